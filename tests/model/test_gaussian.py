"""The linear Gaussian model against its dense formulas."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from cangauge._typing import FloatArray
from cangauge.model.gaussian import GaussianPosterior, Rows


def drawn(seed: int, n: int, p: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return X, y, standard deviations of noise and of prior."""
    rng = np.random.default_rng(seed)
    sizes = 10.0 ** rng.uniform(-3.0, 3.0, p)
    X = rng.normal(size=(n, p)) * sizes
    std, prior_std = rng.uniform(0.1, 2.0, n), rng.uniform(0.3, 3.0, p) / sizes
    y = X @ (prior_std * rng.normal(size=p)) + std * rng.normal(size=n)
    return X, y, std, prior_std


def log_evidence(rows: Rows) -> float:
    """Return the log density of y with all coefficients integrated out."""
    left = rows.eliminated(rows.table.shape[1] - 1)
    return left.log_norm - 0.5 * float(np.sum(left.table**2))


def dense(
    X: FloatArray, y: FloatArray, cov: FloatArray, prior_std: FloatArray
) -> tuple[GaussianPosterior, float]:
    P = np.diag(prior_std**2)
    S = X @ P @ X.T + cov
    gain = P @ X.T @ np.linalg.inv(S)
    V = P - gain @ X @ P
    density = multivariate_normal(cov=S, allow_singular=False).logpdf(y)
    scaled = V / np.outer(prior_std, prior_std)
    root = prior_std[:, None] * np.linalg.cholesky(0.5 * (scaled + scaled.T))
    return GaussianPosterior(gain @ y, root), float(density)


def check(rows: Rows, right: GaussianPosterior, density: float, prior_std: FloatArray) -> None:
    assert log_evidence(rows) == pytest.approx(density, rel=1e-8, abs=1e-6)
    found = rows.posterior()
    np.testing.assert_allclose(found.mean / prior_std, right.mean / prior_std, atol=1e-6)
    scale = np.outer(prior_std, prior_std)
    np.testing.assert_allclose(found.covariance / scale, right.covariance / scale, atol=1e-6)


SIZES = {"seed": st.integers(0, 10**6), "n": st.integers(1, 40), "p": st.integers(1, 6)}


@settings(max_examples=60, deadline=None)
@given(**SIZES)
def test_posterior_and_evidence_are_those_of_the_dense_formula(seed: int, n: int, p: int) -> None:
    X, y, std, prior_std = drawn(seed, n, p)
    rows = Rows.of(X, y, std) + Rows.prior(prior_std)
    check(rows, *dense(X, y, np.diag(std**2), prior_std), prior_std)


@settings(max_examples=30, deadline=None)
@given(**SIZES)
def test_correlated_noise(seed: int, n: int, p: int) -> None:
    X, y, std, prior_std = drawn(seed, n, p)
    at = np.arange(n)
    cov = np.outer(std, std) * np.exp(-np.abs(at[:, None] - at) / 3.0)
    rows = Rows.correlated(X, y, np.linalg.cholesky(cov)) + Rows.prior(prior_std)
    check(rows, *dense(X, y, cov, prior_std), prior_std)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(2, 200), p=st.integers(2, 5))
def test_rows_may_be_split_and_columns_eliminated(seed: int, n: int, p: int) -> None:
    X, y, std, prior_std = drawn(seed, n, p)
    half = n // 2
    parts = [Rows.of(X[at], y[at], std[at]) for at in (slice(half), slice(half, None))]
    rows = parts[0] + parts[1] + Rows.prior(prior_std)
    assert len(rows.table) <= p + 1
    together = Rows.of(X, y, std) + Rows.prior(prior_std)
    whole = together.posterior()
    check(rows, whole, log_evidence(together), prior_std)
    assert log_evidence(rows.eliminated(1)) == pytest.approx(log_evidence(together), abs=1e-6)
    rest = rows.eliminated(1).posterior()
    np.testing.assert_allclose(rest.mean / prior_std[1:], whole.mean[1:] / prior_std[1:], atol=1e-6)


@settings(max_examples=30, deadline=None)
@given(**SIZES, k=st.integers(1, 4))
def test_an_added_column_gains_the_difference_of_evidence(
    seed: int, n: int, p: int, k: int
) -> None:
    X, y, std, prior_std = drawn(seed, n, p + k)
    added = (Rows.of(X, y, std) + Rows.prior(prior_std[:p], others=k)).added(p, prior_std[p:])
    rows = Rows.of(X, y, std)
    base = rows.with_columns(range(p)) + Rows.prior(prior_std[:p])
    for j in range(p, p + k):
        prior = Rows.prior(np.r_[prior_std[:p], prior_std[j]])
        rows_with_it = rows.with_columns([*range(p), j]) + prior
        gain = log_evidence(rows_with_it) - log_evidence(base)
        with_it = rows_with_it.posterior()
        assert added.log_factor[j - p] == pytest.approx(gain, abs=1e-5)
        size = prior_std[j]
        assert added.mean[j - p] / size == pytest.approx(with_it.mean[-1] / size, abs=1e-5)

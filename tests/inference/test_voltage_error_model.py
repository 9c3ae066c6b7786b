"""The error model against dense Gaussians, quadrature and drawn errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import multivariate_normal

from cangauge.inference.error_model import (
    CURVE_FROM_S,
    KNOTS_PCT,
    SCALES,
    ErrorEquations,
    LogResidual,
    RestrictedLikelihood,
    TimeError,
    curve_prior,
    describe_error,
    haar_variances,
    principal_functions,
    variance_of_sum,
)
from cangauge.inference.time_scales import haar_transform

OCV_V = 340.0 + 0.55 * KNOTS_PCT
OHM = (-0.1, -0.02)


def exponential(size: int, rows: float) -> np.ndarray:
    """Covariance of an exponentially correlated error of unit variance."""
    lag = np.abs(np.subtract.outer(np.arange(size), np.arange(size)))
    return np.exp(-lag / rows) if rows > 0.0 else np.eye(size)


def drawn_log(rng: np.random.Generator, error_v: np.ndarray, start_pct: float) -> LogResidual:
    size = error_v.size
    current_a = np.repeat(rng.normal(15.0, 25.0, size // 10 + 1), 10)[:size]
    soc = start_pct - np.cumsum(current_a) / 36.0 / 60.0
    delayed = np.column_stack([current_a, np.roll(current_a, 10)])
    return LogResidual(error_v, soc, 20.0 + 0.001 * np.arange(size), delayed)


@settings(max_examples=20, deadline=None)
@given(rows=st.floats(0.0, 200.0))
def test_haar_variances_equal_the_dense_covariance(rows: float) -> None:
    size = 64
    transform = haar_transform(np.eye(size), SCALES)
    covariance = exponential(size, rows if rows > 1e-3 else 0.0)
    expected = haar_variances(1.0, rows if rows > 1e-3 else 0.0)
    for scale, coefficients in enumerate(transform[:6]):
        found = np.einsum("ij,jk,ik->i", coefficients, covariance, coefficients)
        np.testing.assert_allclose(found, expected[scale], rtol=1e-9)
    total = covariance.sum()
    assert variance_of_sum(np.array([float(size)]), rows)[0] == pytest.approx(total, rel=1e-6)


def test_white_errors_have_the_dense_restricted_likelihood() -> None:
    """White and lasting errors are diagonal in the transform: no approximation is left."""
    rng = np.random.default_rng(0)
    tables = [rng.normal(size=(256, 4)) for _ in range(3)]
    for table in tables:  # columns without content at the scales that are left out
        table[:, :3] = np.repeat(rng.normal(size=(2, 3)), 128, axis=0)
    prior = np.diag([1.0, 4.0, 0.25])
    mean = np.array([0.3, -0.2, 0.1])
    found = RestrictedLikelihood(ErrorEquations.of_tables(tables), mean, prior, 1.0)

    def dense(error: TimeError) -> float:
        columns = np.vstack([table[:, :3] for table in tables])
        values = np.concatenate([table[:, 3] for table in tables])
        covariance = error.fast_std_v**2 * np.eye(768) + columns @ np.linalg.inv(prior) @ columns.T
        for k in range(3):
            at = slice(256 * k, 256 * (k + 1))
            covariance[at, at] += error.lasting_std_v**2
        return float(multivariate_normal.logpdf(values, columns @ mean, covariance))

    one = TimeError(0.8, 0.0, 1e-9, 300.0, 0.4)
    other = TimeError(1.1, 0.0, 1e-9, 300.0, 1.5)
    difference = found.log_likelihood(one) - found.log_likelihood(other)
    assert difference == pytest.approx(dense(one) - dense(other), rel=1e-6)


def test_a_shared_error_is_integrated_out() -> None:
    """Of one shared error: the closed form against quadrature over it."""
    rng = np.random.default_rng(4)
    column = np.repeat([1.0, -0.5], 128)
    table = np.column_stack([column, rng.normal(size=256) + 0.7 * column])
    likelihood = RestrictedLikelihood(
        ErrorEquations.of_tables([table]), np.zeros(1), np.array([[2.0]]), 1.0
    )

    def by_quadrature(std_v: float) -> float:
        def density(amplitude: float) -> float:
            square = np.sum((table[:, 1] - amplitude * column) ** 2)
            log_density = -0.5 * square / std_v**2 - 256.0 * np.log(std_v) - amplitude**2
            return float(np.exp(log_density + 0.5 * 256.0))

        return float(np.log(quad(density, -8.0, 8.0, points=[0.7], limit=200)[0]))

    found = [
        likelihood.log_likelihood(TimeError(std_v, 0.0, 1e-9, 300.0, 1e-9)) for std_v in (0.9, 1.1)
    ]
    assert found[0] - found[1] == pytest.approx(by_quadrature(0.9) - by_quadrature(1.1), rel=1e-6)


def test_fast_error_is_found_beside_a_drift() -> None:
    """A drift of 5 V over each log; an autocovariance fit gave 0 V in 26 of 30 draws."""
    for seed in range(30):
        rng = np.random.default_rng(seed)
        logs = [
            drawn_log(
                rng,
                rng.normal(0.0, 0.5, 1500) + np.linspace(0.0, 5.0, 1500) * rng.choice([-1.0, 1.0]),
                start_pct=80.0 - 10.0 * k,
            )
            for k in range(3)
        ]
        error, _ = describe_error(logs, OCV_V, OHM, 1.0)
        assert error.fast_std_v == pytest.approx(0.5, rel=0.15), seed


@pytest.mark.parametrize("rate_hz", [1.0, 0.5])
def test_white_errors_are_white_at_every_rate(rate_hz: float) -> None:
    rng = np.random.default_rng(3)
    logs = [drawn_log(rng, rng.normal(0.0, 0.5, 3000), 80.0) for _ in range(3)]
    error, _ = describe_error(logs, OCV_V, OHM, rate_hz)
    assert error.fast_std_v == pytest.approx(0.5, rel=0.1)
    assert error.fast_time_s < 1.0 / rate_hz


def test_the_curve_is_known_only_where_logs_were() -> None:
    rng = np.random.default_rng(7)
    widths = {}
    for number in (1, 2, 6):
        logs = [drawn_log(rng, rng.normal(0.0, 0.4, 1800), 80.0) for _ in range(number)]
        _, curve = describe_error(logs, OCV_V, OHM, 1.0)
        std_v = np.linalg.norm(curve.function_v, axis=0)
        seen = std_v[np.searchsorted(KNOTS_PCT, 75.0)]
        assert std_v[np.searchsorted(KNOTS_PCT, 30.0)] > 4.0 * seen
        assert std_v[0] > std_v[np.searchsorted(KNOTS_PCT, 30.0)]
        widths[number] = seen
    assert widths[1] > widths[2] > widths[6]


def test_principal_functions_keep_every_variance() -> None:
    _, covariance = curve_prior(360.0)
    functions = principal_functions(covariance)
    np.testing.assert_allclose(np.sum(functions**2, axis=0), np.diag(covariance), rtol=1e-9)


def test_short_stretches_say_nothing_of_the_curve() -> None:
    rng = np.random.default_rng(1)
    table = rng.normal(size=(2048, 3))
    likelihood = RestrictedLikelihood(
        ErrorEquations.of_tables([table]), np.zeros(2), np.eye(2), 1.0
    )
    _, covariance = likelihood.posterior(TimeError(1.0, 0.0, 1e-9, 300.0, 1e-9))
    scales = haar_transform(table[:, :2], SCALES)
    slow = [item for j, item in enumerate(scales) if 2.0 ** (j + 1) >= CURVE_FROM_S]
    products = sum(item.T @ item for item in slow)
    np.testing.assert_allclose(np.linalg.inv(covariance), np.eye(2) + products, rtol=1e-6)

"""Haar transform: orthonormal, and noise has the stated variance on each scale."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from cangauge.inference.time_scales import SCALES, HaarBlocks, haar_transform, scale_variances

FloatArray = NDArray[np.float64]
ROWS = 2048


@given(st.integers(1, 3000), st.integers(1, 4), st.integers(0, 2**31))
@example(1, 1, 0)
@example(2, 1, 0)
@example(3, 2, 1)
@example(1023, 1, 0)
@example(1024, 1, 0)
@example(1025, 1, 0)
def test_preserves_sums_of_squares_and_products(rows: int, columns: int, seed: int) -> None:
    values = np.random.default_rng(seed).normal(3.0, 1.0, (rows, columns))
    parts = haar_transform(values)
    assert len(parts) == SCALES
    assert sum(len(part) for part in parts) == rows
    kept = sum(part.T @ part for part in parts)
    np.testing.assert_allclose(kept, values.T @ values, rtol=1e-9, atol=1e-9 * rows)


@given(st.integers(1, 300))
@example(256)
def test_is_orthonormal(rows: int) -> None:
    transform = np.vstack(haar_transform(np.eye(rows)))
    np.testing.assert_allclose(transform @ transform.T, np.eye(rows), atol=1e-12)


@settings(deadline=None)
@given(st.integers(8, 2000), st.floats(-5.0, 5.0))
def test_a_constant_is_slow_and_an_alternation_is_fast(rows: int, level: float) -> None:
    """A constant lies in the last scale alone, alternating signs mostly in the first."""
    constant = haar_transform(np.full((rows, 1), level))
    for part in constant[:-1]:
        np.testing.assert_allclose(part, 0.0, atol=1e-9)
    assert float(np.sum(constant[-1] ** 2)) == pytest.approx(rows * level**2, rel=1e-9, abs=1e-9)
    alternating = haar_transform(np.where(np.arange(rows) % 2, 1.0, -1.0)[:, None])
    assert float(np.sum(alternating[0] ** 2)) > 0.6 * rows


@settings(deadline=None)
@given(st.integers(1, 3000), st.integers(3, 12), st.integers(0, 3), st.integers(0, 2**31))
def test_blocks_have_the_coefficients_of_the_whole(
    rows: int, exponent: int, finest: int, seed: int
) -> None:
    values = np.random.default_rng(seed).normal(3.0, 1.0, (rows, 2))
    transform = HaarBlocks(SCALES, 2**finest)
    size = 2**exponent
    parts = [transform.add(values[first : first + size]) for first in range(0, rows, size)]
    parts.append(transform.end())
    found = [np.vstack(of_scale) for of_scale in zip(*parts, strict=True)]
    for scale, expected in enumerate(haar_transform(values)):
        if scale >= finest:
            np.testing.assert_allclose(
                np.sort(found[scale], axis=0), np.sort(expected, axis=0), atol=1e-9
            )


def test_a_step_lies_on_the_scale_of_its_stretches() -> None:
    step = haar_transform(np.repeat([0.0, 1.0], 32)[:, None])
    by_size = [float(np.sum(part**2)) for part in step]
    # 64 rows: the mean (of scale SCALES − 1) and the difference of two stretches of 32 rows.
    assert by_size[5] == pytest.approx(16.0)
    assert by_size[-1] == pytest.approx(16.0)
    assert sum(by_size) == pytest.approx(32.0)


def expected_variances(covariance: FloatArray) -> list[float]:
    """The mean variance of each scale's coefficients, from the covariance of the error."""
    transform = haar_transform(np.eye(len(covariance)))
    return [float(np.mean(np.sum((part @ covariance) * part, axis=1))) for part in transform]


@pytest.mark.parametrize(
    ("fast_v2", "fast_rows", "slow_v2", "slow_rows"),
    [(0.3, 0.0, 0.0, 0.0), (0.0, 0.0, 2.0, 5.0), (0.2, 1.5, 0.7, 12.0), (0.1, 0.0, 0.5, 60.0)],
)
def test_scale_variances_follow_from_the_covariance(
    fast_v2: float, fast_rows: float, slow_v2: float, slow_rows: float
) -> None:
    """Exact on stretches of 2ʲ rows, for white and exponentially correlated noise."""
    apart = np.abs(np.subtract.outer(np.arange(ROWS), np.arange(ROWS)))
    covariance = np.zeros((ROWS, ROWS))
    for variance, length in ((fast_v2, fast_rows), (slow_v2, slow_rows)):
        alike = np.exp(-apart / length) if length > 0.0 else np.eye(ROWS)
        covariance += variance * alike
    expected = expected_variances(covariance)
    found = scale_variances(fast_v2, fast_rows, slow_v2, slow_rows)
    assert found.shape == (SCALES,)
    np.testing.assert_allclose(found[:-1], expected[:-1], rtol=1e-9)
    # The last scale stands for all slower ones, with the spectral density at frequency zero, which
    # stretches of 512 rows approach from below.
    assert expected[-1] <= found[-1] * (1.0 + 1e-9)
    longest = max(fast_rows, slow_rows)
    assert found[-1] <= expected[-1] * (1.0 + 6.0 * longest / 512.0) + 1e-12


def test_drawn_noise_has_the_stated_variance() -> None:
    """White noise of 0.4 V plus 0.8 V correlated over 30 rows."""
    rng = np.random.default_rng(4)
    rows, kept = 1 << 17, np.exp(-1.0 / 30.0)
    drive = rng.normal(0.0, 0.8 * np.sqrt(1.0 - kept**2), rows).tolist()
    slow = [rng.normal(0.0, 0.8)]
    for kick in drive[1:]:
        slow.append(kept * slow[-1] + kick)
    error = np.array(slow) + rng.normal(0.0, 0.4, rows)
    stated = scale_variances(0.16, 0.0, 0.64, 30.0)
    for part, variance in zip(haar_transform(error[:, None]), stated, strict=True):
        # Four standard deviations of the mean of the squares.
        assert float(np.mean(part**2)) == pytest.approx(
            variance, rel=4.0 * np.sqrt(2.0 / len(part))
        )


def test_white_noise_is_flat_and_correlated_noise_grows() -> None:
    np.testing.assert_allclose(scale_variances(0.5, 0.0, 0.0, 0.0), 0.5)
    assert np.all(np.diff(scale_variances(0.0, 0.0, 1.0, 40.0)) > 0.0)

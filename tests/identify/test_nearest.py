"""Projection onto linear bounds, at any scale of the numbers."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import nnls

from cangauge.inference.least_squares import nearest_rising

FloatArray = NDArray[np.float64]


def by_lawson_and_hanson(z: FloatArray, bounds: FloatArray, at_least: FloatArray) -> FloatArray:
    """The point by least distance programming (Solving Least Squares Problems, 1974, ch. 23)."""
    unit = float(np.abs(missed := at_least - bounds @ z).max())
    table = np.vstack([bounds.T, missed / unit])
    wanted = np.zeros(z.size + 1)
    wanted[-1] = 1.0
    weights, _ = nnls(table, wanted, maxiter=10_000)
    rest = table @ weights - wanted
    return z - unit * rest[:-1] / rest[-1]


@pytest.mark.parametrize("seed", [1744, *range(30)])
def test_projection_equals_lawson_and_hanson(seed: int) -> None:
    """Seed 1744: the solver alone stops short of its tolerance."""
    rng = np.random.default_rng(seed)
    n, m = rng.integers(2, 40), rng.integers(1, 30)
    bounds = rng.normal(size=(m, n)) @ np.diag(10.0 ** rng.uniform(-4.0, 0.0, n))
    bounds /= np.linalg.norm(bounds, axis=1)[:, None]
    z = rng.normal(size=n) * 10.0 ** rng.uniform(0.0, 4.0)
    at_least = bounds @ rng.normal(size=n) - rng.uniform(0.0, 1.0, m) * rng.integers(0, 2, m)
    at_least = np.where(rng.random(m) < 0.5, np.minimum(at_least, 0.0), at_least)
    found = nearest_rising(np.eye(n), z, bounds, at_least)
    if np.all(bounds @ z >= at_least):
        assert np.array_equal(found, z)
        return
    best = by_lawson_and_hanson(z, bounds, at_least)
    size = 1.0 + np.abs(z).max()
    assert (bounds @ found - at_least).min() > -1e-6 * size
    assert np.linalg.norm(found - z) == pytest.approx(np.linalg.norm(best - z), rel=1e-5)

"""Long series thinned for drawing, so that no peak is lost."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

POINTS_AT_MOST = 4000
"""A screen shows no more than this many points of a line."""


def extremes(values: FloatArray, at_most: int = POINTS_AT_MOST) -> NDArray[np.intp]:
    """Return the rows to draw: the smallest and the largest value of each bucket of rows.

    Parameters
    ----------
    values : array of shape (n,)
        May hold NaN; a bucket with NaN keeps one, so that the drawn line breaks there too.
    at_most : int
        No more rows than this are returned (6 or more).

    Returns
    -------
    array of shape (m,), m ≤ max(at_most, 0)
        Increasing row numbers; all of them if n ≤ `at_most`.
    """
    if values.size <= at_most:
        return np.arange(values.size)
    missing = np.isnan(values)
    rows = _buckets(values.size, at_most // (3 if missing.any() else 2))
    kept = [_take(rows, np.where(missing, np.inf, values), np.argmin)]
    kept.append(_take(rows, np.where(missing, -np.inf, values), np.argmax))
    if missing.any():
        broken = missing[rows].any(axis=1)
        kept.append(_take(rows, missing.astype(np.float64), np.argmax)[broken])
    return np.unique(np.concatenate(kept))


def envelope(
    low: FloatArray, high: FloatArray, at_most: int = POINTS_AT_MOST
) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """Thin a band: rows (the first of each bucket), lowest `low` and highest `high` of each.

    Parameters
    ----------
    low, high : array of shape (n,)
        NaN where the band is not known; a bucket without any value gives NaN.
    at_most : int
        No more buckets than this.
    """
    if low.size <= at_most:
        return np.arange(low.size), low, high
    rows = _buckets(low.size, at_most)
    lowest = np.where(np.isnan(low), np.inf, low)[rows].min(axis=1)
    highest = np.where(np.isnan(high), -np.inf, high)[rows].max(axis=1)
    known = np.isfinite(lowest) & np.isfinite(highest)
    return rows[:, 0], np.where(known, lowest, np.nan), np.where(known, highest, np.nan)


def every(n: int, at_most: int = POINTS_AT_MOST) -> slice:
    """Return the slice that thins n points of a cloud evenly to no more than `at_most`."""
    return slice(None, None, max(1, -(-n // at_most)))


def _buckets(n: int, number: int) -> NDArray[np.intp]:
    """Return row numbers, shape (≤ number, size); the last row fills up the last bucket."""
    size = -(-n // number)
    rows = np.arange(-(-n // size) * size)
    return np.minimum(rows, n - 1).reshape(-1, size)


def _take(
    rows: NDArray[np.intp], values: FloatArray, pick: Callable[..., NDArray[np.intp]]
) -> NDArray[np.intp]:
    chosen = pick(values[rows], axis=1)
    return np.asarray(rows[np.arange(rows.shape[0]), chosen])

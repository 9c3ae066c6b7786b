"""A log's rows by time scale: an orthonormal Haar transform.

What a model misses is correlated in time, and more so over minutes than over seconds. In the
transform each coefficient is the difference of two neighbouring stretches of the log, and
coefficients of one scale have about the same variance and hardly any correlation, whatever the
spectrum. So errors can be weighed scale by scale: a delay of a second is judged against the fast
errors, an offset against the slow ones (Wornell, Proc. IEEE 81 (1993) 1428).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

SCALES: Final = 10
"""Scales: stretches of 2, 4, … 512 rows, and all longer ones with the log's mean."""


def by_scale(columns: FloatArray) -> list[FloatArray]:
    """Return the transform of some columns, one array a scale, the finest first.

    Parameters
    ----------
    columns : array of shape (n, k)
        Rows in order of time.

    Returns
    -------
    list of arrays
        `SCALES` arrays of shape (n_j, k) with Σ n_j = n; sums of squares and products over all of
        them are those of the rows.
    """
    n = columns.shape[0]
    total = np.zeros((n + 1, columns.shape[1]))
    np.cumsum(columns, axis=0, out=total[1:])
    parts: list[list[FloatArray]] = [[] for _ in range(SCALES)]
    parts[-1].append(total[-1:] / np.sqrt(n))
    edges = np.array([0, n])
    while True:
        left, right = edges[:-1], edges[1:]
        split = right - left > 1
        if not split.any():
            break
        a, b = left[split], right[split]
        # At the largest power of two inside, so that stretches have the same lengths in all logs.
        m = a + 2 ** np.ceil(np.log2(b - a) - 1.0).astype(np.intp)
        first, second = (m - a).astype(float), (b - m).astype(float)
        gain = np.sqrt(first * second / (first + second))[:, None]
        change = (total[b] - total[m]) / second[:, None] - (total[m] - total[a]) / first[:, None]
        scale = np.minimum(np.rint(np.log2(first + second)).astype(np.intp) - 1, SCALES - 1)
        for j in np.unique(scale):
            parts[j].append((gain * change)[scale == j])
        edges = np.unique(np.concatenate((edges, m)))
    empty = np.zeros((0, columns.shape[1]))
    return [np.vstack([empty, *part]) for part in parts]


def scale_variances(
    fast_v2: float, fast_rows: float, slow_v2: float, slow_rows: float
) -> FloatArray:
    """Return the variance of the coefficients of an error of two correlated parts, shape (SCALES,).

    Parameters
    ----------
    fast_v2, slow_v2 : float
        Variances [V²].
    fast_rows, slow_rows : float
        Correlation lengths, in rows; 0 is white.
    """
    result = np.zeros(SCALES)
    for variance, rows in ((fast_v2, fast_rows), (slow_v2, slow_rows)):
        sums = [_variance_of_sum(2**j, rows) for j in range(SCALES + 1)]
        half, whole = np.array(sums[:-1]), np.array(sums[1:])
        size = 2.0 ** np.arange(1, SCALES + 1)
        result += variance * (4.0 * half - whole) / size
        # Longer stretches and the mean: the density at frequency zero.
        density = 1.0 if rows <= 0.0 else (1.0 + np.exp(-1.0 / rows)) / (1.0 - np.exp(-1.0 / rows))
        result[-1] += variance * (density - (4.0 * half[-1] - whole[-1]) / size[-1])
    return result


def _variance_of_sum(n: int, rows: float) -> float:
    if rows <= 0.0:
        return float(n)
    lag = np.arange(1, n)
    return float(n + 2.0 * np.sum((n - lag) * np.exp(-lag / rows)))

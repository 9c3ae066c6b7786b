"""Error model by time scale: an orthonormal Haar transform of a log's rows.

Model errors are correlated in time, over minutes more than over seconds. A coefficient of the
transform is the difference of two neighbouring stretches of the log. Coefficients of one scale have
about equal variance and little correlation, whatever the spectrum, so errors can be weighted scale
by scale: a delay of a second against the fast errors, an offset against the slow ones (Wornell,
Proc. IEEE 81 (1993) 1428).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cangauge._typing import FloatArray

SCALES: Final = 10
"""Number of scales: stretches of 2, 4, … 512 rows, then all longer ones and the log's mean."""


def haar_transform(columns: FloatArray, scales: int = SCALES) -> list[FloatArray]:
    """Return the Haar transform of columns, one array per scale, the finest first.

    Parameters
    ----------
    columns : array of shape (n, k)
        Rows in order of time.
    scales : int
        Number of scales; the last row of the last one belongs to the log's mean.

    Returns
    -------
    list of arrays
        `scales` arrays of shape (n_j, k) with Σ n_j = n. The transform is orthonormal: sums of
        squares and products are those of the rows.
    """
    n = columns.shape[0]
    total = np.zeros((n + 1, columns.shape[1]))
    np.cumsum(columns, axis=0, out=total[1:])
    differences, counts = _differences(n, scales)
    coefficients = np.empty_like(total[1:])
    coefficients[:-1] = differences @ total
    coefficients[-1] = total[-1] / np.sqrt(n)
    return np.split(coefficients, np.cumsum(counts)[:-1])


def _differences(n: int, scales: int) -> tuple[sparse.csr_array, NDArray[np.intp]]:
    """Return the matrix from cumulative sums to coefficients, and the number per scale.

    The matrix, shape (n − 1, n + 1), holds the finest scale first and omits the log's mean.
    """
    edges = np.array([0, n])
    stretches = []
    while True:
        first, end = edges[:-1], edges[1:]
        split = end - first > 1
        if not split.any():
            break
        first, end = first[split], end[split]
        # Split at the largest power of two, so that stretches have the same lengths in all logs.
        middle = first + 2 ** np.ceil(np.log2(end - first) - 1.0).astype(np.intp)
        stretches.append(np.stack([first, middle, end]))
        edges = np.unique(np.concatenate((edges, middle)))
    first, middle, end = np.hstack([np.zeros((3, 0), dtype=np.intp), *stretches])
    scale = np.minimum(np.rint(np.log2(end - first)).astype(np.intp) - 1, scales - 1)
    order = np.argsort(scale, kind="stable")
    first, middle, end = first[order], middle[order], end[order]
    left, right = (middle - first).astype(float), (end - middle).astype(float)
    gain = np.sqrt(left * right / (left + right))
    weights = np.concatenate((gain / left, -gain / left - gain / right, gain / right))
    at = (np.tile(np.arange(first.size), 3), np.concatenate((first, middle, end)))
    counts = np.bincount(scale, minlength=scales)
    counts[-1] += 1  # the mean
    return sparse.csr_array((weights, at), shape=(first.size, n + 1)), counts


def scale_variances(
    fast_v2: float, fast_rows: float, slow_v2: float, slow_rows: float
) -> FloatArray:
    """Return the variance of the Haar coefficients of an error of two parts, shape (SCALES,).

    Parameters
    ----------
    fast_v2, slow_v2 : float
        Variances [V²].
    fast_rows, slow_rows : float
        Exponential correlation lengths, in rows; 0 is white.
    """
    result = np.zeros(SCALES)
    for variance, rows in ((fast_v2, fast_rows), (slow_v2, slow_rows)):
        sums = [_variance_of_sum(2**j, rows) for j in range(SCALES + 1)]
        half, whole = np.array(sums[:-1]), np.array(sums[1:])
        size = 2.0 ** np.arange(1, SCALES + 1)
        result += variance * (4.0 * half - whole) / size
        # Longer stretches and the mean: the spectral density at frequency zero.
        density = 1.0 if rows <= 0.0 else (1.0 + np.exp(-1.0 / rows)) / (1.0 - np.exp(-1.0 / rows))
        result[-1] += variance * (density - (4.0 * half[-1] - whole[-1]) / size[-1])
    return result


def _variance_of_sum(n: int, rows: float) -> float:
    if rows <= 0.0:
        return float(n)
    lag = np.arange(1, n)
    return float(n + 2.0 * np.sum((n - lag) * np.exp(-lag / rows)))

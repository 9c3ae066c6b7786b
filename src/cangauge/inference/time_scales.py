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
    parts: list[list[FloatArray]] = [[] for _ in range(scales)]
    sums, size, last = columns, 1, 1  # of stretches of `size` rows; the last one may be shorter
    while len(sums) > 1:
        pairs = len(sums) // 2
        left, right = sums[: 2 * pairs : 2], sums[1 : 2 * pairs : 2]
        differences = left - right
        differences /= np.sqrt(2.0 * size)
        is_odd = len(sums) % 2 == 1
        full = pairs if is_odd or last == size else pairs - 1
        parts[min(size.bit_length() - 1, scales - 1)].append(differences[:full])
        if full < pairs:
            gain = np.sqrt(size * last / (size + last))
            scale = int(np.rint(np.log2(size + last))) - 1
            shorter = gain * (left[-1:] / size - right[-1:] / last)
            parts[min(scale, scales - 1)].append(shorter)
        added = np.empty((pairs + is_odd, *columns.shape[1:]))
        np.add(left, right, out=added[:pairs])
        added[pairs:] = sums[2 * pairs :]
        sums = added
        last = last if is_odd else size + last
        size *= 2
    parts[-1].append(sums / np.sqrt(columns.shape[0]))  # the mean
    none = columns[:0]
    return [np.concatenate(part) if len(part) > 1 else [*part, none][0] for part in parts]


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

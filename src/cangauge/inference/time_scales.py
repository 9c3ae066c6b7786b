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
    transform = HaarBlocks(scales)
    parts = [transform.add(columns), transform.end()]
    return [np.concatenate(of_scale) for of_scale in zip(*parts, strict=True)]


class HaarBlocks:
    """Haar transform of columns that come in blocks of rows, in order of time.

    The coefficients are those of `haar_transform` of all rows: stretches of a block end with it.

    Parameters
    ----------
    scales : int
        Number of scales.
    finest : int
        Rows of the shortest stretches that are compared, a power of two: the coefficients of
        shorter ones are left out.
    """

    def __init__(self, scales: int, finest: int = 1) -> None:
        self._scales, self._finest = scales, finest
        self._sums: list[FloatArray] = []
        self._rows = self._size = self._last = 0

    def add(self, block: FloatArray) -> list[FloatArray]:
        """Return the coefficients within a block, one array of shape (n_j, k) per scale.

        Parameters
        ----------
        block : array of shape (m, k)
            m is the same power of two in every block but the last, at least `finest`.
        """
        rows, size = len(block), self._finest
        sums, last = block, 1
        if size > 1:
            sums = np.add.reduceat(block, np.arange(0, rows, size), axis=0)
            last = rows - size * (len(sums) - 1)
        parts, total = self._compare(sums, size, last)
        self._size = self._size or rows
        self._last, self._rows = rows, self._rows + rows
        self._sums.append(total)
        return parts

    def end(self) -> list[FloatArray]:
        """Return the coefficients between blocks; the last row of the last scale is the mean."""
        parts, total = self._compare(np.concatenate(self._sums), self._size, self._last)
        parts[-1] = np.concatenate((parts[-1], total / np.sqrt(self._rows)))
        return parts

    def _compare(
        self, sums: FloatArray, size: int, last: int
    ) -> tuple[list[FloatArray], FloatArray]:
        """Return coefficients and total of stretches of `size` rows, the last one of `last`."""
        parts: list[list[FloatArray]] = [[sums[:0]] for _ in range(self._scales)]
        while len(sums) > 1:
            pairs = len(sums) // 2
            left, right = sums[: 2 * pairs : 2], sums[1 : 2 * pairs : 2]
            differences = left - right
            differences /= np.sqrt(2.0 * size)
            is_odd = len(sums) % 2 == 1
            full = pairs if is_odd or last == size else pairs - 1
            parts[min(size.bit_length() - 1, self._scales - 1)].append(differences[:full])
            if full < pairs:
                gain = np.sqrt(size * last / (size + last))
                scale = int(np.rint(np.log2(size + last))) - 1
                shorter = gain * (left[-1:] / size - right[-1:] / last)
                parts[min(scale, self._scales - 1)].append(shorter)
            added = np.empty((pairs + is_odd, *sums.shape[1:]))
            np.add(left, right, out=added[:pairs])
            added[pairs:] = sums[2 * pairs :]
            sums = added
            last = last if is_odd else size + last
            size *= 2
        return [part[-1] if len(part) == 2 else np.concatenate(part) for part in parts], sums


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

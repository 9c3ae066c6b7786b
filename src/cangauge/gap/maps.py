"""Maps of the error: its root mean square over SoC × current and SoC × temperature."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

LEAST_ROWS = 10
"""A bin with fewer rows says little and is left empty."""

ROWS_A_BIN = 150
"""No axis has more bins than one for so many rows of the logs, or than `LEAST_BINS`."""

LEAST_BINS = 5

SOC_BINS, OTHER_BINS = 20, 14
"""No axis has more bins than this."""

TAIL_ROWS, TAIL_PART = 100, (0.01, 0.1)
"""So many rows at either end of the current, within these parts of all, share one bin."""

LEAST_WIDTH = 1.0
"""No bin is narrower than 1 %, 1 A or 1 K."""


@dataclass(frozen=True, eq=False)
class ErrorMap:
    """Error over two quantities; k × m bins, k of the second quantity, m of the SoC."""

    soc_edges_pct: FloatArray
    """Shape (m + 1,)."""
    edges: FloatArray
    """Of the second quantity, shape (k + 1,)."""
    rows: NDArray[np.intp]
    """Rows in each bin, shape (k, m)."""
    rms_v: FloatArray
    """Root mean square error [V]; NaN in bins with fewer than `LEAST_ROWS` rows."""
    mean_v: FloatArray
    """Mean error [V]; NaN where `rms_v` is."""
    tails: bool = False
    """Whether the lowest and highest bins of the second quantity hold all that lies beyond."""


def error_map(
    soc_pct: FloatArray, values: FloatArray, error_v: FloatArray, *, tails: bool = False
) -> ErrorMap:
    """Return the map of an error.

    Parameters
    ----------
    soc_pct, values : array of shape (n,)
        SoC [%], and current [A] or temperature [°C] of each row: they alone choose the bins, so
        that maps of two errors on the same rows can be compared.
    error_v : array of shape (n,)
        Measured − model [V].
    tails : bool
        Whether `values` has long tails, which then go into its outermost bins.
    """
    if tails:
        values = _without_tails(values)
    most = max(LEAST_BINS, soc_pct.size // ROWS_A_BIN)
    across = even_edges(soc_pct, min(SOC_BINS, most))
    up = even_edges(values, min(OTHER_BINS, most))
    shape = up.size - 1, across.size - 1
    at = _bin(up, values) * shape[1] + _bin(across, soc_pct)

    def total(weights: FloatArray | None = None) -> FloatArray:
        sums = np.bincount(at, weights=weights, minlength=shape[0] * shape[1])
        return sums.reshape(shape).astype(np.float64)

    rows = total()
    enough = np.where(rows >= LEAST_ROWS, rows, np.nan)
    return ErrorMap(
        soc_edges_pct=across,
        edges=up,
        rows=rows.astype(np.intp),
        rms_v=np.sqrt(total(error_v**2) / enough),
        mean_v=total(error_v) / enough,
        tails=tails,
    )


def _without_tails(values: FloatArray) -> FloatArray:
    # One pulse of 400 A must not squeeze a drive at 50 A into two rows of bins.
    part = float(np.clip(TAIL_ROWS / values.size, *TAIL_PART))
    low, high = np.quantile(values, [part, 1.0 - part])
    return np.clip(values, low, high)


def even_edges(values: FloatArray, at_most: int) -> FloatArray:
    """Return edges of even bins over all values, 1, 2 or 5 · 10ᵏ wide.

    Parameters
    ----------
    values : array of shape (n,)
    at_most : int
        No more bins than this.
    """
    low, high = float(values.min()), float(values.max())
    width = LEAST_WIDTH
    for factor in np.tile([2.0, 2.5, 2.0], 10):
        first, last = np.floor(low / width), np.floor(high / width) + 1.0
        if last - first <= at_most:
            break
        width *= factor
    return np.asarray(width * np.arange(first, last + 0.5))


def _bin(edges: FloatArray, values: FloatArray) -> NDArray[np.intp]:
    found = np.searchsorted(edges, values, side="right") - 1
    return np.clip(found, 0, edges.size - 2)

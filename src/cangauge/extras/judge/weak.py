"""A weak cell, from the cell voltages beside the logs.

A cell whose capacity is smaller by w falls behind the others by w·Q while the charge Q is drawn.
With u′ the slope of a cell's curve and I the current, its voltage less the median cell's is

    d = u′(S)·(a + w·(S − 100)/100) − r·I

a (balance) and r (resistance) are free. The w of the other cells show how well w is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from cangauge._typing import FloatArray

WEAK_STD_PCT: Final = 15.0
"""Standard deviation of a weak cell's lack of capacity [%]."""
LEAST_STD_PCT: Final = 1.0
"""Least spread of the capacities of healthy cells [%]: sorted cells of one batch."""
LEAST_SPAN_PCT: Final = 10.0
"""Least span of SoC over all logs from which capacities are compared [%]."""
MAD: Final = 1.4826
"""Standard deviation over median absolute deviation of a normal distribution."""


class WeakestCell(NamedTuple):
    """The weakest cell."""

    number: int
    """From the number of the first cell."""
    log_factor: float
    """ln of the Bayes factor of one weak cell, any of them, against none."""
    size_pct: float
    """Capacity that it lacks [%], and its σ."""
    std_pct: float


def weak_cell(
    volts: Sequence[FloatArray],
    soc_pct: Sequence[FloatArray],
    slope_v: Sequence[FloatArray],
    current_a: Sequence[FloatArray],
    first: int = 1,
) -> WeakestCell | None:
    """Return the weakest cell; None where the logs do not compare capacities.

    Parameters
    ----------
    volts : sequence of array of shape (n, cells)
        Cell voltages of each stretch [V].
    soc_pct, slope_v, current_a : sequence of array of shape (n,)
        SoC of the pack [%], slope of a cell's curve [V/%] and current [A].
    first : int
        Number of the first cell.
    """  # fmt: skip
    cells = np.concatenate(volts)
    S, slope, amps = (np.concatenate(each) for each in (soc_pct, slope_v, current_a))
    has = np.isfinite(cells).all(axis=1) & np.isfinite(S)
    if has.sum() < 4 or cells.shape[1] < 3 or np.ptp(S[has]) < LEAST_SPAN_PCT:
        return None
    cells, S, slope, amps = cells[has], S[has], slope[has], amps[has]
    X = np.column_stack([slope, -slope * (S - 100.0) / 100.0, -amps])
    d = cells - np.median(cells, axis=1, keepdims=True)
    lack = -np.linalg.lstsq(X, d, rcond=None)[0][1]
    lack = lack - np.median(lack)
    spread = max(LEAST_STD_PCT, MAD * float(np.median(np.abs(lack))))
    wide = np.hypot(spread, WEAK_STD_PCT)
    factors = 0.5 * lack**2 * (spread**-2 - wide**-2) - np.log(wide / spread)
    factors = np.where(lack > 0.0, factors + np.log(2.0), -np.inf)
    k = int(np.argmax(lack))
    gain = WEAK_STD_PCT**2 / (WEAK_STD_PCT**2 + spread**2)
    log_factor = float(np.logaddexp.reduce(factors) - np.log(lack.size))
    return WeakestCell(first + k, log_factor, gain * float(lack[k]), float(np.sqrt(gain)) * spread)

"""A weak cell, from the cell voltages beside the logs.

Each cell's SoC follows from the median cell's: S′ = U⁻¹(v − v_median + U(S)), U being the curve of
a cell and S the SoC of the pack; beyond a bend the curve is not its slope. A cell whose capacity
is smaller by w falls behind the others while the charge is drawn:

    S′ − S = a − w·(100 − S)/(100 − w) + r·I/U′

a (balance) and r (resistance) are free. The w of the other cells show how well w is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from scipy.special import expit

from cangauge._typing import FloatArray
from cangauge.extras.judge.faults import P_FAULT

WEAK_STD_PCT: Final = 15.0
"""Standard deviation of a weak cell's lack of capacity [%]."""
LEAST_STD_PCT: Final = 1.0
"""Least spread of the capacities of healthy cells [%]: sorted cells of one batch."""
LEAST_SPAN_PCT: Final = 10.0
"""Least span of SoC over all logs from which capacities are compared [%]."""
MAD: Final = 1.4826
"""Standard deviation over median absolute deviation of a normal distribution."""
CURVE_PCT: Final = np.linspace(-20.0, 110.0, 1301)
"""SoC at which the curve is inverted [%]."""


class WeakestCell(NamedTuple):
    """The weakest cell."""

    number: int
    """From the number of the first cell."""
    log_factor: float
    """ln of the Bayes factor of one weak cell, any of them, against none."""
    lack_pct: float
    """Capacity that it lacks [%], and its σ."""
    std_pct: float

    @property
    def probability(self) -> float:
        """Of a weak cell."""
        return float(expit(self.log_factor + np.log(P_FAULT / (1.0 - P_FAULT))))

    def behind_pct(self, soc_pct: FloatArray) -> FloatArray:
        """Return by how much the cell is behind a pack that was full [% SoC]."""
        return self.lack_pct * (100.0 - soc_pct) / (100.0 - self.lack_pct)


def weak_cell(
    volts: Sequence[FloatArray],
    soc_pct: Sequence[FloatArray],
    current_a: Sequence[FloatArray],
    curve_v: FloatArray,
    first: int = 1,
) -> WeakestCell | None:
    """Return the weakest cell; None where the logs do not compare capacities.

    Parameters
    ----------
    volts : sequence of array of shape (n, cells)
        Cell voltages of each stretch [V].
    soc_pct, current_a : sequence of array of shape (n,)
        SoC of the pack [%] and current [A].
    curve_v : array of shape (1301,)
        A cell's open-circuit voltage at `CURVE_PCT` [V].
    first : int
        Number of the first cell.
    """
    cells = np.concatenate(volts)
    S, amps = (np.concatenate(each) for each in (soc_pct, current_a))
    has = np.isfinite(cells).all(axis=1) & np.isfinite(S)
    if has.sum() < 4 or cells.shape[1] < 3 or np.ptp(S[has]) < LEAST_SPAN_PCT:
        return None
    cells, S, amps = cells[has], S[has], amps[has]
    rising_v = np.maximum.accumulate(curve_v) + 1e-9 * np.arange(curve_v.size)
    at_v = np.interp(S, CURVE_PCT, rising_v)
    slope = np.gradient(rising_v, CURVE_PCT)
    median = np.median(cells, axis=1, keepdims=True)
    theirs = np.interp(cells - median + at_v[:, None], rising_v, CURVE_PCT)
    lack = np.empty(cells.shape[1])
    for k in range(lack.size):  # a voltage says as much of a SoC as the curve is steep
        steep = np.interp(0.5 * (S + theirs[:, k]), CURVE_PCT, slope)
        steep[(theirs[:, k] < 0.0) | (theirs[:, k] > 100.0)] = 0.0  # beyond it nobody knows it
        X = np.column_stack([steep, steep * (S - 100.0) / 100.0, amps * (steep > 0.0)])
        a = np.linalg.lstsq(X, (theirs[:, k] - S) * steep, rcond=None)[0][1]
        lack[k] = 100.0 * a / (100.0 + a)
    lack = lack - np.median(lack)
    spread = max(LEAST_STD_PCT, MAD * float(np.median(np.abs(lack))))
    wide = np.hypot(spread, WEAK_STD_PCT)
    factors = 0.5 * lack**2 * (spread**-2 - wide**-2) - np.log(wide / spread)
    factors = np.where(lack > 0.0, factors + np.log(2.0), -np.inf)
    k = int(np.argmax(lack))
    gain = WEAK_STD_PCT**2 / (WEAK_STD_PCT**2 + spread**2)
    log_factor = float(np.logaddexp.reduce(factors) - np.log(lack.size))
    return WeakestCell(first + k, log_factor, gain * float(lack[k]), float(np.sqrt(gain)) * spread)

"""A weak cell, from the cell voltages beside the logs.

Each cell's SoC follows from the median cell's: S′ = U⁻¹(v − v_median + U(S)), U being the curve of
a cell and S the SoC of the pack; beyond a bend the curve is not its slope. A cell whose capacity
is smaller by w falls behind the others while the charge is drawn:

    S′ − S = a − w·(100 − S)/(100 − w) + r·I/U′

a (balance) and r (resistance) are free. The w of the other cells show how well w is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.special import expit, logit, logsumexp
from scipy.stats import median_abs_deviation, norm

from cangauge._typing import FloatArray
from cangauge.extras.judge.chain import Chain
from cangauge.extras.judge.faults import FAULTS
from cangauge.extras.judge.result import FoundFault
from cangauge.logs.log import Log
from cangauge.logs.read import CellColumns
from cangauge.model.curve import hermite_basis

LEAST_STD_PCT: Final = 1.0
"""Least spread of the capacities of healthy cells [%]: sorted cells of one batch."""


def weakest_cell(
    logs: Sequence[Log],
    cell_voltages: Sequence[CellColumns | None],
    chain: Chain,
    soc_pct: FloatArray,
) -> FoundFault | None:
    """Return the weakest cell; None where the logs do not compare capacities.

    Parameters
    ----------
    logs : sequence of Log
    cell_voltages : sequence of CellColumns
        Beside each log; None where it has none.
    chain : Chain
    soc_pct : array of shape (blocks,)
        SoC of the pack [%].
    """
    volts, socs, amps, first = [], [], [], 1
    for stretch in chain.stretches:
        beside = cell_voltages[stretch.log] if stretch.log < len(cell_voltages) else None
        if beside is not None:
            log, first = logs[stretch.log], beside.first
            rows = np.searchsorted(log.time_s, chain.blocks.time_s[stretch.blocks])
            volts.append(beside.voltage_v[rows])
            socs.append(soc_pct[stretch.blocks])
            amps.append(log.current_a[rows])
    if not volts:
        return None
    cells, S, current_a = map(np.concatenate, (volts, socs, amps))
    has = np.isfinite(cells).all(axis=1)
    cells, S, current_a = cells[has], S[has], current_a[has]
    # Over less of the SoC a balance looks like a capacity.
    if S.size < 4 or cells.shape[1] < 3 or np.ptp(S) < 10.0:
        return None
    lack = _lacks_pct(chain, cells, S, current_a)
    spread = max(LEAST_STD_PCT, float(median_abs_deviation(lack, scale="normal")))
    kind = FAULTS["weak_cell"]
    (prior_std,) = kind.stds
    wide = np.hypot(spread, prior_std)
    factors = norm.logpdf(lack, scale=wide) - norm.logpdf(lack, scale=spread)
    factors = np.where(lack > 0.0, factors + np.log(2.0), -np.inf)
    log_factor = logsumexp(factors) - np.log(lack.size)
    weakest = int(np.argmax(lack))
    gain = prior_std**2 / (prior_std**2 + spread**2)
    size = gain * float(lack[weakest])
    # A capacity is as well known as the slope of the curve over the SoC that was visited.
    visited_pct = np.array([S.min(), S.max()])
    knots_pct = np.array(chain.functions.soc_pct)
    of_functions = hermite_basis(visited_pct, knots_pct) @ chain.functions.value
    over_v = np.diff(chain.extended.model.pseudo_ocv(visited_pct))
    slope_std = float(np.linalg.norm(np.diff(of_functions, axis=0)) / over_v[0])
    std = float(np.hypot(np.sqrt(gain) * spread, slope_std * size))
    probability = float(expit(log_factor + logit(kind.probability)))
    return FoundFault("weak_cell", probability, size, std, cell=first + weakest)


def _lacks_pct(chain: Chain, cells: FloatArray, S: FloatArray, current_a: FloatArray) -> FloatArray:
    """Return the capacity that each cell lacks beside the median cell [%]."""
    curve_pct = np.linspace(-20.0, 110.0, 1301)
    curve_v = chain.extended.model.pseudo_ocv(curve_pct) / cells.shape[1]
    rising_v = np.maximum.accumulate(curve_v) + 1e-9 * np.arange(curve_v.size)
    slope = np.gradient(rising_v, curve_pct)
    apart_v = cells - np.median(cells, axis=1, keepdims=True)
    theirs = np.interp(apart_v + np.interp(S, curve_pct, rising_v)[:, None], rising_v, curve_pct)
    lack = np.empty(cells.shape[1])
    for k in range(lack.size):  # a voltage says as much of a SoC as the curve is steep
        steep = np.interp(0.5 * (S + theirs[:, k]), curve_pct, slope)
        steep[(theirs[:, k] < 0.0) | (theirs[:, k] > 100.0)] = 0.0  # beyond it nobody knows it
        X = np.column_stack([steep, steep * (S - 100.0) / 100.0, current_a * (steep > 0.0)])
        a = np.linalg.lstsq(X, (theirs[:, k] - S) * steep, rcond=None)[0][1]
        lack[k] = 100.0 * a / (100.0 + a)
    return lack - np.median(lack)

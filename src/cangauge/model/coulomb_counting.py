"""Coulomb counting by the trapezoidal rule, and the capacity of a pack from its logs.

C_i = C_{i−1} − (I_i + I_{i−1})·(t_i − t_{i−1})/2,      S = 100·C/C_t
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.log import Log

BRIDGE_S = 60.0
"""No charge is counted over a longer gap in the current [s]: the pack is assumed to rest."""

FULL_PCT, EMPTY_PCT = 98.0, 2.0
"""Reference SoC at the start (at least) and end (at most) of a log with the whole capacity [%]."""

KNEE_STEEPNESS = 5.0
"""Ratio of the voltage's slope over charge at the end of a log to that in its middle, from which a
log without reference SoC counts as discharged to empty."""


def discharged_ah(time_s: FloatArray, current_a: FloatArray) -> FloatArray:
    """Return the charge discharged since the first row [Ah], shape (n,), by the trapezoidal rule.

    Parameters
    ----------
    time_s, current_a : array of shape (n,)
        Time [s] and current [A], positive = discharge. Steps longer than `BRIDGE_S` count nothing.
    """
    step_s = np.diff(time_s)
    step_ah = np.where(step_s > BRIDGE_S, 0.0, (current_a[1:] + current_a[:-1]) * step_s / 7200.0)
    return np.concatenate(([0.0], np.cumsum(step_ah)))


def counted_soc_pct(log: Log, capacity_ah: float, initial_soc_pct: float | None) -> FloatArray:
    """Return the SoC counted from the log's current [%], shape (n,).

    Parameters
    ----------
    log : Log
    capacity_ah : float
        Charge from 100 to 0 % [Ah].
    initial_soc_pct : float, optional
        SoC at the first row [%]. By default the count starts from the first finite value of the
        log's reference SoC; a log without reference starts at 100 %.
    """
    out = discharged_ah(log.time_s, log.current_a)
    row, value = _start(log, initial_soc_pct)
    return np.asarray(value - 100.0 * (out - out[row]) / capacity_ah)


def _start(log: Log, initial_soc_pct: float | None) -> tuple[int, float]:
    """Return row and value of the SoC that counting starts from [%]; 100 % if it is unknown."""
    if initial_soc_pct is not None:
        return 0, initial_soc_pct
    return log.first_soc() or (0, 100.0)


def capacity_from_reference(logs: Sequence[Log]) -> float:
    """Return the charge per 100 % of reference SoC [Ah], by regression pooled over the logs.

    Raises
    ------
    InputError
        If no log has a reference SoC that moves by at least 1 %.
    """
    covariance = variance = 0.0
    for log in logs:
        if log.soc_pct is None:
            continue
        known = np.isfinite(log.soc_pct)
        if not known.any() or np.ptp(log.soc_pct[known]) < 1.0:
            continue
        soc = log.soc_pct[known]
        out = discharged_ah(log.time_s, log.current_a)[known]
        covariance += float(np.sum((soc - soc.mean()) * (out - out.mean())))
        variance += float(np.sum((soc - soc.mean()) ** 2))
    if variance == 0.0:
        raise InputError(
            "no log has a reference SoC that moves by 1 % or more",
            field="soc_pct",
            cure="give the capacity in Ah with --capacity-ah",
        )
    return -100.0 * covariance / variance


def capacity_from_full_discharge(logs: Sequence[Log], initial_soc_pct: float | None) -> float:
    """Return the capacity from the first log that runs from full to empty [Ah].

    Raises
    ------
    InputError
        If no log runs from full to empty.
    """
    for log in logs:
        capacity = _whole_capacity_ah(log, initial_soc_pct)
        if capacity is not None:
            return capacity
    raise InputError(
        f"unknown capacity: no log runs from full to empty ({FULL_PCT:.0f} % or more to"
        f" {EMPTY_PCT:.0f} % or less)",
        source=logs[0].source or logs[0].name,
        field="capacity_ah",
        cure="give --capacity-ah A, or --capacity-ah from-soc for the charge per 100 % of the logs'"
        " soc_pct",
    )


def _whole_capacity_ah(log: Log, initial_soc_pct: float | None) -> float | None:
    out = discharged_ah(log.time_s, log.current_a)
    first_row, first = _start(log, initial_soc_pct)
    if first < FULL_PCT:
        return None
    if log.soc_pct is not None and np.isfinite(log.soc_pct).sum() > 1:
        last_row = int(np.flatnonzero(np.isfinite(log.soc_pct))[-1])
        last = float(log.soc_pct[last_row])
        if last > EMPTY_PCT:
            return None
        return float(100.0 * (out[last_row] - out[first_row]) / (first - last))
    if not _ends_in_the_knee(log, out):
        return None
    return float(100.0 * (out[-1] - out[first_row]) / first)


def _ends_in_the_knee(log: Log, out_ah: FloatArray) -> bool:
    """Whether the voltage, less its drop over the resistance, falls steeply at the end."""
    total = float(out_ah[-1])
    running = log.voltage_v > 0.5 * np.median(log.voltage_v)
    if total <= 0.0 or running.sum() < 100:
        return False
    volts, current, out = log.voltage_v[running], log.current_a[running], out_ah[running]
    near_end = out > 0.98 * total
    middle = (out > 0.3 * total) & (out < 0.7 * total)
    if near_end.sum() < 10 or middle.sum() < 10:
        return False

    def fall_per_ah(rows: NDArray[np.bool_]) -> float:
        columns = np.column_stack([np.ones(rows.sum()), out[rows], current[rows]])
        return -float(np.linalg.lstsq(columns, volts[rows], rcond=None)[0][1])

    return fall_per_ah(near_end) > KNEE_STEEPNESS * max(fall_per_ah(middle), 0.0)

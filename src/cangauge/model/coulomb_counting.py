"""Coulomb counting by the trapezoidal rule, and the capacity of a pack from its logs.

C_i = C_{i−1} − (I_i + I_{i−1})·(t_i − t_{i−1})/2,      S = 100·C/C_t

`logs.gaps.discharged_ah` sums the charge C_0 − C_i.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cangauge._text import rounded
from cangauge._typing import BoolArray, FloatArray
from cangauge.errors import InputError
from cangauge.logs.charge import implied_capacity
from cangauge.logs.gaps import discharged_ah, split_where_moved
from cangauge.logs.log import Log

FULL_PCT, EMPTY_PCT = 95.0, 5.0
"""SoC at the start (at least) and end (at most) of a log from full to empty [%]."""

KNEE_STEEPNESS = 5.0
"""Ratio of the voltage's slope over charge at the end of a log to that in its middle, from which a
log without reference SoC counts as discharged to empty, …"""

EMPTY_VOLTAGE = 0.88
"""… and the largest ratio of its last voltage without current to its first. From full to empty a
cell falls to 0.80 of its voltage (layered oxides: 4.15 to 3.3 V at rest) or 0.87 (LFP: 3.35 to
2.9 V); over half of its charge to no less than 0.89 (4.15 to 3.7 V)."""

DIFFERENT_PCT = 1.0
"""Difference between a counted or stated SoC and the log's own from which it is reported [%]: the
resolution of a dashboard."""


def soc_at_first_row(log: Log, capacity_ah: float) -> float | None:
    """Return the log's first finite SoC, counted back to its first row [%]; None without one.

    Parameters
    ----------
    log : Log
    capacity_ah : float
        Charge from 100 to 0 % [Ah].
    """
    return None if log.first_soc() is None else float(counted_soc_pct(log, capacity_ah)[0])


def start_of(log: Log) -> tuple[int, float]:
    """Return index and value [%] of a log's first finite SoC; raise InputError without one."""
    start = log.first_soc()
    if start is None:
        raise InputError(
            "the SoC at the start is unknown: the log states none",
            source=log.source or log.name,
            field="soc_pct",
            cure="give --initial-soc P, the SoC at the first row (100 for a log from full)",
        )
    return start


def counted_soc_pct(log: Log, capacity_ah: float) -> FloatArray:
    """Return the SoC counted from the first finite value of the log's own [%], shape (n,).

    Parameters
    ----------
    log : Log
    capacity_ah : float
        Charge from 100 to 0 % [Ah].

    Raises
    ------
    InputError
        If the log states no SoC.
    """
    row, start_pct = start_of(log)
    out_ah = discharged_ah(log.time_s, log.current_a)
    return np.asarray(start_pct - 100.0 * (out_ah - out_ah[row]) / capacity_ah)


def difference_from_reference(log: Log, capacity_ah: float) -> str | None:
    """Return a phrase if counted charge and the log's own SoC disagree, or that is frozen; or None.

    Parameters
    ----------
    log : Log
    capacity_ah : float
        Capacity that the count uses [Ah].

    Returns
    -------
    str or None
        With the capacity that the log implies, unless its SoC is frozen. None where both changes
        agree within `DIFFERENT_PCT`, or the reference moves less than that without being frozen.
    """
    soc_pct, out_ah = _readings(log)
    if soc_pct.size < 2:
        return None
    moved_pct = float(np.ptp(soc_pct))
    counted_pct = 100.0 * float(np.ptp(out_ah)) / capacity_ah
    if moved_pct == 0.0 and counted_pct >= DIFFERENT_PCT:
        return (
            f"{log.name}: its own SoC stays at {soc_pct[0]:g} % while {counted_pct:.1f} % is"
            " counted: a column that is not updated; state the start with --initial-soc"
        )
    if moved_pct < DIFFERENT_PCT:
        return None
    try:
        implied_ah = implied_capacity([log], 0.0).capacity_ah
    except InputError:  # it only jumps
        return None
    if moved_pct * abs(implied_ah / capacity_ah - 1.0) < DIFFERENT_PCT:
        return None
    return (
        f"{log.name}: the counted charge and the log's own SoC imply a capacity of"
        f" {implied_ah:.1f} Ah; {capacity_ah:.1f} Ah is used."
        " Check the capacity and the current sensor"
    )


def capacity_from_reference(logs: Sequence[Log]) -> float:
    """Return the charge per 100 % of reference SoC [Ah]; see `logs.charge.implied_capacity`.

    Raises
    ------
    InputError
        If no log has a reference SoC that moves by at least 1 %.
    """
    return implied_capacity(logs, least_pct=1.0).capacity_ah


def _readings(log: Log) -> tuple[FloatArray, FloatArray]:
    """Return the log's own SoC [%] and the charge discharged [Ah] where it has one, shape (k,)."""
    soc_pct = np.full(len(log), np.nan) if log.soc_pct is None else log.soc_pct
    rows = np.isfinite(soc_pct)
    return soc_pct[rows], discharged_ah(log.time_s, log.current_a)[rows]


def capacity_from_full_discharge(logs: Sequence[Log], starts_pct: Sequence[float | None]) -> float:
    """Return the capacity from the first log that is proven to run from full to empty [Ah].

    Proof is the log's own SoC at both ends; or, for a log without, a stated start near full and a
    voltage that ends in the knee of an empty pack, at the voltage of one.

    Parameters
    ----------
    logs : sequence of Log
    starts_pct : sequence of float or None
        Stated SoC at the first row of each [%].

    Raises
    ------
    InputError
        If no log is.
    """
    for log, start_pct in zip(logs, starts_pct, strict=True):
        first, *others = split_where_moved(log)
        for piece, stated_pct in ((first, start_pct), *((other, None) for other in others)):
            capacity_ah = _whole_capacity_ah(piece, stated_pct)
            if capacity_ah is not None:
                return capacity_ah
    nearest = _nearest(logs)
    from_soc = ", or --capacity-ah from-soc for the charge per 100 % of the logs' soc_pct"
    raise InputError(
        f"unknown capacity: no log is proven to run from full to empty (its own SoC from"
        f" {FULL_PCT:.0f} % or more to {EMPTY_PCT:.0f} % or less; or --initial-soc of"
        f" {FULL_PCT:.0f} % or more, and a voltage that ends in the knee){nearest}",
        source=logs[0].source or logs[0].name,
        field="capacity_ah",
        cure=f"give --capacity-ah A{from_soc if nearest else ''}",
    )


def _nearest(logs: Sequence[Log]) -> str:
    """Return the log whose own SoC spans most, and the charge per 100 % that it implies."""
    socs = [_readings(log)[0] for log in logs]
    spans_pct = [float(np.ptp(soc)) if soc.size else 0.0 for soc in socs]
    place = int(np.argmax(spans_pct))
    log, soc = logs[place], socs[place]
    try:
        per_100_ah = rounded(abs(capacity_from_reference([log])), 4)
    except InputError:
        return ""
    ends = f"{soc.min():.1f} … {soc.max():.1f} %"
    return f"; nearest is {log.name}: {ends}, {per_100_ah} Ah per 100 %"


def _whole_capacity_ah(log: Log, stated_pct: float | None) -> float | None:
    """Return the charge per 100 % of a log from full to empty [Ah]; None if it is not one."""
    soc_pct, soc_ah = _readings(log)
    if stated_pct is not None:
        first_pct, first_ah = stated_pct, 0.0
    elif soc_pct.size:
        first_pct, first_ah = float(soc_pct[0]), float(soc_ah[0])
    else:
        return None
    if first_pct < FULL_PCT:
        return None
    if soc_pct.size > 1:
        last_pct, last_ah = soc_pct[-1], soc_ah[-1]
        if last_pct > EMPTY_PCT:
            return None
    else:
        out_ah = discharged_ah(log.time_s, log.current_a)
        last_pct, last_ah = 0.0, out_ah[-1]
        if not _ends_in_the_knee(log, out_ah):
            return None
    return float(100.0 * (last_ah - first_ah) / (first_pct - last_pct))


def _ends_in_the_knee(log: Log, out_ah: FloatArray) -> bool:
    """Whether the voltage, with the drop over the resistance added, falls steeply at the end."""
    total_ah = float(out_ah[-1])
    running = log.voltage_v > 0.5 * np.median(log.voltage_v)
    if total_ah <= 0.0 or running.sum() < 100:
        return False
    volts, current, part = log.voltage_v[running], log.current_a[running], out_ah[running]
    first, near_end = part < 0.02 * total_ah, part > 0.98 * total_ah
    middle = (part > 0.3 * total_ah) & (part < 0.7 * total_ah)
    if not first.any() or near_end.sum() < 10 or middle.sum() < 10:
        return False

    def slopes(rows: BoolArray) -> tuple[float, float]:
        """Return the fall of the voltage over charge [V/Ah] and over current [Ω]."""
        columns = np.column_stack([np.ones(rows.sum()), part[rows], current[rows]])
        _, by_ah, by_a = np.linalg.lstsq(columns, volts[rows], rcond=None)[0].tolist()
        return -by_ah, -by_a

    middle_v_per_ah, ohm = slopes(middle)
    rest_v = volts + max(ohm, 0.0) * current
    is_steep = slopes(near_end)[0] > KNEE_STEEPNESS * max(middle_v_per_ah, 0.0)
    falls_to = float(np.min(rest_v[near_end]) / np.median(rest_v[first]))
    return is_steep and falls_to <= EMPTY_VOLTAGE

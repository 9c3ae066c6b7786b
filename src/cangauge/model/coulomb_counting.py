"""Coulomb counting by the trapezoidal rule, and the capacity of a pack from its logs.

C_i = C_{i−1} − (I_i + I_{i−1})·(t_i − t_{i−1})/2,      S = 100·C/C_t
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cangauge._text import rounded
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.gaps import BRIDGE_S, discharged_ah, split_where_moved
from cangauge.logs.log import Log

__all__ = [
    "BRIDGE_S",
    "capacity_from_full_discharge",
    "capacity_from_reference",
    "counted_soc_pct",
    "difference_from_reference",
    "discharged_ah",
    "doubt_of_start",
]

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
"""Difference between the counted SoC and the log's own over the log from which it is reported [%]:
the resolution of a dashboard."""


def counted_soc_pct(log: Log, capacity_ah: float, initial_soc_pct: float | None) -> FloatArray:
    """Return the SoC counted from the log's current [%], shape (n,).

    Parameters
    ----------
    log : Log
    capacity_ah : float
        Charge from 100 to 0 % [Ah].
    initial_soc_pct : float, optional
        SoC at the first row [%]. By default the count starts from the first finite value of the
        log's reference SoC.

    Raises
    ------
    InputError
        If the SoC is known nowhere.
    """
    out = discharged_ah(log.time_s, log.current_a)
    start = _start(log, initial_soc_pct)
    if start is None:
        raise InputError(
            "the SoC at the start is unknown: the log states none",
            source=log.source or log.name,
            field="soc_pct",
            cure="give --initial-soc P, the SoC at the first row (100 for a log from full)",
        )
    row, value = start
    return np.asarray(value - 100.0 * (out - out[row]) / capacity_ah)


def _start(log: Log, initial_soc_pct: float | None) -> tuple[int, float] | None:
    """Return row and value of the SoC that counting starts from [%]; None if it is unknown."""
    return (0, initial_soc_pct) if initial_soc_pct is not None else log.first_soc()


def difference_from_reference(log: Log, capacity_ah: float) -> str | None:
    """Return how much the counted charge differs from the log's own SoC, in a phrase, or None.

    Parameters
    ----------
    log : Log
    capacity_ah : float
        Capacity that the count uses [Ah].

    Returns
    -------
    str or None
        Both changes and the capacity that the log implies; None where they agree within
        `DIFFERENT_PCT`, or the reference moves less than that without being frozen.
    """
    if log.soc_pct is None:
        return None
    known = np.flatnonzero(np.isfinite(log.soc_pct))
    if known.size < 2:
        return None
    # A start stated for the first row is no reading of the log's own.
    out = discharged_ah(log.time_s, log.current_a)[known]
    soc = log.soc_pct[known]
    counted_range = 100.0 * float(np.ptp(out)) / capacity_ah
    if np.ptp(soc) == 0.0 and counted_range >= DIFFERENT_PCT:
        return (
            f"{log.name}: its own SoC stays at {soc[0]:g} % while {counted_range:.1f} % is counted:"
            " a column that is not updated; state the start with --initial-soc"
        )
    ends = [int(np.argmax(soc)), int(np.argmin(soc))]
    own = float(soc[ends[0]] - soc[ends[1]])
    counted = float(100.0 * (out[ends[1]] - out[ends[0]]) / capacity_ah)
    if abs(counted - own) < DIFFERENT_PCT or own < DIFFERENT_PCT:
        return None
    implied = 100.0 * float(out[ends[1]] - out[ends[0]]) / own
    return (
        f"{log.name}: the counted charge and the log's own SoC imply a capacity of"
        f" {implied:.1f} Ah; {capacity_ah:.1f} Ah is used."
        " Check the capacity and the current sensor"
    )


def doubt_of_start(log: Log, given_pct: float, capacity_ah: float | None = None) -> str | None:
    """Return why a given SoC at the first row is doubtful, in a phrase, or None.

    Parameters
    ----------
    log : Log
    given_pct : float
        [%].
    capacity_ah : float, optional
        Counts the log's first SoC back to the first row [Ah].

    Returns
    -------
    str or None
        That it differs from the log's own SoC by `DIFFERENT_PCT` or more, or is a fraction.
    """
    doubts = []
    first = log.first_soc()
    if first is not None:
        row, own_pct = first
        if row and capacity_ah is not None:
            out_ah = discharged_ah(log.time_s[: row + 1], log.current_a[: row + 1])[-1]
            own_pct += 100.0 * float(out_ah) / capacity_ah
        if abs(own_pct - given_pct) >= DIFFERENT_PCT:
            doubts.append(f"its own SoC is {own_pct:.1f} %")
    if 0.0 < given_pct <= 1.0:
        doubts.append(f"a fraction is given in percent, as {100.0 * given_pct:g}")
    if not doubts:
        return None
    return f"{log.name}: the initial SoC is {given_pct:g} % as given; {', and '.join(doubts)}"


def capacity_from_reference(logs: Sequence[Log]) -> float:
    """Return the charge per 100 % of reference SoC [Ah], by regression pooled over the logs.

    Raises
    ------
    InputError
        If no log has a reference SoC that moves by at least 1 %.
    """
    covariance = variance = 0.0
    for log in [piece for whole in logs for piece in split_where_moved(whole)]:
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


def capacity_from_full_discharge(
    logs: Sequence[Log], initial_soc_pct: float | Sequence[float | None] | None
) -> float:
    """Return the capacity from the first log that is proven to run from full to empty [Ah].

    Proof is the log's own SoC at both ends; or, for a log without, a stated start near full and a
    voltage that ends in the knee of an empty pack, at the voltage of one.

    Parameters
    ----------
    logs : sequence of Log
    initial_soc_pct : float, sequence of float or None, optional
        Stated SoC at the first row, of all logs or of each [%].

    Raises
    ------
    InputError
        If no log is.
    """
    if initial_soc_pct is None or isinstance(initial_soc_pct, int | float):
        initial_soc_pct = [initial_soc_pct] * len(logs)
    for log, initial in zip(logs, initial_soc_pct, strict=True):
        for k, piece in enumerate(split_where_moved(log)):
            capacity = _whole_capacity_ah(piece, initial if k == 0 else None)
            if capacity is not None:
                return capacity
    raise InputError(
        f"unknown capacity: no log is proven to run from full to empty (its own SoC from"
        f" {FULL_PCT:.0f} % or more to {EMPTY_PCT:.0f} % or less; or --initial-soc of"
        f" {FULL_PCT:.0f} % or more, and a voltage that ends in the knee){_nearest(logs)}",
        source=logs[0].source or logs[0].name,
        field="capacity_ah",
        cure="give --capacity-ah A, or --capacity-ah from-soc for the charge per 100 % of the logs'"
        " soc_pct",
    )


def _nearest(logs: Sequence[Log]) -> str:
    """Return the log whose own SoC spans most, and the charge per 100 % that it implies."""
    found = [
        (float(np.nanmin(log.soc_pct)), float(np.nanmax(log.soc_pct)), log)
        for log in logs
        if log.soc_pct is not None and log.first_soc() is not None
    ]
    if not found:
        return ""
    low, high, log = max(found, key=lambda each: each[1] - each[0])
    try:
        per_100_ah = rounded(abs(capacity_from_reference([log])), 4)
    except InputError:
        return ""
    return f"; nearest is {log.name}: {low:.1f} … {high:.1f} %, {per_100_ah} Ah per 100 %"


def _whole_capacity_ah(log: Log, initial_soc_pct: float | None) -> float | None:
    start = _start(log, initial_soc_pct)
    if start is None or start[1] < FULL_PCT:
        return None
    out = discharged_ah(log.time_s, log.current_a)
    first_row, first = start
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

    first = out < 0.02 * total
    ohm = -float(np.linalg.lstsq(
        np.column_stack([np.ones(middle.sum()), out[middle], current[middle]]),
        volts[middle], rcond=None,
    )[0][2])  # fmt: skip
    rest = volts + max(ohm, 0.0) * current
    falls_to = float(np.min(rest[near_end]) / np.median(rest[first])) if first.any() else 1.0
    is_steep = fall_per_ah(near_end) > KNEE_STEEPNESS * max(fall_per_ah(middle), 0.0)
    return is_steep and falls_to <= EMPTY_VOLTAGE

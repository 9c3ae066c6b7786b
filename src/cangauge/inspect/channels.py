"""Channels of a log: range, quantization, stuck intervals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.logs.log import Log
from cangauge.logs.sign import STEP_SPACING_S, spaced_rows

STUCK_S: Final = 10.0
"""Shortest interval of one value that may be stuck [s], …"""
STUCK_ROWS: Final = 5
"""… its fewest rows, …"""
STUCK_JUMPS: Final = 3
"""… and the fewest jumps of the other channel within it."""
JUMP_LIMIT_S: Final = 5.0
"""Longest interval between rows for a jump [s]."""
END_S: Final = 2.0
"""Jumps this close to the ends of an interval do not count [s]."""
CURRENT_JUMP_SHARE: Final = 0.05
"""Smallest jump of current, of its range [-]."""
VOLTAGE_QUANTA: Final = 4.0
"""Smallest jump of voltage, in quanta; a jump of current must move the voltage by as much."""
VOLTAGE_SHARE: Final = 0.002
"""Smallest jump of voltage, relative to its median [-]."""

_FREQUENT: Final = (3, 6, 12, 50)
"""Numbers of most frequent values whose differences are candidates for the quantum."""
_MIN_PLACES: Final = 4
"""Fewest occupied places of a grid."""
_ON_PLACE: Final = 0.9
"""Least share of the rows on a grid that hold the main value of their place."""
_ON_GRID: Final = 0.95
"""Least share of the rows on a grid."""
_OFF_GRID: Final = 0.05
"""Largest distance from a place of the grid, in quanta."""


@dataclass(frozen=True, slots=True)
class Stuck:
    """An interval in which a channel kept one value while the other one jumped."""

    start_s: float
    duration_s: float
    value: float
    why: str


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel of a log; values in `unit`.

    `quantum` is the quantization step (None: there is none), `levels` the number of distinct
    values, `missing` the rows without one.
    """

    unit: str
    minimum: float
    maximum: float
    median: float
    quantum: float | None
    levels: int
    missing: int
    stuck: tuple[Stuck, ...] = ()


def describe_channels(log: Log, resistance_ohm: float | None) -> dict[str, Channel]:
    """Describe the channels of a log.

    With a resistance [Ω], current and voltage are searched for stuck intervals.
    """
    current, voltage = _described(log.current_a, "A"), _described(log.voltage_v, "V")
    if resistance_ohm:
        ohm = abs(resistance_ohm)
        visible_v = max(VOLTAGE_QUANTA * (voltage.quantum or 0.0), VOLTAGE_SHARE * voltage.median)
        range_a = current.maximum - current.minimum
        jump_a = max(visible_v / ohm, CURRENT_JUMP_SHARE * range_a)
        jump_v = max(visible_v, jump_a * ohm)
        stuck_v = _stuck(log, log.voltage_v, log.current_a, f"{jump_a:.3g} A", jump_a)
        stuck_a = _stuck(log, log.current_a, log.voltage_v, f"{jump_v:.3g} V", jump_v)
        voltage, current = replace(voltage, stuck=stuck_v), replace(current, stuck=stuck_a)
    channels = {"current_a": current, "voltage_v": voltage}
    channels["temperature_c"] = _described(log.temperature_c, "°C")
    if log.soc_pct is not None and np.isfinite(log.soc_pct).any():
        channels["soc_pct"] = _described(log.soc_pct, "%")
    return channels


def _described(values: FloatArray, unit: str) -> Channel:
    finite = values[np.isfinite(values)]
    low, high, median = float(finite.min()), float(finite.max()), float(np.median(finite))
    levels, missing = int(np.unique(finite).size), int(values.size - finite.size)
    return Channel(unit, low, high, median, quantum_of(finite), levels, missing)


def quantum_of(values: FloatArray) -> float | None:
    """Return the quantization step of finite values, shape (n,), or None if there is none.

    It is the largest step on whose grid (through the most frequent value) 95 % of the values lie,
    so that a few interpolated rows do not hide it. Candidates are differences between
    neighbouring values, of the frequent ones and of all.
    """
    distinct, count = np.unique(values, return_counts=True)
    if distinct.size < _MIN_PLACES:
        return None
    noise = 1e-9 * max(abs(float(distinct[0])), abs(float(distinct[-1])))
    by_count = distinct[np.argsort(-count, kind="stable")]
    groups = (*(by_count[:k] for k in _FREQUENT), distinct)
    steps = [np.quantile(np.diff(np.sort(each)), [0.0, 0.02, 0.1, 0.5]) for each in groups]
    for step in sorted({float(step) for each in steps for step in each}, reverse=True):
        if step <= noise:
            break
        offset = (distinct - by_count[0]) / step
        near = np.abs(offset - np.rint(offset)) < _OFF_GRID
        place, weight = np.rint(offset[near]), count[near]
        places, first = np.unique(place, return_index=True)
        if places.size < _MIN_PLACES or weight.sum() < _ON_GRID * values.size:
            continue
        # Several values at one place (64.98 and 65.00 on a grid of 65) mean a finer step.
        if np.maximum.reduceat(weight, first).sum() >= _ON_PLACE * weight.sum():
            from_origin = distinct[near] - by_count[0]
            fitted = np.sum(weight * place * from_origin) / np.sum(weight * place * place)
            return float(f"{fitted:.5g}")
    return None


def _stuck(
    log: Log, values: FloatArray, other: FloatArray, shown: str, jump: float
) -> tuple[Stuck, ...]:
    """Return the intervals in which a channel keeps one value while the other jumps.

    Jumps are changes from one second to the next; several in both directions are needed, since in
    a constant-current or constant-voltage phase the other channel drifts but does not jump.
    """
    rows = spaced_rows(log.time_s, STEP_SPACING_S)
    near = np.diff(log.time_s[rows]) <= JUMP_LIMIT_S
    change = np.where(near, np.diff(other[rows]), 0.0)
    time = log.time_s[rows[1:]]
    up, down = time[change > jump], time[change < -jump]
    edges = np.concatenate(([0], np.flatnonzero(np.diff(values)) + 1, [values.size]))
    found = []
    for first, last in zip(edges[:-1].tolist(), (edges[1:] - 1).tolist(), strict=True):
        start, end = float(log.time_s[first]), float(log.time_s[last])
        if end - start < STUCK_S or last - first + 1 < STUCK_ROWS:
            continue
        # A jump at either end bounds the interval; jumps in one direction are relaxation.
        ends = (start + END_S, end - END_S)
        ups, downs = (int(np.diff(np.searchsorted(jumps, ends))[0]) for jumps in (up, down))
        if ups and downs and ups + downs >= STUCK_JUMPS:
            why = f"the other channel jumped {ups + downs} times by more than {shown}"
            found.append(Stuck(start, end - start, float(values[first]), why))
    return tuple(found)

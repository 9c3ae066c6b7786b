"""Channels of a log: range, quantization, stuck intervals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from cangauge._typing import BoolArray, FloatArray
from cangauge.bus.plausibility import (
    LEAST_SWING,
    STUCK_AFTER_S,
    SWING_C_RATE,
    PackProperties,
    stuck_detectors,
)
from cangauge.logs.log import Log
from cangauge.logs.resolution import quantum_of

CURRENT_SHARE: Final = 0.05
"""Smallest swing of current that must move the voltage, of its range [-]."""
VOLTAGE_SHARE: Final = 0.002
"""Smallest swing of voltage that must move the current, relative to its median [-]."""


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel of a log; values in `unit`.

    `quantum` is the quantization step (None: there is none), `levels` the number of distinct
    values, `missing` the rows without one. `stuck` are the intervals in which the channel kept one
    value while the other one swung: start and length [s], value, and why.
    """

    unit: str
    minimum: float
    maximum: float
    median: float
    quantum: float | None
    levels: int
    missing: int
    stuck: tuple[dict[str, Any], ...] = ()


def describe_channels(log: Log, resistance_ohm: float | None) -> dict[str, Channel]:
    """Describe the channels of a log.

    With a resistance [Ω], current and voltage are searched for stuck intervals.
    """
    current, voltage = _described(log.current_a, "A"), _described(log.voltage_v, "V")
    if resistance_ohm:
        stuck_a, stuck_v = _stuck(log, current, voltage, abs(resistance_ohm))
        current, voltage = replace(current, stuck=stuck_a), replace(voltage, stuck=stuck_v)
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


def _stuck(
    log: Log, current: Channel, voltage: Channel, resistance_ohm: float
) -> tuple[tuple[dict[str, Any], ...], tuple[dict[str, Any], ...]]:
    """Return the stuck intervals of current and voltage, by the detectors of the service."""
    pack = PackProperties(
        resistance_ohm,
        error_std_v=VOLTAGE_SHARE * abs(voltage.median) / LEAST_SWING,
        capacity_ah=CURRENT_SHARE * (current.maximum - current.minimum) / SWING_C_RATE,
        usual_v=abs(voltage.median),
    )
    of_current, of_voltage = stuck_detectors(
        pack, (current.quantum or 0.0, STUCK_AFTER_S), (voltage.quantum or 0.0, STUCK_AFTER_S)
    )
    columns = (each.tolist() for each in (log.time_s, log.current_a, log.voltage_v))
    flags = [
        (of_current.update(current_a, time_s), of_voltage.update(voltage_v, time_s))
        for time_s, current_a, voltage_v in zip(*columns, strict=True)
    ]
    is_stuck_a, is_stuck_v = np.transpose(flags)
    why_a = f"the voltage swung several times by {of_voltage.swing:.3g} V or more"
    why_v = f"the current swung several times by {of_current.swing:.3g} A or more"
    return (
        _intervals(log.time_s, log.current_a, is_stuck_a, why_a),
        _intervals(log.time_s, log.voltage_v, is_stuck_v, why_v),
    )


def _intervals(
    time_s: FloatArray, values: FloatArray, is_stuck: BoolArray, why: str
) -> tuple[dict[str, Any], ...]:
    """Return the intervals of one value that have a row recognised as stuck."""
    first = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)
    last = np.append(first[1:], values.size) - 1
    hit = np.logical_or.reduceat(is_stuck, first)
    start_s, end_s, value = time_s[first[hit]], time_s[last[hit]], values[first[hit]]
    columns = start_s.tolist(), (end_s - start_s).tolist(), value.tolist()
    return tuple(
        {"start_s": begin, "duration_s": length, "value": kept, "why": why}
        for begin, length, kept in zip(*columns, strict=True)
    )

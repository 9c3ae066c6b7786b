"""Days of the published equation's pack, and faults of one size, that several tests diagnose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cangauge.logs.log import Log
from synthetic import synthetic_log

Fault = Callable[[Log, float], Log]


def day(seed: int) -> Log:
    """A healthy drive of 48 min from 85 to 60 %."""
    return synthetic_log(
        hours=0.8, start_pct=85.0, end_pct=60.0, noise_v=0.5, seed=seed, name=f"day {seed}"
    )


def late(log: Log, seconds: float) -> Log:
    """The current is recorded late."""
    return replace(log, current_a=np.interp(log.time_s - seconds, log.time_s, log.current_a))


def more_amperes(log: Log, amperes: float) -> Log:
    """The current reads too high; the log's SoC is counted with it."""
    start = log.first_soc()
    assert start is not None
    soc = np.full(len(log), np.nan)
    soc[0] = start[1]
    return replace(log, current_a=log.current_a + amperes, soc_pct=soc)


def more_volts(log: Log, volts: float) -> Log:
    return replace(log, voltage_v=log.voltage_v + volts)


def scaled_volts(log: Log, factor: float) -> Log:
    return replace(log, voltage_v=log.voltage_v * factor)


def more_resistance(log: Log, ohm: float) -> Log:
    return replace(log, voltage_v=log.voltage_v - ohm * log.current_a)


def resistance_step(log: Log, ohm: float) -> Log:
    """More resistance from 1400 s on."""
    return replace(log, voltage_v=log.voltage_v - ohm * log.current_a * (log.time_s > 1400.0))


def asymmetric(log: Log, ohm: float) -> Log:
    """More resistance while charging."""
    return replace(log, voltage_v=log.voltage_v - ohm * np.minimum(log.current_a, 0.0))


def wrong_start(log: Log, percent: float) -> Log:
    """The assumed SoC is too low."""
    assert log.soc_pct is not None
    return replace(log, soc_pct=log.soc_pct - percent)


def warmer(log: Log, kelvin: float) -> Log:
    """The thermometer reads too high."""
    return replace(log, temperature_c=log.temperature_c + kelvin)


FAULTS: dict[str, tuple[Fault, float]] = {
    "current_reading": (more_amperes, 6.0),
    "voltage_reading": (more_volts, 5.0),
    "clock": (late, 2.0),
    "resistance": (more_resistance, 0.08),
}
"""Fault → a change of more than two floors, and its size."""

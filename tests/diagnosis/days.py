"""Days of the published equation's pack, and faults, that several tests diagnose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cangauge.logs.log import Log
from synthetic import synthetic_log


def day(seed: int) -> Log:
    """A healthy drive of 48 min from 85 to 60 %."""
    return synthetic_log(
        hours=0.8, start_pct=85.0, end_pct=60.0, noise_v=0.5, seed=seed, name=f"day {seed}"
    )


def short_day(seed: int, noise_v: float = 0.5) -> Log:
    """A healthy drive of 36 min from 85 to 65 %."""
    return synthetic_log(
        hours=0.6, start_pct=85.0, end_pct=65.0, noise_v=noise_v, seed=seed, name=f"day {seed}"
    )


def late(log: Log, seconds: float = 1.0) -> Log:
    """The current arrives late."""
    return replace(log, current_a=np.interp(log.time_s - seconds, log.time_s, log.current_a))


def more_amperes(log: Log, amperes: float) -> Log:
    return replace(log, current_a=log.current_a + amperes)


def more_volts(log: Log, volts: float) -> Log:
    return replace(log, voltage_v=log.voltage_v + volts)


def more_resistance(log: Log, ohm: float) -> Log:
    return replace(log, voltage_v=log.voltage_v - ohm * log.current_a)


def resistance_step(log: Log, ohm: float = 0.05) -> Log:
    """More resistance from 1400 s on."""
    return replace(log, voltage_v=log.voltage_v - ohm * log.current_a * (log.time_s > 1400.0))


def asymmetric(log: Log, ohm: float = 0.06) -> Log:
    """More resistance while charging."""
    return replace(log, voltage_v=log.voltage_v - ohm * np.minimum(log.current_a, 0.0))

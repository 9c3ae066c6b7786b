"""Settings of the estimator, and the rules for an external SoC reference.

An external reference is a moment at which the SoC is known by other means than counting and the
filter: the end of a full charge, or a long rest. Both rules are off by default.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import get_args

from cangauge.errors import require_choice
from cangauge.estimation.state import EstimatorMemory
from cangauge.settings import (
    GAP_S,
    START_STD_PCT,
    VALID_STD_PCT,
    VOLTAGE_ACCURACY_PCT,
    CapacityAh,
    FullCharge,
    GapSeconds,
    LongRest,
    Method,
    PackLimits,
    StartPct,
    StartStdPct,
    TemperatureSource,
    ValidStdPct,
    VoltageAccuracyPct,
    check_settings,
)
from cangauge.types import Sample


@dataclass(frozen=True)
class EstimatorSettings:
    """Settings of an estimator.

    Parameters
    ----------
    method : {"ekf", "newton", "coulomb"}
        Method whose SoC is published.
    initial_soc_pct : float, optional
        SoC at the first sample [%]; by default found from the first voltages.
    initial_soc_std_pct : float
        Its standard deviation [%].
    valid_std_pct : float
        A SoC with a larger standard deviation is degraded [%].
    capacity_ah : float, optional
        Overrides the model's capacity [Ah].
    gap_s : float
        A longer step between samples is a gap in the current [s].
    temperature_source : str
        Where the input's temperature is measured.
    voltage_accuracy_pct : float
        Standard deviation of the voltage sensor's lasting error [% of the voltage].
    full_charge : FullCharge, optional
    long_rest : LongRest, optional
        Rules for an external SoC reference; None is off.
    limits : PackLimits
        Limits for the possible currents and the energy left.

    Raises
    ------
    InputError
        If a value is out of range.
    """

    method: Method = "ekf"
    initial_soc_pct: StartPct | None = None
    initial_soc_std_pct: StartStdPct = START_STD_PCT
    valid_std_pct: ValidStdPct = VALID_STD_PCT
    capacity_ah: CapacityAh | None = None
    gap_s: GapSeconds = GAP_S
    temperature_source: TemperatureSource = "unknown"
    voltage_accuracy_pct: VoltageAccuracyPct = VOLTAGE_ACCURACY_PCT
    full_charge: FullCharge | None = None
    long_rest: LongRest | None = None
    limits: PackLimits = field(default_factory=PackLimits)

    def __post_init__(self) -> None:
        require_choice(self.method, get_args(Method), "method")
        check_settings(self)


def detect_references(
    settings: EstimatorSettings, memory: EstimatorMemory, sample: Sample
) -> list[tuple[float, float]]:
    """Return SoC and deviation [%] of the references that a row establishes.

    A reference is given once each time that its rule becomes true.

    Parameters
    ----------
    settings : EstimatorSettings
    memory : EstimatorMemory
        Of the estimator; the state of the rules in it is updated.
    sample : Sample
        Its voltage may be NaN.
    """
    found, full, rest = [], settings.full_charge, settings.long_rest
    if full is not None and not math.isnan(sample.voltage_v):  # a missing voltage proves nothing
        is_high = sample.voltage_v >= full.voltage_v and abs(sample.current_a) <= full.current_a
        memory.full_since_s = since(memory.full_since_s, is_high, sample.time_s)
        was, memory.is_full = memory.is_full, sample.time_s - memory.full_since_s >= full.hold_s
        if memory.is_full and not was:
            found.append((full.soc_pct, full.soc_std_pct))
    if rest is not None and not math.isnan(memory.newton_pct):
        was = memory.is_rested
        memory.is_rested = sample.time_s - memory.rest_since_s >= rest.after_s
        if memory.is_rested and not was:
            found.append((memory.newton_pct, rest.soc_std_pct))
    return found


def since(start_s: float, holds: bool, now_s: float) -> float:
    """Return since when a condition has held [s], given the time so far; NaN: it does not."""
    if not holds:
        return math.nan
    return now_s if math.isnan(start_s) else start_s

"""Settings of the estimator."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import get_args

from cangauge.errors import require_choice
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

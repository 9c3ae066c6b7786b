"""Settings of the estimator, and the rules for an external SoC reference.

An external reference is a moment at which the SoC is known by other means than counting and the
filter: the end of a full charge, or a long rest. Both rules are off by default.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, get_args

from cangauge.errors import InputError, require_choice, require_number
from cangauge.estimation.power import PackLimits
from cangauge.estimation.state import EstimatorMemory
from cangauge.logs.log import TemperatureSource
from cangauge.model.delay_line import GAP_S
from cangauge.types import Sample

Method = Literal["ekf", "newton", "coulomb"]

VALID_STD_PCT = 3.0
"""Largest standard deviation of a valid SoC [%]: 19 of 20 such SoC lie within 6 %.

With the start withheld the filter settles at 2.4–3 % in a trip of half an hour. The error of the
log's voltage level limits it. A lower limit would make most such trips degraded. A higher one would
accept a SoC found from the voltage in the first minutes.
"""


@dataclass(frozen=True)
class FullCharge:
    """Rule: the pack is full once the voltage is high and the charging current has tapered off.

    Parameters
    ----------
    voltage_v : float
        Lowest voltage [V].
    current_a : float
        Largest absolute current [A].
    hold_s : float
        How long both must hold [s].
    soc_pct, soc_std_pct : float
        The SoC then, and its standard deviation [%].

    Raises
    ------
    InputError
        If a value is out of range.
    """

    voltage_v: float
    current_a: float
    hold_s: float = 60.0
    soc_pct: float = 100.0
    soc_std_pct: float = 0.5

    def __post_init__(self) -> None:
        _check_range("full_charge.voltage_v", self.voltage_v, 0.1, 1e4)
        _check_range("full_charge.current_a", self.current_a, 0.0, 5e3)
        _check_range("full_charge.hold_s", self.hold_s, 0.0, 86400.0)
        _check_range("full_charge.soc_pct", self.soc_pct, 0.0, 100.0)
        _check_range("full_charge.soc_std_pct", self.soc_std_pct, 0.01, 100.0)


@dataclass(frozen=True)
class LongRest:
    """Rule: after a long rest the voltage is the open-circuit voltage, and its inverse the SoC.

    Parameters
    ----------
    after_s : float
        Time at rest [s].
    soc_std_pct : float
        Standard deviation of that SoC [%].

    Raises
    ------
    InputError
        If a value is out of range.
    """

    after_s: float = 7200.0
    soc_std_pct: float = 2.0

    def __post_init__(self) -> None:
        _check_range("long_rest.after_s", self.after_s, 60.0, 30.0 * 86400.0)
        _check_range("long_rest.soc_std_pct", self.soc_std_pct, 0.01, 100.0)


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
    initial_soc_pct: float | None = None
    initial_soc_std_pct: float = 1.0
    valid_std_pct: float = VALID_STD_PCT
    capacity_ah: float | None = None
    gap_s: float = GAP_S
    temperature_source: TemperatureSource = "unknown"
    full_charge: FullCharge | None = None
    long_rest: LongRest | None = None
    limits: PackLimits = field(default_factory=PackLimits)

    def __post_init__(self) -> None:
        require_choice(self.method, get_args(Method), "method")
        for name, low, high in (
            ("initial_soc_pct", 0.0, 100.0),
            ("initial_soc_std_pct", 0.0, 100.0),
            ("valid_std_pct", 0.01, 100.0),
            ("capacity_ah", 1e-3, 1e5),
            ("gap_s", 1e-3, 3600.0),
        ):
            value = getattr(self, name)
            if value is not None:
                _check_range(name, value, low, high)


class SocReference(NamedTuple):
    """An external SoC reference and its standard deviation [%]."""

    soc_pct: float
    soc_std_pct: float


def detect_references(
    settings: EstimatorSettings, memory: EstimatorMemory, sample: Sample
) -> list[SocReference]:
    """Return the references that a row establishes, once each time that a rule becomes true.

    Parameters
    ----------
    settings : EstimatorSettings
    memory : EstimatorMemory
        Of the estimator; the state of the rules in it is updated.
    sample : Sample
        Its voltage may be NaN.
    """
    found = []
    full, rest = settings.full_charge, settings.long_rest
    if full is not None and not math.isnan(sample.voltage_v):  # a missing voltage proves nothing
        if sample.voltage_v < full.voltage_v or abs(sample.current_a) > full.current_a:
            memory.full_since_s = math.nan
        elif math.isnan(memory.full_since_s):
            memory.full_since_s = sample.time_s
        was, memory.is_full = memory.is_full, sample.time_s - memory.full_since_s >= full.hold_s
        if memory.is_full and not was:
            found.append(SocReference(full.soc_pct, full.soc_std_pct))
    if rest is not None and not math.isnan(memory.newton_pct):
        was = memory.is_rested
        memory.is_rested = sample.time_s - memory.rest_since_s >= rest.after_s
        if memory.is_rested and not was:
            found.append(SocReference(memory.newton_pct, rest.soc_std_pct))
    return found


def _check_range(field: str, value: float, low: float, high: float) -> None:
    require_number(value, field)
    if not low <= value <= high:
        raise InputError(f"must lie within {low:g} … {high:g}", field=field, value=value)

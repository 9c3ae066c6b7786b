"""When an estimate is not plainly valid, and why."""

from __future__ import annotations

import math

from cangauge.estimate.types import Reason, Sample, Status
from cangauge.logs.log import TemperatureSource
from cangauge.model.voltage_model import VoltageModel

CURRENT_AT_MOST_A = 5000.0
TEMPERATURE_WITHIN_C = (-60.0, 120.0)
VOLTAGE_WITHIN = (0.5, 1.5)
"""Beyond these no current, temperature or voltage (relative to half charge) is believed."""

_NO_REASON = Reason.NONE  # of every sample; members of an enum are slow to look up

SOC_MARGIN_PCT = 1.0
TEMPERATURE_MARGIN_K = 1.0
CURRENT_MARGIN = 1.1
"""How far outside the identified range is still called inside."""

OUTSIDE_SLOPE_ERROR = 0.5
"""Outside the identified SoC the straight line's slope is uncertain by this much, relative."""

OUTSIDE_TEMPERATURE_V_PER_K = 1e-3
"""Outside the identified temperatures the voltage is uncertain by this much per K, relative to
the pack's voltage (0.36 V/K for a Leaf)."""


def acceptable(sample: Sample) -> bool:
    """Whether a sample can be counted: finite time, and a current that a pack can carry."""
    return math.isfinite(sample.time_s) and abs(sample.current_a) <= CURRENT_AT_MOST_A


def cleaned(sample: Sample, usual_v: float) -> tuple[Sample, Reason]:
    """Return the sample with what cannot be true taken out (NaN), and the reason.

    Parameters
    ----------
    sample : Sample
    usual_v : float
        Voltage of the pack at half charge [V]; a contactor that is open shows next to nothing.
    """
    reason = _NO_REASON
    low, high = VOLTAGE_WITHIN[0] * usual_v, VOLTAGE_WITHIN[1] * usual_v
    if not math.isnan(sample.voltage_v) and not low <= sample.voltage_v <= high:
        sample = sample._replace(voltage_v=math.nan)
        reason = Reason.IMPLAUSIBLE_INPUT
    low, high = TEMPERATURE_WITHIN_C
    if not math.isnan(sample.temperature_c) and not low <= sample.temperature_c <= high:
        sample = sample._replace(temperature_c=math.nan)
        reason = Reason.IMPLAUSIBLE_INPUT
    return sample, reason


def outside_model(model: VoltageModel, soc_pct: float, sample: Sample) -> Reason:
    """Return which of SoC, temperature and current the model was not identified on."""
    reasons = Reason.NONE
    low, high = model.soc_range_pct
    if soc_pct < low - SOC_MARGIN_PCT or soc_pct > high + SOC_MARGIN_PCT:
        reasons |= Reason.SOC_OUTSIDE_MODEL
    low, high = model.temperature_range_c
    cold, hot = low - TEMPERATURE_MARGIN_K, high + TEMPERATURE_MARGIN_K
    if sample.temperature_c < cold or sample.temperature_c > hot:
        reasons |= Reason.TEMPERATURE_OUTSIDE_MODEL
    low, high = model.current_range_a
    if sample.current_a < CURRENT_MARGIN * low or sample.current_a > CURRENT_MARGIN * high:
        reasons |= Reason.CURRENT_OUTSIDE_MODEL
    return reasons


def outside_model_std_v(model: VoltageModel, soc_pct: float, temperature_c: float) -> float:
    """Return how uncertain the voltage becomes outside what the model was identified on [V]."""
    low, high = model.soc_range_pct
    beyond_pct = max(low - soc_pct, soc_pct - high, 0.0) if math.isfinite(soc_pct) else 0.0
    low, high = model.temperature_range_c
    beyond_k = 0.0
    if math.isfinite(temperature_c):
        beyond_k = max(low - temperature_c, temperature_c - high, 0.0)
    if beyond_pct == 0.0 and beyond_k == 0.0:
        return 0.0
    volts, slope = model.pseudo_ocv_at(soc_pct if math.isfinite(soc_pct) else 50.0)
    return math.hypot(
        OUTSIDE_SLOPE_ERROR * slope * beyond_pct, OUTSIDE_TEMPERATURE_V_PER_K * volts * beyond_k
    )


def temperature_mismatch(of_model: TemperatureSource, of_input: TemperatureSource) -> Reason:
    """Return the mismatch's reason if both are known and differ."""
    if "unknown" in {of_model, of_input} or of_model == of_input:
        return Reason.NONE
    return Reason.TEMPERATURE_SOURCE_MISMATCH


def status_of(reasons: Reason) -> Status:
    """Return the status that the reasons amount to."""
    if not reasons:
        return Status.VALID
    if reasons & Reason.NO_INITIAL_SOC:
        return Status.INITIALISING
    if reasons & (Reason.INPUT_STALE | Reason.CURRENT_MISSING):
        return Status.INVALID
    return Status.DEGRADED

"""What goes into the estimator and what comes out of it.

When an estimate is not plainly valid, and why.
"""

from __future__ import annotations

import enum
import math
from typing import Final, NamedTuple

from cangauge.logs.log import TemperatureSource
from cangauge.model.voltage_model import VoltageModel

# --- What goes into the estimator and what comes out of it


class Sample(NamedTuple):
    """One (time, current, voltage, temperature), paired on bus time.

    `voltage_v` or `temperature_c` may be NaN where that signal is missing: charge is still
    counted, and the status says so.
    """

    time_s: float
    """Bus time [s]."""
    current_a: float
    """Pack current [A], positive = discharge."""
    voltage_v: float
    """Pack voltage [V]."""
    temperature_c: float
    """Temperature [°C]."""


class Status(enum.IntEnum):
    """How far an estimate can be trusted; the numbers are those of the published frame."""

    INITIALISING = 0
    VALID = 1
    DEGRADED = 2
    INVALID = 3


class Reason(enum.IntFlag):
    """Why the status is not plainly valid; bit numbers are those of the published frame."""

    NONE = 0
    DELAY_LINE_FILLING = 1 << 0
    """Less than the longest delay of gap-free current has been seen."""
    CURRENT_GAP = 1 << 1
    """Current was missing for longer than the allowed gap: charge is uncertain."""
    VOLTAGE_MISSING = 1 << 2
    TEMPERATURE_MISSING = 1 << 3
    VOLTAGE_OUTSIDE_MODEL = 1 << 4
    """Newton: the voltage lies outside the model's range; SoC is clipped."""
    SOC_OUTSIDE_MODEL = 1 << 5
    """SoC lies outside what the model was identified on: extrapolated, bounded."""
    TEMPERATURE_OUTSIDE_MODEL = 1 << 6
    CURRENT_OUTSIDE_MODEL = 1 << 7
    TEMPERATURE_SOURCE_MISMATCH = 1 << 8
    """The bus's temperature is not measured where the model's was."""
    INNOVATION_LARGE = 1 << 9
    """Voltage and prediction disagree persistently: the uncertainty was inflated, or the filter,
    to which every voltage was an outlier for minutes, was started anew."""
    NO_INITIAL_SOC = 1 << 10
    """No initial SoC is known yet."""
    INPUT_STALE = 1 << 11
    """No wanted frame within the time-out."""
    IMPLAUSIBLE_INPUT = 1 << 12
    """A value or sample was refused: not finite, out of its range, or changed too fast."""
    PROTECTION_FAILED = 1 << 13
    """Frames were refused, several in a row: CRC wrong, counter standing still, or too short."""
    SIGNAL_STUCK = 1 << 14
    """A signal stands still while another one proves that it should move."""
    CURRENT_MISSING = 1 << 15
    """No current within its time-out, or none that is believed: charge is not counted."""
    SOC_UNCERTAIN = 1 << 16
    """The standard deviation is larger than a valid SoC may have."""


REASON_WORDS: Final = {
    Reason.DELAY_LINE_FILLING: "less current has been seen than the model's longest delay needs",
    Reason.CURRENT_GAP: "current was missing for too long: charge is uncertain",
    Reason.VOLTAGE_MISSING: "the sample has no voltage",
    Reason.TEMPERATURE_MISSING: "the sample has no temperature",
    Reason.VOLTAGE_OUTSIDE_MODEL: "no SoC of 0–100 % gives this voltage: the inverse is clipped",
    Reason.SOC_OUTSIDE_MODEL: "the model was not identified at this SoC: it is extrapolated",
    Reason.TEMPERATURE_OUTSIDE_MODEL: "the model was not identified at this temperature",
    Reason.CURRENT_OUTSIDE_MODEL: "the model was not identified at this current",
    Reason.TEMPERATURE_SOURCE_MISMATCH: "the temperature is not measured where the model's was",
    Reason.INNOVATION_LARGE: "voltage and prediction disagree lastingly: σ was enlarged",
    Reason.NO_INITIAL_SOC: "no SoC is known yet",
    Reason.INPUT_STALE: "no wanted frame within the time-out",
    Reason.IMPLAUSIBLE_INPUT: "a value was refused: out of its range, or it changed too fast",
    Reason.PROTECTION_FAILED: "frames were refused: CRC wrong, counter still, or too short",
    Reason.SIGNAL_STUCK: "a signal stands still while another one proves that it should move",
    Reason.CURRENT_MISSING: "no current that is believed: charge is not counted",
    Reason.SOC_UNCERTAIN: "the standard deviation is larger than a valid SoC may have",
}
"""What each reason means, for pages and messages."""


def reason_name(reason: Reason) -> str:
    """Return the name of one reason in words, such as "delay line filling"."""
    return (reason.name or "").lower().replace("_", " ")


def reason_names(reasons: int) -> str:
    """Return all reasons that are set, in words, parted by "; "."""
    return "; ".join(reason_name(reason) for reason in Reason if reasons & reason)


class Estimate(NamedTuple):
    """The estimate after one sample."""

    time_s: float
    """Bus time of the sample [s]."""
    soc_pct: float
    """State of charge of the chosen method [%], within 0–100; NaN while unknown."""
    soc_std_pct: float
    """Its standard deviation [%]; NaN while unknown."""
    soc_newton_pct: float
    """State of charge by inverse of the voltage model [%]; NaN while unknown."""
    soc_coulomb_pct: float
    """State of charge by Coulomb counting alone [%]; NaN while unknown."""
    voltage_model_v: float
    """Voltage that the model predicts at `soc_pct` [V]; NaN while unknown."""
    residual_v: float
    """Measured minus predicted voltage [V]; NaN while unknown."""
    status: Status
    reasons: Reason
    samples: int
    """Samples processed so far."""


# --- When an estimate is not plainly valid, and why

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

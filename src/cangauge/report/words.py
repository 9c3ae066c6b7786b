"""Numbers and states in words, the same in every report and table."""

from __future__ import annotations

import math
from typing import Final

from cangauge.estimate.types import Reason

NONE_KNOWN: Final = "–"

LONGEST_WHOLE: Final = 1e6
"""Larger numbers are written with a power of ten."""

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


def number(value: float | None, digits: int = 3, unit: str = "") -> str:
    """Return a number with fixed digits and its unit, or a dash where it is not known."""
    if value is None or not math.isfinite(value):
        return NONE_KNOWN
    text = f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "−")
    return f"{text} {unit}" if unit else text


def significant(value: float | None, digits: int = 4, unit: str = "") -> str:
    """Return a number with so many significant digits, or a dash where it is not known."""
    if value is None or not math.isfinite(value):
        return NONE_KNOWN
    text = f"{value:#.{digits}g}".rstrip(".")
    if "e+" in text and abs(value) < LONGEST_WHOLE:
        text = f"{float(text):.0f}"
    text = text.replace("-", "−")
    return f"{text} {unit}" if unit else text


def span(low: float, high: float, digits: int = 1, unit: str = "") -> str:
    """Return a range, such as "20.0 … 26.0 °C"."""
    return f"{number(low, digits)} … {number(high, digits)} {unit}".rstrip()


def duration(seconds: float) -> str:
    """Return a time span in the unit that suits it."""
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.1f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.2f} h"


def reason_name(reason: Reason) -> str:
    """Return the name of one reason in words, such as "delay line filling"."""
    return (reason.name or "").lower().replace("_", " ")


def reason_names(reasons: int) -> str:
    """Return all reasons that are set, in words, parted by "; "."""
    return "; ".join(reason_name(reason) for reason in Reason if reasons & reason)

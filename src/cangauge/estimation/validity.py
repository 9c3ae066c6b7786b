"""Implausible samples, and temperatures of another place than the model's."""

from __future__ import annotations

import math
from typing import Final

from cangauge.settings import TemperatureSource
from cangauge.types import TEMPERATURE_WITHIN_C, VOLTAGE_WITHIN, Reason, Sample

_NO_REASON: Final = Reason.NONE  # used for every sample; looking up an enum member is slow


def drop_implausible(sample: Sample, nominal_v: float) -> tuple[Sample, Reason]:
    """Return the sample with an implausible voltage or temperature replaced by NaN, and why.

    `nominal_v` is the pack's voltage at half charge [V]; behind open contactors it is close to 0.
    """
    reason = _NO_REASON
    low, high = VOLTAGE_WITHIN
    for name, least, most in (
        ("voltage_v", low * nominal_v, high * nominal_v),
        ("temperature_c", *TEMPERATURE_WITHIN_C),
    ):
        value = getattr(sample, name)
        if value < least or value > most:  # false for NaN
            sample = sample._replace(**{name: math.nan})
            reason = Reason.IMPLAUSIBLE_INPUT
    return sample, reason


def temperature_mismatch(of_model: TemperatureSource, of_input: TemperatureSource) -> Reason:
    """Return the reason for a mismatch if both sources are known and differ."""
    if "unknown" in {of_model, of_input} or of_model == of_input:
        return Reason.NONE
    return Reason.TEMPERATURE_SOURCE_MISMATCH

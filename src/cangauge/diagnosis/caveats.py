"""What logs cannot show, whatever the evidence says: too short, too narrow, nothing to compare.

Each limit is a sentence: what the logs are like, and what can therefore not be concluded.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cangauge.diagnosis.problem import COVERED_K, COVERED_PCT
from cangauge.inference.rows import SampledLog
from cangauge.logs.log import TemperatureSource
from cangauge.model.charge import BRIDGE_S

SHORT_S = 600.0
"""In a shorter log little builds up [s]."""

ONE_TEMPERATURE_K, ONE_SOC_PCT = 3.0, 10.0
"""Logs within less than this show nothing of temperature, or of SoC [K, %]."""

REST_C_RATE, REST_PART = 0.02, 0.005
"""Charging or resting for less than this part of the rows counts as never; a current below this
is rest [1/h]."""

STEPS_PART = 0.5
"""Half a step of the reported temperature that makes less than this part of the floor is little."""

MISSED_PART, ODD_TIMES, STATED_TIMES = 0.005, 3.0, 5.0
"""A reference is missed by more than this part of the voltage, and by so many times what the others
are, or what the model file states."""

FEW_REFERENCES = 3
"""Fewer tell hardly how much logs differ without a cause."""


def limits(
    logs: Sequence[SampledLog],
    references: Sequence[SampledLog],
    capacity_ah: float,
    initial_soc_pct: float | None = None,
    temperature_source: TemperatureSource = "unknown",
) -> list[str]:
    """Return what these logs cannot show and why; nothing for logs without such limits.

    Parameters
    ----------
    logs : sequence of SampledLog
        Diagnosed logs.
    references : sequence of SampledLog
    capacity_ah : float
        Of the model [Ah].
    initial_soc_pct : float, optional
        SoC at each diagnosed log's first row, if it was given [%].
    temperature_source : str
        What the model's temperature was measured on.
    """
    found = [
        _duration(logs),
        _temperature(logs, references),
        _soc(logs, references),
        _pauses(logs),
        _source([*logs, *references], temperature_source),
        _start(logs, initial_soc_pct),
        _reference_start(references),
        _charging(logs, capacity_ah),
        _reference_number(len(references)),
    ]
    return [sentence for sentence in found if sentence]


def stepped_temperature(step_k: float, kt_v_per_k: float, floor_v: float) -> str:
    """Return what a temperature that is reported in steps leaves open; "" if it is little.

    Parameters
    ----------
    step_k : float
        Of the reports [K].
    kt_v_per_k : float
        By how much the model's voltage follows the temperature [V/K].
    floor_v : float
        The model's error without a cause [V].
    """
    half_v = 0.5 * step_k * abs(kt_v_per_k)
    if half_v < STEPS_PART * floor_v:
        return ""
    return (
        f"The temperature is reported in steps of {step_k:g} K, and the model's voltage follows it"
        f" by {1e3 * kt_v_per_k:.0f} mV/K: up to {half_v:.2f} V for as long as a report stands. It"
        " is read between the steps here, as far as they tell; a service cannot look ahead, and its"
        " voltage model errs by so much. A temperature with a finer step shows smaller causes."
    )


def reference_fit(misses: Sequence[tuple[str, float]], stated_v: float, voltage_v: float) -> str:
    """Return what references mean that the model does not fit; "" where it does.

    Parameters
    ----------
    misses : sequence of (str, float)
        Each reference's name, and the given model's RMS error on it [V].
    stated_v : float
        What the model file states of itself [V].
    voltage_v : float
        The pack's usual voltage [V].
    """
    if not misses:
        return ""
    *others, (name, worst_v) = sorted(misses, key=lambda miss: miss[1])
    others_v = float(np.median([volts for _, volts in others])) if others else worst_v
    part = worst_v / voltage_v
    if part > MISSED_PART and worst_v > ODD_TIMES * others_v:
        return (
            f"The model misses the reference {name} by {worst_v:.1f} V"
            f" ({100.0 * part:.0f} % of the voltage), the others by {others_v:.2f} V: is"
            " it a log of this pack, with the right SoC at its start? What is learned from it can"
            " hide a cause."
        )
    usual = float(np.median([volts for _, volts in misses]))
    if usual > MISSED_PART * voltage_v and usual > STATED_TIMES * stated_v:
        return (
            f"The model misses its references by {usual:.2f} V where its file states"
            f" {stated_v:.2f} V. If the capacity, the SoC at their start or the pack is wrong, a"
            " cause can hide behind that."
        )
    return ""


def worse_with(baseline_v: float, extended_v: float) -> str:
    """Return that an extended model is no better on rows left out [V]; "" where it is."""
    if extended_v <= baseline_v:
        return ""
    return (
        f"On rows left out the extended model errs by {extended_v:.2f} V, the given one by"
        f" {baseline_v:.2f} V: do not run it. The cause may be the right one; its size is not."
    )


def _pauses(logs: Sequence[SampledLog]) -> str:
    found = []
    for item in logs:
        time_s = item.log.time_s
        steps = np.diff(time_s)
        at = int(np.argmax(steps))
        if steps[at] > BRIDGE_S:
            after_h = (time_s[at] - time_s[0]) / 3600.0
            found.append(f"{item.log.name} ({steps[at] / 60.0:.0f} min, {after_h:.1f} h in)")
    if not found:
        return ""
    return (
        f"Nothing was recorded for a while: {', '.join(found)}. The pack is taken to have rested;"
        " charge that moved meanwhile looks like initial_soc, capacity or an error of the voltage,"
        " and none of these can be concluded. Give the parts as logs of their own, each with its"
        " SoC."
    )


def _duration(logs: Sequence[SampledLog]) -> str:
    short = [item.log for item in logs if item.log.duration_s < SHORT_S]
    if not short:
        return ""
    lasting = ", ".join(f"{log.name} ({log.duration_s / 60.0:.1f} min)" for log in short)
    return (
        f"Shorter than {SHORT_S / 60.0:.0f} min: {lasting}. What builds up over minutes to hours"
        " (slow_diffusion, core_temperature, hysteresis, a drift of the count by current_offset,"
        " current_gain, capacity or coulombic_efficiency) can be neither named nor ruled out"
        " there, because it has hardly begun to show."
    )


def _temperature(logs: Sequence[SampledLog], references: Sequence[SampledLog]) -> str:
    low, high = _range([item.rows.temperature_c for item in logs])
    sentences = []
    if high - low < ONE_TEMPERATURE_K:
        sentences.append(
            f"One temperature ({low:.1f} … {high:.1f} °C): how the gap changes with temperature"
            " cannot be concluded from these logs alone, so resistance_temperature,"
            " entropic_coefficient and temperature_lag look like any change of the resistance or"
            " of the OCV."
        )
    if references:
        known = _range([item.rows.temperature_c for item in references])
        if low < known[0] - COVERED_K or high > known[1] + COVERED_K:
            sentences.append(
                f"Temperatures of {low:.1f} … {high:.1f} °C where the references have"
                f" {known[0]:.1f} … {known[1]:.1f} °C: what the temperature alone does to a pack"
                " without a fault is not known there, and cannot be told safely from a cause."
            )
    return " ".join(sentences)


def _soc(logs: Sequence[SampledLog], references: Sequence[SampledLog]) -> str:
    low, high = _range([item.rows.soc_pct for item in logs])
    sentences = []
    if high - low < ONE_SOC_PCT:
        sentences.append(
            f"A narrow range of SoC ({low:.1f} … {high:.1f} %): how the gap changes with SoC cannot"
            " be concluded, so initial_soc, capacity, voltage_gain, voltage_offset, ocv_shape and"
            " weak_cell look alike, and resistance_soc looks like any other resistance."
        )
    if references:
        known = _range([item.rows.soc_pct for item in references])
        if low < known[0] - COVERED_PCT or high > known[1] + COVERED_PCT:
            sentences.append(
                f"SoC of {low:.0f} … {high:.0f} % where the references have"
                f" {known[0]:.0f} … {known[1]:.0f} %: outside it the model's own OCV may be wrong,"
                " and that cannot be told safely from a cause. Rows there count less, and not at"
                " all where the model's own logs have not been either."
            )
    return " ".join(sentences)


def _start(logs: Sequence[SampledLog], initial_soc_pct: float | None) -> str:
    names = [item.log.name for item in logs if item.log.first_soc() is None]
    if initial_soc_pct is not None or not names:
        return ""
    return (
        f"No SoC at the start of {', '.join(names)}: 100 % was assumed. If that is wrong, it looks"
        " like initial_soc, voltage_offset or capacity, and none of these can be concluded; give"
        " the SoC with --initial-soc."
    )


def _reference_start(references: Sequence[SampledLog]) -> str:
    names = [item.log.name for item in references if item.log.first_soc() is None]
    if not names:
        return ""
    return (
        f"No SoC at the start of the reference{'s' if len(names) > 1 else ''} {', '.join(names)}:"
        " 100 % was assumed. If that is wrong, what is learned of the clean pack is wrong; give"
        " references with soc_pct, one value is enough."
    )


def _source(logs: Sequence[SampledLog], of_model: TemperatureSource) -> str:
    others = sorted({item.log.temperature_source for item in logs} - {of_model, "unknown"})
    if of_model == "unknown" or not others:
        return ""
    return (
        f"The model's temperature was measured on {of_model}, that of these logs on"
        f" {', '.join(others)}: what the temperature does to voltage and resistance cannot be"
        " concluded, because it is another temperature."
    )


def _charging(logs: Sequence[SampledLog], capacity_ah: float) -> str:
    current = np.concatenate([item.rows.delayed_current_a[:, 0] for item in logs])
    least_a = REST_C_RATE * capacity_ah
    sentences = []
    if np.mean(current < -least_a) < REST_PART:
        sentences.append(
            "The pack is never charged: resistance_asymmetry and coulombic_efficiency cannot be"
            " seen, and hysteresis not told from an offset of the OCV."
        )
    if np.mean(np.abs(current) < least_a) < REST_PART:
        sentences.append(
            "The pack never rests: what decays without current (slow_diffusion) cannot be told"
            " from what stays (hysteresis), nor an error of the voltage from one of the resistance"
            " by looking at rest."
        )
    return " ".join(sentences)


def _reference_number(number: int) -> str:
    if number >= FEW_REFERENCES:
        return ""
    if not number:
        return (
            "No reference logs: whether the model was ever right on this pack cannot be concluded;"
            " the error that the model file states stands for the floor, and structure that the"
            " model never had counts as a cause."
        )
    return (
        f"Only {number} reference log{'s' if number > 1 else ''}: how much logs of this pack differ"
        " without a cause is hardly known, so probabilities are less sure than they look."
    )


def _range(values: Sequence[np.ndarray]) -> tuple[float, float]:
    whole = np.concatenate(values)
    return float(whole.min()), float(whole.max())

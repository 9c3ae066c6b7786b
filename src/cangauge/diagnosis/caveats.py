"""Caveats: limits of what the logs can show, whatever the verdict; one or two sentences each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cangauge.diagnosis.error_breakdown import REST_C_RATE
from cangauge.diagnosis.references import COVERED_K, COVERED_PCT
from cangauge.inference.rows import SampledLog
from cangauge.logs.gaps import bridge_s
from cangauge.logs.log import TemperatureSource

SHORT_S = 600.0
"""Duration below which slow effects hardly develop [s]."""

NARROW_K, NARROW_PCT = 3.0, 10.0
"""Ranges of temperature and SoC below which their influence is not visible [K, %]."""

REST_PART = 0.005
"""Part of the rows below which the pack counts as never charged, or never at rest."""

STEP_PART = 0.5
"""Part of the floor below which half a step of the temperature is negligible."""

POOR_FIT_PART, POOR_FIT_TIMES, STATED_TIMES = 0.005, 3.0, 5.0
"""A reference fits poorly with an error above this part of the voltage, and above the first
multiple of the others' or the second of the model file's."""

FEW_REFERENCES = 3
"""Number of references below which the spread between healthy logs is uncertain."""


def log_caveats(
    logs: Sequence[SampledLog],
    references: Sequence[SampledLog],
    capacity_ah: float,
    temperature_source: TemperatureSource = "unknown",
) -> list[str]:
    """Return the caveats of the diagnosed logs and references.

    Parameters
    ----------
    logs, references : sequence of SampledLog
    capacity_ah : float
        Of the model [Ah].
    temperature_source : str
        Where the model's temperature was measured.
    """
    found = [
        _duration(logs),
        *_temperature(logs, references),
        *_soc(logs, references),
        _recording_gaps(logs),
        _temperature_source([*logs, *references], temperature_source),
        *_current(logs, capacity_ah),
        _reference_number(len(references)),
    ]
    return [sentence for sentence in found if sentence]


def temperature_step_caveat(step_k: float, kt_v_per_k: float, floor_v: float) -> str:
    """Return the caveat of a temperature reported in coarse steps; "" if negligible.

    Parameters
    ----------
    step_k : float
        Step of the reported temperature [K].
    kt_v_per_k : float
        Temperature coefficient of the model [V/K].
    floor_v : float
        Error of the model without a cause [V].
    """
    half_v = 0.5 * step_k * abs(kt_v_per_k)
    if half_v < STEP_PART * floor_v:
        return ""
    return (
        f"The temperature is reported in steps of {step_k:g} K; at the model's"
        f" {1e3 * kt_v_per_k:.0f} mV/K that is an error of up to {half_v:.2f} V as long as the"
        " value does not change. The diagnosis interpolates between the steps; a service cannot."
        " A finer temperature would reveal smaller causes."
    )


def reference_fit_caveat(
    errors_v: Sequence[tuple[str, float]], stated_v: float, voltage_v: float
) -> str:
    """Return the caveat of references that the given model does not fit; "" if it fits them.

    Parameters
    ----------
    errors_v : sequence of (str, float)
        Name and RMS error of each reference [V].
    stated_v : float
        RMS error that the model file states [V].
    voltage_v : float
        Usual voltage of the pack [V].
    """
    if not errors_v:
        return ""
    *others, (name, worst_v) = sorted(errors_v, key=lambda item: item[1])
    others_v = float(np.median([volts for _, volts in others])) if others else worst_v
    part = worst_v / voltage_v
    if part > POOR_FIT_PART and worst_v > POOR_FIT_TIMES * others_v:
        return (
            f"The model does not fit the reference {name}: {worst_v:.1f} V RMS"
            f" ({100.0 * part:.0f} % of the voltage), the others {others_v:.2f} V. Check that it is"
            " a log of this pack with the right initial SoC; it can hide a cause."
        )
    usual_v = float(np.median([volts for _, volts in errors_v]))
    if usual_v > POOR_FIT_PART * voltage_v and usual_v > STATED_TIMES * stated_v:
        return (
            f"The model does not fit its references: {usual_v:.2f} V RMS; the model file states"
            f" {stated_v:.2f} V. If their capacity, initial SoC or pack is wrong, that can hide a"
            " cause."
        )
    return ""


def extension_caveat(baseline_v: float, extended_v: float) -> str:
    """Return the caveat of an extended model with a larger error on held-out rows [V]."""
    if extended_v <= baseline_v:
        return ""
    return (
        f"The extended model is worse on held-out rows: {extended_v:.2f} V, the given one"
        f" {baseline_v:.2f} V. Do not use it: the cause may be right, but its size is not."
    )


def extended_soc_caveat(given_pct: float, extended_pct: float, stated_pct: float) -> str:
    """Return the caveat of an extended model whose SoC error on the diagnosed logs is larger.

    Parameters
    ----------
    given_pct, extended_pct : float
        Mean absolute errors with the given and with the extended model [%].
    stated_pct : float
        Mean standard deviation that the estimator states with the extended model [%]: up to that
        size the errors of one log are no evidence against it.
    """
    if extended_pct <= max(given_pct, stated_pct):
        return ""
    return (
        f"On these logs the extended model's SoC is farther from the logs' own SoC"
        f" ({extended_pct:.1f} %) than the given model's ({given_pct:.1f} %). Compare both on a log"
        " of another day with the same fault before you use it; where the fault can be mended (a"
        " sensor, a time stamp), mend it instead."
    )


def _duration(logs: Sequence[SampledLog]) -> str:
    short = [item.log for item in logs if item.log.duration_s < SHORT_S]
    if not short:
        return ""
    names = ", ".join(f"{log.name} ({log.duration_s / 60.0:.1f} min)" for log in short)
    return (
        f"Shorter than {SHORT_S / 60.0:.0f} min: {names}. Effects that develop over minutes to"
        " hours (slow_diffusion, core_temperature, hysteresis, and a drift of the charge by"
        " current_offset, current_gain, capacity or coulombic_efficiency) can be neither named nor"
        " excluded."
    )


def _temperature(logs: Sequence[SampledLog], references: Sequence[SampledLog]) -> list[str]:
    low, high = _range([item.rows.temperature_c for item in logs])
    sentences = []
    if high - low < NARROW_K:
        sentences.append(
            f"Narrow temperature range ({low:.1f} … {high:.1f} °C): resistance_temperature,"
            " entropic_coefficient and temperature_lag look like any change of the resistance or"
            " of the OCV."
        )
    if references:
        known = _range([item.rows.temperature_c for item in references])
        if low < known[0] - COVERED_K or high > known[1] + COVERED_K:
            sentences.append(
                f"Temperatures of {low:.1f} … {high:.1f} °C, references {known[0]:.1f} …"
                f" {known[1]:.1f} °C: outside the references' range the behaviour of a healthy pack"
                " is not known and may look like a cause."
            )
    return sentences


def _soc(logs: Sequence[SampledLog], references: Sequence[SampledLog]) -> list[str]:
    low, high = _range([item.rows.soc_pct for item in logs])
    sentences = []
    if high - low < NARROW_PCT:
        sentences.append(
            f"Narrow SoC range ({low:.1f} … {high:.1f} %): initial_soc, capacity, voltage_gain,"
            " voltage_offset, ocv_shape and weak_cell look alike, and resistance_soc looks like any"
            " other resistance."
        )
    if references:
        known = _range([item.rows.soc_pct for item in references])
        if low < known[0] - COVERED_PCT or high > known[1] + COVERED_PCT:
            sentences.append(
                f"SoC of {low:.0f} … {high:.0f} %, references {known[0]:.0f} … {known[1]:.0f} %:"
                " outside the references' range an error of the model's OCV may look like a cause."
                " Rows there count less, and not at all outside the range of the model's own logs."
            )
    return sentences


def _recording_gaps(logs: Sequence[SampledLog]) -> str:
    found = []
    for item in logs:
        time_s = item.log.time_s
        steps = np.diff(time_s)
        at = int(np.argmax(steps))
        if steps[at] > bridge_s(time_s):
            after_h = (time_s[at] - time_s[0]) / 3600.0
            found.append(f"{item.log.name} ({steps[at] / 60.0:.0f} min after {after_h:.1f} h)")
    if not found:
        return ""
    return (
        f"Gap in the recording: {', '.join(found)}. The pack is assumed to have rested; charge"
        " moved meanwhile looks like initial_soc, capacity or an error of the voltage. Give the"
        " parts as separate logs, each with its SoC."
    )


def _temperature_source(logs: Sequence[SampledLog], of_model: TemperatureSource) -> str:
    others = sorted({item.log.temperature_source for item in logs} - {of_model, "unknown"})
    if of_model == "unknown" or not others:
        return ""
    return (
        f"The model's temperature was measured on {of_model}, that of these logs on"
        f" {', '.join(others)}: effects of the temperature on voltage and resistance cannot be"
        " judged."
    )


def _current(logs: Sequence[SampledLog], capacity_ah: float) -> list[str]:
    current = np.concatenate([item.rows.delayed_current_a[:, 0] for item in logs])
    least_a = REST_C_RATE * capacity_ah
    sentences = []
    if np.mean(current < -least_a) < REST_PART:
        sentences.append(
            "The pack is never charged: resistance_asymmetry and coulombic_efficiency are not"
            " visible, and hysteresis looks like an offset of the OCV."
        )
    if np.mean(np.abs(current) < least_a) < REST_PART:
        sentences.append(
            "The pack never rests: relaxation (slow_diffusion) looks like hysteresis, and an error"
            " of the voltage like one of the resistance."
        )
    return sentences


def _reference_number(number: int) -> str:
    if number >= FEW_REFERENCES:
        return ""
    if not number:
        return (
            "No reference logs: the floor is the error that the model file states, whether or not"
            " the model was ever right on this pack, and structure that the model lacks counts as a"
            " cause."
        )
    return (
        f"Only {number} reference log{'s' if number > 1 else ''}: differences between healthy logs"
        " are hardly known, and probabilities are less reliable."
    )


def _range(values: Sequence[np.ndarray]) -> tuple[float, float]:
    whole = np.concatenate(values)
    return float(whole.min()), float(whole.max())

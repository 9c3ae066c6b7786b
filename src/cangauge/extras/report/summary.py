"""Results as sentences and table rows, shared by terminal and pages; imports no bokeh."""

from __future__ import annotations

import math
from html import escape
from typing import Any, Final

from cangauge._formatting import NONE_KNOWN, number, significant, span
from cangauge.diagnosis import LIKELY, NONE, UNKNOWN, Diagnosis
from cangauge.diagnosis.next_test import NAMED, Plan
from cangauge.identify.effect_search import FittedEffects
from cangauge.model.effects.library import LIBRARY

Rows = list[list[str]]

_SIZES: Final = {
    "current_offset": ("offset_a", "The current reads {size} A {sign}", "too high", "too low"),
    "current_gain": ("gain_pct", "The current reads {size} % {sign}", "too high", "too low"),
    "voltage_offset": ("offset_v", "The voltage reads {size} V {sign}", "too high", "too low"),
    "voltage_gain": ("gain_pct", "The voltage reads {size} % {sign}", "too high", "too low"),
    "time_skew": ("skew_s", "The current is {size} s {sign}", "late", "early"),
    "capacity": ("change_pct", "The capacity is {size} % {sign} than the model's", "larger",
                 "smaller"),
    "initial_soc": ("offset_pct", "The assumed initial SoC is {size} % {sign}", "too low",
                    "too high"),
    "resistance_step": ("step_ohm", "The resistance steps {sign} by {size} Ω", "up", "down"),
    "resistance_asymmetry": ("charging_ohm", "The resistance to charging is {size} Ω {sign}",
                             "too high", "too low"),
}  # fmt: skip
"""Effect → its main parameter, a sentence, and the words for a positive and a negative value."""


EXPLAINED: Final = {
    "current_offset": "the current sensor is off by a constant, or a load bypasses it",
    "current_gain": "the current sensor reads too much or too little in proportion",
    "voltage_offset": "the voltage reading is off by a constant",
    "voltage_gain": "the voltage reading is off in proportion",
    "time_skew": "current and voltage are not recorded at the same moment",
    "temperature_lag": "the temperature sensor follows the pack late",
    "core_temperature": "the cells inside are warmer than the sensor shows after high current",
    "inner_temperature": "the cells inside follow slow changes of the measured temperature late",
    "capacity": "the pack holds more or less charge than the model assumes",
    "initial_soc": "the log starts at another state of charge than assumed",
    "coulombic_efficiency": "part of the charge that is put in cannot be taken out again",
    "resistance_temperature": "the resistance rises more (or less) in the cold than modelled",
    "resistance_soc": "the resistance rises towards empty or full",
    "resistance_asymmetry": "charging meets another resistance than discharging",
    "resistance_step": "the resistance changes at one moment, as by a loose contact",
    "charge_transfer": "the voltage drop is not in proportion to the current: steep at small ones",
    "fast_polarization": "the voltage needs seconds to follow a change of load",
    "slow_diffusion": "the voltage needs minutes to recover after a load",
    "hysteresis": "at rest the voltage differs after charging and after discharging",
    "entropic_coefficient": "the open-circuit voltage depends on temperature otherwise",
    "ocv_shape": "the open-circuit voltage has another shape over the state of charge",
    "weak_cell": "some cells are empty before the others",
    NONE: "the logs differ from the model no more than logs without a fault",
    UNKNOWN: "a gap that no effect of the library explains",
}
"""Answer → what it means, in a line."""


def rounded(value: float, std_error: float | None) -> tuple[str, str]:
    """Return a value rounded to its standard error, and the error with two digits."""
    if not std_error or not math.isfinite(std_error):
        return significant(value, 3), significant(std_error, 2)
    decimals = max(0, 1 - math.floor(math.log10(std_error)))
    return number(value, decimals), significant(std_error, 2)


def effect_rows(found: FittedEffects) -> tuple[list[str], Rows]:
    """Return headings and rows: every parameter of every effect with its standard error."""
    rows = [
        [
            effect_id if k == 0 else "",
            item.name,
            *rounded(item.value, item.std_error),
            "" if item.unit == "1" else item.unit.replace("ohm", "Ω"),
        ]
        for effect_id, parameters in found.estimates
        for k, item in enumerate(parameters)
    ]
    return ["<effect", "<parameter", "value", "std. error", "<unit"], rows


def search_rows(found: FittedEffects) -> tuple[list[str], Rows]:
    """Return headings and rows: the steps of the effect search with their held-out errors."""
    rows = [
        [
            step.effect_id,
            step.what,
            significant(step.comparison.before_rmse_v, 3),
            significant(step.comparison.after_rmse_v, 3),
            number(step.comparison.t_value, 1),
            number(step.comparison.t_critical, 1),
        ]
        for step in found.steps
    ]
    return ["<effect", "<step", "held out without [V]", "with [V]", "t", "t needed"], rows


def headline(diagnosis: Diagnosis) -> str:
    """Return size and cause of the gap, and how sure the alarm is; "" if no cause is named."""
    verdict = diagnosis.verdict
    if verdict.cause in {NONE, UNKNOWN}:
        return ""
    names = [verdict.cause, *verdict.ambiguous_with]
    percent = 100.0 * sum(verdict.probabilities[name] for name in names)
    together = "together " if names[1:] else ""
    causes = f"{', '.join(names[:-1])} or {names[-1]}" if names[1:] else names[0]
    causes += f" ({together}{percent:.0f} %)"
    size = _size(diagnosis)
    first = f"{size}: {causes}." if size else f"The most likely cause is {causes}."
    if verdict.detected:
        return first
    none = 100.0 * verdict.probabilities[NONE]
    return f"{first} No alarm: the probability that there is no fault is {none:.0f} %."


def _size(diagnosis: Diagnosis) -> str:
    """Return the size of the cause with its 95 % interval; "" if it has no single number."""
    cause = diagnosis.verdict.cause
    if cause not in _SIZES:
        return ""
    name, sentence, positive, negative = _SIZES[cause]
    parameters: dict[str, Any] = next(
        item["parameters"] for item in diagnosis.candidates if item["effect"] == cause
    )
    if name not in parameters:
        return ""
    value, interval = parameters[name]["value"], parameters[name]["ci"]
    size = significant(abs(value), 2)
    if interval is not None:
        low, high = sorted(bound if value > 0.0 else -bound for bound in interval)
        size += f" ({significant(low, 2)} … {significant(high, 2)})"
    return sentence.format(size=size, sign=positive if value > 0.0 else negative)


def next_step(diagnosis: Diagnosis) -> str:
    """Return the measurement that would confirm the named cause; "" without one."""
    verdict = diagnosis.verdict
    if verdict.cause in {NONE, UNKNOWN}:
        return ""
    purpose = "separate these causes" if verdict.ambiguous_with else "confirm the cause"
    return f"To {purpose}: {LIBRARY[verdict.cause].separated_by}."


def open_question(diagnosis: Diagnosis) -> str:
    """Return what the verdict leaves open; "" for a clear cause."""
    verdict, references = diagnosis.verdict, diagnosis.problem.references
    baseline = number(diagnosis.baseline_rmse_v, 2, "V")
    if verdict.cause == NONE:
        learned = ""
        if references:
            with_references = number(diagnosis.extended_rmse_v, 2, "V")
            learned = f" ({baseline} as given, {with_references} with what the references show)"
        return (
            f"No cause can be named: logs without a fault may have the same error{learned}. This"
            f" does not prove that there is none.{_invisible(diagnosis)}"
        )
    if verdict.cause == UNKNOWN:
        floor = "references" if references else "the model file states"
        sizes = f"{baseline}, {floor} {number(diagnosis.floor_v, 2, 'V')}"
        stated = verdict.probabilities
        together = 1.0 - stated[NONE] - stated[UNKNOWN]
        if together > stated[UNKNOWN]:
            return (
                f"No cause can be named ({sizes}): a cause outside the library is the likeliest"
                f" single answer, but all effects of the library together have"
                f" {100.0 * together:.0f} %; none of them stands out. The best,"
                f" {verdict.candidates[0].effect_id}, has"
                f" {100.0 * stated[verdict.candidates[0].effect_id]:.0f} %."
            )
        return (
            f"No cause can be named: the gap is real ({sizes}), but no effect of the library is a"
            f" likely cause. The best, {verdict.candidates[0].effect_id}, explains"
            f" {100.0 * verdict.explained:.0f} % of it. The cause is not in the library, or several"
            " act at once, or the model is not of this pack."
        )
    sentences = []
    if verdict.probability < LIKELY:
        sentences.append(
            f"{verdict.cause} is the most likely cause, but its probability is only"
            f" {verdict.probability:.2f}: do not act on it alone."
        )
    sentences += _separability(diagnosis)
    return " ".join(sentences)


def _separability(diagnosis: Diagnosis) -> list[str]:
    """Return from which size on the verdict is separable from its nearest rival, and the ceiling.

    Only where that is more than the size found.
    """
    verdict = diagnosis.verdict
    if verdict.ceiling is None:
        return []
    rival, part = next(iter(verdict.ceiling.parts_needed().items()), ("", 0.0))
    best = 100.0 * verdict.ceiling.probability_of_best
    if part <= 1.0:
        return []
    at = _main_amount(diagnosis)
    if not math.isfinite(part):
        limit = "at any size"
    elif at is None:
        limit = f"below {part:.1f} times the size found"
    else:
        limit = f"below {significant(part * abs(at[0]), 2)} {at[1]}"
    return [
        f"These logs cannot distinguish {verdict.cause} from {rival} {limit}: at the size found"
        f" the best method would name the right one in {best:.0f} % of cases."
    ]


def _main_amount(diagnosis: Diagnosis) -> tuple[float, str] | None:
    """Return value and unit of the verdict's main parameter; None if it has no single number."""
    cause = diagnosis.verdict.cause
    parameters: dict[str, Any] = next(
        item["parameters"] for item in diagnosis.candidates if item["effect"] == cause
    )
    item = parameters.get(_SIZES[cause][0]) if cause in _SIZES else None
    return None if item is None else (item["value"], item["unit"].replace("ohm", "Ω"))


def _invisible(diagnosis: Diagnosis) -> str:
    names = [str(item["effect"]) for item in diagnosis.observability if item["visible"] == 0.0]
    if not names:
        return " Causes smaller than these logs can show remain possible."
    return f" At no physical size would these logs clearly show {', '.join(names)}."


def parameters_text(parameters: dict[str, dict[str, Any]], separator: str = ", ") -> str:
    """Return parameters of an effect with units and 95 % intervals, where they have one."""
    texts = []
    for name, item in parameters.items():
        unit = "" if item["unit"] == "1" else f" {item['unit'].replace('ohm', 'Ω')}"
        interval = ""
        if item["ci"] is not None:
            low, high = (significant(bound, 3) for bound in item["ci"])
            interval = f" ({low} … {high})"
        value = 0.0 if abs(item["value"]) < 1e-6 else item["value"]
        texts.append(f"{name} {significant(value, 3)}{unit}{interval}")
    return separator.join(texts)


def percent(fraction: float) -> str:
    """Return a fraction in %."""
    return number(100.0 * fraction, 0, "%")


def percent_span(low: float, high: float) -> str:
    """Return a range of fractions in %."""
    return span(100.0 * low, 100.0 * high, 0, "%")


PLAN_TITLE: Final = "Tests: expected probability of each cause where it is the true one"


def plan_rows(plan: Plan) -> tuple[list[str], Rows]:
    """Return headings and rows: the tests, best first, and the probabilities without any."""
    causes = plan.causes[:NAMED]
    rows = [
        [
            test.profile.name,
            number(test.profile.start_soc_pct, 0),
            number(test.profile.start_c, 0),
            number(test.information_nats, 2),
            number(test.probability, 2),
            *(number(test.expected[cause], 2) for cause in causes),
        ]
        for test in plan.tests
    ]
    now = [number(plan.before[cause], 2) for cause in causes]
    rows.append(["without a test", *[NONE_KNOWN] * 3, number(plan.probability, 2), *now])
    headings = ["<test", "from SoC [%]", "from [°C]", "information [nats]", "P(true one)"]
    return [*headings, *causes], rows


SHOWN_IN_NOTEBOOK: Final = 5


def diagnosis_html(found: Diagnosis) -> str:
    """Return a diagnosis as a compact HTML block: verdict, sizes, probabilities, caveats.

    Parameters
    ----------
    found : Diagnosis
    """
    texts = [headline(found), found.summary, open_question(found), next_step(found)]
    paragraphs = [f"<p>{escape(text)}</p>" for text in texts[1:] if text]
    by_effect = {str(item["effect"]): item for item in found.candidates}
    ordered = sorted(found.verdict.probabilities.items(), key=lambda item: -item[1])
    rows = []
    for name, probability in ordered[:SHOWN_IN_NOTEBOOK]:
        item = by_effect.get(name)
        parameters = parameters_text(item["parameters"]) if item and item["parameters"] else ""
        error = number(item["rmse_v"] if item else None, 2, "V")
        cells = (name, number(probability, 2), error, parameters)
        tag = "th" if name == found.verdict.cause else "td"
        rows.append("".join(f"<{tag} style='text-align:left'>{escape(c)}</{tag}>" for c in cells))
    head = "".join(
        f"<th style='text-align:left'>{text}</th>"
        for text in ("cause", "probability", "error with it, held out", "parameters")
    )
    table = "".join(f"<tr>{row}</tr>" for row in (head, *rows))
    caveats = "".join(f"<li>{escape(text)}</li>" for text in found.caveats)
    limits = f"<details><summary>What these logs cannot show</summary><ul>{caveats}</ul></details>"
    return (
        f"<div><h4>{escape(texts[0])}</h4>{''.join(paragraphs)}<table>{table}</table>"
        f"{limits if caveats else ''}</div>"
    )

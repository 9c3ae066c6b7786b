"""What a user reads of a diagnosis: sentences, table rows and a notebook's block; no bokeh."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from cangauge._text import NONE_KNOWN, counted, number, significant
from cangauge.diagnosis.answer import NONE, TITLES, UNKNOWN, Posterior
from cangauge.diagnosis.columns import COVER_PCT
from cangauge.diagnosis.evidence import COVER_K
from cangauge.diagnosis.extended import LOG_EFFECTS, Quantity, residual_v
from cangauge.diagnosis.simulator import correction
from cangauge.logs.gaps import bridge_s

if TYPE_CHECKING:
    from cangauge.diagnosis.diagnose import Diagnosis
    from cangauge.diagnosis.planner import Plan

Rows = list[list[str]]

SIZES: Final[Mapping[str, tuple[str, str, str, str]]] = {
    "current_offset": ("offset_a", "The current reads {size} A {sign}", "too high", "too low"),
    "current_gain": ("gain_pct", "The current reads {size} % {sign}", "too high", "too low"),
    "voltage_offset": ("offset_v", "The voltage reads {size} V {sign}", "too high", "too low"),
    "voltage_gain": ("gain_pct", "The voltage reads {size} % {sign}", "too high", "too low"),
    "time_skew": ("skew_s", "The current is recorded {size} s {sign}", "late", "early"),
    "capacity": (
        "change_pct", "The capacity is {size} % {sign} than the model's", "larger", "smaller",
    ),
    "initial_soc": (
        "offset_pct", "The assumed initial SoC is {size} % {sign}", "too low", "too high",
    ),
    "resistance_step": ("step_ohm", "The resistance steps {sign} by {size} Ω", "up", "down"),
    "resistance_asymmetry": (
        "charging_ohm", "The resistance to charging is {size} Ω {sign}", "too high", "too low",
    ),
}  # fmt: skip
"""Effect → its main parameter, a sentence, and the words for a positive and a negative value."""

GROWN: Final = ("step_ohm", "The resistance has {sign} by {size} Ω", "grown", "fallen")
"""In place of a step, where it happened before the first log."""

AT_START: Final = 0.05
"""A step in this first part of a log is taken to have happened before it: half the distance between
the places that are tried."""

SHORT_S: Final = 600.0
"""Duration below which slow effects hardly develop [s]."""

MISFIT: Final = 1.2
"""Error of the given model, in those with what the references show, from which both are told."""

POOR_FIT: Final = 2.0
"""A model misfits its references with an error of more than this many healthy errors."""

SHOWN_MEMBERS: Final = 3
"""Effects of a group that a summary lists where none stands out."""

COMMON: Final = ("current_offset", "voltage_offset", "initial_soc", "time_skew")
"""Effects whose visible size the summary lists first: what a user suspects first."""


def size_sentence(
    effect: str, parameters: Mapping[str, Quantity], place: float | None = None
) -> str:
    """Return the size of an effect with its 95 % interval; "" if it has no single number.

    `place` is that of a step in the first log, in parts of it.
    """
    if effect not in SIZES:
        return ""
    grown = place is not None and place < AT_START
    name, sentence, positive, negative = GROWN if grown else SIZES[effect]
    value, ci = parameters[name].value, parameters[name].ci
    size = significant(abs(value), 2)
    if ci is not None:
        low, high = sorted(bound if value > 0.0 else -bound for bound in ci)
        size += f" ({significant(low, 2)} … {significant(high, 2)})"
    return sentence.format(size=size, sign=positive if value > 0.0 else negative)


def headline(found: Diagnosis) -> str:
    """Return size, place and cause of the gap in one sentence, in agreement with the alarm."""
    answer = found.posterior
    none = percent(answer.probabilities[NONE])
    if not answer.detected:
        if not answer.likely:
            return (
                f"No significant gap beyond that of healthy logs. P(no fault) = {none}: a fault too"
                " small to be seen is not excluded."
            )
        return f"A gap is likely, not certain: P(no fault) = {none}. {_where_to_look(answer)}"
    name = answer.name
    if answer.leading_group == UNKNOWN or name is None:
        return f"There is a gap. {_where_to_look(answer)}"
    place = (found.evidence.effects[name].in_logs or (None,))[0]
    size = size_sentence(name, found.parameters[name], place)
    sure = f"{name}, {percent(answer.probabilities[name])}"
    return f"{size} ({sure})." if size else f"The most likely cause is {sure}."


def _where_to_look(answer: Posterior) -> str:
    """Return the stated group, or two in order, with their probability, in a sentence."""
    if answer.leading_group == UNKNOWN:
        return (
            f"Its cause is outside the library ({percent(answer.probabilities[UNKNOWN])}): the best"
            f" effect leaves {number(answer.left_over, 1)} times the error of a healthy log."
        )
    stated = answer.stated_groups
    total = percent(sum(answer.groups[group] for group in stated))
    words = ", then ".join(TITLES[group] for group in stated)
    return f"Look first at {words} ({'together ' if len(stated) > 1 else ''}{total})."


def summary(found: Diagnosis) -> str:
    """Return the answer in a few lines: what it is, how large, what to do, what is left open."""
    answer, simulator = found.posterior, found.simulator
    lines = ["" if simulator is None else simulator.remark, headline(found), size_text(found)]
    if simulator is not None and found.accepted is not None:
        lines.append(correction(found.accepted, found.parameters[found.accepted]))
    if answer.detected and answer.leading_group != UNKNOWN and answer.name is not None:
        lines.append(_where_to_look(answer))
    if answer.likely:
        lines.append(answer.check_first)
        if answer.leading_group != UNKNOWN and answer.name is None:
            lines.append(
                "No single effect stands out there; the likeliest:"
                f" {', '.join(answer.members[:SHOWN_MEMBERS])}."
            )
    if not answer.detected:
        lines.append(visible_text(found))
    if not found.has_references:
        lines.append(
            "No reference log was given: the model itself and the error that its file states count"
            " as healthy. Give logs without the fault with --reference."
        )
    return "\n".join(line for line in lines if line)


def size_text(found: Diagnosis) -> str:
    """Return the errors in volts, what the cause closes of the gap, and what the SoC gains."""
    healthy = "a healthy log has" if found.has_references else "the model file states"
    what = "model" if found.simulator is None else "simulator"
    text = f"The {what} misses the voltage by {significant(found.baseline_rmse_v, 2, 'V')} RMS"
    expected, answer = math.sqrt(found.evidence.gap_v2), found.posterior
    left_open = answer.likely and found.accepted is None and answer.leading_group != UNKNOWN
    if found.has_references and (left_open or found.baseline_rmse_v > MISFIT * expected):
        text += f" ({significant(expected, 2, 'V')} with what the references show of this pack)"
    text += f"; {healthy} {significant(found.healthy_rmse_v, 2, 'V')}."
    if found.accepted is not None:
        all_rows = all(log.judged.all() for log in found.log_errors)
        text += f" With {found.accepted}: {significant(found.extended_rmse_v, 2, 'V')}"
        text += "." if all_rows else ", on the rows that it can change."
    elif left_open:
        left_v = math.sqrt(found.evidence.effects[answer.members[0]].left_v2)
        text += f" {answer.members[0]}, the likeliest cause, would leave"
        text += f" {significant(left_v, 2, 'V')}."
    return text + soc_text(found)


def soc_text(found: Diagnosis) -> str:
    """Return what the cause does to the SoC error of these logs, and why none is accepted."""
    if (cause := found.likeliest) in {None, *LOG_EFFECTS}:
        return ""
    refused, errors = found.accepted is None, found.soc_errors_pct
    if errors is None:
        text = f" No extended model: {cause} does not stand out." if refused else ""
        if found.start_is_suspect and any(log.soc_pct is not None for log in found.logs):
            text += " The start of these logs may be the cause, so their SoC proves nothing."
        return text
    before, after = (number(error, 2) for error in errors)
    if not refused:
        better = errors[1] < errors[0]
        return f" SoC error, start withheld: {before} → {after} %{'' if better else ', no better'}."
    if errors[1] >= errors[0]:
        return (
            f" No extended model: with {cause} the SoC error, start withheld, would rise from"
            f" {before} to {after} %."
        )
    return (
        f" No extended model: {cause} does not stand out, and the SoC error, start withheld, would"
        f" only fall from {before} to {after} %."
    )


def visible_text(found: Diagnosis) -> str:
    """Return from which size the most usual effects would have been seen."""
    least = {item["effect"]: item for item in found.visible_from if item["effect"] in COMMON}
    sizes = [
        f"{name} from {significant(item['size'], 2)} {item['unit']}"
        for name, item in least.items()
        if item["size"] is not None
    ]
    never = [name for name, item in least.items() if item["size"] is None]
    text = f"These logs would have shown {', '.join(sizes)}." if sizes else ""
    return text + (
        f" No {' and no '.join(never)} of a physical size would be seen in them." if never else ""
    )


def percent(fraction: float) -> str:
    """Return a probability in %, never rounded to certainty."""
    value = 100.0 * fraction
    if 0.0 < value < 1.0:
        return "under 1 %"
    if 99.0 < value < 100.0:
        return "over 99 %"
    return f"{value:.0f} %"


def caveats(found: Diagnosis) -> list[str]:
    """Return what limits the answer, a sentence each."""
    said = list(found.remarks)
    for log in found.logs:
        if log.duration_s < SHORT_S:
            said.append(
                f"{log.name} is shorter than {SHORT_S / 60.0:.0f} min: effects that develop over"
                " minutes to hours can be neither named nor excluded."
            )
        step_s = float(np.diff(log.time_s).max())
        if step_s > bridge_s(log.time_s):
            said.append(
                f"{log.name} has a gap of {step_s / 60.0:.0f} min. The pack is assumed to have"
                " rested; charge moved meanwhile looks like initial_soc or capacity."
            )
    if found.has_references:
        said += _of_references(found)
    source = found.model.temperature_source
    others = {log.temperature_source for log in found.logs} - {"unknown", source}
    if source != "unknown" and others:
        said.append(
            f"The model's temperature was measured on {source}, that of these logs on"
            f" {', '.join(sorted(others))}: effects of temperature cannot be judged."
        )
    return said


def _of_references(found: Diagnosis) -> list[str]:
    """Return sentences on what the references do not cover, or do not show."""
    said, logs = [], [of.log for of in found.columns]
    references, soc = found.known.logs, found.known.pack.soc
    for quantity, unit, margin, of in (
        ("temperature", "°C", COVER_K, lambda log: log.temperature_c),
        ("SoC", "%", COVER_PCT, soc),
    ):
        (low, high), (least, most) = (
            np.quantile(np.concatenate([of(log) for log in some]), [0.0, 1.0])
            for some in (logs, references)
        )
        if low < least - margin or high > most + margin:
            said.append(
                f"The logs' {quantity} of {low:.0f} … {high:.0f} {unit} goes beyond the references'"
                f" {least:.0f} … {most:.0f} {unit}, where a healthy pack is not known."
            )
    if len(references) < 3:
        said.append(
            f"Only {counted(len(references), 'reference log')}: differences between healthy logs"
            " are hardly known, and probabilities are less reliable."
        )
    model, names = found.model.extended_model(), [log.name for log in found.references]
    errors = {
        name: float(np.sqrt(np.mean(residual_v(model, log)[log.measured] ** 2)))
        for name, log in zip(
            names or [f"reference {k + 1}" for k in range(len(references))], references, strict=True
        )
    }
    worst, usual = max(errors, key=lambda name: errors[name]), float(np.median([*errors.values()]))
    if usual > POOR_FIT * found.healthy_rmse_v:
        said.append(
            f"The model misses its references by {significant(usual, 2, 'V')}, a model of these"
            f" logs by {significant(found.healthy_rmse_v, 2, 'V')}: fit it again with them."
        )
    elif len(references) > 2 and errors[worst] > 3.0 * usual:
        said.append(
            f"The reference {worst} is off by {significant(errors[worst], 2, 'V')}, the others by"
            f" {significant(usual, 2, 'V')}: check that it is without the fault."
        )
    return said


EXPLAINED: Final = {
    "current_offset": "the current sensor is off by a constant, or a load bypasses it",
    "current_gain": "the current sensor reads too much or too little in proportion",
    "voltage_offset": "the voltage reading is off by a constant",
    "voltage_gain": "the voltage reading is off in proportion",
    "time_skew": "current and voltage are not recorded at the same moment",
    "temperature_lag": "the temperature sensor follows the pack late",
    "core_temperature": "the cells inside are warmer than the sensor shows after high current",
    "capacity": "the pack holds more or less charge than the model assumes",
    "initial_soc": "the log starts at another state of charge than assumed",
    "coulombic_efficiency": "part of the charge that is put in cannot be taken out again",
    "resistance_temperature": "the resistance rises more (or less) in the cold than modelled",
    "resistance_soc": "the resistance rises towards empty or full",
    "resistance_asymmetry": "charging meets another resistance than discharging",
    "resistance_step": "the resistance changes at one moment, as by a loose contact, or has changed"
    " before these logs",
    "charge_transfer": "the voltage drop is not in proportion to the current: steep at small ones",
    "fast_polarization": "the voltage needs seconds to follow a change of load",
    "slow_diffusion": "the voltage needs minutes to recover after a load",
    "hysteresis": "at rest the voltage differs after charging and after discharging",
    "entropic_coefficient": "the open-circuit voltage depends on temperature otherwise",
    "weak_cell": "some cells are empty before the others",
    NONE: "the logs differ from the model no more than logs without a fault",
    UNKNOWN: "a gap that no effect of the library explains",
}
"""Answer → what it means, in a line."""


SHOWN: Final = 5
"""Causes that a terminal and a notebook show."""


def candidate_rows(result: Mapping[str, Any], at_most: int | None = None) -> tuple[list[str], Rows]:
    """Return headings and rows of `Diagnosis.to_json`: causes, probability, size, error left.

    `none` and `unknown` follow the causes.
    """
    cause = result["cause"]
    rows = [
        [
            _words(each["effect"]),
            number(each["probability"], 2),
            size_cell(each),
            number(each["rmse_v"], 2),
        ]
        for each in cause["candidates"][:at_most]
    ]
    rows += [
        [answer, number(cause[f"probability_{answer}"], 2), NONE_KNOWN, NONE_KNOWN]
        for answer in (UNKNOWN, NONE)
    ]
    return ["cause", "probability", "size (95 %)", "error left [V]"], rows


def size_cell(candidate: Mapping[str, Any]) -> str:
    """Return the sizes of a candidate that have an interval, named where the unit is no name."""
    sizes = {k: each for k, each in candidate["parameters"].items() if each["ci"] is not None}
    parts = []
    for name, quantity in sizes.items():
        low, high = quantity["ci"]
        has_unit = quantity["unit"] != "1"
        unit = f" {quantity['unit'].replace('ohm', 'Ω')}" if has_unit else ""
        label = "" if has_unit and len(sizes) == 1 else f"{_words(_UNIT_SUFFIX.sub('', name))} "
        size = (
            f"{significant(quantity['value'], 3)} ({significant(low, 2)} … {significant(high, 2)})"
        )
        parts.append(f"{label}{size}{unit}")
    return "; ".join(parts) or NONE_KNOWN


_UNIT_SUFFIX: Final = re.compile(r"_(v_per_k|ohm|pct|[avsk])$")
"""Unit at the end of a parameter's name."""


def visible_rows(result: Mapping[str, Any]) -> tuple[list[str], Rows]:
    """Return headings and rows: the smallest size of each cause that would have been seen."""
    rows = [
        [_words(each["effect"]), significant(each["size"], 2, each["unit"])]
        for each in result["visible_from"]
    ]
    return ["cause", "seen from"], rows


def plan_rows(plan: Plan) -> tuple[list[str], Rows]:
    """Return headings and rows: the possible next steps, best first."""
    rows = [
        [step.name, number(plan.before, 2), number(step.after, 2), f"{step.gain:+.2f}"]
        for step in plan.steps
    ]
    return ["step", "P(true cause) now", "after", "gain"], rows


def _words(name: str) -> str:
    return name.replace("_", " ")


def diagnosis_html(found: Diagnosis) -> str:
    """Return a diagnosis as a compact HTML block: verdict, probabilities, limits."""
    result = found.to_json()
    head, rows = candidate_rows(result, SHOWN)
    lines = [
        "".join(f"<{tag} style='text-align:left'>{escape(cell)}</{tag}>" for cell in cells)
        for tag, cells in (("th", head), *(("td", r) for r in rows))
    ]
    table = "".join(f"<tr>{line}</tr>" for line in lines)
    limits = "".join(f"<li>{escape(text)}</li>" for text in found.caveats)
    folded = f"<details><summary>What these logs cannot show</summary><ul>{limits}</ul></details>"
    first, *others = found.summary.splitlines()
    texts = "".join(f"<p>{escape(text)}</p>" for text in others)
    return (
        f"<div><h4>{escape(first)}</h4>{texts}<table>{table}</table>"
        f"{folded if limits else ''}</div>"
    )

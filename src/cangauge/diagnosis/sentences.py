"""The sentences of a diagnosis: what a user reads first, all from one posterior."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

import numpy as np

from cangauge._text import counted, number, significant
from cangauge.diagnosis.answer import GROUP_OF, NONE, TITLES, UNKNOWN, Posterior
from cangauge.diagnosis.columns import COVER_PCT
from cangauge.diagnosis.evidence import COVER_K
from cangauge.logs.gaps import bridge_s

if TYPE_CHECKING:
    from cangauge.diagnosis.diagnose import Diagnosis
    from cangauge.diagnosis.extended import Quantity

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

SHORT_S: Final = 600.0
"""Duration below which slow effects hardly develop [s]."""

MISFIT: Final = 1.2
"""Error of the given model, in those with what the references show, from which both are told."""

POOR_FIT: Final = 2.0
"""A model misfits its references with an error of more than this many healthy errors."""

COMMON: Final = ("current_offset", "voltage_offset", "initial_soc", "time_skew")
"""Effects whose visible size the summary lists first: what a user suspects first."""


def size_sentence(effect: str, parameters: Mapping[str, Quantity]) -> str:
    """Return the size of an effect with its 95 % interval; "" if it has no single number."""
    if effect not in SIZES:
        return ""
    name, sentence, positive, negative = SIZES[effect]
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
        text = f"No significant gap beyond that of healthy logs: P(no fault) = {none}."
        if answer.probabilities[NONE] < 1.0 - answer.probabilities[NONE]:
            text += f" If there is a fault, look first at {groups_text(answer)}."
        return text
    if answer.leading_group == UNKNOWN:
        unknown = percent(answer.probabilities[UNKNOWN])
        return (
            f"A gap of a cause outside the library ({unknown}): the best effect leaves"
            f" {number(answer.left_over, 1)} times the error of a healthy log."
        )
    name = answer.name
    if name is None or found.parameters.get(name) is None:
        return f"A gap; look first at {groups_text(answer)}."
    size = size_sentence(name, found.parameters[name])
    sure = f"{name}, {percent(answer.probabilities[name])}"
    return f"{size} ({sure})." if size else f"The most likely cause is {sure}."


def groups_text(answer: Posterior) -> str:
    """Return the stated group, or two in order, with their probability."""
    stated = answer.stated_groups
    total = percent(sum(answer.groups[group] for group in stated))
    words = ", then ".join(TITLES[group] for group in stated)
    return f"{words} ({'together ' if len(stated) > 1 else ''}{total})"


def summary(found: Diagnosis) -> str:
    """Return the answer in a few lines: what it is, how large, what to do, what is left open."""
    answer = found.posterior
    first = found.simulator.remark if found.simulator is not None else ""
    lines = [first, headline(found), size_text(found), found.correction]
    if answer.detected:
        if answer.leading_group != UNKNOWN and answer.name is not None:
            lines.append(f"Look first at {groups_text(answer)}.")
        lines.append(answer.check_first)
        if answer.leading_group != UNKNOWN and answer.name is None:
            group = answer.stated_groups[0]
            members = [name for name in answer.effects if GROUP_OF[name] == group][:3]
            lines.append(f"No single effect stands out there; the likeliest: {', '.join(members)}.")
    else:
        lines.append(visible_text(found))
    if not found.has_references:
        lines.append(
            "No reference log was given: the model itself and the error that its file states count"
            " as healthy. Give logs without the fault with --reference."
        )
    return "\n".join(line for line in lines if line)


def size_text(found: Diagnosis) -> str:
    """Return the errors in volts, and what the cause closes of the gap."""
    healthy = "a healthy log has" if found.has_references else "the model file states"
    what = "model" if found.simulator is None else "simulator"
    text = f"The {what} misses the voltage by {significant(found.baseline_rmse_v, 2, 'V')} RMS"
    if found.has_references and found.baseline_rmse_v > MISFIT * found.expected_rmse_v:
        expected = significant(found.expected_rmse_v, 2, "V")
        text += f" ({expected} with what the references show of this pack)"
    text += f"; {healthy} {significant(found.healthy_rmse_v, 2, 'V')}."
    if found.accepted is not None:
        all_rows = all(log.judged.all() for log in found.log_errors)
        text += f" With {found.accepted}: {significant(found.extended_rmse_v, 2, 'V')}"
        text += "." if all_rows else ", on the rows that it can change."
    return text


def visible_text(found: Diagnosis) -> str:
    """Return from which size the most usual effects would have been seen."""
    sizes = [
        f"{item['effect']} from {significant(item['size'], 2)} {item['unit']}"
        for item in found.visible_from
        if item["size"] is not None and item["effect"] in COMMON
    ]
    return f"These logs would have shown {', '.join(sizes)}." if sizes else ""


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
    errors = found.reference_rmse_v
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

"""What a user reads of a diagnosis: three lines, and what limits them."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from html import escape
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from cangauge._text import counted, number, significant
from cangauge.diagnosis.posterior import ALIKE, Posterior
from cangauge.diagnosis.rows import COVER_PCT
from cangauge.diagnosis.where import clause
from cangauge.logs.gaps import bridge_s

if TYPE_CHECKING:
    from cangauge.diagnosis.diagnose import Diagnosis
    from cangauge.diagnosis.evidence import Evidence
    from cangauge.diagnosis.model_check import ModelCheck
    from cangauge.model.effects.base import Pack

FAULT: Final[Mapping[str, Mapping[str, Any]]] = tomllib.loads(
    files("cangauge.diagnosis").joinpath("words.toml").read_text("utf-8")
)
"""Fault → its words; see `words.toml`."""

LEAST_REFERENCES: Final = 3
"""References from which on probabilities are reliable."""
SHOWN_VISIBLE: Final = ("voltage_offset", "current_offset", "resistance_growth")
"""Effects whose smallest visible size is told where there is no gap: what a user suspects first."""


def shown_unit(unit: str) -> str:
    """Return the unit of a parameter as a reader sees it."""
    return "" if unit == "1" else unit.replace("ohm", "Ω")


def percent(probability: float) -> str:
    """Return a probability in per cent, never 0 or 100."""
    if probability < 0.005:
        return "under 1 %"
    return "over 99 %" if probability > 0.995 else f"{100.0 * probability:.0f} %"


def volts(value: float) -> str:
    """Return a voltage error with two significant digits."""
    return significant(value, 2, "V")


def sentence(found: Diagnosis, evidence: Evidence, pack: Pack) -> str:
    """Return what an effect does to a pack, how much and how sure, without the sentence's end."""
    shape, size, half = evidence.shape, evidence.size, evidence.half_width
    values, words = shape.values(size), FAULT[shape.effect.fault]
    key = f"{shape.effect.id}_late" if values.get("late") else shape.effect.id
    if key not in words["effects"]:
        return f"{words['title'].capitalize()}: {key.replace('_', ' ')}"
    low, high = size - half, size + half
    now, least, most = (pack.capacity_ah * (1.0 + each / 100.0) for each in (size, low, high))

    def shown(factor: float, unit: str) -> str:
        """Return the absolute size with its interval; the bracket stays open."""
        value, wide = factor * abs(size), factor * half
        digits = 2 if value < 100.0 else 3
        least = significant(max(value - wide, 0.0), digits)
        most = significant(value + wide, digits, unit)
        return f"{significant(value, digits, unit)} ({least}–{most}"

    start_pct = found.rows[0].trace.start_pct
    fields = {
        "log": "The log" if len(found.rows) == 1 else "The first log",
        "size": shown(1.0, shown_unit(shape.unit)),
        "percent": shown(100.0, "%"),
        "milli": shown(1e3, f"m{shape.unit}"),
        "at_pack_v": shown(pack.voltage_v / 100.0, "V"),
        "at_pack_ohm": shown(pack.resistance_ohm, "Ω"),
        "of_voltage": number(100.0 * abs(size) / pack.voltage_v, 1, "%"),
        "of_gain": number(abs(size), 1, "%"),
        "of_share": number(100.0 * abs(size), 0, "%"),
        "end": shape.name.removeprefix("at_"),
        "stated_pct": start_pct,
        "true_pct": start_pct + size,
        "pct": f"({start_pct + low:.0f}–{start_pct + high:.0f} %)",
        "true_ah": significant(now, 3, "Ah"),
        "ah": f"({significant(least, 3)}–{significant(most, 3, 'Ah')})",
        "assumed_ah": significant(pack.capacity_ah, 3, "Ah"),
    }
    minutes = {f"{each[:-2]}_min": v / 60.0 for each, v in values.items() if each.endswith("_s")}
    text = re.sub(r"\[(.*?)\|(.*?)\]", r"\1" if size > 0.0 else r"\2", words["effects"][key])
    return text.format_map(values | minutes | fields)


def answer(found: Diagnosis) -> str:
    """Return the answer in three lines: what, how far and where, what to do."""
    lines = [_what(found), _how_far(found), _to_do(found)]
    if found.simulator is not None:
        if found.simulator.remark:  # it says itself what to do
            lines = [found.simulator.remark, *(lines if found.posterior.stated else lines[:2])]
        if found.correction is not None:
            lines.append(_simulator_change(found.correction.evidence))
    check = found.model_check
    if check is not None and not check.describes:
        lines = [*_model_lines(found, check), f"These logs: {_lower(lines[0])}", *lines[1:]]
    return "\n".join(lines)


def _simulator_change(evidence: Evidence) -> str:
    """Return what to change in a simulator's inputs, or in the measurement, in one sentence."""
    effect, values = evidence.shape.effect.id, evidence.shape.values(evidence.size)
    factor = 1.0 + values.get("gain_pct", 0.0) / 100.0
    change = FAULT[evidence.fault].get("simulator", {}).get(effect, "add the voltage of {effect}")
    return f"To correct the simulator: {change.format(effect=effect, factor=factor, **values)}."


def _model_lines(found: Diagnosis, check: ModelCheck) -> list[str]:
    """Return what the model misses on the healthy logs, and what to do about it."""
    error_v, name = volts(check.references_rmse_v), "simulator" if found.simulator else "model"
    given = found.model.extended_model().pack
    missed = "; ".join(_lower(sentence(found, each.evidence, given)) for each in check.missed)
    what = f"to it they look as if {missed}" if missed else "none of the nine faults explains it"
    among = f"{volts(check.among_themselves_rmse_v)} among themselves"
    lines = [f"The {name} misses the healthy logs by {error_v} ({among}): {what}."]
    if missed:
        lines.append(f"Error {error_v} → {volts(check.missed[-1].rmse_v)} with this corrected.")
    if found.simulator:
        return [*lines, "Correct the simulator on healthy logs first."]
    path = found.correction_path if found.is_written else None
    better = f", or take {path}" if path else ""
    return [*lines, f"Fit the model again on healthy logs{better}."]


def _lower(text: str) -> str:
    return text[0].lower() + text[1:]


def _title(fault: str) -> str:
    return str(FAULT[fault]["title"])


def _what(found: Diagnosis) -> str:
    """Return the faults that are named, and how likely they are."""
    posterior = found.posterior
    none = f"P(no fault) {percent(posterior.none)}"
    if posterior.level == "none":
        rest = f", {_likeliest(posterior)}" if posterior.leans_to_fault else ""
        return f"No significant gap beyond that of healthy logs: {none}{rest}."
    sure = "" if posterior.level == "gap" else f" Likely, not certain: {none}."
    if not posterior.stated:
        unknown = percent(posterior.unknown)
        return f"There is a gap that none of the nine faults explains (likelihood {unknown}).{sure}"
    first, *others = (
        sentence(found, found.best_of(fault), found.healthy.model.pack) for fault in posterior.named
    )
    if not posterior.is_sure:
        is_likelier_than_not = posterior.within_gap(posterior.stated[0]) > 0.5
        begin = "Most likely" if is_likelier_than_not else "The cause is not clear. Most probable:"
        first = f"{begin} {_lower(first)}"
    what = ", or ".join([first, *map(_lower, others)])
    return f"{what}. Likelihood: {_likeliest(posterior)}{_together(posterior)}.{sure}"


def _together(posterior: Posterior) -> str:
    """Return what is off where only a group of faults is sure, as the end of a sentence."""
    if posterior.alike is None:
        return ""
    faults = ALIKE[posterior.alike]
    *others, last = map(_title, faults)
    together = percent(sum(posterior.faults[fault] for fault in faults))
    return f"; the {posterior.alike} ({', '.join(others)} or {last}) {together}"


def _likeliest(posterior: Posterior) -> str:
    """Return up to three faults of 2 % or more, or named, with their probabilities, in order."""
    shown = [
        f"{_title(fault)} {percent(p)}"
        for fault, p in posterior.faults.items()
        if p >= 0.02 or fault in posterior.named
    ]
    return ", ".join(shown[:3])


def _how_far(found: Diagnosis) -> str:
    """Return the error as it is, corrected, and of healthy logs; and where it lies."""
    whose = "healthy logs of this pack have" if found.has_references else "the model file states"
    where, error = clause(found.where), volts(found.baseline_rmse_v)
    if found.is_corrected:
        error += f" → {volts(found.extended_rmse_v)} with {_corrected(found)}"
    place = f"{where[0].upper()}{where[1:]}.{_uncertain(found)}"
    return f"Error {error}; {whose} {volts(found.healthy_rmse_v)}. {place}"


def _uncertain(found: Diagnosis) -> str:
    """Return that the model knows the healthy logs badly, where no fault of it is sure."""
    check = found.model_check
    if check is None or not (check.describes and check.is_uncertain):
        return ""
    return (
        f" The model itself is uncertain here: it misses the healthy logs by"
        f" {volts(check.references_rmse_v)}; fit it again with them."
    )


def _corrected(found: Diagnosis) -> str:
    """Return what a smaller error is owed to; and the error with the other of two faults."""
    if found.correction is None:
        return "the model corrected"
    mine, stated = found.correction.evidence.fault, found.posterior.stated
    what = "this" if len(stated) == 1 else f"the {_title(mine)}"
    others = "".join(
        f" ({volts(found.corrections[fault].rmse_v)} with the {_title(fault)})"
        for fault in stated
        if fault != mine
    )
    return f"{'the model and ' if found.lacks else ''}{what} corrected{others}"


def _to_do(found: Diagnosis) -> str:
    if found.posterior.level == "none":
        seen = [
            f"{significant(size, 2, shown_unit(unit))} ({name.replace('_', ' ')})"
            for name in SHOWN_VISIBLE
            for size, unit in [found.visible_from(name)]
            if size is not None
        ]
        shown = f" These logs would have shown {', '.join(seen)}." if seen else ""
        return f"{found.check_first}{shown}"
    model = "A corrected model is at hand (--extended MODEL, `extended_model()`)."
    if found.why_not is not None:
        model = f"No correction: {found.why_not}."
    elif found.correction_path:
        model = f"Corrected model: {found.correction_path}"
    return f"{found.check_first} {model}"


def caveats(found: Diagnosis) -> list[str]:
    """Return what limits the answer, a sentence each."""
    remarks = list(found.remarks)
    number_of = len(found.references)
    if 0 < number_of < LEAST_REFERENCES:
        remarks.append(
            f"{counted(number_of, 'reference')} cannot show how much healthy logs differ: give"
            f" {LEAST_REFERENCES} or more."
        )
    if not found.has_references:
        remarks.append("Without references the error that the model file states counts as normal.")
    for log, rows in zip(found.logs, found.rows, strict=True):
        name, steps_s = log.name, np.diff(log.time_s)
        interval_s, part = float(np.median(steps_s)), 1.0 - rows.kept.size / rows.trace.rows.size
        if found.has_references and part > 0.05:
            remarks.append(
                f"{percent(part)} of {name} lies at SoC that no reference visits (within"
                f" {COVER_PCT:.0f} %) and is left out."
            )
        if interval_s >= 10.0:  # the shortest memory of both equations
            remarks.append(
                f"{name} has a row every {number(interval_s, 0, 's')}: what the current did"
                " between them is not known, and may look like a fault of clock, resistance or"
                " current."
            )
        if log.duration_s < 600.0:
            minutes = number(log.duration_s / 60.0, 0, "min")
            remarks.append(f"{name} lasts {minutes}: slow effects hardly develop in it.")
        if steps_s.max() > bridge_s(log.time_s):
            remarks.append(f"{name} has gaps; charge that flowed in them is not counted.")
    return [*remarks, "A fault is a signature at the terminals, not proof of a mechanism."]


def fault_rows(found: Diagnosis) -> tuple[list[str], list[list[str]]]:
    """Return headings and rows: each fault with its probability, size and remaining error."""
    rows = []
    for fault, p in found.posterior.faults.items():
        best = found.best_of(fault)
        value, half = best.shape.neutral + best.size, best.half_width
        ends = f"{significant(value - half, 2)} … {significant(value + half, 2)}"
        size = f"{significant(value, 2, shown_unit(best.shape.unit))} ({ends})"
        effect, left = best.shape.effect.id.replace("_", " "), found.corrections[fault].rmse_v
        rows.append([_title(fault), percent(p), effect, size, volts(left)])
    return ["fault", "probability", "best shape", "size (95 %)", "error with it"], rows


def plan_text(found: Diagnosis) -> str:
    """Return what the next measurement is expected to bring, in a sentence."""
    if found.next_step is None:
        return "Next step: none; there is no fault to settle."
    fault, before, after = found.next_step
    return (
        f"Next step: {FAULT[fault]['measurement']}. The probability of the true fault would rise"
        f" from {percent(before)} to {percent(after)}."
    )


def html(found: Diagnosis) -> str:
    """Return the answer for a notebook."""
    return "".join(f"<p>{escape(line)}</p>" for line in answer(found).splitlines())

"""What a user reads of a diagnosis: three lines, and what limits them."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from cangauge._text import counted, number, significant
from cangauge.diagnosis.posterior import ALIKE, Posterior
from cangauge.diagnosis.rows import COVER_PCT, Trace
from cangauge.diagnosis.where import rms, where_sentence
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


def sentence(evidence: Evidence, pack: Pack, logs: Sequence[Trace]) -> str:
    """Return what an effect in logs does to a pack, how much and how sure, without the end."""
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

    start_pct = logs[0].start_pct
    is_one, begins = len(logs) == 1, logs[evidence.shapes.index(shape)]
    fields = {
        "log": "The log" if is_one else "The first log",
        "of_log": "" if is_one else f" of {begins.log.name}",
        "size": shown(1.0, shown_unit(shape.unit)),
        "percent": shown(100.0, "%"),
        "milli": shown(1e3, f"m{shape.unit}"),
        "at_pack_v": shown(pack.voltage_v / 100.0, "V"),
        "at_pack_ohm": shown(pack.resistance_ohm, "Ω"),
        "of_voltage": number(100.0 * abs(size) / pack.voltage_v, 1, "%"),
        "of_gain": number(abs(size), 1, "%"),
        "of_share": number(100.0 * abs(size), 0, "%"),
        "end": shape.amplitude.name.removeprefix("at_"),
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
        if found.simulator:  # it says itself what to do
            lines = [found.simulator, *(lines if found.posterior.stated else lines[:2])]
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
    error_v, name = (
        volts(check.references_rmse_v),
        "model" if found.simulator is None else "simulator",
    )
    given = found.model.extended_model().pack
    references = found.healthy.references
    missed = "; ".join(_lower(sentence(each.evidence, given, references)) for each in check.missed)
    what = "none of the nine faults explains it"
    if missed:
        what = f"compared with the {name}, {missed}"
    among = f"they miss each other by {volts(check.among_themselves_rmse_v)}"
    lines = [f"The {name} misses the healthy logs by {error_v} ({among}): {what}."]
    if missed:
        lines.append(f"Error {error_v} → {volts(check.missed[-1].rmse_v)} with this corrected.")
    if found.simulator is not None:
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
        if not posterior.leans_to_fault:
            return f"No significant gap beyond that of healthy logs: {none}."
        but = "but a fault is likelier than none"
        return f"No significant gap, {but}: {none}, {_likeliest(posterior)}."
    sure = "" if posterior.level == "gap" else f" A fault is likely, not certain: {none}."
    if not posterior.stated:
        unknown = percent(posterior.unknown)
        return f"There is a gap that none of the nine faults explains (likelihood {unknown}).{sure}"
    pack, logs = found.healthy.model.pack, [rows.trace for rows in found.rows]
    first, *others = (sentence(found.best_of(fault), pack, logs) for fault in posterior.named)
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
    has_references = found.healthy.references
    whose = "healthy logs of this pack have" if has_references else "the model file states"
    error = volts(found.baseline_rmse_v)
    if found.is_corrected:
        error += f" → {volts(found.extended_rmse_v)} with {_corrected(found)}"
    place = where_sentence(found.where)
    return f"Error {error}; {whose} {volts(found.healthy_rmse_v)}. {place}{_uncertain(found)}"


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
    """Return what to do first, and what there is of a corrected model."""
    if found.posterior.level == "none":
        return f"{found.check_first}{_would_have_shown(found)}"
    model = "--extended FILE.json saves the corrected model (in Python: `extended_model.save`)."
    if not found.is_written:
        return f"{found.check_first} No correction: {found.why_not}."
    if found.correction_path:
        model = f"Corrected model: {found.correction_path}"
    if refusal := _refusal(found):  # the model is corrected for the healthy logs alone
        model += f"\nIt does not correct the fault of these logs: {refusal}."
    return f"{found.check_first} {model}"


def _would_have_shown(found: Diagnosis) -> str:
    """Return the smallest sizes of common effects that would have been visible, in a sentence."""
    seen = [
        f"a {name.replace('_', ' ')} of {significant(size, 2, shown_unit(unit))}"
        for name in SHOWN_VISIBLE
        for size, unit in [found.visible_from(name)]
        if size is not None
    ]
    return f" These logs would have shown {', '.join(seen)}." if seen else ""


def check_first(found: Diagnosis) -> str:
    """Return what to do first, in a sentence."""
    posterior = found.posterior
    if found.next_step is not None:
        measured, stated = found.next_step[0], posterior.stated
        instruction = str(FAULT[measured]["instruction"])
        if measured == stated[0]:
            return instruction
        first, second = map(_title, stated)
        return f"To tell the {first} from the {second}: {_lower(instruction)}"
    if posterior.level != "none":
        return (
            "Check that the references are of this pack and without the fault; then look where the"
            " error lies."
        )
    if posterior.leans_to_fault:
        return "Before any repair, diagnose one more log like these together with them."
    return "Nothing to do."


def why_not(found: Diagnosis) -> str | None:
    """Return why the fault of these logs is not corrected; None where it is."""
    why = _refusal(found) if found.posterior.stated else "no fault is stated"
    if why is None or not found.is_written:
        return why
    return f"the model is corrected for the healthy logs alone: {why}"


def _refusal(found: Diagnosis) -> str | None:
    """Return why the stated fault is not written into a model; None where it is, or without one."""
    if found.correction is not None:
        is_of_log = found.correction.is_of_log
        start = "a wrong start belongs to these logs and not to the model: pass --initial-soc"
        return start if is_of_log else None
    tried = [found.corrections[fault] for fault in found.posterior.stated]
    if not tried:
        return None
    better = next((each for each in tried if each.is_better), None)
    refused = better or tried[0]
    with_it = f"with the {_title(refused.evidence.fault)} corrected"
    if better is not None:
        before, after = (number(x, 2, "%") for x in found.soc_mae_pct(better))
        return f"{with_it}, the SoC error of left-out rows grows ({before} → {after})"
    change = f"{volts(rms(refused.errors.before_v))} → {volts(refused.rmse_v)}"
    return f"{with_it}, the voltage error of left-out rows does not shrink ({change})"


def caveats(found: Diagnosis) -> list[str]:
    """Return what limits the answer, a sentence each."""
    remarks = list(found.remarks)
    number_of = len(found.references)
    if 0 < number_of < LEAST_REFERENCES:
        remarks.append(
            f"{counted(number_of, 'reference')} cannot show how much healthy logs differ: give"
            f" {LEAST_REFERENCES} or more."
        )
    if not found.healthy.references:
        remarks.append("Without references the error that the model file states counts as normal.")
    for log, rows in zip(found.logs, found.rows, strict=True):
        name, steps_s = log.name, np.diff(log.time_s)
        interval_s, part = float(np.median(steps_s)), 1.0 - rows.kept.size / rows.trace.rows.size
        if found.healthy.references and part > 0.05:
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
        value, half = best.parameters[best.shape.amplitude.name].value, best.half_width
        ends = f"{significant(value - half, 2)} … {significant(value + half, 2)}"
        size = f"{significant(value, 2, shown_unit(best.shape.unit))} ({ends})"
        effect, left = best.shape.effect.id.replace("_", " "), found.corrections[fault].rmse_v
        rows.append([_title(fault), percent(p), effect, size, volts(left)])
    return ["fault", "probability", "best shape", "size (95 %)", "error with it"], rows


def plan_text(found: Diagnosis) -> str:
    """Return what the next measurement is expected to bring, in a sentence."""
    if found.next_step is None:
        return f"Next step: {_lower(found.check_first)}"
    fault, before, after = found.next_step
    return (
        f"Next step: {FAULT[fault]['measurement']}. The probability of the true fault would rise"
        f" from {percent(before)} to {percent(after)}."
    )


def html(found: Diagnosis) -> str:
    """Return the answer for a notebook."""
    return "".join(f"<p>{escape(line)}</p>" for line in answer(found).splitlines())

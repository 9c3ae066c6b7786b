"""What a user reads of a diagnosis: three lines, and what limits them."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Final

import numpy as np

from cangauge._text import counted, number, significant
from cangauge.diagnosis.faults import FAULT, shown_unit
from cangauge.diagnosis.posterior import ALIKE, Posterior
from cangauge.diagnosis.rows import COVER_PCT
from cangauge.diagnosis.simulator import correction
from cangauge.diagnosis.where import clause
from cangauge.logs.gaps import bridge_s

if TYPE_CHECKING:
    from cangauge.diagnosis.diagnose import Diagnosis
    from cangauge.diagnosis.model_check import ModelCheck

SLOW_S, SHORT_S = 10.0, 600.0
"""Interval of rows that no longer follow the load, the shortest memory of both equations; and the
duration below which slow effects hardly develop [s]."""
LEAST_REFERENCES: Final = 3
"""References from which on probabilities are reliable."""
SHOWN_FROM, MOST_SHOWN = 0.02, 3
"""Probability from which a sentence lists a fault, and how many it lists."""
SHOWN_VISIBLE: Final = ("voltage_offset", "current_offset", "resistance_growth")
"""Effects whose smallest visible size is told where there is no gap: what a user suspects first."""


def percent(probability: float) -> str:
    """Return a probability in per cent, never 0 or 100."""
    if probability < 0.005:
        return "under 1 %"
    return "over 99 %" if probability > 0.995 else f"{100.0 * probability:.0f} %"


def volts(value: float) -> str:
    """Return a voltage error with two significant digits."""
    return significant(value, 2, "V")


def answer(found: Diagnosis) -> str:
    """Return the answer in three lines: what, how far and where, what to do."""
    lines = [_what(found), _how_far(found), _to_do(found)]
    if found.simulator is not None:
        if found.simulator.remark:  # it says itself what to do
            lines = [found.simulator.remark, *(lines if found.posterior.stated else lines[:2])]
        if found.correction is not None:
            lines.append(correction(found.correction.evidence))
    check = found.model_check
    if check is not None and not check.describes:
        lines = [*_model_lines(found, check), f"These logs: {_lower(lines[0])}", *lines[1:]]
    return "\n".join(lines)


def _model_lines(found: Diagnosis, check: ModelCheck) -> list[str]:
    among = f"{volts(check.among_themselves_rmse_v)} among themselves"
    size = f"{volts(check.references_rmse_v)} ({among})"
    given = found.model.extended_model()
    missed = [_lower(found.sentence(each.evidence, given)) for each in check.missed]
    what = "none of the nine faults explains it"
    if missed:
        what = f"to it they look as if {'; '.join(missed)}"
    name = "model" if found.simulator is None else "simulator"
    lines = [f"The {name} misses the healthy logs by {size}: {what}."]
    if check.missed:
        after = volts(check.missed[-1].rmse_v)
        lines.append(f"Error {volts(check.references_rmse_v)} → {after} with this corrected.")
    if found.simulator is not None:
        return [*lines, "Correct the simulator on healthy logs first."]
    path = found.correction_path
    better = f", or take {path}" if path and found.is_written else ""
    lines.append(f"Fit the model again on healthy logs{better}.")
    return lines


def _lower(text: str) -> str:
    return text[0].lower() + text[1:]


def _what(found: Diagnosis) -> str:
    posterior = found.posterior
    none = f"P(no fault) {percent(posterior.none)}"
    if posterior.level == "none":
        rest = f", {_likeliest(found)}" if posterior.leans_to_fault else ""
        return f"No significant gap beyond that of healthy logs: {none}{rest}."
    sure = "" if posterior.level == "gap" else f" Likely, not certain: {none}."
    if not posterior.stated:
        unknown = percent(posterior.unknown)
        return f"There is a gap that none of the nine faults explains (likelihood {unknown}).{sure}"
    texts = [found.sentence(found.best_of(fault)) for fault in posterior.stated]
    what = ", or ".join([texts[0], *map(_lower, texts[1:])]) + "."
    return f"{what} Likelihood: {_likeliest(found)}{_together(posterior)}.{sure}"


def _together(posterior: Posterior) -> str:
    """Return what is off where only a group of faults is sure, as the end of a sentence."""
    if posterior.alike is None:
        return ""
    faults = ALIKE[posterior.alike]
    *others, last = (FAULT[fault].title for fault in faults)
    together = percent(sum(posterior.faults[fault] for fault in faults))
    return f"; the {posterior.alike} ({', '.join(others)} or {last}) {together}"


def _likeliest(found: Diagnosis) -> str:
    """Return the most probable faults with their probabilities, in order."""
    posterior = found.posterior
    shown = [
        f"{FAULT[fault].title} {percent(p)}"
        for fault, p in posterior.faults.items()
        if p >= SHOWN_FROM or fault in posterior.stated
    ]
    return ", ".join(shown[:MOST_SHOWN])


def _how_far(found: Diagnosis) -> str:
    healthy = f"healthy logs of this pack have {volts(found.healthy_rmse_v)}"
    if not found.has_references:
        healthy = f"the model file states {volts(found.healthy_rmse_v)}"
    where = clause(found.where)
    place = f"{where[0].upper()}{where[1:]}.{_uncertain(found)}"
    before = volts(found.baseline_rmse_v)
    if not found.is_corrected:
        return f"Error {before}; {healthy}. {place}"
    after = f"{volts(found.extended_rmse_v)} with {_corrected(found)} corrected{_other(found)}"
    return f"Error {before} → {after}; {healthy}. {place}"


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
    """Return what a smaller error is owed to."""
    if found.correction is None:
        return "the model"
    what = "this"
    if len(found.posterior.stated) > 1:
        what = f"the {FAULT[found.correction.evidence.fault].title}"
    return f"the model and {what}" if found.lacks else what


def _other(found: Diagnosis) -> str:
    """Return the error with the other of two stated faults corrected."""
    return "".join(
        f" ({volts(found.corrections[fault].rmse_v)} with the {FAULT[fault].title})"
        for fault in found.posterior.stated
        if found.correction is not None and fault != found.correction.evidence.fault
    )


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
    text = found.check_first
    if found.why_not is not None:
        return f"{text} No correction: {found.why_not}."
    if found.correction_path:
        return f"{text} Corrected model: {found.correction_path}"
    return f"{text} A corrected model is at hand (--extended MODEL, `extended_model()`)."


def caveats(found: Diagnosis) -> list[str]:
    """Return what limits the answer, a sentence each."""
    remarks = list(found.remarks)
    number_of = len(found.references)
    if found.has_references and 0 < number_of < LEAST_REFERENCES:
        remarks.append(
            f"{counted(number_of, 'reference')} cannot show how much healthy logs differ: give"
            f" {LEAST_REFERENCES} or more."
        )
    if not found.has_references:
        remarks.append("Without references the error that the model file states counts as normal.")
    for log, rows in zip(found.logs, found.rows, strict=True):
        part = 1.0 - rows.kept.size / max(rows.trace.rows.size, 1)
        if found.has_references and part > 0.05:
            remarks.append(
                f"{percent(part)} of {log.name} lies at SoC that no reference visits (within"
                f" {COVER_PCT:.0f} %) and is left out."
            )
        interval_s = float(np.median(np.diff(log.time_s)))
        if interval_s >= SLOW_S:
            remarks.append(
                f"{log.name} has a row every {number(interval_s, 0, 's')}: what the current did"
                " between them is not known, and may look like a fault of clock, resistance or"
                " current."
            )
        if log.duration_s < SHORT_S:
            minutes = number(log.duration_s / 60.0, 0, "min")
            remarks.append(f"{log.name} lasts {minutes}: slow effects hardly develop in it.")
        if np.diff(log.time_s).max() > bridge_s(log.time_s):
            remarks.append(f"{log.name} has gaps; charge that flowed in them is not counted.")
    remarks.append("A fault is a signature at the terminals, not proof of a mechanism.")
    return remarks


def fault_rows(found: Diagnosis) -> tuple[list[str], list[list[str]]]:
    """Return headings and rows: each fault with its probability, size and remaining error."""
    rows = [
        [
            FAULT[fault].title,
            percent(p),
            found.best_of(fault).shape.effect.id.replace("_", " "),
            _amount(found, fault),
            volts(found.corrections[fault].rmse_v),
        ]
        for fault, p in found.posterior.faults.items()
    ]
    return ["fault", "probability", "best shape", "size (95 %)", "error with it"], rows


def _amount(found: Diagnosis, fault: str) -> str:
    """Return the amplitude of a fault's best shape with its interval."""
    of = next(item for item in found.best_of(fault).parameters.values() if item.ci is not None)
    low, high = of.ci or (of.value, of.value)
    ends = f"{significant(low, 2)} … {significant(high, 2)}"
    return f"{significant(of.value, 2, shown_unit(of.unit))} ({ends})"


def plan_text(found: Diagnosis) -> str:
    """Return what the next measurement is expected to bring, in a sentence."""
    if found.next_step is None:
        return "Next step: none; there is no fault to settle."
    fault, before, after = found.next_step
    return (
        f"Next step: {FAULT[fault].measurement}. The probability of the true fault would rise from"
        f" {percent(before)} to {percent(after)}."
    )


def html(found: Diagnosis) -> str:
    """Return the answer for a notebook."""
    return "".join(f"<p>{escape(line)}</p>" for line in answer(found).splitlines())

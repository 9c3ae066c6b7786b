"""Rows of tables that terminal and page share: effects of a fit, what a verdict leaves open."""

from __future__ import annotations

from cangauge._formatting import number, significant
from cangauge.diagnosis import LIKELY, NONE, UNKNOWN, Diagnosis
from cangauge.identify.effect_search import FittedEffects
from cangauge.model.effects.library import LIBRARY

# --- Effects of a fit as rows of a table, for the terminal and the report alike

Rows = list[list[str]]


def effect_rows(found: FittedEffects) -> tuple[list[str], Rows]:
    """Return headings and rows: every parameter of every effect with its standard error."""
    rows = [
        [
            effect_id if k == 0 else "",
            item.name,
            significant(item.value, 4),
            "–" if item.std_error is None else significant(item.std_error, 2),
            "" if item.unit == "1" else item.unit.replace("ohm", "Ω"),
        ]
        for effect_id, parameters in found.estimates
        for k, item in enumerate(parameters)
    ]
    return ["<effect", "<parameter", "value", "std. error", "<unit"], rows


def step_rows(found: FittedEffects) -> tuple[list[str], Rows]:
    """Return headings and rows: what was tried in order, and what it was worth held out."""
    rows = [
        [
            step.effect_id,
            step.what,
            significant(step.comparison.before_rmse_v, 4),
            significant(step.comparison.after_rmse_v, 4),
            number(step.comparison.t_value, 1),
            number(step.comparison.needed, 1),
        ]
        for step in found.steps
    ]
    headings = ["<effect", "<", "held out without [V]", "with [V]", "t", "t needed"]
    return headings, rows


# --- What cannot be concluded, said before anything else on the page


def verdict_limit(diagnosis: Diagnosis) -> str:
    """Return what the verdict itself leaves open; "" for a clear cause."""
    verdict = diagnosis.verdict
    if verdict.cause == NONE:
        beside = ""
        if diagnosis.problem.references:
            beside = (
                " beside what the references teach"
                f" ({number(diagnosis.baseline_rmse_v, 2)} V as given,"
                f" {number(diagnosis.extended_rmse_v, 2, 'V')} with that)"
            )
        return (
            f"No cause can be named: what these logs show{beside}, logs without a cause may show"
            f" as well. That does not prove that there is none.{_unseen(diagnosis)}"
        )
    if verdict.cause == UNKNOWN:
        best = verdict.candidates[0].effect_id
        floor = "references" if diagnosis.problem.references else "the model file states"
        return (
            f"No cause can be named: the gap is real ({number(diagnosis.baseline_rmse_v, 2, 'V')},"
            f" {floor} {number(diagnosis.floor_v, 2, 'V')}), but no effect of the library is"
            f" likely enough to be the cause; the best one, {best}, takes"
            f" {100.0 * verdict.explained:.0f} % of it away. The cause is not in the library, or"
            " several act at once, or the model is not of this pack."
        )
    words = []
    if verdict.probability < LIKELY:
        words.append(
            f"{verdict.cause} is the likeliest cause, yet with a probability of only"
            f" {verdict.probability:.2f}: do not act on it alone."
        )
    if verdict.ambiguous_with:
        words.append(
            f"These logs cannot tell {verdict.cause} from {', '.join(verdict.ambiguous_with)}."
            f" What would: {LIBRARY[verdict.cause].separated_by}."
        )
    return " ".join(words)


def _unseen(diagnosis: Diagnosis) -> str:
    names = [str(item["effect"]) for item in diagnosis.observability if item["visible"] == 0.0]
    if not names:
        return " Smaller causes than the last table says would stay unseen."
    return f" These logs would hardly show {', '.join(names)} at any size that physics allows."

"""Effects of a fit as rows of a table, for the terminal and the report alike."""

from __future__ import annotations

from cangauge.identify.effects.fitted import FittedEffects
from cangauge.report.words import number, significant

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

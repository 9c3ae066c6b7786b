"""Tables of a fit as headings and rows of text, for terminal and pages."""

from __future__ import annotations

import math

from cangauge._text import number, significant
from cangauge.identify.effect_search import Selected
from cangauge.identify.fit import Identification

Rows = list[list[str]]


def rounded(value: float, std_error: float | None) -> tuple[str, str]:
    """Return a value rounded to its standard error, and the error with two digits."""
    if not std_error or not math.isfinite(std_error):
        return significant(value, 3), significant(std_error, 2)
    decimals = max(0, 1 - math.floor(math.log10(std_error)))
    return number(value, decimals), significant(std_error, 2)


def effect_rows(result: Identification) -> tuple[list[str], Rows]:
    """Return headings and rows: every parameter of the fitted effects."""
    rows = [
        [
            effect.id if k == 0 else "",
            parameter.name,
            significant(values[parameter.name], 4),
            "" if parameter.unit == "1" else parameter.unit.replace("ohm", "Ω"),
        ]
        for effect, values in result.model.extended_model().effects
        for k, parameter in enumerate(effect.parameters)
    ]
    return ["<effect", "<parameter", "value", "<unit"], rows


def search_rows(found: Selected) -> tuple[list[str], Rows]:
    """Return headings and rows: the steps of the effect search with their left-out errors."""
    rows = [
        [
            step.effect_id,
            step.what,
            significant(step.before_rmse_v, 3),
            significant(step.after_rmse_v, 3),
            number(step.t_value, 1),
        ]
        for step in found.steps
    ]
    return ["<effect", "<step", "left out without [V]", "with [V]", "t"], rows

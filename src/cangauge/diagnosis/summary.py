"""Results as sentences and table rows, shared by terminal and pages; imports no bokeh."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING, Any, Final

from cangauge._text import NONE_KNOWN, number, significant
from cangauge.diagnosis.answer import NONE, UNKNOWN

if TYPE_CHECKING:
    from cangauge.diagnosis.diagnose import Diagnosis
    from cangauge.diagnosis.planner import Plan

Rows = list[list[str]]

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


SHOWN: Final = 5
"""Causes that a terminal and a notebook show."""


def candidate_rows(result: Mapping[str, Any], at_most: int | None = None) -> tuple[list[str], Rows]:
    """Return headings and rows: causes with probability, size and the error that they leave.

    Parameters
    ----------
    result : mapping
        Of `Diagnosis.to_json`.
    at_most : int, optional
        Causes of the library; `none` and `unknown` follow in any case.
    """
    cause = result["cause"]
    rows = [
        [
            _words(each["effect"]),
            number(each["probability"], 2),
            size_text(each),
            number(each["rmse_v"], 2),
        ]
        for each in cause["candidates"][:at_most]
    ]
    rows += [
        [answer, number(cause[f"probability_{answer}"], 2), NONE_KNOWN, NONE_KNOWN]
        for answer in (UNKNOWN, NONE)
    ]
    return ["<cause", "probability", "<size (95 %)", "error left [V]"], rows


def size_text(candidate: Mapping[str, Any]) -> str:
    """Return the sizes of a candidate that have an interval."""
    parts = []
    for name, quantity in candidate["parameters"].items():
        if quantity["ci"] is None:
            continue
        low, high = quantity["ci"]
        unit = "" if quantity["unit"] == "1" else f" {quantity['unit'].replace('ohm', 'Ω')}"
        parts.append(
            f"{_words(name)} {significant(quantity['value'], 3)}"
            f" ({significant(low, 2)} … {significant(high, 2)}){unit}"
        )
    return "; ".join(parts) or NONE_KNOWN


def visible_rows(result: Mapping[str, Any]) -> tuple[list[str], Rows]:
    """Return headings and rows: the smallest size of each cause that would have been seen."""
    rows = [
        [_words(each["effect"]), significant(each["size"], 2, each["unit"])]
        for each in result["visible_from"]
    ]
    return ["<cause", "seen from"], rows


def plan_rows(plan: Plan) -> tuple[list[str], Rows]:
    """Return headings and rows: the possible next steps, best first."""
    rows = [
        [step.name, number(plan.before, 2), number(step.after, 2), f"{step.gain:+.2f}"]
        for step in plan.steps
    ]
    return ["<step", "P(true cause) now", "after", "gain"], rows


def percent(fraction: float) -> str:
    """Return a fraction in percent."""
    return number(100.0 * fraction, 0, "%")


def _words(name: str) -> str:
    return name.replace("_", " ")


def diagnosis_html(found: Diagnosis) -> str:
    """Return a diagnosis as a compact HTML block: verdict, probabilities, limits.

    Parameters
    ----------
    found : Diagnosis
    """
    result = found.to_json(soc_error=False)
    head, rows = candidate_rows(result, SHOWN)
    lines = [
        "".join(f"<{tag} style='text-align:left'>{escape(cell)}</{tag}>" for cell in cells)
        for tag, cells in (("th", [x.removeprefix("<") for x in head]), *(("td", r) for r in rows))
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

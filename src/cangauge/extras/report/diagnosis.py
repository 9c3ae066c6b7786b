"""The page of `cangauge gap`: verdict, what to do, where the gap is, how far it shrinks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from cangauge._files import file_sha256
from cangauge._text import NONE_KNOWN, number, span
from cangauge.diagnosis import NONE, Diagnosis
from cangauge.diagnosis.answer import TITLES
from cangauge.diagnosis.planner import Plan
from cangauge.diagnosis.sentences import (
    EXPLAINED,
    candidate_rows,
    percent,
    plan_rows,
    visible_rows,
)
from cangauge.extras.report.charts import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    Figure,
    Plot,
    TimeFigures,
    bars,
)
from cangauge.extras.report.page import Block, Page, Table, Tile, joined

_AXES: Final = {
    "soc": "state of charge",
    "temperature": "temperature",
    "current": "current (positive: discharge)",
    "rest": "rest and load",
    "time": "time since the start",
    "timescale": "time scale of the error",
}
_SHOWN_SHARE: Final = 0.005
"""Intervals with less of the squared error are left out."""
_TIMESCALES: Final = ("under 10 s", "10 to 100 s", "100 to 1000 s", "over 1000 s")
_SHOWN_CAUSES: Final = 8


def gap_page(found: Diagnosis, model_path: Path | None = None, plan: Plan | None = None) -> Page:
    """Return the page of a diagnosis.

    Parameters
    ----------
    found : Diagnosis
    model_path : Path, optional
        The model's file, to name it by its SHA-256.
    plan : Plan, optional
        The next step.
    """
    result = found.to_json()
    places = _places(result["where"])
    first = places.pop(_widest(result["where"]))
    verdict, *details = found.summary.splitlines()
    next_words = [] if plan is None or not plan.between else [plan.sentence]
    head, causes = candidate_rows(result)
    explained = [[*row, EXPLAINED.get(row[0].replace(" ", "_"), "")] for row in causes]
    signature = "A cause is a signature at the terminals, not proof of a mechanism."
    unseen = f"{NONE_KNOWN}: no physical size would have been seen in these logs."
    names = joined([log.name for log in found.logs])
    return Page(
        title=f"Diagnosis of {names} with model {found.model.name}",
        lead=verdict,
        subtitle=" ".join([*details, *next_words]),
        tiles=_tiles(found),
        sections={"Where and how much": [[first, _shrinks(found)]]},
        folded={
            "The next step": [] if plan is None else _next_step(plan),
            "Every cause: probability and size": [
                Table([*head, "what it means"], explained, signature)
            ],
            "What these logs would have shown": [Table(*visible_rows(result), unseen)],
            "Where else the error lies": [list(places.values())],
            "Error over time": _over_time(found),
            "Logs and references": [_compared(found)],
            "What these logs cannot show": [found.caveats] if found.caveats else [],
        },
        model=found.model,
        model_path=model_path,
        logs=found.logs,
    )


def diagnosis_figure(found: Diagnosis) -> Plot:
    """Return the probabilities of the causes as bars, the likeliest first, for a notebook."""
    answer = found.posterior
    ordered = sorted(answer.probabilities.items(), key=lambda item: -item[1])
    entries = [
        (name, float(probability), BLUE if name == answer.verdict else GREY)
        for name, probability in ordered[:_SHOWN_CAUSES]
    ]
    return bars("", "probability", entries, "").plot


def _tiles(found: Diagnosis) -> list[Tile]:
    answer = found.posterior
    none = f"P(no fault) {percent(answer.probabilities[NONE])}"
    verdict = "found" if answer.detected else "likely" if answer.likely else "not significant"
    tiles = [Tile("Gap", verdict, none)]
    if answer.likely:
        group = answer.leading_group
        probability = f"probability {percent(answer.groups[group])}"
        tiles.append(Tile("Look first at", TITLES[group], probability))
    return [
        *tiles,
        Tile("Model's error", number(found.baseline_rmse_v, 2, "V"), "RMS, these logs"),
        Tile("Error of healthy logs", number(found.healthy_rmse_v, 2, "V"), "RMS, left out"),
    ]


def _shrinks(found: Diagnosis) -> Figure:
    entries = [
        ("model as given", found.baseline_rmse_v, ORANGE),
        ("healthy logs", found.healthy_rmse_v, GREEN),
    ]
    title, caption = "Beside healthy logs", "RMS error of the voltage."
    if found.accepted is not None:
        cause = found.accepted.replace("_", " ")
        entries.insert(1, (f"with {cause}", found.extended_rmse_v, BLUE))
        title = "How far it shrinks"
        caption = "RMS error of the voltage, on rows that did not size the cause."
        if found.closed_fraction is not None:
            closed = percent(found.closed_fraction)
            caption += f" The cause closes {closed} of the squared gap above healthy logs."
    return bars(title, "RMS error", entries, caption, unit="V")


def _shown(where: Sequence[Mapping[str, Any]], axis: str) -> list[Mapping[str, Any]]:
    return [place for place in where if place["axis"] == axis and place["share"] >= _SHOWN_SHARE]


def _widest(where: Sequence[Mapping[str, Any]]) -> str:
    """Return the axis along which the error differs most: its squares over their mean."""
    spread = {}
    for axis in ("soc", "current", "temperature", "time"):
        squares = np.array([place["rmse_v"] ** 2 for place in _shown(where, axis)])
        spread[axis] = float(np.std(squares) / np.mean(squares)) if squares.size else 0.0
    return max(spread, key=lambda axis: spread[axis])


def _places(where: Sequence[Mapping[str, Any]]) -> dict[str, Figure]:
    """Return the error of the model along each axis."""
    figures = {}
    for axis in dict.fromkeys(place["axis"] for place in where):
        shown = _shown(where, axis)
        entries = [(_interval(place), place["rmse_v"], ORANGE) for place in shown]
        largest = max(shown, key=lambda place: place["share"])
        share = percent(largest["share"])
        caption = f"{share} of the squared error lies at {_interval(largest)}."
        title = f"Where: {_AXES.get(axis, axis)}"
        figures[axis] = bars(title, "RMS error of the model", entries, caption, unit="V")
    return figures


def _interval(place: Mapping[str, Any]) -> str:
    low, high = place["range"]
    if place["axis"] == "timescale":
        at = int(np.searchsorted([10.0, 100.0, 1000.0], low, side="right"))
        return _TIMESCALES[at]
    if place["axis"] == "rest":
        return "rest" if low >= 0.5 else "load"
    if place["axis"] == "time":
        return span(low / 60.0, high / 60.0, 0, "min")
    return span(low, high, 0, place["unit"])


def _next_step(plan: Plan) -> list[Block]:
    note = "Optimistic: it assumes that the pack behaves as the references' model."
    return [plan.sentence, Table(*plan_rows(plan), note)]


def _compared(found: Diagnosis) -> Table:
    both = (("log", found.logs), ("reference", found.references))
    entries = [
        {
            "": role,
            "name": log.name,
            "duration [min]": number(log.duration_s / 60.0, 0),
            "temperature [°C]": span(log.temperature_c.min(), log.temperature_c.max(), 0),
            "SHA-256": (file_sha256(log.source) or NONE_KNOWN)[:12],
        }
        for role, logs in both
        for log in logs
    ]
    return Table.of(entries)


def _over_time(found: Diagnosis) -> list[Block]:
    """Return the figures of the errors, before and after, and of the current."""
    errors, logs = found.log_errors, found.logs
    time = TimeFigures([log.time_s for log in logs], [log.name for log in logs])
    title, caption = "Measured minus modelled voltage", "At 1 Hz, as the model is identified."
    error = time.figure(title, "measured − model [V]", caption, height=260, names=True)
    for name, color, values in (
        ("model as given", ORANGE, [log.before_v for log in errors]),
        ("with the cause", BLUE, [log.after_v for log in errors]),
    ):
        pieces = list(zip((log.time_s for log in errors), values, strict=True))
        time.line(error, name, pieces, color, line_width=1.0, line_alpha=0.85)
    error.mark("width", 0.0)
    caption = "Positive current discharges the pack."
    current = time.figure("Current", "current [A]", caption, height=160)
    pieces = [(log.time_s, log.current_a) for log in errors]
    return [error, time.line(current, "current", pieces, GREY, line_width=1.0)]

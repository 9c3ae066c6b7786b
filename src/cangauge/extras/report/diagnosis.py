"""The page of `cangauge gap`: verdict, what to do, where the gap is, how far it shrinks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

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
    Pen,
    TimeFigures,
    add_zero,
    bars,
)
from cangauge.extras.report.page import (
    Beside,
    Block,
    Bullets,
    Figure,
    InputFile,
    Page,
    Paragraph,
    Section,
    Table,
    Tile,
    joined,
    reconstruction_banners,
    render,
)

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


def gap_report(found: Diagnosis, model_path: Path | None = None, plan: Plan | None = None) -> str:
    """Return the diagnosis as one self-contained HTML page.

    Parameters
    ----------
    found : Diagnosis
    model_path : Path, optional
        The model's file, to name it by its SHA-256.
    plan : Plan, optional
        The next step.
    """
    return render(gap_page(found, InputFile.of_model(found.model, model_path), plan))


def gap_page(found: Diagnosis, model: InputFile | None = None, plan: Plan | None = None) -> Page:
    """Return the report's content (see `gap_report`); `figures` holds the bokeh figures."""
    result = found.to_json()
    places = _places(result["where"])
    first = _widest(result["where"])
    others = [figure for axis, figure in places.items() if axis != first]
    verdict, *details = found.summary.splitlines()
    next_words = [] if plan is None or not plan.between else [plan.sentence]
    folded: dict[str, list[Block]] = {
        "Every cause: probability and size": [_causes(result)],
        "What these logs would have shown": [_visible(result)],
        "Where else the error lies": [Beside(others)],
        "Error over time": list(_over_time(found)),
        "Logs and references": [_compared(found)],
        **({"What these logs cannot show": [Bullets(found.caveats)]} if found.caveats else {}),
    }
    if plan is not None:
        folded = {"The next step": _next_step(plan), **folded}
    title = f"Diagnosis of {joined([log.name for log in found.logs])}"
    return Page(
        title=title if model is None else f"{title} with model {model.name}",
        lead=verdict,
        subtitle=" ".join([*details, *next_words]),
        tiles=_tiles(found),
        sections=[
            Section("Where and how much", [Beside([places[first], _shrinks(found)])]),
            *(Section(heading, blocks, is_folded=True) for heading, blocks in folded.items()),
        ],
        inputs=[
            *([] if model is None else [model]),
            *(InputFile.of_path("log", log.name, log.source) for log in found.logs),
        ],
        banners=reconstruction_banners(
            *(text for log in found.logs for text in (log.name, log.source))
        ),
    )


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
    return Figure(title, bars("RMS error", "V", entries, decimals=2), caption)


def _widest(where: Sequence[Mapping[str, Any]]) -> str:
    """Return the axis along which the error differs most: its squares over their mean."""
    spread = {}
    for axis in ("soc", "current", "temperature", "time"):
        mine = [each for each in where if each["axis"] == axis]
        rms_v = np.array([each["rmse_v"] for each in mine if each["share"] >= _SHOWN_SHARE])
        spread[axis] = float(np.std(rms_v**2) / np.mean(rms_v**2)) if rms_v.size else 0.0
    return max(spread, key=lambda axis: spread[axis])


def _places(where: Sequence[Mapping[str, Any]]) -> dict[str, Figure]:
    figures = {}
    for axis in dict.fromkeys(each["axis"] for each in where):
        mine = [each for each in where if each["axis"] == axis and each["share"] >= _SHOWN_SHARE]
        entries = [(_interval(each), each["rmse_v"], ORANGE) for each in mine]
        figures[axis] = Figure(
            f"Where: {_AXES.get(axis, axis)}",
            bars("RMS error of the model", "V", entries, decimals=2),
            _place_caption(mine),
        )
    return figures


def _place_caption(places: Sequence[Mapping[str, Any]]) -> str:
    most = max(places, key=lambda each: each["share"])
    return f"{percent(most['share'])} of the squared error lies at {_interval(most)}."


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


def _causes(result: Mapping[str, Any]) -> Table:
    headings, rows = candidate_rows(result)
    return Table(
        [*headings, "what it means"],
        [[*row, EXPLAINED.get(row[0].replace(" ", "_"), "")] for row in rows],
        note="A cause is a signature at the terminals, not proof of a mechanism.",
    )


def _visible(result: Mapping[str, Any]) -> Table:
    headings, rows = visible_rows(result)
    return Table(
        headings,
        rows,
        note=f"{NONE_KNOWN}: no physical size would have been seen in these logs.",
    )


def _next_step(plan: Plan) -> list[Block]:
    headings, rows = plan_rows(plan)
    return [
        Paragraph(plan.sentence),
        Table(
            headings,
            rows,
            note="Optimistic: it assumes that the pack behaves as the references' model.",
        ),
    ]


def _compared(found: Diagnosis) -> Table:
    rows = []
    for role, logs in (("log", found.logs), ("reference", found.references)):
        for log in logs:
            file = InputFile.of_path(role, log.name, log.source)
            rows.append(
                [
                    role,
                    log.name,
                    number(log.duration_s / 60.0, 0),
                    span(float(log.temperature_c.min()), float(log.temperature_c.max()), 0),
                    "–" if file.sha256 is None else file.sha256[:12],
                ]
            )
    return Table(["", "name", "duration [min]", "temperature [°C]", "SHA-256"], rows)


def _over_time(found: Diagnosis) -> tuple[Figure, Figure]:
    """Return the figures of the errors, before and after, and of the current."""
    errors, time = found.log_errors, TimeFigures(found.logs)
    plot = time.plot("measured − model", "V", height=260, names=True)
    rows_s = [log.time_s for log in errors]
    for name, color, values in (
        ("model as given", ORANGE, [log.before_v for log in errors]),
        ("with the cause", BLUE, [log.after_v for log in errors]),
    ):
        pieces = list(zip(rows_s, values, strict=True))
        time.line(plot, name, pieces, Pen(color, width=1.0, alpha=0.85))
    add_zero(plot)
    current = time.plot("current", "A", height=160)
    pieces = [(log.time_s, log.current_a) for log in errors]
    time.line(current, "current", pieces, Pen(GREY, width=1.0, in_legend=False))
    return (
        Figure("Measured minus modelled voltage", plot, "At 1 Hz, as the model is identified."),
        Figure("Current", current, "Positive current discharges the pack."),
    )

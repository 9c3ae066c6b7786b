"""The page of `cangauge gap`: the answer, where the gap is, how far it shrinks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any, Final

from cangauge._files import file_sha256
from cangauge._text import NONE_KNOWN, number, span
from cangauge.diagnosis import Diagnosis
from cangauge.diagnosis.faults import FAULT
from cangauge.diagnosis.text import fault_rows, percent, plan_text
from cangauge.diagnosis.where import stands_out
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
    "rest": "time since a rest",
    "time": "time since the start",
}


def gap_page(found: Diagnosis, model_path: Path | None = None) -> Page:
    """Return the page of a diagnosis.

    Parameters
    ----------
    found : Diagnosis
    model_path : Path, optional
        The model's file, to name it by its SHA-256.
    """
    places = _places(found.where)
    first = places.pop(_widest(found.where)) if places else None
    answer, *details = found.summary.splitlines()
    names = joined([log.name for log in found.logs])
    shown: list[Block] = [[_shrinks(found)] if first is None else [first, _shrinks(found)]]
    return Page(
        title=f"Diagnosis of {names} with model {found.model.name}",
        lead=answer,
        subtitle=" ".join(details),
        tiles=_tiles(found),
        sections={"Where and how far": shown},
        folded={
            "Every fault: probability and size": [Table(*fault_rows(found), plan_text(found))],
            "Where else the error lies": [list(places.values())],
            "Error over time": _over_time(found),
            "Logs and references": [_compared(found)],
            "What limits this answer": [found.caveats],
        },
        model=found.model,
        model_path=model_path,
        logs=found.logs,
    )


def diagnosis_figure(found: Diagnosis) -> Plot:
    """Return the probabilities of the faults as bars, the likeliest first, for a notebook."""
    answer = found.posterior
    entries = [
        (FAULT[fault].title, p, BLUE if fault in answer.stated else GREY)
        for fault, p in answer.faults.items()
    ]
    entries += [("no fault", answer.none, GREEN), ("none of these", answer.unknown, GREY)]
    return bars("", "probability", entries, "").plot


def _tiles(found: Diagnosis) -> list[Tile]:
    answer = found.posterior
    verdict = {"gap": "found", "likely": "likely", "none": "not significant"}[answer.level]
    tiles = [Tile("Gap", verdict, f"P(no fault) {percent(answer.none)}")]
    if answer.stated:
        each_p = " or ".join(percent(answer.faults[fault]) for fault in answer.stated)
        p = f"probability {each_p}"
        tiles.append(Tile("Fault", " or ".join(FAULT[each].title for each in answer.stated), p))
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
    if found.is_corrected:
        entries.insert(1, ("corrected", found.extended_rmse_v, BLUE))
        title = "How far it shrinks"
        left_out = "the log left out" if len(found.logs) > 1 else "rows that did not size it"
        caption = f"RMS error of the voltage, corrected on {left_out}."
        closed, _ = found.closed
        if closed is not None:
            caption += f" It closes {percent(closed)} of the squared gap above healthy logs."
    if found.soc_errors_pct is not None:
        before, after = (number(each, 2, "%") for each in found.soc_errors_pct)
        caption += f" SoC error, start withheld: {before}, corrected {after}."
    return bars(title, "RMS error", entries, caption, unit="V")


def _widest(where: Sequence[Mapping[str, Any]]) -> str:
    """Return the axis with the largest excess that is certain."""
    excesses = [place["ci"][0] for place in where]
    return str(where[excesses.index(max(excesses))]["axis"])


def _places(where: Sequence[Mapping[str, Any]]) -> dict[str, Figure]:
    """Return the error of the model along each axis."""
    figures = {}
    for axis in dict.fromkeys(place["axis"] for place in where):
        shown = [place for place in where if place["axis"] == axis]
        entries = [(_interval(place), place["rmse_v"], ORANGE) for place in shown]
        largest = max(shown, key=itemgetter("excess"))
        caption = "No interval stands out from the others."
        if stands_out(largest):
            times = number(largest["excess"], 1)
            caption = f"At {_interval(largest)} it is {times} times that of all rows."
        title = f"Where: {_AXES.get(axis, axis)}"
        figures[axis] = bars(title, "RMS error of the model", entries, caption, unit="V")
    return figures


def _interval(place: Mapping[str, Any]) -> str:
    low, high = place["range"]
    if place["axis"] == "time":
        return span(low / 60.0, high / 60.0, 0, "min")
    return span(low, high, 0, place["unit"])


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
        ("corrected", BLUE, [log.after_v for log in errors]),
    ):
        pieces = list(zip((log.time_s for log in errors), values, strict=True))
        time.line(error, name, pieces, color, line_width=1.0, line_alpha=0.85)
    error.mark("width", 0.0)
    caption = "Positive current discharges the pack."
    current = time.figure("Current", "current [A]", caption, height=160)
    pieces = [(log.time_s, log.current_a) for log in errors]
    return [error, time.line(current, "current", pieces, GREY, line_width=1.0)]

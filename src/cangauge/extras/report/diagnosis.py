"""The page of `cangauge gap`: the answer, where the gap is, how far it shrinks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any, Final

from cangauge._text import number, span
from cangauge.diagnosis import Diagnosis
from cangauge.diagnosis.text import FAULT, fault_rows, percent, plan_text
from cangauge.diagnosis.where import stands_out, surely
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
from cangauge.extras.report.page import Page

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
    values = {
        "found": found,
        "path": model_path,
        "places": _places(found.where),
        "shrinks": _shrinks(found),
        "over_time": _over_time(found),
        "fault_rows": fault_rows(found),
        "plan": plan_text(found),
        "words": FAULT,
        "percent": percent,
    }
    return Page.of("diagnosis.j2", values)


def diagnosis_figure(found: Diagnosis) -> Plot:
    """Return the probabilities of the faults as bars, the likeliest first, for a notebook."""
    answer = found.posterior
    entries = [
        (FAULT[fault]["title"], p, BLUE if fault in answer.stated else GREY)
        for fault, p in answer.faults.items()
    ]
    entries += [("no fault", answer.none, GREEN), ("none of these", answer.unknown, GREY)]
    return bars("", "probability", entries, "").plot


def _shrinks(found: Diagnosis) -> Figure:
    entries = [
        ("model as given", found.baseline_rmse_v, ORANGE),
        ("healthy logs", found.healthy_rmse_v, GREEN),
    ]
    title, caption = "Beside healthy logs", "RMS error of the voltage."
    if found.is_corrected:
        entries.insert(1, ("corrected", found.extended_rmse_v, BLUE))
        title = "How far it shrinks"
        left_out = "each log" if len(found.logs) > 1 else "each part of the log"
        caption += f" The correction of {left_out} is sized by the others."
        closed, _ = found.closed
        if closed is not None:
            caption += f" It closes {percent(closed)} of the squared gap above healthy logs."
    if found.soc_errors_pct is not None:
        before, after = (number(each, 2, "%") for each in found.soc_errors_pct)
        corrected = f", corrected {after}" if found.is_corrected else ""
        caption += f" Mean SoC error with the start withheld: {before}{corrected}."
    return bars(title, "RMS error", entries, caption, unit="V")


def _places(where: Sequence[Mapping[str, Any]]) -> list[Figure]:
    """Return the error of the model along each axis, that with the surest excess first."""
    figures = {}
    for axis in dict.fromkeys(place["axis"] for place in where):
        shown = [place for place in where if place["axis"] == axis]
        entries = [(_interval(place), place["rmse_v"], ORANGE) for place in shown]
        largest = max(shown, key=itemgetter("excess"))
        caption = "No interval stands out from the others."
        if stands_out(largest):
            times = number(largest["excess"], 1)
            caption = f"At {_interval(largest)} it is {times} times that of all rows."
        title = f"Where: {_AXES[axis]}"
        figures[axis] = bars(title, "RMS error of the model", entries, caption, unit="V")
    if not where:
        return []
    first = figures.pop(max(where, key=surely)["axis"])
    return [first, *figures.values()]


def _interval(place: Mapping[str, Any]) -> str:
    low, high = place["range"]
    if place["axis"] == "time":
        return span(low / 60.0, high / 60.0, 0, "min")
    return span(low, high, 0, place["unit"])


def _over_time(found: Diagnosis) -> list[Figure]:
    """Return the figures of the errors, before and after, and of the current."""
    errors = found.errors.by_log
    axis = [log.time_s - log.time_s[0] for log in found.logs]
    time = TimeFigures(axis, [log.name for log in found.logs])
    error = time.figure(
        "Measured minus modelled voltage",
        "measured − model [V]",
        "At 1 Hz, as the model is identified.",
        {
            "model as given": [(log.time_s, log.before_v) for log in errors],
            "corrected model": [(log.time_s, log.after_v) for log in errors],
        },
        height=260,
    )
    error.mark("width", 0.0)
    caption = "Positive current discharges the pack."
    return [error, time.channel(errors, "current", caption, height=160)]

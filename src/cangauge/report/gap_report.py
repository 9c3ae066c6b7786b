"""The page of `cangauge gap`: how large, where, which effect, how far it shrinks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cangauge.gap.diagnose import Diagnosis, in_words
from cangauge.gap.verdict import NONE, UNKNOWN
from cangauge.gap.where import Place
from cangauge.model.effects.library import LIBRARY
from cangauge.report.bars import bars
from cangauge.report.page import (
    Block,
    Bullets,
    Figure,
    Page,
    Paragraph,
    Section,
    Table,
    Tile,
    reconstruction_banners,
    render,
)
from cangauge.report.words import number, significant, span

SHOWN = 8
LONGEST_S = 1e6
BLUE, GREY = "#1f77b4", "#b0b0b0"
AXIS_WORDS = {
    "soc": "state of charge [%]",
    "temperature": "temperature [°C]",
    "current": "current [A], positive = discharge",
    "rest": "rest (1) or drive (0)",
    "time": "time since the log's start [s]",
    "timescale": "time scale of the error [s]",
}


def gap_report(diagnosis: Diagnosis) -> str:
    """Return the diagnosis as one self-contained HTML page."""
    return render(gap_page(diagnosis))


def gap_page(diagnosis: Diagnosis) -> Page:
    """Return the page of a diagnosis."""
    logs = [terms.prepared.log for terms in diagnosis.settled.diagnosed]
    names = ", ".join(log.name for log in logs)
    return Page(
        title="Gap between model and log",
        subtitle=in_words(diagnosis),
        tiles=_tiles(diagnosis),
        sections=[
            _which(diagnosis),
            _where(diagnosis),
            Section("The worst moments", [_worst(diagnosis)]),
            Section("What these logs can show", _observability(diagnosis)),
            Section("How it was done", [Bullets(_method(diagnosis, names))]),
        ],
        banners=reconstruction_banners(names, *(log.source for log in logs)),
    )


def _tiles(diagnosis: Diagnosis) -> list[Tile]:
    verdict = diagnosis.verdict
    tiles = [
        Tile("Verdict", verdict.cause.replace("_", " "), f"probability {verdict.probability:.2f}"),
        Tile("Error of the model", number(diagnosis.baseline_rmse_v, 2, "V"), "RMS, these logs"),
        Tile("Floor", number(diagnosis.floor_v, 2, "V"), "RMS, reference logs"),
    ]
    if verdict.cause not in {NONE, UNKNOWN}:
        closed = "–" if diagnosis.closed is None else f"{100.0 * diagnosis.closed:.0f} %"
        tiles += [
            Tile("With the effect", number(diagnosis.extended_rmse_v, 2, "V"), "RMS, left out"),
            Tile("Closed", closed, "of the squared gap above the floor"),
        ]
    return tiles


def _which(diagnosis: Diagnosis) -> Section:
    verdict = diagnosis.verdict
    blocks: list[Block] = [Paragraph(_cause_words(diagnosis))]
    ranked = diagnosis.candidates[:SHOWN]
    chances = [
        (str(item["effect"]), 100.0 * float(item["probability"]), BLUE if k == 0 else GREY)
        for k, item in enumerate(ranked)
    ]
    chances.extend((name, 100.0 * verdict.chances[name], GREY) for name in (UNKNOWN, NONE))
    blocks.append(
        Figure(
            "How probable each cause is",
            bars("probability", "%", chances),
            "Tempered evidence: bars of like height cannot be told apart by these logs.",
        )
    )
    rows = [_candidate_row(item) for item in ranked]
    blocks.append(
        Table(
            ["effect", "log evidence", "error left out [V]", "closed", "parameters (95 %)"],
            rows,
            note="Errors are on rows that the fit of the effect did not see.",
        )
    )
    return Section("Which effect", blocks)


def _cause_words(diagnosis: Diagnosis) -> str:
    verdict = diagnosis.verdict
    if verdict.cause == NONE:
        return "No effect has more evidence than chance gives on clean logs."
    if verdict.cause == UNKNOWN:
        return (
            "Something differs, but the best effect of the library explains only"
            f" {100.0 * verdict.explained:.0f} % of the excess: the cause is not in it."
        )
    effect = LIBRARY[verdict.cause]
    words = f"{verdict.cause}: {effect.signature}. {effect.equation}."
    if verdict.ambiguous_with:
        words += (
            f" These logs cannot tell it from {', '.join(verdict.ambiguous_with)};"
            f" what would: {effect.separated_by}."
        )
    return words + " A label is a signature at the terminals, not proof of a mechanism."


def _candidate_row(item: dict[str, Any]) -> list[str]:
    closed = item["closed_fraction"]
    parameters = "; ".join(
        f"{name} {significant(each['value'], 3)}"
        + ("" if each["ci"] is None else f" ({span(each['ci'][0], each['ci'][1], 3)})")
        + f" {each['unit']}"
        for name, each in item["parameters"].items()
    )
    return [
        str(item["effect"]),
        number(item["log_bayes_factor"], 1),
        number(item["rmse_v"], 2),
        "–" if closed is None else f"{100.0 * closed:.0f} %",
        parameters,
    ]


def _where(diagnosis: Diagnosis) -> Section:
    blocks: list[Block] = []
    for axis, words in AXIS_WORDS.items():
        places = [place for place in diagnosis.where if place.axis == axis]
        if places:
            blocks.append(
                Figure(
                    f"Share of the squared error over {words}",
                    bars(
                        "share",
                        "%",
                        [(_range(place), 100.0 * place.share, BLUE) for place in places],
                    ),
                    _where_words(places),
                )
            )
    return Section("Where the error lies", blocks)


def _range(place: Place) -> str:
    if place.axis == "rest":
        return "rest" if place.low > 0.0 else "drive"
    if place.axis == "timescale" and place.high >= LONGEST_S:
        return f"over {number(place.low, 0)}"
    return span(place.low, place.high, 0)


def _where_words(places: Sequence[Place]) -> str:
    most = max(places, key=lambda place: place.share)
    low, high = most.ci
    return (
        f"Most lies at {_range(most)}: {100.0 * most.share:.0f} %"
        f" ({100.0 * low:.0f}–{100.0 * high:.0f} %), {most.rmse_v:.2f} V there."
    )


def _worst(diagnosis: Diagnosis) -> Table:
    rows = [
        [
            str(item["log"]),
            *(
                number(float(str(item[name])), digits)
                for name, digits in (
                    ("time_s", 0),
                    ("residual_v", 2),
                    ("soc_pct", 1),
                    ("current_a", 1),
                    ("temperature_c", 1),
                )
            ),
        ]
        for item in diagnosis.worst
    ]
    return Table(
        ["log", "time [s]", "measured − model [V]", "SoC [%]", "current [A]", "temperature [°C]"],
        rows,
        note="At least a minute apart.",
    )


def _observability(diagnosis: Diagnosis) -> list[Block]:
    rows = [
        [str(item["effect"]), f"{100.0 * float(str(item['visible'])):.0f} %", str(item["needs"])]
        for item in diagnosis.observability
    ]
    return [
        Table(
            ["effect", "visible part of its physical range", "what would show or separate it"],
            rows,
            note="0 %: even at its physical limit the effect would not be accepted on these logs.",
        )
    ]


def _method(diagnosis: Diagnosis, names: str) -> list[str]:
    settled = diagnosis.settled
    error = settled.error
    rows = int(np.sum([terms.residual_v.size for terms in settled.diagnosed]))
    return [
        f"Diagnosed: {names} ({rows} rows); references: {len(settled.references)}.",
        f"Error expected without a cause: {error.rmse_v:.2f} V, weighed by time scale:"
        f" {error.scale_v2[0] ** 0.5:.2f} V from row to row,"
        f" {error.lasting_v2**0.5:.2f} V·√row over many minutes.",
        "Coefficients, structure that clean logs share, and what differs from log to log without a"
        " cause are integrated out; then every effect is weighed against none.",
        *settled_remarks(diagnosis),
    ]


def settled_remarks(diagnosis: Diagnosis) -> list[str]:
    """Return what the reader should know of this diagnosis in particular."""
    remarks = list(diagnosis.extension.remarks)
    if not diagnosis.settled.references:
        remarks.append(
            "Without references the model's own noise stands for the floor: give logs on which the"
            " model is known to be good with --reference."
        )
    return remarks

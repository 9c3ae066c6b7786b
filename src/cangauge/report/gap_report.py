"""The page of `cangauge gap`: how large, where, which effect, how far it shrinks."""

from __future__ import annotations

from typing import Any

import numpy as np

from cangauge.gap.before_after import errors_before_and_after
from cangauge.gap.diagnose import Diagnosis, in_words
from cangauge.gap.verdict import NONE, UNKNOWN
from cangauge.model.effects.library import LIBRARY
from cangauge.report.bars import bars
from cangauge.report.figures import BLUE, GREY
from cangauge.report.gap_limits import verdict_limit
from cangauge.report.gap_maps import map_figures, share_figures
from cangauge.report.gap_moments import moment_figures
from cangauge.report.gap_shrink import shrink_figures
from cangauge.report.gap_size import size_blocks
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
UNITS = {"1": "", "ohm": " Ω"}
"""Units that a reader writes otherwise than the model file."""


def gap_report(diagnosis: Diagnosis) -> str:
    """Return the diagnosis as one self-contained HTML page."""
    return render(gap_page(diagnosis))


def gap_page(diagnosis: Diagnosis) -> Page:
    """Return the page of a diagnosis."""
    logs = [terms.prepared.log for terms in diagnosis.settled.diagnosed]
    names = ", ".join(log.name for log in logs)
    errors = errors_before_and_after(diagnosis.settled, diagnosis.extension.model)
    extended = _extended(diagnosis)
    sections = [
        Section("How large it is", size_blocks(diagnosis, extended)),
        Section(
            "Where it lies",
            [*map_figures(errors, extended), *share_figures(diagnosis.where)],
        ),
        Section("Which effect", _which(diagnosis)),
        Section("How far it shrinks", [_shrinks(diagnosis), *shrink_figures(errors, extended)]),
        Section("The worst moments", moment_figures(diagnosis.worst, errors, extended)),
        Section("How much of each effect these logs can show", _observability(diagnosis)),
        Section("How it was done", [Bullets(_method(diagnosis, names))]),
    ]
    open_question, cannot = verdict_limit(diagnosis), diagnosis.limits
    if open_question or cannot:
        said = [open_question] if open_question else []
        sections.insert(0, Section("What these logs cannot show", [Bullets([*said, *cannot])]))
    return Page(
        title="Gap between model and log",
        subtitle=in_words(diagnosis),
        tiles=_tiles(diagnosis),
        sections=sections,
        banners=reconstruction_banners(names, *(log.source for log in logs)),
    )


def _extended(diagnosis: Diagnosis) -> str:
    """Return what the extended model adds, in words."""
    accepted = diagnosis.extension.cause
    if accepted:
        return f"with {' and '.join(accepted)}"
    return "with what references add" if diagnosis.settled.references else "nothing added"


def _tiles(diagnosis: Diagnosis) -> list[Tile]:
    verdict = diagnosis.verdict
    before, after = diagnosis.baseline_soc_mae_pct, diagnosis.extended_soc_mae_pct
    tiles = [
        Tile("Verdict", verdict.cause.replace("_", " "), f"probability {verdict.probability:.2f}"),
        Tile("Error of the model", number(diagnosis.baseline_rmse_v, 2, "V"), "RMS, these logs"),
        Tile("Extended model", number(diagnosis.extended_rmse_v, 2, "V"), "RMS, rows left out"),
        Tile(
            "Floor: references" if diagnosis.settled.references else "Floor: model file",
            number(diagnosis.floor_v, 2, "V"),
            "RMS, model as given",
        ),
    ]
    if diagnosis.explainable_v is not None:
        tiles.append(
            Tile(
                "Floor: explainable",
                number(diagnosis.explainable_v, 2, "V"),
                "RMS, with references' structure",
            )
        )
    if diagnosis.closed is not None:
        hint = "of its square, above the floor"
        if diagnosis.closed_ci is not None:
            low, high = diagnosis.closed_ci
            hint = f"squared; 95 %: {_percents(low, high)}"
        tiles.append(Tile("Gap closed", _percent(diagnosis.closed), hint))
    if before is not None:
        tiles.append(
            Tile(
                "SoC error (EKF)",
                f"{significant(before, 2)} → {significant(after, 2, '%')}",
                "mean, before → extended",
            )
        )
    return tiles


def _shrinks(diagnosis: Diagnosis) -> Paragraph:
    before, after = diagnosis.baseline_rmse_v, diagnosis.extended_rmse_v
    words = f"On rows left out of the fit: {before:.2f} V before, {after:.2f} V after."
    if diagnosis.closed is not None:
        words += f" That closes {_percent(diagnosis.closed)}"
        if diagnosis.closed_ci is not None:
            low, high = diagnosis.closed_ci
            words += f" (95 % interval {_percents(low, high)})"
        words += " of the squared gap above the floor."
    if not diagnosis.settled.references:
        return Paragraph(words)
    added = "the cause and " if diagnosis.extension.cause else "no cause, only "
    return Paragraph(
        f"{words} The extended model has {added}what the references teach: coefficients moved, and"
        " structure that logs without a cause show as well."
    )


def _percent(part: float) -> str:
    return number(100.0 * part, 0, "%")


def _percents(low: float, high: float) -> str:
    return span(100.0 * low, 100.0 * high, 0, "%")


def _which(diagnosis: Diagnosis) -> list[Block]:
    verdict = diagnosis.verdict
    blocks: list[Block] = [Paragraph(_cause_words(diagnosis))]
    ranked = diagnosis.candidates[:SHOWN]
    chances = [
        (name, 100.0 * verdict.chances[name], BLUE if name == verdict.cause else GREY)
        for name in (*(str(item["effect"]) for item in ranked), UNKNOWN, NONE)
    ]
    blocks.append(
        Figure(
            "How probable each cause is",
            bars("probability", "%", chances),
            "By evidence, and by what each takes away: how often it was so on other packs.",
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
    return blocks


def _cause_words(diagnosis: Diagnosis) -> str:
    verdict = diagnosis.verdict
    if verdict.cause == NONE:
        return "What these logs show, clean ones may show as well."
    if verdict.cause == UNKNOWN:
        return (
            "Something differs, but no effect of the library is likely enough to be the cause: the"
            f" best one, {verdict.candidates[0].effect_id}, takes"
            f" {100.0 * verdict.explained:.0f} % of the gap away."
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
        + UNITS.get(each["unit"], f" {each['unit']}")
        for name, each in item["parameters"].items()
    )
    return [
        str(item["effect"]),
        number(item["log_bayes_factor"], 1),
        number(item["rmse_v"], 2),
        "–" if closed is None else _percent(closed),
        parameters,
    ]


def _observability(diagnosis: Diagnosis) -> list[Block]:
    rows = [
        [str(item["effect"]), f"{100.0 * float(str(item['visible'])):.0f} %", str(item["needs"])]
        for item in diagnosis.observability
    ]
    return [
        Table(
            ["effect", "visible part of its physical range", "what would show or separate it"],
            rows,
            note="0 %: even at its physical limit the effect would show little on these logs beside"
            " what references without it show.",
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

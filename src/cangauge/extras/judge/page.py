"""The page of `cangauge judge`: both SoCs, the band, and the moments at which they part."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cangauge._text import counted, number
from cangauge.extras.judge.result import Judgement
from cangauge.extras.judge.text import moment, signed
from cangauge.extras.report.charts import ORANGE, Figure, TimeFigures
from cangauge.extras.report.page import Page, Table, Tile, joined


def judge_page(judgement: Judgement, model_path: Path | None = None) -> Page:
    """Return the page of a judgement.

    Parameters
    ----------
    judgement : Judgement
    model_path : Path, optional
        The model's file, to name it by its SHA-256.
    """
    logs = judgement.logs
    first, *rest = judgement.text.split("\n")
    std = number(judgement.error_std_pct, 1, "%")
    return Page(
        title=f"Second opinion on the gauge of {joined([log.name for log in logs])}",
        lead=first,
        subtitle=f"{counted(len(logs), 'log')}, judged by {judgement.model.name}.",
        tiles=[
            Tile("Verdict now", judgement.verdict.replace("_", " ")),
            Tile("Error now", number(judgement.error_pct, 1, "% SoC"), f"σ {std}"),
        ],
        sections={
            "Why, and what next": [[text] for text in rest],
            "Both states of charge": [_figure(judgement)],
        },
        folded={"Pieces": [_piece_table(judgement)]},
        model=judgement.model,
        model_path=model_path,
        logs=logs,
    )


def _piece_table(judgement: Judgement) -> Table:
    rows = [
        [
            moment(judgement, piece.begin),
            moment(judgement, piece.end),
            signed(piece.error_pct),
            number(piece.std_pct, 1),
            "" if piece.stands_at_pct is None else f"at {number(piece.stands_at_pct, 1)} %",
        ]
        for piece in judgement.pieces
    ]
    return Table(["from", "until", "error at its end [% SoC]", "σ", "stands still"], rows)


def _figure(judgement: Judgement) -> Figure:
    logs = judgement.logs
    time = TimeFigures([log.time_s for log in logs])
    pieces = list(zip(logs, judgement.corrected_pct, judgement.corrected_std_pct, strict=True))
    published = zip((log.time_s for log in logs), judgement.published_pct, strict=True)
    bands = [
        (log.time_s, np.clip(soc - 2.0 * std, 0.0, 100.0), np.clip(soc + 2.0 * std, 0.0, 100.0))
        for log, soc, std in pieces
    ]
    figure = time.figure(
        "Published and corrected state of charge",
        "state of charge [%]",
        "The published SoC should lie inside the band (2σ). A dashed line marks a jump of the"
        " gauge, or where it began to stand still.",
        {"corrected": [(log.time_s, soc) for log, soc, _ in pieces], "published": list(published)},
        band=bands,
        height=400,
    )
    for (number_of, time_s), *_ in judgement.pieces[1:]:
        at = float(time.at(number_of, np.array([time_s]))[0])
        figure.mark("height", at, ORANGE, line_dash="dashed", line_width=2)
    return figure

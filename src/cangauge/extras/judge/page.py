"""The page of `cangauge judge`: both SoCs, the band, and the moments at which they part."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cangauge._text import number
from cangauge.extras.judge.causes import RIGHT
from cangauge.extras.judge.result import Judgement
from cangauge.extras.report.charts import BLACK, BLUE, ORANGE, Figure, TimeFigures
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
    jumps = [Table(*judgement.jump_rows())] if judgement.jumps else []
    std = number(judgement.error_std_pct, 1, "%")
    right = number(100.0 * sum(judgement.probabilities[name] for name in RIGHT), 0, "%")
    return Page(
        title=f"Second opinion on the gauge of {joined([log.name for log in logs])}",
        lead=judgement.headline,
        subtitle=f"{judgement.extent}, judged by {judgement.model.name}.",
        tiles=[
            Tile("Verdict", judgement.verdict.replace("_", " "), judgement.extent),
            Tile("Error at the end", number(judgement.error_pct, 1, "% SoC"), f"σ {std}"),
            Tile("Largest error", number(judgement.worst_pct, 1, "% SoC"), "relative to its σ"),
            Tile("P(the gauge is right)", right, "off from 5 % down"),
        ],
        sections={
            "Both states of charge": [_figure(judgement)],
            "What next": [[judgement.next_step]],
            "All answers": [Table(*judgement.answer_rows())],
            "Jumps that the charge does not explain": jumps,
        },
        model=judgement.model,
        model_path=model_path,
        logs=logs,
    )


def _figure(judgement: Judgement) -> Figure:
    logs = judgement.logs
    time = TimeFigures([log.time_s for log in logs])
    pieces = list(zip(logs, judgement.corrected_pct, judgement.corrected_std_pct, strict=True))
    published = zip((log.time_s for log in logs), judgement.published_pct, strict=True)
    figure = time.figure(
        "Published and corrected state of charge",
        "state of charge [%]",
        "The published SoC should lie inside the band. A dashed line marks a moment at which the"
        " two part: a jump, or where the error began.",
        height=400,
    )
    bands = [
        (log.time_s, np.clip(soc - 2.0 * std, 0.0, 100.0), np.clip(soc + 2.0 * std, 0.0, 100.0))
        for log, soc, std in pieces
    ]
    time.band(figure, bands)
    corrected = [(log.time_s, soc) for log, soc, _ in pieces]
    time.line(figure, "corrected", corrected, BLUE, line_width=2.0)
    time.line(figure, "published", list(published), BLACK, line_width=2.0)
    moments = [(jump.log, jump.time_s) for jump in judgement.jumps]
    if judgement.onset is not None:
        moments.append(judgement.onset)
    for log_number, time_s in moments:
        at = float(time.at(log_number, np.array([time_s]))[0])
        figure.mark("height", at, ORANGE, line_dash="dashed", line_width=2)
    return figure

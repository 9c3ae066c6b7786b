"""The page of `cangauge judge`: both SoCs, the band, and the moments at which they part."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from bokeh.models import Span

from cangauge._text import number
from cangauge.extras.judge.judgement import Judgement, rows_of, text_of_days
from cangauge.extras.report.charts import BLACK, BLUE, ORANGE, Pen, TimeFigures
from cangauge.extras.report.page import (
    Bullets,
    Figure,
    InputFile,
    Page,
    Section,
    Table,
    Tile,
    joined,
    reconstruction_banners,
    render,
)

_VERDICTS = {"agrees": "agrees", "off": "off", "cannot_tell": "cannot tell"}


def judge_report(judgement: Judgement, model_path: Path | None = None) -> str:
    """Return the judgement as one self-contained HTML page.

    Parameters
    ----------
    judgement : Judgement
    model_path : Path, optional
        The model's file, to name it by its SHA-256.
    """
    return render(judge_page(judgement, model_path))


def judge_page(judgement: Judgement, model_path: Path | None = None) -> Page:
    """Return the page's content (see `judge_report`)."""
    logs = judgement.logs
    std = number(judgement.error_std_pct, 1, "%")
    tiles = [
        Tile("Verdict", _VERDICTS[judgement.verdict], text_of_days(judgement)),
        Tile("Error at the end", number(judgement.error_pct, 1, "% SoC"), f"σ {std}"),
        Tile("Largest error", number(judgement.worst_pct, 1, "% SoC"), "relative to its σ"),
        Tile(
            "P(the gauge is right)",
            number(100.0 * judgement.probabilities["none"], 0, "%"),
            "off from 5 % down",
        ),
    ]
    sections = [
        Section("Both states of charge", [_figure(judgement)]),
        Section("What next", [Bullets([judgement.next_step])]),
        Section(
            "All answers",
            [Table(["answer", "probability", "size (±1σ)"], rows_of(judgement))],
        ),
    ]
    if judgement.jumps:
        rows = [
            [logs[jump.log].name, number(jump.since_start_s / 3600.0, 2), number(jump.size_pct, 1)]
            for jump in judgement.jumps
        ]
        sections.append(
            Section(
                "Jumps that the charge does not explain",
                [Table(["log", "hours since the first row", "% SoC"], rows)],
            )
        )
    return Page(
        title=f"Second opinion on the gauge of {joined([log.name for log in logs])}",
        lead=judgement.headline,
        subtitle=f"{text_of_days(judgement)}, judged by {judgement.model.name}.",
        tiles=tiles,
        sections=sections,
        inputs=[
            InputFile.of_model(judgement.model, model_path),
            *(InputFile.of_path("log", log.name, log.source) for log in logs),
        ],
        banners=reconstruction_banners(*(f"{log.name} {log.source}" for log in logs)),
    )


def _figure(judgement: Judgement) -> Figure:
    logs = judgement.logs
    time = TimeFigures(logs)
    plot = time.plot("state of charge", "%", height=400)
    pieces = list(zip(logs, judgement.corrected_pct, judgement.corrected_std_pct, strict=True))
    bands = [
        (log.time_s, np.clip(soc - 2.0 * std, 0.0, 100.0), np.clip(soc + 2.0 * std, 0.0, 100.0))
        for log, soc, std in pieces
    ]
    time.band(plot, "±2σ", bands, BLUE)
    time.line(plot, "corrected", [(log.time_s, soc) for log, soc, _ in pieces],
              Pen(BLUE, width=2.0))  # fmt: skip
    published = zip((log.time_s for log in logs), judgement.published_pct, strict=True)
    time.line(plot, "published", list(published), Pen(BLACK, width=2.0))
    moments = [(jump.log, jump.time_s) for jump in judgement.jumps]
    cause = judgement.cause
    if judgement.verdict == "off" and cause.onset is not None:
        moments.append(judgement.moment_s(cause.onset, inside=cause.inside))
    for number_, time_s in moments:
        at = float(time.at(number_, np.array([time_s]))[0])
        plot.add_layout(
            Span(location=at, dimension="height", line_color=ORANGE, line_dash="dashed",
                 line_width=2)
        )  # fmt: skip
    return Figure(
        "Published and corrected state of charge",
        plot,
        "The published SoC should lie inside the band. A dashed line marks a moment at which the"
        " two part: a jump, or where the error began.",
    )

"""Pictures of a check: confusion matrix, reliability, detection against the gap's size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from bokeh.models import ColumnDataSource, FactorRange, LinearColorMapper, Range1d, Whisker

from cangauge.gapcheck.outcome import CRASHED, NONE, UNKNOWN
from cangauge.gapcheck.plan import EFFECTS
from cangauge.report.figures import BLUE, GREEN, GREY, ORANGE, Pen, Plot, add_line, plane
from cangauge.report.page import Figure

_SHADES: Final = ("#ffffff", "#deebf7", "#c6dbef", "#9ecae1", "#6baed6", "#4292c6", "#2171b5")
_ROW_PX: Final = 22


def confusion_figure(confusion: Mapping[str, Mapping[str, int]]) -> Figure:
    """Return the confusion matrix: a row for each truth, a column for each verdict.

    Parameters
    ----------
    confusion : mapping
        Truth → verdict → how often.
    """
    order = [*EFFECTS, NONE, UNKNOWN, CRASHED]
    said = {verdict for row in confusion.values() for verdict in row}
    truths = sorted(confusion, key=lambda name: (name not in order, _place(order, name), name))
    verdicts = [name for name in order if name in said or name in confusion]
    cells = [
        (truth, verdict, count, count / sum(row.values()))
        for truth, row in confusion.items()
        for verdict, count in row.items()
    ]
    plot = plane(
        ("verdict", "truth"),
        "@truth: @verdict, @count of @of",
        units=("", ""),
        height=170 + _ROW_PX * len(truths),
        x_range=FactorRange(factors=verdicts),
        y_categories=truths[::-1],
    )
    source = ColumnDataSource(
        {
            "truth": [cell[0] for cell in cells],
            "verdict": [cell[1] for cell in cells],
            "count": [cell[2] for cell in cells],
            "of": [sum(confusion[cell[0]].values()) for cell in cells],
            "share": [cell[3] for cell in cells],
            "ink": ["#ffffff" if cell[3] > 0.6 else "#1c2430" for cell in cells],
            "edge": [GREEN if cell[0] == cell[1] else GREY for cell in cells],
        }
    )
    shades = LinearColorMapper(palette=list(_SHADES), low=0.0, high=1.0)
    plot.rect(
        x="verdict", y="truth", width=0.94, height=0.9, source=source, line_color="edge",
        fill_color={"field": "share", "transform": shades},
    )  # fmt: skip
    plot.text(
        x="verdict", y="truth", text="count", source=source, text_align="center",
        text_baseline="middle", text_font_size="11px", text_color="ink",
    )  # fmt: skip
    plot.xaxis.major_label_orientation = 0.9
    plot.xgrid.grid_line_color = plot.ygrid.grid_line_color = None
    return Figure(
        "What was said of what",
        plot,
        "Numbers count cases; the shade is the share of the row. Right verdicts have a green edge.",
    )


def reliability_figure(bins: Sequence[Mapping[str, Any]]) -> Figure:
    """Return how often verdicts are right against the probability that they state.

    Parameters
    ----------
    bins : sequence of mapping
        Those of `score.reliability` that hold cases.
    """
    plot = plane(
        ("stated probability", "share that is right"),
        "stated @x{0.00}: right @y{0.00} of @of",
        units=("", ""),
        height=340,
        x_range=Range1d(0.0, 1.0),
    )
    add_line(plot, "perfect", np.array([0.0, 1.0]), np.array([0.0, 1.0]), Pen(GREY, dash="dashed"))
    _points(
        plot,
        "verdicts",
        [entry["stated"] for entry in bins],
        [entry["right"] for entry in bins],
        BLUE,
    )
    plot.y_range = Range1d(-0.03, 1.03)
    return Figure(
        "Reliability",
        plot,
        "Above the dashed line verdicts are right more often than they claim, below less often."
        " Bars are 95 % intervals.",
    )


def gap_figure(by_gap: Sequence[Mapping[str, Any]]) -> Figure:
    """Return how often a gap is found, and its cause named, against its size.

    Parameters
    ----------
    by_gap : sequence of mapping
        Of `score.score`, one for each range of the gap.
    """
    there = [entry for entry in by_gap if entry["top1"]["of"]]
    plot = plane(
        ("gap in floors (middle of its range)", "share of cases"),
        "$name: @y{0.00} of @of",
        units=("", ""),
    )
    for nudge, key, name, color in (
        (0.98, "detected", "a gap is found", GREY),
        (1.0, "top1_pair", "cause, pairs counted", BLUE),
        (1.02, "top1", "cause, strictly", ORANGE),
    ):
        middle = [nudge * 0.5 * sum(entry["gap_in_floors"]) for entry in there]
        _points(plot, name, middle, [entry[key] for entry in there], color)
    plot.y_range = Range1d(-0.03, 1.03)
    return Figure("By size of the gap", plot, "Bars are 95 % intervals.")


def _points(
    plot: Plot, name: str, x: Sequence[float], shares: Sequence[Mapping[str, Any]], color: str
) -> None:
    """Draw shares with their intervals."""
    y = [item["value"] for item in shares]
    add_line(plot, name, np.array(x), np.array(y), Pen(color))
    source = ColumnDataSource(
        {
            "x": list(x),
            "y": y,
            "low": [item["ci"][0] for item in shares],
            "high": [item["ci"][1] for item in shares],
            "of": [item["of"] for item in shares],
        }
    )
    plot.scatter(x="x", y="y", source=source, size=7, color=color, name=name)
    whisker = Whisker(base="x", upper="high", lower="low", source=source, line_color=color)
    whisker.upper_head.line_color = whisker.lower_head.line_color = color
    plot.add_layout(whisker)


def _place(order: Sequence[str], name: str) -> int:
    return order.index(name) if name in order else len(order)

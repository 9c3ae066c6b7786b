"""How far the gap shrinks: the error over time before and after, and by log."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cangauge.gap.before_after import LogErrors
from cangauge.gap.held_out import rms
from cangauge.report.figures import BLUE, GREY, ORANGE, Pen, add_zero
from cangauge.report.page import Block, Figure, Table
from cangauge.report.time_figures import TimeFigures
from cangauge.report.timeline import Timeline
from cangauge.report.words import number, span


def shrink_figures(errors: Sequence[LogErrors], extended: str) -> list[Block]:
    """Return the error over time and each log's figures.

    Parameters
    ----------
    errors : sequence of LogErrors
        Of all diagnosed logs.
    extended : str
        What the extended model adds, in words.
    """
    logs = [item.prepared.log for item in errors]
    time = TimeFigures(Timeline.of(logs))
    plot = time.plot("measured − model", "V", height=300, names=True)
    lines = (
        ("model as given", ORANGE, [item.before_v for item in errors]),
        (extended, BLUE, [item.after_v for item in errors]),
    )
    for name, color, values in lines:
        pieces = [
            (item.prepared.rows.time_s, each) for item, each in zip(errors, values, strict=True)
        ]
        time.line(plot, name, pieces, Pen(color, width=1.0, alpha=0.85))
    add_zero(plot)
    current = time.plot("current", "A", height=170)
    time.line(
        current, "current", [(log.time_s, log.current_a) for log in logs],
        Pen(GREY, width=1.0, in_legend=False),
    )  # fmt: skip
    return [
        Figure(
            "Measured minus modelled voltage, before and after",
            plot,
            "These rows took part in the extended model's fit; how much remains on rows that did"
            " not is in the table of the gap's size above.",
        ),
        Figure("Current", current, "What the pack did meanwhile; above zero it is discharged."),
        _table(errors),
    ]


def _table(errors: Sequence[LogErrors]) -> Table:
    rows = []
    for item in errors:
        seen, before, after = item.prepared.rows, rms(item.before_v), rms(item.after_v)
        rows.append(
            [
                item.prepared.log.name,
                number(item.prepared.log.duration_s / 60.0, 1),
                span(float(seen.soc_pct.max()), float(seen.soc_pct.min()), 0),
                span(float(seen.temperature_c.min()), float(seen.temperature_c.max()), 0),
                number(before, 2),
                number(after, 2),
                number(float(np.mean(item.before_v)), 2),
                number(float(np.mean(item.after_v)), 2),
            ]
        )
    return Table(
        ["log", "duration [min]", "SoC [%]", "temperature [°C]", "RMS before [V]",
         "RMS after [V]", "mean before [V]", "mean after [V]"],
        rows,
        note="On the rows of the fit: after is a little smaller than on rows left out.",
    )  # fmt: skip

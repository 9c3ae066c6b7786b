"""When an estimate was valid and when not, drawn as bars over time with the reasons in words."""

from __future__ import annotations

import numpy as np
from bokeh.models import ColumnDataSource
from numpy.typing import NDArray

from cangauge.estimate.offline import EstimateTable
from cangauge.estimate.types import Reason, Status
from cangauge.report.figures import AMBER, BLACK, GREEN, GREY, Plot, plane
from cangauge.report.page import Figure, Table
from cangauge.report.recorded import Recorded
from cangauge.report.time_figures import TimeFigures
from cangauge.report.words import REASON_WORDS, number, reason_name

FloatArray = NDArray[np.float64]

STATUS_COLORS = {
    Status.INITIALISING: GREY,
    Status.VALID: GREEN,
    Status.DEGRADED: AMBER,
    Status.INVALID: BLACK,
}

SPANS_AT_MOST = 500
"""Gaps shorter than this part of the time axis are not drawn: no screen shows them."""


def status_figure(log: Recorded, table: EstimateTable, time: TimeFigures) -> Figure:
    """Return a row of bars for the status and one for each reason that ever was set."""
    reasons = _seen(table)
    names = ["status", *(reason_name(reason) for reason in reasons)]
    plot = plane(
        (time.timeline.label, ""),
        f"@what<br>@left{{0.[00]}} … @right{{0.[00]}} {time.timeline.unit}",
        units=("", ""),
        height=76 + 30 * len(names),
        x_range=time.x_range,
        y_categories=names[::-1],
    )
    at = time.timeline.at(0, log.time_s)
    for status in Status:
        spans = _stretches(at, table.status == status)
        _add_bars(plot, spans, ("status", status.name.lower()), STATUS_COLORS[status])
    for reason, name in zip(reasons, names[1:], strict=True):
        _add_bars(plot, _stretches(at, (table.reasons & reason) != 0), (name, name), AMBER)
    plot.ygrid.grid_line_color = None
    return Figure(
        "Status over time",
        plot,
        "Green is valid, amber degraded, grey initialising, black invalid; below, when each reason"
        " held.",
    )


def reason_table(table: EstimateTable) -> Table:
    """Return the share of samples of each status and each reason, with its meaning."""
    rows = [
        [status.name.lower(), _share(table.status == status), ""]
        for status in Status
        if np.any(table.status == status)
    ]
    rows += [
        [reason_name(reason), _share((table.reasons & reason) != 0), REASON_WORDS[reason]]
        for reason in _seen(table)
    ]
    return Table(["status or reason", "share of samples", "meaning"], rows)


def _seen(table: EstimateTable) -> list[Reason]:
    return [reason for reason in Reason if np.any(table.reasons & reason)]


def _share(mask: NDArray[np.bool_]) -> str:
    return number(100.0 * float(mask.mean()), 2, "%")


def _add_bars(
    plot: Plot, spans: tuple[FloatArray, FloatArray], words: tuple[str, str], color: str
) -> None:
    """Draw one bar for each stretch of time, in the row and with the hover text of `words`."""
    left, right = spans
    if not left.size:
        return
    row, what = words
    columns = {"left": left, "right": right, "row": [row] * left.size, "what": [what] * left.size}
    plot.hbar(
        y="row",
        left="left",
        right="right",
        height=0.62,
        fill_color=color,
        line_color=color,  # a single sample must still be seen
        source=ColumnDataSource(columns),
    )


def _stretches(at: FloatArray, mask: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    """Return where `mask` begins and ceases to hold; each row lasts until the next one."""
    change = np.diff(np.concatenate(([0], mask.astype(np.int8), [0])))
    begin, end = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
    left, right = at[begin], at[np.minimum(end, at.size - 1)]
    if left.size > 1:
        least = (at[-1] - at[0]) / SPANS_AT_MOST
        apart = left[1:] - right[:-1] >= least
        left, right = left[np.r_[True, apart]], right[np.r_[apart, True]]
    return left, right

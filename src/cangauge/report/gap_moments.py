"""The worst moments as small multiples: error before and after, and current, a minute around."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from bokeh.layouts import gridplot
from bokeh.models import Range1d, Span
from numpy.typing import NDArray

from cangauge.gap.before_after import LogErrors
from cangauge.gap.moments import APART_S, Around, Moment, around
from cangauge.report.decimate import extremes
from cangauge.report.figures import BLUE, GREY, ORANGE, Pen, Plot, add_line, add_zero, plane
from cangauge.report.page import Beside, Block, Figure, Table
from cangauge.report.words import number

FloatArray = NDArray[np.float64]

POINTS_AT_MOST = 600
"""Of the current around one moment."""

IN_A_ROW = 2


def moment_figures(
    moments: Sequence[Moment], errors: Sequence[LogErrors], extended: str
) -> list[Block]:
    """Return a figure for each moment, all on the same scales, and their table.

    Parameters
    ----------
    moments : sequence of Moment
        The worst first.
    errors : sequence of LogErrors
        Of all diagnosed logs.
    extended : str
        What the extended model adds, in words.
    """
    seen = [around(moment, errors) for moment in moments]
    volts = _range([each.before_v for each in seen] + [each.after_v for each in seen])
    amperes = _range([each.current_a for each in seen])
    drawn = [
        Figure(
            f"{rank}. {moment.log} at {number(moment.time_s, 0)} s",
            _small(each, volts, amperes, extended),
            f"{number(moment.residual_v, 2)} V at {number(moment.soc_pct, 1)} %,"
            f" {number(moment.current_a, 1)} A and {number(moment.temperature_c, 1)} °C; with the"
            f" extended model {number(_at(each), 2)} V.",
        )
        for rank, (moment, each) in enumerate(zip(moments, seen, strict=True), start=1)
    ]
    rows = [Beside(drawn[at : at + IN_A_ROW]) for at in range(0, len(drawn), IN_A_ROW)]
    return [*rows, _table(moments, seen)]


def _at(each: Around) -> float:
    return float(each.after_v[np.argmin(np.abs(each.time_s))])


def _range(values: Sequence[FloatArray]) -> tuple[float, float]:
    whole = np.concatenate([*values, np.zeros(1)])
    margin = 0.06 * float(np.ptp(whole)) or 1.0
    return float(whole.min()) - margin, float(whole.max()) + margin


def _small(
    each: Around, volts: tuple[float, float], amperes: tuple[float, float], extended: str
) -> Plot:
    x_range = Range1d(-APART_S, APART_S)
    above = plane(
        ("", "measured − model"), "$name: @y{0.00} V<br>at @x{0.0} s", units=("", "V"),
        height=190, x_range=x_range,
    )  # fmt: skip
    add_zero(above)
    add_line(above, "model as given", each.time_s, each.before_v, Pen(ORANGE, width=1.6))
    add_line(above, extended, each.time_s, each.after_v, Pen(BLUE, width=1.6))
    above.y_range = Range1d(*volts)
    above.xaxis.visible = False
    below = plane(
        ("time from the moment", "current"), "@y{0.0} A<br>at @x{0.0} s", units=("s", "A"),
        height=150, x_range=x_range,
    )  # fmt: skip
    thin = extremes(each.current_a, POINTS_AT_MOST)
    add_line(
        below, "current", each.current_time_s[thin], each.current_a[thin],
        Pen(GREY, width=1.4, in_legend=False),
    )  # fmt: skip
    below.y_range = Range1d(*amperes)
    for plot in (above, below):
        plot.add_layout(
            Span(location=0.0, dimension="height", line_color="#c3cad3", line_dash="dashed")
        )
        plot.yaxis.ticker.desired_num_ticks = 4
    return gridplot(
        [[above], [below]],
        sizing_mode="stretch_width",
        merge_tools=True,
        toolbar_location="right",
        toolbar_options={"logo": None, "autohide": True},
    )


def _table(moments: Sequence[Moment], seen: Sequence[Around]) -> Table:
    rows = [
        [
            str(rank),
            moment.log,
            number(moment.time_s, 0),
            number(moment.residual_v, 2),
            number(_at(each), 2),
            number(moment.soc_pct, 1),
            number(moment.current_a, 1),
            number(moment.temperature_c, 1),
        ]
        for rank, (moment, each) in enumerate(zip(moments, seen, strict=True), start=1)
    ]
    return Table(
        ["", "log", "time in the log [s]", "measured − model [V]", "with the extended model [V]",
         "SoC [%]", "current [A]", "temperature [°C]"],
        rows,
        note="At least a minute apart. Positive current discharges.",
    )  # fmt: skip

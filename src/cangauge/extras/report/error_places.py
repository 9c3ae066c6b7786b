"""Where the error of a diagnosis lies: maps, shares over each axis, worst segments."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from bokeh.layouts import gridplot
from bokeh.models import ColorBar, ColumnDataSource, LinearColorMapper, Range1d, Span, Whisker
from bokeh.palettes import Viridis256

from cangauge._formatting import number, span
from cangauge._typing import FloatArray
from cangauge.diagnosis import (
    MIN_BIN_ROWS,
    SEGMENT_S,
    ErrorMap,
    ErrorShare,
    LogErrors,
    SegmentSignals,
    WorstSegment,
    error_map,
    segment_signals,
)
from cangauge.extras.report.charts import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    SKY,
    Pen,
    Plot,
    add_line,
    add_zero,
    extremes,
    new_figure,
)
from cangauge.extras.report.page import Beside, Block, Figure, Table
from cangauge.extras.report.summary import percent, percent_span

_SEGMENT_POINTS: Final = 600
"""Points of the current drawn for one segment."""
_LONGEST_S: Final = 1e6
"""A time scale beyond this is shown as open-ended [s]."""
_WHOLE_MINUTES_FROM_S: Final = 600.0
_AXES: Final = {
    "soc": ("state of charge", "%"),
    "current": ("current", "A"),
    "temperature": ("temperature", "°C"),
    "rest": ("rest and drive", ""),
    "time": ("time since the start", "min"),
    "timescale": ("time scale of the error", "s"),
}
_SHADES: Final = tuple(Viridis256[::-1])
"""Light for a small error, dark for a large one."""


def error_maps(errors: Sequence[LogErrors], extended: str) -> list[Block]:
    """Return the maps of the error, before and after in the same shades."""
    rows = [item.sampled.rows for item in errors]
    soc = np.concatenate([item.soc_pct for item in rows])
    axes = {
        "current": np.concatenate([item.delayed_current_a[:, 0] for item in rows]),
        "temperature": np.concatenate([item.temperature_c for item in rows]),
    }
    models = {
        "model as given": np.concatenate([item.before_v for item in errors]),
        extended: np.concatenate([item.after_v for item in errors]),
    }
    maps = {
        (model, axis): error_map(soc, values, error_v, tails=axis == "current")
        for model, error_v in models.items()
        for axis, values in axes.items()
    }
    largest_v = max(float(np.nanmax(each.rms_v, initial=0.0)) for each in maps.values())
    return [
        Beside(
            [
                Figure(
                    f"RMS error over SoC × {_AXES[axis][0]}, {model}",
                    _heat_map(maps[model, axis], _AXES[axis], largest_v),
                    _map_caption(maps[model, axis], _AXES[axis][1]),
                )
                for axis in axes
            ]
        )
        for model in models
    ]


def _heat_map(each: ErrorMap, axis: tuple[str, str], largest_v: float) -> Plot:
    quantity, unit = axis
    plot = new_figure(
        ("state of charge", quantity),
        f"RMS @rms{{0.00}} V, mean @mean{{0.00}} V, @rows rows<br>SoC @left{{0.[0]}} …"
        f" @right{{0.[0]}} %, {quantity} @range",
        units=("%", unit),
        height=330,
        x_range=Range1d(float(each.soc_edges_pct[0]), float(each.soc_edges_pct[-1])),
    )
    plot.y_range = Range1d(float(each.edges[0]), float(each.edges[-1]))
    up, across = np.nonzero(np.isfinite(each.rms_v))
    source = ColumnDataSource(
        {
            "left": each.soc_edges_pct[across],
            "right": each.soc_edges_pct[across + 1],
            "bottom": each.edges[up],
            "top": each.edges[up + 1],
            "range": [_bin_range(each, int(k), unit) for k in up],
            "rms": each.rms_v[up, across],
            "mean": each.mean_v[up, across],
            "rows": each.rows[up, across],
        }
    )
    shades = LinearColorMapper(palette=list(_SHADES), low=0.0, high=max(largest_v, 1e-3))
    plot.quad(
        left="left", right="right", bottom="bottom", top="top", source=source,
        fill_color={"field": "rms", "transform": shades}, line_color="#ffffff", line_width=0.5,
    )  # fmt: skip
    plot.add_layout(
        ColorBar(
            color_mapper=shades, title="RMS error [V]", width=12, padding=6,
            title_text_font_style="normal", title_text_font_size="12px",
        ),
        "right",
    )  # fmt: skip
    return plot


def _map_caption(each: ErrorMap, unit: str) -> str:
    if not np.isfinite(each.rms_v).any():
        return f"No bin holds {MIN_BIN_ROWS} rows: the logs are too short for a map."
    up, across = np.unravel_index(int(np.nanargmax(each.rms_v)), each.rms_v.shape)
    low, high = each.soc_edges_pct[across], each.soc_edges_pct[across + 1]
    return (
        f"Largest {number(float(each.rms_v[up, across]), 2, 'V')} (mean"
        f" {number(float(each.mean_v[up, across]), 2, 'V')}) at {span(low, high, 0, '%')} SoC and"
        f" {_bin_range(each, int(up), unit)}. Bins with fewer than {MIN_BIN_ROWS} rows are empty."
        + (" The top and bottom bins include everything beyond." if each.tails else "")
    )


def _bin_range(each: ErrorMap, up: int, unit: str) -> str:
    """Return the range of the second quantity in a bin, in words."""
    low, high = float(each.edges[up]), float(each.edges[up + 1])
    digits = _digits(high - low)
    if each.tails and up == each.edges.size - 2:
        return f"over {number(low, digits, unit)}"
    if each.tails and up == 0:
        return f"below {number(high, digits, unit)}"
    return span(low, high, digits, unit)


def _digits(width: float) -> int:
    """Return the number of decimals that separates edges `width` apart."""
    return max(0, math.ceil(math.log10(2.0 / max(width, 1e-6))))


def share_figures(places: Sequence[ErrorShare]) -> list[Figure]:
    """Return the shares of the squared error over every axis, the most informative one first.

    An axis is informative where one of its ranges has far more than an equal part of the error.
    """
    by_axis = {axis: [place for place in places if place.axis == axis] for axis in _AXES}
    figures = []
    for axis in sorted(by_axis, key=lambda axis: -_concentration(by_axis[axis])):
        on_axis, (quantity, unit) = by_axis[axis], _AXES[axis]
        if not on_axis:
            continue
        # The narrowest range sets the decimals: a single cell has few amperes.
        digits = _digits(min(place.high - place.low for place in on_axis))
        largest = max(on_axis, key=lambda place: place.share)
        figures.append(
            Figure(
                f"Share of the squared error: {quantity}{f' [{unit}]' if unit else ''}",
                _share_bars(on_axis, digits),
                f"Largest at {_place_range(largest, digits)}{f' {unit}' if unit else ''}:"
                f" {percent(largest.share)} (95 % interval {percent_span(*largest.ci)}),"
                f" {number(largest.rmse_v, 2, 'V')} RMS there.",
            )
        )
    return figures


def _concentration(places: Sequence[ErrorShare]) -> float:
    """Return the largest share in equal parts; 0 below two places."""
    return len(places) * max((place.share for place in places), default=0.0) if places[1:] else 0.0


def side_by_side(figures: Sequence[Figure]) -> list[Block]:
    """Return figures two in a row."""
    return [Beside(figures[at : at + 2]) for at in range(0, len(figures), 2)]


def _place_range(place: ErrorShare, digits: int) -> str:
    """Return a place's range in words, in the unit of `_AXES`."""
    if place.axis == "rest":
        return "rest" if place.low > 0.0 else "drive"
    if place.axis == "time":
        decimals = 0 if place.high > _WHOLE_MINUTES_FROM_S else 1
        return span(place.low / 60.0, place.high / 60.0, decimals)
    if place.axis == "timescale" and place.high >= _LONGEST_S:
        return f"over {number(place.low, 0)}"
    return span(place.low, place.high, digits)


def _share_bars(places: Sequence[ErrorShare], digits: int) -> Plot:
    ranges = [_place_range(place, digits) for place in places]
    plot = new_figure(
        ("share of the squared error", ""),
        "@name: @share{0.0} % (@low{0.0} … @high{0.0} %), RMS @rms{0.00} V there",
        units=("%", ""),
        height=72 + 26 * max(len(places), 3),
        x_range=Range1d(0.0, 140.0),  # room for the text beside a bar of 100 %
        y_categories=ranges[::-1],
    )
    source = ColumnDataSource(
        {
            "name": ranges,
            "share": [100.0 * place.share for place in places],
            "low": [100.0 * place.ci[0] for place in places],
            "high": [100.0 * place.ci[1] for place in places],
            "end": [100.0 * max(place.ci[1], place.share) for place in places],
            "rms": [place.rmse_v for place in places],
            "text": [f"  {percent(p.share)}, {p.rmse_v:.2f} V" for p in places],
        }
    )
    plot.hbar(y="name", right="share", height=0.62, color=SKY, source=source)
    whisker = Whisker(
        base="name", lower="low", upper="high", dimension="width", source=source, line_color=BLACK
    )
    whisker.upper_head.size = whisker.lower_head.size = 8
    plot.add_layout(whisker)
    plot.text(
        x="end", y="name", text="text", source=source, text_baseline="middle",
        text_font_size="12px", text_color="#1c2430",
    )  # fmt: skip
    plot.xaxis.ticker = [0, 20, 40, 60, 80, 100]
    plot.ygrid.grid_line_color = None
    return plot


def worst_segment_figures(
    segments: Sequence[WorstSegment], errors: Sequence[LogErrors], extended: str
) -> list[Block]:
    """Return a figure of errors and current for each segment, on common scales, and their table."""
    nearby = [segment_signals(segment, errors) for segment in segments]
    volts = _common_range([part for each in nearby for part in (each.before_v, each.after_v)])
    amperes = _common_range([each.current_a for each in nearby])
    figures, rows = [], []
    for rank, (segment, each) in enumerate(zip(segments, nearby, strict=True), start=1):
        after_v = float(each.after_v[np.argmin(np.abs(each.time_s))])
        figures.append(
            Figure(
                f"{rank}. {segment.log} at {number(segment.time_s, 0)} s",
                _segment_plot(each, volts, amperes, extended),
                f"{number(segment.residual_v, 2, 'V')} at {number(segment.soc_pct, 1, '%')} SoC,"
                f" {number(segment.current_a, 1, 'A')} and"
                f" {number(segment.temperature_c, 1, '°C')};"
                f" extended model {number(after_v, 2, 'V')}.",
            )
        )
        rows.append(
            [
                str(rank),
                segment.log,
                number(segment.time_s, 0),
                number(segment.residual_v, 2),
                number(after_v, 2),
                number(segment.soc_pct, 1),
                number(segment.current_a, 1),
                number(segment.temperature_c, 1),
            ]
        )
    return [
        *(Beside(figures[at : at + 2]) for at in range(0, len(figures), 2)),
        Table(
            ["", "log", "time in the log [s]", "measured − model [V]",
             "with the extended model [V]", "SoC [%]", "current [A]", "temperature [°C]"],
            rows,
            note="At least a minute apart. Positive current discharges.",
        ),
    ]  # fmt: skip


def _common_range(values: Sequence[FloatArray]) -> tuple[float, float]:
    whole = np.concatenate([*values, np.zeros(1)])
    margin = 0.06 * float(np.ptp(whole)) or 1.0
    return float(whole.min()) - margin, float(whole.max()) + margin


def _segment_plot(
    each: SegmentSignals, volts: tuple[float, float], amperes: tuple[float, float], extended: str
) -> Plot:
    x_range = Range1d(-SEGMENT_S, SEGMENT_S)
    error = new_figure(
        ("", "measured − model"), "$name: @y{0.00} V<br>at @x{0.0} s", units=("", "V"),
        height=190, x_range=x_range,
    )  # fmt: skip
    add_zero(error)
    add_line(error, "model as given", each.time_s, each.before_v, Pen(ORANGE, width=1.6))
    add_line(error, extended, each.time_s, each.after_v, Pen(BLUE, width=1.6))
    error.y_range = Range1d(*volts)
    error.xaxis.visible = False
    current = new_figure(
        ("time from the centre", "current"), "@y{0.0} A<br>at @x{0.0} s", units=("s", "A"),
        height=150, x_range=x_range,
    )  # fmt: skip
    drawn = extremes(each.current_a, _SEGMENT_POINTS)
    add_line(
        current, "current", each.current_time_s[drawn], each.current_a[drawn],
        Pen(GREY, width=1.4, in_legend=False),
    )  # fmt: skip
    current.y_range = Range1d(*amperes)
    for plot in (error, current):
        plot.add_layout(
            Span(location=0.0, dimension="height", line_color="#c3cad3", line_dash="dashed")
        )
        plot.yaxis.ticker.desired_num_ticks = 4
    return gridplot(
        [[error], [current]],
        sizing_mode="stretch_width",
        merge_tools=True,
        toolbar_location="right",
        toolbar_options={"logo": None, "autohide": True},
    )

"""The figures of the live page, as a description that bokeh's own script draws in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from bokeh.embed import components
from bokeh.models import (
    BoxZoomTool,
    ColumnDataSource,
    DatetimeTickFormatter,
    FactorRange,
    HoverTool,
    Range1d,
)
from bokeh.plotting import figure

from cangauge.extras.live.history import COLUMNS
from cangauge.extras.report.charts import AMBER, BLUE, GREEN, GREY, ORANGE

STATUS_COLOURS: Final = {"valid": GREEN, "degraded": AMBER, "invalid": ORANGE, "initialising": GREY}
"""From the best to the worst known; each has its own line, so colour is not the only sign."""
_CLOCK: Final = "%H:%M:%S"


@dataclass(frozen=True)
class Chart:
    """A figure over time.

    Parameters
    ----------
    title : str
        With the unit.
    lines : dict
        What bokeh draws, by column.
    hover : str
        Text at the pointer.
    height : int
        [px]
    """

    title: str
    lines: dict[str, dict[str, str]]
    hover: str
    height: int = 200


def _dashed(name: str, colour: str) -> dict[str, str]:
    return {"legend_label": name, "line_color": colour, "line_dash": "dashed"}


CHARTS: Final = {
    "soc": Chart(
        "State of charge [%] with its band of ±2σ",
        {
            "soc_newton_pct": {"legend_label": "by voltage (Newton)", "line_color": ORANGE},
            "soc_pct": {"legend_label": "estimate"},
            "soc_coulomb_pct": _dashed("by counting", GREEN),
        },
        "@soc_pct{0.00} % (@soc_low_pct{0.0} to @soc_high_pct{0.0} %),"
        " voltage @soc_newton_pct{0.0} %, counting @soc_coulomb_pct{0.0} %",
        280,
    ),
    "current": Chart("Current [A], positive discharges", {"current_a": {}}, "@current_a{0.00} A"),
    "voltage": Chart(
        "Voltage [V]",
        {
            "voltage_v": {"legend_label": "measured"},
            "voltage_model_v": _dashed("model", ORANGE),
        },
        "measured @voltage_v{0.00} V, model @voltage_model_v{0.00} V",
    ),
    "residual": Chart("Residual, measured − model [mV]", {"residual_mv": {}}, "@residual_mv{0} mV"),
    "temperature": Chart("Temperature [°C]", {"temperature_c": {}}, "@temperature_c{0.0} °C"),
    "rates": Chart(
        "Frames and rejects [1/s]",
        {
            "frames_per_s": {"legend_label": "frames"},
            "rejects_per_s": _dashed("rejects", ORANGE),
        },
        "@frames_per_s{0} frames/s, @rejects_per_s{0.0} rejects/s",
    ),
    "latency": Chart(
        "Latency from frame to SoC, mean of a second [ms]",
        {"latency_ms": {}},
        "@latency_ms{0.00} ms",
    ),
}


WIDE: Final = frozenset({"soc", "status"})
"""Figures over the whole width, one below the other."""


def chart_parts() -> tuple[str, dict[str, str]]:
    """Return the script that draws the figures, and an HTML element for each by its name."""
    rows = ColumnDataSource({name: [] for name in COLUMNS}, name="rows")
    runs = ColumnDataSource(
        {name: [] for name in ("left", "right", "status", "colour", "words")}, name="runs"
    )
    shared = Range1d(0.0, 1.0, name="time")
    figures = {name: _figure(name, chart, rows, shared) for name, chart in CHARTS.items()}
    figures["soc"].varea(
        "time_ms",
        "soc_low_pct",
        "soc_high_pct",
        source=rows,
        fill_color=BLUE,
        fill_alpha=0.22,
        level="underlay",
    )
    figures["status"] = _timeline(runs, shared)
    script, elements = components(figures, wrap_script=False)
    return script, elements


def _plot(name: str, height: int, shared: Range1d, **options: Any) -> Any:
    plot = figure(
        name=name,
        height=height,
        sizing_mode="stretch_width",
        x_axis_type="datetime",
        x_range=shared,
        tools="",
        toolbar_location=None,
        background_fill_color=None,
        border_fill_color=None,
        min_border_left=88 if name in WIDE else 60,
        min_border_right=12,
        **options,
    )
    plot.xaxis.formatter = DatetimeTickFormatter(
        seconds=_CLOCK, minsec=_CLOCK, minutes="%H:%M", hourmin="%H:%M", hours="%H:%M"
    )
    plot.xaxis.ticker.desired_num_ticks = 5
    plot.axis.major_label_text_font_size = "13px"
    plot.axis.minor_tick_line_color = None
    drag = BoxZoomTool(dimensions="width")
    plot.add_tools(drag)
    plot.toolbar.active_drag = drag
    return plot


def _figure(name: str, chart: Chart, rows: ColumnDataSource, shared: Range1d) -> Any:
    plot = _plot(name, chart.height, shared)
    for column, style in chart.lines.items():
        drawn = plot.line(
            "time_ms", column, source=rows, line_width=1.8, **{"line_color": BLUE} | style
        )
    plot.add_tools(
        HoverTool(
            renderers=[drawn],
            mode="vline",
            tooltips=f"@time_ms{{{_CLOCK}}}: {chart.hover}",
            formatters={"@time_ms": "datetime"},
        )
    )
    if len(chart.lines) > 1:
        legend = plot.legend[0]
        plot.add_layout(legend, "above")
        legend.orientation, legend.click_policy = "horizontal", "hide"
        legend.background_fill_alpha, legend.border_line_alpha = 0.0, 0.0
        legend.padding, legend.margin, legend.label_text_font_size = 0, 0, "13px"
    return plot


def _timeline(runs: ColumnDataSource, shared: Range1d) -> Any:
    worst_first = list(STATUS_COLOURS)[::-1]
    plot = _plot("status", 150, shared, y_range=FactorRange(factors=worst_first))
    plot.hbar(
        y="status",
        left="left",
        right="right",
        height=0.7,
        source=runs,
        fill_color="colour",
        line_color="colour",
    )
    plot.add_tools(HoverTool(tooltips="@status: @words", mode="mouse"))
    return plot

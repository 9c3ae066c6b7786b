"""Drawing with bokeh: an empty figure with units and tools, lines, clouds, shades."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from bokeh.models import (
    BoxAnnotation,
    BoxZoomTool,
    ColumnDataSource,
    DataRange1d,
    HoverTool,
    Legend,
    LegendItem,
    PanTool,
    ResetTool,
    SaveTool,
    Span,
    WheelZoomTool,
)
from bokeh.plotting import figure
from numpy.typing import NDArray

from cangauge.report.decimate import every

FloatArray = NDArray[np.float64]
Plot = Any
"""A bokeh figure; bokeh ships no types that mypy could follow."""

# Okabe and Ito's colours, told apart with every kind of colour vision.
BLACK, BLUE, ORANGE, GREEN = "#222222", "#0072b2", "#d55e00", "#009e73"
PURPLE, SKY, AMBER, GREY = "#a4508b", "#56b4e9", "#e69f00", "#8a94a0"


@dataclass(frozen=True)
class Pen:
    """How a line looks."""

    color: str = BLUE
    width: float = 1.3
    alpha: float = 1.0
    dash: str = "solid"
    visible: bool = True
    """False: drawn only after a click on its legend entry."""
    in_legend: bool = True
    """A figure with one line needs no legend."""


def plane(
    quantities: tuple[str, str],
    hover: str,
    *,
    units: tuple[str, str],
    height: int = 300,
    x_range: Any = None,
    hover_mode: str = "mouse",
    y_categories: Sequence[str] | None = None,
) -> Plot:
    """Return an empty figure with tools, units on both axes, and room for a legend above.

    Parameters
    ----------
    quantities, units : pairs of str
        Of the horizontal and the vertical axis; a unit of "" is not shown.
    hover : str
        Template of the text at the pointer.
    height : int
        In screen pixels; the width follows the page.
    x_range : bokeh range, optional
    hover_mode : {"mouse", "vline"}
    y_categories : sequence of str, optional
        Names along the vertical axis, in place of numbers.
    """
    drag, wheel = BoxZoomTool(), WheelZoomTool()
    ranges = (
        {"y_range": list(y_categories)}
        if y_categories is not None
        else {"y_range": DataRange1d(only_visible=True)}
    )
    plot = figure(
        height=height,
        sizing_mode="stretch_width",
        x_range=x_range if x_range is not None else DataRange1d(only_visible=True),
        x_axis_label=_with_unit(quantities[0], units[0]),
        y_axis_label=_with_unit(quantities[1], units[1]),
        tools=[
            PanTool(),
            drag,
            wheel,
            ResetTool(),
            SaveTool(),
            HoverTool(
                tooltips=f"<span style='font-size:12px'>{hover}</span>",
                mode=hover_mode,
                visible=False,  # it is always on, and its button would need room
            ),
        ],
        active_drag=drag,
        active_scroll=None,  # the wheel scrolls the page until the reader asks otherwise
        toolbar_location="right",
        min_border_left=78,  # so that time axes below one another line up
        **ranges,
    )
    plot.toolbar.logo = None
    return plot


def add_line(plot: Plot, name: str, x: FloatArray, y: FloatArray, pen: Pen) -> None:
    """Draw a line as it is (not thinned)."""
    line = plot.line(
        x="x",
        y="y",
        source=table_of(x=x, y=y),
        line_color=pen.color,
        line_width=pen.width,
        line_alpha=pen.alpha,
        line_dash=pen.dash,
        name=name,
    )
    line.visible = pen.visible
    if pen.in_legend:
        add_to_legend(plot, name, line)


def add_cloud(plot: Plot, name: str, x: FloatArray, y: FloatArray, color: str) -> None:
    """Draw points, evenly thinned."""
    thin = every(x.size)
    cloud = plot.scatter(
        x="x",
        y="y",
        source=table_of(x=x[thin], y=y[thin]),
        size=3,
        fill_color=color,
        fill_alpha=0.35,
        line_color=None,
        name=name,
    )
    add_to_legend(plot, name, cloud)


def add_zero(plot: Plot) -> None:
    """Draw the line of no error."""
    plot.add_layout(Span(location=0.0, dimension="width", line_color="#66707d", line_width=1))


def frame(plot: Plot, low: float, high: float) -> None:
    """Show `low` … `high` vertically, with a margin; the reader can still pan and zoom out."""
    margin = 0.05 * (high - low) or 0.5
    plot.y_range.start, plot.y_range.end = low - margin, high + margin


def shade_outside(plot: Plot, low: float, high: float) -> None:
    """Shade what lies left of `low` and right of `high`."""
    for left, right in ((None, low), (high, None)):
        plot.add_layout(
            BoxAnnotation(left=left, right=right, fill_color="#9aa4b0", fill_alpha=0.16)
        )


def _with_unit(quantity: str, unit: str) -> str:
    return f"{quantity} [{unit}]" if unit else quantity


def table_of(**columns: FloatArray) -> ColumnDataSource:
    """Return columns as a page keeps them, in single precision."""
    # Single precision halves the page: 0.03 mV at 400 V, 1 ms on an axis of 100 h.
    return ColumnDataSource({name: values.astype(np.float32) for name, values in columns.items()})


def add_to_legend(plot: Plot, name: str, drawn: Any) -> None:
    """Add an entry to the legend above the figure; a click on it hides the line."""
    if not plot.legend:
        plot.add_layout(Legend(orientation="horizontal", click_policy="hide", items=[]), "above")
    items = list(plot.legend[0].items)
    plot.legend[0].items = [*items, LegendItem(label=name, renderers=[drawn])]

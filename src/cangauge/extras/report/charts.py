"""Figures of the report pages, drawn with bokeh.

A `Figure` has a title, labelled axes, tools and a caption; `TimeFigures` makes figures over one
time axis. Long series are reduced to the extremes of buckets, so that no peak is lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from bokeh import models
from bokeh.layouts import column
from bokeh.plotting import figure
from numpy.typing import NDArray

from cangauge._text import number, significant
from cangauge._typing import FloatArray
from cangauge.logs.gaps import usual_gap_s
from cangauge.settings import GAP_S

Plot = Any
"""A bokeh figure; bokeh ships no types that mypy could follow."""
Pieces = Sequence[tuple[FloatArray, ...]]
"""Times [s] and values of each log."""

# The palette of Okabe and Ito, distinct with every kind of colour vision.
BLACK, BLUE, ORANGE, GREEN = "#222222", "#0072b2", "#d55e00", "#009e73"
PURPLE, SKY, AMBER, GREY = "#a4508b", "#56b4e9", "#e69f00", "#8a94a0"

MAX_POINTS: Final = 4000
"""Points of a drawn line: no screen resolves more."""
_LOG_SPACING: Final = 0.004
"""Free space between two logs on the time axis, relative to its length."""


class Figure:
    """A figure with a title above and a caption below; its width follows the page.

    Parameters
    ----------
    title : str
    x_label, y_label : str
        Quantity and unit of an axis, such as "voltage [V]".
    caption : str
        What to look for.
    hover : str
        Template of the text at the pointer.
    height : int
        In pixels.
    x_range : bokeh range, optional
    y_categories : sequence of str, optional
        Names along the vertical axis instead of numbers.

    Attributes
    ----------
    plot : bokeh figure
        `bokeh.plotting.show(figure.plot)` draws it in a notebook.
    """

    def __init__(
        self,
        title: str,
        x_label: str,
        y_label: str,
        caption: str,
        *,
        hover: str,
        height: int = 300,
        x_range: Any = None,
        y_categories: Sequence[str] = (),
    ) -> None:
        self.title, self.caption = title, caption
        drag, tooltips = models.BoxZoomTool(), f"<span style='font-size:12px'>{hover}</span>"
        self.plot: Plot = figure(
            height=height,
            sizing_mode="stretch_width",
            x_range=x_range or models.DataRange1d(only_visible=True),
            y_range=list(y_categories) or models.DataRange1d(only_visible=True),
            x_axis_label=x_label,
            y_axis_label=y_label,
            tools=[
                models.PanTool(),
                drag,
                models.WheelZoomTool(),
                models.ResetTool(),
                models.SaveTool(),
                # Always on: its button would only take room.
                models.HoverTool(tooltips=tooltips, visible=False),
            ],
            active_drag=drag,
            active_scroll=None,  # the wheel scrolls the page until the reader selects the tool
            toolbar_location="right",
            min_border_left=78,  # aligns time axes below one another
        )
        self.plot.toolbar.logo = None
        self.plot.toolbar.autohide = True

    def line(
        self,
        name: str,
        x: FloatArray,
        y: FloatArray,
        color: str,
        *,
        in_legend: bool = True,
        **style: Any,
    ) -> None:
        """Draw a line through all points; `style` is bokeh's, such as `line_width`."""
        style = {"line_width": 1.3} | style
        data = _source(x=x, y=y)
        line = self.plot.line(x="x", y="y", source=data, name=name, line_color=color, **style)
        if in_legend:
            self.add_to_legend(name, line)

    def cloud(self, name: str, x: FloatArray, y: FloatArray, color: str) -> None:
        """Draw points, evenly sampled if there are many."""
        step = max(1, -(-x.size // MAX_POINTS))
        cloud = self.plot.scatter(
            x="x",
            y="y",
            source=_source(x=x[::step], y=y[::step]),
            size=3,
            fill_color=color,
            fill_alpha=0.35,
            line_color=None,
            name=name,
        )
        self.add_to_legend(name, cloud)

    def mark(self, dimension: str, at: float, color: str = "#66707d", **style: Any) -> None:
        """Draw a line across the figure: at zero error, or at a moment."""
        style = {"line_width": 1} | style
        self.plot.add_layout(
            models.Span(location=at, dimension=dimension, line_color=color, **style)
        )

    def set_y_limits(self, low: float, high: float) -> None:
        """Show `low` … `high` and a margin; the reader can still zoom out."""
        margin = 0.05 * (high - low) or 0.5
        self.plot.y_range.start, self.plot.y_range.end = low - margin, high + margin

    def shade_outside(self, low: float, high: float) -> None:
        """Shade the figure left of `low` and right of `high`."""
        for left, right in ((None, low), (high, None)):
            self.plot.add_layout(
                models.BoxAnnotation(left=left, right=right, fill_color="#9aa4b0", fill_alpha=0.16)
            )

    def add_to_legend(self, name: str, drawn: Any) -> None:
        """Add an entry to the legend, which a figure of one line does not show."""
        if not self.plot.legend:
            legend = models.Legend(orientation="horizontal", click_policy="hide", items=[])
            self.plot.add_layout(legend, "above")
        legend = self.plot.legend[0]
        legend.items = [*legend.items, models.LegendItem(label=name, renderers=[drawn])]
        legend.visible = len(self.plot.renderers) > 1


def stacked(*figures: Figure) -> Plot:
    """Return the figures below one another, without titles, for a notebook."""
    return column([figure.plot for figure in figures], sizing_mode="stretch_width")


def _source(**columns: FloatArray) -> models.ColumnDataSource:
    # Single precision halves the page: it resolves 0.03 mV at 400 V and 1 ms in 4 h.
    return models.ColumnDataSource(
        {name: values.astype(np.float32) for name, values in columns.items()}
    )


def histogram(
    title: str, label: str, unit: str, parts: Sequence[tuple[str, FloatArray, str]], caption: str
) -> Figure:
    """Return histograms of several series (name, values, color), each in % of its rows.

    NaN is left out.
    """
    known = [(name, values[np.isfinite(values)], color) for name, values, color in parts]
    everything = np.abs(np.concatenate([values for _, values, _ in known]))
    # The outermost bars include outliers, which would otherwise compress the rest into one bar.
    limit = (float(np.quantile(everything, 0.999)) if everything.size else 0.0) or 1.0
    edges = np.linspace(-limit, limit, 61)
    hover = f"$name: @y{{0.[00]}} %<br>at @x{{0.[000]}} {unit}"
    shares = Figure(title, f"{label} [{unit}]", "share of rows [%]", caption, hover=hover)
    for name, values, color in known:
        counts = np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0]
        drawn = shares.plot.vbar(
            x="x",
            top="y",
            width=float(edges[1] - edges[0]),
            source=_source(
                x=0.5 * (edges[1:] + edges[:-1]), y=100.0 * counts / max(values.size, 1)
            ),
            fill_color=color,
            fill_alpha=0.4,
            line_color=None,
            name=name,
        )
        shares.add_to_legend(name, drawn)
    return shares


def bars(
    title: str,
    label: str,
    entries: Sequence[tuple[str, float, str]],
    caption: str,
    *,
    unit: str = "",
    decimals: int | None = 2,
) -> Figure:
    """Return horizontal bars (name, value, color), each with its value beside it.

    With `decimals` None a value has three significant digits.
    """
    names, values, colors = (list(column) for column in zip(*entries, strict=True))
    texts = [
        significant(value, 3, unit) if decimals is None else number(value, decimals, unit)
        for value in values
    ]
    low, high = min(0.0, *values), max(0.0, *values)
    shown = Figure(
        title,
        f"{label} [{unit}]" if unit else label,
        "",
        caption,
        hover="@name: @text",
        height=60 + 44 * len(entries),
        # Room for the text of the longest bar, also on a narrow screen.
        x_range=models.Range1d(1.05 * low, high + 0.3 * (high - low) or 1.0),
        y_categories=names[::-1],
    )
    columns = {"name": names, "value": np.array(values), "color": colors}
    source = models.ColumnDataSource(columns | {"text": [f" {text}" for text in texts]})
    shown.plot.hbar(y="name", right="value", height=0.6, color="color", source=source)
    shown.plot.text(
        x="value",
        y="name",
        text="text",
        source=source,
        text_baseline="middle",
        text_font_size="12px",
        text_color="#1c2430",
    )
    shown.plot.ygrid.grid_line_color = None
    return shown


class TimeFigures:
    """Figures over one time axis from zero, on which logs follow one another; they zoom together.

    Parameters
    ----------
    times_s : sequence of array
        Times of the rows of each log [s].
    names : sequence of str, optional
        Of the logs.

    Attributes
    ----------
    unit : {"s", "min", "h"}
    start : array of shape (k,)
        Where each log begins on the axis, in `unit`.
    end : float
        End of the last log, in `unit`.
    """

    def __init__(self, times_s: Sequence[FloatArray], names: Sequence[str] = ()) -> None:
        durations_s = np.array([float(time_s[-1] - time_s[0]) for time_s in times_s])
        spacing_s = _LOG_SPACING * float(durations_s.sum())
        ends_s = np.cumsum(durations_s + spacing_s)
        total_s = max(float(ends_s[-1]) - spacing_s, 1e-3)  # a single row needs an axis too
        units = ((300.0, 1.0, "s"), (6.0 * 3600.0, 60.0, "min"), (np.inf, 3600.0, "h"))
        _, self._unit_s, self.unit = next(unit for unit in units if total_s <= unit[0])
        self.start = np.concatenate(([0.0], ends_s[:-1])) / self._unit_s
        self.end = total_s / self._unit_s
        self._names, self._first_s = names, [float(time_s[0]) for time_s in times_s]
        self._boundaries = self.start[1:] - 0.5 * spacing_s / self._unit_s
        pad = 0.01 * self.end
        limits = (-pad, self.end + pad)
        self.x_range = models.Range1d(*limits, bounds=limits, min_interval=pad / 50.0)

    @property
    def label(self) -> str:
        """Label of the axis."""
        return f"{'time' if self.start.size == 1 else 'time, logs in sequence'} [{self.unit}]"

    def at(self, number: int, time_s: FloatArray) -> FloatArray:
        """Return the axis positions of times [s] of log `number`."""
        return np.asarray(self.start[number] + (time_s - self._first_s[number]) / self._unit_s)

    def figure(
        self, title: str, y_label: str, caption: str, *, height: int = 235, names: bool = False
    ) -> Figure:
        """Return an empty figure over time, with the logs' names if `names`; see `Figure`."""
        unit = y_label.rpartition("[")[2].rstrip("]")
        hover = f"$name: @y{{0.[000]}} {unit}<br>at @x{{0.[00]}} {self.unit}"
        shown = Figure(
            title, self.label, y_label, caption, hover=hover, height=height, x_range=self.x_range
        )
        for boundary in self._boundaries:
            shown.mark("height", boundary, "#c3cad3")
        if names and self.start.size > 1:
            for start, name in zip(self.start, self._names, strict=True):
                text = name.replace("$", "")[:22]  # $…$ would be TeX
                label = models.Label(x=float(start), y=6, y_units="screen", x_offset=12, text=text)
                label.update(angle=1.5708, text_font_size="10px", text_color="#55606e")
                shown.plot.add_layout(label)
        return shown

    def channel(
        self,
        name: str,
        unit: str,
        pieces: Pieces,
        color: str,
        caption: str,
        *,
        names: bool = False,
    ) -> Figure:
        """Return the figure of one quantity through all logs, named by it; see `figure`."""
        shown = self.figure(name.capitalize(), f"{name} [{unit}]", caption, names=names)
        return self.line(shown, name, pieces, color, line_width=1.0)

    def joined(self, pieces: Pieces) -> tuple[FloatArray, ...]:
        """Return positions and values of one line through all logs, NaN at gaps and between logs.

        `pieces` holds (time_s, values, …) of each log.
        """
        lines = []
        for k, (time_s, *values) in enumerate(pieces):
            breaks = np.flatnonzero(np.diff(time_s) > usual_gap_s(time_s, GAP_S)) + 1
            breaks = np.append(breaks, time_s.size)  # separates this log from the next one
            at = self.at(k, time_s)
            broken = [np.insert(of, breaks, np.nan) for of in values]
            lines.append([np.insert(at, breaks, at[breaks - 1]), *broken])
        return tuple(np.concatenate(parts) for parts in zip(*lines, strict=True))

    def line(self, shown: Figure, name: str, pieces: Pieces, color: str, **style: Any) -> Figure:
        """Draw one line through all logs into a figure and return it; see `joined` and `Figure`."""
        x, y = self.joined(pieces)
        rows = extremes(y)
        shown.line(name, x[rows], y[rows], color, **style)
        return shown

    def band(self, shown: Figure, pieces: Pieces) -> None:
        """Shade ±2σ: `pieces` holds (time_s, low, high) of each log."""
        x, low, high = self.joined(pieces)
        rows = np.union1d(extremes(low, MAX_POINTS // 2), extremes(high, MAX_POINTS // 2))
        area = shown.plot.varea(
            x="x",
            y1="low",
            y2="high",
            source=_source(x=x[rows], low=low[rows], high=high[rows]),
            fill_color=BLUE,
            fill_alpha=0.18,
            name="±2σ",
        )
        shown.add_to_legend("±2σ", area)


def extremes(values: FloatArray, max_points: int = MAX_POINTS) -> NDArray[np.intp]:
    """Return the rows to draw: the smallest and the largest value of each bucket of rows.

    Parameters
    ----------
    values : array of shape (n,)
        May hold NaN; a bucket with NaN keeps one, so that the drawn line breaks there too.
    max_points : int
        At least 6.

    Returns
    -------
    array of shape (m,), m ≤ `max_points`
        Increasing row numbers; all of them if n ≤ `max_points`.
    """
    if values.size <= max_points:
        return np.arange(values.size)
    missing = np.isnan(values)
    buckets = max_points // (3 if missing.any() else 2)
    size = -(-values.size // buckets)
    rows = np.arange(-(-values.size // size) * size).reshape(-1, size)
    rows = np.minimum(rows, values.size - 1)  # the last row number fills the last bucket
    picked = [
        np.argmin(np.where(missing, np.inf, values)[rows], axis=1),
        np.argmax(np.where(missing, -np.inf, values)[rows], axis=1),
    ]
    if missing.any():
        picked.append(np.where(missing[rows].any(axis=1), missing[rows].argmax(axis=1), picked[0]))
    return np.unique(np.take_along_axis(rows, np.stack(picked, axis=1), axis=1))

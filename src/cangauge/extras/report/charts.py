"""Figures of the report pages, drawn with bokeh.

A `Figure` has a title, labelled axes, tools and a caption; `TimeFigures` makes figures over one
time axis. Long series are reduced to the extremes of buckets, so that no peak is lost.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from bokeh import models
from bokeh.layouts import column
from bokeh.plotting import figure
from numpy.typing import NDArray

from cangauge._text import number
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

COLORS: Final[Mapping[str, str]] = {
    "measured": BLACK,
    "voltage": BLACK,
    "reference": BLACK,
    "counted": BLACK,
    "published": BLACK,
    "model": ORANGE,
    "model as given": ORANGE,
    "held out": ORANGE,
    "by Newton": ORANGE,
    "temperature": ORANGE,
    "pseudo-OCV": BLUE,
    "estimate": BLUE,
    "corrected": BLUE,
    "corrected model": BLUE,
    "fit": BLUE,
    "σ": BLUE,
    "current": BLUE,
    "Newton": AMBER,
    "Coulomb": GREEN,
    "state of charge": GREEN,
    "residual": PURPLE,
}
"""Quantity over time → color of its line."""
CHANNELS: Final = {
    "current": ("current_a", "A"),
    "voltage": ("voltage_v", "V"),
    "temperature": ("temperature_c", "°C"),
    "state of charge": ("soc_pct", "%"),
}
"""Channel of a log → its attribute and unit."""
_SMOOTH: Final = {"reference", "counted", "published", "pseudo-OCV", "estimate", "corrected"}
"""Lines that noise does not thicken: drawn wide."""
_STYLES: Final[Mapping[str, Mapping[str, Any]]] = {
    "Coulomb": {"line_dash": "dashed"},
    "Newton": {"visible": False},
    "held out": {"visible": False},
}
"""Noisy lines are hidden until their legend entry is clicked."""

MAX_POINTS: Final = 4000
"""Points of a drawn line: no screen resolves more."""


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
        legend = models.Legend(orientation="horizontal", click_policy="hide")
        self.plot.add_layout(legend, "above")
        self.plot.toolbar.logo = None
        self.plot.toolbar.autohide = True

    def line(self, name: str, x: FloatArray, y: FloatArray, color: str, **style: Any) -> None:
        """Draw a line through all points; `style` is bokeh's, such as `line_width`."""
        style = {"line_width": 1.3} | style
        self.draw("line", name, {"x": x, "y": y}, line_color=color, **style)

    def cloud(self, name: str, x: FloatArray, y: FloatArray) -> None:
        """Draw grey points, evenly sampled if there are many."""
        step = max(1, -(-x.size // MAX_POINTS))
        points = {"x": x[::step], "y": y[::step]}
        style = {"size": 3, "fill_color": GREY, "fill_alpha": 0.35, "line_color": None}
        self.draw("scatter", name, points, **style)

    def draw(self, glyph: str, name: str, columns: Mapping[str, FloatArray], **style: Any) -> None:
        """Draw a glyph of bokeh, with an entry in the legend unless the figure shows only it."""
        # Single precision halves the page: it resolves 0.03 mV at 400 V and 1 ms in 4 h.
        data = {key: values.astype(np.float32) for key, values in columns.items()}
        places = {key: key for key in columns}
        method = getattr(self.plot, glyph)
        method(**places, source=data, name=name, legend_label=name, **style)
        self.plot.legend.visible = len(self.plot.renderers) > 1

    def mark(self, dimension: str, at: float, color: str = "#66707d", **style: Any) -> None:
        """Draw a line across the figure: at zero error, or at a moment."""
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


def stacked(*figures: Figure) -> Plot:
    """Return the figures below one another, without titles, for a notebook."""
    return column([figure.plot for figure in figures], sizing_mode="stretch_width")


def bars(
    title: str,
    label: str,
    entries: Sequence[tuple[str, float, str]],
    caption: str,
    *,
    unit: str = "",
) -> Figure:
    """Return horizontal bars (name, value, color), each with its value beside it."""
    names, values, colors = (list(column) for column in zip(*entries, strict=True))
    texts = [f" {number(value, 2, unit)}" for value in values]
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
    columns = {"name": names, "value": np.array(values), "color": colors, "text": texts}
    source = models.ColumnDataSource(columns)
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
        spacing_s = 0.004 * float(durations_s.sum())  # free space between two logs
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
        self,
        title: str,
        y_label: str,
        caption: str,
        lines: Mapping[str, Pieces],
        *,
        band: Pieces = (),
        height: int = 235,
    ) -> Figure:
        """Return a figure over time.

        Parameters
        ----------
        title, y_label, caption, height
            See `Figure`.
        lines : mapping of str to Pieces
            A line for each name in `COLORS`.
        band : Pieces
            (time_s, low, high) of each log, shaded as ±2σ.
        """
        unit = y_label.rpartition("[")[2].rstrip("]")
        hover = f"$name: @y{{0.[000]}} {unit}<br>at @x{{0.[00]}} {self.unit}"
        shown = Figure(
            title, self.label, y_label, caption, hover=hover, height=height, x_range=self.x_range
        )
        for boundary in self._boundaries:
            shown.mark("height", boundary, "#c3cad3")
        if self.start.size > 1:
            for start, name in zip(self.start, self._names, strict=False):
                text = name.replace("$", "")[:22]  # $…$ would be TeX
                label = models.Label(x=float(start), y=6, y_units="screen", x_offset=12, text=text)
                label.update(angle=1.5708, text_font_size="10px", text_color="#55606e")
                shown.plot.add_layout(label)
        if band:
            x, low, high = self.joined(band)
            rows = np.union1d(extremes(low, MAX_POINTS // 2), extremes(high, MAX_POINTS // 2))
            columns = {"x": x[rows], "y1": low[rows], "y2": high[rows]}
            shown.draw("varea", "±2σ", columns, fill_color=BLUE, fill_alpha=0.18)
        for name, pieces in lines.items():
            x, y = self.joined(pieces)
            rows = extremes(y)
            width, style = 2.0 if name in _SMOOTH else 1.0, _STYLES.get(name, {})
            at, values, color = x[rows], y[rows], COLORS[name]
            shown.line(name, at, values, color, line_width=width, line_alpha=0.85, **style)
        return shown

    def channel(self, logs: Sequence[Any], name: str, caption: str, *, height: int = 235) -> Figure:
        """Return the figure of a channel of `CHANNELS` through all logs."""
        attribute, unit = CHANNELS[name]
        pieces = [(log.time_s, getattr(log, attribute)) for log in logs]
        title, y_label = name.capitalize(), f"{name} [{unit}]"
        return self.figure(title, y_label, caption, {name: pieces}, height=height)

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

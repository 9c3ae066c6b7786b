"""Figures of the report pages, drawn with bokeh.

`new_figure` returns an empty figure with units and tools, `TimeFigures` makes figures over one time
axis. Long series are reduced to the extremes of buckets, so that no peak is lost.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from bokeh.models import (
    BoxAnnotation,
    BoxZoomTool,
    ColumnDataSource,
    DataRange1d,
    HoverTool,
    Label,
    Legend,
    LegendItem,
    PanTool,
    Range1d,
    ResetTool,
    SaveTool,
    Span,
    WheelZoomTool,
)
from bokeh.plotting import figure
from numpy.typing import NDArray

from cangauge._text import number, significant
from cangauge._typing import FloatArray
from cangauge.logs.gaps import usual_gap_s
from cangauge.model.delay_line import GAP_S
from cangauge.service.offline import Recorded

Plot = Any
"""A bokeh figure; bokeh ships no types that mypy could follow."""

# The palette of Okabe and Ito, distinct with every kind of colour vision.
BLACK, BLUE, ORANGE, GREEN = "#222222", "#0072b2", "#d55e00", "#009e73"
PURPLE, SKY, AMBER, GREY = "#a4508b", "#56b4e9", "#e69f00", "#8a94a0"


@dataclass(frozen=True)
class Pen:
    """Style of a line."""

    color: str = BLUE
    width: float = 1.3
    alpha: float = 1.0
    dash: str = "solid"
    visible: bool = True
    """False: hidden until its legend entry is clicked."""
    in_legend: bool = True
    """False for a figure with a single line."""


def new_figure(
    quantities: tuple[str, str],
    hover: str,
    *,
    units: tuple[str, str],
    height: int = 300,
    x_range: Any = None,
    y_categories: Sequence[str] | None = None,
) -> Plot:
    """Return an empty figure with tools and labelled axes; its width follows the page.

    Parameters
    ----------
    quantities, units : pairs of str
        Of the horizontal and the vertical axis; a unit of "" is not shown.
    hover : str
        Template of the text at the pointer.
    height : int
        In pixels.
    x_range : bokeh range, optional
    y_categories : sequence of str, optional
        Names along the vertical axis instead of numbers.
    """
    x_label, y_label = (
        f"{quantity} [{unit}]" if unit else quantity
        for quantity, unit in zip(quantities, units, strict=True)
    )
    drag, wheel = BoxZoomTool(), WheelZoomTool()
    plot = figure(
        height=height,
        sizing_mode="stretch_width",
        x_range=x_range if x_range is not None else DataRange1d(only_visible=True),
        y_range=DataRange1d(only_visible=True) if y_categories is None else list(y_categories),
        x_axis_label=x_label,
        y_axis_label=y_label,
        tools=[
            PanTool(),
            drag,
            wheel,
            ResetTool(),
            SaveTool(),
            HoverTool(
                tooltips=f"<span style='font-size:12px'>{hover}</span>",
                visible=False,  # always on: its button would only take room
            ),
        ],
        active_drag=drag,
        active_scroll=None,  # the wheel scrolls the page until the reader selects the tool
        toolbar_location="right",
        min_border_left=78,  # aligns time axes below one another
    )
    plot.toolbar.logo = None
    plot.toolbar.autohide = True
    return plot


def add_line(plot: Plot, name: str, x: FloatArray, y: FloatArray, pen: Pen) -> None:
    """Draw a line through all points."""
    line = plot.line(
        x="x",
        y="y",
        source=_source(x=x, y=y),
        line_color=pen.color,
        line_width=pen.width,
        line_alpha=pen.alpha,
        line_dash=pen.dash,
        name=name,
    )
    line.visible = pen.visible
    if pen.in_legend:
        _add_to_legend(plot, name, line)


def add_cloud(plot: Plot, name: str, x: FloatArray, y: FloatArray, color: str) -> None:
    """Draw points, evenly sampled if there are many."""
    sample = sampling_slice(x.size)
    cloud = plot.scatter(
        x="x",
        y="y",
        source=_source(x=x[sample], y=y[sample]),
        size=3,
        fill_color=color,
        fill_alpha=0.35,
        line_color=None,
        name=name,
    )
    _add_to_legend(plot, name, cloud)


def add_zero(plot: Plot) -> None:
    """Draw the line of zero error."""
    plot.add_layout(Span(location=0.0, dimension="width", line_color="#66707d", line_width=1))


def set_y_limits(plot: Plot, low: float, high: float) -> None:
    """Show `low` … `high` and a margin; the reader can still zoom out."""
    margin = 0.05 * (high - low) or 0.5
    plot.y_range.start, plot.y_range.end = low - margin, high + margin


def shade_outside(plot: Plot, low: float, high: float) -> None:
    """Shade the figure left of `low` and right of `high`."""
    for left, right in ((None, low), (high, None)):
        plot.add_layout(
            BoxAnnotation(left=left, right=right, fill_color="#9aa4b0", fill_alpha=0.16)
        )


def _source(**columns: FloatArray) -> ColumnDataSource:
    # Single precision halves the page: it resolves 0.03 mV at 400 V and 1 ms in 4 h.
    return ColumnDataSource({name: values.astype(np.float32) for name, values in columns.items()})


def _add_to_legend(plot: Plot, name: str, drawn: Any) -> None:
    if not plot.legend:
        plot.add_layout(Legend(orientation="horizontal", click_policy="hide", items=[]), "above")
    items = list(plot.legend[0].items)
    plot.legend[0].items = [*items, LegendItem(label=name, renderers=[drawn])]


def histogram(quantity: str, unit: str, parts: Sequence[tuple[str, FloatArray, str]]) -> Plot:
    """Return histograms of several series in one figure, each in % of its rows.

    Parameters
    ----------
    quantity, unit : str
    parts : sequence of (name, values, color)
        NaN is left out.
    """
    known = [(name, values[np.isfinite(values)], color) for name, values, color in parts]
    everything = np.concatenate([values for _, values, _ in known])
    # The outermost bars include outliers, which would otherwise compress the rest into one bar.
    limit = float(np.quantile(np.abs(everything), 0.999)) if everything.size else 1.0
    edges = np.linspace(-limit, limit, 61) if limit > 0.0 else np.linspace(-1.0, 1.0, 61)
    plot = new_figure(
        (quantity, "share of rows"),
        f"$name: @y{{0.[00]}} %<br>at @x{{0.[000]}} {unit}",
        units=(unit, "%"),
    )
    for name, values, color in known:
        if not values.size:
            continue
        counts = np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0]
        drawn = plot.vbar(
            x="x",
            top="y",
            width=float(edges[1] - edges[0]),
            source=_source(x=0.5 * (edges[1:] + edges[:-1]), y=100.0 * counts / values.size),
            fill_color=color,
            fill_alpha=0.4,
            line_color=None,
            name=name,
        )
        _add_to_legend(plot, name, drawn)
    return plot


def bars(
    quantity: str, unit: str, entries: Sequence[tuple[str, float, str]], *, decimals: int | None
) -> Plot:
    """Return horizontal bars (name, value, color), each with its value beside it.

    With `decimals` None a value has three significant digits.
    """
    names = [name for name, _, _ in entries]
    values = np.array([value for _, value, _ in entries])

    def shown(value: float) -> str:
        if decimals is None:
            return significant(value, 3, unit)
        return number(value, decimals, unit)

    source = ColumnDataSource(
        {
            "name": names,
            "value": values,
            "color": [color for _, _, color in entries],
            "text": [f" {shown(value)}" for value in values],
        }
    )
    low, high = min(0.0, float(values.min())), max(0.0, float(values.max()))
    plot = new_figure(
        (quantity, ""),
        "@name: @text",
        units=(unit, ""),
        height=60 + 44 * len(entries),
        # Room for the text of the longest bar, also on a narrow screen.
        x_range=Range1d(1.05 * low, 1.3 * high if high > 0.0 else 1.0),
        y_categories=names[::-1],
    )
    plot.hbar(y="name", right="value", height=0.6, color="color", source=source)
    plot.text(
        x="value", y="name", text="text", source=source, text_baseline="middle",
        text_font_size="12px", text_color="#1c2430",
    )  # fmt: skip
    plot.ygrid.grid_line_color = None
    return plot


_LOG_SPACING: Final = 0.004
"""Free space between two logs on the time axis, relative to its length."""


class TimeFigures:
    """Figures over one time axis from zero, on which logs follow one another; they zoom together.

    Parameters
    ----------
    logs : sequence of Recorded

    Attributes
    ----------
    unit : {"s", "min", "h"}
    start : array of shape (k,)
        Where each log begins on the axis, in `unit`.
    end : float
        End of the last log, in `unit`.
    """

    def __init__(self, logs: Sequence[Recorded]) -> None:
        durations_s = np.array([log.duration_s for log in logs])
        spacing_s = _LOG_SPACING * float(durations_s.sum())
        ends_s = np.cumsum(durations_s + spacing_s)
        total_s = max(float(ends_s[-1]) - spacing_s, 1e-3)  # a single row needs an axis too
        units = ((300.0, 1.0, "s"), (6.0 * 3600.0, 60.0, "min"), (np.inf, 3600.0, "h"))
        _, self._unit_s, self.unit = next(unit for unit in units if total_s <= unit[0])
        self.start = np.concatenate(([0.0], ends_s[:-1])) / self._unit_s
        self.end = total_s / self._unit_s
        self._names = [log.name for log in logs]
        self._first_s = [float(log.time_s[0]) for log in logs]
        self._gap_s = [usual_gap_s(log.time_s, GAP_S) for log in logs]
        self._boundaries = self.start[1:] - 0.5 * spacing_s / self._unit_s
        pad = 0.01 * self.end
        limits = (-pad, self.end + pad)
        self.x_range = Range1d(*limits, bounds=limits, min_interval=pad / 50.0)

    @property
    def label(self) -> str:
        """Label of the axis."""
        return f"{'time' if len(self._names) == 1 else 'time, logs in sequence'} [{self.unit}]"

    def at(self, number: int, time_s: FloatArray) -> FloatArray:
        """Return the axis positions of times [s] of log `number`."""
        return np.asarray(self.start[number] + (time_s - self._first_s[number]) / self._unit_s)

    def plot(self, quantity: str, unit: str, *, height: int = 240, names: bool = False) -> Plot:
        """Return an empty figure of a quantity over time.

        Parameters
        ----------
        quantity, unit : str
            For the vertical axis and the hover text.
        height : int
            In pixels.
        names : bool
            Whether to write the logs' names into it.
        """
        plot = new_figure(
            (self.label, quantity),
            f"$name: @y{{0.[000]}} {unit}<br>at @x{{0.[00]}} {self.unit}",
            units=("", unit),
            height=height,
            x_range=self.x_range,
        )
        for boundary in self._boundaries:
            plot.add_layout(
                Span(location=boundary, dimension="height", line_color="#c3cad3", line_width=1)
            )
        if names and len(self._names) > 1:
            for start, name in zip(self.start, self._names, strict=True):
                text = name.replace("$", "")[:22]  # $…$ would be TeX
                label = Label(x=float(start), y=6, y_units="screen", x_offset=12, text=text)
                label.update(angle=1.5708, text_font_size="10px", text_color="#55606e")
                plot.add_layout(label)
        return plot

    def joined(
        self, pieces: Sequence[tuple[FloatArray, FloatArray]], gap_s: float | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return one line through all logs, with NaN at gaps and between logs.

        Parameters
        ----------
        pieces : sequence of (time_s, values), one for each log
        gap_s : float, optional
            Break over steps longer than this [s]; by default over each log's own gaps.
        """
        positions, drawn = [], []
        for k, (time_s, values) in enumerate(pieces):
            limit_s = self._gap_s[k] if gap_s is None else gap_s
            breaks = np.flatnonzero(np.diff(time_s) > limit_s) + 1
            breaks = np.append(breaks, time_s.size)  # separates this log from the next one
            at = self.at(k, time_s)
            positions.append(np.insert(at, breaks, at[breaks - 1]))
            drawn.append(np.insert(values, breaks, np.nan))
        return np.concatenate(positions), np.concatenate(drawn)

    def line(
        self,
        plot: Plot,
        name: str,
        pieces: Sequence[tuple[FloatArray, FloatArray]],
        pen: Pen,
        *,
        gap_s: float | None = None,
    ) -> None:
        """Draw one line through all logs: `pieces` holds (time_s, values) of each."""
        x, y = self.joined(pieces, gap_s)
        rows = extremes(y)
        add_line(plot, name, x[rows], y[rows], pen)

    def band(
        self,
        plot: Plot,
        name: str,
        pieces: Sequence[tuple[FloatArray, FloatArray, FloatArray]],
        color: str,
    ) -> None:
        """Draw a band: `pieces` holds (time_s, low, high) of each log."""
        x, low = self.joined([(time_s, low) for time_s, low, _ in pieces])
        _, high = self.joined([(time_s, high) for time_s, _, high in pieces])
        rows, low, high = envelope(low, high)
        area = plot.varea(
            x="x",
            y1="low",
            y2="high",
            source=_source(x=x[rows], low=low, high=high),
            fill_color=color,
            fill_alpha=0.18,
            name=name,
        )
        _add_to_legend(plot, name, area)


MAX_POINTS: Final = 4000
"""Points of a drawn line: no screen resolves more."""


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
    rows = _buckets(values.size, max_points // (3 if missing.any() else 2))
    kept = [
        _pick(rows, np.where(missing, np.inf, values), np.argmin),
        _pick(rows, np.where(missing, -np.inf, values), np.argmax),
    ]
    if missing.any():
        has_missing = missing[rows].any(axis=1)
        kept.append(_pick(rows, missing.astype(np.float64), np.argmax)[has_missing])
    return np.unique(np.concatenate(kept))


def envelope(
    low: FloatArray, high: FloatArray, max_points: int = MAX_POINTS
) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """Reduce a band to buckets: first row, lowest `low` and highest `high` of each.

    Parameters
    ----------
    low, high : array of shape (n,)
        NaN where the band is unknown; a bucket without any value gives NaN.
    max_points : int
    """
    if low.size <= max_points:
        return np.arange(low.size), low, high
    rows = _buckets(low.size, max_points)
    lowest = np.where(np.isnan(low), np.inf, low)[rows].min(axis=1)
    highest = np.where(np.isnan(high), -np.inf, high)[rows].max(axis=1)
    known = np.isfinite(lowest) & np.isfinite(highest)
    return rows[:, 0], np.where(known, lowest, np.nan), np.where(known, highest, np.nan)


def sampling_slice(n: int, max_points: int = MAX_POINTS) -> slice:
    """Return the slice that samples n points evenly, at most `max_points` of them."""
    return slice(None, None, max(1, -(-n // max_points)))


def _buckets(n: int, count: int) -> NDArray[np.intp]:
    """Return row numbers of shape (≤ count, size); the last row number fills the last bucket."""
    size = -(-n // count)
    rows = np.arange(-(-n // size) * size)
    return np.minimum(rows, n - 1).reshape(-1, size)


def _pick(
    rows: NDArray[np.intp], values: FloatArray, pick: Callable[..., NDArray[np.intp]]
) -> NDArray[np.intp]:
    chosen = pick(values[rows], axis=1)
    return np.asarray(rows[np.arange(rows.shape[0]), chosen])

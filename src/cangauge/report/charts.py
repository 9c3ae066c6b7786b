"""Long series thinned for drawing, so that no peak is lost.

What a report needs of a recording: a log has it, and so have the samples of a capture.

The time axis of a report: one or more logs, one after another, from zero.

Drawing with bokeh: an empty figure with units and tools, lines, clouds, shades.

Figures over one time axis that move together.

Bars: how often a value occurs, and how large several are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

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

from cangauge._formatting import significant
from cangauge._typing import FloatArray
from cangauge.inference.rows import usual_gap_s
from cangauge.model.delay_line import GAP_S

# --- Long series thinned for drawing, so that no peak is lost

POINTS_AT_MOST = 4000
"""A screen shows no more than this many points of a line."""


def extremes(values: FloatArray, at_most: int = POINTS_AT_MOST) -> NDArray[np.intp]:
    """Return the rows to draw: the smallest and the largest value of each bucket of rows.

    Parameters
    ----------
    values : array of shape (n,)
        May hold NaN; a bucket with NaN keeps one, so that the drawn line breaks there too.
    at_most : int
        No more rows than this are returned (6 or more).

    Returns
    -------
    array of shape (m,), m ≤ max(at_most, 0)
        Increasing row numbers; all of them if n ≤ `at_most`.
    """
    if values.size <= at_most:
        return np.arange(values.size)
    missing = np.isnan(values)
    rows = _buckets(values.size, at_most // (3 if missing.any() else 2))
    kept = [_take(rows, np.where(missing, np.inf, values), np.argmin)]
    kept.append(_take(rows, np.where(missing, -np.inf, values), np.argmax))
    if missing.any():
        broken = missing[rows].any(axis=1)
        kept.append(_take(rows, missing.astype(np.float64), np.argmax)[broken])
    return np.unique(np.concatenate(kept))


def envelope(
    low: FloatArray, high: FloatArray, at_most: int = POINTS_AT_MOST
) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """Thin a band: rows (the first of each bucket), lowest `low` and highest `high` of each.

    Parameters
    ----------
    low, high : array of shape (n,)
        NaN where the band is not known; a bucket without any value gives NaN.
    at_most : int
        No more buckets than this.
    """
    if low.size <= at_most:
        return np.arange(low.size), low, high
    rows = _buckets(low.size, at_most)
    lowest = np.where(np.isnan(low), np.inf, low)[rows].min(axis=1)
    highest = np.where(np.isnan(high), -np.inf, high)[rows].max(axis=1)
    known = np.isfinite(lowest) & np.isfinite(highest)
    return rows[:, 0], np.where(known, lowest, np.nan), np.where(known, highest, np.nan)


def every(n: int, at_most: int = POINTS_AT_MOST) -> slice:
    """Return the slice that thins n points of a cloud evenly to no more than `at_most`."""
    return slice(None, None, max(1, -(-n // at_most)))


def _buckets(n: int, number: int) -> NDArray[np.intp]:
    """Return row numbers, shape (≤ number, size); the last row fills up the last bucket."""
    size = -(-n // number)
    rows = np.arange(-(-n // size) * size)
    return np.minimum(rows, n - 1).reshape(-1, size)


def _take(
    rows: NDArray[np.intp], values: FloatArray, pick: Callable[..., NDArray[np.intp]]
) -> NDArray[np.intp]:
    chosen = pick(values[rows], axis=1)
    return np.asarray(rows[np.arange(rows.shape[0]), chosen])


# --- What a report needs of a recording: a log has it, and so have the samples of a capture


class Recorded(Protocol):
    """Series of a drive or test, n rows; voltage, temperature and SoC may hold NaN."""

    @property
    def time_s(self) -> FloatArray:
        """Time [s], increasing."""

    @property
    def current_a(self) -> FloatArray:
        """Current [A], positive = discharge."""

    @property
    def voltage_v(self) -> FloatArray:
        """Voltage [V]."""

    @property
    def temperature_c(self) -> FloatArray:
        """Temperature [°C]."""

    @property
    def soc_pct(self) -> FloatArray | None:
        """Reference SoC [%]."""

    @property
    def name(self) -> str:
        """Short name."""

    @property
    def source(self) -> str:
        """Path of the file."""

    @property
    def temperature_source(self) -> str:
        """What the temperature was measured on."""

    @property
    def remarks(self) -> tuple[str, ...]:
        """What reading it showed."""

    @property
    def duration_s(self) -> float:
        """Time from the first row to the last [s]."""

    def __len__(self) -> int:
        """Return the number of rows."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Samples as they were recorded: unlike a log's, voltage and temperature may be missing.

    Parameters
    ----------
    time_s : array of shape (n,)
        Time [s], not decreasing.
    current_a, voltage_v, temperature_c : array of shape (n,)
        Current [A] (positive = discharge), voltage [V] and temperature [°C], NaN where missing.
    soc_pct : array of shape (n,), optional
        Reference SoC [%], NaN where missing.
    name, source, temperature_source : str
    remarks : tuple of str
    """

    time_s: FloatArray
    current_a: FloatArray
    voltage_v: FloatArray
    temperature_c: FloatArray
    soc_pct: FloatArray | None
    name: str
    source: str
    temperature_source: str
    remarks: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Return the number of rows."""
        return int(self.time_s.size)

    @property
    def duration_s(self) -> float:
        """Time from the first row to the last [s]."""
        return float(self.time_s[-1] - self.time_s[0])


# --- The time axis of a report: one or more logs, one after another, from zero

PAUSE = 0.004
"""Free space between two logs, relative to the whole axis."""


@dataclass(frozen=True, eq=False)
class Timeline:
    """Where the logs lie on the common axis.

    Parameters
    ----------
    names : sequence of str
        The logs' names.
    start : array of shape (k,)
        Where each log begins on the axis, in `unit`.
    first_s : array of shape (k,)
        Its first time stamp [s].
    gap_s : array of shape (k,)
        A line breaks over a longer step of its time [s].
    seconds : float
        Length of the axis' unit [s].
    unit : {"s", "min", "h"}
    pause : float
        Free space between two logs, in `unit`.
    end : float
        End of the last log, in `unit`.
    """

    names: Sequence[str]
    start: FloatArray
    first_s: FloatArray
    gap_s: FloatArray
    seconds: float
    unit: str
    pause: float
    end: float

    @classmethod
    def of(cls, logs: Sequence[Recorded]) -> Timeline:
        """Lay logs out one after another."""
        durations = np.array([log.duration_s for log in logs])
        pause_s = PAUSE * float(durations.sum())
        ends = np.cumsum(durations + pause_s)
        total_s = float(ends[-1]) - pause_s
        total_s = max(total_s, 1e-3)  # one row alone still needs an axis
        seconds, unit = _unit(total_s)
        return cls(
            names=[log.name for log in logs],
            start=np.concatenate(([0.0], ends[:-1])) / seconds,
            first_s=np.array([log.time_s[0] for log in logs]),
            gap_s=np.array([usual_gap_s(log.time_s, GAP_S) for log in logs]),
            seconds=seconds,
            unit=unit,
            pause=pause_s / seconds,
            end=total_s / seconds,
        )

    @property
    def label(self) -> str:
        """Text for the axis."""
        return (
            f"time [{self.unit}]" if len(self.names) == 1 else f"time, logs in turn [{self.unit}]"
        )

    def at(self, number: int, time_s: FloatArray) -> FloatArray:
        """Return the axis positions of times [s] of the log with this number."""
        return np.asarray(self.start[number] + (time_s - self.first_s[number]) / self.seconds)

    def line(
        self, pieces: Sequence[tuple[FloatArray, FloatArray]], *, gap_s: float | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return one line through all logs, with NaN wherever it must break.

        Parameters
        ----------
        pieces : sequence of (time_s, values), one for each log
        gap_s : float, optional
            Break over steps longer than this [s]; by default over the logs' own gaps.
        """
        places, drawn = [], []
        for number, (time_s, values) in enumerate(pieces):
            limit_s = self.gap_s[number] if gap_s is None else gap_s
            breaks = np.flatnonzero(np.diff(time_s) > limit_s) + 1
            # A break at the end parts this log from the next one.
            breaks = np.append(breaks, time_s.size)
            at = self.at(number, time_s)
            places.append(np.insert(at, breaks, at[breaks - 1]))
            drawn.append(np.insert(values, breaks, np.nan))
        return np.concatenate(places), np.concatenate(drawn)


def _unit(total_s: float) -> tuple[float, str]:
    if total_s <= 300.0:
        return 1.0, "s"
    return (60.0, "min") if total_s <= 6.0 * 3600.0 else (3600.0, "h")


# --- Drawing with bokeh: an empty figure with units and tools, lines, clouds, shades

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


# --- Figures over one time axis that move together

NAMES_LEVEL_AT_MOST = 12
"""More log names than this are written upright, to find room."""

PROBES = 2000
"""Times over the axis at which the pointer shows the values of all lines together."""

LETTERS_ACROSS = 160
"""So many small letters fit side by side over the whole time axis."""


class _Probe:
    """What the pointer shows: the values of all lines of a figure at one time, in one box.

    The lines are thinned each for itself, so they share no rows; an unseen line with the values
    of all of them at common times carries the box.
    """

    def __init__(self, plot: Plot, timeline: Timeline, unit: str) -> None:
        self._plot = plot
        self._unit = unit
        self._at = np.linspace(0.0, timeline.end, PROBES)
        self._source = table_of(x=self._at)
        self._text = [f"at @x{{0.[00]}} {timeline.unit}"]

    def add(self, name: str, x: FloatArray, y: FloatArray) -> None:
        """Take in one more line (x increasing, y may hold NaN)."""
        right = np.clip(np.searchsorted(x, self._at), 1, max(x.size - 1, 1))
        left = right - 1
        right = np.minimum(right, x.size - 1)
        nearest = np.where(self._at - x[left] < x[right] - self._at, left, right)
        number = len(self._text)
        self._source.add(y[nearest].astype(np.float32), f"y{number}")
        self._text.append(f"{name}: @y{number}{{0.[000]}} {self._unit}")
        hover = self._plot.select_one(HoverTool)
        hover.tooltips = f"<div style='font-size:12px'>{'<br>'.join(self._text)}</div>"
        if number == 1:
            unseen = self._plot.line(x="x", y="y1", source=self._source, line_alpha=0.0)
            hover.renderers = [unseen]
            hover.point_policy = "follow_mouse"


class TimeFigures:
    """Figures over the same time axis; zooming one zooms all.

    Parameters
    ----------
    timeline : Timeline
    """

    def __init__(self, timeline: Timeline) -> None:
        self.timeline = timeline
        self._probes: dict[str, _Probe] = {}
        pad = 0.01 * timeline.end
        self.x_range = Range1d(
            -pad, timeline.end + pad, bounds=(-pad, timeline.end + pad), min_interval=pad / 50.0
        )

    def plot(self, quantity: str, unit: str, *, height: int = 240, names: bool = False) -> Plot:
        """Return an empty figure of a quantity over time.

        Parameters
        ----------
        quantity, unit : str
            For the vertical axis and the hover text.
        height : int
            In screen pixels.
        names : bool
            Whether to write the logs' names into it.
        """
        plot = plane(
            (self.timeline.label, quantity),
            "",
            units=("", unit),
            height=height,
            x_range=self.x_range,
            hover_mode="vline",
        )
        self._probes[plot.id] = _Probe(plot, self.timeline, unit)
        for number, name in enumerate(self.timeline.names):
            if number:
                place = self.timeline.start[number] - 0.5 * self.timeline.pause
                plot.add_layout(
                    Span(location=place, dimension="height", line_color="#c3cad3", line_width=1)
                )
            if names and len(self.timeline.names) > 1:
                plot.add_layout(self._name(number, name))
        return plot

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
        x, y = self.timeline.line(pieces, gap_s=gap_s)
        rows = extremes(y)
        add_line(plot, name, x[rows], y[rows], pen)
        self._probes[plot.id].add(name, x, y)

    def band(
        self,
        plot: Plot,
        name: str,
        pieces: Sequence[tuple[FloatArray, FloatArray, FloatArray]],
        color: str,
    ) -> None:
        """Draw a band: `pieces` holds (time_s, low, high) of each log."""
        x, low = self.timeline.line([(time_s, low) for time_s, low, _ in pieces])
        _, high = self.timeline.line([(time_s, high) for time_s, _, high in pieces])
        rows, low, high = envelope(low, high)
        area = plot.varea(
            x="x",
            y1="low",
            y2="high",
            source=table_of(x=x[rows], low=low, high=high),
            fill_color=color,
            fill_alpha=0.18,
            name=name,
        )
        add_to_legend(plot, name, area)

    def _letters(self, number: int) -> int:
        """Return how many letters of a name fit before the next log begins."""
        ends = [*self.timeline.start[1:], self.timeline.end]
        share = (ends[number] - self.timeline.start[number]) / self.timeline.end
        return max(3, int(share * LETTERS_ACROSS))

    def _name(self, number: int, name: str) -> Label:
        upright = len(self.timeline.names) > NAMES_LEVEL_AT_MOST
        return Label(
            x=float(self.timeline.start[number]),
            y=6,
            y_units="screen",
            x_offset=12 if upright else 3,
            text=name.replace("$", "")[: 22 if upright else self._letters(number)],
            angle=1.5708 if upright else 0.0,
            text_font_size="10px",
            text_color="#55606e",
            background_fill_color="#ffffff",
            background_fill_alpha=0.75,
        )


# --- Bars: how often a value occurs, and how large several are


def histogram(quantity: str, unit: str, parts: Sequence[tuple[str, FloatArray, str]]) -> Plot:
    """Return a figure of how often each value occurs, in % of each part's rows.

    Parameters
    ----------
    quantity, unit : str
    parts : sequence of (name, values, color)
        Values may hold NaN, which is left out.
    """
    known = [(name, values[np.isfinite(values)], color) for name, values, color in parts]
    everything = np.concatenate([values for _, values, _ in known])
    # A few far values must not squeeze the rest into one bar.
    limit = float(np.quantile(np.abs(everything), 0.999)) if everything.size else 1.0
    edges = np.linspace(-limit, limit, 61) if limit > 0.0 else np.linspace(-1.0, 1.0, 61)
    plot = plane(
        (quantity, "share of rows"),
        f"$name: @y{{0.[00]}} %<br>at @x{{0.[000]}} {unit}",
        units=(unit, "%"),
    )
    for name, values, color in known:
        if not values.size:
            continue
        share = 100.0 * np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0] / values.size
        middle = 0.5 * (edges[1:] + edges[:-1])
        bars = plot.vbar(
            x="x",
            top="y",
            width=float(edges[1] - edges[0]),
            source=table_of(x=middle, y=share),
            fill_color=color,
            fill_alpha=0.4,
            line_color=None,
            name=name,
        )
        add_to_legend(plot, name, bars)
    return plot


def bars(quantity: str, unit: str, entries: Sequence[tuple[str, float, str]]) -> Plot:
    """Return horizontal bars (name, value, color), each with its value written beside it."""
    names = [name for name, _, _ in entries]
    plot = plane(
        (quantity, ""),
        "@name: @text",
        units=(unit, ""),
        height=60 + 44 * len(entries),
        y_categories=names[::-1],
    )
    values = np.array([value for _, value, _ in entries])
    source = ColumnDataSource(
        {
            "name": names,
            "value": values,
            "color": [color for _, _, color in entries],
            "text": [f" {significant(value, 4, unit)}" for value in values],
        }
    )
    plot.hbar(y="name", right="value", height=0.6, color="color", source=source)
    plot.text(
        x="value", y="name", text="text", source=source, text_baseline="middle",
        text_font_size="12px", text_color="#1c2430",
    )  # fmt: skip
    low, high = min(0.0, float(values.min())), max(0.0, float(values.max()))
    plot.x_range = Range1d(1.05 * low, 1.18 * high if high > 0.0 else 1.0)
    plot.ygrid.grid_line_color = None
    return plot

"""Figures over one time axis that move together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from bokeh.models import HoverTool, Label, Range1d, Span
from numpy.typing import NDArray

from cangauge.report.decimate import envelope, extremes
from cangauge.report.figures import Pen, Plot, add_line, add_to_legend, plane, table_of
from cangauge.report.timeline import Timeline

FloatArray = NDArray[np.float64]

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

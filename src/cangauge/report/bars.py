"""Bars: how often a value occurs, and how large several are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from bokeh.models import ColumnDataSource, Range1d
from numpy.typing import NDArray

from cangauge.report.figures import Plot, add_to_legend, plane, table_of
from cangauge.report.words import significant

FloatArray = NDArray[np.float64]


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

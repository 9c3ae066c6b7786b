"""Where the gap lies: maps over SoC and a second quantity, and shares with their intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from bokeh.models import ColorBar, ColumnDataSource, LinearColorMapper, Range1d, Whisker
from bokeh.palettes import Viridis256
from numpy.typing import NDArray

from cangauge.gap.before_after import LogErrors
from cangauge.gap.maps import LEAST_ROWS, ErrorMap, error_map
from cangauge.gap.where import Place
from cangauge.report.figures import BLACK, SKY, Plot, plane
from cangauge.report.page import Beside, Block, Figure
from cangauge.report.words import number, span

FloatArray = NDArray[np.float64]

LONGEST_S = 1e6
MINUTES_FROM_S = 600.0
AXES: Final = {
    "soc": ("state of charge", "%"),
    "current": ("current", "A"),
    "temperature": ("temperature", "°C"),
    "rest": ("rest and drive", ""),
    "time": ("time since the start", "min"),
    "timescale": ("time scale of the error", "s"),
}
SHADES: Final = tuple(Viridis256[::-1])
"""Light for a small error, dark for a large one."""


def map_figures(errors: Sequence[LogErrors], extended: str | None) -> list[Block]:
    """Return the maps of the error, before and after in the same shades.

    Parameters
    ----------
    errors : sequence of LogErrors
        Of all diagnosed logs.
    extended : str, optional
        What the extended model adds, in words; without it only the maps before are drawn.
    """
    rows = [item.prepared.rows for item in errors]
    soc = np.concatenate([item.soc_pct for item in rows])
    others = {
        "current": np.concatenate([item.delayed_current_a[:, 0] for item in rows]),
        "temperature": np.concatenate([item.temperature_c for item in rows]),
    }
    before = np.concatenate([item.before_v for item in errors])
    after = np.concatenate([item.after_v for item in errors])
    maps = {
        (axis, when): error_map(soc, values, error_v, tails=axis == "current")
        for axis, values in others.items()
        for when, error_v in (("before", before), ("after", after))
    }
    most = max(_largest(each) for each in maps.values())
    drawn: list[Block] = [
        Beside([_map(axis, maps[axis, "before"], most, "model as given") for axis in others])
    ]
    if extended:
        drawn.append(Beside([_map(axis, maps[axis, "after"], most, extended) for axis in others]))
    return drawn


def _largest(each: ErrorMap) -> float:
    known = each.rms_v[np.isfinite(each.rms_v)]
    return float(known.max()) if known.size else 0.0


def _map(axis: str, each: ErrorMap, most: float, model: str) -> Figure:
    quantity, unit = AXES[axis]
    return Figure(
        f"RMS error over SoC × {quantity}, {model}",
        heat_map(each, (quantity, unit), most),
        _map_words(each, unit),
    )


def heat_map(each: ErrorMap, axis: tuple[str, str], most_v: float) -> Plot:
    """Return the drawing of a map.

    Parameters
    ----------
    each : ErrorMap
    axis : pair of str
        Second quantity and its unit.
    most_v : float
        Error of the darkest shade [V].
    """
    quantity, unit = axis
    plot = plane(
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
            "range": [_range(each, int(k), unit) for k in up],
            "rms": each.rms_v[up, across],
            "mean": each.mean_v[up, across],
            "rows": each.rows[up, across],
        }
    )
    shades = LinearColorMapper(palette=list(SHADES), low=0.0, high=max(most_v, 1e-3))
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
    plot.toolbar.autohide = True
    return plot


def _map_words(each: ErrorMap, unit: str) -> str:
    if not np.isfinite(each.rms_v).any():
        return f"No bin holds {LEAST_ROWS} rows: the logs are too short for a map."
    up, across = np.unravel_index(int(np.nanargmax(each.rms_v)), each.rms_v.shape)
    low, high = each.soc_edges_pct[across], each.soc_edges_pct[across + 1]
    return (
        f"Largest {each.rms_v[up, across]:.2f} V (mean {number(float(each.mean_v[up, across]), 2)}"
        f" V) at {span(low, high, 0)} % and {_range(each, int(up), unit)}."
        f" Bins with fewer than {LEAST_ROWS} rows are empty."
        + (" The top and the bottom ones hold all beyond." if each.tails else "")
    )


def _range(each: ErrorMap, up: int, unit: str) -> str:
    """Return what a bin of the second quantity holds, in words."""
    low, high = float(each.edges[up]), float(each.edges[up + 1])
    digits = digits_of(high - low)
    if each.tails and up == each.edges.size - 2:
        return f"over {number(low, digits, unit)}"
    if each.tails and up == 0:
        return f"below {number(high, digits, unit)}"
    return span(low, high, digits, unit)


def share_figures(places: Sequence[Place]) -> list[Block]:
    """Return the shares of the squared error over every axis, two figures in a row."""
    drawn = []
    for axis, (quantity, unit) in AXES.items():
        mine = [place for place in places if place.axis == axis]
        if mine:
            in_unit = f" [{unit}]" if unit else ""
            drawn.append(
                Figure(
                    f"Share of the squared error: {quantity}{in_unit}",
                    _share_bars(mine),
                    _share_words(mine, unit),
                )
            )
    return [Beside(drawn[at : at + 2]) for at in range(0, len(drawn), 2)]


def _share_bars(places: Sequence[Place]) -> Plot:
    digits = _digits(places)
    names = [place_range(place, digits) for place in places]
    plot = plane(
        ("share of the squared error", ""),
        "@name: @share{0.0} % (@low{0.0} … @high{0.0} %), RMS @rms{0.00} V there",
        units=("%", ""),
        height=72 + 26 * max(len(places), 3),
        x_range=Range1d(0.0, 128.0),
        y_categories=names[::-1],
    )
    ends = [max(100.0 * place.ci[1], 100.0 * place.share) for place in places]
    source = ColumnDataSource(
        {
            "name": names,
            "share": [100.0 * place.share for place in places],
            "low": [100.0 * place.ci[0] for place in places],
            "high": [100.0 * place.ci[1] for place in places],
            "end": ends,
            "rms": [place.rmse_v for place in places],
            "text": [f"  {100.0 * p.share:.0f} %, {p.rmse_v:.2f} V" for p in places],
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
    plot.toolbar.autohide = True
    return plot


def _share_words(places: Sequence[Place], unit: str) -> str:
    most = max(places, key=lambda place: place.share)
    low, high = most.ci
    where = f"{place_range(most, _digits(places))} {unit}".rstrip()
    return (
        f"Most lies at {where}: {100.0 * most.share:.0f} % (95 % interval"
        f" {100.0 * low:.0f} … {100.0 * high:.0f} %), {most.rmse_v:.2f} V RMS there."
    )


def _digits(places: Sequence[Place]) -> int:
    """Return with how many digits the narrowest place has two ends: a cell has few amperes."""
    return digits_of(min(place.high - place.low for place in places))


def digits_of(width: float) -> int:
    """Return how many digits tell edges that are so far apart."""
    return max(0, math.ceil(math.log10(2.0 / max(width, 1e-6))))


def place_range(place: Place, digits: int) -> str:
    """Return a place's range in words, in the unit of `AXES`."""
    if place.axis == "rest":
        return "rest" if place.low > 0.0 else "drive"
    if place.axis == "time":
        return span(place.low / 60.0, place.high / 60.0, 0 if place.high > MINUTES_FROM_S else 1)
    if place.axis == "timescale" and place.high >= LONGEST_S:
        return f"over {number(place.low, 0)}"
    return span(place.low, place.high, digits)

"""The worst moments as small multiples: error before and after, and current, a minute around.

How far the gap shrinks: the error over time before and after, and by log.

How large the gap is: in volts and in % SoC, against the two floors.

Where the gap lies: maps over SoC and a second quantity, and shares with their intervals.

The page of `cangauge gap`: how large, where, which effect, how far it shrinks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from bokeh.layouts import gridplot
from bokeh.models import ColorBar, ColumnDataSource, LinearColorMapper, Range1d, Span, Whisker
from bokeh.palettes import Viridis256

from cangauge._formatting import number, significant, span
from cangauge._typing import FloatArray
from cangauge.diagnosis import (
    MIN_BIN_ROWS,
    NONE,
    SEGMENT_S,
    UNKNOWN,
    Diagnosis,
    ErrorMap,
    ErrorShare,
    LogErrors,
    SegmentSignals,
    WorstSegment,
    error_map,
    rms,
    segment_signals,
)
from cangauge.model.effects.library import LIBRARY
from cangauge.report.charts import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    SKY,
    Pen,
    Plot,
    TimeFigures,
    Timeline,
    add_line,
    add_zero,
    bars,
    extremes,
    plane,
)
from cangauge.report.page import (
    Beside,
    Block,
    Bullets,
    Figure,
    Page,
    Paragraph,
    Section,
    Table,
    Tile,
    reconstruction_banners,
    render,
)
from cangauge.report.tables import verdict_limit

# --- The worst moments as small multiples: error before and after, and current, a minute around

POINTS_AT_MOST = 600
"""Of the current around one moment."""

IN_A_ROW = 2


def moment_figures(
    moments: Sequence[WorstSegment], errors: Sequence[LogErrors], extended: str
) -> list[Block]:
    """Return a figure for each moment, all on the same scales, and their table.

    Parameters
    ----------
    moments : sequence of WorstSegment
        The worst first.
    errors : sequence of LogErrors
        Of all diagnosed logs.
    extended : str
        What the extended model adds, in words.
    """
    seen = [segment_signals(moment, errors) for moment in moments]
    volts = _moment_range([each.before_v for each in seen] + [each.after_v for each in seen])
    amperes = _moment_range([each.current_a for each in seen])
    drawn = [
        Figure(
            f"{rank}. {moment.log} at {number(moment.time_s, 0)} s",
            _small(each, volts, amperes, extended),
            f"{number(moment.residual_v, 2)} V at {number(moment.soc_pct, 1)} %,"
            f" {number(moment.current_a, 1)} A and {number(moment.temperature_c, 1)} °C; with the"
            f" extended model {number(_at(each), 2)} V.",
        )
        for rank, (moment, each) in enumerate(zip(moments, seen, strict=True), start=1)
    ]
    rows = [Beside(drawn[at : at + IN_A_ROW]) for at in range(0, len(drawn), IN_A_ROW)]
    return [*rows, _moments_table(moments, seen)]


def _at(each: SegmentSignals) -> float:
    return float(each.after_v[np.argmin(np.abs(each.time_s))])


def _moment_range(values: Sequence[FloatArray]) -> tuple[float, float]:
    whole = np.concatenate([*values, np.zeros(1)])
    margin = 0.06 * float(np.ptp(whole)) or 1.0
    return float(whole.min()) - margin, float(whole.max()) + margin


def _small(
    each: SegmentSignals, volts: tuple[float, float], amperes: tuple[float, float], extended: str
) -> Plot:
    x_range = Range1d(-SEGMENT_S, SEGMENT_S)
    above = plane(
        ("", "measured − model"), "$name: @y{0.00} V<br>at @x{0.0} s", units=("", "V"),
        height=190, x_range=x_range,
    )  # fmt: skip
    add_zero(above)
    add_line(above, "model as given", each.time_s, each.before_v, Pen(ORANGE, width=1.6))
    add_line(above, extended, each.time_s, each.after_v, Pen(BLUE, width=1.6))
    above.y_range = Range1d(*volts)
    above.xaxis.visible = False
    below = plane(
        ("time from the moment", "current"), "@y{0.0} A<br>at @x{0.0} s", units=("s", "A"),
        height=150, x_range=x_range,
    )  # fmt: skip
    thin = extremes(each.current_a, POINTS_AT_MOST)
    add_line(
        below, "current", each.current_time_s[thin], each.current_a[thin],
        Pen(GREY, width=1.4, in_legend=False),
    )  # fmt: skip
    below.y_range = Range1d(*amperes)
    for plot in (above, below):
        plot.add_layout(
            Span(location=0.0, dimension="height", line_color="#c3cad3", line_dash="dashed")
        )
        plot.yaxis.ticker.desired_num_ticks = 4
    return gridplot(
        [[above], [below]],
        sizing_mode="stretch_width",
        merge_tools=True,
        toolbar_location="right",
        toolbar_options={"logo": None, "autohide": True},
    )


def _moments_table(moments: Sequence[WorstSegment], seen: Sequence[SegmentSignals]) -> Table:
    rows = [
        [
            str(rank),
            moment.log,
            number(moment.time_s, 0),
            number(moment.residual_v, 2),
            number(_at(each), 2),
            number(moment.soc_pct, 1),
            number(moment.current_a, 1),
            number(moment.temperature_c, 1),
        ]
        for rank, (moment, each) in enumerate(zip(moments, seen, strict=True), start=1)
    ]
    return Table(
        ["", "log", "time in the log [s]", "measured − model [V]", "with the extended model [V]",
         "SoC [%]", "current [A]", "temperature [°C]"],
        rows,
        note="At least a minute apart. Positive current discharges.",
    )  # fmt: skip


# --- How far the gap shrinks: the error over time before and after, and by log


def shrink_figures(errors: Sequence[LogErrors], extended: str) -> list[Block]:
    """Return the error over time and each log's figures.

    Parameters
    ----------
    errors : sequence of LogErrors
        Of all diagnosed logs.
    extended : str
        What the extended model adds, in words.
    """
    logs = [item.prepared.log for item in errors]
    time = TimeFigures(Timeline.of(logs))
    plot = time.plot("measured − model", "V", height=300, names=True)
    lines = (
        ("model as given", ORANGE, [item.before_v for item in errors]),
        (extended, BLUE, [item.after_v for item in errors]),
    )
    for name, color, values in lines:
        pieces = [
            (item.prepared.rows.time_s, each) for item, each in zip(errors, values, strict=True)
        ]
        time.line(plot, name, pieces, Pen(color, width=1.0, alpha=0.85))
    add_zero(plot)
    current = time.plot("current", "A", height=170)
    time.line(
        current, "current", [(log.time_s, log.current_a) for log in logs],
        Pen(GREY, width=1.0, in_legend=False),
    )  # fmt: skip
    return [
        Figure(
            "Measured minus modelled voltage, before and after",
            plot,
            "These rows took part in the extended model's fit; how much remains on rows that did"
            " not is in the table of the gap's size above.",
        ),
        Figure("Current", current, "What the pack did meanwhile; above zero it is discharged."),
        _logs_table(errors),
    ]


def _logs_table(errors: Sequence[LogErrors]) -> Table:
    rows = []
    for item in errors:
        seen, before, after = item.prepared.rows, rms(item.before_v), rms(item.after_v)
        rows.append(
            [
                item.prepared.log.name,
                number(item.prepared.log.duration_s / 60.0, 1),
                span(float(seen.soc_pct.max()), float(seen.soc_pct.min()), 0),
                span(float(seen.temperature_c.min()), float(seen.temperature_c.max()), 0),
                number(before, 2),
                number(after, 2),
                number(float(np.mean(item.before_v)), 2),
                number(float(np.mean(item.after_v)), 2),
            ]
        )
    return Table(
        ["log", "duration [min]", "SoC [%]", "temperature [°C]", "RMS before [V]",
         "RMS after [V]", "mean before [V]", "mean after [V]"],
        rows,
        note="On the rows of the fit: after is a little smaller than on rows left out.",
    )  # fmt: skip


# --- How large the gap is: in volts and in % SoC, against the two floors


def size_blocks(diagnosis: Diagnosis, extended: str) -> list[Block]:
    """Return the gap's size as bars and as a table.

    Parameters
    ----------
    diagnosis : Diagnosis
    extended : str
        What the extended model adds, in words.
    """
    slope = slope_v_per_pct(diagnosis)
    entries = [
        ("model as given", diagnosis.baseline_rmse_v, ORANGE,
         diagnosis.baseline_soc_mae_pct, "these logs"),
        (extended, diagnosis.extended_rmse_v, BLUE,
         diagnosis.extended_soc_mae_pct, "these logs, rows that its fit did not see"),
        (_floor_name(diagnosis), diagnosis.floor_v, GREY, None, _floor_words(diagnosis)),
    ]  # fmt: skip
    if diagnosis.explainable_v is not None:
        entries.append(
            ("floor: explainable", diagnosis.explainable_v, GREEN, None,
             "a reference left out, with the structure that the others teach")
        )  # fmt: skip
    rows = [
        [name, number(volts, 2), number(volts / slope, 2), number(soc, 2), judged]
        for name, volts, _, soc, judged in entries
    ]
    return [
        Figure(
            "Error and floors",
            bars("RMS error", "V", [(name, volts, color) for name, volts, color, _, _ in entries]),
            _see(diagnosis),
        ),
        Table(
            ["", "RMS [V]", "as SoC [%]", "SoC error of the estimator [%]", "judged on"],
            rows,
            note=f"As SoC: volts over the median slope of the pseudo-OCV here,"
            f" {slope:.2f} V per %. The estimator's is the mean absolute error of the EKF with the"
            " initial SoC withheld, after 5 minutes; – where the logs do not tell their SoC.",
        ),
    ]


def slope_v_per_pct(diagnosis: Diagnosis) -> float:
    """Return the median slope of the pseudo-OCV over the diagnosed rows [V per %]."""
    problem = diagnosis.problem
    soc = np.concatenate([terms.prepared.rows.soc_pct for terms in problem.diagnosed])
    return float(np.median(problem.given.model.pseudo_ocv_slope(soc)))


def _floor_name(diagnosis: Diagnosis) -> str:
    return "floor: references" if diagnosis.problem.references else "floor: model file"


def _floor_words(diagnosis: Diagnosis) -> str:
    if diagnosis.problem.references:
        return "references, with the model as given: sensors and what repeats no better"
    return "what the model file states, for want of references"


def _see(diagnosis: Diagnosis) -> str:
    times = diagnosis.baseline_rmse_v / max(diagnosis.floor_v, 1e-9)
    words = f"The model's error here is {times:.1f} times that on the references."
    if not diagnosis.problem.references:
        words = f"The model's error here is {times:.1f} times what its file states."
    if diagnosis.explainable_v is None:
        return words + " The second floor, what flexible structure explains, needs more references."
    return (
        words
        + " What lies above both floors is the gap; between them, structure that the model lacks"
        " would explain it without any cause."
    )


# --- Where the gap lies: maps over SoC and a second quantity, and shares with their intervals

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
            "range": [_map_range(each, int(k), unit) for k in up],
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
        return f"No bin holds {MIN_BIN_ROWS} rows: the logs are too short for a map."
    up, across = np.unravel_index(int(np.nanargmax(each.rms_v)), each.rms_v.shape)
    low, high = each.soc_edges_pct[across], each.soc_edges_pct[across + 1]
    return (
        f"Largest {each.rms_v[up, across]:.2f} V (mean {number(float(each.mean_v[up, across]), 2)}"
        f" V) at {span(low, high, 0)} % and {_map_range(each, int(up), unit)}."
        f" Bins with fewer than {MIN_BIN_ROWS} rows are empty."
        + (" The top and the bottom ones hold all beyond." if each.tails else "")
    )


def _map_range(each: ErrorMap, up: int, unit: str) -> str:
    """Return what a bin of the second quantity holds, in words."""
    low, high = float(each.edges[up]), float(each.edges[up + 1])
    digits = digits_of(high - low)
    if each.tails and up == each.edges.size - 2:
        return f"over {number(low, digits, unit)}"
    if each.tails and up == 0:
        return f"below {number(high, digits, unit)}"
    return span(low, high, digits, unit)


def share_figures(places: Sequence[ErrorShare]) -> list[Block]:
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


def _share_bars(places: Sequence[ErrorShare]) -> Plot:
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


def _share_words(places: Sequence[ErrorShare], unit: str) -> str:
    most = max(places, key=lambda place: place.share)
    low, high = most.ci
    where = f"{place_range(most, _digits(places))} {unit}".rstrip()
    return (
        f"Most lies at {where}: {100.0 * most.share:.0f} % (95 % interval"
        f" {100.0 * low:.0f} … {100.0 * high:.0f} %), {most.rmse_v:.2f} V RMS there."
    )


def _digits(places: Sequence[ErrorShare]) -> int:
    """Return with how many digits the narrowest place has two ends: a cell has few amperes."""
    return digits_of(min(place.high - place.low for place in places))


def digits_of(width: float) -> int:
    """Return how many digits tell edges that are so far apart."""
    return max(0, math.ceil(math.log10(2.0 / max(width, 1e-6))))


def place_range(place: ErrorShare, digits: int) -> str:
    """Return a place's range in words, in the unit of `AXES`."""
    if place.axis == "rest":
        return "rest" if place.low > 0.0 else "drive"
    if place.axis == "time":
        return span(place.low / 60.0, place.high / 60.0, 0 if place.high > MINUTES_FROM_S else 1)
    if place.axis == "timescale" and place.high >= LONGEST_S:
        return f"over {number(place.low, 0)}"
    return span(place.low, place.high, digits)


# --- The page of `cangauge gap`: how large, where, which effect, how far it shrinks

SHOWN = 8
UNITS = {"1": "", "ohm": " Ω"}
"""Units that a reader writes otherwise than the model file."""


def gap_report(diagnosis: Diagnosis) -> str:
    """Return the diagnosis as one self-contained HTML page."""
    return render(gap_page(diagnosis))


def gap_page(diagnosis: Diagnosis) -> Page:
    """Return the page of a diagnosis."""
    logs = [terms.prepared.log for terms in diagnosis.problem.diagnosed]
    names = ", ".join(log.name for log in logs)
    errors = diagnosis.log_errors()
    extended = _extended(diagnosis)
    sections = [
        Section("How large it is", size_blocks(diagnosis, extended)),
        Section(
            "Where it lies",
            [*map_figures(errors, extended), *share_figures(diagnosis.error_breakdown)],
        ),
        Section("Which effect", _which(diagnosis)),
        Section("How far it shrinks", [_shrinks(diagnosis), *shrink_figures(errors, extended)]),
        Section("The worst moments", moment_figures(diagnosis.worst_segments, errors, extended)),
        Section("How much of each effect these logs can show", _observability(diagnosis)),
        Section("How it was done", [Bullets(_method(diagnosis, names))]),
    ]
    open_question, cannot = verdict_limit(diagnosis), diagnosis.caveats
    if open_question or cannot:
        said = [open_question] if open_question else []
        sections.insert(0, Section("What these logs cannot show", [Bullets([*said, *cannot])]))
    return Page(
        title="Gap between model and log",
        subtitle=diagnosis.summary,
        tiles=_tiles(diagnosis),
        sections=sections,
        banners=reconstruction_banners(names, *(log.source for log in logs)),
    )


def _extended(diagnosis: Diagnosis) -> str:
    """Return what the extended model adds, in words."""
    accepted = diagnosis.extension.cause
    if accepted:
        return f"with {' and '.join(accepted)}"
    return "with what references add" if diagnosis.problem.references else "nothing added"


def _tiles(diagnosis: Diagnosis) -> list[Tile]:
    verdict = diagnosis.verdict
    before, after = diagnosis.baseline_soc_mae_pct, diagnosis.extended_soc_mae_pct
    tiles = [
        Tile("Verdict", verdict.cause.replace("_", " "), f"probability {verdict.probability:.2f}"),
        Tile("Error of the model", number(diagnosis.baseline_rmse_v, 2, "V"), "RMS, these logs"),
        Tile("Extended model", number(diagnosis.extended_rmse_v, 2, "V"), "RMS, rows left out"),
        Tile(
            "Floor: references" if diagnosis.problem.references else "Floor: model file",
            number(diagnosis.floor_v, 2, "V"),
            "RMS, model as given",
        ),
    ]
    if diagnosis.explainable_v is not None:
        tiles.append(
            Tile(
                "Floor: explainable",
                number(diagnosis.explainable_v, 2, "V"),
                "RMS, with references' structure",
            )
        )
    if diagnosis.closed_fraction is not None:
        hint = "of its square, above the floor"
        if diagnosis.closed_fraction_ci is not None:
            low, high = diagnosis.closed_fraction_ci
            hint = f"squared; 95 %: {_percents(low, high)}"
        tiles.append(Tile("Gap closed", _percent(diagnosis.closed_fraction), hint))
    if before is not None:
        tiles.append(
            Tile(
                "SoC error (EKF)",
                f"{significant(before, 2)} → {significant(after, 2, '%')}",
                "mean, before → extended",
            )
        )
    return tiles


def _shrinks(diagnosis: Diagnosis) -> Paragraph:
    before, after = diagnosis.baseline_rmse_v, diagnosis.extended_rmse_v
    words = f"On rows left out of the fit: {before:.2f} V before, {after:.2f} V after."
    if diagnosis.closed_fraction is not None:
        words += f" That closes {_percent(diagnosis.closed_fraction)}"
        if diagnosis.closed_fraction_ci is not None:
            low, high = diagnosis.closed_fraction_ci
            words += f" (95 % interval {_percents(low, high)})"
        words += " of the squared gap above the floor."
    if not diagnosis.problem.references:
        return Paragraph(words)
    added = "the cause and " if diagnosis.extension.cause else "no cause, only "
    return Paragraph(
        f"{words} The extended model has {added}what the references teach: coefficients moved, and"
        " structure that logs without a cause show as well."
    )


def _percent(part: float) -> str:
    return number(100.0 * part, 0, "%")


def _percents(low: float, high: float) -> str:
    return span(100.0 * low, 100.0 * high, 0, "%")


def _which(diagnosis: Diagnosis) -> list[Block]:
    verdict = diagnosis.verdict
    blocks: list[Block] = [Paragraph(_cause_words(diagnosis))]
    ranked = diagnosis.candidates[:SHOWN]
    chances = [
        (name, 100.0 * verdict.probabilities[name], BLUE if name == verdict.cause else GREY)
        for name in (*(str(item["effect"]) for item in ranked), UNKNOWN, NONE)
    ]
    blocks.append(
        Figure(
            "How probable each cause is",
            bars("probability", "%", chances),
            "By evidence, and by what each takes away: how often it was so on other packs.",
        )
    )
    rows = [_candidate_row(item) for item in ranked]
    blocks.append(
        Table(
            ["effect", "log evidence", "error left out [V]", "closed", "parameters (95 %)"],
            rows,
            note="Errors are on rows that the fit of the effect did not see.",
        )
    )
    return blocks


def _cause_words(diagnosis: Diagnosis) -> str:
    verdict = diagnosis.verdict
    if verdict.cause == NONE:
        return "What these logs show, clean ones may show as well."
    if verdict.cause == UNKNOWN:
        return (
            "Something differs, but no effect of the library is likely enough to be the cause: the"
            f" best one, {verdict.candidates[0].effect_id}, takes"
            f" {100.0 * verdict.explained:.0f} % of the gap away."
        )
    effect = LIBRARY[verdict.cause]
    words = f"{verdict.cause}: {effect.signature}. {effect.equation}."
    if verdict.ambiguous_with:
        words += (
            f" These logs cannot tell it from {', '.join(verdict.ambiguous_with)};"
            f" what would: {effect.separated_by}."
        )
    return words + " A label is a signature at the terminals, not proof of a mechanism."


def _candidate_row(item: dict[str, Any]) -> list[str]:
    closed = item["closed_fraction"]
    parameters = "; ".join(
        f"{name} {significant(each['value'], 3)}"
        + ("" if each["ci"] is None else f" ({span(each['ci'][0], each['ci'][1], 3)})")
        + UNITS.get(each["unit"], f" {each['unit']}")
        for name, each in item["parameters"].items()
    )
    return [
        str(item["effect"]),
        number(item["log_bayes_factor"], 1),
        number(item["rmse_v"], 2),
        "–" if closed is None else _percent(closed),
        parameters,
    ]


def _observability(diagnosis: Diagnosis) -> list[Block]:
    rows = [
        [str(item["effect"]), f"{100.0 * float(str(item['visible'])):.0f} %", str(item["needs"])]
        for item in diagnosis.observability
    ]
    return [
        Table(
            ["effect", "visible part of its physical range", "what would show or separate it"],
            rows,
            note="0 %: even at its physical limit the effect would show little on these logs beside"
            " what references without it show.",
        )
    ]


def _method(diagnosis: Diagnosis, names: str) -> list[str]:
    problem = diagnosis.problem
    error = problem.error
    rows = int(np.sum([terms.residual_v.size for terms in problem.diagnosed]))
    return [
        f"Diagnosed: {names} ({rows} rows); references: {len(problem.references)}.",
        f"Error expected without a cause: {error.rmse_v:.2f} V, weighed by time scale:"
        f" {error.scale_v2[0] ** 0.5:.2f} V from row to row,"
        f" {error.lasting_v2**0.5:.2f} V·√row over many minutes.",
        "Coefficients, structure that clean logs share, and what differs from log to log without a"
        " cause are integrated out; then every effect is weighed against none.",
        *problem_remarks(diagnosis),
    ]


def problem_remarks(diagnosis: Diagnosis) -> list[str]:
    """Return what the reader should know of this diagnosis in particular."""
    remarks = list(diagnosis.extension.remarks)
    if not diagnosis.problem.references:
        remarks.append(
            "Without references the model's own noise stands for the floor: give logs on which the"
            " model is known to be good with --reference."
        )
    return remarks

"""The page of `cangauge gap`: size, place and cause of the gap, and how far a cause closes it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

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
from cangauge.diagnosis.next_test import NextSteps, Plan
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
    add_line,
    add_zero,
    bars,
    extremes,
    new_figure,
)
from cangauge.report.page import (
    Beside,
    Block,
    Bullets,
    Figure,
    InputFile,
    Page,
    Paragraph,
    Section,
    Table,
    Tile,
    joined,
    reconstruction_banners,
    render,
)
from cangauge.report.summary import (
    headline,
    next_step,
    open_question,
    parameters_text,
    percent_span,
    plan_rows,
)

_SHOWN_CANDIDATES: Final = 8
_SEGMENT_POINTS: Final = 600
"""Points of the current drawn for one segment."""
_LONGEST_S: Final = 1e6
"""A time scale beyond this is shown as open-ended [s]."""
_WHOLE_MINUTES_FROM_S: Final = 600.0
_AXES: Final = {
    "soc": ("state of charge", "%"),
    "current": ("current", "A"),
    "temperature": ("temperature", "°C"),
    "rest": ("rest and drive", ""),
    "time": ("time since the start", "min"),
    "timescale": ("time scale of the error", "s"),
}
_SHADES: Final = tuple(Viridis256[::-1])
"""Light for a small error, dark for a large one."""


def gap_report(
    diagnosis: Diagnosis, model: InputFile | None = None, steps: NextSteps | None = None
) -> str:
    """Return the diagnosis as one self-contained HTML page.

    Parameters
    ----------
    diagnosis : Diagnosis
    model : InputFile, optional
        The diagnosed model, to name it on the page.
    steps : NextSteps, optional
        A test that was added to the diagnosis, and the next one.
    """
    return render(gap_page(diagnosis, model, steps))


def gap_page(
    diagnosis: Diagnosis, model: InputFile | None = None, steps: NextSteps | None = None
) -> Page:
    """Return the report's content (see `gap_report`); `figures` holds the bokeh figures."""
    problem = diagnosis.problem
    logs = [matrix.sampled.log for matrix in problem.diagnosed]
    references = [matrix.sampled.log for matrix in problem.references]
    errors = diagnosis.log_errors()
    extended = _extended_name(diagnosis)
    sections = [
        Section("How large the gap is", _size(diagnosis, extended)),
        Section(
            "Where the gap is",
            [*_maps(errors, extended), *share_figures(diagnosis.error_breakdown)],
        ),
        Section("Cause", _cause(diagnosis)),
        Section("How far the gap closes", [_closing(diagnosis), *_over_time(errors, extended)]),
        Section("Worst segments", _worst_segments(diagnosis.worst_segments, errors, extended)),
        Section("What these logs can show", [_observability(diagnosis)]),
        Section("Method", [Bullets(_method(diagnosis))]),
    ]
    if steps is not None and steps.plan is not None:
        sections.insert(3, Section("The next test", _next_test(steps.plan)))
    caveats = [text for text in (open_question(diagnosis), *diagnosis.caveats) if text]
    if caveats:
        sections.insert(0, Section("What these logs cannot show", [Bullets(caveats)]))
    title = f"Diagnosis of {joined([log.name for log in logs])}"
    if model is not None:
        title += f" with model {model.name}"
    size, verdict = headline(diagnosis), diagnosis.summary
    return Page(
        title=title,
        lead=size or verdict,
        subtitle=f"{verdict} {next_step(diagnosis)}" if size else "",
        tiles=_tiles(diagnosis),
        sections=sections,
        inputs=[
            *([] if model is None else [model]),
            *(InputFile.of_path("log", log.name, log.source) for log in logs),
            *(InputFile.of_path("reference", log.name, log.source) for log in references),
        ],
        banners=reconstruction_banners(*(text for log in logs for text in (log.name, log.source))),
    )


def _next_test(plan: Plan) -> list[Block]:
    """Return the proposed test, its profile, and what each test is expected to show."""
    best = plan.best.profile
    plot = new_figure(("time", "current"), "@y{0.0} A<br>at @x{0} s", units=("s", "A"), height=220)
    add_zero(plot)
    add_line(plot, "current", best.time_s, best.current_a, Pen(BLUE, width=1.4, in_legend=False))
    return [
        Paragraph(plan.sentence),
        Figure(
            f"Proposed test: {best.name}",
            plot,
            f"From {number(best.start_soc_pct, 0, '%')} to"
            f" {number(float(best.soc_pct[-1]), 0, '%')} SoC, from"
            f" {number(best.start_c, 0, '°C')}. Positive current discharges.",
        ),
        Table(
            *plan_rows(plan),
            note="P(true one): expected probability of the true cause, averaged over the 90 % set."
            " A cause's own column: its expected probability where it is the true one. Under the"
            " linear model, which flatters.",
        ),
    ]


def _extended_name(diagnosis: Diagnosis) -> str:
    """Return what the extended model adds, in words."""
    accepted = diagnosis.extension.cause
    if accepted:
        return f"with {' and '.join(accepted)}"
    return "adapted to the references" if diagnosis.problem.references else "nothing added"


def _tiles(diagnosis: Diagnosis) -> list[Tile]:
    verdict = diagnosis.verdict
    before, after = diagnosis.baseline_soc_mae_pct, diagnosis.extended_soc_mae_pct
    tiles = [
        Tile("Verdict", verdict.cause.replace("_", " "), f"probability {verdict.probability:.2f}"),
        Tile("Error of the model", number(diagnosis.baseline_rmse_v, 2, "V"), "RMS, these logs"),
        Tile("Extended model", number(diagnosis.extended_rmse_v, 2, "V"), "RMS, held-out rows"),
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
                "RMS, adapted to references",
            )
        )
    if diagnosis.closed_fraction is not None:
        hint = "of the squared gap above the floor"
        if diagnosis.closed_fraction_ci is not None:
            hint = f"squared; 95 %: {percent_span(*diagnosis.closed_fraction_ci)}"
        tiles.append(Tile("Gap closed", _percent(diagnosis.closed_fraction), hint))
    if before is not None:
        tiles.append(
            Tile(
                "SoC error (EKF)",
                f"{significant(before, 2)} → {significant(after, 2, '%')}",
                "MAE, model as given → extended",
            )
        )
    return tiles


def _percent(fraction: float) -> str:
    return number(100.0 * fraction, 0, "%")


def _size(diagnosis: Diagnosis, extended: str) -> list[Block]:
    """Return the errors in volts and in % SoC, against the two floors."""
    problem = diagnosis.problem
    soc = np.concatenate([matrix.sampled.rows.soc_pct for matrix in problem.diagnosed])
    slope_v_per_pct = float(np.median(problem.given.model.pseudo_ocv_slope(soc)))
    floor = (
        ("floor: references", "the references, model as given: sensors and what does not repeat")
        if problem.references
        else ("floor: model file", "stated in the model file, without references")
    )
    entries = [
        ("model as given", diagnosis.baseline_rmse_v, ORANGE,
         diagnosis.baseline_soc_mae_pct, "these logs"),
        (extended, diagnosis.extended_rmse_v, BLUE,
         diagnosis.extended_soc_mae_pct, "these logs, on rows held out of its fit"),
        (floor[0], diagnosis.floor_v, GREY, None, floor[1]),
    ]  # fmt: skip
    if diagnosis.explainable_v is not None:
        entries.append(
            ("floor: explainable", diagnosis.explainable_v, GREEN, None,
             "each reference held out, model adapted to the others")
        )  # fmt: skip
    rows = [
        [name, number(rms_v, 2), number(rms_v / slope_v_per_pct, 2), number(soc_mae_pct, 2), on]
        for name, rms_v, _, soc_mae_pct, on in entries
    ]
    return [
        Figure(
            "Error and floors",
            bars(
                "RMS error",
                "V",
                [(name, rms_v, color) for name, rms_v, color, _, _ in entries],
                decimals=2,
            ),
            _size_caption(diagnosis),
        ),
        Table(
            ["", "RMS [V]", "as SoC [%]", "SoC error of the EKF [%]", "judged on"],
            rows,
            note="As SoC: volts over the median slope of the pseudo-OCV here,"
            f" {slope_v_per_pct:.2f} V per %. SoC error of the EKF: mean absolute error after"
            " 5 minutes, initial SoC withheld; – where the logs have no reference SoC.",
        ),
    ]


def _size_caption(diagnosis: Diagnosis) -> str:
    ratio = number(diagnosis.baseline_rmse_v / max(diagnosis.floor_v, 1e-9), 1)
    floor = "that on the references" if diagnosis.problem.references else "what its file states"
    text = f"The model's error on these logs is {ratio} times {floor}."
    if diagnosis.explainable_v is None:
        return f"{text} The second floor, the error of an adapted model, needs more references."
    return (
        f"{text} The part above both floors is the gap. The part between the floors is structure"
        " that the model lacks, and needs no fault."
    )


def _maps(errors: Sequence[LogErrors], extended: str) -> list[Block]:
    """Return the maps of the error, before and after in the same shades."""
    rows = [item.sampled.rows for item in errors]
    soc = np.concatenate([item.soc_pct for item in rows])
    axes = {
        "current": np.concatenate([item.delayed_current_a[:, 0] for item in rows]),
        "temperature": np.concatenate([item.temperature_c for item in rows]),
    }
    models = {
        "model as given": np.concatenate([item.before_v for item in errors]),
        extended: np.concatenate([item.after_v for item in errors]),
    }
    maps = {
        (model, axis): error_map(soc, values, error_v, tails=axis == "current")
        for model, error_v in models.items()
        for axis, values in axes.items()
    }
    largest_v = max(float(np.nanmax(each.rms_v, initial=0.0)) for each in maps.values())
    return [
        Beside(
            [
                Figure(
                    f"RMS error over SoC × {_AXES[axis][0]}, {model}",
                    _heat_map(maps[model, axis], _AXES[axis], largest_v),
                    _map_caption(maps[model, axis], _AXES[axis][1]),
                )
                for axis in axes
            ]
        )
        for model in models
    ]


def _heat_map(each: ErrorMap, axis: tuple[str, str], largest_v: float) -> Plot:
    quantity, unit = axis
    plot = new_figure(
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
            "range": [_bin_range(each, int(k), unit) for k in up],
            "rms": each.rms_v[up, across],
            "mean": each.mean_v[up, across],
            "rows": each.rows[up, across],
        }
    )
    shades = LinearColorMapper(palette=list(_SHADES), low=0.0, high=max(largest_v, 1e-3))
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
    return plot


def _map_caption(each: ErrorMap, unit: str) -> str:
    if not np.isfinite(each.rms_v).any():
        return f"No bin holds {MIN_BIN_ROWS} rows: the logs are too short for a map."
    up, across = np.unravel_index(int(np.nanargmax(each.rms_v)), each.rms_v.shape)
    low, high = each.soc_edges_pct[across], each.soc_edges_pct[across + 1]
    return (
        f"Largest {number(float(each.rms_v[up, across]), 2, 'V')} (mean"
        f" {number(float(each.mean_v[up, across]), 2, 'V')}) at {span(low, high, 0, '%')} SoC and"
        f" {_bin_range(each, int(up), unit)}. Bins with fewer than {MIN_BIN_ROWS} rows are empty."
        + (" The top and bottom bins include everything beyond." if each.tails else "")
    )


def _bin_range(each: ErrorMap, up: int, unit: str) -> str:
    """Return the range of the second quantity in a bin, in words."""
    low, high = float(each.edges[up]), float(each.edges[up + 1])
    digits = _digits(high - low)
    if each.tails and up == each.edges.size - 2:
        return f"over {number(low, digits, unit)}"
    if each.tails and up == 0:
        return f"below {number(high, digits, unit)}"
    return span(low, high, digits, unit)


def _digits(width: float) -> int:
    """Return the number of decimals that separates edges `width` apart."""
    return max(0, math.ceil(math.log10(2.0 / max(width, 1e-6))))


def share_figures(places: Sequence[ErrorShare]) -> list[Block]:
    """Return the shares of the squared error over every axis, two figures in a row."""
    figures = []
    for axis, (quantity, unit) in _AXES.items():
        on_axis = [place for place in places if place.axis == axis]
        if not on_axis:
            continue
        # The narrowest range sets the decimals: a single cell has few amperes.
        digits = _digits(min(place.high - place.low for place in on_axis))
        largest = max(on_axis, key=lambda place: place.share)
        figures.append(
            Figure(
                f"Share of the squared error: {quantity}{f' [{unit}]' if unit else ''}",
                _share_bars(on_axis, digits),
                f"Largest at {_place_range(largest, digits)}{f' {unit}' if unit else ''}:"
                f" {_percent(largest.share)} (95 % interval {percent_span(*largest.ci)}),"
                f" {number(largest.rmse_v, 2, 'V')} RMS there.",
            )
        )
    return [Beside(figures[at : at + 2]) for at in range(0, len(figures), 2)]


def _place_range(place: ErrorShare, digits: int) -> str:
    """Return a place's range in words, in the unit of `_AXES`."""
    if place.axis == "rest":
        return "rest" if place.low > 0.0 else "drive"
    if place.axis == "time":
        decimals = 0 if place.high > _WHOLE_MINUTES_FROM_S else 1
        return span(place.low / 60.0, place.high / 60.0, decimals)
    if place.axis == "timescale" and place.high >= _LONGEST_S:
        return f"over {number(place.low, 0)}"
    return span(place.low, place.high, digits)


def _share_bars(places: Sequence[ErrorShare], digits: int) -> Plot:
    ranges = [_place_range(place, digits) for place in places]
    plot = new_figure(
        ("share of the squared error", ""),
        "@name: @share{0.0} % (@low{0.0} … @high{0.0} %), RMS @rms{0.00} V there",
        units=("%", ""),
        height=72 + 26 * max(len(places), 3),
        x_range=Range1d(0.0, 140.0),  # room for the text beside a bar of 100 %
        y_categories=ranges[::-1],
    )
    source = ColumnDataSource(
        {
            "name": ranges,
            "share": [100.0 * place.share for place in places],
            "low": [100.0 * place.ci[0] for place in places],
            "high": [100.0 * place.ci[1] for place in places],
            "end": [100.0 * max(place.ci[1], place.share) for place in places],
            "rms": [place.rmse_v for place in places],
            "text": [f"  {_percent(p.share)}, {p.rmse_v:.2f} V" for p in places],
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
    return plot


def _cause(diagnosis: Diagnosis) -> list[Block]:
    verdict = diagnosis.verdict
    shown = diagnosis.candidates[:_SHOWN_CANDIDATES]
    names = [*(str(item["effect"]) for item in shown), UNKNOWN, NONE]
    probabilities = [
        (name, 100.0 * verdict.probabilities[name], BLUE if name == verdict.cause else GREY)
        for name in names
    ]
    rows = [
        [
            str(item["effect"]),
            number(item["log_bayes_factor"], 1),
            number(item["rmse_v"], 2),
            "–" if item["closed_fraction"] is None else _percent(item["closed_fraction"]),
            parameters_text(item["parameters"], "; "),
        ]
        for item in shown
    ]
    return [
        Paragraph(_cause_text(diagnosis)),
        Figure(
            "Probability of each cause",
            bars("probability", "%", probabilities, decimals=0),
            "From the evidence and the error that each cause removes, calibrated on other packs"
            " with known causes.",
        ),
        Table(
            ["effect", "log evidence", "error held out [V]", "gap closed", "parameters (95 %)"],
            rows,
            note="Errors on rows held out of the fit of the effect.",
        ),
    ]


def _cause_text(diagnosis: Diagnosis) -> str:
    verdict = diagnosis.verdict
    if verdict.cause == NONE:
        return "Logs without a fault may have the same error."
    if verdict.cause == UNKNOWN:
        return (
            "The logs differ from the model, but no effect of the library is a likely cause: the"
            f" best, {verdict.candidates[0].effect_id}, explains {_percent(verdict.explained)} of"
            " the gap."
        )
    effect = LIBRARY[verdict.cause]
    return (
        f"{verdict.cause}: {effect.signature}. {effect.equation}. {next_step(diagnosis)}"
        " An effect is a signature at the terminals, not proof of a mechanism."
    )


def _closing(diagnosis: Diagnosis) -> Paragraph:
    before = number(diagnosis.baseline_rmse_v, 2, "V")
    after = number(diagnosis.extended_rmse_v, 2, "V")
    text = f"RMS error on held-out rows: {before} with the model as given, {after} extended."
    if diagnosis.extended_rmse_v > diagnosis.baseline_rmse_v:
        text += " The extended model is worse: do not run it."
    elif diagnosis.closed_fraction is not None:
        interval = ""
        if diagnosis.closed_fraction_ci is not None:
            interval = f" (95 % interval {percent_span(*diagnosis.closed_fraction_ci)})"
        closed = _percent(diagnosis.closed_fraction)
        text += f" This closes {closed}{interval} of the squared gap above the"
        text += " floor."
    if diagnosis.problem.references:
        cause = "the cause and " if diagnosis.extension.cause else "no cause, only "
        text += (
            f" The extended model has {cause}what the references show: adjusted coefficients, and"
            " structure that logs without a fault share."
        )
    return Paragraph(text)


def _over_time(errors: Sequence[LogErrors], extended: str) -> list[Block]:
    logs = [item.sampled.log for item in errors]
    time = TimeFigures(logs)
    plot = time.plot("measured − model", "V", height=300, names=True)
    rows_s = [item.sampled.rows.time_s for item in errors]
    for name, color, values in (
        ("model as given", ORANGE, [item.before_v for item in errors]),
        (extended, BLUE, [item.after_v for item in errors]),
    ):
        pen = Pen(color, width=1.0, alpha=0.85)
        time.line(plot, name, list(zip(rows_s, values, strict=True)), pen)
    add_zero(plot)
    current = time.plot("current", "A", height=170)
    pieces = [(log.time_s, log.current_a) for log in logs]
    time.line(current, "current", pieces, Pen(GREY, width=1.0, in_legend=False))
    return [
        Figure(
            "Measured minus modelled voltage, before and after",
            plot,
            "All rows, including those of the extended model's fit: see the size of the gap above"
            " for the error on held-out rows.",
        ),
        Figure("Current", current, "Positive current discharges the pack, negative charges it."),
        _log_table(errors),
    ]


def _log_table(errors: Sequence[LogErrors]) -> Table:
    rows = []
    for item in errors:
        seen = item.sampled.rows
        rows.append(
            [
                item.sampled.log.name,
                number(item.sampled.log.duration_s / 60.0, 1),
                span(float(seen.soc_pct.max()), float(seen.soc_pct.min()), 0),
                span(float(seen.temperature_c.min()), float(seen.temperature_c.max()), 0),
                number(rms(item.before_v), 2),
                number(rms(item.after_v), 2),
                number(float(np.mean(item.before_v)), 2),
                number(float(np.mean(item.after_v)), 2),
            ]
        )
    return Table(
        ["log", "duration [min]", "SoC [%]", "temperature [°C]", "RMS before [V]",
         "RMS after [V]", "mean before [V]", "mean after [V]"],
        rows,
        note="On the rows of the fit, where the error after is slightly smaller than on held-out"
        " rows.",
    )  # fmt: skip


def _worst_segments(
    segments: Sequence[WorstSegment], errors: Sequence[LogErrors], extended: str
) -> list[Block]:
    """Return a figure of errors and current for each segment, on common scales, and their table."""
    nearby = [segment_signals(segment, errors) for segment in segments]
    volts = _common_range([part for each in nearby for part in (each.before_v, each.after_v)])
    amperes = _common_range([each.current_a for each in nearby])
    figures, rows = [], []
    for rank, (segment, each) in enumerate(zip(segments, nearby, strict=True), start=1):
        after_v = float(each.after_v[np.argmin(np.abs(each.time_s))])
        figures.append(
            Figure(
                f"{rank}. {segment.log} at {number(segment.time_s, 0)} s",
                _segment_plot(each, volts, amperes, extended),
                f"{number(segment.residual_v, 2, 'V')} at {number(segment.soc_pct, 1, '%')} SoC,"
                f" {number(segment.current_a, 1, 'A')} and"
                f" {number(segment.temperature_c, 1, '°C')};"
                f" extended model {number(after_v, 2, 'V')}.",
            )
        )
        rows.append(
            [
                str(rank),
                segment.log,
                number(segment.time_s, 0),
                number(segment.residual_v, 2),
                number(after_v, 2),
                number(segment.soc_pct, 1),
                number(segment.current_a, 1),
                number(segment.temperature_c, 1),
            ]
        )
    return [
        *(Beside(figures[at : at + 2]) for at in range(0, len(figures), 2)),
        Table(
            ["", "log", "time in the log [s]", "measured − model [V]",
             "with the extended model [V]", "SoC [%]", "current [A]", "temperature [°C]"],
            rows,
            note="At least a minute apart. Positive current discharges.",
        ),
    ]  # fmt: skip


def _common_range(values: Sequence[FloatArray]) -> tuple[float, float]:
    whole = np.concatenate([*values, np.zeros(1)])
    margin = 0.06 * float(np.ptp(whole)) or 1.0
    return float(whole.min()) - margin, float(whole.max()) + margin


def _segment_plot(
    each: SegmentSignals, volts: tuple[float, float], amperes: tuple[float, float], extended: str
) -> Plot:
    x_range = Range1d(-SEGMENT_S, SEGMENT_S)
    error = new_figure(
        ("", "measured − model"), "$name: @y{0.00} V<br>at @x{0.0} s", units=("", "V"),
        height=190, x_range=x_range,
    )  # fmt: skip
    add_zero(error)
    add_line(error, "model as given", each.time_s, each.before_v, Pen(ORANGE, width=1.6))
    add_line(error, extended, each.time_s, each.after_v, Pen(BLUE, width=1.6))
    error.y_range = Range1d(*volts)
    error.xaxis.visible = False
    current = new_figure(
        ("time from the centre", "current"), "@y{0.0} A<br>at @x{0.0} s", units=("s", "A"),
        height=150, x_range=x_range,
    )  # fmt: skip
    drawn = extremes(each.current_a, _SEGMENT_POINTS)
    add_line(
        current, "current", each.current_time_s[drawn], each.current_a[drawn],
        Pen(GREY, width=1.4, in_legend=False),
    )  # fmt: skip
    current.y_range = Range1d(*amperes)
    for plot in (error, current):
        plot.add_layout(
            Span(location=0.0, dimension="height", line_color="#c3cad3", line_dash="dashed")
        )
        plot.yaxis.ticker.desired_num_ticks = 4
    return gridplot(
        [[error], [current]],
        sizing_mode="stretch_width",
        merge_tools=True,
        toolbar_location="right",
        toolbar_options={"logo": None, "autohide": True},
    )


def _observability(diagnosis: Diagnosis) -> Table:
    rows = [
        [str(item["effect"]), _percent(float(str(item["visible"]))), str(item["needs"])]
        for item in diagnosis.observability
    ]
    return Table(
        ["effect", "visible part of its physical range", "what would show or separate it"],
        rows,
        note="0 %: even at its physical limit the effect would hardly exceed the error of logs"
        " without it.",
    )


def _method(diagnosis: Diagnosis) -> list[str]:
    problem = diagnosis.problem
    error = problem.error
    rows = sum(matrix.residual_v.size for matrix in problem.diagnosed)
    names = ", ".join(matrix.sampled.log.name for matrix in problem.diagnosed)
    remarks = [
        f"Diagnosed: {names} ({rows:,} rows); references: {len(problem.references)}.",
        f"Expected error without a fault: {error.rmse_v:.2f} V, weighted by time scale:"
        f" {error.scale_v2[0] ** 0.5:.2f} V from row to row,"
        f" {error.lasting_v2**0.5:.2f} V·√row over many minutes.",
        "Coefficients, structure that logs without a fault share, and their differences from log to"
        " log are marginalised; then every effect is compared with none.",
        *diagnosis.extension.remarks,
    ]
    if not problem.references:
        remarks.append(
            "Without references the model file's own noise is the floor: give logs on which the"
            " model is known to be good with --reference."
        )
    return remarks

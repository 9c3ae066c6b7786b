"""The page of `cangauge estimate`: SoC against the reference, and when the estimate was valid."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from bokeh.models import ColumnDataSource
from numpy.typing import NDArray

from cangauge._text import duration, number, span
from cangauge._typing import FloatArray
from cangauge.estimation.offline import EstimateTable
from cangauge.extras.report.charts import (
    AMBER,
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    Pen,
    Plot,
    TimeFigures,
    add_zero,
    new_figure,
    set_y_limits,
)
from cangauge.extras.report.page import (
    Block,
    Bullets,
    Figure,
    InputFile,
    Moment,
    Page,
    Paragraph,
    Section,
    Table,
    Tile,
    reconstruction_banners,
    render,
)
from cangauge.extras.report.verdict import Period, estimate_verdict, periods
from cangauge.identify.rows import running_rows
from cangauge.service.offline import Recorded, RecordedEstimate
from cangauge.types import REASON_WORDS, Reason, Status, reason_name

_METHODS: Final = {
    "ekf": "an extended Kalman filter (EKF) over voltage and charge",
    "newton": "the inverse of the voltage model (Newton)",
    "coulomb": "coulomb counting",
}
_STATUS_COLORS: Final = {
    Status.INITIALISING: GREY,
    Status.VALID: GREEN,
    Status.DEGRADED: AMBER,
    Status.INVALID: BLACK,
}
_MAX_BARS: Final = 500
"""Gaps shorter than the time axis over this number are closed: no screen resolves them."""
_LISTED_PERIODS: Final = 20
"""Most periods without a valid estimate to list, the longest ones."""


def estimate_report(estimate: RecordedEstimate, model_path: Path | None = None) -> str:
    """Return the report of an estimate as one self-contained HTML page.

    Parameters
    ----------
    estimate : RecordedEstimate
    model_path : Path, optional
        The model's file, to name it by its SHA-256.
    """
    return render(estimate_page(estimate, model_path))


def estimate_page(estimate: RecordedEstimate, model_path: Path | None = None) -> Page:
    """Return the report's content (see `estimate_report`); `figures` holds the bokeh figures."""
    log, model, settings = estimate.recorded, estimate.model, estimate.settings
    time = TimeFigures([log])
    found = periods(estimate.table)
    soc = _soc(estimate, time)
    sections = [
        Section("State of charge", soc),
        *_errors(estimate),
        Section("Voltage", _voltage(log, estimate.table, time)),
        Section("Input", _input(log, time)),
        Section(
            "Status",
            [
                _status_figure(log, estimate.table, time),
                *_periods(found, soc[0], time),
                _reasons(estimate.table),
            ],
        ),
        Section("Model and settings", _settings(estimate)),
    ]
    return Page(
        title=f"State of charge of {log.name}",
        lead=estimate_verdict(estimate, found),
        subtitle=f"{duration(log.duration_s)}, {len(log):,} samples, estimated by"
        f" {_METHODS[settings.method]} with the model {model.name}.",
        tiles=_tiles(estimate),
        sections=sections,
        inputs=[
            InputFile.of_model(model, model_path),
            InputFile.of_path("log", log.name, log.source),
        ],
        banners=[
            *reconstruction_banners(log.name, log.source, *log.remarks),
            *estimate.warnings,
        ],
    )


def _tiles(estimate: RecordedEstimate) -> list[Tile]:
    table, scores = estimate.table, estimate.scores
    known = np.flatnonzero(np.isfinite(table.soc_pct))
    ends, std = "–", "–"
    if known.size:
        first, last = known[0], known[-1]
        ends = f"{number(table.soc_pct[first], 1)} → {number(table.soc_pct[last], 1, '%')}"
        std = number(table.soc_std_pct[last], 2, "%")
    tiles = [Tile("SoC, start → end", ends, f"σ at the end {std}")]
    if _reference(estimate.recorded) is not None:
        cover = None if scores.cover_2sigma is None else 100.0 * scores.cover_2sigma
        tiles += [
            Tile("SoC error (MAE)", number(scores.soc_mae_pct, 2, "%"),
                 f"largest {number(scores.soc_max_pct, 2, '%')}"),
            Tile("Newton alone (MAE)", number(scores.soc_newton_mae_pct, 2, "%"), "no counting"),
            Tile("Coulomb alone (MAE)", number(scores.soc_coulomb_mae_pct, 2, "%"), "no voltage"),
            Tile("Reference within ±2σ", number(cover, 1, "%"), "of compared samples"),
        ]  # fmt: skip
    tiles += [
        Tile("Voltage error (MAE)", number(scores.voltage_mae_pct, 2, "%"), "measured − model"),
        Tile("Valid", number(100.0 * scores.valid_fraction, 1, "%"), "of all samples"),
    ]
    return tiles


def _reference(log: Recorded) -> FloatArray | None:
    """Return the reference SoC; None if it is no more than an initial value."""
    if log.soc_pct is None or np.isfinite(log.soc_pct).sum() < 2:
        return None
    return log.soc_pct


def _soc(estimate: RecordedEstimate, time: TimeFigures) -> list[Figure]:
    log, table = estimate.recorded, estimate.table
    reference = _reference(log)
    at = log.time_s
    plot = time.plot("state of charge", "%", height=380)
    time.band(plot, "±2σ", [(at, *_band(table.soc_pct, table.soc_std_pct, 0.0))], BLUE)
    time.line(plot, "Newton", [(at, table.soc_newton_pct)], Pen(AMBER, width=0.8, alpha=0.6))
    time.line(plot, "Coulomb", [(at, table.soc_coulomb_pct)], Pen(GREEN, dash="dashed"))
    if reference is not None:
        time.line(plot, "reference", [(at, reference)], Pen(BLACK, width=2.0))
    time.line(plot, "estimate", [(at, table.soc_pct)], Pen(BLUE, width=2.0))
    expected = (
        "The estimate should follow the reference, which should lie inside the band."
        if reference is not None
        else "The log has no reference SoC."
    )
    figure = Figure(
        "Estimated state of charge",
        plot,
        f"{expected} Newton scatters where the pseudo-OCV is flat; Coulomb counting drifts.",
    )
    if reference is None:
        std = time.plot("σ of SoC", "%", height=235)
        time.line(std, "σ", [(at, table.soc_std_pct)], Pen(BLUE, in_legend=False))
        return [figure, Figure("Uncertainty", std, "Standard deviation of the estimated SoC.")]
    error = time.plot("SoC error", "%", height=280)
    time.band(error, "±2σ", [(at, *_band(np.zeros_like(at), table.soc_std_pct, -100.0))], BLUE)
    for name, soc_pct, pen in (
        ("Newton", table.soc_newton_pct, Pen(AMBER, width=0.8, alpha=0.6)),
        ("Coulomb", table.soc_coulomb_pct, Pen(GREEN, dash="dashed")),
        ("estimate", table.soc_pct, Pen(BLUE, width=1.8)),
    ):
        time.line(error, name, [(at, soc_pct - reference)], pen)
    _limit_error(error, table, reference)
    add_zero(error)
    return [
        figure,
        Figure(
            "Error against the reference",
            error,
            "Each SoC minus the reference. An estimate that leaves the ±2σ band for long has an"
            " error that its model does not expect. A wide band at the start may extend beyond the"
            " figure.",
        ),
    ]


def _band(center: FloatArray, std: FloatArray, lower_bound: float) -> tuple[FloatArray, FloatArray]:
    """Return ±2σ around `center`, within `lower_bound` … 100."""
    return np.maximum(center - 2.0 * std, lower_bound), np.minimum(center + 2.0 * std, 100.0)


def _limit_error(plot: Plot, table: EstimateTable, reference: FloatArray) -> None:
    """Set the vertical range so that a wide start or a few outliers do not flatten the rest."""
    methods = (table.soc_newton_pct, table.soc_coulomb_pct, table.soc_pct)
    sizes = [(np.abs(soc_pct - reference), 0.99) for soc_pct in methods]
    sizes.append((2.0 * table.soc_std_pct, 0.9))
    known = [(size[np.isfinite(size)], quantile) for size, quantile in sizes]
    limit = max((float(np.quantile(size, q)) for size, q in known if size.size), default=1.0)
    set_y_limits(plot, -max(limit, 0.1), max(limit, 0.1))


def _errors(estimate: RecordedEstimate) -> list[Section]:
    """Return the section with the error of each method; empty without a reference."""
    table, scores = estimate.table, estimate.scores
    reference = _reference(estimate.recorded)
    if reference is None:
        return []
    rows = []
    for name, soc_pct, mae_pct in (
        ("estimate", table.soc_pct, scores.soc_mae_pct),
        ("Newton alone", table.soc_newton_pct, scores.soc_newton_mae_pct),
        ("Coulomb alone", table.soc_coulomb_pct, scores.soc_coulomb_mae_pct),
    ):
        error = soc_pct - reference
        error = error[np.isfinite(error)]
        rest: list[float | None] = [None] * 4
        if error.size:
            rest = [
                float(np.sqrt(np.mean(error**2))),
                float(error.mean()),
                float(np.abs(error).max()),
                float(error[-1]),
            ]
        rows.append([name, *(number(value, 2) for value in (mae_pct, *rest))])
    head = ["SoC by", "MAE [%]", "RMSE [%]", "mean [%]", "largest [%]", "at the end [%]"]
    note = f"Over {np.isfinite(reference).sum():,} samples with a reference; errors in % SoC."
    return [Section("SoC error", [Table(head, rows, note)])]


def _voltage(log: Recorded, table: EstimateTable, time: TimeFigures) -> list[Block]:
    at = log.time_s
    both = time.plot("voltage", "V", height=260)
    time.line(both, "measured", [(at, log.voltage_v)], Pen(BLACK, width=1.1))
    time.line(both, "model", [(at, table.voltage_model_v)], Pen(ORANGE, width=0.9, alpha=0.85))
    residual = time.plot("residual", "V", height=235)
    pen = Pen(PURPLE, width=0.9, in_legend=False)
    time.line(residual, "residual", [(at, table.residual_v)], pen)
    add_zero(residual)
    is_limited = _limit_to_running(log, table, both, residual)
    return [
        Figure(
            "Measured and modelled voltage",
            both,
            "The model's voltage at the estimated SoC should lie on the measurement."
            + (" Start-up and shut-down rows lie below the figure." if is_limited else ""),
        ),
        Figure(
            "Measured minus modelled voltage",
            residual,
            "Scatter about zero averages out. A lasting bias shifts the SoC; the filter allows for"
            " the lasting error that the model file states.",
        ),
    ]


def _limit_to_running(log: Recorded, table: EstimateTable, both: Plot, residual: Plot) -> bool:
    """Limit the figures to the rows between start-up and shut-down; False if those are all."""
    running = np.isfinite(log.voltage_v)
    measured = int(running.sum())
    if measured:
        running[running] = running_rows(log.time_s[running], log.voltage_v[running])
    error = np.abs(table.residual_v[running])
    error = error[np.isfinite(error)]
    if int(running.sum()) == measured or not error.size:
        return False
    shown = np.concatenate([log.voltage_v[running], table.voltage_model_v[running]])
    set_y_limits(both, float(np.nanmin(shown)), float(np.nanmax(shown)))
    limit = float(np.quantile(error, 0.9995))
    set_y_limits(residual, -limit, limit)
    return True


def _input(log: Recorded, time: TimeFigures) -> list[Block]:
    current = time.plot("current", "A", height=235)
    pen = Pen(BLUE, width=0.9, in_legend=False)
    time.line(current, "current", [(log.time_s, log.current_a)], pen)
    temperature = time.plot("temperature", "°C", height=235)
    pen = Pen(ORANGE, width=1.2, in_legend=False)
    time.line(temperature, "temperature", [(log.time_s, log.temperature_c)], pen)
    return [
        Figure("Current", current, "Positive current discharges the pack, negative charges it."),
        Figure(
            "Temperature",
            temperature,
            f"Measured on: {log.temperature_source}. An estimate is valid only at temperatures that"
            " the model was identified at.",
        ),
    ]


def _status_figure(log: Recorded, table: EstimateTable, time: TimeFigures) -> Figure:
    """Return a row of bars for the status and one for each reason that occurs."""
    reasons = _occurring(table)
    names = ["status", *map(reason_name, reasons)]
    timeline = time.timeline
    plot = new_figure(
        (timeline.label, ""),
        f"@what<br>@left{{0.[00]}} … @right{{0.[00]}} {timeline.unit}",
        units=("", ""),
        height=76 + 30 * len(names),
        x_range=time.x_range,
        y_categories=names[::-1],
    )
    at = timeline.at(0, log.time_s)
    for status in Status:
        intervals = _intervals(at, table.status == status)
        _add_bars(plot, "status", status.name.lower(), intervals, _STATUS_COLORS[status])
    for reason, name in zip(reasons, names[1:], strict=True):
        _add_bars(plot, name, name, _intervals(at, (table.reasons & reason) != 0), AMBER)
    plot.ygrid.grid_line_color = None
    return Figure(
        "Status over time",
        plot,
        "Green: valid; amber: degraded; grey: initialising; black: invalid. Below: when each reason"
        " applied.",
    )


def _add_bars(
    plot: Plot, row: str, hover: str, intervals: tuple[FloatArray, FloatArray], color: str
) -> None:
    left, right = intervals
    if not left.size:
        return
    columns = {"left": left, "right": right, "row": [row] * left.size, "what": [hover] * left.size}
    plot.hbar(
        y="row",
        left="left",
        right="right",
        height=0.62,
        fill_color=color,
        line_color=color,  # keeps a single sample visible
        source=ColumnDataSource(columns),
    )


def _intervals(at: FloatArray, mask: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    """Return where `mask` begins and ceases to hold; each row lasts until the next one."""
    change = np.diff(np.concatenate(([0], mask.astype(np.int8), [0])))
    begin, end = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
    left, right = at[begin], at[np.minimum(end, at.size - 1)]
    if left.size > 1:
        apart = left[1:] - right[:-1] >= (at[-1] - at[0]) / _MAX_BARS
        left, right = left[np.r_[True, apart]], right[np.r_[apart, True]]
    return left, right


def _reasons(table: EstimateTable) -> Table:
    """Return the share of samples with each status and each reason, with its meaning."""
    rows = [
        [status.name.lower(), _share(table.status == status), ""]
        for status in Status
        if np.any(table.status == status)
    ]
    rows += [
        [reason_name(reason), _share((table.reasons & reason) != 0), REASON_WORDS[reason]]
        for reason in _occurring(table)
    ]
    return Table(["status or reason", "share of samples", "meaning"], rows)


def _periods(found: Sequence[Period], figure: Figure, time: TimeFigures) -> list[Block]:
    """Return the table of the periods without a valid estimate, each leading to the figure."""
    if not found:
        return []
    longest = sorted(found, key=lambda period: period.start_s - period.end_s)[:_LISTED_PERIODS]
    rows: list[list[str | Moment]] = []
    for period in sorted(longest):
        margin_s = 0.25 * (period.end_s - period.start_s) + 1.0
        first_s, last_s = period.start_s - margin_s, period.end_s + margin_s
        start, end = time.timeline.since_start(np.array([first_s, last_s]))
        rows.append(
            [
                Moment(period.when(), figure, float(start), float(end)),
                duration(period.end_s - period.start_s),
                period.status.name.lower(),
                REASON_WORDS.get(period.reason, ""),
            ]
        )
    note = "h:mm:ss since the start of the log. A link zooms the figures to the period."
    if len(found) > len(rows):
        note += f" The longest {len(rows)} of {len(found):,} periods."
    return [Table(["period", "duration", "status", "main reason"], rows, note)]


def _occurring(table: EstimateTable) -> Sequence[Reason]:
    return [reason for reason in Reason if np.any(table.reasons & reason)]


def _share(mask: NDArray[np.bool_]) -> str:
    return number(100.0 * float(mask.mean()), 1, "%")


def _settings(estimate: RecordedEstimate) -> list[Block]:
    log, model, settings = estimate.recorded, estimate.model, estimate.settings
    initial = "from the first voltages"
    if settings.initial_soc_pct is not None:
        std = number(settings.initial_soc_std_pct, 1, "%")
        initial = f"{number(settings.initial_soc_pct, 1)} ± {std}"
    blocks: list[Block] = [
        Table(
            ["setting", ""],
            [
                ["method", settings.method],
                ["initial SoC (±1σ)", initial],
                ["capacity", number(settings.capacity_ah or model.capacity_ah, 2, "Ah")],
                ["a gap is longer than", number(settings.gap_s, 1, "s")],
                ["model", model.name],
                ["voltage error (MAE) of the model",
                 f"{number(model.noise.voltage_mae_pct, 2, '%')} on {model.noise.judged_on}"],
                ["identified at SoC", span(*model.range.soc_pct, 1, "%")],
                ["identified at temperature", span(*model.range.temperature_c, 1, "°C")],
                ["identified at current", span(*model.range.current_a, 0, "A")],
                ["temperature of model / log",
                 f"{model.temperature_source} / {log.temperature_source}"],
            ],
        )
    ]  # fmt: skip
    if log.remarks:
        blocks += [Paragraph("Remarks on the log:"), Bullets(log.remarks)]
    return blocks

"""The page of `cangauge estimate`: SoC against the reference, and when the estimate was valid."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

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
    Page,
    Paragraph,
    Section,
    Table,
    Tile,
    reconstruction_banners,
    render,
)
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
    log, model, table = estimate.recorded, estimate.model, estimate.table
    time = TimeFigures([log])
    found = periods(table)
    reference = _reference(log)
    status = [_status_figure(log, table, time), *_periods(found), _reasons(table)]
    errors = [] if reference is None else [_error_table(estimate, reference)]
    return Page(
        title=f"State of charge of {log.name}",
        lead=estimate_verdict(estimate, found),
        subtitle=f"{duration(log.duration_s)}, {len(log):,} samples, estimated by"
        f" {_METHODS[estimate.settings.method]} with the model {model.name}.",
        tiles=_tiles(estimate),
        sections=[
            Section("State of charge", [*_soc(table, log.time_s, reference, time), *errors]),
            Section("Voltage", _voltage(log, table, time)),
            Section("Input", _input(log, time)),
            Section("Status", status),
            Section("Model and settings", _settings(estimate)),
        ],
        inputs=[
            InputFile.of_model(model, model_path),
            InputFile.of_path("log", log.name, log.source),
        ],
        banners=[
            *reconstruction_banners(log.name, log.source, *log.remarks),
            *estimate.warnings,
        ],
    )


# --- The result in a sentence


class Period(NamedTuple):
    """A time without a valid estimate, since the start of the log [s]."""

    start_s: float
    end_s: float
    status: Status
    reason: Reason
    """The reason that applied to most of its samples."""

    def when(self, template: str = "{} … {}") -> str:
        """Return the times as h:mm:ss."""
        return template.format(_clock(self.start_s), _clock(self.end_s))


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"


def periods(table: EstimateTable) -> list[Period]:
    """Return the times that are degraded or invalid, in sequence."""
    status, time_s = np.asarray(table.status), table.time_s
    edges = np.flatnonzero(np.diff(status)) + 1
    found = []
    for begin, end in zip((0, *edges), (*edges, status.size), strict=True):
        if begin == end or status[begin] not in {Status.DEGRADED, Status.INVALID}:
            continue
        reasons = np.asarray(table.reasons[begin:end]).astype(np.int64)
        counts = {reason: int(np.count_nonzero(reasons & reason)) for reason in Reason}
        most = max(counts, key=counts.__getitem__)
        found.append(
            Period(
                float(time_s[begin] - time_s[0]),
                float(time_s[min(end, status.size - 1)] - time_s[0]),
                Status(int(status[begin])),
                most if counts[most] else Reason.NONE,
            )
        )
    return found


def estimate_verdict(estimate: RecordedEstimate, found: Sequence[Period]) -> str:
    """Return how far the SoC is from the log's own, and when and why it is not valid."""
    table, scores = estimate.table, estimate.scores
    known = np.flatnonzero(np.isfinite(table.soc_pct))
    if not known.size:
        return "No sample gives a state of charge."
    if _reference(estimate.recorded) is not None and scores.soc_max_pct:
        text = f"SoC within {number(scores.soc_max_pct, 1, '%')} of the log's own"
        text += f" ({number(scores.soc_mae_pct, 1, '%')} on average)"
    else:
        first, last = table.soc_pct[known[0]], table.soc_pct[known[-1]]
        std = number(2.0 * table.soc_std_pct[known[-1]], 1, "%")
        text = f"SoC from {number(first, 1)} to {number(last, 1, '%')} (±{std} at the end, 2σ)"
    # A share that is not whole must not round to 0 or 100 %.
    share = number(min(max(100.0 * scores.valid_fraction, 0.1), 99.9), 1, "%")
    whole = {0.0: "never valid", 1.0: "valid throughout"}
    text += f"; {whole.get(scores.valid_fraction, f'valid in {share} of the samples')}"
    if found:
        longest = max(found, key=lambda period: period.end_s - period.start_s)
        text += f"; {longest.status.name.lower()} {longest.when('from {} to {}')}"
        text += f" because {REASON_WORDS[longest.reason]}" if longest.reason else ""
        text += f", the longest of {len(found)} periods" if len(found) > 1 else ""
    return f"{text}."


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
        largest = f"largest {number(scores.soc_max_pct, 2, '%')}"
        tiles += [
            Tile("SoC error (MAE)", number(scores.soc_mae_pct, 2, "%"), largest),
            Tile("Newton alone (MAE)", number(scores.soc_newton_mae_pct, 2, "%"), "no counting"),
            Tile("Coulomb alone (MAE)", number(scores.soc_coulomb_mae_pct, 2, "%"), "no voltage"),
            Tile("Reference within ±2σ", number(cover, 1, "%"), "of compared samples"),
        ]
    return [
        *tiles,
        Tile("Voltage error (MAE)", number(scores.voltage_mae_pct, 2, "%"), "measured − model"),
        Tile("Valid", number(100.0 * scores.valid_fraction, 1, "%"), "of all samples"),
    ]


def _reference(log: Recorded) -> FloatArray | None:
    """Return the reference SoC; None if it is no more than an initial value."""
    if log.soc_pct is None or np.isfinite(log.soc_pct).sum() < 2:
        return None
    return log.soc_pct


# --- Figures


def soc_plot(
    table: EstimateTable, reference: tuple[FloatArray, FloatArray] | None, time: TimeFigures
) -> Plot:
    """Return the SoC with ±2σ, by voltage and by counting alone; `reference` is (time_s, SoC)."""
    at = table.time_s
    plot = time.plot("state of charge", "%", height=380)
    low, high = table.soc_pct - 2.0 * table.soc_std_pct, table.soc_pct + 2.0 * table.soc_std_pct
    time.band(plot, "±2σ", [(at, np.maximum(low, 0.0), np.minimum(high, 100.0))], BLUE)
    time.line(plot, "Newton", [(at, table.soc_newton_pct)], Pen(AMBER, 0.8, 0.6, visible=False))
    time.line(plot, "Coulomb", [(at, table.soc_coulomb_pct)], Pen(GREEN, dash="dashed"))
    if reference is not None:
        time.line(plot, "reference", [reference], Pen(BLACK, width=2.0))
    time.line(plot, "estimate", [(at, table.soc_pct)], Pen(BLUE, width=2.0))
    return plot


def _soc(
    table: EstimateTable, at: FloatArray, reference: FloatArray | None, time: TimeFigures
) -> list[Block]:
    plot = soc_plot(table, None if reference is None else (at, reference), time)
    caption = "Click “Newton” for the SoC by voltage alone; Coulomb counting drifts."
    if reference is None:
        std = time.plot("σ of SoC", "%", height=235)
        time.line(std, "σ", [(at, table.soc_std_pct)], Pen(BLUE, in_legend=False))
        return [
            Figure("Estimated state of charge", plot, f"The log has no reference SoC. {caption}"),
            Figure("Uncertainty", std, "Standard deviation of the estimated SoC."),
        ]
    error = time.plot("SoC error", "%", height=280)
    band = np.minimum(2.0 * table.soc_std_pct, 100.0)
    time.band(error, "±2σ", [(at, -band, band)], BLUE)
    sizes = [(2.0 * table.soc_std_pct, 0.9)]
    for name, soc_pct, pen in (
        ("Newton", table.soc_newton_pct, Pen(AMBER, 0.8, 0.6, visible=False)),
        ("Coulomb", table.soc_coulomb_pct, Pen(GREEN, dash="dashed")),
        ("estimate", table.soc_pct, Pen(BLUE, width=1.8)),
    ):
        time.line(error, name, [(at, soc_pct - reference)], pen)
        sizes += [(np.abs(soc_pct - reference), 0.99)] if pen.visible else []
    # A wide start or a few outliers do not flatten the rest.
    known = [(size[np.isfinite(size)], quantile) for size, quantile in sizes]
    limit = max((float(np.quantile(size, q)) for size, q in known if size.size), default=1.0)
    set_y_limits(error, -max(limit, 0.1), max(limit, 0.1))
    add_zero(error)
    follow = "The estimate should follow the reference, which should lie inside the band."
    return [
        Figure("Estimated state of charge", plot, f"{follow} {caption}"),
        Figure(
            "Error against the reference",
            error,
            "Each SoC minus the reference. An estimate that leaves the ±2σ band for long has an"
            " error that its model does not expect.",
        ),
    ]


def _error_table(estimate: RecordedEstimate, reference: FloatArray) -> Table:
    table, scores = estimate.table, estimate.scores
    rows = []
    for name, soc_pct, mae_pct in (
        ("estimate", table.soc_pct, scores.soc_mae_pct),
        ("Newton alone", table.soc_newton_pct, scores.soc_newton_mae_pct),
        ("Coulomb alone", table.soc_coulomb_pct, scores.soc_coulomb_mae_pct),
    ):
        error = (soc_pct - reference)[np.isfinite(soc_pct - reference)]
        error = error if error.size else np.full(1, np.nan)
        rms = float(np.sqrt(np.mean(error**2)))
        values = (mae_pct, rms, float(error.mean()), float(np.abs(error).max()), float(error[-1]))
        rows.append([name, *(number(value, 2) for value in values)])
    head = ["SoC by", "MAE [%]", "RMSE [%]", "mean [%]", "largest [%]", "at the end [%]"]
    note = f"Over {np.isfinite(reference).sum():,} samples with a reference; errors in % SoC."
    return Table(head, rows, note)


def _voltage(log: Recorded, table: EstimateTable, time: TimeFigures) -> list[Block]:
    at = log.time_s
    both = time.plot("voltage", "V", height=260)
    time.line(both, "measured", [(at, log.voltage_v)], Pen(BLACK, width=1.1))
    time.line(both, "model", [(at, table.voltage_model_v)], Pen(ORANGE, width=0.9, alpha=0.85))
    residual = time.plot("residual", "V", height=235)
    time.line(residual, "residual", [(at, table.residual_v)], Pen(PURPLE, 0.9, in_legend=False))
    add_zero(residual)
    running = np.isfinite(log.voltage_v)
    measured = int(running.sum())
    if measured:
        running[running] = running_rows(log.time_s[running], log.voltage_v[running])
    error = np.abs(table.residual_v[running])
    error = error[np.isfinite(error)]
    below = ""
    if int(running.sum()) < measured and error.size:
        shown = np.concatenate([log.voltage_v[running], table.voltage_model_v[running]])
        set_y_limits(both, float(np.nanmin(shown)), float(np.nanmax(shown)))
        limit = float(np.quantile(error, 0.9995))
        set_y_limits(residual, -limit, limit)
        below = " Start-up and shut-down rows lie below the figure."
    follow = "The model's voltage at the estimated SoC should lie on the measurement."
    return [
        Figure("Measured and modelled voltage", both, f"{follow}{below}"),
        Figure(
            "Measured minus modelled voltage",
            residual,
            "Scatter about zero averages out. A lasting bias shifts the SoC; the filter allows for"
            " the lasting error that the model file states.",
        ),
    ]


def _input(log: Recorded, time: TimeFigures) -> list[Block]:
    valid = "An estimate is valid only at temperatures that the model was identified at."
    figures: list[Block] = []
    for name, unit, values, color, caption in (
        ("Current", "A", log.current_a, BLUE, "Positive current discharges the pack."),
        ("Temperature", "°C", log.temperature_c, ORANGE,
         f"Measured on: {log.temperature_source}. {valid}"),
    ):  # fmt: skip
        plot = time.plot(name.lower(), unit, height=235)
        time.line(plot, name.lower(), [(log.time_s, values)], Pen(color, 1.0, in_legend=False))
        figures.append(Figure(name, plot, caption))
    return figures


# --- Status


def _status_figure(log: Recorded, table: EstimateTable, time: TimeFigures) -> Figure:
    """Return a row of bars for the status and one for each reason that occurs."""
    at = time.at(0, log.time_s)
    bars = [
        ("status", status.name.lower(), table.status == status, _STATUS_COLORS[status])
        for status in Status
    ]
    bars += [
        (reason_name(reason), reason_name(reason), (table.reasons & reason) != 0, AMBER)
        for reason in _occurring(table)
    ]
    names = list(dict.fromkeys(row for row, _, _, _ in bars))
    plot = new_figure(
        (time.label, ""),
        f"@what<br>@left{{0.[00]}} … @right{{0.[00]}} {time.unit}",
        units=("", ""),
        height=76 + 30 * len(names),
        x_range=time.x_range,
        y_categories=names[::-1],
    )
    for row, what, mask, color in bars:
        left, right = _intervals(at, mask)
        columns: dict[str, Any] = {"left": left, "right": right}
        columns |= {"row": [row] * left.size, "what": [what] * left.size}
        plot.hbar(
            y="row",
            left="left",
            right="right",
            height=0.62,
            fill_color=color,
            line_color=color,  # keeps a single sample visible
            source=ColumnDataSource(columns),
        )
    plot.ygrid.grid_line_color = None
    return Figure(
        "Status over time",
        plot,
        "Green: valid; amber: degraded; grey: initialising; black: invalid. Below: when each reason"
        " applied.",
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
    shares = [(status.name.lower(), table.status == status, "") for status in Status]
    shares += [
        (reason_name(reason), (table.reasons & reason) != 0, REASON_WORDS[reason])
        for reason in _occurring(table)
    ]
    rows = [
        [name, number(100.0 * float(mask.mean()), 1, "%"), words]
        for name, mask, words in shares
        if mask.any()
    ]
    return Table(["status or reason", "share of samples", "meaning"], rows)


def _periods(found: Sequence[Period]) -> list[Block]:
    """Return the table of the periods without a valid estimate."""
    if not found:
        return []
    longest = sorted(found, key=lambda period: period.start_s - period.end_s)[:_LISTED_PERIODS]
    rows = [
        [
            period.when(),
            duration(period.end_s - period.start_s),
            period.status.name.lower(),
            REASON_WORDS.get(period.reason, ""),
        ]
        for period in sorted(longest)
    ]
    note = "h:mm:ss since the start of the log."
    if len(found) > len(rows):
        note += f" The longest {len(rows)} of {len(found):,} periods."
    return [Table(["period", "duration", "status", "main reason"], rows, note)]


def _occurring(table: EstimateTable) -> Sequence[Reason]:
    return [reason for reason in Reason if np.any(table.reasons & reason)]


def _settings(estimate: RecordedEstimate) -> list[Block]:
    log, model, settings = estimate.recorded, estimate.model, estimate.settings
    initial = "from the first voltages"
    if settings.initial_soc_pct is not None:
        std = number(settings.initial_soc_std_pct, 1, "%")
        initial = f"{number(settings.initial_soc_pct, 1)} ± {std}"
    error = number(model.noise.voltage_mae_pct, 2, "%")
    rows = {
        "method": settings.method,
        "initial SoC (±1σ)": initial,
        "capacity": number(settings.capacity_ah or model.capacity_ah, 2, "Ah"),
        "a gap is longer than": number(settings.gap_s, 1, "s"),
        "model": model.name,
        "voltage error (MAE) of the model": f"{error} on {model.noise.judged_on}",
        "identified at SoC": span(*model.range.soc_pct, 1, "%"),
        "identified at temperature": span(*model.range.temperature_c, 1, "°C"),
        "identified at current": span(*model.range.current_a, 0, "A"),
        "temperature of model / log": f"{model.temperature_source} / {log.temperature_source}",
    }
    blocks: list[Block] = [Table(["setting", ""], [list(row) for row in rows.items()])]
    if log.remarks:
        blocks += [Paragraph("Remarks on the log:"), Bullets(log.remarks)]
    return blocks

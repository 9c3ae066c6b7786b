"""The page of `cangauge estimate`: SoC against the reference, and when the estimate was valid."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from bokeh.models import ColumnDataSource
from numpy.typing import NDArray

from cangauge._text import duration, number
from cangauge._typing import FloatArray
from cangauge.bus.recording import CaptureSamples
from cangauge.estimation.offline import EstimateTable
from cangauge.extras.report.charts import (
    AMBER,
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    Figure,
    Plot,
    TimeFigures,
    stacked,
)
from cangauge.extras.report.page import Block, Page, Table, Tile, range_rows
from cangauge.identify.rows import running_rows
from cangauge.logs.log import Log
from cangauge.service.offline import RecordedEstimate
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
_NEWTON: Final = {"line_width": 0.8, "line_alpha": 0.6, "visible": False}
"""Style of the SoC by voltage alone: noisy, and hidden until its legend entry is clicked."""
_MAX_BARS: Final = 500
"""Gaps shorter than the time axis over this number are closed: no screen resolves them."""


def estimate_page(estimate: RecordedEstimate, model_path: Path | None = None) -> Page:
    """Return the page of an estimate.

    Parameters
    ----------
    estimate : RecordedEstimate
    model_path : Path, optional
        The model's file, to name it by its SHA-256.
    """
    log, model, table = estimate.recorded, estimate.model, estimate.table
    time = TimeFigures([log.time_s])
    reference = _reference(log)
    settings = [_settings(estimate), *(("Remarks on the log:", log.remarks) if log.remarks else ())]
    return Page(
        title=f"State of charge of {log.name}",
        lead=estimate_verdict(estimate),
        subtitle=f"{duration(log.duration_s)}, {len(log):,} samples, estimated by"
        f" {_METHODS[estimate.settings.method]} with the model {model.name}.",
        tiles=_tiles(estimate),
        sections={
            "State of charge": [
                _soc_figure(table, None if reference is None else (log.time_s, reference), time),
                *_soc_error(estimate, reference, time),
            ],
            "Voltage": _voltage(log, table, time),
            "Input": _input(log, time),
            "Status": [_status_figure(log, table, time), _reasons(table)],
            "Model and settings": settings,
        },
        model=model,
        model_path=model_path,
        logs=[log],
        warnings=estimate.warnings,
    )


def estimate_figure(table: EstimateTable, log: Log | None = None) -> Plot:
    """Return the SoC with ±2σ, by voltage and by counting alone, and the residual, for a notebook.

    Parameters
    ----------
    table : EstimateTable
    log : Log, optional
        Its reference SoC is drawn too.
    """
    time = TimeFigures([table.time_s])
    has_soc = log is not None and log.soc_pct is not None
    soc = _soc_figure(table, (log.time_s, log.soc_pct) if has_soc else None, time)  # type: ignore[union-attr,arg-type]
    residual = time.figure("", "measured − model [V]", "")
    residual.mark("width", 0.0)
    time.line(residual, "measured − model", [(table.time_s, table.residual_v)], BLUE)
    return stacked(soc, residual)


# --- The result in a sentence


def estimate_verdict(estimate: RecordedEstimate) -> str:
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
    return f"{text}{_longest_period(table)}."


def _longest_period(table: EstimateTable) -> str:
    """Return the longest time that is degraded or invalid, with its main reason, as a clause."""
    status, since_s = np.asarray(table.status), table.time_s - table.time_s[0]
    edges = np.flatnonzero(np.diff(status)) + 1
    periods = [
        (float(since_s[begin]), float(since_s[min(end, status.size - 1)]), slice(begin, end))
        for begin, end in pairwise([0, *edges, status.size])
        if status[begin] in {Status.DEGRADED, Status.INVALID}
    ]
    if not periods:
        return ""
    durations = [end_s - start_s for start_s, end_s, _ in periods]
    start_s, end_s, rows = periods[durations.index(max(durations))]
    name = Status(int(status[rows.start])).name.lower()
    reasons = np.asarray(table.reasons[rows]).astype(np.int64)
    samples = {reason: int(np.count_nonzero(reasons & reason)) for reason in Reason}
    main = max(samples, key=samples.__getitem__)
    text = f"; {name} from {_clock(start_s)} to {_clock(end_s)}"
    text += f" because {REASON_WORDS[main]}" if samples[main] else ""
    return text + (f", the longest of {len(periods)} periods" if len(periods) > 1 else "")


def _clock(seconds: float) -> str:
    """Return a time as h:mm:ss."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"


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


def _reference(log: Log | CaptureSamples) -> FloatArray | None:
    """Return the reference SoC; None if it is no more than an initial value."""
    if log.soc_pct is None or np.isfinite(log.soc_pct).sum() < 2:
        return None
    return log.soc_pct


# --- Figures


def _soc_figure(
    table: EstimateTable, reference: tuple[FloatArray, FloatArray] | None, time: TimeFigures
) -> Figure:
    """Return the SoC with ±2σ, by voltage and by counting alone; `reference` is (time_s, SoC)."""
    at = table.time_s
    low, high = table.soc_pct - 2.0 * table.soc_std_pct, table.soc_pct + 2.0 * table.soc_std_pct
    follow = "The estimate should follow the reference, which should lie inside the band."
    follow = "The log has no reference SoC." if reference is None else follow
    caption = f"{follow} Click “Newton” for the SoC by voltage alone; Coulomb counting drifts."
    figure = time.figure("Estimated state of charge", "state of charge [%]", caption, height=380)
    time.band(figure, [(at, np.maximum(low, 0.0), np.minimum(high, 100.0))])
    time.line(figure, "Newton", [(at, table.soc_newton_pct)], AMBER, **_NEWTON)
    time.line(figure, "Coulomb", [(at, table.soc_coulomb_pct)], GREEN, line_dash="dashed")
    if reference is not None:
        time.line(figure, "reference", [reference], BLACK, line_width=2.0)
    return time.line(figure, "estimate", [(at, table.soc_pct)], BLUE, line_width=2.0)


def _soc_error(
    estimate: RecordedEstimate, reference: FloatArray | None, time: TimeFigures
) -> list[Block]:
    """Return the errors against the reference; without one, the standard deviation alone."""
    table, scores, at = estimate.table, estimate.scores, estimate.table.time_s
    if reference is None:
        caption = "Standard deviation of the estimated SoC."
        figure = time.figure("Uncertainty", "σ of SoC [%]", caption)
        return [time.line(figure, "σ", [(at, table.soc_std_pct)], BLUE)]
    newton, coulomb, error = (
        soc_pct - reference
        for soc_pct in (table.soc_newton_pct, table.soc_coulomb_pct, table.soc_pct)
    )
    figure = time.figure(
        "Error against the reference",
        "SoC error [%]",
        "Each SoC minus the reference. An estimate that leaves the ±2σ band for long has an"
        " error that its model does not expect.",
        height=280,
    )
    band = np.minimum(2.0 * table.soc_std_pct, 100.0)
    time.band(figure, [(at, -band, band)])
    time.line(figure, "Newton", [(at, newton)], AMBER, **_NEWTON)
    time.line(figure, "Coulomb", [(at, coulomb)], GREEN, line_dash="dashed")
    time.line(figure, "estimate", [(at, error)], BLUE, line_width=1.8)
    figure.mark("width", 0.0)
    # A wide start or a few outliers do not flatten the rest.
    sizes = ((2.0 * table.soc_std_pct, 0.9), (coulomb, 0.99), (error, 0.99))
    known = [(np.abs(size[np.isfinite(size)]), quantile) for size, quantile in sizes]
    limit = max((float(np.quantile(size, q)) for size, q in known if size.size), default=1.0)
    figure.set_y_limits(-max(limit, 0.1), max(limit, 0.1))
    rows = [
        _error_row("estimate", scores.soc_mae_pct, error),
        _error_row("Newton alone", scores.soc_newton_mae_pct, newton),
        _error_row("Coulomb alone", scores.soc_coulomb_mae_pct, coulomb),
    ]
    head = ["SoC by", "MAE [%]", "RMSE [%]", "mean [%]", "largest [%]", "at the end [%]"]
    note = f"Over {np.isfinite(reference).sum():,} samples with a reference; errors in % SoC."
    return [figure, Table(head, rows, note)]


def _error_row(name: str, mae_pct: float | None, error: FloatArray) -> list[str]:
    error = error[np.isfinite(error)]
    error = error if error.size else np.full(1, np.nan)
    rms = float(np.sqrt(np.mean(error**2)))
    values = (mae_pct, rms, float(error.mean()), float(np.abs(error).max()), float(error[-1]))
    return [name, *(number(value, 2) for value in values)]


def _voltage(log: Log | CaptureSamples, table: EstimateTable, time: TimeFigures) -> list[Block]:
    at, running = log.time_s, np.isfinite(log.voltage_v)
    measured = int(running.sum())
    if measured:
        running[running] = running_rows(at[running], log.voltage_v[running])
    error = np.abs(table.residual_v[running])
    error = error[np.isfinite(error)]
    is_limited = int(running.sum()) < measured and error.size > 0
    below = " Start-up and shut-down rows lie below the figure." if is_limited else ""
    both = time.figure(
        "Measured and modelled voltage",
        "voltage [V]",
        f"The model's voltage at the estimated SoC should lie on the measurement.{below}",
        height=260,
    )
    time.line(both, "measured", [(at, log.voltage_v)], BLACK, line_width=1.1)
    model = [(at, table.voltage_model_v)]
    time.line(both, "model", model, ORANGE, line_width=0.9, line_alpha=0.85)
    residual = time.figure(
        "Measured minus modelled voltage",
        "residual [V]",
        "Scatter about zero averages out. A lasting bias shifts the SoC; the filter allows for"
        " the lasting error that the model file states.",
    )
    time.line(residual, "residual", [(at, table.residual_v)], PURPLE, line_width=0.9)
    residual.mark("width", 0.0)
    if is_limited:
        shown = np.concatenate([log.voltage_v[running], table.voltage_model_v[running]])
        both.set_y_limits(float(np.nanmin(shown)), float(np.nanmax(shown)))
        limit = float(np.quantile(error, 0.9995))
        residual.set_y_limits(-limit, limit)
    return [both, residual]


def _input(log: Log | CaptureSamples, time: TimeFigures) -> list[Block]:
    current, temperature = [(log.time_s, log.current_a)], [(log.time_s, log.temperature_c)]
    caption = f"Measured on: {log.temperature_source}. Outside the temperatures of the fit the SoC"
    caption += " is less certain."
    return [
        time.channel("current", "A", current, BLUE, "Positive current discharges the pack."),
        time.channel("temperature", "°C", temperature, ORANGE, caption),
    ]


# --- Status


def _status_figure(log: Log | CaptureSamples, table: EstimateTable, time: TimeFigures) -> Figure:
    """Return a row of bars for the status and one for each reason that occurs."""
    at = time.at(0, log.time_s)
    bars = [
        ("status", status.name.lower(), table.status == status, _STATUS_COLORS[status])
        for status in Status
    ]
    bars += [(name, name, mask, AMBER) for name, mask, _ in _reason_masks(table)]
    names = list(dict.fromkeys(row for row, _, _, _ in bars))
    figure = Figure(
        "Status over time",
        time.label,
        "",
        "Green: valid; amber: degraded; grey: initialising; black: invalid. Below: when each reason"
        " applied.",
        hover=f"@what<br>@left{{0.[00]}} … @right{{0.[00]}} {time.unit}",
        height=76 + 30 * len(names),
        x_range=time.x_range,
        y_categories=names[::-1],
    )
    spans = [(row, what, *ends, c) for row, what, mask, c in bars for ends in _intervals(at, mask)]
    columns = zip(("row", "what", "left", "right", "color"), zip(*spans, strict=True), strict=True)
    # An outline keeps a single sample visible.
    figure.plot.hbar(
        y="row",
        left="left",
        right="right",
        height=0.62,
        fill_color="color",
        line_color="color",
        source=ColumnDataSource(dict(columns)),
    )
    figure.plot.ygrid.grid_line_color = None
    return figure


def _intervals(at: FloatArray, mask: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """Return where `mask` begins and ceases to hold; each row lasts until the next one."""
    change = np.diff(np.concatenate(([0], mask.astype(np.int8), [0])))
    begin, end = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
    left, right = at[begin], at[np.minimum(end, at.size - 1)]
    if left.size > 1:
        apart = left[1:] - right[:-1] >= (at[-1] - at[0]) / _MAX_BARS
        left, right = left[np.r_[True, apart]], right[np.r_[apart, True]]
    return list(zip(left.tolist(), right.tolist(), strict=True))


def _reason_masks(table: EstimateTable) -> list[tuple[str, NDArray[np.bool_], str]]:
    """Return name, rows and meaning of each reason that occurs."""
    masks = [(reason, (table.reasons & reason) != 0) for reason in Reason]
    return [
        (reason_name(reason), mask, REASON_WORDS[reason]) for reason, mask in masks if mask.any()
    ]


def _reasons(table: EstimateTable) -> Table:
    """Return the share of samples with each status and each reason, with its meaning."""
    shares = [(status.name.lower(), table.status == status, "") for status in Status]
    entries = [
        {
            "status or reason": name,
            "share of samples": number(100.0 * float(mask.mean()), 1, "%"),
            "meaning": meaning,
        }
        for name, mask, meaning in (*shares, *_reason_masks(table))
        if mask.any()
    ]
    return Table.of(entries)


def _settings(estimate: RecordedEstimate) -> Table:
    log, model, settings = estimate.recorded, estimate.model, estimate.settings
    initial = "from the first voltages"
    if settings.initial_soc_pct is not None:
        std = number(settings.initial_soc_std_pct, 1, "%")
        initial = f"{number(settings.initial_soc_pct, 1)} ± {std}"
    error = number(model.noise.voltage_mae_pct, 2, "%")
    rows = [
        ["method", settings.method],
        ["initial SoC (±1σ)", initial],
        ["capacity", number(settings.capacity_ah or model.capacity_ah, 2, "Ah")],
        ["a gap is longer than", number(settings.gap_s, 1, "s")],
        ["model", model.name],
        ["voltage error (MAE) of the model", f"{error} on {model.noise.judged_on}"],
        *range_rows(model),
        ["temperature of model / log", f"{model.temperature_source} / {log.temperature_source}"],
    ]
    return Table(["setting", ""], rows)

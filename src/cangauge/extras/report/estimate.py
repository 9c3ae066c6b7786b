"""The page of `cangauge estimate`: SoC against the reference, and when the estimate was valid."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from bokeh.models import ColumnDataSource

from cangauge._text import number
from cangauge._typing import BoolArray, FloatArray
from cangauge.bus.recording import CaptureSamples
from cangauge.estimation.offline import EstimateTable
from cangauge.extras.report.charts import (
    AMBER,
    BLACK,
    GREEN,
    GREY,
    Figure,
    Pieces,
    Plot,
    TimeFigures,
    stacked,
)
from cangauge.extras.report.page import Page
from cangauge.identify.rows import running_rows
from cangauge.logs.log import Log
from cangauge.service.offline import RecordedEstimate
from cangauge.types import REASON_WORDS, Reason, Status, reason_name

_STATUS_COLORS: Final = {
    Status.INITIALISING: GREY,
    Status.VALID: GREEN,
    Status.DEGRADED: AMBER,
    Status.INVALID: BLACK,
}


def estimate_page(estimate: RecordedEstimate, model_path: Path | None = None) -> Page:
    """Return the page of an estimate.

    Parameters
    ----------
    estimate : RecordedEstimate
    model_path : Path, optional
        The model's file, to name it by its SHA-256.
    """
    log, table = estimate.recorded, estimate.table
    time = TimeFigures([log.time_s])
    reference = _reference(log)
    errors = {} if reference is None else _errors(table, reference)
    values = {
        "estimate": estimate,
        "path": model_path,
        "verdict": estimate_verdict(estimate),
        "known": np.flatnonzero(np.isfinite(table.soc_pct)),
        "errors": {name: each[np.isfinite(each)] for name, each in errors.items()},
        "references": 0 if reference is None else np.isfinite(reference).sum(),
        "soc": _soc_figure(table, [] if reference is None else [(log.time_s, reference)], time),
        "error": _error_figure(table, errors, time) if errors else _std_figure(table, time),
        "voltage": _voltage(log, table, time),
        "input": [
            time.channel([log], "current", "Positive current discharges the pack."),
            time.channel(
                [log],
                "temperature",
                f"Measured on: {log.temperature_source}. Outside the temperatures of the fit the"
                " SoC is less certain.",
            ),
        ],
        "status": _status_figure(log, table, time),
        "masks": _masks(table),
        "meanings": {reason_name(reason): REASON_WORDS[reason] for reason in Reason},
    }
    return Page.of("estimate.j2", values)


def estimate_figure(table: EstimateTable, log: Log | None = None) -> Plot:
    """Return the SoC with ±2σ, by voltage and by counting alone, and the residual, for a notebook.

    Parameters
    ----------
    table : EstimateTable
    log : Log, optional
        Its reference SoC is drawn too.
    """
    time = TimeFigures([table.time_s])
    known = [] if log is None or log.soc_pct is None else [(log.time_s, log.soc_pct)]
    pieces = {"residual": [(table.time_s, table.residual_v)]}
    residual = time.figure("", "measured − model [V]", "", pieces)
    residual.mark("width", 0.0)
    return stacked(_soc_figure(table, known, time), residual)


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


def _reference(log: Log | CaptureSamples) -> FloatArray | None:
    """Return the reference SoC; None if it is no more than an initial value."""
    if log.soc_pct is None or np.isfinite(log.soc_pct).sum() < 2:
        return None
    return log.soc_pct


def _errors(table: EstimateTable, reference: FloatArray) -> dict[str, FloatArray]:
    """Return what each SoC differs by from the reference [%]."""
    each = {"estimate": table.soc_pct, "Newton": table.soc_newton_pct}
    each["Coulomb"] = table.soc_coulomb_pct
    return {name: soc_pct - reference for name, soc_pct in each.items()}


# --- Figures


def _soc_figure(table: EstimateTable, reference: Pieces, time: TimeFigures) -> Figure:
    """Return the SoC with ±2σ, by voltage and by counting alone, and the reference if any."""
    at = table.time_s
    low, high = table.soc_pct - 2.0 * table.soc_std_pct, table.soc_pct + 2.0 * table.soc_std_pct
    follow = "The log has no reference SoC."
    if reference:
        follow = "The estimate should follow the reference, which should lie inside the band."
    return time.figure(
        "Estimated state of charge",
        "state of charge [%]",
        f"{follow} Click “Newton” for the SoC by voltage alone; Coulomb counting drifts.",
        {
            "Newton": [(at, table.soc_newton_pct)],
            "Coulomb": [(at, table.soc_coulomb_pct)],
            **({"reference": reference} if reference else {}),
            "estimate": [(at, table.soc_pct)],
        },
        band=[(at, np.maximum(low, 0.0), np.minimum(high, 100.0))],
        height=380,
    )


def _std_figure(table: EstimateTable, time: TimeFigures) -> Figure:
    pieces = [(table.time_s, table.soc_std_pct)]
    caption = "Standard deviation of the estimated SoC."
    return time.figure("Uncertainty", "σ of SoC [%]", caption, {"σ": pieces})


def _error_figure(table: EstimateTable, errors: dict[str, FloatArray], time: TimeFigures) -> Figure:
    band = np.minimum(2.0 * table.soc_std_pct, 100.0)
    figure = time.figure(
        "Error against the reference",
        "SoC error [%]",
        "Each SoC minus the reference. An estimate that leaves the ±2σ band for long has an"
        " error that its model does not expect.",
        {name: [(table.time_s, errors[name])] for name in ("Newton", "Coulomb", "estimate")},
        band=[(table.time_s, -band, band)],
        height=280,
    )
    figure.mark("width", 0.0)
    # A wide start or a few outliers do not flatten the rest.
    sizes = ((band, 0.9), (errors["Coulomb"], 0.99), (errors["estimate"], 0.99))
    known = [(np.abs(size[np.isfinite(size)]), part) for size, part in sizes]
    limit = max((float(np.quantile(size, part)) for size, part in known if size.size), default=1.0)
    figure.set_y_limits(-max(limit, 0.1), max(limit, 0.1))
    return figure


def _voltage(log: Log | CaptureSamples, table: EstimateTable, time: TimeFigures) -> list[Figure]:
    """Return both voltages and the residual; rows of start-up do not compress the rest."""
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
        {"measured": [(at, log.voltage_v)], "model": [(at, table.voltage_model_v)]},
        height=260,
    )
    residual = time.figure(
        "Measured minus modelled voltage",
        "residual [V]",
        "Scatter about zero averages out. A lasting bias shifts the SoC; the filter allows for"
        " the lasting error that the model file states.",
        {"residual": [(at, table.residual_v)]},
    )
    residual.mark("width", 0.0)
    if is_limited:
        shown = np.concatenate([log.voltage_v[running], table.voltage_model_v[running]])
        both.set_y_limits(float(np.nanmin(shown)), float(np.nanmax(shown)))
        limit = float(np.quantile(error, 0.9995))
        residual.set_y_limits(-limit, limit)
    return [both, residual]


# --- Status


def _masks(table: EstimateTable) -> tuple[dict[str, BoolArray], dict[str, BoolArray]]:
    """Return the rows of each status and of each reason that occurs, by its name."""
    statuses = {status.name.lower(): table.status == status for status in Status}
    reasons = {reason_name(reason): (table.reasons & reason) != 0 for reason in Reason}
    status, reason = (
        {name: mask for name, mask in masks.items() if mask.any()} for masks in (statuses, reasons)
    )
    return status, reason


def _status_figure(log: Log | CaptureSamples, table: EstimateTable, time: TimeFigures) -> Figure:
    """Return a row of bars for the status and one for each reason that occurs."""
    at = time.at(0, log.time_s)
    statuses, reasons = _masks(table)
    bars = [
        ("status", name, mask, _STATUS_COLORS[Status[name.upper()]])
        for name, mask in statuses.items()
    ]
    bars += [(name, name, mask, AMBER) for name, mask in reasons.items()]
    figure = Figure(
        "Status over time",
        time.label,
        "",
        "Green: valid; amber: degraded; grey: initialising; black: invalid. Below: when each reason"
        " applied.",
        hover=f"@what<br>@left{{0.[00]}} … @right{{0.[00]}} {time.unit}",
        height=106 + 30 * len(reasons),
        x_range=time.x_range,
        y_categories=[*reversed(reasons), "status"],
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


def _intervals(at: FloatArray, mask: BoolArray) -> list[tuple[float, float]]:
    """Return where `mask` begins and ceases to hold; each row lasts until the next one.

    Gaps below a five-hundredth of the axis are closed: no screen resolves them.
    """
    change = np.diff(np.concatenate(([0], mask.astype(np.int8), [0])))
    begin, end = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
    left, right = at[begin], at[np.minimum(end, at.size - 1)]
    apart = left[1:] - right[:-1] >= (at[-1] - at[0]) / 500.0
    left, right = left[np.r_[True, apart]], right[np.r_[apart, True]]
    return list(zip(left.tolist(), right.tolist(), strict=True))

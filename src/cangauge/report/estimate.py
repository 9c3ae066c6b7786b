"""When an estimate was valid and when not, drawn as bars over time with the reasons in words.

The report of an estimate: SoC against the reference, and how far each value can be trusted.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from bokeh.models import ColumnDataSource
from numpy.typing import NDArray

from cangauge._formatting import duration, number, span
from cangauge._typing import FloatArray
from cangauge.estimate.offline import EstimateTable, Scores
from cangauge.estimate.settings import EstimatorSettings
from cangauge.estimate.validity import REASON_WORDS, Reason, Status, reason_name
from cangauge.inference.rows import running_rows
from cangauge.model.model_file import Model
from cangauge.report.charts import (
    AMBER,
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    Pen,
    Plot,
    Recorded,
    TimeFigures,
    Timeline,
    add_zero,
    frame,
    plane,
)
from cangauge.report.page import (
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

# --- When an estimate was valid and when not, drawn as bars over time with the reasons in words

STATUS_COLORS = {
    Status.INITIALISING: GREY,
    Status.VALID: GREEN,
    Status.DEGRADED: AMBER,
    Status.INVALID: BLACK,
}

SPANS_AT_MOST = 500
"""Gaps shorter than this part of the time axis are not drawn: no screen shows them."""


def status_figure(log: Recorded, table: EstimateTable, time: TimeFigures) -> Figure:
    """Return a row of bars for the status and one for each reason that ever was set."""
    reasons = _seen(table)
    names = ["status", *(reason_name(reason) for reason in reasons)]
    plot = plane(
        (time.timeline.label, ""),
        f"@what<br>@left{{0.[00]}} … @right{{0.[00]}} {time.timeline.unit}",
        units=("", ""),
        height=76 + 30 * len(names),
        x_range=time.x_range,
        y_categories=names[::-1],
    )
    at = time.timeline.at(0, log.time_s)
    for status in Status:
        spans = _stretches(at, table.status == status)
        _add_bars(plot, spans, ("status", status.name.lower()), STATUS_COLORS[status])
    for reason, name in zip(reasons, names[1:], strict=True):
        _add_bars(plot, _stretches(at, (table.reasons & reason) != 0), (name, name), AMBER)
    plot.ygrid.grid_line_color = None
    return Figure(
        "Status over time",
        plot,
        "Green is valid, amber degraded, grey initialising, black invalid; below, when each reason"
        " held.",
    )


def reason_table(table: EstimateTable) -> Table:
    """Return the share of samples of each status and each reason, with its meaning."""
    rows = [
        [status.name.lower(), _share(table.status == status), ""]
        for status in Status
        if np.any(table.status == status)
    ]
    rows += [
        [reason_name(reason), _share((table.reasons & reason) != 0), REASON_WORDS[reason]]
        for reason in _seen(table)
    ]
    return Table(["status or reason", "share of samples", "meaning"], rows)


def _seen(table: EstimateTable) -> list[Reason]:
    return [reason for reason in Reason if np.any(table.reasons & reason)]


def _share(mask: NDArray[np.bool_]) -> str:
    return number(100.0 * float(mask.mean()), 2, "%")


def _add_bars(
    plot: Plot, spans: tuple[FloatArray, FloatArray], words: tuple[str, str], color: str
) -> None:
    """Draw one bar for each stretch of time, in the row and with the hover text of `words`."""
    left, right = spans
    if not left.size:
        return
    row, what = words
    columns = {"left": left, "right": right, "row": [row] * left.size, "what": [what] * left.size}
    plot.hbar(
        y="row",
        left="left",
        right="right",
        height=0.62,
        fill_color=color,
        line_color=color,  # a single sample must still be seen
        source=ColumnDataSource(columns),
    )


def _stretches(at: FloatArray, mask: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    """Return where `mask` begins and ceases to hold; each row lasts until the next one."""
    change = np.diff(np.concatenate(([0], mask.astype(np.int8), [0])))
    begin, end = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
    left, right = at[begin], at[np.minimum(end, at.size - 1)]
    if left.size > 1:
        least = (at[-1] - at[0]) / SPANS_AT_MOST
        apart = left[1:] - right[:-1] >= least
        left, right = left[np.r_[True, apart]], right[np.r_[apart, True]]
    return left, right


# --- The report of an estimate: SoC against the reference, and how far each value can be tru…

METHOD_WORDS = {
    "ekf": "fusion (EKF) of voltage and charge",
    "newton": "inverse of the voltage model (Newton)",
    "coulomb": "Coulomb counting",
}


def estimate_report(
    log: Recorded,
    table: EstimateTable,
    scores: Scores,
    model: Model,
    settings: EstimatorSettings | None = None,
) -> str:
    """Return the report of an estimate as one self-contained HTML page.

    Parameters
    ----------
    log : Recorded
        What was estimated, n rows: a log, or the samples of a capture.
    table : EstimateTable
        Its estimates, n rows.
    scores : Scores
    model : Model
    settings : EstimatorSettings, optional
    """
    return render(estimate_page(log, table, scores, model, settings))


def estimate_page(
    log: Recorded,
    table: EstimateTable,
    scores: Scores,
    model: Model,
    settings: EstimatorSettings | None = None,
    *,
    title: str | None = None,
    first: Sequence[Section] = (),
) -> Page:
    """Return the report's content (see `estimate_report`), for those who want to add to it.

    Parameters
    ----------
    title : str, optional
        In place of "State of charge of <log>".
    first : sequence of Section
        What to show before the rest.
    """
    settings = settings or EstimatorSettings()
    time = TimeFigures(Timeline.of([log]))
    sections = [
        *first,
        Section("State of charge", _soc(log, table, time)),
        *_scores(log, table, scores),
        Section("Voltage", _voltage(log, table, time)),
        Section("Input", _input(log, time)),
        Section("Status", [status_figure(log, table, time), reason_table(table)]),
        Section("Model and settings", _settings(log, model, settings)),
    ]
    return Page(
        title=title or f"State of charge of {log.name}",
        subtitle=f"{duration(log.duration_s)}, {len(log):,} samples, by"
        f" {METHOD_WORDS[settings.method]} with the model {model.name}."
        " Positive current discharges.",
        tiles=_tiles(log, table, scores),
        sections=sections,
        banners=reconstruction_banners(log.name, log.source, *log.remarks),
    )


def _tiles(log: Recorded, table: EstimateTable, scores: Scores) -> list[Tile]:
    known = np.flatnonzero(np.isfinite(table.soc_pct))
    ends = f"{number(table.soc_pct[known[0]], 1)} → {number(table.soc_pct[known[-1]], 1, '%')}" \
        if known.size else "–"  # fmt: skip
    std = number(table.soc_std_pct[known[-1]], 2, "%") if known.size else "–"
    tiles = [Tile("SoC, start → end", ends, f"σ at the end {std}")]
    if _reference(log) is not None:
        cover = None if scores.cover_2sigma is None else 100.0 * scores.cover_2sigma
        tiles += [
            Tile("SoC error (MAE)", number(scores.soc_mae_pct, 2, "%"),
                 f"largest {number(scores.soc_max_pct, 2, '%')}"),
            Tile("Newton alone (MAE)", number(scores.soc_newton_mae_pct, 2, "%"), "no counting"),
            Tile("Coulomb alone (MAE)", number(scores.soc_coulomb_mae_pct, 2, "%"), "no voltage"),
            Tile("Within ±2σ", number(cover, 1, "%"), "of compared samples"),
        ]  # fmt: skip
    tiles += [
        Tile("Voltage error (MAE)", number(scores.voltage_mae_pct, 3, "%"), "measured − model"),
        Tile("Valid", number(100.0 * scores.valid_fraction, 1, "%"), "of all samples"),
    ]
    return tiles


def _soc(log: Recorded, table: EstimateTable, time: TimeFigures) -> list[Block]:
    reference = _reference(log)
    at = log.time_s
    plot = time.plot("state of charge", "%", height=380)
    time.band(plot, "±2σ", [(at, *_band(table.soc_pct, table.soc_std_pct, 0.0))], BLUE)
    time.line(plot, "Newton", [(at, table.soc_newton_pct)], Pen(AMBER, width=0.8, alpha=0.6))
    time.line(plot, "Coulomb", [(at, table.soc_coulomb_pct)], Pen(GREEN, dash="dashed"))
    if reference is not None:
        time.line(plot, "reference", [(at, reference)], Pen(BLACK, width=2.0))
    time.line(plot, "estimate", [(at, table.soc_pct)], Pen(BLUE, width=2.0))
    shown = Figure(
        "Estimated state of charge",
        plot,
        "The estimate should follow the reference, with the reference inside the band nearly"
        " always. Newton scatters where the voltage is flat; counting drifts."
        if reference is not None
        else "The log has no reference SoC to compare with. Newton scatters where the voltage is"
        " flat; counting drifts.",
    )
    if reference is None:
        return [shown, _uncertainty(log, table, time)]
    error = time.plot("SoC error", "%", height=280)
    time.band(error, "±2σ", [(at, *_band(np.zeros_like(at), table.soc_std_pct, -100.0))], BLUE)
    for name, values, pen in (
        ("Newton", table.soc_newton_pct, Pen(AMBER, width=0.8, alpha=0.6)),
        ("Coulomb", table.soc_coulomb_pct, Pen(GREEN, dash="dashed")),
        ("estimate", table.soc_pct, Pen(BLUE, width=1.8)),
    ):
        time.line(error, name, [(at, values - reference)], pen)
    everyone = (table.soc_newton_pct, table.soc_coulomb_pct, table.soc_pct)
    _frame_error(error, [values - reference for values in everyone], table.soc_std_pct)
    add_zero(error)
    return [
        shown,
        Figure(
            "Error against the reference",
            error,
            "Each SoC minus the reference. The band is the estimate's own claim: a line that"
            " leaves it for long shows an error that the estimate did not expect."
            " A wide band at the start may reach beyond the frame.",
        ),
    ]


def _uncertainty(log: Recorded, table: EstimateTable, time: TimeFigures) -> Figure:
    plot = time.plot("σ of SoC", "%", height=235)
    time.line(plot, "σ", [(log.time_s, table.soc_std_pct)], Pen(BLUE, in_legend=False))
    return Figure("Uncertainty", plot, "The estimate's own standard deviation.")


def _scores(log: Recorded, table: EstimateTable, scores: Scores) -> list[Section]:
    """Return the section with the error of each way to SoC; none without a reference."""
    reference = _reference(log)
    if reference is None:
        return []
    rows = []
    for name, values, mae in (
        ("estimate", table.soc_pct, scores.soc_mae_pct),
        ("Newton alone", table.soc_newton_pct, scores.soc_newton_mae_pct),
        ("Coulomb alone", table.soc_coulomb_pct, scores.soc_coulomb_mae_pct),
    ):
        error = values - reference
        error = error[np.isfinite(error)]
        known = error.size > 0
        rows.append(
            [
                name,
                number(mae, 2),
                number(float(np.sqrt(np.mean(error**2))) if known else None, 2),
                number(float(error.mean()) if known else None, 2),
                number(float(np.abs(error).max()) if known else None, 2),
                number(float(error[-1]) if known else None, 2),
            ]
        )
    head = ["SoC by", "MAE [%]", "RMSE [%]", "mean [%]", "largest [%]", "at the end [%]"]
    note = f"Over {np.isfinite(reference).sum():,} samples with a reference; errors in % SoC."
    return [Section("How good it is", [Table(head, rows, note)])]


def _voltage(log: Recorded, table: EstimateTable, time: TimeFigures) -> list[Block]:
    at = log.time_s
    both = time.plot("voltage", "V", height=260)
    time.line(both, "measured", [(at, log.voltage_v)], Pen(BLACK, width=1.1))
    time.line(both, "model", [(at, table.voltage_model_v)], Pen(ORANGE, width=0.9, alpha=0.85))
    residual = time.plot("residual", "V", height=235)
    pen = Pen(PURPLE, width=0.9, in_legend=False)
    time.line(residual, "residual", [(at, table.residual_v)], pen)
    add_zero(residual)
    beyond = _frame_running(log, table, both, residual)
    return [
        Figure(
            "Measured and modelled voltage",
            both,
            f"The model's voltage at the estimated SoC should lie on the measurement.{beyond}",
        ),
        Figure(
            "Measured minus modelled voltage",
            residual,
            "Scatter about zero is harmless; a lasting bias pulls the SoC, and the filter allows"
            " for as much of it as the model file states.",
        ),
    ]


def _frame_running(log: Recorded, table: EstimateTable, both: Plot, residual: Plot) -> str:
    """Keep start-up and shut-down rows out of the frames; say so if there are any."""
    running = np.isfinite(log.voltage_v)
    measured = int(running.sum())
    if measured:
        running[running] = running_rows(log.time_s[running], log.voltage_v[running])
    error = np.abs(table.residual_v[running])
    error = error[np.isfinite(error)]
    if int(running.sum()) == measured or not error.size:
        return ""
    shown = np.concatenate([log.voltage_v[running], table.voltage_model_v[running]])
    frame(both, float(np.nanmin(shown)), float(np.nanmax(shown)))
    limit = float(np.quantile(error, 0.9995))
    frame(residual, -limit, limit)
    return " Start-up and shut-down rows lie below the frame."


def _input(log: Recorded, time: TimeFigures) -> list[Block]:
    current = time.plot("current", "A", height=235)
    time.line(
        current, "current", [(log.time_s, log.current_a)], Pen(BLUE, width=0.9, in_legend=False)
    )
    temperature = time.plot("temperature", "°C", height=235)
    time.line(
        temperature, "temperature", [(log.time_s, log.temperature_c)],
        Pen(ORANGE, width=1.2, in_legend=False),
    )  # fmt: skip
    return [
        Figure("Current", current, "Above zero the pack is discharged, below it is charged."),
        Figure(
            "Temperature",
            temperature,
            f"Measured on: {log.temperature_source}. Only within the model's own temperatures is"
            " the estimate called valid.",
        ),
    ]


def _settings(log: Recorded, model: Model, settings: EstimatorSettings) -> list[Block]:
    start = settings.initial_soc_pct
    given = (
        "from the first voltages"
        if start is None
        else f"{number(start, 2)} ± {number(settings.initial_soc_std_pct, 2, '%')}"
    )
    blocks: list[Block] = [
        Table(
            ["setting", ""],
            [
                ["method", METHOD_WORDS[settings.method]],
                ["initial SoC (±1σ)", given],
                ["capacity", number(settings.capacity_ah or model.capacity_ah, 2, "Ah")],
                ["longest step that is no gap", number(settings.gap_s, 1, "s")],
                ["model", model.name],
                ["model's voltage error", number(model.noise.voltage_mae_pct, 3, "%")
                 + f" on {model.noise.judged_on}"],
                ["identified over SoC", span(*model.range.soc_pct, 1, "%")],
                ["identified over temperature", span(*model.range.temperature_c, 1, "°C")],
                ["identified over current", span(*model.range.current_a, 1, "A")],
                ["temperature of model / log",
                 f"{model.temperature_source} / {log.temperature_source}"],
            ],
        )
    ]  # fmt: skip
    if log.remarks:
        blocks += [Paragraph("Remarks on the log:"), Bullets(log.remarks)]
    return blocks


def _reference(log: Recorded) -> FloatArray | None:
    """Return the reference SoC; None if there is no more of it than a start."""
    if log.soc_pct is None or np.isfinite(log.soc_pct).sum() < 2:
        return None
    return log.soc_pct


def _band(middle: FloatArray, std: FloatArray, least: float) -> tuple[FloatArray, FloatArray]:
    """Return the ends of ±2σ, within `least` … 100."""
    return np.maximum(middle - 2.0 * std, least), np.minimum(middle + 2.0 * std, 100.0)


def _frame_error(plot: Plot, errors: Sequence[FloatArray], std: FloatArray) -> None:
    """Set the vertical range so that a wide start or a few far values do not flatten the rest."""
    sizes = [(np.abs(error), 0.99) for error in errors] + [(2.0 * std, 0.9)]
    known = [(size[np.isfinite(size)], part) for size, part in sizes]
    limit = max((float(np.quantile(size, part)) for size, part in known if size.size), default=1.0)
    frame(plot, -max(limit, 0.1), max(limit, 0.1))

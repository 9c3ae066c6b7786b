"""`cangauge estimate`: a log or capture and a model → SoC at every sample, offline."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cangauge._extras import extra
from cangauge._files import atomic_path
from cangauge._text import NONE_KNOWN, number, rounded, uncertain
from cangauge.cli.declare import command
from cangauge.cli.options import ReadingOptions, assumed_of, check_outputs, note_starts
from cangauge.cli.output import emit_json, live_line, note, print_values
from cangauge.cli.status import pack_values
from cangauge.types import REASON_WORDS, Reason

if TYPE_CHECKING:
    from cangauge.bus.captures import Capture
    from cangauge.estimation.settings import EstimatorSettings
    from cangauge.logs.log import Log
    from cangauge.model.model_file import Model
    from cangauge.service.offline import RecordedEstimate


@command()
def estimate_command(
    log_path: Path,
    *,
    model: Path,
    output: Path,
    method: Literal["ekf", "newton", "coulomb"] = "ekf",
    initial_soc: float | Literal["auto"] | None = None,
    initial_soc_std: float = 1.0,
    capacity_ah: float | None = None,
    reading: ReadingOptions,
    pack: Path | None = None,
    report: Path | None = None,
    json_output: bool = False,
) -> None:
    """Estimate the state of charge of a recorded log or capture, offline.

    OUT has one row per sample: time_s [s], soc_pct, soc_std_pct, soc_newton_pct, soc_coulomb_pct
    [%], voltage_model_v, residual_v (measured − model) [V], status (initialising, valid, degraded,
    invalid) and reasons (separated by "; "). An unknown value is empty (CSV) or null (Parquet).
    An .mcap holds samples and estimates for Foxglove and PlotJuggler. Positive current discharges.

    PACK has one row per second, of a log over an hour 3,600 rows: capacity_ah, resistance_ratio,
    offset_a, discharge_a and charge_a (possible for 10 s), energy_wh (left), with standard
    deviations; and, where the log has cell voltages (columns cell_1_v, cell_2_v, …, or [cells] of
    the map file), the weakest cell.

    Examples
    --------
    `cangauge estimate trip.parquet -m pack.json -o soc.csv --report soc.html`

    `cangauge estimate trip.csv -m pack.json -o soc.parquet --initial-soc auto`

    `cangauge estimate drive.log --vehicle leaf_ze0 -m leaf.json -o soc.csv --method newton`

    Parameters
    ----------
    log_path : LOG
        Recorded log or capture.
    output : -o, --output OUT.csv|.parquet|.mcap
        Table of estimates.
    method : ekf|newton|coulomb
        Method of soc_pct: Kalman filter over voltage and charge (ekf), voltage alone (newton), or
        counting alone (coulomb).
    initial_soc : P|auto (0 … 100 %)
        SoC at the first sample, e.g. 80; `auto` takes it from the first voltages. Default: the
        first soc_pct of a log, counted back to its first row; else, and for a capture (as live),
        auto.
    initial_soc_std : X (0 … 100 %)
        Standard deviation of the initial SoC.
    pack : PACK.csv|.parquet
        Table of health, power and cells, once a second.
    """
    from cangauge.estimation.settings import EstimatorSettings
    from cangauge.logs.read import LogFile
    from cangauge.model.model_file import Model

    settings = EstimatorSettings(
        method=method,
        initial_soc_pct=None if initial_soc == "auto" else initial_soc,
        initial_soc_std_pct=initial_soc_std,
        capacity_ah=capacity_ah,
    )
    check_outputs([output, pack, report], [log_path, model])
    pack_model, logs, recording = Model.load(model), [], reading.open(log_path)
    if isinstance(recording, LogFile):
        logs = [reading.load(log_path)]
        done = _of_log(logs[0], pack_model, settings, reading, pack=pack, initial_soc=initial_soc)
    else:
        done = _of_capture(recording, pack_model, settings, reading, pack)
    _write(done, output, pack, report, model)
    for warning in done.warnings:
        note(f"warning: {done.recorded.source}: {warning}")
    if json_output:
        files = {"output": output, "pack": pack, "report": report}
        named = {name: path and str(path) for name, path in files.items()}
        emit_json(done.to_dict() | named | {"assumed": assumed_of(logs)})
        return
    _show(done)
    written = {"estimates": output, "health, power and cells": pack, "report": report}
    for what, path in written.items():
        if path is not None:
            note(f"{what}: {path}")


def _of_log(
    log: Log,
    model: Model,
    settings: EstimatorSettings,
    reading: ReadingOptions,
    *,
    pack: Path | None,
    initial_soc: float | str | None,
) -> RecordedEstimate:
    from cangauge.logs.read import read_cells
    from cangauge.model.delay_line import GAP_S
    from cangauge.service.offline import PackHistory, estimate_recorded_log

    if settings.initial_soc_pct is not None:
        note_starts([log], settings.initial_soc_pct, settings.capacity_ah or model.capacity_ah)
    cells = read_cells(Path(log.source), log.time_s, reading.given_columns())
    history = PackHistory(keeps_rows=pack is not None, cells=cells, duration_s=log.duration_s)
    with live_line() as show:
        done = estimate_recorded_log(
            log,
            model,
            settings,
            soc_from_log=initial_soc is None,
            pack=history,
            progress=lambda count: show(f"{log.name}: {count} of {len(log)} samples"),
        )
    if (gap_s := done.settings.gap_s) > GAP_S:
        note(
            f"note: {log.source}: its usual step is {rounded(gap_s / 3.0, 2)} s;"
            f" steps over {rounded(gap_s, 2)} s count as gaps"
        )
    return done


def _of_capture(
    capture: Capture,
    model: Model,
    settings: EstimatorSettings,
    reading: ReadingOptions,
    pack: Path | None,
) -> RecordedEstimate:
    """Estimate a capture; InputError if it has one sample, or inverted current."""
    from cangauge.bus.recording import CaptureSamples, refuse_single_row
    from cangauge.logs.sign import require_discharge_positive
    from cangauge.service.offline import estimate_capture

    car = reading.car_of(capture.path)
    with live_line() as show:
        done = estimate_capture(
            capture.path,
            car,
            model,
            settings,
            keeps_pack=pack is not None,
            progress=lambda count: show(f"{capture.path.name}: {count} frames"),
        )
    recorded = done.recorded
    refuse_single_row(recorded)
    for remark in recorded.remarks:
        note(f"{recorded.source}: {remark}")
    if isinstance(recorded, CaptureSamples) and (log := recorded.as_log()) is not None:
        require_discharge_positive(log, is_capture=True)
    return done


def _write(
    done: RecordedEstimate, output: Path, pack: Path | None, report: Path | None, model_path: Path
) -> None:
    """Write the tables and the report, or none of them."""
    from cangauge.logs.canonical import write_table
    from cangauge.service.estimate_table import write_estimates

    page = extra("report.estimate:estimate_page")(done, model_path).html() if report else ""
    with ExitStack() as all_of_them:
        part = all_of_them.enter_context(atomic_path(output))
        if output.suffix.lower() == ".mcap":
            extra("formats.estimate_mcap:write_estimates_mcap")(part, done.recorded, done.table)
        else:
            write_estimates(part, done.recorded.time_s, done.table)
        if pack is not None:
            write_table(done.pack.columns, all_of_them.enter_context(atomic_path(pack)))
        if report is not None:
            all_of_them.enter_context(atomic_path(report)).write_text(page, encoding="utf-8")


def _show(done: RecordedEstimate) -> None:
    """Print the SoC at both ends, its error where the log has a reference, and the pack."""
    scores, table = done.scores, done.table
    origin = {"given": "given", "log": "from the log's soc_pct", "voltage": "found by the voltage"}
    known = [row for row in range(len(table.soc_pct)) if table.soc_pct[row] == table.soc_pct[row]]
    start = number(done.settings.initial_soc_pct, 1, "%")
    if done.origin == "voltage" and known:
        start = uncertain(float(table.soc_pct[known[0]]), float(table.soc_std_pct[known[0]]), "%")
    cover = None if scores.cover_2sigma is None else 100.0 * scores.cover_2sigma
    shares = [
        f"{REASON_WORDS[Reason[name.upper().replace(' ', '_')]]} {number(100.0 * share, 1, '%')}"
        for name, share in done.reason_shares.items()
    ]
    values = {
        "initial SoC": f"{start} ({origin[done.origin]})",
        "SoC at the end": uncertain(float(table.soc_pct[-1]), float(table.soc_std_pct[-1]), "%"),
        "SoC error, MAE": number(scores.soc_mae_pct, 2, "%"),
        "SoC error, largest": number(scores.soc_max_pct, 2, "%"),
        "reference within ±2σ": number(cover, 1, "% of samples"),
        "voltage error, MAE": number(scores.voltage_mae_pct, 2, "%"),
        "valid": number(100.0 * scores.valid_fraction, 1, "% of samples"),
        "less than valid": "; ".join(shares) or NONE_KNOWN,
    }
    if done.pack.report is not None:
        values |= pack_values(done.pack.report.to_dict())
    print_values(f"State of charge of {done.recorded.name}", values)

"""`cangauge estimate`: a log or capture and a model → SoC at every sample, offline."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import typer
from rich.progress import Progress

from cangauge._extras import extra
from cangauge._files import atomic_path
from cangauge._text import (
    NONE_KNOWN,
    number,
    possible,
    rounded,
    significant,
    uncertain,
    uncertain_energy,
)
from cangauge.cli.options import (
    JsonOption,
    ReadingOptions,
    ReportOption,
    assumed_of,
    check_outputs,
    known_temperature_source,
    note_starts,
    option_groups,
    refuse_inverted_current,
    suffixed,
    unnamed_capture,
    within,
)
from cangauge.cli.output import console, emit_json, note, print_table
from cangauge.cli.shown import VALID_STD_PCT
from cangauge.errors import InputError
from cangauge.types import REASON_WORDS, Reason

if TYPE_CHECKING:
    from cangauge.bus.publish import PackReport
    from cangauge.estimation.power import KnownLimits
    from cangauge.estimation.settings import Method
    from cangauge.model.model_file import Model
    from cangauge.service.offline import RecordedEstimate

AUTO = "auto"


@option_groups()
def estimate_command(  # noqa: PLR0917 - typer passes options by name
    log_path: Annotated[Path, typer.Argument(metavar="LOG", help="Recorded log or capture.")],
    model_path: Annotated[
        Path, typer.Option("-m", "--model", metavar="MODEL", help="Model file of `cangauge fit`.")
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="OUT",
            callback=suffixed(".csv", ".parquet", ".mcap"),
            help="Table of estimates, .csv, .parquet or .mcap.",
        ),
    ],
    method: Annotated[
        str,
        typer.Option(
            metavar="ekf|newton|coulomb",
            help="Method of soc_pct: Kalman filter over voltage and charge (ekf), voltage alone"
            " (newton), or counting alone (coulomb).",
        ),
    ] = "ekf",
    initial_soc: Annotated[
        str | None,
        typer.Option(
            metavar="P|auto",
            help="SoC at the first sample [%], e.g. 80; `auto` takes it from the first voltages."
            " Default: the first soc_pct of a log, counted back to its first row; else, and for a"
            " capture (as live), auto.",
        ),
    ] = None,
    initial_soc_std: Annotated[
        float, typer.Option(metavar="X", help="Standard deviation of the initial SoC [%].")
    ] = 1.0,
    valid_std: Annotated[
        float,
        typer.Option(metavar="X", help="Largest standard deviation of a valid SoC [%]."),
    ] = VALID_STD_PCT,
    capacity_ah: Annotated[
        float | None,
        typer.Option(metavar="A", help="Charge from 100 to 0 % [Ah]. Default: the model's."),
    ] = None,
    max_gap_s: Annotated[
        float | None,
        typer.Option(
            metavar="S",
            help="A longer step between samples is a gap [s]. Default: 2 s, or for a slower log 3"
            " of its usual steps.",
        ),
    ] = None,
    *,
    reading: ReadingOptions,
    pack: Annotated[
        Path | None,
        typer.Option(
            metavar="PACK",
            callback=suffixed(".csv", ".parquet"),
            help="Table of health, power and cells, once a second, .csv or .parquet.",
        ),
    ] = None,
    report: ReportOption = None,
    json_output: JsonOption = False,
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
    """
    from cangauge.bus.captures import Capture
    from cangauge.estimation.settings import EstimatorSettings
    from cangauge.logs.read import read_cells
    from cangauge.model.delay_line import GAP_S
    from cangauge.model.model_file import Model
    from cangauge.service.offline import (
        PackHistory,
        estimate_capture,
        estimate_recorded_log,
    )

    settings = EstimatorSettings(
        method=_method(method),
        initial_soc_pct=_initial_soc(initial_soc),
        initial_soc_std_pct=within(
            initial_soc_std, 0.0, 100.0, option="--initial-soc-std", unit="%"
        ),
        valid_std_pct=within(valid_std, 0.01, 100.0, option="--valid-std", unit="%"),
        capacity_ah=within(capacity_ah, 1e-3, 1e5, option="--capacity-ah", unit="Ah"),
        gap_s=within(max_gap_s, 1e-3, 3600.0, option="--max-gap-s", unit="s") or GAP_S,
    )
    check_outputs([output, pack, report], [log_path, model_path])
    model = Model.load(model_path)
    assumed: dict[str, list[str]] = {}
    if isinstance(reading.open(log_path), Capture):
        if not reading.names_vehicle:
            raise unnamed_capture(log_path)
        car = reading.car()
        source = known_temperature_source(reading.temperature_source) or "unknown"
        settings = replace(settings, temperature_source=source)
        with _progress(None) as progress:
            done = estimate_capture(
                log_path, car, model, settings, keeps_pack=pack is not None, progress=progress
            )
        _check_capture(done, model)
    else:
        log = reading.load(log_path)
        assumed = assumed_of([log])
        if settings.initial_soc_pct is not None:
            note_starts([log], settings.initial_soc_pct, capacity_ah or model.capacity_ah)
        cells = read_cells(log_path, log.time_s, reading.given_columns())
        with _progress(len(log)) as progress:
            done = estimate_recorded_log(
                log,
                model,
                settings,
                soc_from_log=initial_soc is None,
                gap_from_log=max_gap_s is None,
                pack=PackHistory(
                    keeps_rows=pack is not None, cells=cells, duration_s=log.duration_s
                ),
                progress=progress,
            )
        if max_gap_s is None and done.settings.gap_s > GAP_S:
            note(
                f"note: {log.source}: its usual step is {rounded(done.settings.gap_s / 3.0, 2)} s;"
                f" steps over {rounded(done.settings.gap_s, 2)} s count as gaps (--max-gap-s)"
            )
    _write_pack(done, pack)
    _write_output(done, output, report, model_path)
    for warning in done.warnings:
        note(f"warning: {done.recorded.source}: {warning}")
    if json_output:
        written = {"output": str(output), "pack": pack and str(pack), "assumed": assumed}
        emit_json(done.to_dict() | written | {"report": report and str(report)})
        return
    _show(done)
    note(
        f"estimates: {output}"
        + (f"\nhealth, power and cells: {pack}" if pack else "")
        + (f"\nreport: {report}" if report else "")
    )


def _is_mcap(output: Path) -> bool:
    return output.suffix.lower() == ".mcap"


def _write_output(
    done: RecordedEstimate, output: Path, report: Path | None, model_path: Path
) -> None:
    """Write table and report, or neither."""
    from cangauge.service.estimate_table import write_estimates

    page = None
    if report is not None:
        page = extra("report.estimate:estimate_report")(done, model_path)
    with ExitStack() as both:
        part = both.enter_context(atomic_path(output))
        if _is_mcap(output):
            extra("formats.estimate_mcap:write_estimates_mcap")(part, done.recorded, done.table)
        else:
            write_estimates(part, done.recorded.time_s, done.table)
        if report is not None and page is not None:
            both.enter_context(atomic_path(report)).write_text(page, encoding="utf-8")


def _write_pack(done: RecordedEstimate, pack: Path | None) -> None:
    from cangauge.logs.canonical import write_table

    if pack is not None:
        write_table(done.pack.columns, pack)


def _method(given: str) -> Method:
    from cangauge.estimation.settings import Method

    for method in get_args(Method):
        if given == method:
            return method  # type: ignore[no-any-return]
    raise InputError(
        "not a known method", field="--method", value=given, cure="use ekf, newton or coulomb"
    )


def _initial_soc(given: str | None) -> float | None:
    if given is None or given == AUTO:
        return None
    try:
        return within(float(given), 0.0, 100.0, option="--initial-soc", unit="%")
    except ValueError as error:
        raise InputError(
            "neither a number nor auto", field="--initial-soc", value=given, cure="give it as 80"
        ) from error


@contextmanager
def _progress(total: int | None) -> Iterator[Callable[[int], None]]:
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("estimating", total=total)
        yield lambda done: progress.update(task, completed=done)


def _check_capture(done: RecordedEstimate, model: Model) -> None:
    """Refuse a capture of one sample, of another pack, or with inverted current."""
    from cangauge.bus.recording import refuse_single_row
    from cangauge.service.offline import RecordedCapture, require_same_pack

    recorded = done.recorded
    refuse_single_row(recorded)
    for remark in recorded.remarks:
        note(f"{recorded.source}: {remark}")
    require_same_pack(recorded, model)
    if isinstance(recorded, RecordedCapture) and (log := recorded.as_log()) is not None:
        refuse_inverted_current(log, is_capture=True)


def _show(done: RecordedEstimate) -> None:
    scores, table, settings = done.scores, done.table, done.settings
    cover = None if scores.cover_2sigma is None else 100.0 * scores.cover_2sigma
    origin = {"given": "given", "log": "from the log's soc_pct", "voltage": "found by the voltage"}
    start = number(settings.initial_soc_pct, 1)
    known = [row for row in range(len(table.soc_pct)) if table.soc_pct[row] == table.soc_pct[row]]
    if done.origin == "voltage" and known:
        start = uncertain(float(table.soc_pct[known[0]]), float(table.soc_std_pct[known[0]]))
    rows = [
        ["initial SoC", start, f"% ({origin[done.origin]})"],
        ["SoC at the end", number(table.soc_pct[-1], 1), "%"],
        ["  its standard deviation", number(table.soc_std_pct[-1], 1), "%"],
        ["SoC error, MAE", number(scores.soc_mae_pct, 2), "%"],
        ["SoC error, largest", number(scores.soc_max_pct, 2), "%"],
        ["  by Newton alone, MAE", number(scores.soc_newton_mae_pct, 2), "%"],
        ["  by counting alone, MAE", number(scores.soc_coulomb_mae_pct, 2), "%"],
        ["reference within ±2σ", number(cover, 1), "% of samples"],
        ["voltage error, MAE", number(scores.voltage_mae_pct, 2), "%"],
        ["valid", number(100.0 * scores.valid_fraction, 1), "% of samples"],
        ["samples", str(scores.rows), ""],
    ]
    # Without a reference there are no errors of the SoC.
    rows = [row for row in rows if row[1] != NONE_KNOWN]
    print_table(f"State of charge of {done.recorded.name}", ["", "value", "<unit"], rows)
    if done.pack.report is not None:
        limits = settings.limits.of_model(done.model.voltage_model())
        _show_pack(done.pack.report, limits)
    if shares := done.reason_shares:
        rows = [
            [REASON_WORDS[Reason[name.upper().replace(" ", "_")]], number(100.0 * share, 1)]
            for name, share in shares.items()
        ]
        print_table("Reasons for less than valid estimates", ["reason", "% of samples"], rows)


def _show_pack(report: PackReport, limits: KnownLimits) -> None:
    health, power, cells = report
    low_v, high_v = (significant(v, 3) for v in (limits.min_voltage_v, limits.max_voltage_v))
    rows = [
        ["capacity", uncertain(health.capacity_ah, health.capacity_std_ah), "Ah"],
        [
            "resistance, relative",
            uncertain(health.resistance_ratio, health.resistance_std),
            "× the model's",
        ],
        ["current offset", significant(health.offset_a, 2), "A"],
        ["possible discharge, 10 s", possible(power.discharge_a, power.discharge_std_a),
         f"A, down to {low_v} V"],
        ["possible charge, 10 s", possible(power.charge_a, power.charge_std_a),
         f"A, up to {high_v} V"],
        ["energy left", *uncertain_energy(power.energy_wh, power.energy_std_wh).rsplit(" ", 1)],
    ]  # fmt: skip
    if cells is not None:
        name = "weakest cell" if cells.weakest < 0 else f"weakest cell: number {cells.weakest}"
        rows += [
            [name, uncertain(cells.soc_pct, cells.soc_std_pct), "%"],
            ["  spread of the cells", number(cells.spread_pct, 1), "%"],
            ["pack less sum of cells", uncertain(cells.sum_error_v, cells.sum_std_v), "V"],
        ]
    print_table("The pack at the end", ["", "value", "<unit"], rows)

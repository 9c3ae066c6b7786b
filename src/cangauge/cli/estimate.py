"""`cangauge estimate`: a log or capture and a model → SoC at every sample, offline."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from cangauge.atomic import atomic_path
from cangauge.cli.estimate_file import check_suffix, write_estimates
from cangauge.cli.estimate_sources import Estimated, from_capture, from_log
from cangauge.cli.inputs import (
    DbcOption,
    JsonOption,
    MapOption,
    ReportOption,
    TemperatureOption,
    TemperatureSourceOption,
    VehicleOption,
    check_outputs,
    known_temperature_source,
    load_log,
    note_not_a_capture,
    within,
)
from cangauge.cli.output import emit_json, note
from cangauge.cli.tables import print_table
from cangauge.errors import InputError
from cangauge.estimate.offline import EstimateTable
from cangauge.estimate.settings import VALID_STD_PCT, EstimatorSettings, Method
from cangauge.estimate.types import Reason
from cangauge.logs.read import CaptureGivenError
from cangauge.model.delay_line import GAP_S
from cangauge.model.model_file import ModelFile, load_model
from cangauge.report.words import number, reason_name, reason_names

AUTO = "auto"
DOUBTFUL_VALID, DOUBTFUL_COVER = 0.1, 0.5
"""Below these fractions (of valid samples, of the reference within 2σ) the user is warned."""


def estimate_command(  # noqa: PLR0917 - typer passes options by name
    log_path: Annotated[Path, typer.Argument(metavar="LOG", help="Recorded log or capture.")],
    model_path: Annotated[
        Path, typer.Option("-m", "--model", metavar="MODEL", help="Model file of `cangauge fit`.")
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", metavar="OUT", help="File of estimates: .csv or .parquet by suffix."
        ),
    ],
    method: Annotated[
        str,
        typer.Option(
            metavar="ekf|newton|coulomb",
            help="Whose SoC goes into soc_pct: fusion, the voltage model's inverse alone, or"
            " counting alone.",
        ),
    ] = "ekf",
    initial_soc: Annotated[
        str | None,
        typer.Option(
            metavar="P|auto",
            help="SoC at the first sample [%], or `auto`: from the first voltages. Default: the"
            " first soc_pct of a log, counted back to its first row; without one, and for a"
            " capture (as live), auto.",
        ),
    ] = None,
    initial_soc_std: Annotated[
        float, typer.Option(metavar="X", help="Standard deviation of the initial SoC [%].")
    ] = 1.0,
    valid_std: Annotated[
        float,
        typer.Option(metavar="X", help="A SoC with a larger standard deviation is degraded [%]."),
    ] = VALID_STD_PCT,
    capacity_ah: Annotated[
        float | None,
        typer.Option(metavar="A", help="Charge from 100 to 0 % [Ah]. Default: the model's."),
    ] = None,
    max_gap_s: Annotated[
        float | None,
        typer.Option(
            metavar="S",
            help="A longer step between samples is a gap [s]. Default: 2 s, or 3 usual steps of a"
            " log that is slower.",
        ),
    ] = None,
    vehicle: VehicleOption = None,
    dbc: DbcOption = None,
    map_file: MapOption = None,
    temperature: TemperatureOption = None,
    temperature_source: TemperatureSourceOption = None,
    report: ReportOption = None,
    json_output: JsonOption = False,
) -> None:
    """Estimate the state of charge of a recorded log or capture, offline.

    OUT has one row for each sample: time_s [s], soc_pct, soc_std_pct, soc_newton_pct,
    soc_coulomb_pct [%], voltage_model_v, residual_v (measured − model) [V], status (initialising,
    valid, degraded, invalid) and reasons (words, parted by "; "). A value that is not known is
    empty (CSV) or null (Parquet). Positive current discharges.

    For example:

    `cangauge estimate trip.parquet -m pack.json -o soc.csv --report soc.html`

    `cangauge estimate trip.csv -m pack.json -o soc.parquet --initial-soc auto`

    `cangauge estimate drive.log --vehicle leaf_ze0 -m leaf.json -o soc.csv --method newton`
    """
    check_suffix(output)
    chosen = _method(method)
    start = _start(initial_soc)
    within(initial_soc_std, 0.0, 100.0, option="--initial-soc-std", unit="%")
    within(valid_std, 0.01, 100.0, option="--valid-std", unit="%")
    if capacity_ah is not None:
        within(capacity_ah, 1e-3, 1e5, option="--capacity-ah", unit="Ah")
    if max_gap_s is not None:
        within(max_gap_s, 1e-3, 3600.0, option="--max-gap-s", unit="s")
    check_outputs([output, report], [log_path, model_path])
    model = load_model(model_path)
    settings = EstimatorSettings(
        method=chosen,
        initial_soc_pct=start,
        initial_soc_std_pct=initial_soc_std,
        valid_std_pct=valid_std,
        capacity_ah=capacity_ah,
        gap_s=GAP_S if max_gap_s is None else max_gap_s,
    )
    described = vehicle is not None or dbc is not None or map_file is not None
    try:
        log = load_log(
            log_path,
            temperature_c=temperature,
            temperature_source=temperature_source,
            refuse_turned=True,
        )
    except CaptureGivenError:
        if not described:
            raise
        # cantools is slow to import, and logs do without.
        from cangauge.bus.vehicle import load_vehicle  # noqa: PLC0415

        car = load_vehicle(vehicle, dbc, map_file, temperature_c=temperature)
        source = known_temperature_source(temperature_source) or "unknown"
        done = from_capture(log_path, car, model, replace(settings, temperature_source=source))
    else:
        if described:
            note_not_a_capture(log_path)
        done = from_log(log, model, settings, given=initial_soc, gap_given=max_gap_s is not None)
    page = None
    if report is not None:
        # bokeh takes half a second to import.
        from cangauge.report.estimate_report import estimate_report  # noqa: PLC0415

        page = estimate_report(done.recorded, done.table, done.scores, model, done.settings)
    with ExitStack() as both:  # estimates and report, or neither
        part = both.enter_context(atomic_path(output))
        write_estimates(part, done.recorded.time_s, done.table)
        if page is not None and report is not None:
            both.enter_context(atomic_path(report)).write_text(page, encoding="utf-8")
    _warn(done, model)
    if json_output:
        emit_json(_as_json(done, model) | {"output": str(output), "report": report and str(report)})
        return
    _show(done)
    note(f"estimates: {output}" + (f"\nreport: {report}" if report else ""))


def _warn(done: Estimated, model: ModelFile) -> None:
    """Say on stderr what makes the estimate doubtful as a whole."""
    scores, name = done.scores, done.recorded.source or done.recorded.name
    if scores.valid_fraction < DOUBTFUL_VALID:
        words = reason_names(int(np.bitwise_or.reduce(done.table.reasons)))
        note(
            f"warning: {name}: only {100.0 * scores.valid_fraction:.0f} % of the samples have a"
            f" valid estimate ({words}); is {model.name} the model of this pack, at these"
            " temperatures?"
        )
    if scores.cover_2sigma is not None and scores.cover_2sigma < DOUBTFUL_COVER:
        note(
            f"warning: {name}: the reference SoC lies within 2σ in only"
            f" {100.0 * scores.cover_2sigma:.0f} % of the samples; is {model.name} the model of"
            " this pack, and is its capacity right?"
        )


def _method(given: str) -> Method:
    for method in ("ekf", "newton", "coulomb"):
        if given == method:
            return method
    raise InputError(
        "not a known method", field="--method", value=given, cure="use ekf, newton or coulomb"
    )


def _start(given: str | None) -> float | None:
    if given is None or given == AUTO:
        return None
    try:
        return within(float(given), 0.0, 100.0, option="--initial-soc", unit="%")
    except ValueError as error:
        raise InputError(
            "neither a number nor auto", field="--initial-soc", value=given, cure="give it as 80"
        ) from error


def _as_json(done: Estimated, model: ModelFile) -> dict[str, Any]:
    settings = done.settings
    return {
        **vars(done.scores),
        "method": settings.method,
        "initial_soc_pct": settings.initial_soc_pct,
        "initial_soc_from": done.origin,
        "capacity_ah": settings.capacity_ah or model.capacity_ah,
        "max_gap_s": settings.gap_s,
        "reasons": _reason_shares(done.table),
        **done.facts,
    }


def _reason_shares(table: EstimateTable) -> dict[str, float]:
    """Return the share of samples with each reason that was ever set."""
    shares = {reason: float(np.mean((table.reasons & reason) != 0)) for reason in Reason}
    return {reason_name(reason): share for reason, share in shares.items() if share > 0.0}


def _show(done: Estimated) -> None:
    scores, table, settings = done.scores, done.table, done.settings
    cover = None if scores.cover_2sigma is None else 100.0 * scores.cover_2sigma
    words = {"given": "as given", "log": "of the log's soc_pct", "voltage": "by the voltage"}
    print_table(
        f"State of charge of {done.recorded.name}",
        ["", "value", "<unit"],
        [
            ["samples", str(scores.rows), ""],
            ["computed in", number(scores.seconds, 2), "s"],
            ["initial SoC", number(settings.initial_soc_pct, 2), f"% ({words[done.origin]})"],
            ["SoC at the end", number(table.soc_pct[-1], 2), "%"],
            ["  its standard deviation", number(table.soc_std_pct[-1], 2), "%"],
            ["SoC error, MAE", number(scores.soc_mae_pct, 2), "%"],
            ["SoC error, largest", number(scores.soc_max_pct, 2), "%"],
            ["  by Newton alone, MAE", number(scores.soc_newton_mae_pct, 2), "%"],
            ["  by counting alone, MAE", number(scores.soc_coulomb_mae_pct, 2), "%"],
            ["reference within ±2σ", number(cover, 1), "% of samples"],
            ["voltage error, MAE", number(scores.voltage_mae_pct, 3), "%"],
            ["valid", number(100.0 * scores.valid_fraction, 1), "% of samples"],
        ],
    )
    shares = _reason_shares(table)
    if shares:
        rows = [[name, number(100.0 * share, 2)] for name, share in shares.items()]
        print_table("Not plainly valid because", ["reason", "% of samples"], rows)

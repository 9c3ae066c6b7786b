"""`cangauge fleet`: fit, estimate, gap and health over the logs of a fleet, on Dask."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, cast

import typer

from cangauge._formatting import number, significant
from cangauge._io import file_sha256, write_texts_atomic
from cangauge.cli.fit import parse_delays
from cangauge.cli.options import (
    JsonOption,
    Reading,
    ReportOption,
    check_outputs,
    known_temperature_source,
    option_groups,
    suffixed,
    within,
)
from cangauge.cli.output import console, emit_json, note, print_table, progress_shown
from cangauge.cli.shown import ALARM_BELOW, FLEET_LOGS, FLEET_REFERENCES, LOCAL, VEHICLE_PATTERN
from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge.fleet.jobs import Job
    from cangauge.fleet.overview import FleetOverview
    from cangauge.fleet.run import Summary
    from cangauge.fleet.sources import FleetLog, ReadOptions
    from cangauge.logs.draft import Sign

fleet_app: Final = typer.Typer(
    name="fleet", rich_markup_mode="markdown", add_completion=False, no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)  # fmt: skip

LogsArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="LOGS",
        help="Logs or captures: paths or URLs with * and **, or a manifest (CSV with the columns"
        " log, vehicle, start, initial_soc_pct, healthy).",
    ),
]
ModelOption = Annotated[
    Path, typer.Option("-m", "--model", metavar="MODEL", help="Model file of the vehicles' type.")
]
OutOption = Annotated[
    str,
    typer.Option(
        "-o", "--output", metavar="OUT",
        help="Folder or URL of the results: Parquet, one row a log, by vehicle. Logs that it holds"
        " with the same model and options are skipped.",
    ),
]  # fmt: skip
CapacityOption = Annotated[
    float | None,
    typer.Option("--capacity-ah", metavar="A", help="Charge from 100 to 0 % [Ah]."),
]


@dataclass(frozen=True, slots=True)
class Cluster:
    """The options of every fleet command: what computes, and how logs name their vehicles."""

    scheduler: Annotated[
        str,
        typer.Option(
            metavar="ADDRESS|local",
            help="Dask scheduler (tcp://10.0.0.5:8786), or this machine.",
        ),
    ] = LOCAL
    workers: Annotated[
        int | None,
        typer.Option(metavar="N", help="Worker processes of `local`. Default: one a core."),
    ] = None
    pattern: Annotated[
        str,
        typer.Option(
            "--vehicle-pattern", metavar="REGEX",
            help="The first group finds the vehicle in the name of a log. Default: its folder.",
        ),
    ] = VEHICLE_PATTERN  # fmt: skip

    def find(self, logs: Sequence[str]) -> list[FleetLog]:
        """Return the logs that paths, globs and manifests name (`find_logs`)."""
        from cangauge.fleet.sources import find_logs

        return find_logs(logs, pattern=self.pattern)

    def run(self, work: Callable[[Any], Any]) -> Any:
        """Return what a function of the Dask client returns; show its progress."""
        from cangauge.fleet.run import connected

        workers = None if self.workers is None else float(self.workers)
        within(workers, 1, 1024, option="--workers", unit="")
        shown: AbstractContextManager[Any] = nullcontext()
        if console.is_terminal:
            shown = console.status("starting")
        with shown as status:
            step = None if status is None else status.update
            connection = connected(self.scheduler, self.workers)
            with progress_shown("cangauge.fleet", step), connection as client:
                return work(client)


@fleet_app.callback()
def fleet_command() -> None:
    """Fit, estimate, diagnose and watch the health of a fleet's logs, on Dask.

    Each log is a task of a Dask scheduler. Results are Parquet files by vehicle: a run that is
    repeated or killed continues where it was, and logs that cannot be read are set aside with the
    reason. Needs the extra `fleet`.
    """


@fleet_app.command("fit")
@option_groups()
def fit_fleet_command(
    logs: LogsArgument,
    output: Annotated[
        Path,
        typer.Option(
            "-m",
            "--model",
            metavar="MODEL.json",
            callback=suffixed(".json"),
            help="Model file to write.",
        ),
    ],
    out: OutOption,
    capacity_ah: Annotated[
        float, typer.Option(metavar="A", help="Charge from 100 to 0 % [Ah], e.g. 51.5.")
    ],
    *,
    cluster: Cluster,
    rate_hz: Annotated[
        float, typer.Option(metavar="HZ", help="Rate of the fit [Hz]; faster logs are decimated.")
    ] = 1.0,
    delays: Annotated[
        str, typer.Option(metavar="S,S,…", help="Delays of the current [s].")
    ] = "0,10,30,70",
    epsilon: Annotated[float, typer.Option(metavar="E", help="Margin ε of the scaled SoC.")] = 0.05,
    t_ref: Annotated[float, typer.Option(metavar="C", help="Reference temperature [°C].")] = 20.0,
    name: Annotated[str | None, typer.Option(help="Name of the model.")] = None,
    reading: Reading,
    json_output: JsonOption = False,
) -> None:
    """Identify one model from all logs: the fit of `cangauge fit`, out of core.

    Each log is reduced to its information matrix, and these add up. Every log needs its SoC, or
    initial_soc_pct in the manifest.

    Examples
    --------
    `cangauge fleet fit 'logs/*/*.parquet' -m type.json -o results --capacity-ah 51.5`
    """
    from cangauge.fleet.fit import fit_fleet
    from cangauge.inference.rows import FitOptions

    within(capacity_ah, 1e-3, 1e5, option="--capacity-ah", unit="Ah")
    within(rate_hz, 0.01, 1000.0, option="--rate-hz", unit="Hz")
    within(epsilon, 1e-4, 0.49, option="--epsilon", unit="")
    within(t_ref, -60.0, 120.0, option="--t-ref", unit="°C")
    options = FitOptions(capacity_ah, None, rate_hz, parse_delays(delays), epsilon, t_ref)
    check_outputs([output], [])
    how, found_logs = _read_options(reading), cluster.find(logs)
    result = cluster.run(lambda client: fit_fleet(found_logs, how, options, out, client, name=name))
    write_texts_atomic({output: result.model.to_json()})
    if json_output:
        emit_json(result.to_dict() | {"model": str(output), "output": out})
        return
    figures = result.to_dict()
    print_table(
        f"Model {result.model.name}",
        ["", "value", "<unit"],
        [
            ["voltage error, MAE", number(figures["voltage_mae_pct"], 3), "%"],
            ["voltage error, RMSE", significant(figures["voltage_rmse_v"], 3), "V"],
            ["voltage error held out, MAE", number(result.model.noise.voltage_mae_pct, 3), "%"],
            ["SoC from voltage, MAE", number(figures["soc_newton_mae_pct"], 2), "%"],
            ["slope resistance", significant(result.slope_ohm, 3), "Ω"],
            ["condition number", significant(result.solution.condition_number, 2), ""],
            ["rows used", str(figures["rows"]), ""],
        ],
    )
    for remark in result.remarks:
        note(f"note: {remark}")
    note(f"model: {output}")


@fleet_app.command("estimate")
@option_groups()
def estimate_fleet_command(
    logs: LogsArgument,
    model: ModelOption,
    out: OutOption,
    *,
    cluster: Cluster,
    capacity_ah: CapacityOption = None,
    reading: Reading,
    report: ReportOption = None,
    json_output: JsonOption = False,
) -> None:
    """Estimate the state of charge of every log, with its error where the log has SoC.

    Examples
    --------
    `cangauge fleet estimate 's3://drives/*/*.parquet' -m type.json -o s3://results/may
    --scheduler tcp://10.0.0.5:8786`
    """
    from cangauge.estimation.settings import EstimatorSettings
    from cangauge.fleet.jobs import EstimateJob
    from cangauge.model.model_file import Model

    settings = EstimatorSettings(capacity_ah=capacity_ah)
    job = EstimateJob(_read_options(reading), Model.load(model), settings)
    _run(job, cluster.find(logs), out, cluster, report, json_output=json_output)


@fleet_app.command("health")
@option_groups()
def health_fleet_command(
    logs: LogsArgument,
    model: ModelOption,
    out: OutOption,
    *,
    cluster: Cluster,
    capacity_ah: CapacityOption = None,
    reading: Reading,
    report: ReportOption = None,
    json_output: JsonOption = False,
) -> None:
    """Follow capacity and resistance of each vehicle over its logs, and find outliers.

    A vehicle's logs follow each other in order of their start (manifest), else of their names.

    Examples
    --------
    `cangauge fleet health manifest.csv -m type.json -o results --report fleet.html`
    """
    from cangauge.estimation.settings import EstimatorSettings
    from cangauge.fleet.health import HealthJob
    from cangauge.model.model_file import Model

    settings = EstimatorSettings(capacity_ah=capacity_ah)
    job = HealthJob(_read_options(reading), Model.load(model), settings)
    _run(job, cluster.find(logs), out, cluster, report, json_output=json_output)


@fleet_app.command("gap")
@option_groups()
def gap_fleet_command(  # noqa: PLR0917 - typer passes options by name
    logs: LogsArgument,
    model: ModelOption,
    out: OutOption,
    reference: Annotated[
        list[str] | None,
        typer.Option(
            metavar="LOGS",
            help="Logs without a fault, of any vehicles of the type; repeat the option. Or the"
            " column healthy of a manifest.",
        ),
    ] = None,
    references: Annotated[
        int, typer.Option(metavar="N", help="References of a diagnosis at most.")
    ] = FLEET_REFERENCES,
    latest: Annotated[
        int, typer.Option(metavar="N", help="Latest logs of a vehicle, diagnosed together.")
    ] = FLEET_LOGS,
    alarm: Annotated[
        float,
        typer.Option(
            metavar="P", help="Report a fault where the probability of none is at most this."
        ),
    ] = ALARM_BELOW,
    *,
    cluster: Cluster,
    reading: Reading,
    report: ReportOption = None,
    json_output: JsonOption = False,
) -> None:
    """Diagnose each vehicle against references of the whole fleet.

    Its own healthy logs come first, then one of each other vehicle in turn.

    Examples
    --------
    `cangauge fleet gap 'may/*/*.parquet' --reference 'april/*/*.parquet' -m type.json -o results
    --report fleet.html`
    """
    from cangauge.fleet.gap import GapJob, suspect_and_healthy
    from cangauge.model.model_file import Model

    within(float(references), 1, 1000, option="--references", unit="")
    within(float(latest), 1, 1000, option="--latest", unit="")
    within(alarm, 0.0, 1.0, option="--alarm", unit="")
    known = cluster.find(reference or [])
    healthy = {log.url for log in known}
    found = [log for log in cluster.find(logs) if log.url not in healthy]
    suspect, good = suspect_and_healthy(
        [*found, *(replace(log, healthy=True) for log in known)], latest
    )
    job = GapJob(_read_options(reading), Model.load(model), references, alarm)
    _run(job, job.vehicles(suspect, good), out, cluster, report, json_output=json_output)


def _read_options(reading: Reading) -> ReadOptions:
    """Return how logs are read; files of the vehicle are read here, not by the workers."""
    from cangauge.fleet.sources import ReadOptions

    if reading.sign not in {None, "charge", "discharge"}:
        raise InputError("neither charge nor discharge", field="--sign", value=reading.sign)
    mapped = reading.mapped_columns()
    is_map_of_columns = mapped is not None and reading.vehicle is None and reading.dbc is None
    car = reading.car() if reading.names_vehicle and not is_map_of_columns else None
    paths = (reading.dbc, reading.map_file)
    files = {str(path): file_sha256(path) for path in paths if path is not None}
    given = [
        reading.vehicle, files, reading.columns, reading.sign, reading.temperature,
        reading.temperature_source,
    ]  # fmt: skip
    return ReadOptions(
        vehicle=car,
        columns=reading.given_columns(),
        mapped=mapped,
        sign=cast("Sign | None", reading.sign),
        temperature_c=reading.temperature,
        temperature_source=known_temperature_source(reading.temperature_source),
        described=json.dumps(given),
    )


def _run(
    job: Job,
    logs: Sequence[FleetLog],
    out: str,
    cluster: Cluster,
    report: Path | None,
    *,
    json_output: bool,
) -> None:
    """Run a job over the logs, and print and write what it found of the fleet."""
    from cangauge.fleet.dataset import Dataset
    from cangauge.fleet.overview import FleetOverview
    from cangauge.fleet.run import run_job

    check_outputs([report], [])
    dataset = Dataset(out, job.kind, job.columns)
    summary = cluster.run(lambda client: run_job(job, logs, dataset, client))
    found = FleetOverview.read(out)
    if report is not None:
        from cangauge.report.fleet import fleet_report

        write_texts_atomic({report: fleet_report(found)})
    if json_output:
        emit_json(
            summary.to_dict() | found.to_dict() | {"output": out, "report": report and str(report)}
        )
    else:
        _show(summary, found)
    if not summary.done + summary.skipped:
        note(f"error: no result; the reasons are in {out}/{dataset.tables[1]}")
        raise typer.Exit(1)


def _show(summary: Summary, found: FleetOverview) -> None:
    typer.echo(f"{summary} ({summary.seconds:.0f} s, {summary.workers} workers)")
    for reason, count in sorted(summary.reasons.items(), key=lambda item: -item[1])[:10]:
        note(f"set aside: {count} × {reason}")
    if found.gaps:
        rows = [
            [name, row["verdict"], number(row["probability"], 2), number(row["probability_none"])]
            for name, row in ((name, found.gaps[name]) for name in found.alarms)
        ]
        print_table("Vehicles with a gap", ["vehicle", "<cause", "probability", "P(none)"], rows)
    if found.z:
        rows = [[vehicle, quantity, number(z, 1)] for vehicle, quantity, z in found.outlying]
        print_table("Outliers in health", ["vehicle", "<quantity", "robust z"], rows)

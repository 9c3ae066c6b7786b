"""`cangauge fleet`: fit, estimate, gap and health over the logs of a fleet, on Dask."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import typer

from cangauge._config import read_toml
from cangauge._files import file_sha256, write_texts_atomic
from cangauge._text import number, significant
from cangauge.cli.declare import command
from cangauge.cli.options import ReadingOptions, check_outputs
from cangauge.cli.output import finish, note, print_table, print_values, progress

if TYPE_CHECKING:
    from cangauge.extras.fleet.fit import FleetFit
    from cangauge.extras.fleet.jobs import Job, Task
    from cangauge.extras.fleet.overview import FleetOverview
    from cangauge.extras.fleet.run import Summary
    from cangauge.extras.fleet.sources import FleetLog, ReadOptions

_SHOWN_REASONS: Final = 10
"""Reasons that are printed, the most frequent first; a page has all."""
_SHOWN_LOGS: Final = 20
"""Logs, or vehicles, that are printed; a page has more."""

fleet_app: Final = typer.Typer(
    name="fleet", rich_markup_mode="markdown", add_completion=False, no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Cluster:
    """The options of every fleet command: where results go, what computes, how logs are named.

    Parameters
    ----------
    out : -o, --output OUT
        Folder or URL of the results: Parquet, one row a log, by vehicle. Logs that it holds with
        the same model and options are skipped.
    workers : N|ADDRESS
        Worker processes of this machine, or a Dask scheduler (tcp://10.0.0.5:8786). Default: one a
        core.
    """

    out: str
    workers: str | None = None

    def run(self, work: Callable[[Any], Any]) -> Any:
        """Return what a function of the Dask client returns; show its progress."""
        from cangauge.extras.fleet.run import connected

        with progress("cangauge.extras.fleet") as show:
            show("starting")
            with connected(self.workers) as client:
                return work(client)


@fleet_app.callback()
def fleet_command() -> None:
    """Fit, estimate, diagnose and watch the health of a fleet's logs, on Dask.

    Each log is a task of a Dask scheduler. Results are Parquet files by vehicle: a run that is
    repeated or killed continues where it was, and logs that cannot be read are set aside with the
    reason. LOGS are paths or URLs with * and **, or a manifest: CSV with the columns log, vehicle,
    start, initial_soc_pct, healthy. Needs the extra `fleet`.
    """


fleet_command.group = fleet_app  # type: ignore[attr-defined] # read by the app


@fleet_app.command("fit")
@command("columns", "sign", "temperature")
def fit_fleet_command(
    logs: list[str],
    *,
    model: Path,
    capacity_ah: float,
    cluster: Cluster,
    chemistry: Literal["oxide", "lfp"] = "oxide",
    cells: int | None = None,
    reading: ReadingOptions,
    report: Path | None = None,
    json_output: bool = False,
) -> None:
    """Identify one model from all logs: the fit of `cangauge fit`.

    Each log is reduced to its sums, and these add up. Every log needs its SoC, or
    initial_soc_pct in the manifest. Logs that do not fit the others are named.

    Examples
    --------
    `cangauge fleet fit 'logs/*/*.parquet' -m type.json -o results --capacity-ah 51.5`

    Parameters
    ----------
    logs : LOGS
        Logs, captures or a manifest.
    model : -m, --model MODEL.json
        Model file to write.
    capacity_ah : A (0.001 … 1e5 Ah)
        Charge from 100 to 0 %, e.g. 51.5.
    """
    from cangauge.extras.fleet.fit import SumsJob, fit_fleet
    from cangauge.extras.fleet.sources import find_logs

    job = SumsJob(_read_options(reading), capacity_ah, chemistry, cells)
    found = find_logs(logs)
    _check_outputs([model, report], found, *map(Path, logs))
    result = cluster.run(lambda client: fit_fleet(job, found, cluster.out, client))
    texts = {model: result.model.to_json()}
    if report is not None:
        from cangauge.extras.report.fleet import fleet_fit_page

        texts[report] = fleet_fit_page(result).html()
    write_texts_atomic(texts)
    figures = result.to_dict() | {"output": cluster.out}
    files = {"model": model, "report": report}
    finish(figures, partial(_show_fit, result), files, as_json=json_output)


def _show_fit(result: FleetFit) -> None:
    from cangauge.extras.fleet.results import by_kind, reason_of

    by_log = result.by_log
    values = {
        "voltage error, RMSE": significant(result.voltage_rmse_v, 3, "V"),
        "voltage error of left-out logs, RMSE": significant(
            result.model.noise.voltage_rmse_v, 3, "V"
        ),
        "rows used": str(result.rows),
        "logs that do not fit": by_log.count_text,
    }
    print_values(f"Model {result.model.name}", values)
    for what, unused in (("set aside", result.bad), ("left out", result.left_out)):
        _note_reasons(what, [(reason_of(row), count) for row, count in by_kind(unused)])
    head, rows = by_log.misfit_rows()
    if rows:
        print_table("Logs that do not fit the others", head, rows[:_SHOWN_LOGS])
    if rows or not by_log.is_known:
        note(by_log.rule_text)


@fleet_app.command("estimate")
@command("columns", "sign", "temperature")
def estimate_fleet_command(
    logs: list[str],
    *,
    model: Path,
    cluster: Cluster,
    reading: ReadingOptions,
    report: Path | None = None,
    json_output: bool = False,
) -> None:
    """Estimate the state of charge of every log, with its error where the log has SoC.

    Examples
    --------
    `cangauge fleet estimate 's3://drives/*/*.parquet' -m type.json -o s3://results/may
    --workers tcp://10.0.0.5:8786`

    Parameters
    ----------
    logs : LOGS
        Logs, captures or a manifest.
    """
    from cangauge.extras.fleet.jobs import EstimateJob, by_log
    from cangauge.extras.fleet.sources import find_logs

    among = find_logs(logs)
    _run(
        EstimateJob, by_log, among, logs, model=model, cluster=cluster, reading=reading,
        report=report, json_output=json_output,
    )  # fmt: skip


@fleet_app.command("health")
@command("columns", "sign", "temperature")
def health_fleet_command(
    logs: list[str],
    *,
    model: Path,
    cluster: Cluster,
    reading: ReadingOptions,
    report: Path | None = None,
    json_output: bool = False,
) -> None:
    """Follow capacity and resistance of each vehicle over its logs, and find outliers.

    A vehicle's logs follow each other in order of their start (manifest), else of their names.

    Examples
    --------
    `cangauge fleet health manifest.csv -m type.json -o results --report fleet.html`

    Parameters
    ----------
    logs : LOGS
        Logs, captures or a manifest.
    """
    from cangauge.extras.fleet.jobs import HealthJob, by_vehicle
    from cangauge.extras.fleet.sources import find_logs

    among = find_logs(logs)
    _run(
        HealthJob, by_vehicle, among, logs, model=model, cluster=cluster, reading=reading,
        report=report, json_output=json_output,
    )  # fmt: skip


@fleet_app.command("gap")
@command("columns", "sign", "temperature")
def gap_fleet_command(
    logs: list[str],
    *,
    model: Path,
    reference: list[str] | None = None,
    cluster: Cluster,
    reading: ReadingOptions,
    report: Path | None = None,
    json_output: bool = False,
) -> None:
    """Diagnose each vehicle against references of the whole fleet.

    Its own healthy logs come first, then one of each other vehicle in turn, 30 at most. Vehicles
    without healthy logs of their own share references; a worker learns from them once. Logs to
    diagnose are the latest three of a vehicle.

    Examples
    --------
    `cangauge fleet gap 'may/*/*.parquet' --reference 'april/*/*.parquet' -m type.json -o results
    --report fleet.html`

    Parameters
    ----------
    logs : LOGS
        Logs, captures or a manifest.
    reference : LOGS
        Logs without a fault, of any vehicles of the type; repeat the option. Or the column healthy
        of a manifest.
    """
    from cangauge.extras.fleet.gap import GapJob, gap_tasks
    from cangauge.extras.fleet.sources import find_logs

    references = reference or []
    healthy = {log.url: replace(log, healthy=True) for log in find_logs(references)}
    among = [healthy.pop(log.url, log) for log in find_logs(logs)] + [*healthy.values()]
    _run(
        GapJob, gap_tasks, among, [*logs, *references], model=model, cluster=cluster,
        reading=reading, report=report, json_output=json_output,
    )  # fmt: skip


def _read_options(reading: ReadingOptions) -> ReadOptions:
    """Return how logs are read; files of the vehicle are read here, not by the workers."""
    from cangauge.extras.fleet.sources import ReadOptions

    mapped, car = reading.mapped_columns(), None
    is_map_of_columns = mapped is not None and not (
        {"dbc", "like"} & read_toml(str(reading.map_file)).keys()
    )
    if reading.names_vehicle and (reading.vehicle or reading.dbc or not is_map_of_columns):
        car = reading.car()
    paths: list[str] = []
    if reading.map_file is not None:
        paths = [str(reading.map_file), *(car.dbc_files if car is not None else ())]
    files = {path: file_sha256(path) for path in paths}
    return ReadOptions(
        vehicle=car,
        columns=mapped,
        described=json.dumps([reading.vehicle, files]),
    )


def _run(
    kind: Callable[..., Job],
    tasks_of: Callable[[Sequence[FleetLog]], list[Task]],
    among: Sequence[FleetLog],
    inputs: Sequence[str],
    *,
    model: Path,
    cluster: Cluster,
    reading: ReadingOptions,
    report: Path | None,
    json_output: bool,
) -> None:
    """Run a job on logs, and print and write what its results say of them.

    `inputs` is what the user gave in place of the logs: it is not overwritten either.
    """
    from cangauge.extras.fleet.overview import FleetOverview
    from cangauge.extras.fleet.results import Results
    from cangauge.extras.fleet.run import run_job
    from cangauge.model.model_file import Model

    _check_outputs([report], among, model, *map(Path, inputs))
    job = kind(_read_options(reading), Model.load(model))
    tasks = tasks_of(among)
    results = Results(cluster.out, job.kind, job.columns)
    summary = cluster.run(lambda client: run_job(job, tasks, results, client))
    found = FleetOverview.read(cluster.out, among)
    if report is not None:
        from cangauge.extras.report.fleet import fleet_page

        write_texts_atomic({report: fleet_page(found).html()})
    result = vars(summary) | found.to_dict() | {"output": cluster.out}
    finish(result, partial(_show, summary, found), {"report": report}, as_json=json_output)
    if not summary.done + summary.skipped:
        note(f"error: no result; the reasons are in {cluster.out}/{job.kind}-bad")
        raise typer.Exit(1)


def _note_reasons(what: str, reasons: Iterable[tuple[str, int]]) -> None:
    ordered = sorted(reasons, key=lambda item: -item[1])
    for reason, count in ordered[:_SHOWN_REASONS]:
        note(f"{what}: {count} × {reason}")
    if len(ordered) > _SHOWN_REASONS:
        note(f"{what}: {sum(n for _, n in ordered[_SHOWN_REASONS:])} for other reasons")


def _check_outputs(outputs: Sequence[Path | None], logs: Sequence[FleetLog], *files: Path) -> None:
    """Refuse outputs that cannot be written, or would overwrite a log or another input."""
    names = {output.name for output in outputs if output is not None}
    read = [Path(log.url) for log in logs if log.url.rpartition("/")[2] in names]
    check_outputs(outputs, [*read, *files])


def _show(summary: Summary, found: FleetOverview) -> None:
    typer.echo(f"{summary} ({summary.seconds:.0f} s, {summary.workers} workers)")
    _note_reasons("set aside", summary.reasons.items())
    if found.gaps:
        rows = []
        for name in found.by_gap[:_SHOWN_LOGS]:
            row = found.gaps[name]
            shown = number(row["probability"], 2), number(row["probability_none"], 2)
            rows.append([name, row["verdict"], *shown, "gap" if row["detected"] else ""])
        head = ["vehicle", "cause", "probability", "P(no fault)", ""]
        print_table(f"{len(found.alarms)} of {len(found.gaps)} vehicles have a gap", head, rows)
    if found.outlying:
        rows = [[vehicle, quantity, number(z, 1)] for vehicle, quantity, z in found.outlying]
        print_table("Outliers in health", ["vehicle", "quantity", "robust z"], rows)
    elif found.health:
        typer.echo(found.no_outlier_text)

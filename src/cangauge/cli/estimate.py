"""The file of estimates: one row a sample, as CSV or Parquet.

What `cangauge estimate` estimates: a log, or a capture by the live service's own path.

`cangauge estimate`: a log or capture and a model → SoC at every sample, offline.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import typer
from numpy.typing import NDArray
from rich.progress import Progress

from cangauge._formatting import number
from cangauge._io import atomic_path
from cangauge._typing import FloatArray
from cangauge.cli.options import (
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
    refuse_single_row,
    refuse_turned_current,
    within,
)
from cangauge.cli.output import console, emit_json, note, print_table
from cangauge.errors import InputError
from cangauge.estimate.offline import EstimateTable, Scores, estimate_log, score
from cangauge.estimate.settings import VALID_STD_PCT, EstimatorSettings, Method
from cangauge.estimate.validity import Reason, Status, reason_name, reason_names
from cangauge.inference.rows import usual_gap_s
from cangauge.logs.log import Log
from cangauge.model.charge import counted_soc_pct
from cangauge.model.delay_line import GAP_S
from cangauge.model.model_file import Model
from cangauge.report.charts import Recorded, Recording
from cangauge.service.estimate_table import NUMBERS

# --- The file of estimates: one row a sample, as CSV or Parquet

SUFFIXES = (".csv", ".parquet")


def check_suffix(output: Path) -> None:
    """Raise InputError if the name says neither CSV nor Parquet."""
    if output.suffix.lower() not in SUFFIXES:
        raise InputError(
            "the suffix says neither CSV nor Parquet",
            source=output,
            field="--output",
            value=output.suffix,
            cure="name it .csv or .parquet",
        )


def write_estimates(path: Path, time_s: NDArray[np.float64], table: EstimateTable) -> None:
    """Write estimates; the suffix says how.

    Parameters
    ----------
    path : Path
        Ends in .csv or .parquet.
    time_s : array of shape (n,)
        The samples' own time [s]: a refused sample's estimate is the one before.
    table : EstimateTable
        n estimates; what is not known becomes empty (CSV) or null (Parquet).
    """
    columns: dict[str, Any] = {"time_s": pa.array(time_s)}
    columns |= {name: pa.array(getattr(table, name), from_pandas=True) for name in NUMBERS}
    columns["status"] = pa.array([Status(value).name.lower() for value in table.status.tolist()])
    words = {value: reason_names(value) for value in np.unique(table.reasons).tolist()}
    columns["reasons"] = pa.array([words[value] for value in table.reasons.tolist()])
    if path.suffix.lower() == ".parquet":
        pa.parquet.write_table(pa.table(columns), path)
        return
    with path.open("wb") as file:
        # The header by hand: pyarrow always puts quotes around names; no cell needs any.
        file.write((",".join(columns) + "\n").encode())
        plain = pa.csv.WriteOptions(include_header=False, quoting_style="none")
        pa.csv.write_csv(pa.table(columns), file, plain)


# --- What `cangauge estimate` estimates: a log, or a capture by the live service's own path

if TYPE_CHECKING:
    from cangauge.bus.vehicle import Vehicle

VOLTAGE_MARGIN = 0.2
"""A recording whose median voltage lies further outside the model's is another pack's."""

Origin = Literal["given", "log", "voltage"]
"""Where the initial SoC comes from."""


@dataclass(frozen=True, eq=False)
class Estimated:
    """An estimate with all that a table, a report and a JSON object need.

    Parameters
    ----------
    recorded : Recorded
        n samples.
    table : EstimateTable
        n estimates.
    scores : Scores
    settings : EstimatorSettings
    origin : {"given", "log", "voltage"}
        Where the initial SoC comes from.
    facts : dict
        What else belongs into the JSON object.
    """

    recorded: Recorded
    table: EstimateTable
    scores: Scores
    settings: EstimatorSettings
    origin: Origin
    facts: dict[str, Any]


def from_log(
    log: Log, model: Model, settings: EstimatorSettings, *, given: str | None, gap_given: bool
) -> Estimated:
    """Estimate a log.

    Parameters
    ----------
    log : Log
    model : Model
    settings : EstimatorSettings
        As the user gave them.
    given : str, optional
        The initial SoC as given, "auto" for the first voltages; by default the log's first
        reference SoC, counted back to its first row.
    gap_given : bool
        Whether the gap was given; by default it follows a slow log's steps.

    Raises
    ------
    InputError
        If the log is another pack's.
    """
    check_same_pack(log, model)
    origin: Origin = "voltage" if settings.initial_soc_pct is None else "given"
    settings = replace(settings, temperature_source=log.temperature_source)
    if given is None and log.first_soc() is not None:
        origin = "log"
        first = counted_soc_pct(log, settings.capacity_ah or model.capacity_ah, None)[0]
        settings = replace(settings, initial_soc_pct=float(np.clip(first, 0.0, 100.0)))
    if not gap_given:
        settings = replace(settings, gap_s=_gap_s(log))
    with _progress() as progress:
        task = progress.add_task("estimating", total=len(log))
        table, scores = estimate_log(
            log, model, settings, lambda done: progress.update(task, completed=done)
        )
    return Estimated(log, table, scores, settings, origin, {})


def from_capture(
    path: Path, vehicle: Vehicle, model: Model, settings: EstimatorSettings
) -> Estimated:
    """Estimate a capture, bit for bit as the service does.

    Like the service it begins from the first voltages unless an initial SoC is given, whatever
    the car itself says; the car's SoC is the reference to compare with.

    Raises
    ------
    InputError
        If the capture gives no sample, its current is turned, or it is another pack's.
    """
    # python-can and cantools are slow to import; logs do without.
    from cangauge.service.capture_estimate import estimate_capture  # noqa: PLC0415

    if settings.temperature_source == "unknown":
        settings = replace(settings, temperature_source=vehicle.temperature_source)
    with _progress() as progress:
        task = progress.add_task("estimating", total=None)
        found = estimate_capture(
            path,
            vehicle,
            model,
            settings,
            progress=lambda done: progress.update(task, completed=done),
        )
    recording = Recording(
        time_s=_running_on(found.time_s),
        current_a=found.current_a,
        voltage_v=found.voltage_v,
        temperature_c=found.temperature_c,
        soc_pct=found.soc_reference_pct if np.isfinite(found.soc_reference_pct).any() else None,
        name=path.name.split(".")[0],
        source=str(path),
        temperature_source=settings.temperature_source,
        remarks=found.remarks,
    )
    refuse_single_row(recording)
    for remark in recording.remarks:
        note(f"{path}: {remark}")
    check_same_pack(recording, model)
    _check_sign(recording)
    # All that is asked of the log here is what a recording has.
    scores = score(found.table, cast("Log", recording), found.seconds)
    facts = {"time_source": found.time_source, "frames": asdict(found.counts)}
    origin: Origin = "voltage" if settings.initial_soc_pct is None else "given"
    return Estimated(recording, found.table, scores, settings, origin, facts)


def check_same_pack(recorded: Recorded, model: Model) -> None:
    """Refuse a recording whose voltage shows that the model belongs to another pack.

    Raises
    ------
    InputError
        If the median voltage lies more than `VOLTAGE_MARGIN` outside the model's pseudo-OCV.
    """
    known = recorded.voltage_v[np.isfinite(recorded.voltage_v)]
    if not known.size:
        return
    low, high = model.voltage_model().pseudo_ocv([0.0, 100.0])
    median = float(np.median(known))
    if not (1.0 - VOLTAGE_MARGIN) * low <= median <= (1.0 + VOLTAGE_MARGIN) * high:
        raise InputError(
            f"the median is {median:.1f} V, but the model {model.name} is of a pack of"
            f" {low:.0f} … {high:.0f} V",
            source=recorded.source or recorded.name,
            field="voltage_v",
            cure="give the model of this pack with -m, or check the unit of the voltage",
        )


def _check_sign(recording: Recording) -> None:
    """Refuse a turned current; a log of the rows that have everything tells it."""
    whole = np.isfinite(recording.voltage_v)
    whole[1:] &= np.diff(recording.time_s) > 0.0
    if whole.sum() < 2:
        return
    soc_pct = recording.soc_pct
    refuse_turned_current(
        Log(
            time_s=recording.time_s[whole],
            current_a=recording.current_a[whole],
            voltage_v=recording.voltage_v[whole],
            temperature_c=np.zeros(int(whole.sum())),
            soc_pct=None if soc_pct is None else soc_pct[whole],
            name=recording.name,
            source=recording.source,
        ),
        is_capture=True,
    )


def _running_on(time_s: FloatArray) -> FloatArray:
    """Return time that goes on where a second replay began anew in the same capture [s]."""
    step_s = np.diff(time_s)
    if not np.any(step_s < 0.0):
        return time_s
    return np.asarray(time_s[0] + np.concatenate(([0.0], np.cumsum(np.maximum(step_s, 0.0)))))


def _gap_s(log: Log) -> float:
    gap_s = min(usual_gap_s(log.time_s, GAP_S), 3600.0)
    if gap_s > GAP_S:
        note(
            f"note: {log.source or log.name}: its usual step is {gap_s / 3.0:g} s; steps over"
            f" {gap_s:g} s count as gaps (--max-gap-s)"
        )
    return gap_s


def _progress() -> Progress:
    return Progress(console=console, transient=True, disable=not console.is_terminal)


# --- `cangauge estimate`: a log or capture and a model → SoC at every sample, offline

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
    model = Model.load(model_path)
    settings = EstimatorSettings(
        method=chosen,
        initial_soc_pct=start,
        initial_soc_std_pct=initial_soc_std,
        valid_std_pct=valid_std,
        capacity_ah=capacity_ah,
        gap_s=GAP_S if max_gap_s is None else max_gap_s,
    )
    described = vehicle is not None or dbc is not None or map_file is not None
    # python-can and cantools are slow to import.
    from cangauge.bus.captures.capture import Capture  # noqa: PLC0415
    from cangauge.bus.recording import capture_without_vehicle, open_recording  # noqa: PLC0415
    from cangauge.bus.vehicle import Vehicle  # noqa: PLC0415

    if isinstance(open_recording(log_path), Capture):
        if not described:
            raise capture_without_vehicle(log_path)
        car = Vehicle.load(vehicle, dbc, map_file, temperature_c=temperature)
        source = known_temperature_source(temperature_source) or "unknown"
        done = from_capture(log_path, car, model, replace(settings, temperature_source=source))
    else:
        log = load_log(
            log_path,
            temperature_c=temperature,
            temperature_source=temperature_source,
            refuse_turned=True,
        )
        if described:
            note_not_a_capture(log_path)
        done = from_log(log, model, settings, given=initial_soc, gap_given=max_gap_s is not None)
    page = None
    if report is not None:
        # bokeh takes half a second to import.
        from cangauge.report.estimate import estimate_report  # noqa: PLC0415

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


def _warn(done: Estimated, model: Model) -> None:
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


def _as_json(done: Estimated, model: Model) -> dict[str, Any]:
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

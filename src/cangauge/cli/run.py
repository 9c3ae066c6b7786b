"""`cangauge run`: the service, frames in, SoC frames out."""

from __future__ import annotations

import gc
import logging
import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from cangauge.bus.lasting import LastingPort
from cangauge.bus.open import parse_bus_options
from cangauge.cli.bus_options import (
    BusDbcOption,
    BusMapOption,
    BusOptionOption,
    BusTemperatureOption,
    BusVehicleOption,
    ChannelOption,
    ClockIdOption,
    DetailIdOption,
    EstimateIdOption,
    InterfaceOption,
    frame_ids,
)
from cangauge.cli.inputs import JsonOption, TemperatureSourceOption, check_outputs
from cangauge.cli.ops_options import (
    HttpOption,
    HttpTokenFileOption,
    LogFormatOption,
    LogLevelOption,
    RecordKeepMbOption,
    RecordOption,
    RecordPartMbOption,
    RecordPartSOption,
    StatusSocketOption,
)
from cangauge.cli.output import console, emit_json
from cangauge.errors import CangaugeError
from cangauge.events import LogFormat, emit, logging_to, speaker
from cangauge.model.model_file import load_model
from cangauge.report.words import number, reason_names
from cangauge.service.config import RunConfig, load_config
from cangauge.service.display import LiveLine
from cangauge.service.gauge import Gauge
from cangauge.service.loop import LoopSettings, Outputs, RunSummary, serve
from cangauge.service.monitor import Monitor
from cangauge.service.operate import operated
from cangauge.service.record import Recorder
from cangauge.service.reload import Reloader
from cangauge.service.signals import note_hangups, stop_on_signals
from cangauge.service.state_keeper import StateKeeper
from cangauge.service.table import EstimateWriter

_LOG = logging.getLogger(__name__)


def run_command(  # noqa: PLR0917 - typer passes options by name
    config: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.toml",
            help="Options in a file: keys are their names with underscores; those given here go"
            " before it.",
        ),
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option("-m", "--model", metavar="MODEL", help="Model file of `cangauge fit`."),
    ] = None,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    bus_option: BusOptionOption = None,
    wait_for_bus: Annotated[
        bool | None,
        typer.Option(
            "--wait-for-bus/--need-bus",
            help="Start even if the bus is not there yet, or refuse to (default). A bus that goes"
            " later is waited for in any case.",
        ),
    ] = None,
    vehicle: BusVehicleOption = None,
    dbc: BusDbcOption = None,
    map_file: BusMapOption = None,
    temperature: BusTemperatureOption = None,
    temperature_source: TemperatureSourceOption = None,
    method: Annotated[
        str | None,
        typer.Option(
            metavar="ekf|newton|coulomb",
            help="Whose SoC is published: fusion (default), the voltage model's inverse alone, or"
            " counting alone.",
        ),
    ] = None,
    initial_soc: Annotated[
        str | None,
        typer.Option(
            metavar="P|auto", help="SoC at the first sample [%]; auto (default): by voltage."
        ),
    ] = None,
    initial_soc_std: Annotated[
        float | None,
        typer.Option(metavar="X", help="Its standard deviation [%]. Default: 1."),
    ] = None,
    valid_std: Annotated[
        float | None,
        typer.Option(
            metavar="X",
            help="A SoC with a larger standard deviation is degraded [%]. Default: 1.5.",
        ),
    ] = None,
    capacity_ah: Annotated[
        float | None, typer.Option(metavar="A", help="Capacity [Ah]. Default: the model's.")
    ] = None,
    max_gap_s: Annotated[
        float | None,
        typer.Option(metavar="S", help="A longer step between samples is a gap [s]. Default: 2."),
    ] = None,
    pair_within_s: Annotated[
        float | None,
        typer.Option(
            metavar="S",
            help="Current and voltage at most this far apart belong together [s]. Default: 0.02.",
        ),
    ] = None,
    time_source: Annotated[
        str | None,
        typer.Option(
            metavar="receive|replay-clock",
            help="Time is the frames' receive stamps (default), or the log time that `cangauge"
            " replay` tells at other speeds than 1.",
        ),
    ] = None,
    timeout_s: Annotated[
        float | None,
        typer.Option(metavar="S", help="Without a sample for so long: stale [s]. Default: 2."),
    ] = None,
    record: RecordOption = None,
    record_part_mb: RecordPartMbOption = None,
    record_part_s: RecordPartSOption = None,
    record_keep_mb: RecordKeepMbOption = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="FILE", help="Estimates as a table, .csv or .parquet."
        ),
    ] = None,
    duration_s: Annotated[
        float | None, typer.Option("--duration", metavar="S", help="End after this time [s].")
    ] = None,
    until_idle_s: Annotated[
        float | None,
        typer.Option(
            "--until-idle", metavar="S", help="End when samples came and then none for so long [s]."
        ),
    ] = None,
    state: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Keep SoC, its uncertainty and the delay line here over restarts: written every"
            " 10 s and at the end. A folder stands for a file in it. Default: systemd's"
            " StateDirectory, if there is one.",
        ),
    ] = None,
    state_max_age_s: Annotated[
        float | None,
        typer.Option(
            "--state-max-age", metavar="S", help="An older state is refused [s]. Default: 7 days."
        ),
    ] = None,
    state_every_s: Annotated[
        float | None,
        typer.Option("--state-every", metavar="S", help="Write it so often [s]. Default: 10."),
    ] = None,
    soc_estimate_id: EstimateIdOption = None,
    soc_detail_id: DetailIdOption = None,
    replay_clock_id: ClockIdOption = None,
    http: HttpOption = None,
    http_token_file: HttpTokenFileOption = None,
    status_socket: StatusSocketOption = None,
    log_format: LogFormatOption = None,
    log_level: LogLevelOption = None,
    json_output: JsonOption = False,
) -> None:
    """Estimate the state of charge from a bus, and publish it there.

    Publishes SOC_ESTIMATE (0x5A0) every 100 ms and SOC_DETAIL (0x5A1) every second, as
    `dbc/soc_estimate.dbc` says: SoC and its standard deviation [%], status, reasons. Ends at
    Ctrl-C or SIGTERM with a summary. Positive current discharges.

    SIGHUP reads configuration, model and car again: SoC goes on, and what is broken is refused.
    The bus, the time source and the files to write need a restart.

    For example:

    `cangauge run -m leaf.json --vehicle leaf_aze0 --interface socketcan --channel can0`

    `cangauge run -m leaf.json --time-source replay-clock`  (and, beside it,
    `cangauge replay trip.parquet --speed max`)

    `cangauge run --config car.toml --record drive.log -o soc.parquet`

    `cangauge run --config car.toml --state /var/lib/cangauge`
    """
    options: dict[str, Any] = {
        "model": _text(model),
        "interface": interface,
        "channel": channel,
        "bus_options": parse_bus_options(bus_option or []),
        "wait_for_bus": wait_for_bus,
        "vehicle": vehicle,
        "dbc": _text(dbc),
        "map": _text(map_file),
        "temperature": temperature,
        "temperature_source": temperature_source,
        "method": method,
        "initial_soc": initial_soc,
        "initial_soc_std": initial_soc_std,
        "valid_std": valid_std,
        "capacity_ah": capacity_ah,
        "max_gap_s": max_gap_s,
        "pair_within_s": pair_within_s,
        "time_source": time_source,
        "timeout_s": timeout_s,
        "ids": frame_ids(soc_estimate_id, soc_detail_id, replay_clock_id),
        "record": _text(record),
        "record_part_mb": record_part_mb,
        "record_part_s": record_part_s,
        "record_keep_mb": record_keep_mb,
        "output": _text(output),
        "duration_s": duration_s,
        "until_idle_s": until_idle_s,
        "state": _text(state),
        "state_max_age_s": state_max_age_s,
        "state_every_s": state_every_s,
        "http": http,
        "http_token_file": _text(http_token_file),
        "status_socket": status_socket,
        "log_format": log_format,
        "log_level": log_level,
    }

    def read() -> RunConfig:
        return load_config(config, options)

    loaded = read()
    with logging_to(loaded.log_format, loaded.log_level), _failures_logged(loaded.log_format):
        result = _run(loaded, read)
    if json_output:
        emit_json(result)


@contextmanager
def _failures_logged(log_format: LogFormat) -> Iterator[None]:
    """Tell of a failure as an event where stderr is JSON, so that every line of it is."""
    try:
        yield
    except CangaugeError as error:
        if log_format != "json":
            raise
        emit(_LOG, logging.ERROR, "service.failed", str(error), exit_code=error.exit_code)
        raise typer.Exit(error.exit_code) from error


def _run(config: RunConfig, read: Callable[[], RunConfig]) -> dict[str, Any]:
    check_outputs([None if config.output is None else Path(config.output)], [Path(config.model)])
    kept = config.state_settings(os.environ)
    vehicle = config.load_vehicle()
    gauge = Gauge(vehicle, load_model(config.model), config.gauge_settings())
    reloader = Reloader(read, config, vehicle, gauge, _voice("config.reload"))
    address = config.address()
    # All that is loaded by now stays until the end. Left out of garbage collection, it costs no
    # pauses meanwhile, and at the end not the second or so of taking it apart.
    gc.freeze()
    with ExitStack() as stack:
        # Signals first: whoever starts the service may end it at any moment after.
        stop = stack.enter_context(stop_on_signals())
        hangup = stack.enter_context(note_hangups())
        port = stack.enter_context(LastingPort(address, gauge.filters, _voice("bus.notice")))
        port.open(wait=config.wait_for_bus)
        recorder = table = line = keeper = None
        if kept is not None:
            keeper = stack.enter_context(StateKeeper(kept, gauge, _voice("state.notice")))
        if config.record is not None:
            recorder = stack.enter_context(Recorder(config.record, config.record_limits()))
        if config.output is not None:
            table = stack.enter_context(EstimateWriter(config.output, _voice("file.failed")))
        monitor = stack.enter_context(operated(config, vehicle.name, gauge, port, recorder))
        if console.is_terminal:
            line = stack.enter_context(LiveLine(console, gauge, lambda: port.trouble))
        outputs = Outputs(
            record=recorder,
            table=None if table is None else table.add,
            show=_each_turn(monitor, recorder, line),
            warn=_voice("service.warning"),
            checkpoint=None if keeper is None else keeper.checkpoint,
            reload=lambda: _reload(reloader, monitor, gauge) if hangup() else None,
            stepped=monitor.stepped,
            sent=monitor.sent,
        )
        summary = serve(port, gauge, config.loop_settings(), outputs, stop)
    emit(_LOG, logging.INFO, "service.stopped", _summary_line(gauge, port, summary))
    if not gauge.counts.frames:
        emit(
            _LOG,
            logging.WARNING,
            "bus.nothing_wanted",
            f"{port.name}: no wanted frame arrived; check channel, bit rate and the car"
            " (--vehicle, or --dbc and --map)",
        )
    # BLF and MF4 begin with the first frame, and without one there is no file.
    recorded = recorder.path if recorder and (recorder.frames or recorder.path.exists()) else None
    output = None if table is None or table.failed else config.output
    for path in (recorded, output):
        if path is not None:
            emit(_LOG, logging.INFO, "file.written", f"written: {path}", path=str(path))
    return _as_json(gauge, port, summary, config) | {"record": _text(recorded), "output": output}


def _voice(event: str) -> Callable[[str], None]:
    """Return what logs the lines of those who keep a measure of their own."""
    return speaker(_LOG, event, always=True)


def _reload(reloader: Reloader, monitor: Monitor, gauge: Gauge) -> LoopSettings | None:
    with monitor.reloading():
        settings = reloader.reload()
        monitor.identity = replace(
            monitor.identity,
            vehicle=gauge.vehicle.name,
            model=reloader.config.model,
            method=gauge.settings.estimator.method,
        )
    return settings


def _each_turn(
    monitor: Monitor, recorder: Recorder | None, line: LiveLine | None
) -> Callable[[float], None]:
    wanted = (monitor.turn, recorder and recorder.tick, line and line.show)
    calls = [each for each in wanted if each]

    def turn(now_s: float) -> None:
        for call in calls:
            call(now_s)

    return turn


def _summary_line(gauge: Gauge, port: LastingPort, summary: RunSummary) -> str:
    counts, latest = gauge.counts, gauge.latest
    soc = f"{number(latest.soc_pct, 2)} ± {number(latest.soc_std_pct, 2, '%')}"
    step = number(summary.step_p50_us, 0, "µs")
    return (
        f"{summary.seconds:.1f} s, {counts.frames} frames, {counts.samples} samples,"
        f" {counts.lost} lost, {counts.crc_errors} CRC errors{_troubles(port, summary)};"
        f" last SoC {soc} ({latest.status.name.lower()}); step {step} (median)"
    )


def _troubles(port: LastingPort, summary: RunSummary) -> str:
    """Return what went wrong on the bus, as a part of the summary."""
    kinds = ", ".join(f"{kind} {count}" for kind, count in port.error_kinds.most_common())
    found = {
        "dropped in the receive queue": port.queue_drops,
        f"error frames ({kinds})": port.error_frames,
        "not sent": port.unsent,
        "of another service with these ids": summary.rival_frames,
        f"times without the bus ({port.away_s:.1f} s)": port.losses,
    }
    return "".join(f", {count} {what}" for what, count in found.items() if count)


def _as_json(
    gauge: Gauge, port: LastingPort, summary: RunSummary, config: RunConfig
) -> dict[str, Any]:
    counts, latest = gauge.counts, gauge.latest
    return {
        "bus": port.name,
        "seconds": summary.seconds,
        "cpu_seconds": summary.cpu_seconds,
        "frames": counts.frames,
        "samples": counts.samples,
        "lost": counts.lost,
        "crc_errors": counts.crc_errors,
        "refused": {
            "crc_errors": counts.crc_errors,
            "repeated": counts.repeated,
            "short": counts.short,
            "not_available": counts.not_available,
            "implausible": counts.implausible,
            "stuck": counts.stuck,
            "held_back": counts.held_back,
        },
        "untimed": counts.untimed,
        "restarts": counts.beginnings,
        "garbled": port.garbled,
        "error_frames": port.error_frames,
        "error_kinds": dict(port.error_kinds),
        "queue_drops": port.queue_drops,
        "unsent": port.unsent,
        "bus_losses": port.losses,
        "bus_away_s": port.away_s,
        "rival_frames": summary.rival_frames,
        "stamps": port.facts.stamps,
        "step_p50_us": summary.step_p50_us,
        "estimate": {
            "time_s": latest.time_s,
            "soc_pct": latest.soc_pct,
            "soc_std_pct": latest.soc_std_pct,
            "soc_newton_pct": latest.soc_newton_pct,
            "soc_coulomb_pct": latest.soc_coulomb_pct,
            "residual_v": latest.residual_v,
            "status": latest.status.name.lower(),
            "reasons": reason_names(int(latest.reasons)),
        },
        "soc_reference_pct": gauge.reference_soc_pct,
        "state": config.state,
    }


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)

"""`cangauge run`: the service, frames in, SoC frames out."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from cangauge._logging import LogFormat, emit, logging_to
from cangauge.bus.open import parse_bus_options
from cangauge.cli.options import (
    BusDbcOption,
    BusMapOption,
    BusOptionOption,
    BusTemperatureOption,
    BusVehicleOption,
    ChannelOption,
    ClockIdOption,
    DetailIdOption,
    EstimateIdOption,
    HttpOption,
    HttpTokenFileOption,
    InterfaceOption,
    JsonOption,
    LogFormatOption,
    LogLevelOption,
    RecordKeepMbOption,
    RecordOption,
    RecordPartMbOption,
    RecordPartSOption,
    StatusSocketOption,
    TemperatureSourceOption,
    frame_ids,
)
from cangauge.cli.output import emit_json
from cangauge.errors import CangaugeError
from cangauge.service.config import RunConfig, load_config
from cangauge.service.run import run_service

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
        result = run_service(loaded, read)
    if json_output:
        emit_json(result)


@contextmanager
def _failures_logged(log_format: LogFormat) -> Iterator[None]:
    """Tell of a failure as an event where stderr is JSON, so that every line of it is."""
    try:
        yield
    except CangaugeError as error:
        if log_format == "json":
            emit(_LOG, logging.ERROR, "service.failed", str(error), exit_code=error.exit_code)
            error.logged = True
        raise


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)

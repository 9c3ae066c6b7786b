"""`cangauge run`: the service, frames in, SoC frames out."""

from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import typer

from cangauge.bus.open import open_bus, parse_bus_options
from cangauge.bus.receive import BusPort
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
from cangauge.cli.output import console, emit_json, note
from cangauge.model.model_file import load_model
from cangauge.report.words import number, reason_names
from cangauge.service.config import RunConfig, load_config
from cangauge.service.display import LiveLine
from cangauge.service.gauge import Gauge
from cangauge.service.loop import Outputs, RunSummary, serve
from cangauge.service.record import Recorder
from cangauge.service.signals import stop_on_signals
from cangauge.service.state_keeper import StateKeeper
from cangauge.service.table import EstimateWriter


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
    record: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Record the frames received (.log or .csv): `cangauge estimate` on them"
            " gives the live numbers, bit for bit.",
        ),
    ] = None,
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
            " 30 s and at the end. A folder stands for a file in it. Default: systemd's"
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
        typer.Option("--state-every", metavar="S", help="Write it so often [s]. Default: 30."),
    ] = None,
    soc_estimate_id: EstimateIdOption = None,
    soc_detail_id: DetailIdOption = None,
    replay_clock_id: ClockIdOption = None,
    json_output: JsonOption = False,
) -> None:
    """Estimate the state of charge from a bus, and publish it there.

    Publishes SOC_ESTIMATE (0x5A0) every 100 ms and SOC_DETAIL (0x5A1) every second, as
    `dbc/soc_estimate.dbc` says: SoC and its standard deviation [%], status, reasons. Ends at
    Ctrl-C or SIGTERM with a summary. Positive current discharges.

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
        "vehicle": vehicle,
        "dbc": _text(dbc),
        "map": _text(map_file),
        "temperature": temperature,
        "temperature_source": temperature_source,
        "method": method,
        "initial_soc": initial_soc,
        "initial_soc_std": initial_soc_std,
        "capacity_ah": capacity_ah,
        "max_gap_s": max_gap_s,
        "pair_within_s": pair_within_s,
        "time_source": time_source,
        "timeout_s": timeout_s,
        "ids": frame_ids(soc_estimate_id, soc_detail_id, replay_clock_id),
        "record": _text(record),
        "output": _text(output),
        "duration_s": duration_s,
        "until_idle_s": until_idle_s,
        "state": _text(state),
        "state_max_age_s": state_max_age_s,
        "state_every_s": state_every_s,
    }
    result = _run(load_config(config, options))
    if json_output:
        emit_json(result)


def _run(config: RunConfig) -> dict[str, Any]:
    written = [Path(name) for name in (config.record, config.output) if name is not None]
    check_outputs(written, [Path(config.model)])
    kept = config.state_settings(os.environ)
    gauge = Gauge(config.load_vehicle(), load_model(config.model), config.gauge_settings())
    address = config.address()
    with ExitStack() as stack:
        # Signals first: whoever starts the service may end it at any moment after.
        stop = stack.enter_context(stop_on_signals())
        port = stack.enter_context(BusPort(open_bus(address, gauge.filters), str(address)))
        recorder = table = line = keeper = None
        if kept is not None:
            keeper = stack.enter_context(StateKeeper(kept, gauge, note))
        if config.record is not None:
            recorder = stack.enter_context(Recorder(config.record))
        if config.output is not None:
            table = stack.enter_context(EstimateWriter(config.output))
        note(f"listening on {address}; time source: {config.time_source}; Ctrl-C ends")
        if console.is_terminal:
            line = stack.enter_context(LiveLine(console, gauge))
        outputs = Outputs(
            record=recorder,
            table=None if table is None else table.add,
            show=None if line is None else line.show,
            warn=note,
            checkpoint=None if keeper is None else keeper.checkpoint,
        )
        summary = serve(port, gauge, config.loop_settings(), outputs, stop)
    note(_summary_line(gauge, summary))
    if not gauge.counts.frames:
        note(
            f"warning: {port.name}: no wanted frame arrived; check channel, bit rate and the car"
            " (--vehicle, or --dbc and --map)"
        )
    for path in written:
        note(f"written: {path}")
    return _as_json(gauge, port, summary, config)


def _summary_line(gauge: Gauge, summary: RunSummary) -> str:
    counts, latest = gauge.counts, gauge.latest
    soc = f"{number(latest.soc_pct, 2)} ± {number(latest.soc_std_pct, 2, '%')}"
    step = number(summary.step_p50_us, 0, "µs")
    return (
        f"{summary.seconds:.1f} s, {counts.frames} frames, {counts.samples} samples,"
        f" {counts.lost} lost, {counts.crc_errors} CRC errors;"
        f" last SoC {soc} ({latest.status.name.lower()}); step {step} (median)"
    )


def _as_json(gauge: Gauge, port: BusPort, summary: RunSummary, config: RunConfig) -> dict[str, Any]:
    counts, latest = gauge.counts, gauge.latest
    return {
        "bus": port.name,
        "seconds": summary.seconds,
        "cpu_seconds": summary.cpu_seconds,
        "frames": counts.frames,
        "samples": counts.samples,
        "lost": counts.lost,
        "crc_errors": counts.crc_errors,
        "untimed": counts.untimed,
        "restarts": counts.beginnings,
        "garbled": port.garbled,
        "error_frames": port.error_frames,
        "unsent": port.unsent,
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
        "record": config.record,
        "output": config.output,
        "state": config.state,
    }


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)

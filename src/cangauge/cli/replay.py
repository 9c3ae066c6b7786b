"""`cangauge replay`: a log or a capture → frames on a bus."""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

import typer
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from cangauge._text import duration, number
from cangauge.cli.config_options import (
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
from cangauge.cli.options import (
    ColumnsOption,
    JsonOption,
    ReadingOptions,
    SignOption,
    assumed_of,
    note_reading,
)
from cangauge.cli.output import console, emit_json, note
from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge.bus.connection import BusConnection
    from cangauge.bus.publish import FrameIds
    from cangauge.replay.player import ReplayState
    from cangauge.replay.steps import Source


def replay_command(  # noqa: PLR0917 - typer passes options by name
    recorded: Annotated[
        Path, typer.Argument(metavar="LOG|CAPTURE", help="Recorded log, or recorded frames.")
    ],
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    bus_option: BusOptionOption = None,
    vehicle: BusVehicleOption = None,
    dbc: BusDbcOption = None,
    map_file: BusMapOption = None,
    temperature: BusTemperatureOption = None,
    columns: ColumnsOption = None,
    sign: SignOption = None,
    speed: Annotated[
        str,
        typer.Option(
            metavar="1|N|max",
            help="1: real time; N: N times faster; max: as fast as `cangauge run` acknowledges,"
            " without loss.",
        ),
    ] = "1",
    loop: Annotated[
        bool, typer.Option("--loop", help="Repeat until Ctrl-C, with increasing log time.")
    ] = False,
    wait_s: Annotated[
        float | None,
        typer.Option(
            "--wait",
            metavar="S",
            help="Longest wait for `cangauge run` before the first frame [s].",
        ),
    ] = None,
    soc_estimate_id: EstimateIdOption = None,
    soc_detail_id: DetailIdOption = None,
    replay_clock_id: ClockIdOption = None,
    json_output: JsonOption = False,
) -> None:
    """Play a recorded log or capture on a bus.

    A log is sent as the vehicle's frames of current [A], voltage [V], temperature [°C] and SoC [%],
    a capture as recorded. Recorded timing is kept. At every speed but 1 the log time is sent too
    (REPLAY_CLOCK, 0x5AF), so that `cangauge run --time-source replay-clock` counts the same charge
    at any speed.

    Examples
    --------
    `cangauge replay trip.parquet`

    `cangauge replay trip.parquet --speed max --vehicle leaf_aze0`

    `cangauge replay candump.log.gz --speed 10 --interface socketcan --channel vcan0 --loop`
    """
    from cangauge.bus.connection import BusConnection
    from cangauge.bus.open import bus_address, open_bus, parse_bus_options
    from cangauge.bus.publish import FrameIds, standard_filter
    from cangauge.replay.player import ReplaySettings, play
    from cangauge.service.lifecycle import stop_on_signals

    given = {"soc_estimate": soc_estimate_id, "soc_detail": soc_detail_id}
    ids = FrameIds(**frame_ids(**given, replay_clock=replay_clock_id))
    if wait_s is not None and not 0.0 < wait_s <= 1e6:
        raise InputError("must be more than 0 s", field="--wait", value=wait_s)
    settings = ReplaySettings(speed=_speed(speed), loop=loop, wait_s=wait_s, ids=ids)
    reading = ReadingOptions(vehicle, dbc, map_file, columns, sign, temperature)
    source = _source(recorded, reading, ids)
    address = bus_address(interface, channel, parse_bus_options(bus_option or []))
    with ExitStack() as stack:
        stop = stack.enter_context(stop_on_signals())
        filters = [standard_filter(ids.soc_estimate), standard_filter(ids.soc_detail)]
        bus = stack.enter_context(BusConnection(open_bus(address, filters), str(address)))
        note(f"playing {recorded} on {address}, speed {speed}")
        bar = stack.enter_context(_Bar(source, loop=loop)) if console.is_terminal else None
        state = play(bus, source, settings, stop=stop, show=None if bar is None else bar.show)
        stopped = stop()
    note(_summary_line(state))
    if bus.unsent:
        note(f"warning: {bus.unsent} frames were not sent: the transmit queue stayed full")
    if json_output:
        emit_json(_as_json(state, bus, source))
    if stopped and not loop:
        raise KeyboardInterrupt


def _source(recorded: Path, reading: ReadingOptions, ids: FrameIds) -> Source:
    from cangauge.bus.vehicle import Vehicle
    from cangauge.logs.read import LogFile
    from cangauge.replay.steps import CaptureSource, LogSource
    from cangauge.service.config import DEFAULT_VEHICLE

    car = reading.car() if reading.names_vehicle else None
    recording = reading.open(recorded)
    if not isinstance(recording, LogFile):
        return CaptureSource(recorded, car, ids)
    log = recording.read(temperature_c=reading.temperature)
    note_reading(log)
    return LogSource(log, car or Vehicle.load(DEFAULT_VEHICLE))


def _speed(text: str) -> float:
    try:
        speed = math.inf if text == "max" else float(text)
    except ValueError:
        speed = math.nan
    if text != "max" and not 1e-3 <= speed <= 1e6:
        cure = "give 1 (real time), another factor, or max"
        raise InputError("not a speed", field="--speed", value=text, cure=cure)
    return speed


class _Bar:
    """Progress on the terminal: log time, speed, SoC published by the receiver."""

    def __init__(self, source: Source, *, loop: bool) -> None:
        length_s = None if loop else source.duration_s
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[text]}"),
            TimeRemainingColumn(),
        )
        # No refresh thread: redrawn with each state.
        self._bar = Progress(*columns, console=console, transient=True, auto_refresh=False)
        self._task: TaskID = self._bar.add_task(source.name, total=length_s, text="")

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def show(self, state: ReplayState) -> None:
        text = f"{duration(state.log_seconds)}, {number(state.speed, 1)}×"
        if state.soc is not None:
            text += f", SoC {number(state.soc.soc_pct, 2, '%')}"
        self._bar.update(self._task, completed=state.log_seconds, text=text, refresh=True)


def _summary_line(state: ReplayState) -> str:
    text = (
        f"{state.frames} frames, {duration(state.log_seconds)} of log in {state.seconds:.2f} s"
        f" ({number(state.speed, 2)}×)"
    )
    if state.acknowledged is not None:
        text += f"; {state.acknowledged} of {state.samples} samples acknowledged"
        text += f", {state.lost} LOST" if state.lost else ""
    if state.soc is not None:
        text += f"; latest SoC received {number(state.soc.soc_pct, 2, '%')}"
    return text


def _as_json(state: ReplayState, bus: BusConnection, source: Source) -> dict[str, Any]:
    from cangauge.replay.encoder import FrameEncoder
    from cangauge.replay.steps import CaptureSource, LogSource

    result: dict[str, Any] = {
        "bus": bus.name,
        "frames": state.frames,
        "clock_frames": state.clocks,
        "samples": state.samples if source.counts_samples else None,
        "acknowledged": state.acknowledged,
        "lost": state.lost,
        "seconds": state.seconds,
        "log_seconds": state.log_seconds,
        "speed": state.speed,
        "unsent": bus.unsent,
        "soc_pct": None if state.soc is None else state.soc.soc_pct,
        "soc_std_pct": None if state.soc is None else state.soc.soc_std_pct,
    }
    if isinstance(source, LogSource):
        result["quantisation"] = FrameEncoder(source.vehicle).quantization()
        result["assumed"] = assumed_of([source.log])
    if isinstance(source, CaptureSource):
        result["dropped"] = source.dropped
    return result

"""`cangauge replay`: a log or a capture → frames on a bus."""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

import typer
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from cangauge._text import duration, number
from cangauge.cli.config_options import config_options, config_values
from cangauge.cli.options import (
    ColumnsOption,
    JsonOption,
    ReadingOptions,
    assumed_of,
    note_reading,
    number_unless,
)
from cangauge.cli.output import console, emit_json, note

if TYPE_CHECKING:
    from cangauge.bus.connection import BusConnection
    from cangauge.bus.publish import FrameIds
    from cangauge.replay.player import ReplayState
    from cangauge.replay.steps import Source
    from cangauge.service.config import RunConfig


@config_options("interface", "channel", "bus_options", "vehicle", "dbc", "map", "temperature")
def replay_command(
    recorded: Annotated[
        Path, typer.Argument(metavar="LOG|CAPTURE", help="Recorded log, or recorded frames.")
    ],
    *,
    config: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.toml",
            help="Configuration of the `cangauge run` that listens: its bus, vehicle and ids.",
        ),
    ] = None,
    columns: ColumnsOption = None,
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
    json_output: JsonOption = False,
    **options: Any,
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
    from cangauge.bus.open import open_bus
    from cangauge.bus.publish import FrameIds, standard_filter
    from cangauge.replay.player import ReplaySettings, play
    from cangauge.service.config import load_config
    from cangauge.service.lifecycle import stop_on_signals
    from cangauge.service.setup import address_of

    factor = number_unless("max", speed, 1e-3, 1e6, option="--speed") or math.inf
    loaded = load_config(config, {"model": "-", **config_values(options)})
    ids = FrameIds(**loaded.ids.model_dump())
    source, address = _source(recorded, columns, loaded, ids), address_of(loaded)
    with ExitStack() as stack:
        stop = stack.enter_context(stop_on_signals())
        filters = [standard_filter(ids.soc_estimate), standard_filter(ids.soc_detail)]
        bus = stack.enter_context(BusConnection(open_bus(address, filters), str(address)))
        note(f"playing {recorded} on {address}, speed {speed}")
        bar = stack.enter_context(_Bar(source, loop=loop)) if console.is_terminal else None
        settings = ReplaySettings(speed=factor, loop=loop, ids=ids)
        state = play(bus, source, settings, stop=stop, show=None if bar is None else bar.show)
        stopped = stop()
    note(_summary_line(state))
    if bus.unsent:
        note(f"warning: {bus.unsent} frames were not sent: the transmit queue stayed full")
    if json_output:
        emit_json(_as_json(state, bus, source))
    if stopped and not loop:
        raise KeyboardInterrupt


def _source(recorded: Path, columns: str | None, config: RunConfig, ids: FrameIds) -> Source:
    from cangauge.logs.read import LogFile
    from cangauge.replay.steps import CaptureSource, LogSource
    from cangauge.service.setup import load_vehicle

    map_file = None if config.map is None else Path(config.map)
    reading = ReadingOptions(map_file=map_file, columns=columns)
    recording = reading.open(recorded)
    if not isinstance(recording, LogFile):
        is_named = (config.vehicle, config.dbc, config.map) != (None, None, None)
        return CaptureSource(recorded, load_vehicle(config) if is_named else None, ids)
    log = recording.read(temperature_c=config.temperature)
    note_reading(log)
    return LogSource(log, load_vehicle(config))


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

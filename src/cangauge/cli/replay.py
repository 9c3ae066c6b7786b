"""`cangauge replay`: a log or a capture → frames on a bus."""

from __future__ import annotations

import math
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cangauge._text import duration, number
from cangauge.cli.options import (
    Json,
    ReadingOptions,
    argument,
    assumed_of,
    command,
    config_parameters,
    config_values,
    note_reading,
    option,
)
from cangauge.cli.output import emit_json, note, progress

if TYPE_CHECKING:
    from cangauge.bus.connection import BusConnection
    from cangauge.replay.player import ReplayState
    from cangauge.replay.steps import Source
    from cangauge.service.config import RunConfig


@command(
    keys=config_parameters(
        "interface", "channel", "bus_options", "vehicle", "dbc", "map", "temperature"
    )
)
def replay_command(
    recorded: Annotated[
        Path, argument("LOG|CAPTURE", "Recorded log, or capture of recorded frames.")
    ],
    *,
    config: Annotated[
        Path | None,
        option(
            "--config",
            "FILE",
            "Configuration of the receiving `cangauge run`. Bus, vehicle and ids are taken from"
            " it.",
        ),
    ] = None,
    columns: Annotated[
        str | None,
        option(
            "--columns",
            "NAME=HEADING,…",
            "For a table with other headings: columns, as in `cangauge inspect`.",
        ),
    ] = None,
    speed: Annotated[
        Any,
        option(
            "--speed",
            "1|N|max",
            "1: real time. N: N times faster. max: as fast as `cangauge run` acknowledges,"
            " without loss.",
            within=(0.001, 1e6),
            word="max",
        ),
    ] = 1.0,
    loop: Annotated[
        bool, option("--loop", "", "Repeat until Ctrl-C, with increasing log time.")
    ] = False,
    json_output: Json = False,
    **options: Any,
) -> None:
    """Play a recorded log or capture on a bus.

    A log is encoded into the vehicle's frames of current [A], voltage [V], temperature [°C] and SoC
    [%]. A capture is sent as recorded. The recorded timing is kept. At a speed other than 1, the
    log time is sent as well (REPLAY_CLOCK, 0x5AF). `cangauge run --time-source replay-clock` then
    counts the same charge at every speed.

    Examples
    --------
    `cangauge replay trip.parquet`

    `cangauge replay trip.parquet --speed max --vehicle leaf_aze0`

    `cangauge replay candump.log.gz --speed 10 --interface socketcan --channel vcan0 --loop`
    """
    from cangauge.bus.connection import BusConnection
    from cangauge.bus.open import open_bus
    from cangauge.bus.publish import standard_filter
    from cangauge.replay.player import play
    from cangauge.service.config import load_config
    from cangauge.service.lifecycle import stop_on_signals
    from cangauge.service.setup import address_of

    loaded = load_config(config, {"model": "-", **config_values(options)})
    ids = loaded.ids
    source = _source(recorded, columns, loaded)
    address = address_of(loaded)
    stopped: list[bool] = []
    with ExitStack() as stack:
        stack.enter_context(stop_on_signals(partial(stopped.append, True)))
        filters = [standard_filter(ids.soc_estimate), standard_filter(ids.soc_detail)]
        bus = stack.enter_context(BusConnection(open_bus(address, filters), address))
        note(f"playing {recorded} on {address}, speed {speed}")
        show_line = stack.enter_context(progress())

        def show(state: ReplayState) -> None:
            show_line(_line(state))

        def is_stopped() -> bool:
            return bool(stopped)

        state = play(
            bus,
            source,
            stop=is_stopped,
            show=show,
            speed=math.inf if speed == "max" else speed,
            loop=loop,
            ids=ids,
        )
    note(_line(state))
    if bus.unsent:
        note(f"warning: {bus.unsent} frames were not sent: the transmit queue stayed full")
    if json_output:
        emit_json(_as_json(state, bus, source))
    if stopped and not loop:
        raise KeyboardInterrupt


def _source(recorded: Path, columns: str | None, config: RunConfig) -> Source:
    from cangauge.logs.read import LogFile
    from cangauge.replay.steps import CaptureSource, LogSource
    from cangauge.service.setup import load_vehicle

    map_file = None if config.map is None else Path(config.map)
    recording = ReadingOptions(map_file=map_file, columns=columns).open(recorded)
    if not isinstance(recording, LogFile):
        is_named = (config.vehicle, config.dbc, config.map) != (None, None, None)
        return CaptureSource(recorded, load_vehicle(config) if is_named else None, config.ids)
    log = recording.read(temperature_c=config.temperature)
    note_reading(log)
    return LogSource(log, load_vehicle(config))


def _line(state: ReplayState) -> str:
    """Return frames, log time, speed, acknowledged samples and the latest SoC of the receiver."""
    text = (
        f"{state.frames} frames, {duration(state.log_seconds)} of log in {state.seconds:.2f} s"
        f" ({number(state.speed, 2)}×)"
    )
    if state.acknowledged is None:
        text += "; `cangauge status` counts what was lost"
    else:
        text += f"; {state.acknowledged} of {state.samples} samples acknowledged"
        text += f", {state.lost} LOST" if state.lost else ""
    if state.soc:
        text += f"; latest SoC received {number(state.soc['soc_pct'], 2, '%')}"
    return text


def _as_json(state: ReplayState, bus: BusConnection, source: Source) -> dict[str, Any]:
    from cangauge.replay.steps import LogSource

    result = {name: value for name, value in vars(state).items() if name != "soc"} | {
        "bus": bus.name,
        "samples": state.samples if source.counts_samples else None,
        "speed": state.speed,
        "unsent": bus.unsent,
        "soc_pct": state.soc.get("soc_pct"),
        "soc_std_pct": state.soc.get("soc_std_pct"),
    }
    if isinstance(source, LogSource):
        return result | {"quantisation": source.quantization, "assumed": assumed_of([source.log])}
    return result | {"dropped": source.dropped}

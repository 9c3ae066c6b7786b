"""Puts the service together from its parts, lets it run, and tells what it amounted to."""

from __future__ import annotations

import gc
import logging
import os
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from cangauge.bus.lasting import LastingPort
from cangauge.cli.inputs import check_outputs
from cangauge.cli.output import console
from cangauge.cli.run_summary import summary_json, summary_line
from cangauge.events import emit, speaker
from cangauge.model.model_file import load_model
from cangauge.service.config import RunConfig
from cangauge.service.display import LiveLine
from cangauge.service.gauge import Gauge
from cangauge.service.loop import LoopSettings, Outputs, serve
from cangauge.service.monitor import Monitor
from cangauge.service.operate import operated
from cangauge.service.record import Recorder
from cangauge.service.reload import Reloader
from cangauge.service.signals import note_hangups, stop_on_signals
from cangauge.service.state_keeper import StateKeeper

_LOG = logging.getLogger(__name__)


def run_service(config: RunConfig, read: Callable[[], RunConfig]) -> dict[str, Any]:
    """Run the service until it ends; return what `--json` prints.

    Parameters
    ----------
    config : RunConfig
    read : callable
        Returns the configuration as it stands, for SIGHUP.
    """
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
            # pyarrow is slow to import, and few services write a table.
            from cangauge.service.table import EstimateWriter  # noqa: PLC0415

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
    emit(_LOG, logging.INFO, "service.stopped", summary_line(gauge, port, summary))
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
    return summary_json(gauge, port, summary) | {
        "state": config.state,
        "record": None if recorded is None else str(recorded),
        "output": output,
    }


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

"""The service: estimate the SoC from a bus, publish it there, reload its configuration."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import Any, Final

from cangauge._files import check_writable
from cangauge._logging import emit
from cangauge._text import known_soc, number
from cangauge.bus.publish import NO_REPORT
from cangauge.bus.reconnecting import ReconnectingBus
from cangauge.errors import CangaugeError, InputError
from cangauge.service.config import RunConfig, config_keys, load_config
from cangauge.service.lifecycle import Notifier, note_hangups, sole_writer, stop_on_signals
from cangauge.service.loop import Loop, LoopSettings, RunSummary
from cangauge.service.output import Output
from cangauge.service.pipeline import Pipeline
from cangauge.service.record import Recorder, RecordLimits
from cangauge.service.setup import Reloader, Setup, address_of
from cangauge.service.state import StateKeeper, state_path
from cangauge.service.status import PAGE_EVERY_S, SHOW_EVERY_S, Monitor
from cangauge.service.status_client import StatusSocket, socket_path
from cangauge.types import reason_names

OUTPUTS: Final = {
    "cangauge.service.estimate_table": ("output",),
    "cangauge.extras.live.launch": ("http", "dashboard", "mqtt"),
    "cangauge.extras.inverter.gateway": ("publish",),
    "cangauge.extras.judge.live": ("judge",),
}
"""Modules with an output, and the keys that ask for it; imported only then. Each has
`make_output(service)`."""
_LOG = logging.getLogger(__name__)


class Service:
    """Estimate the state of charge from a bus, and publish it there.

    Parameters
    ----------
    config : RunConfig or path-like, optional
        Configuration, or its TOML file.
    outputs : sequence of Output
        Further consumers of the results.
    **options
        Keys of the configuration, which take precedence over the file.

    Attributes
    ----------
    config : RunConfig
        The configuration in use, except for keys that need a restart.
    pipeline : Pipeline
        The estimator.
    recorder : Recorder or None
        The recording, while `run` runs.
    address, bus : BusAddress, str
        Interface and channel.

    Raises
    ------
    InputError
        If the configuration, the model or the vehicle is invalid.

    Examples
    --------
    >>> service = Service(model="leaf.json", vehicle="leaf_aze0", channel="can0")  # doctest: +SKIP
    >>> service.run()["estimate"]["soc_pct"]  # doctest: +SKIP
    71.2
    """

    def __init__(
        self,
        config: RunConfig | str | PathLike[str] | None = None,
        outputs: Sequence[Output] = (),
        **options: Any,
    ) -> None:
        self._read = (
            partial(RunConfig.model_copy, config)
            if isinstance(config, RunConfig)
            else partial(load_config, config, options)
        )
        self.config = loaded = self._read()
        self._state = state_path(loaded.state, os.environ)
        _check_files(loaded, self._state)
        self._setup = setup = Setup.of(loaded)
        self.pipeline = Pipeline(setup.vehicle, setup.model, setup.settings)
        self.address = address_of(loaded)
        self.bus = str(self.address)
        self._outputs = list(outputs)
        self._stop = threading.Event()
        self._reload = threading.Event()
        self.recorder: Recorder | None = None

    def stop(self) -> None:
        """Make `run` return; from any thread."""
        self._stop.set()

    def reload(self) -> None:
        """Read and apply the configuration again while `run` runs; from any thread."""
        self._reload.set()

    def run(self) -> dict[str, Any]:
        """Run until `stop`, a signal, or a configured end.

        SIGINT and SIGTERM stop and SIGHUP reloads, if this is the main thread.

        Returns
        -------
        dict
            Summary of frames, bus errors and the last estimate, as `cangauge run --json`.

        Raises
        ------
        CangaugeError
            If the bus, the recording or an address cannot be opened.
        """
        config, pipeline = self.config, self.pipeline
        with ExitStack() as stack:
            # Signals first: the service may be stopped at any moment from now on.
            stopped, hung_up = self._stop.is_set, self._reload.is_set
            if threading.current_thread() is threading.main_thread():
                stopped = stack.enter_context(stop_on_signals())
                hung_up = stack.enter_context(note_hangups())
            for owned in (self._state, config.record, config.output):
                if owned is not None:
                    stack.enter_context(sole_writer(owned))
            reloader = Reloader(self._read)
            stack.callback(reloader.close)
            port = stack.enter_context(ReconnectingBus(self.address, pipeline.filters))
            port.open(wait=config.wait_for_bus)
            keeper = None
            if self._state is not None:
                keeper = StateKeeper(self._state, pipeline, port.name, config.state_max_age_s)
                stack.enter_context(keeper)
            recorder = None
            if config.record is not None:
                self.recorder = recorder = Recorder(config.record, _record_limits(config))
                self._outputs.insert(0, recorder)
            notifier = stack.enter_context(Notifier(os.environ))
            monitor = Monitor(
                pipeline,
                port,
                config.model,
                notifier=notifier,
                record=lambda: None if recorder is None else recorder.state,
                troubles=lambda: [text for each in self._outputs if (text := each.trouble)],
                show_every_s=SHOW_EVERY_S if config.dashboard is None else PAGE_EVERY_S,
                sign_cure=self._setup.sign_cure,
            )
            for output in self._outputs:
                stack.callback(output.close)
            for module, keys in OUTPUTS.items():
                if any(getattr(config, key) is not None for key in keys):
                    self._outputs.append(import_module(module).make_output(self))
                    stack.callback(self._outputs[-1].close)
            _serve_status(config, monitor, stack)
            text = f"listening on {port.name}; time source: {config.time_source}; Ctrl-C ends"
            about = {"bus": port.name, "vehicle": pipeline.vehicle.name, "model": config.model}
            emit(_LOG, logging.INFO, "service.ready", text, **about)
            notifier.ready(f"listening on {port.name}")
            stack.callback(notifier.stopping)
            loop = Loop(
                port,
                pipeline,
                _loop_settings(config),
                outputs=self._outputs,
                record=recorder,
                monitor=monitor,
                checkpoint=(lambda: None) if keeper is None else keeper.checkpoint,
                reload=lambda: self._poll_reload(reloader, monitor, wanted=hung_up()),
            )
            summary = loop.run(lambda: stopped() or self._stop.is_set())
        return self._end(port, summary)

    def reconfigure(self) -> LoopSettings | None:
        """Read the configuration again and apply it; the SoC continues.

        `run` does the same on SIGHUP or `reload`, but reads in a thread meanwhile. Model, vehicle,
        method, capacity, gaps, time-outs and published ids change at once. The initial SoC is
        ignored, since the SoC is known. Other keys need a restart, which is logged.

        Returns
        -------
        LoopSettings or None
            Those of the new configuration; None if it is invalid, and the old one stays.
        """
        try:
            new: Setup | CangaugeError = Setup.of(self._read())
        except CangaugeError as error:
            new = error
        return self._use(new)[0]

    def _use(self, new: Setup | CangaugeError) -> tuple[LoopSettings | None, str | None]:
        """Use another configuration as a whole, or log why not; return its settings, or that."""
        try:
            if isinstance(new, CangaugeError):
                raise new
            is_same = new.vehicle_key == self._setup.vehicle_key
            self.pipeline.reconfigure(None if is_same else new.vehicle, new.model, new.settings)
        except CangaugeError as error:
            text = f"new configuration refused, the old one stays: {error}"
            emit(_LOG, logging.WARNING, "config.refused", text)
            return None, str(error)
        _log_changes(self.config, new.config)
        self._setup, self.config = new, new.config
        return _loop_settings(new.config), None

    def _poll_reload(
        self, reloader: Reloader, monitor: Monitor, *, wanted: bool
    ) -> LoopSettings | None:
        """Begin to read on request; use what was read since the last call."""
        if wanted or self._reload.is_set():
            self._reload.clear()
            reloader.request()
            monitor.reload_begins()
        if (new := reloader.poll()) is None:
            return None
        settings, problem = self._use(new)
        monitor.model, monitor.sign_cure = self.config.model, self._setup.sign_cure
        if not reloader.is_reading:
            monitor.reload_ends(problem)
        return settings

    def _end(self, port: ReconnectingBus, summary: RunSummary) -> dict[str, Any]:
        """Log the end of a run; return its summary."""
        pipeline, recorder = self.pipeline, self.recorder
        emit(_LOG, logging.INFO, "service.stopped", _summary_line(pipeline, port, summary))
        if not pipeline.counts.frames:
            text = f"{port.name}: no expected frame arrived; check channel, bit rate and vehicle"
            text += " (--vehicle, or --dbc and --map)"
            emit(_LOG, logging.WARNING, "bus.nothing_wanted", text)
        record = None if recorder is None else str(recorder.written)
        has_failed = any(getattr(each, "failed", False) for each in self._outputs)
        output = None if has_failed else self.config.output
        for path in filter(None, (record, output)):
            emit(_LOG, logging.INFO, "file.written", f"written: {path}", limit=path, path=path)
        return _summary_json(pipeline, port, summary) | {
            "state": self.config.state,
            "record": record,
            "output": output,
        }


def _check_files(config: RunConfig, state: Path | None) -> None:
    """Raise InputError if the table or the state is another file of the service."""
    if config.output is not None:
        if os.path.realpath(config.output) == os.path.realpath(config.model):
            cure = "name another file for it"
            raise InputError("this output is also an input", source=config.output, cure=cure)
        check_writable(config.output)
    if state is not None:
        others = (config.model, config.record, config.output, config.dbc, config.map)
        for other in filter(None, others):
            if os.path.realpath(other) == os.path.realpath(state):
                raise InputError("is another file of this service", field="--state", value=other)


def _record_limits(config: RunConfig) -> RecordLimits:
    part_mb, keep_mb = config.record_part_mb, config.record_keep_mb
    return RecordLimits(
        part_bytes=None if part_mb is None else 1e6 * part_mb,
        part_s=config.record_part_s,
        keep_bytes=None if keep_mb is None else 1e6 * keep_mb,
    )


def _loop_settings(config: RunConfig) -> LoopSettings:
    return LoopSettings(
        timeout_s=config.timeout_s,
        duration_s=config.duration_s,
        until_idle_s=config.until_idle_s,
        checkpoint_every_s=config.state_every_s,
        poll_every_s=None if config.poll is None else config.poll.every_s,
    )


def _serve_status(config: RunConfig, monitor: Monitor, stack: ExitStack) -> None:
    if config.status_socket == "off":
        return
    is_auto = config.status_socket == "auto"
    path = socket_path(monitor.latest.status["bus"]) if is_auto else Path(config.status_socket)
    try:
        server = StatusSocket(path, lambda: monitor.latest.at(time.monotonic()))
        stack.callback(server.close)
    except InputError as error:
        if not is_auto:
            raise
        # Not requested explicitly: the service runs without it.
        emit(_LOG, logging.WARNING, "status.unavailable", f"no status socket: {error}")


def _log_changes(old: RunConfig, new: RunConfig) -> None:
    before, after = old.model_dump(), new.model_dump()
    changed = ", ".join(name for name in after if after[name] != before[name])
    text = f"configuration reloaded; changed: {changed or 'no option'}"
    emit(_LOG, logging.INFO, "config.reloaded", text)
    restarts = [key.name for key in config_keys() if key.info.restart]
    late = ", ".join(name for name in restarts if _value(before, name) != _value(after, name))
    if late:
        text = f"{late}: takes effect after a restart of the service"
        emit(_LOG, logging.WARNING, "config.needs_restart", text)


def _value(content: Any, key: str) -> object:
    for part in key.split("."):
        content = None if content is None else content[part]
    return content


def _summary_line(pipeline: Pipeline, port: ReconnectingBus, summary: RunSummary) -> str:
    """Return a run's frames, losses and last SoC in one line."""
    counts, latest = pipeline.counts, pipeline.latest
    kinds = ", ".join(f"{kind} {count}" for kind, count in port.error_kinds.most_common())
    found = {
        "dropped in the receive queue": port.queue_drops,
        f"error frames ({kinds})": port.error_frames,
        "not sent": port.unsent,
        "from another service with these ids": summary.foreign_frames,
        f"bus losses ({port.away_s:.1f} s)": port.losses,
    }
    errors = "".join(f", {count} {what}" for what, count in found.items() if count)
    soc = known_soc(latest.soc_pct, latest.soc_std_pct, 2)
    return (
        f"{summary.seconds:.1f} s, {counts.frames} frames, {counts.samples} samples,"
        f" {counts.lost} lost, {counts.crc_errors} CRC errors{errors}; last SoC {soc}"
        f" ({latest.status.name.lower()}); step {number(summary.step_p50_us, 0, 'µs')} (median)"
    )


_COUNTED: Final = ("frames", "samples", "lost", "crc_errors", "untimed")
_REFUSED: Final = (
    "crc_errors", "repeated", "short", "not_available", "implausible", "stuck", "held_back",
)  # fmt: skip
_OF_BUS: Final = ("garbled", "error_frames", "queue_drops", "unsent")
_ESTIMATED: Final = (
    "time_s", "soc_pct", "soc_std_pct", "soc_newton_pct", "soc_coulomb_pct", "residual_v",
)  # fmt: skip


def _summary_json(pipeline: Pipeline, port: ReconnectingBus, summary: RunSummary) -> dict[str, Any]:
    """Return the summary that `--json` prints."""
    counts, latest = pipeline.counts, pipeline.latest
    return {
        "bus": port.name,
        "seconds": summary.seconds,
        "cpu_seconds": summary.cpu_seconds,
        **{name: getattr(counts, name) for name in _COUNTED},
        "refused": {name: getattr(counts, name) for name in _REFUSED},
        "restarts": counts.beginnings,
        **{name: getattr(port, name) for name in _OF_BUS},
        "error_kinds": dict(port.error_kinds),
        "bus_losses": port.losses,
        "bus_away_s": port.away_s,
        "rival_frames": summary.foreign_frames,
        "stamps": port.capabilities.stamps,
        "step_p50_us": summary.step_p50_us,
        "estimate": {
            **{name: getattr(latest, name) for name in _ESTIMATED},
            "status": latest.status.name.lower(),
            "reasons": reason_names(int(latest.reasons)),
        },
        "soc_reference_pct": pipeline.decoder.reference_soc_pct,
        **(pipeline.report().to_dict() if pipeline.samples else NO_REPORT),
    }

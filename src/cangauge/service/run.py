"""The service: estimate the SoC from a bus, publish it there, reload its configuration."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, closing
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, Final

from cangauge._logging import emit
from cangauge._text import known_soc, number
from cangauge.bus.reconnecting import ReconnectingBus
from cangauge.errors import CangaugeError, InputError
from cangauge.service.config import RunConfig, config_keys, load_config
from cangauge.service.lifecycle import Notifier, reload_on_hangup, sole_writer, stop_on_signals
from cangauge.service.loop import Loop
from cangauge.service.output import Output
from cangauge.service.pipeline import Pipeline
from cangauge.service.record import Recorder, check_recording
from cangauge.service.setup import Setup, address_of, read_setup
from cangauge.service.state import StateKeeper, state_path
from cangauge.service.status import Monitor
from cangauge.service.status_client import StatusSocket, socket_path, value_at
from cangauge.service.worker import start_thread

COUNTED: Final = {
    "garbled": "packets that are no frames",
    "error_frames": "error frames",
    "unsent": "frames not sent",
    "queue_drops": "frames dropped in the receive queue",
    "losses": "bus losses",
    "foreign": "frames of another service with these ids",
}
"""Words for the counts of a bus, at the end of a run."""
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
    pipeline : Pipeline
        The estimator.
    recorder : Recorder or None
        The recording, while `run` runs.
    address, bus : BusAddress, str
        Interface and channel.
    endpoint : Path or None
        The status socket, while `run` runs.

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
        config = self._read()
        with config.naming_keys():
            self._state = state_path(config.state, os.environ)
            self._check_files(config)
            self._setup = setup = Setup.of(config)
            self.pipeline = Pipeline(setup.vehicle, setup.model, setup.settings)
            self.address = address_of(config)
        self.bus = str(self.address)
        self._outputs = list(outputs)
        self._is_stopped = self._is_reload_due = False
        self._reading: Future[Setup | CangaugeError] | None = None
        self.recorder: Recorder | None = None
        self.endpoint: Path | None = None

    @property
    def config(self) -> RunConfig:
        """The configuration in use, except for keys that need a restart."""
        return self._setup.config

    def stop(self) -> None:
        """Make `run` return; from any thread."""
        self._is_stopped = True

    def reload(self) -> None:
        """Read and `apply` the configuration again while `run` runs; from any thread."""
        self._is_reload_due = True

    def run(self) -> dict[str, Any]:
        """Run until `stop`, a signal, or a configured end.

        SIGINT and SIGTERM stop and SIGHUP reloads, if this is the main thread.

        Returns
        -------
        dict
            The object of `/status` at the end, the CPU time and the name of the recording, as
            `cangauge run --json`.

        Raises
        ------
        CangaugeError
            If the bus, the recording or an address cannot be opened.
        """
        config = self.config
        pipeline = self.pipeline
        began_s = time.process_time()
        with ExitStack() as stack:
            # Signals first: the service may be stopped at any moment from now on.
            if threading.current_thread() is threading.main_thread():
                stack.enter_context(stop_on_signals(self.stop))
                stack.enter_context(reload_on_hangup(self.reload))
            for owned in (self._state, config.record):
                if owned is not None:
                    stack.enter_context(sole_writer(owned))
            port = stack.enter_context(ReconnectingBus(self.address, pipeline.filters))
            port.open(wait=config.wait_for_bus)
            checkpoint = None
            if self._state is not None:
                keeper = StateKeeper(self._state, pipeline, port.name, config.state_max_age_s)
                checkpoint = stack.enter_context(keeper).checkpoint
            if config.record is not None:
                self.recorder = Recorder(
                    config.record, config.record_part_mb, config.record_keep_mb
                )
                self._outputs.insert(0, self.recorder)
            for output in self._outputs:
                stack.callback(output.close)
            notifier = stack.enter_context(closing(Notifier(os.environ)))
            monitor = Monitor(
                pipeline,
                port,
                config.model,
                notifier=notifier,
                recorder=self.recorder,
                outputs=self._outputs,
                sign_cure=self._setup.sign_cure,
            )
            self.endpoint = _serve_status(config, monitor, stack)
            for make_output in self._setup.outputs:
                self._outputs.append(make_output(self))
                stack.callback(self._outputs[-1].close)
            emit(
                _LOG.info,
                "service.ready",
                f"listening on {port.name}; time source: {config.time_source}; Ctrl-C ends",
                bus=port.name,
                vehicle=pipeline.vehicle.name,
                model=config.model,
            )
            notifier.send(READY=1, STATUS=f"listening on {port.name}")
            stack.callback(notifier.send, STOPPING=1, STATUS="stopping")
            loop = Loop(
                port,
                pipeline,
                config,
                outputs=self._outputs,
                monitor=monitor,
                checkpoint=checkpoint,
                reload=partial(self._poll_reload, monitor),
            )
            loop.run(self._is_done)
        status = monitor.final() | {
            "cpu_seconds": time.process_time() - began_s,
            "recording": self.recorder and str(self.recorder.written),
        }
        log_end(status)
        return status

    def _is_done(self) -> bool:
        return self._is_stopped

    def apply(self, new: Setup | CangaugeError) -> str | None:
        """Use another configuration as a whole; else log and return why not.

        Model, vehicle, method, capacity, gaps, time-outs and published ids change at once; the SoC
        continues unless current or voltage are decoded otherwise, and the initial SoC is ignored.
        Other keys need a restart, which is logged.
        """
        try:
            if isinstance(new, CangaugeError):
                raise new
            with new.config.naming_keys():
                self.pipeline.reconfigure(new.vehicle, new.model, new.settings)
        except CangaugeError as error:
            emit(
                _LOG.warning,
                "config.refused",
                f"new configuration refused, the old one stays: {error}",
            )
            return str(error)
        _log_changes(self._setup, new)
        self._setup = new
        return None

    def _poll_reload(self, monitor: Monitor) -> RunConfig | None:
        """Begin to read on request, in a thread; return the new configuration once it is in use."""
        if self._reading is None and self._is_reload_due:
            self._is_reload_due = False
            self._reading = reading = Future[Setup | CangaugeError]()
            monitor.reload_begins()

            def read() -> None:
                reading.set_result(read_setup(self._read))

            try:
                start_thread(read, "cangauge-reload")
            except CangaugeError as error:
                reading.set_result(error)
        if self._reading is None or not self._reading.done():
            return None
        problem = self.apply(self._reading.result())
        self._reading = None
        monitor.model = self.config.model
        monitor.sign_cure = self._setup.sign_cure
        monitor.reload_ends(problem)
        return self.config if problem is None else None

    def _check_files(self, config: RunConfig) -> None:
        """Raise InputError if the recording cannot be written, or if two files are one.

        A state that cannot be written never stops the service: `StateKeeper` logs it.
        """
        if self._state is not None:
            for other in filter(None, (config.model, config.record, config.dbc, config.map)):
                if os.path.realpath(other) == os.path.realpath(self._state):
                    raise InputError(
                        "is another file of this service", field="--state", value=other
                    )
        if config.record is not None:
            check_recording(Path(config.record), config.record_part_mb, config.record_keep_mb)


def log_end(status: Mapping[str, Any]) -> None:
    """Log the end of a run by its status: frames, losses and last SoC, and what is missing."""
    frames = status["frames"]
    estimate = status["estimate"]
    step_s = status["step"]["mean_s"]
    errors = "".join(
        f", {count} {COUNTED.get(name, name)}"
        for name, count in status["bus_counts"].items()
        if count
    )
    emit(
        _LOG.info,
        "service.stopped",
        f"{status['uptime_s']:.1f} s, {frames['received']} frames, {status['samples']} samples,"
        f" {frames['lost']} lost, {status['rejects']['crc_errors']} CRC errors{errors};"
        f" last SoC {known_soc(estimate['soc_pct'], estimate['soc_std_pct'], 2)}"
        f" ({status['status']});"
        f" step {number(step_s and 1e6 * step_s, 0, 'µs')} (mean)",
    )
    if not frames["received"]:
        emit(
            _LOG.warning,
            "bus.nothing_wanted",
            f"{status['bus']}: no expected frame arrived; check channel, bit rate and vehicle"
            " (--vehicle or --map)",
        )
    if (path := status["recording"]) is not None:
        emit(_LOG.info, "file.written", f"written: {path}", path=path)


def _serve_status(config: RunConfig, monitor: Monitor, stack: ExitStack) -> Path | None:
    """Open the status socket; return its path, or None if it is off or not to be had."""
    if config.status_socket == "off":
        return None
    is_asked_for = config.status_socket != "auto"
    bus = monitor.latest.status["bus"]
    path = Path(config.status_socket) if is_asked_for else socket_path(bus)
    try:
        stack.enter_context(closing(StatusSocket(path, monitor.now)))
    except CangaugeError as error:
        if is_asked_for:
            raise
        emit(_LOG.warning, "status.unavailable", f"no status socket: {error}")
        return None
    return path


def _log_changes(old: Setup, new: Setup) -> None:
    before = old.config.model_dump()
    after = new.config.model_dump()
    keys = config_keys()
    names = [name for name in keys if value_at(before, name) != value_at(after, name)]
    changed = [
        *names,
        *["content of map or DBC"] * (old.vehicle != new.vehicle),
        *["content of the model"] * (old.model != new.model),
    ]
    text = f"configuration reloaded; changed: {', '.join(changed) or 'nothing'}"
    if old.vehicle.battery != new.vehicle.battery:
        text += "; current or voltage are decoded otherwise: the SoC starts anew from the voltage"
    emit(_LOG.info, "config.reloaded", text)
    if late := ", ".join(name for name in names if keys[name]["restart"]):
        emit(
            _LOG.warning,
            "config.needs_restart",
            f"{late}: takes effect after a restart of the service",
        )

"""The service: estimate the SoC from a bus, publish it there, reload its configuration."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cangauge._io import READ_WITHIN_S, check_writable, refuse_pipe, sole_writer
from cangauge._logging import emit
from cangauge._text import number
from cangauge.bus.connection import ReconnectingBus
from cangauge.bus.publish import NO_REPORT
from cangauge.errors import InputError
from cangauge.service.addresses import default_path, has_unix_sockets
from cangauge.service.config import RunConfig, config_keys, load_config
from cangauge.service.http import Endpoint
from cangauge.service.lifecycle import Notifier, note_hangups, stop_on_signals
from cangauge.service.loop import LoopSettings, Outputs, RunSummary, serve
from cangauge.service.pipeline import Pipeline
from cangauge.service.reading import START_S, BackgroundReader, Reading
from cangauge.service.record_control import RecordControl
from cangauge.service.state import StateKeeper, check_state_path
from cangauge.service.status import PAGE_EVERY_S, SHOW_EVERY_S, Identity, Monitor, Snapshot
from cangauge.types import Estimate, reason_names

if TYPE_CHECKING:
    from cangauge.service.estimate_table import EstimateWriter

_LOG = logging.getLogger(__name__)


class Service:
    """Estimate the state of charge from a bus, and publish it there.

    Parameters
    ----------
    config : RunConfig or path-like, optional
        Configuration, or its TOML file.
    **options
        Keys of the configuration, which take precedence over the file.

    Attributes
    ----------
    config : RunConfig
        The configuration in use, except for keys that need a restart.
    pipeline : Pipeline
        The estimator.
    on_status : callable or None
        Takes a `Snapshot` four times a second while the service runs; ten times with a live page.

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
        **options: Any,
    ) -> None:
        self._read = (
            partial(RunConfig.model_copy, config)
            if isinstance(config, RunConfig)
            else partial(load_config, config, options)
        )
        self.config = loaded = self._read()
        if loaded.output is not None:
            _check_output(Path(loaded.output), Path(loaded.model))
        if loaded.record is not None:
            refuse_pipe(loaded.record)
        self._state = loaded.state_settings(os.environ)
        if self._state is not None:
            check_state_path(self._state.path)
        self._reader = BackgroundReader(self._read)
        notifier = Notifier.from_environment()
        notifier.extend(READ_WITHIN_S)
        notifier.close()
        reading = Reading.of(partial(RunConfig.model_copy, loaded))
        self._vehicle_key = reading.vehicle_key
        self.pipeline = Pipeline(reading.vehicle, reading.model, loaded.pipeline_settings())
        self._address = loaded.address()
        self._stop = threading.Event()
        self._reload = threading.Event()
        self._recording: RecordControl | None = None
        self.on_status: Callable[[Snapshot], None] | None = None

    def stop(self) -> None:
        """Make `run` return; from any thread."""
        self._stop.set()

    def reload(self) -> None:
        """Read and apply the configuration again while `run` runs; from any thread."""
        self._reload.set()

    def record(self, *, active: bool) -> None:
        """Begin or end a recording while `run` runs; from any thread."""
        if self._recording is not None:
            self._recording.request(active=active)

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
            stop, hangup = self._stop.is_set, self._take_reload
            if threading.current_thread() is threading.main_thread():
                signalled = stack.enter_context(stop_on_signals())
                hung_up = stack.enter_context(note_hangups())
                stop = lambda: signalled() or self._stop.is_set()  # noqa: E731
                hangup = lambda: hung_up() or self._take_reload()  # noqa: E731
            for owned in self._written_while_running():
                stack.enter_context(sole_writer(owned))
            stack.callback(self._reader.close)
            port = stack.enter_context(ReconnectingBus(self._address, pipeline.filters))
            port.open(wait=config.wait_for_bus)
            table = keeper = None
            if self._state is not None:
                keeper = stack.enter_context(StateKeeper(self._state, pipeline, port.name))
            record_path = None if config.record is None else Path(config.record)
            recording = RecordControl(record_path, config.record_limits())
            self._recording = stack.enter_context(recording)
            if config.output is not None:
                # pyarrow is slow to import, and few services write a table.
                from cangauge.service.estimate_table import EstimateWriter  # noqa: PLC0415

                table = stack.enter_context(EstimateWriter(config.output))
            monitor = stack.enter_context(self._supervised(port, recording))
            outputs = Outputs(
                record=recording,
                table=self._rows(table, recording),
                show=self._each_turn(monitor, recording),
                checkpoint=None if keeper is None else keeper.checkpoint,
                reload=lambda: self._poll_reload(monitor, wanted=hangup()),
                stepped=monitor.stepped,
                sent=monitor.sent,
            )
            summary = serve(port, pipeline, config.loop_settings(), outputs, stop)
        emit(_LOG, logging.INFO, "service.stopped", _summary_line(pipeline, port, summary))
        if not pipeline.counts.frames:
            emit(
                _LOG,
                logging.WARNING,
                "bus.nothing_wanted",
                f"{port.name}: no expected frame arrived; check channel, bit rate and vehicle"
                " (--vehicle, or --dbc and --map)",
            )
        records = [str(path) for path in recording.written]
        output = None if table is None or table.failed else config.output
        for path in filter(None, (*records, output)):
            emit(_LOG, logging.INFO, "file.written", f"written: {path}", limit=path, path=path)
        return _summary_json(pipeline, port, summary) | {
            "state": config.state,
            "record": records[-1] if records else None,
            "records": records,
            "output": output,
        }

    def reconfigure(self) -> LoopSettings | None:
        """Read the configuration again in this process and apply it; the SoC continues.

        `run` does the same on SIGHUP or `reload`, but reads in another process meanwhile. Model,
        vehicle, method, capacity, gaps, time-outs and published ids change at once. The initial
        SoC is ignored, since the SoC is known. Other keys need a restart, which is logged.

        Returns
        -------
        LoopSettings or None
            Those of the new configuration; None if it is invalid, and the old one stays.
        """
        try:
            return self._apply(Reading.of(self._read))
        except InputError as error:
            _log_refusal(error)
            return None

    def _apply(self, new: Reading) -> LoopSettings:
        """Use another configuration as a whole; raise InputError if it does not fit."""
        settings, started = new.config.pipeline_settings(), self.pipeline.settings
        ids = replace(settings.ids, replay_clock=started.ids.replay_clock)
        self.pipeline.reconfigure(
            None if new.vehicle_key == self._vehicle_key else new.vehicle,
            new.model,
            replace(settings, ids=ids, time_source=started.time_source),
        )
        self._vehicle_key = new.vehicle_key
        _log_changes(self.config, new.config)
        self.config = new.config
        return new.config.loop_settings()

    def _written_while_running(self) -> list[Path]:
        """Return the files of which each belongs to one service only."""
        state = None if self._state is None else self._state.path
        given = (state, self.config.record, self.config.output, self.config.unix_path())
        return [Path(path) for path in given if path is not None]

    def _take_reload(self) -> bool:
        wanted = self._reload.is_set()
        self._reload.clear()
        return wanted

    def _poll_reload(self, monitor: Monitor, *, wanted: bool) -> LoopSettings | None:
        """Begin to read on request; apply what was read since the last call."""
        if wanted:
            self._reader.request()
            monitor.reload_begins(READ_WITHIN_S + START_S)
        result = self._reader.poll()
        if result is None:
            return None
        settings = None
        if isinstance(result, Reading):
            try:
                settings = self._apply(result)
            except InputError as error:
                result = error
        if isinstance(result, InputError):
            _log_refusal(result)
        else:
            monitor.identity = replace(
                monitor.identity,
                vehicle=self.pipeline.vehicle.name,
                model=self.config.model,
                method=self.pipeline.settings.estimator.method,
            )
        if not self._reader.is_reading:
            monitor.reload_ends(str(result) if isinstance(result, InputError) else "")
        return settings

    def _rows(
        self, table: EstimateWriter | None, recording: RecordControl
    ) -> Callable[[float, Estimate], None] | None:
        """Return what takes each sample's estimate: the table, the recording, both or none."""
        if not recording.keeps_estimates:
            return None if table is None else table.add
        pipeline = self.pipeline

        def add(time_s: float, estimate: Estimate) -> None:
            if table is not None:
                table.add(time_s, estimate)
            if pipeline.latest_sample is not None:
                soc_pct = pipeline.decoder.reference_soc_pct
                recording.write_estimate(pipeline.latest_sample, soc_pct, estimate)

        return add

    def _each_turn(self, monitor: Monitor, recording: RecordControl) -> Callable[[float], None]:
        def turn(now_s: float) -> None:
            is_new = monitor.turn(now_s)
            recording.tick(now_s)
            if is_new and self.on_status is not None:
                self.on_status(monitor.latest)

        return turn

    @contextmanager
    def _supervised(self, port: ReconnectingBus, recording: RecordControl) -> Iterator[Monitor]:
        """Yield the monitor, with its status served and systemd notified."""
        config, vehicle = self.config, self.pipeline.vehicle.name
        identity = Identity(
            bus=port.name,
            vehicle=vehicle,
            model=config.model,
            method=config.method,
            time_source=config.time_source,
            began_s=time.time(),
            core=self.pipeline.estimator.core,
        )
        with ExitStack() as stack:
            notifier = Notifier.from_environment()
            stack.callback(notifier.close)
            monitor = Monitor(
                self.pipeline,
                port,
                identity=identity,
                notifier=notifier,
                record=recording,
                show_every_s=SHOW_EVERY_S if config.dashboard is None else PAGE_EVERY_S,
            )
            _serve_status(config, monitor, stack)
            _publish_mqtt(config, monitor, stack)
            emit(
                _LOG,
                logging.INFO,
                "service.ready",
                f"listening on {port.name}; time source: {config.time_source}; Ctrl-C ends",
                bus=port.name,
                vehicle=vehicle,
                model=config.model,
            )
            notifier.ready(f"listening on {port.name}")
            stack.callback(notifier.stopping)
            yield monitor


def _check_output(output: Path, model: Path) -> None:
    if output.resolve() == model.resolve():
        raise InputError(
            "this output is also an input", source=output, cure="name another file for it"
        )
    refuse_pipe(output)
    check_writable(output)


def _log_refusal(error: InputError) -> None:
    text = f"new configuration refused, the old one stays: {error}"
    emit(_LOG, logging.WARNING, "config.refused", text)


def _log_changes(old: RunConfig, new: RunConfig) -> None:
    before, after = old.model_dump(), new.model_dump()
    changed = [name for name in after if after[name] != before[name]]
    text = f"configuration reloaded; changed: {', '.join(changed) or 'no option'}"
    emit(_LOG, logging.INFO, "config.reloaded", text)
    late = [
        key.name
        for key in config_keys()
        if key.info.needs_restart and _value(before, key.name) != _value(after, key.name)
    ]
    if late:
        text = f"{', '.join(late)}: takes effect after a restart of the service"
        emit(_LOG, logging.WARNING, "config.needs_restart", text)


def _value(content: Any, key: str) -> object:
    for part in key.split("."):
        content = None if content is None else content[part]
    return content


def _serve_status(config: RunConfig, monitor: Monitor, stack: ExitStack) -> None:
    unix_path = config.unix_path()
    if config.status_socket == "auto" and has_unix_sockets():
        try:
            unix_path = default_path(monitor.latest.identity.bus)
        except InputError as error:
            # Not requested explicitly: the service runs without it.
            emit(_LOG, logging.WARNING, "status.unavailable", f"no status socket: {error}")
    http = config.http_address()
    if unix_path is None and http is None:
        return
    try:
        endpoint = Endpoint(lambda: monitor.latest, unix_path=unix_path, http=http)
    except InputError as error:
        if config.status_socket != "auto" or error.field != "status_socket":
            raise
        emit(_LOG, logging.WARNING, "status.unavailable", f"no status socket: {error}")
        if http is None:
            return
        unix_path = None
        endpoint = Endpoint(lambda: monitor.latest, http=http)
    stack.enter_context(endpoint)
    if unix_path is not None:
        emit(_LOG, logging.DEBUG, "status.listening", f"status at {unix_path}", path=str(unix_path))
    if http is not None:
        emit(
            _LOG,
            logging.INFO,
            "http.listening",
            f"http://{http.host}:{endpoint.port}/metrics"
            + (", with a token" if http.token else ", without a token"),
            port=endpoint.port,
        )


def _publish_mqtt(config: RunConfig, monitor: Monitor, stack: ExitStack) -> None:
    settings = config.mqtt_settings(monitor.latest.identity.bus)
    if settings is not None:
        # An optional dependency.
        from cangauge.extras.live.mqtt import MqttPublisher  # noqa: PLC0415

        stack.enter_context(MqttPublisher(lambda: monitor.latest, settings))


def _summary_line(pipeline: Pipeline, port: ReconnectingBus, summary: RunSummary) -> str:
    """Return a run's frames, losses and last SoC in one line."""
    counts, latest = pipeline.counts, pipeline.latest
    soc = f"{number(latest.soc_pct, 2)} ± {number(latest.soc_std_pct, 2, '%')}"
    step = number(summary.step_p50_us, 0, "µs")
    return (
        f"{summary.seconds:.1f} s, {counts.frames} frames, {counts.samples} samples,"
        f" {counts.lost} lost, {counts.crc_errors} CRC errors{_bus_errors(port, summary)};"
        f" last SoC {soc} ({latest.status.name.lower()}); step {step} (median)"
    )


def _bus_errors(port: ReconnectingBus, summary: RunSummary) -> str:
    """Return the bus errors of a run, for its summary line."""
    kinds = ", ".join(f"{kind} {count}" for kind, count in port.error_kinds.most_common())
    found = {
        "dropped in the receive queue": port.queue_drops,
        f"error frames ({kinds})": port.error_frames,
        "not sent": port.unsent,
        "from another service with these ids": summary.foreign_frames,
        f"bus losses ({port.away_s:.1f} s)": port.losses,
    }
    return "".join(f", {count} {what}" for what, count in found.items() if count)


def _summary_json(pipeline: Pipeline, port: ReconnectingBus, summary: RunSummary) -> dict[str, Any]:
    """Return the summary that `--json` prints."""
    counts, latest = pipeline.counts, pipeline.latest
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
        "rival_frames": summary.foreign_frames,
        "stamps": port.capabilities.stamps,
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
        "soc_reference_pct": pipeline.decoder.reference_soc_pct,
        **(pipeline.report().to_dict() if pipeline.samples else NO_REPORT),
    }

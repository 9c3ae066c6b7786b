"""One line on a terminal that shows the running estimate, a few times a second.

Another configuration while running: all of it or nothing, and SoC goes on.

What takes effect at once: the model (also another one in the same file), the car and its files,
method, capacity, gaps, pairing, time-outs, ends, and the ids of what is published. Initial SoC and
its standard deviation are ignored: SoC is known by now. The bus, the time source, REPLAY_CLOCK's id
and the files to write stay what they are until the service is started again, and that is said.

Everything around the loop that operators need, opened in order and closed again.

What a run of the service amounted to: one line for the log, one object for `--json`.

Puts the service together from its parts, lets it run, and tells what it amounted to.
"""

from __future__ import annotations

import gc
import hashlib
import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from rich.console import Console
from rich.live import Live
from rich.text import Text

from cangauge._formatting import number
from cangauge._logging import emit, speaker
from cangauge.bus.connection import BusConnection
from cangauge.bus.reconnect import ReconnectingBus
from cangauge.bus.vehicle import Vehicle
from cangauge.cli.options import check_outputs
from cangauge.cli.output import console
from cangauge.errors import InputError
from cangauge.estimate.validity import Status, reason_names
from cangauge.model.model_file import load_model
from cangauge.service.config import RunConfig
from cangauge.service.http import Endpoint, default_path, has_unix_sockets
from cangauge.service.loop import LoopSettings, Outputs, RunSummary, serve
from cangauge.service.pipeline import Pipeline
from cangauge.service.recording import Recorder
from cangauge.service.signals import note_hangups, stop_on_signals
from cangauge.service.state import StateKeeper
from cangauge.service.status import Identity, Monitor
from cangauge.service.systemd import Notifier

# --- One line on a terminal that shows the running estimate, a few times a second

SHOW_EVERY_S: Final = 0.25

_STYLE: Final = {
    Status.INITIALISING: "yellow",
    Status.VALID: "green",
    Status.DEGRADED: "yellow",
    Status.INVALID: "red",
}


class LiveLine:
    """SoC ± standard deviation, status, voltage, residual and rate, on a terminal.

    Parameters
    ----------
    console : rich.console.Console
    gauge : Pipeline
    trouble : callable, optional
        Returns what is wrong with the bus, in words; empty if nothing is.
    """

    def __init__(
        self, console: Console, gauge: Pipeline, trouble: Callable[[], str] | None = None
    ) -> None:
        self._gauge = gauge
        self._trouble = trouble
        # Without a thread of its own: it is drawn when it is told to.
        self._live = Live(console=console, auto_refresh=False, transient=True)
        self._due_s = 0.0
        self._last: tuple[float, int] | None = None
        self._rate = 0.0

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._live.stop()

    def show(self, now_s: float) -> None:
        """Draw if it is time to (monotonic clock [s])."""
        if now_s < self._due_s:
            return
        self._due_s = now_s + SHOW_EVERY_S
        samples = self._gauge.samples
        if self._last is not None and now_s > self._last[0]:
            self._rate = (samples - self._last[1]) / (now_s - self._last[0])
        self._last = (now_s, samples)
        text = live_text(self._gauge, self._rate)
        if self._trouble is not None and (trouble := self._trouble()):
            text.append(f"  {trouble}", style="bold red")
        self._live.update(text, refresh=True)


def live_text(gauge: Pipeline, samples_per_s: float) -> Text:
    """Return the line."""
    estimate = gauge.latest
    text = Text("SoC ", no_wrap=True, overflow="ellipsis")
    soc = f"{number(estimate.soc_pct, 2)} ± {number(estimate.soc_std_pct, 2, '%')}"
    text.append(soc, style="bold")
    status = estimate.status.name.lower()
    why = reason_names(int(estimate.reasons))
    text.append("  ")
    text.append(status, style=_STYLE[estimate.status])
    if why:
        text.append(f" ({why})", style="dim")
    sample = gauge.latest_sample
    if sample is not None:
        residual = number(1e3 * estimate.residual_v, 0, "mV")
        text.append(f"  {number(sample.voltage_v, 2, 'V')}  residual {residual}")
    text.append(f"  {samples_per_s:.0f} samples/s")
    return text


# --- Another configuration while running: all of it or nothing, and SoC goes on

NEEDS_RESTART: Final = (
    "interface",
    "channel",
    "bus_options",
    "wait_for_bus",
    "time_source",
    "record",
    "output",
    "state",
    "state_max_age_s",
    "record_part_mb",
    "record_part_s",
    "record_keep_mb",
    "http",
    "http_token_file",
    "status_socket",
    "log_format",
    "log_level",
)
"""What stays as it was at the start."""


class Reloader:
    """Gives a gauge another configuration.

    Parameters
    ----------
    read : callable
        Returns the configuration as it now stands; may raise InputError.
    config : RunConfig
        The one that the gauge was made of.
    vehicle : Vehicle
        Likewise.
    gauge : Pipeline
    say : callable
        Takes a line of text.

    Attributes
    ----------
    config : RunConfig
        The configuration in use, but for what needs a restart.
    """

    def __init__(
        self,
        read: Callable[[], RunConfig],
        config: RunConfig,
        vehicle: Vehicle,
        gauge: Pipeline,
        say: Callable[[str], None],
    ) -> None:
        self._read = read
        self.config = config
        self._gauge = gauge
        self._say = say
        self._vehicle_key = _vehicle_key(config, vehicle)

    def reload(self) -> LoopSettings | None:
        """Read and apply; return the loop's settings, or None if the old configuration stays.

        Whatever is wrong with the new one is said in one line.
        """
        try:
            config = self._read()
            vehicle, model = config.load_vehicle(), load_model(config.model)
            key = _vehicle_key(config, vehicle)
            settings = config.gauge_settings()
            started = self._gauge.settings
            ids = replace(settings.ids, replay_clock=started.ids.replay_clock)
            self._gauge.reconfigure(
                None if key == self._vehicle_key else vehicle,
                model,
                replace(settings, ids=ids, time_source=started.time_source),
            )
        except (InputError, OSError) as error:  # OSError: a file went while it was read
            self._say(f"warning: new configuration refused, the old one goes on: {error}")
            return None
        self._vehicle_key = key
        self._tell(config)
        self.config = config
        return config.loop_settings()

    def _tell(self, config: RunConfig) -> None:
        old, new = self.config.model_dump(), config.model_dump()
        changed = [name for name in new if new[name] != old[name]]
        self._say(f"configuration read again; changed: {', '.join(changed) or 'no option'}")
        late = [name for name in changed if name in NEEDS_RESTART]
        if self.config.ids.replay_clock != config.ids.replay_clock:
            late.append("ids.replay_clock")
        if late:
            self._say(f"warning: {', '.join(late)}: takes effect when the service starts again")


def _vehicle_key(config: RunConfig, vehicle: Vehicle) -> tuple[object, ...]:
    """Return what tells a vehicle from another: what it is made of, files by their content."""
    files = [*vehicle.dbc_files, *([config.map] if config.map is not None else [])]
    contents = tuple(hashlib.sha256(Path(file).read_bytes()).hexdigest() for file in files)
    chosen = (config.messages, config.rules, config.checks)
    return (config.vehicle, config.temperature, config.pair_within_s, chosen, *contents)


# --- Everything around the loop that operators need, opened in order and closed again

_LOG = logging.getLogger(__name__)


@contextmanager
def operated(
    config: RunConfig, vehicle: str, gauge: Pipeline, port: BusConnection, recorder: Recorder | None
) -> Iterator[Monitor]:
    """Yield the monitor of a service whose status is served and of which systemd knows.

    Raises
    ------
    InputError
        If something was asked for that cannot be served. A status socket that nobody asked for
        is done without.
    """
    identity = Identity(
        bus=port.name,
        vehicle=vehicle,
        model=config.model,
        method=config.method,
        time_source=config.time_source,
        began_s=time.time(),
    )
    with ExitStack() as stack:
        notifier = Notifier.from_environment()
        stack.callback(notifier.close)
        monitor = Monitor(gauge, port, identity=identity, notifier=notifier, record=recorder)
        _serve(config, monitor, stack)
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


def _serve(config: RunConfig, monitor: Monitor, stack: ExitStack) -> None:
    unix_path = config.unix_path()
    if config.status_socket == "auto" and has_unix_sockets():
        try:
            unix_path = default_path(monitor.latest.identity.bus)
        except InputError as error:
            emit(_LOG, logging.WARNING, "status.unavailable", f"no status socket: {error}")
    http = config.http_address()
    if unix_path is None and http is None:
        return
    endpoint = Endpoint(lambda: monitor.latest, unix_path=unix_path, http=http)
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


# --- What a run of the service amounted to: one line for the log, one object for `--json`


def summary_line(gauge: Pipeline, port: ReconnectingBus, summary: RunSummary) -> str:
    """Return the line: frames, losses, the last SoC."""
    counts, latest = gauge.counts, gauge.latest
    soc = f"{number(latest.soc_pct, 2)} ± {number(latest.soc_std_pct, 2, '%')}"
    step = number(summary.step_p50_us, 0, "µs")
    return (
        f"{summary.seconds:.1f} s, {counts.frames} frames, {counts.samples} samples,"
        f" {counts.lost} lost, {counts.crc_errors} CRC errors{_troubles(port, summary)};"
        f" last SoC {soc} ({latest.status.name.lower()}); step {step} (median)"
    )


def _troubles(port: ReconnectingBus, summary: RunSummary) -> str:
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


def summary_json(gauge: Pipeline, port: ReconnectingBus, summary: RunSummary) -> dict[str, Any]:
    """Return the object."""
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
        "soc_reference_pct": gauge.decoder.reference_soc_pct,
    }


# --- Puts the service together from its parts, lets it run, and tells what it amounted to

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
    gauge = Pipeline(vehicle, load_model(config.model), config.gauge_settings())
    reloader = Reloader(read, config, vehicle, gauge, _voice("config.reload"))
    address = config.address()
    # All that is loaded by now stays until the end. Left out of garbage collection, it costs no
    # pauses meanwhile, and at the end not the second or so of taking it apart.
    gc.freeze()
    with ExitStack() as stack:
        # Signals first: whoever starts the service may end it at any moment after.
        stop = stack.enter_context(stop_on_signals())
        hangup = stack.enter_context(note_hangups())
        port = stack.enter_context(ReconnectingBus(address, gauge.filters, _voice("bus.notice")))
        port.open(wait=config.wait_for_bus)
        recorder = table = line = keeper = None
        if kept is not None:
            keeper = stack.enter_context(StateKeeper(kept, gauge, _voice("state.notice")))
        if config.record is not None:
            recorder = stack.enter_context(Recorder(config.record, config.record_limits()))
        if config.output is not None:
            # pyarrow is slow to import, and few services write a table.
            from cangauge.service.estimate_table import EstimateWriter  # noqa: PLC0415

            table = stack.enter_context(EstimateWriter(config.output, _voice("file.failed")))
        monitor = stack.enter_context(operated(config, vehicle.name, gauge, port, recorder))
        if console.is_terminal:
            line = stack.enter_context(LiveLine(console, gauge, lambda: port.trouble))
        outputs = Outputs(
            record=recorder,
            table=None if table is None else table.add,
            show=_each_turn(monitor, recorder, line),
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


def _reload(reloader: Reloader, monitor: Monitor, gauge: Pipeline) -> LoopSettings | None:
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

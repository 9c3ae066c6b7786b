"""Shared by the tests of the service: a short drive, a model, services in threads, commands."""

from __future__ import annotations

import contextlib
import errno
import io
import json
import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import can
import numpy as np
import pytest

from cangauge._resources import shared_file
from cangauge.bus.connection import BusConnection
from cangauge.bus.database import SignalCodec
from cangauge.bus.open import BusAddress, open_bus
from cangauge.bus.time_source import MICROSECONDS
from cangauge.bus.vehicle import LOG_COLUMNS, Vehicle
from cangauge.cli.app import main
from cangauge.estimation.offline import samples_of
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.config import RunConfig
from cangauge.service.events import RateLimitedHandler
from cangauge.service.loop import Loop
from cangauge.service.output import Output
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.service.status import Monitor
from cangauge.types import Estimate, Sample
from synthetic import synthetic_log

PATIENCE_S = 300.0
"""Longest wait for what must happen [s]: only what never happens reaches it, beside any load."""
COMMAND = "from cangauge.__main__ import main; main()"


def leaf_model_path() -> Path:
    return shared_file("replay", "leaf2012_published_model.json")


def leaf_model() -> Model:
    return Model.load(leaf_model_path())


def short_log(seconds: float = 100.0, rate_hz: float = 10.0, *, noise_v: float = 0.3) -> Log:
    """Return a drive from 80 %, in values with many digits, so that quantization shows."""
    return synthetic_log(
        hours=seconds / 3600.0,
        rate_hz=rate_hz,
        start_pct=80.0,
        end_pct=80.0 - 0.01 * seconds,
        noise_v=noise_v,
        seed=3,
    )


def frames_of(log: Log, vehicle: Vehicle | None = None, shift_s: float = 0.0) -> list[can.Message]:
    """Return the frames that carry a log, stamped with its time and a shift [s]."""
    encoder = FrameEncoder(vehicle or Vehicle.load("generic"))
    samples = (each._replace(time_s=each.time_s + shift_s) for each in samples_of(log))
    return [frame for sample in samples for frame in encoder.encode(sample)]


class LoggedLines(RateLimitedHandler):
    """Lines that a service would write, rate-limited as there; warnings begin with "warning: ".

    Parameters
    ----------
    logger : str
    thread : threading.Thread, optional
        Keep the lines of this thread only.
    """

    def __init__(self, logger: str = "cangauge", thread: threading.Thread | None = None) -> None:
        super().__init__()
        self.setLevel(logging.INFO)
        self._logger = logging.getLogger(logger)
        self._level = self._logger.level
        self._thread = thread
        self.lines: list[str] = []

    def __enter__(self) -> Self:
        self._logger.setLevel(logging.INFO)
        self._logger.addHandler(self)
        return self

    def __exit__(self, *_: object) -> None:
        self._logger.removeHandler(self)
        self._logger.setLevel(self._level)
        self.release_due(everything=True)

    def filter(self, record: logging.LogRecord) -> bool:
        """Leave out other threads before the rate limit, which their lines would use up."""
        return self._thread is None or record.thread == self._thread.ident

    def emit(self, record: logging.LogRecord) -> None:
        begin = "warning: " if record.levelno >= logging.WARNING else ""
        self.lines.append(begin + record.getMessage())


@dataclass
class Rows(Output):
    """Collects times and estimates of samples."""

    rows: list[tuple[float, Estimate]]

    def on_sample(self, sample: Sample, estimate: Estimate) -> None:
        self.rows.append((sample.time_s, estimate))


@dataclass
class Service:
    """The loop in a thread; collects estimates and warnings."""

    port: BusConnection
    pipeline: Pipeline
    config: RunConfig
    record: Any = None
    checkpoint: Callable[[], None] = lambda: None
    rows: list[tuple[float, Estimate]] = field(default_factory=list)
    error: BaseException | None = None

    def __enter__(self) -> Self:
        self.monitor = Monitor(self.pipeline, self.port)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._logged = LoggedLines("cangauge.service.loop", self._thread)
        self._logged.__enter__()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    @property
    def warnings(self) -> list[str]:
        """Lines of the loop."""
        return self._logged.lines

    def end(self) -> None:
        self._stop.set()
        self._thread.join(PATIENCE_S)
        self._logged.__exit__()
        self.port.close()
        assert not self._thread.is_alive()

    def join(self, seconds: float = PATIENCE_S) -> None:
        self._thread.join(seconds)
        assert not self._thread.is_alive()

    def _run(self) -> None:
        try:
            loop = Loop(
                self.port,
                self.pipeline,
                self.config,
                outputs=[Rows(self.rows), *([self.record] if self.record else [])],
                monitor=self.monitor,
                checkpoint=self.checkpoint,
            )
            loop.run(self._stop.is_set)
        except Exception as error:  # noqa: BLE001 - for the test to look at
            self.error = error


def loop_config(**keys: Any) -> RunConfig:
    """Return a configuration for a loop, whose pipeline has the model already."""
    return RunConfig(model="-", **keys)


def virtual_port(channel: str, filters: Sequence[Any] | None = None) -> BusConnection:
    address = BusAddress("virtual", channel)
    return BusConnection(open_bus(address, filters), address)


def virtual_service(
    channel: str,
    settings: PipelineSettings | None = None,
    vehicle: Vehicle | None = None,
    record: Any = None,
    **config: Any,
) -> Service:
    pipeline = Pipeline(vehicle or Vehicle.load("generic"), leaf_model(), settings)
    port = virtual_port(channel, pipeline.filters)
    return Service(port, pipeline, loop_config(**config), record)


class BrokenBus:
    """A bus whose calls fail as a driver's do."""

    protocol = can.CanProtocol.CAN_20

    def __init__(self, receiving: list[object], sending: BaseException | None = None) -> None:
        self._receiving = receiving
        self._sending = sending
        self.sent: list[can.Message] = []
        self.filters: object = None
        self.closed = 0

    def recv(self, timeout: float | None) -> can.Message | None:
        if not self._receiving:
            time.sleep(timeout or 0.0)
            return None
        first = self._receiving.pop(0)
        if isinstance(first, BaseException):
            raise first
        return first  # type: ignore[return-value] # a message or None

    def send(self, message: can.Message) -> None:
        if self._sending is not None:
            raise self._sending
        self.sent.append(message)

    def set_filters(self, filters: object) -> None:
        self.filters = filters

    def fileno(self) -> int:
        raise NotImplementedError

    def shutdown(self) -> None:
        self.closed += 1


def same_frames(found: list[can.Message], expected: list[can.Message]) -> bool:
    """Return whether two lists hold the same frames: every field, stamps bit for bit."""
    fields = [name for name in can.Message.__slots__ if name != "__weakref__"]
    values = [
        [[getattr(each, name) for name in fields] for each in some] for some in (found, expected)
    ]
    return values[0] == values[1]


def unpack_error() -> can.CanOperationError:
    error = can.CanOperationError("could not unpack received message")
    error.__cause__ = ValueError("junk")
    return error


def network_down() -> can.CanOperationError:
    error = can.CanOperationError("Failed to receive: Network is down", errno.ENETDOWN)
    error.__cause__ = OSError(errno.ENETDOWN, "Network is down")
    return error


def never() -> bool:
    return False


def collect(port: BusConnection, seconds: float) -> list[can.Message]:
    """Return all frames that arrive within that time."""
    until = time.monotonic() + seconds
    found = []
    while (left := until - time.monotonic()) > 0.0:
        message = port.receive(left)
        if message is not None:
            found.append(message)
    return found


@dataclass
class Ended:
    code: int
    out: str
    err: str

    @property
    def json(self) -> dict[str, Any]:
        result: dict[str, Any] = json.loads(self.out)
        return result


class Command:
    """A `cangauge` command in another process."""

    def __init__(self, *arguments: object) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", COMMAND, *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "COLUMNS": "200"},
            start_new_session=True,  # without a terminal, as systemd starts it
        )
        self.lines: list[str] = []

    def wait_for(self, text: str, seconds: float = PATIENCE_S) -> None:
        """Wait for a text on stderr; a process that never writes it is killed."""
        assert self.process.stderr is not None
        deadline = threading.Timer(seconds, self.process.kill)
        deadline.start()
        try:
            for line in self.process.stderr:
                self.lines.append(line)
                if text in line:
                    return
        finally:
            deadline.cancel()
        raise AssertionError(f"ended without {text!r}: {''.join(self.lines)}")

    def end(self, seconds: float = PATIENCE_S) -> Ended:
        try:
            out, err = self.process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            self.process.kill()
            out, err = self.process.communicate()
            raise AssertionError(f"did not end: {''.join(self.lines)}{err}") from None
        return Ended(self.process.returncode, out, "".join(self.lines) + err)


def run_to_end(*arguments: object, seconds: float = PATIENCE_S) -> Ended:
    return Command(*arguments).end(seconds)


def in_process(*arguments: object) -> Ended:
    """Run a short command in this process."""
    out, err = io.StringIO(), io.StringIO()
    code: object = 0
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        patch.setattr(sys, "argv", ["cangauge", *map(str, arguments)])
        try:
            main()
        except SystemExit as end:
            code = end.code
    assert isinstance(code, int)
    return Ended(code, out.getvalue(), err.getvalue())


def succeeds(*arguments: object) -> Ended:
    """Run a short command in this process that must end with exit code 0."""
    ended = in_process(*arguments)
    assert ended.code == 0, ended.err
    return ended


def refused(ended: Ended, *words: str) -> None:
    """Check for exit code 2, an empty stdout, and one line of error that has these words."""
    assert (ended.code, ended.out) == (2, ""), ended
    errors = [line for line in ended.err.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1, ended.err
    assert "Traceback" not in ended.err
    for word in words:
        assert word in errors[0]


def waits(condition: Callable[[], bool], seconds: float = PATIENCE_S) -> bool:
    """Return whether a condition becomes true in time."""
    until = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > until:
            return False
        time.sleep(0.005)
    return True


def quantized(vehicle: Vehicle, log: Log) -> Log:
    """Return the log as decoded from a vehicle's frames with REPLAY_CLOCK, bit for bit.

    A vehicle without a temperature signal gives its fixed temperature, or the log's if it has none.
    """
    columns = {LOG_COLUMNS[signal.role]: signal for signal in vehicle.signals}
    sent: dict[str, Any] = {
        column: np.array([_sent(signal.codec, value) for value in values.tolist()])
        for column, signal in columns.items()
        if (values := getattr(log, column)) is not None
    }
    if vehicle.fixed_temperature_c is not None:
        sent["temperature_c"] = np.full(len(log), vehicle.fixed_temperature_c)
    return replace(log, time_s=np.rint(log.time_s * MICROSECONDS) / MICROSECONDS, **sent)


def _sent(codec: SignalCodec, value: float) -> float:
    payload = bytearray(64)
    codec.encode_into(payload, value)
    return codec.decode(payload)

"""The wall: what speaks to networks runs in a process of its own, started and watched from here.

Page, `/status`, `/metrics` and MQTT share that process (`process`). It inherits the listening
sockets, takes snapshots as lines on stdin, and writes lines on stdout: that it is alive, and its
log. It can ask the service for nothing. One that ends, is silent for too long, or grows too large
is ended and started again. The estimate does not notice.
"""

from __future__ import annotations

import json
import logging
import os
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from tornado.netutil import bind_sockets

from cangauge._logging import emit
from cangauge.errors import InputError
from cangauge.extras.live.addresses import HttpAddress, MqttOptions, http_address, mqtt_options
from cangauge.service.output import Output
from cangauge.service.setup import address_of
from cangauge.service.status_client import Snapshot
from cangauge.service.worker import start_thread

if TYPE_CHECKING:
    from cangauge.bus.vehicle import Vehicle
    from cangauge.service.config import RunConfig
    from cangauge.service.run import Service

SILENT_S: Final = 60.0
"""Silence after which the process counts as hanging [s]. It says each second that it is alive; a
small or busy computer takes half a minute to start it."""
LARGEST_BYTES: Final = 512 << 20
"""Resident memory above which it is ended: three times what the page needs."""
PAUSE_S: Final = (1.0, 60.0)
"""First and longest pause before it is started again, doubled each time [s]. One that has run for
the longest begins with the first again."""
END_WITHIN_S: Final = 0.5
"""Time limit for the process to end by itself [s]."""
_MOST_BYTES: Final = 1 << 16
"""Longest line of the process, and most that it may write in a second [bytes]: far more than it
does, and too little to cost the estimate time."""

_LOG = logging.getLogger(__name__)


class Live(Output):
    """What a service offers over networks.

    A thread sends the latest snapshot and drops those that come while it sends, so that
    `on_snapshot` never waits. The constructor opens the sockets, so that errors show at once.

    Parameters
    ----------
    http : HttpAddress, optional
        Of `/status`, `/healthz` and `/metrics`.
    dashboard : HttpAddress, optional
        Of the live page.
    mqtt : MqttOptions, optional
        Broker, and what to publish there.

    Attributes
    ----------
    port : int
        TCP port of the first of `dashboard` and `http`; 0 without either.
    trouble : str
        How often the process has ended and why at last; "" while it never has.
    pid : int or None
        Of the process, while it runs.

    Raises
    ------
    InputError
        If an address cannot be bound, or the system cannot hand sockets to another process.
    """

    def __init__(
        self,
        *,
        http: HttpAddress | None = None,
        dashboard: HttpAddress | None = None,
        mqtt: MqttOptions | None = None,
    ) -> None:
        if os.name != "posix":
            problem = "page, status by HTTP and MQTT need Linux or macOS"
            raise InputError(problem, field="dashboard", cure="run without them")
        self._asks: dict[str, Any] = {"level": _LOG.getEffectiveLevel()}
        self._sockets: list[socket.socket] = []
        for key, address in (("dashboard", dashboard), ("http", http)):
            if address is not None:
                sockets = _listen(key, address)
                self._sockets += sockets
                numbers = [each.fileno() for each in sockets]
                self._asks[key] = {"token": address.token, "sockets": numbers}
        self.port = int(self._sockets[0].getsockname()[1]) if self._sockets else 0
        if mqtt is not None:
            self._asks["mqtt"] = mqtt
        self._latest: Snapshot | None = None
        self._done = threading.Event()
        self._woken, self._wake = os.pipe()
        os.set_blocking(self._wake, False)
        self.trouble = ""
        self.pid: int | None = None
        self._thread = start_thread(self._run, "cangauge-live")

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Make a snapshot the latest one; returns at once."""
        self._latest = snapshot
        with suppress(BlockingIOError):  # a full pipe wakes as well
            os.write(self._wake, b"\n")

    def close(self) -> None:
        """End the process."""
        self._done.set()
        with suppress(BlockingIOError):
            os.write(self._wake, b"\n")
        self._thread.join(3.0 * END_WITHIN_S)
        for each in self._sockets:
            each.close()

    def _run(self) -> None:
        """Keep the process running until `close`."""
        ended, pause_s = 0, PAUSE_S[0]
        while not self._done.is_set():
            began_s = time.monotonic()
            try:
                why = self._serve()
            except BrokenPipeError:
                why = "it ended by itself"
            except Exception as error:  # noqa: BLE001 - no process, or lines that are not ours
                why = f"it failed: {error!r}"
            if self._done.is_set():
                return
            ended += 1
            pause_s = PAUSE_S[0] if time.monotonic() - began_s > PAUSE_S[1] else pause_s
            self.trouble = (
                f"what serves {self._names} has ended: {why}. It is started again ({ended} so far);"
                " the estimate continues"
            )
            emit(_LOG, logging.WARNING, "live.ended", self.trouble, retry_s=pause_s)
            self._done.wait(pause_s)
            pause_s = min(2.0 * pause_s, PAUSE_S[1])

    @property
    def _names(self) -> str:
        words = {"dashboard": "the live page", "http": "the status", "mqtt": "MQTT"}
        return " and ".join(word for key, word in words.items() if key in self._asks)

    def _serve(self) -> str:
        """Start the process and feed it; return why it has ended, or had to be."""
        with _process([each.fileno() for each in self._sockets]) as (self.pid, into, out):
            pending, received = _line(self._asks), _Received()
            while not self._done.is_set():
                if not pending and self._latest is not None:
                    snapshot, self._latest = self._latest, None
                    pending = _line({"made_s": snapshot.made_s, "status": snapshot.status})
                writes = [into] if pending else []
                readable, writable, _ = select.select([self._woken, out], writes, [], 1.0)
                if self._woken in readable:
                    os.read(self._woken, 4096)
                if out in readable:  # before what is written: it may have said why it ended
                    if not (data := os.read(out, _MOST_BYTES)):
                        return "it ended by itself"
                    for each in received.lines(data):
                        self._hear(json.loads(each))
                if writable:
                    pending = pending[os.write(into, pending) :]
                if why := received.trouble():
                    return why
                if (size := _resident_bytes(self.pid)) > LARGEST_BYTES:
                    return f"it took {size >> 20} MiB of memory"
        return ""

    def _hear(self, told: dict[str, Any]) -> None:
        """Take a line of the process."""
        if (log := told.get("log")) is None:
            return
        extra = {name: log[name] for name in ("event", "limit", "fields")}
        # Of its logger's name, without a logger: these are never freed.
        line = (log["logger"], log["level"], __file__, 0, "%s", (log["text"],), None)
        if _LOG.isEnabledFor(log["level"]):
            _LOG.handle(_LOG.makeRecord(*line, extra=extra))


class _Received:
    """What the process has written: lines, and whether it is silent or floods."""

    def __init__(self) -> None:
        self._rest = b""
        self._heard_s = self._second_s = time.monotonic()
        self._bytes = 0  # since `_second_s`

    def lines(self, data: bytes) -> list[bytes]:
        """Add what was read; return the lines that are whole by it."""
        self._heard_s = time.monotonic()
        if self._heard_s - self._second_s > 1.0:
            self._second_s, self._bytes = self._heard_s, 0
        self._bytes += len(data)
        *whole, self._rest = (self._rest + data).split(b"\n")
        return whole

    def trouble(self) -> str:
        """Return why the process must be ended; "" while it need not."""
        if max(self._bytes, len(self._rest)) > _MOST_BYTES:
            return f"it wrote more than {_MOST_BYTES >> 10} KiB in a line or a second"
        if time.monotonic() - self._heard_s > SILENT_S:
            return f"it did not answer for {SILENT_S:g} s"
        return ""


@contextmanager
def _process(sockets: Sequence[int]) -> Iterator[tuple[int, int, int]]:
    """Run the process; yield its pid and the descriptors of its stdin and stdout."""
    process = subprocess.Popen(
        # -P: modules do not come from the working folder
        [sys.executable, "-P", "-m", "cangauge.extras.live.process"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        pass_fds=sockets,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    assert process.stdin is not None  # noqa: S101 - as it was made
    assert process.stdout is not None  # noqa: S101
    os.set_blocking(process.stdin.fileno(), False)
    try:
        yield process.pid, process.stdin.fileno(), process.stdout.fileno()
    finally:
        with suppress(OSError):  # what is still to be written is lost
            process.stdin.close()
        with suppress(subprocess.TimeoutExpired):
            process.wait(END_WITHIN_S)
        process.kill()
        process.wait()
        process.stdout.close()


def _line(content: object) -> bytes:
    return json.dumps(content, default=asdict).encode() + b"\n"


def _resident_bytes(pid: int) -> int:
    """Return the resident memory of a process; 0 where the system does not tell."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


def _listen(key: str, address: HttpAddress) -> list[socket.socket]:
    """Return listening sockets of a key's address; raise InputError if they cannot be bound."""
    try:
        sockets = bind_sockets(address.port, address.host)
    except (OSError, UnicodeError) as error:
        raise InputError(
            f"cannot listen: {getattr(error, 'strerror', None) or error}",
            field=key,
            value=str(address),
            cure="choose another port",
        ) from error
    port = sockets[0].getsockname()[1]
    url = f"http://{replace(address, port=port)}/"
    url = f"live page: {url}" if key == "dashboard" else f"{url}status"
    text = f"{url}, {'with' if address.token else 'without'} a token"
    emit(_LOG, logging.INFO, f"{key}.listening", text, port=port)
    return sockets


def output_of(config: RunConfig, _vehicle: Vehicle) -> Callable[[Service], Live]:
    """Read addresses and secrets of a configuration; may raise InputError."""
    address = {
        key: http_address(str(getattr(config, key)), config.http_token_file, field=key)
        for key in ("http", "dashboard")
        if getattr(config, key) is not None
    }
    mqtt = None if config.mqtt is None else mqtt_options(config.mqtt, str(address_of(config)))
    return lambda _: Live(**address, mqtt=mqtt)

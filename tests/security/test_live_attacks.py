"""One service under attack by its clients and its signals: frames go on, and it ends."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import can
import pytest

from cangauge.bus.vehicle import Vehicle
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.state import FILE_NAME
from cangauge.service.status_client import fetch_status
from cangauge.types import Sample
from faults.large_dbc import write_large_dbc
from live import Command, leaf_model_path, waits

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
GROUP = "239.74.163.81"
PORT = 46_000 + os.getpid() % 900
LONGEST_GAP_S = 0.6
"""Between two SOC frames, less the time for which others had the processor [s]; they are sent every
0.1 s."""


def waited_s(pid: int) -> float:
    """Return how long the threads of a process were ready to run, and others ran [s]."""
    files = Path(f"/proc/{pid}/task").glob("*/schedstat")
    return sum(int(path.read_text().split()[1]) for path in files) / 1e9


class Target:
    """A service with all its files, a car that sends, and a listener."""

    def __init__(self, folder: Path) -> None:
        self.config, self.state = folder / "run.toml", folder / "state" / FILE_NAME
        self.recordings, self.socket = folder / "recordings", folder / "status.sock"
        for each in (self.state.parent, self.recordings):
            each.mkdir()
        self.good = (
            f'model = "{leaf_model_path()}"\ninterface = "udp_multicast"\nchannel = "{GROUP}"\n'
            f'initial_soc = 80\nstate = "state/{FILE_NAME}"\nstate_every_s = 0.1\n'
            f'record = "recordings/r.log"\nrecord_part_mb = 0.002\n'
            f'status_socket = "{self.socket}"\n'
            f'http = "127.0.0.1:{PORT}"\n[bus_options]\nport = {PORT}\n'
        )
        self.config.write_text(self.good)
        self.service = Command("run", "--config", self.config)
        self.seen_s: list[float] = []
        self._over = threading.Event()
        self._threads = [threading.Thread(target=each) for each in (self._drive, self._listen)]
        for thread in self._threads:
            thread.start()
        assert waits(lambda: len(self.seen_s) > 3)

    def _drive(self) -> None:
        encoder, number = FrameEncoder(Vehicle.load("generic")), 0
        with can.Bus(interface="udp_multicast", channel=GROUP, port=PORT) as bus:
            while not self._over.wait(0.05):
                number += 1
                sample = Sample(0.05 * number, 10.0 + number % 5, 380.0 - 0.1 * (number % 7), 25.0)
                for frame in encoder.encode(sample):
                    bus.send(frame)

    def _listen(self) -> None:
        with can.Bus(interface="udp_multicast", channel=GROUP, port=PORT) as bus:
            while not self._over.is_set():
                message = bus.recv(0.1)
                if message is not None and message.arbitration_id == 0x5A0:
                    self.seen_s.append(time.monotonic())

    def close(self) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join()
        self.service.process.kill()

    def holds(
        self,
        attack: str,
        seconds: float = 0.4,
        until: Callable[[], bool] = lambda: True,
        longest_gap_s: float = LONGEST_GAP_S,
    ) -> None:
        """Check that frames come during and after an attack."""
        pids = (self.service.process.pid, os.getpid())
        began_s, before_s = time.monotonic(), sum(map(waited_s, pids))
        time.sleep(seconds)
        assert waits(until), attack
        assert self.service.process.poll() is None, attack
        longest_gap_s += sum(map(waited_s, pids)) - before_s
        recent = [each for each in self.seen_s if each >= began_s - longest_gap_s]
        gaps = [b - a for a, b in zip(recent, [*recent[1:], time.monotonic()], strict=True)]
        assert max(gaps, default=9.0) < longest_gap_s, attack

    def status(self) -> dict[str, Any]:
        return fetch_status(self.socket)


@pytest.fixture
def target(tmp_path: Path) -> Iterator[Target]:
    target = Target(tmp_path)
    yield target
    target.close()


JUNK = {
    "endless headers": b"GET /status HTTP/1.1\r\n" + b"X: y\r\n" * 200_000,
    "long header": b"GET /status HTTP/1.1\r\nX: " + b"y" * 2_000_000,
    "long path": b"GET /" + b"a" * 2_000_000,
    "pipelined": b"GET /healthz HTTP/1.1\r\n\r\n" * 3_000,
    "endless chunks": b"POST /status HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n"
    + b"1\r\nx\r\n" * 100_000,
    "huge length": b"POST /status HTTP/1.1\r\nContent-Length: 99999999999999999999\r\n\r\n",
    "negative length": b"POST /status HTTP/1.1\r\nContent-Length: -5\r\n\r\nxxxxx",
    "TLS": b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(500),
    "HTTP/2": b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes(100),
    "zeros": bytes(1_000_000),
    "other host": b"GET http://evil.example/status HTTP/1.1\r\nHost: evil.example\r\n\r\n",
}


def test_frames_go_on_under_attack(target: Target, tmp_path: Path) -> None:
    assert waits(target.state.exists)
    shutil.rmtree(target.state.parent)
    target.holds("state's folder removed", 0.25)
    target.state.parent.mkdir()
    assert waits(target.state.exists)

    shutil.rmtree(target.recordings)
    problem = lambda: bool(target.status()["record"]["problem"])  # noqa: E731
    target.holds("the recording's folder removed", 0.3, problem)
    target.recordings.mkdir()

    for name, junk in JUNK.items():
        for family, address in (
            (socket.AF_INET, ("127.0.0.1", PORT)),
            (socket.AF_UNIX, str(target.socket)),
        ):
            with socket.socket(family) as client, suppress(OSError):
                client.settimeout(0.5)
                client.connect(address)
                client.sendall(junk)
        target.holds(f"client: {name}", 0.05)
    assert target.status()["running"]

    for _ in range(200):
        target.service.process.send_signal(signal.SIGHUP)
        time.sleep(0.002)
    target.holds("hangups", 0.3, lambda: not target.status()["config"]["reloading"])

    write_large_dbc(tmp_path, 0.5)
    large = 'dbc = "large.dbc"\nmap = "map.toml"\n[bus_options]'
    target.config.write_text(target.good.replace("[bus_options]", large))
    target.service.process.send_signal(signal.SIGHUP)
    # Its reader shares the interpreter with the loop for seconds.
    is_read = lambda: target.status()["vehicle"] == "car of a large DBC"  # noqa: E731
    target.holds("a large DBC", 0.3, is_read, longest_gap_s=1.0)
    assert target.status()["config"] == {"reloading": False, "problem": None}
    target.service.process.terminate()
    ended = target.service.end()
    assert ended.code == 0, ended.err
    assert "Traceback" not in ended.err

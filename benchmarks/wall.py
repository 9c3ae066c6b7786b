"""Attack what a service offers over networks, and measure whether its frames notice.

    python benchmarks/wall.py [--seconds 8]

A service with live page, status by HTTP and MQTT publishes SOC_ESTIMATE every 0.1 s. Each row of
the table is an attack: the longest interval between two of these frames, and the growth of the
estimator's memory. Page, HTTP and MQTT are served by `cangauge live`, a program of its own. Exit
status 1 if a frame came later than 0.15 s, or the memory grew by more than 5 %.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path

import can
from rich.table import Table

from cangauge.bus.vehicle import Vehicle
from cangauge.replay.encoder import FrameEncoder
from cangauge.types import Sample
from figures import publish

ROOT = Path(__file__).resolve().parents[1]
GROUP, PORT = "239.74.163.82", 46_950
LONGEST_S, LARGEST_GROWTH = 0.15, 0.05


class Broker:
    """An MQTT broker that accepts, and then attacks with what is chosen."""

    def __init__(self) -> None:
        self.server = socket.create_server(("127.0.0.1", 0))
        self.port = self.server.getsockname()[1]
        self.attack: Callable[[socket.socket], None] | None = None
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            client, _ = self.server.accept()
            threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        with client, suppress(OSError):
            client.recv(4096)
            client.sendall(b"\x20\x02\x00\x00")  # CONNACK
            while True:
                if self.attack is not None:
                    self.attack(client)
                time.sleep(0.05)


def never_released(client: socket.socket) -> None:
    """Send messages of QoS 2 that are never released."""
    payload = b"x" * 60_000
    for number in range(1, 65_536):
        body = b"\x00\x01t" + number.to_bytes(2, "big") + payload
        client.sendall(b"\x34" + _length(len(body)) + body)


def one_large(client: socket.socket) -> None:
    """Send one message of 200 MB."""
    size = 200_000_000
    client.sendall(b"\x30" + _length(size) + b"\x00\x01t")
    for _ in range(size // 100_000):
        client.sendall(b"x" * 100_000)


def _length(number: int) -> bytes:
    found = bytearray()
    while True:
        number, low = divmod(number, 128)
        found.append(low | (0x80 if number else 0))
        if not number:
            return bytes(found)


class Car:
    """Sends frames at 20 Hz, and notes when SOC_ESTIMATE comes."""

    def __init__(self) -> None:
        self.seen_s: list[float] = []
        for work in (self._drive, self._listen):
            threading.Thread(target=work, daemon=True).start()

    def _drive(self) -> None:
        encoder = FrameEncoder(Vehicle.load("generic"))
        with can.Bus(interface="udp_multicast", channel=GROUP, port=PORT) as bus:
            for number in range(1 << 30):
                sample = Sample(0.05 * number, 10.0 + number % 5, 380.0 - 0.1 * (number % 7), 25.0)
                for frame in encoder.encode(sample):
                    bus.send(frame)
                time.sleep(0.05)

    def _listen(self) -> None:
        with can.Bus(interface="udp_multicast", channel=GROUP, port=PORT) as bus:
            while True:
                message = bus.recv(1.0)
                if message is not None and message.arbitration_id == 0x5A0:
                    self.seen_s.append(time.monotonic())


@contextmanager
def service(folder: Path, broker: Broker) -> Iterator[subprocess.Popen[bytes]]:
    """Run a service with everything that speaks to networks."""
    model = ROOT / "replay" / "leaf2012_published_model.json"
    (folder / "run.toml").write_text(
        f'model = "{model}"\ninterface = "udp_multicast"\nchannel = "{GROUP}"\ninitial_soc = 80\n'
        f'status_socket = "{folder}/status"\nhttp = "127.0.0.1:{PORT}"\n'
        f'dashboard = "127.0.0.1:{PORT + 1}"\nlive = "unit"\n[bus_options]\nport = {PORT}\n'
        f'[mqtt]\nbroker = "127.0.0.1"\nport = {broker.port}\nevery_s = 0.2\n'
    )
    command = [sys.executable, "-m", "cangauge", "run", "--config", str(folder / "run.toml")]
    with (folder / "log").open("wb") as log, subprocess.Popen(command, stderr=log) as process:
        try:
            yield process
        finally:
            process.terminate()


@contextmanager
def live(folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Serve page, HTTP and MQTT of the service."""
    command = [sys.executable, "-m", "cangauge", "live", str(folder / "run.toml")]
    with (folder / "live").open("ab") as log, subprocess.Popen(command, stderr=log) as process:
        try:
            time.sleep(4.0)
            yield process
        finally:
            process.kill()


def resident_mb(pid: int) -> float:
    """Return the resident memory of a process [MB]."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


@contextmanager
def viewers(count: int) -> Iterator[None]:
    """Hold connections that ask for all rows and read nothing."""
    held = []
    for _ in range(count):
        with suppress(OSError):
            held.append(socket.create_connection(("127.0.0.1", PORT + 1), 1.0))
            held[-1].sendall(b"GET /rows?span=1h HTTP/1.1\r\nHost: localhost\r\n\r\n")
    yield
    for each in held:
        each.close()


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=8.0, help="of each attack [s]")
    parser.add_argument("--keep", action="store_true", help="keep the figures for the page")
    options = parser.parse_args()
    broker, rows = Broker(), []
    with (
        tempfile.TemporaryDirectory() as name,
        service(folder := Path(name), broker) as process,
    ):
        car = Car()
        time.sleep(8.0)

        def measured(attack: str) -> None:
            began_s = time.monotonic()
            time.sleep(options.seconds)
            seen_s = [at for at in car.seen_s if at >= began_s - 0.2]
            gaps = [b - a for a, b in pairwise([*seen_s, time.monotonic()])]
            rows.append((attack, max(gaps), resident_mb(process.pid)))

        measured("none")
        for number, text in (
            (signal.SIGKILL, "network process killed"),
            (signal.SIGSTOP, "network process stopped"),
        ):
            with live(folder) as served:
                served.send_signal(number)
                measured(text)
        with live(folder):
            for attack, text in (
                (never_released, "broker never releases QoS 2 messages"),
                (one_large, "broker sends a message of 200 MB"),
            ):
                broker.attack = attack
                measured(text)
                broker.attack = None
            with viewers(600):
                measured("600 clients that read nothing")
        measured("none")
    before = rows[0][2]
    table = Table("attack", "longest interval of SOC_ESTIMATE [s]", "service's memory [MB]")
    for attack, gap_s, size_mb in rows:
        table.add_row(attack, f"{gap_s:.3f}", f"{size_mb:.0f}")
    publish(
        "wall", [table], ["src/cangauge/service", "src/cangauge/extras/live"], keeps=options.keep
    )
    held = all(gap_s <= LONGEST_S and mb <= before * (1 + LARGEST_GROWTH) for _, gap_s, mb in rows)
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main())

"""A separate bus for each fault: UDP multicast on this machine, or a vcan interface.

Sender and listener of the harness reopen an interface that was removed.
"""

from __future__ import annotations

import socket
import subprocess
import threading
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Final

import can

from cangauge.bus.open import BusAddress, open_bus
from cangauge.errors import CangaugeError

UDP_GROUP: Final = "239.74.163.2"
UDP_PORT: Final = 20_000
PORTS: Final = 100
"""Buses per process; multicast buses differ by their port."""
BLOCKS: Final = 120
PUBLISHED: Final = [
    {"can_id": frame_id, "can_mask": 0x7FF, "extended": False} for frame_id in (0x5A0, 0x5A1)
]


@dataclass(frozen=True)
class BusLine:
    """One bus.

    Parameters
    ----------
    interface, channel : str
        python-can's names.
    options : mapping
        Further arguments of the driver.
    """

    interface: str
    channel: str
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def is_vcan(self) -> bool:
        """Whether it is a vcan interface."""
        return self.interface == "socketcan"

    def open(self, *, published_only: bool) -> can.BusABC:
        """Open the bus."""
        address = BusAddress(self.interface, self.channel, self.options)
        return open_bus(address, PUBLISHED if published_only else [])

    def link(self, *arguments: str) -> None:
        """Run `ip link` on the interface; a failure is an error of the harness."""
        words = " ".join(arguments).replace("DEV", self.channel).split()
        run(["ip", "link", *words])

    def create(self) -> None:
        """Create the interface if needed and set it up."""
        if not Path("/sys/class/net", self.channel).exists():
            self.link("add DEV type vcan")
        self.link("set DEV up")

    def remove(self) -> None:
        """Remove the interface, like an unplugged adapter."""
        self.link("del DEV")


def udp(number: int) -> BusLine:
    """Return a bus on this machine, exclusive to this number and process."""
    if not 0 <= number < PORTS:
        raise ValueError(f"no line {number}: there are {PORTS}")
    port = UDP_PORT + PORTS * _own_block()[0] + number
    return BusLine("udp_multicast", UDP_GROUP, {"port": port, "hop_limit": 0})


@cache
def _own_block() -> tuple[int, socket.socket]:
    """Claim a block of ports for the lifetime of this process.

    Several processes can bind a multicast port, so a clash would not raise an error. An abstract
    socket name, which only one process can bind, reserves the block.
    """
    for block in range(BLOCKS):
        claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            claim.bind(f"\0cangauge-faults-{block}")
        except OSError:
            claim.close()
        else:
            return block, claim
    raise CangaugeError("no block of ports is free for a separate bus")


def vcan(number: int) -> BusLine:
    """Return a vcan interface of the harness."""
    return BusLine("socketcan", f"fault{number}")


def run(command: list[str]) -> None:
    """Run a system command; raise CangaugeError if it fails."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise CangaugeError(f"{' '.join(command)}: {done.stderr.strip()}")


class HarnessBus:
    """Sends and receives on a bus, and reopens it after it was lost.

    Parameters
    ----------
    line : BusLine
    published_only : bool
        Receive only what the service publishes.
    """

    def __init__(self, line: BusLine, *, published_only: bool) -> None:
        self._line = line
        self._published_only = published_only
        self._bus: can.BusABC | None = line.open(published_only=published_only)
        self._closed = threading.Event()

    def close(self) -> None:
        """Close the bus."""
        self._closed.set()
        self._drop()

    def send(self, frame: can.Message) -> bool:
        """Send a frame; return whether it was sent."""
        bus = self._ready()
        if bus is None:
            return False
        try:
            bus.send(frame)
        except (can.CanError, OSError, ValueError):
            self._drop()
            return False
        return True

    def receive(self, timeout_s: float) -> can.Message | None:
        """Return the next frame, or None after a time-out or if the bus is lost."""
        bus = self._ready()
        if bus is None:
            self._closed.wait(timeout_s)
            return None
        try:
            return bus.recv(timeout_s)
        except (can.CanError, OSError, ValueError):
            self._drop()
            self._closed.wait(0.05)
            return None

    def _ready(self) -> can.BusABC | None:
        if self._bus is None and not self._closed.is_set():
            with suppress(CangaugeError, OSError):
                self._bus = self._line.open(published_only=self._published_only)
        return self._bus

    def _drop(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            with suppress(can.CanError, OSError):
                bus.shutdown()

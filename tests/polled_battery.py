"""A battery controller on a bus that answers over ISO-TP, and what a service makes of it."""

from __future__ import annotations

import threading
import time
from typing import Self

import can

from cangauge.bus.connection import BusConnection
from cangauge.bus.open import BusAddress, open_bus
from cangauge.bus.vehicle import Vehicle
from cangauge.service.config import PollConfig
from cangauge.service.pipeline import Pipeline
from live import Service, leaf_model, loop_config, waits

PROBES = bytes.fromhex("610402011401ff14020c13020e1313")
"""20 °C at the first probe."""
CELLS = bytes([0x61, 0x02]) + b"".join(
    (3900 - (10 if cell == 37 else 0)).to_bytes(2, "big") for cell in range(1, 97)
)
CELLS += (37439).to_bytes(2, "big") + bytes(2)
NEGATIVE, PENDING, SILENT = "negative", "pending", "silent"


class Battery:
    """Answers `21 02` and `21 04` on 0x79B with several frames on 0x7BB, after flow control."""

    def __init__(self, address: BusAddress, manner: str = "") -> None:
        self.bus = open_bus(address, [{"can_id": 0x79B, "can_mask": 0x7FF}])
        self.manner = manner
        self.requests: list[tuple[float, int]] = []
        self.early = 0
        self._left: list[bytes] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(5.0)
        self.bus.shutdown()

    def ask(self, group: int) -> None:
        """Send a request as another tester would."""
        self.bus.send(frame(0x79B, bytes([2, 0x21, group])))

    def _run(self) -> None:
        while not self._stop.is_set():
            message = self.bus.recv(0.05)
            if message is None or message.arbitration_id != 0x79B:
                continue
            if message.data[0] == 0x30:
                for data in self._left:
                    self.bus.send(frame(0x7BB, data))
                self._left = []
            elif message.data[:2] == b"\x02\x21":
                self.early += bool(self._left)
                self.requests.append((time.monotonic(), message.data[2]))
                self._answer(message.data[2])

    def _answer(self, group: int) -> None:
        if self.manner == SILENT:
            return
        if self.manner == NEGATIVE or group not in {2, 4}:
            self.bus.send(frame(0x7BB, b"\x03\x7f\x21\x12"))
            return
        if self.manner == PENDING:
            self.bus.send(frame(0x7BB, b"\x03\x7f\x21\x78"))
            time.sleep(1.2)
        payload = {2: CELLS, 4: PROBES}[group]
        first = bytes([0x10 | len(payload) >> 8, len(payload) & 0xFF]) + payload[:6]
        self._left = [
            bytes([0x20 | n & 15]) + payload[at : at + 7]
            for n, at in enumerate(range(6, len(payload), 7), 1)
        ]
        self.bus.send(frame(0x7BB, first))


def frame(frame_id: int, data: bytes) -> can.Message:
    return can.Message(arbitration_id=frame_id, is_extended_id=False, data=data.ljust(8, b"\0"))


def polling_service(address: BusAddress, every_s: float = 1.0) -> Service:
    pipeline = Pipeline(Vehicle.load("leaf_ze1_polled"), leaf_model())
    port = BusConnection(open_bus(address, pipeline.filters), address)
    return Service(port, pipeline, loop_config(poll=PollConfig(every_s=every_s)))


def temperature_and_cells_come(address: BusAddress) -> None:
    """The service asks, and its signals are those of the replies."""
    with Battery(address) as battery, polling_service(address) as service:
        assert waits(lambda: service.monitor.polls is not None)  # the loop begins in its thread
        polls = service.monitor.polls
        assert polls is not None
        assert waits(lambda: polls["answers"] >= 4)
        decoder = service.pipeline.decoder
        assert decoder.health["temperature"].value_at(time.time()) == 20.0
        assert decoder.cells is not None
        assert sorted({group for _, group in battery.requests}) == [2, 4]
        assert battery.early == 0
    assert polls["unanswered"] == polls["negative"] == polls["other_tester"] == 0
    assert service.monitor.foreign == 0

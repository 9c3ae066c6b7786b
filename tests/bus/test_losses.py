"""Frames lost in the receive queue: counted one by one, and stated by the service."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Sequence

import can
import pytest
from can.typechecking import CanFilter

from cangauge.bus.open import BusAddress, bus_address, has_socketcan, open_bus, socket_of
from cangauge.bus.reconnecting import ReconnectingBus
from cangauge.bus.vehicle import Vehicle
from cangauge.service.pipeline import Pipeline
from live import Service, frames_of, leaf_model, loop_config, short_log, waits

MULTICAST = bus_address("udp_multicast", options={"port": 20_000 + os.getpid() % 20_000})
VCAN = BusAddress("socketcan", "vcan0")


def small_bus(address: BusAddress, filters: Sequence[CanFilter] | None) -> can.BusABC:
    """Open a bus whose receive queue holds some hundred frames."""
    bus = open_bus(address, filters)
    with socket_of(bus) as own:
        own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
    return bus


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux counts them")
@pytest.mark.parametrize(
    "address", [MULTICAST, pytest.param(VCAN, marks=pytest.mark.socketcan)], ids=str
)
def test_an_overflow_of_the_receive_queue_is_counted_and_stated(address: BusAddress) -> None:
    if address is VCAN and not has_socketcan("vcan0"):
        pytest.skip("no SocketCAN interface vcan0 on this machine (see tests/socketcan)")
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model())
    frames = frames_of(short_log(200.0))
    with ReconnectingBus(address, pipeline.filters, small_bus) as port, open_bus(address) as sender:
        port.open()
        for frame in frames:
            sender.send(frame)
        lost = port.queue_drops
        assert lost
        with Service(port, pipeline, loop_config()) as service:
            assert waits(lambda: pipeline.counts["frames"] == len(frames) - lost)
            assert waits(lambda: bool(service.warnings))
            text = f"{port.name}: the receive queue overflowed: {lost} frames lost ({lost} so far)"
            assert service.warnings[0] == f"warning: {text}"
            assert waits(lambda: service.monitor.latest.status["samples"] > 0)
            status = service.monitor.latest.status
    assert status["bus_counts"]["queue_drops"] == lost
    assert status["bus_trouble"] == f"{lost} frames lost in the receive queue"
    assert port.queue_drops == lost  # also when it is closed

"""Frames dropped by full receive queues, and backend capabilities, on real sockets."""

from __future__ import annotations

import os
import socket
import sys
import time
from pathlib import Path

import can
import pytest

from cangauge.bus.connection import BusConnection
from cangauge.bus.open import BusAddress, backend_capabilities, bus_address, open_bus

linux_only = pytest.mark.skipif(sys.platform != "linux", reason="the count is Linux's")


def multicast() -> BusAddress:
    return bus_address("udp_multicast", options={"port": 20_000 + os.getpid() % 20_000})


@linux_only
def test_every_frame_is_received_or_counted() -> None:
    address, sent = multicast(), 4000
    with (
        BusConnection(open_bus(address), "receiver") as port,
        BusConnection(open_bus(address), "sender") as tx,
    ):
        with socket.socket(fileno=os.dup(port._bus.fileno())) as own:  # type: ignore[union-attr] # open
            own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
        assert port.queue_drops == 0
        for number in range(sent):
            tx.send(can.Message(arbitration_id=number % 0x700, is_extended_id=False, data=bytes(8)))
        dropped = port.queue_drops
        received = 0
        while port.receive(0.1) is not None:
            received += 1
    assert dropped
    assert received + dropped == sent
    assert port.queue_drops == dropped  # also when it is closed


def test_without_a_count_the_drops_are_none() -> None:
    with BusConnection(open_bus(BusAddress("virtual", "drops")), "virtual") as port:
        assert port.queue_drops is None
    assert port.queue_drops is None


def descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


@linux_only
def test_the_kernel_stamps_multicast_on_arrival() -> None:
    address = multicast()
    assert backend_capabilities(address).stamps == "kernel"
    with (
        BusConnection(open_bus(address), "receiver") as port,
        BusConnection(open_bus(address), "sender") as tx,
    ):
        before_s = time.time()
        tx.send(can.Message(arbitration_id=1, is_extended_id=False))
        sent_s = time.time()
        time.sleep(0.3)
        message = port.receive(1.0)
    assert message is not None
    assert before_s - 0.001 <= message.timestamp <= sent_s + 0.1


def test_capabilities_by_interface() -> None:
    virtual = backend_capabilities(BusAddress("virtual", "x"))
    assert (virtual.stamps, virtual.echoes) == ("sender", False)
    pcan = backend_capabilities(BusAddress("pcan", "PCAN_USBBUS1", {"receive_own_messages": True}))
    assert (pcan.stamps, pcan.echoes, pcan.has_error_classes) == ("driver", True, False)
    socketcan = backend_capabilities(BusAddress("socketcan", "can0"))
    assert (socketcan.stamps, socketcan.echoes, socketcan.has_error_classes) == (
        "kernel", False, True,
    )  # fmt: skip
    assert backend_capabilities(multicast()).echoes

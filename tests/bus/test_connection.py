"""A bus in use: pending frames, packets that are none, full queues, errors of drivers."""

from __future__ import annotations

import errno
import os
import sys
import time

import can
import pytest
from can.typechecking import CanFilter

from cangauge.bus.connection import AT_ONCE, BusConnection, BusError
from cangauge.bus.open import BusAddress, bus_address, open_bus
from cangauge.bus.publish import standard_filter
from live import PATIENCE_S, BrokenBus, network_down, unpack_error, waits

FILTERS: list[CanFilter] = [
    standard_filter(0x123),
    {"can_id": 0x1ABCDE00, "can_mask": 0x1FFFFF00, "extended": True},
]
linux_only = pytest.mark.skipif(sys.platform != "linux", reason="kernel stamps are Linux's")
FRAME = can.Message(arbitration_id=1, is_extended_id=False)
NOWHERE = BusAddress("virtual", "x")


def multicast(**more: bool) -> BusAddress:
    return bus_address("udp_multicast", options={"port": 20_000 + os.getpid() % 20_000, **more})


def broken(*script: object) -> BusConnection:
    return BusConnection(BrokenBus(list(script)), NOWHERE)  # type: ignore[arg-type] # what is used of it


@linux_only
@pytest.mark.parametrize("carries_fd", [True, False])
def test_frames_that_pass_the_filters_are_received(carries_fd: bool) -> None:
    standard = {"arbitration_id": 0x123, "is_extended_id": False}
    wanted = [
        can.Message(**standard, data=bytes(range(8))),
        can.Message(**standard, is_remote_frame=True, dlc=3),
        can.Message(**standard, data=b"1", channel="elsewhere"),
        can.Message(arbitration_id=0x1ABCDE77, is_extended_id=True, data=b"123"),
    ]
    fd = can.Message(**standard, data=bytes(64), is_fd=True, bitrate_switch=True)
    others = [
        can.Message(arbitration_id=0x123, is_extended_id=True),
        can.Message(arbitration_id=0x124, is_extended_id=False),
    ]
    address = multicast(fd=carries_fd)
    with (
        BusConnection(open_bus(address, FILTERS), address) as port,
        open_bus(multicast()) as sender,
        open_bus(multicast()) as unfiltered,
    ):

        def is_stamped_on_arrival() -> bool:
            sender.send(wanted[0])
            assert unfiltered.recv(PATIENCE_S)
            arrived_s = time.time()
            time.sleep(0.01)
            message = port.receive(PATIENCE_S)
            return message is not None and message.timestamp <= arrived_s

        # Linux switches stamps on in the background: earlier frames are stamped when read.
        assert waits(is_stamped_on_arrival)
        before_s, sent = time.time(), [*others, *wanted, fd, *others]
        for frame in sent:
            sender.send(frame)
        assert all(unfiltered.recv(PATIENCE_S) for _ in sent)
        arrived_s = time.time()
        time.sleep(0.2)
        found = port.receive_pending(1.0)
        # Stamped by the kernel on arrival, not when they are read.
        stamps_s = [each.timestamp for each in found]
        assert before_s - 0.001 <= min(stamps_s) <= max(stamps_s) <= arrived_s
        expected = [*wanted, *([fd] if carries_fd else [])]
        assert all(
            one.equals(two, timestamp_delta=None, check_direction=False)
            for one, two in zip(found, expected, strict=True)
        )
        assert port.is_drained
        assert port.carries_fd is carries_fd
        port.set_filters([standard_filter(0x124)])
        sender.send(others[1])
        sender.send(wanted[0])
        assert [each.arbitration_id for each in port.receive_pending(1.0)] == [0x124]


@linux_only
def test_many_pending_frames_come_in_batches_in_order() -> None:
    with BusConnection(open_bus(multicast()), multicast()) as port, open_bus(multicast()) as sender:
        for number in range(2 * AT_ONCE + 1):
            sender.send(can.Message(arbitration_id=number, is_extended_id=False))
        parts = [port.receive_pending(5.0) for _ in range(3)]
        assert [len(each) for each in parts] == [AT_ONCE, AT_ONCE, 1]
        numbers = [each.arbitration_id for part in parts for each in part]
        assert numbers == list(range(2 * AT_ONCE + 1))
        began_s = time.monotonic()
        assert port.receive_pending(0.1) == []
        assert time.monotonic() - began_s > 0.09


def test_stamps_and_echoes_by_interface() -> None:
    with BusConnection(open_bus(NOWHERE), NOWHERE) as port:
        assert port.queue_drops is None  # it is no socket
    socketcan = BusAddress("socketcan", "can0")
    pcan = BusAddress("pcan", "PCAN_USBBUS1", {"receive_own_messages": True})
    buses = (NOWHERE, pcan, socketcan, multicast())
    assert [bus.echoes for bus in buses] == [False, True, False, True]
    assert [bus.stamps for bus in buses[:3]] == ["sender", "driver", "kernel"]
    if sys.platform == "linux":
        assert multicast().stamps == "kernel"


def test_frames_read_before_an_error_are_kept() -> None:
    port = broken(FRAME, unpack_error(), FRAME, network_down())
    assert port.receive_pending(0.0) == [FRAME, FRAME]
    assert port.garbled == 1
    assert not port.is_drained
    for _ in range(2):
        with pytest.raises(BusError, match="Network is down"):
            port.receive_pending(0.0)


def test_frames_after_an_error_frame_wait_for_the_next_call() -> None:
    error = can.Message(is_error_frame=True)
    port = broken(FRAME, error, error, FRAME, FRAME)
    assert [len(port.receive_pending(0.0)) for _ in range(4)] == [1, 0, 2, 0]
    assert port.error_frames == 2


def test_send_gives_up_when_the_queue_stays_full() -> None:
    full = can.CanOperationError("Failed to transmit: No buffer space", errno.ENOBUFS)
    port = BusConnection(BrokenBus([], sending=full), NOWHERE)  # type: ignore[arg-type] # see above
    assert not port.send(FRAME, within_s=0.01)
    assert port.unsent == 1
    down = BusConnection(BrokenBus([], sending=network_down()), NOWHERE)  # type: ignore[arg-type] # see above
    with pytest.raises(BusError, match=r"sending failed: .*Network is down"):
        down.send(FRAME)

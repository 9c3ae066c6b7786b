"""Pending frames read from the socket: equal to those of python-can's `recv`."""

from __future__ import annotations

import os
import socket
import sys
import time
from pathlib import Path

import can
import pytest

from cangauge.bus.connection import (
    AT_ONCE,
    BusConnection,
    BusError,
    NoPendingFrameError,
    pending_frames,
)
from cangauge.bus.open import BusAddress, bus_address, open_bus
from cangauge.bus.publish import standard_filter
from live import BrokenBus, network_down, same_frames, unpack_error

FILTERS = [
    standard_filter(0x123),
    {"can_id": 0x1ABCDE00, "can_mask": 0x1FFFFF00, "extended": True},
]
linux_only = pytest.mark.skipif(sys.platform != "linux", reason="kernel stamps are Linux's")


def multicast(number: int = 0, **more: bool) -> BusAddress:
    return bus_address(
        "udp_multicast", options={"port": 20_000 + (os.getpid() + number) % 20_000, **more}
    )


def every_kind() -> list[can.Message]:
    standard = {"arbitration_id": 0x123, "is_extended_id": False}
    return [
        can.Message(**standard, data=bytes(range(8))),
        can.Message(**standard, data=b""),
        can.Message(**standard, is_remote_frame=True, dlc=3),
        can.Message(**standard, is_error_frame=True, data=bytes(8)),
        can.Message(**standard, data=bytes(64), is_fd=True, bitrate_switch=True),
        can.Message(**standard, data=bytes(12), is_fd=True, error_state_indicator=True),
        can.Message(**standard, data=b"1", channel="elsewhere"),
        can.Message(arbitration_id=0x123, is_extended_id=True, data=b"12"),
        can.Message(arbitration_id=0x1ABCDE77, is_extended_id=True, data=b"123"),
        can.Message(arbitration_id=0x124, is_extended_id=False, data=b"1234"),
        can.Message(arbitration_id=0x7FF, is_extended_id=False, data=b"12345"),
    ]


def wait_for_stamps(sender: can.BusABC, *buses: can.BusABC) -> None:
    """Wait until the kernel stamps on arrival: it begins shortly after the first request."""
    probe = can.Message(arbitration_id=0x123, is_extended_id=False)
    for _ in range(100):
        sender.send(probe)
        time.sleep(0.02)
        frames = [bus.recv(1.0) for bus in buses]
        if all(frame and time.time() - frame.timestamp > 0.015 for frame in frames):
            return
    raise AssertionError("the kernel does not stamp")


@linux_only
@pytest.mark.parametrize("carries_fd", [True, False])
@pytest.mark.parametrize("filters", [None, FILTERS], ids=["all", "filtered"])
def test_frames_equal_those_of_python_can(
    carries_fd: bool, filters: list[can.typechecking.CanFilter] | None
) -> None:
    address = multicast(fd=carries_fd)
    # Twice each: filter results are cached.
    sent = [each for each in every_kind() for _ in range(2)]
    with (
        open_bus(address, filters) as theirs,
        open_bus(address, filters) as ours,
        open_bus(multicast()) as sender,
    ):
        pending = pending_frames(ours)
        assert pending is not None
        wait_for_stamps(sender, theirs, ours)
        for frame in sent:
            sender.send(frame)
        expected = []
        while (message := theirs.recv(0.2)) is not None:
            expected.append(message)
        found = []
        for _ in sent:
            message = pending.next()
            if message is not None:
                found.append(message)
        with pytest.raises(NoPendingFrameError):
            pending.next()
        pending.close()
    assert (
        len(expected)
        == {(True, None): 22, (True, 1): 16, (False, None): 18, (False, 1): 12}[
            carries_fd, None if filters is None else 1
        ]
    )
    assert same_frames(found, expected)


@linux_only
def test_new_filters_apply_from_the_next_frame() -> None:
    frame = can.Message(arbitration_id=0x55, is_extended_id=False)
    with (
        BusConnection(open_bus(multicast(), FILTERS), "rx") as port,
        open_bus(multicast()) as sender,
    ):
        for _ in range(2):
            sender.send(frame)
            assert port.receive_pending(0.2) == []
        port.set_filters([standard_filter(0x55)])
        sender.send(frame)
        assert len(port.receive_pending(0.2)) == 1
        port.set_filters(FILTERS)
        sender.send(frame)
        assert port.receive_pending(0.2) == []


@linux_only
def test_packets_that_are_no_frames_are_counted() -> None:
    address = multicast()
    junk = [b"", b"\xff", b"\x01", b"\x90", b"\x81\xa1x\x01", bytes(5000)]
    good = can.Message(arbitration_id=0x123, is_extended_id=False, data=b"1")
    with (
        BusConnection(open_bus(address), "ours") as ours,
        open_bus(address) as sender,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as raw,
    ):
        raw.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        for each in junk:
            raw.sendto(each, (address.channel, int(address.options["port"])))
        sender.send(good)
        assert len(ours.receive_pending(0.2)) == 1
        assert ours.garbled == len(junk)


@linux_only
def test_many_pending_frames_come_in_batches_in_order() -> None:
    address = multicast()
    with BusConnection(open_bus(address), "rx") as port, open_bus(address) as sender:
        for number in range(3 * AT_ONCE + 1):
            sender.send(can.Message(arbitration_id=number, is_extended_id=False))
        began_s = time.monotonic()
        parts = [port.receive_pending(5.0) for _ in range(4)]
        assert time.monotonic() - began_s < 1.0
        assert [len(each) for each in parts] == [AT_ONCE, AT_ONCE, AT_ONCE, 1]
        assert [each.arbitration_id for part in parts for each in part] == list(
            range(3 * AT_ONCE + 1)
        )
        began_s = time.monotonic()
        assert port.receive_pending(0.2) == []
        assert 0.19 < time.monotonic() - began_s < 1.0


@linux_only
def test_a_closed_connection_leaks_no_descriptor() -> None:
    def descriptors() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    address = multicast()
    before = descriptors()
    for _ in range(3):
        with BusConnection(open_bus(address), "rx") as port:
            port.receive_pending(0.0)
    assert descriptors() == before


def test_other_interfaces_are_read_until_they_are_empty() -> None:
    frame = can.Message(arbitration_id=1)
    script: list[object] = [frame, frame, None, unpack_error(), frame, network_down()]
    port = BusConnection(BrokenBus(script), "x")  # type: ignore[arg-type] # what is used of one
    assert len(port.receive_pending(0.0)) == 2
    assert port.is_drained
    assert len(port.receive_pending(0.0)) == 1
    assert port.garbled == 1
    assert not port.is_drained
    with pytest.raises(BusError):
        port.receive_pending(0.0)


class Script:
    """Reads from a script instead of a socket."""

    def __init__(self, *steps: object) -> None:
        self._steps = list(steps)

    def next(self) -> can.Message | None:
        step = self._steps.pop(0) if self._steps else NoPendingFrameError()
        if isinstance(step, BaseException):
            raise step
        return step  # type: ignore[return-value] # a message or None

    def wait(self, _timeout_s: float) -> bool:
        return bool(self._steps)

    def forget_filters(self) -> None:
        pass

    def close(self) -> None:
        pass


def test_frames_read_before_an_error_are_kept() -> None:
    frame = can.Message(arbitration_id=1)
    port = BusConnection(BrokenBus([]), "x")  # type: ignore[arg-type] # what is used of one
    port._pending = Script(frame, unpack_error(), None, frame, network_down())
    assert port.receive_pending(0.0) == [frame, frame]
    assert port.garbled == 1
    for _ in range(2):
        with pytest.raises(BusError, match="Network is down"):
            port.receive_pending(0.0)


def test_frames_after_an_error_frame_wait_for_the_next_call() -> None:
    frame, error = can.Message(arbitration_id=1), can.Message(is_error_frame=True)
    port = BusConnection(BrokenBus([]), "x")  # type: ignore[arg-type] # what is used of one
    port._pending = Script(frame, error, error, frame, frame)
    assert [len(port.receive_pending(0.0)) for _ in range(4)] == [1, 0, 2, 0]
    assert port.error_frames == 2

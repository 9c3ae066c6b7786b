"""Frames that wait in a bus's socket, read without asking first whether there is one.

python-can's `recv` asks by `select` ahead of every frame, and on UDP makes a message of every
packet before it looks at the id. For the two interfaces whose sockets are known, what waits is
read here until nothing is left: a system call a frame. The messages are made by python-can's own
functions, and are those that its `recv` gives.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import sys
from collections.abc import Hashable
from typing import Any, Final, Protocol, cast

import can
from can.interfaces.socketcan import SocketcanBus
from can.interfaces.socketcan.socketcan import capture_message
from can.interfaces.udp_multicast import UdpMulticastBus
from can.interfaces.udp_multicast.bus import SO_TIMESTAMPNS

try:
    import msgpack
except ImportError:  # then there is no bus by UDP either
    msgpack = None

_PACKET_BYTES: Final = 4096
"""As python-can: a longer packet is cut off, and then is no frame."""
_STAMP: Final = struct.Struct("@ll")
_IDS_KEPT: Final = 4096
"""So many unwanted ids are remembered at most: anybody may send any."""


class NothingWaitsError(Exception):
    """No frame is waiting in the socket."""


class WaitingFrames(Protocol):
    """Reads what waits in a bus's socket."""

    def next(self) -> can.Message | None:
        """Return the next frame that waits; None for one that does not pass the filters.

        Raises
        ------
        NothingWaitsError
        Exception
            What python-can's `recv` raises.
        """

    def wait(self, timeout_s: float) -> bool:
        """Return whether a frame waits, as soon as one does or the time is up [s]."""

    def close(self) -> None:
        """Let go of the socket; the bus stays open."""


def waiting_frames(bus: can.BusABC) -> WaitingFrames | None:
    """Return what reads the frames that wait; None where the interface's socket is not known."""
    if sys.platform != "linux":
        return None
    if isinstance(bus, SocketcanBus):
        return _SocketcanFrames(bus)
    if isinstance(bus, UdpMulticastBus):
        return _UdpFrames.of(bus)
    return None


class _Impatient:
    """A socket that is read without waiting."""

    def __init__(self, own: socket.socket) -> None:
        self._socket = own

    def recvmsg(self, size: int, ancillary_size: int) -> tuple[Any, ...]:
        """As the socket's."""
        try:
            return self._socket.recvmsg(size, ancillary_size, socket.MSG_DONTWAIT)
        except BlockingIOError:
            raise NothingWaitsError from None

    def wait(self, timeout_s: float) -> bool:
        """Return whether there is anything to read, an error included, in time [s]."""
        return bool(select.select([self._socket], [], [], timeout_s)[0])


class _SocketcanFrames:
    """Those of SocketCAN: the kernel filters."""

    def __init__(self, bus: SocketcanBus) -> None:
        self._socket = _Impatient(bus.socket)
        # All that it asks of a socket is `recvmsg`.
        self._as_socket = cast("socket.socket", self._socket)
        self._channel = bus.channel

    def next(self) -> can.Message | None:
        message = capture_message(self._as_socket, get_channel=not self._channel)
        if message is not None and self._channel:
            message.channel = self._channel
        return message

    def wait(self, timeout_s: float) -> bool:
        return self._socket.wait(timeout_s)

    def close(self) -> None:
        pass  # the socket is the bus's


class _UdpFrames:
    """Those of UDP multicast: a frame with an unwanted id is not made a message of."""

    def __init__(self, bus: UdpMulticastBus, own: socket.socket) -> None:
        self._bus = bus
        self._own = own
        self._socket = _Impatient(own)
        self._stamp_space = socket.CMSG_SPACE(_STAMP.size)
        self._carries_fd = bus.protocol is can.CanProtocol.CAN_FD
        self._filters = bus.filters
        self._unwanted: set[Hashable] = set()

    @classmethod
    def of(cls, bus: UdpMulticastBus) -> _UdpFrames | None:
        """Return them; None if the kernel does not stamp the packets."""
        # The driver keeps its socket to itself; a duplicate of the descriptor is the same socket.
        own = socket.socket(fileno=os.dup(bus.fileno()))
        if own.getsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS):
            return cls(bus, own)
        own.close()
        return None

    def next(self) -> can.Message | None:
        packet, ((_, _, stamp),), _, _ = self._socket.recvmsg(_PACKET_BYTES, self._stamp_space)
        seconds, nanoseconds = _STAMP.unpack(stamp)
        try:
            fields = msgpack.unpackb(packet, raw=False)
            if self._is_unwanted(fields):
                return None
            fields["timestamp"] = seconds + nanoseconds * 1.0e-9
            message = can.Message(check=True, **fields)
        except Exception as error:
            # As python-can: whatever it is, it is this packet's.
            raise can.CanOperationError("could not unpack received message") from error
        if message.is_fd and not self._carries_fd:
            return None
        if self._bus._matches_filters(message):  # noqa: SLF001 - as python-can's `recv` does
            return message
        if len(self._unwanted) >= _IDS_KEPT:
            self._unwanted.clear()
        self._unwanted.add((message.arbitration_id, message.is_extended_id))
        return None

    def _is_unwanted(self, fields: dict[str, Any]) -> bool:
        """Whether a frame with this id was refused by the filters before."""
        if self._bus.filters is not self._filters:
            self._filters = self._bus.filters
            self._unwanted.clear()
        return (fields.get("arbitration_id"), fields.get("is_extended_id")) in self._unwanted

    def wait(self, timeout_s: float) -> bool:
        return self._socket.wait(timeout_s)

    def close(self) -> None:
        self._own.close()

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
"""So many ids are remembered at most: anybody may send any."""
_DO_NOT_WAIT: Final = int(socket.MSG_DONTWAIT) if sys.platform == "linux" else 0


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

    def forget_filters(self) -> None:
        """Take note that the bus has other filters."""

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


class _SocketcanFrames:
    """Those of SocketCAN: the kernel filters."""

    def __init__(self, bus: SocketcanBus) -> None:
        self._socket = bus.socket
        self._channel = bus.channel
        # python-can's function asks nothing of a socket but this.
        self._impatient = cast("socket.socket", _Impatient(bus.socket))

    def next(self) -> can.Message | None:
        message = capture_message(self._impatient, get_channel=not self._channel)
        if message is not None and self._channel:
            message.channel = self._channel
        return message

    def wait(self, timeout_s: float) -> bool:
        return bool(select.select([self._socket], [], [], timeout_s)[0])

    def forget_filters(self) -> None:
        pass

    def close(self) -> None:
        pass  # the socket is the bus's


class _Impatient:
    """A socket that is read without waiting."""

    def __init__(self, own: socket.socket) -> None:
        self._socket = own

    def recvmsg(self, size: int, ancillary_size: int) -> tuple[Any, ...]:
        """As the socket's."""
        try:
            return self._socket.recvmsg(size, ancillary_size, _DO_NOT_WAIT)
        except BlockingIOError:
            raise NothingWaitsError from None


class _UdpFrames:
    """Those of UDP multicast: a frame with an unwanted id is not made a message of."""

    def __init__(self, bus: UdpMulticastBus, own: socket.socket) -> None:
        self._bus = bus
        self._socket = own
        self._stamp_space = socket.CMSG_SPACE(_STAMP.size)
        self._carries_fd = bus.protocol is can.CanProtocol.CAN_FD
        self._passes: dict[Hashable, bool] = {}

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
        try:
            packet, ((_, _, stamp),), _, _ = self._socket.recvmsg(
                _PACKET_BYTES, self._stamp_space, _DO_NOT_WAIT
            )
        except BlockingIOError:
            raise NothingWaitsError from None
        seconds, nanoseconds = _STAMP.unpack(stamp)
        try:
            fields = msgpack.unpackb(packet, raw=False)
            key = fields.get("arbitration_id"), fields.get("is_extended_id")
            passes = self._passes.get(key)
            if passes is False:
                return None
            fields["timestamp"] = seconds + nanoseconds * 1.0e-9
            message = can.Message(check=True, **fields)
        except Exception as error:
            # As python-can: whatever it is, it is this packet's.
            raise can.CanOperationError("could not unpack received message") from error
        if passes is None:
            passes = self._look_up(key, message)
        return message if passes and (self._carries_fd or not message.is_fd) else None

    def _look_up(self, key: Hashable, message: can.Message) -> bool:
        """Return whether frames with an id pass, and remember it."""
        if len(self._passes) >= _IDS_KEPT:
            self._passes.clear()
        # As python-can's `recv` does.
        self._passes[key] = passes = self._bus._matches_filters(message)  # noqa: SLF001
        return passes

    def wait(self, timeout_s: float) -> bool:
        return bool(select.select([self._socket], [], [], timeout_s)[0])

    def forget_filters(self) -> None:
        self._passes.clear()

    def close(self) -> None:
        self._socket.close()

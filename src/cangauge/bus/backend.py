"""Backends of python-can: capabilities, kinds of error frames, fast reading of sockets.

Pending frames of SocketCAN and UDP multicast are read from the socket until it is empty, one system
call per frame. python-can's `recv` calls `select` before every frame, and on UDP builds a message
of every packet before it looks at the id. The messages are those that `recv` gives.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import sys
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any, Final, Literal, Protocol, cast

import can
from can.interfaces.socketcan import SocketcanBus
from can.interfaces.socketcan.socketcan import capture_message
from can.interfaces.udp_multicast.bus import SO_TIMESTAMPNS

from cangauge.bus.open import BusAddress
from cangauge.bus.udp import CheckedUdpBus, as_message, unpack_fields

Stamps = Literal["kernel", "sender", "driver"]

_LINUX: Final = sys.platform == "linux"


@dataclass(frozen=True)
class BackendCapabilities:
    """Properties of an interface.

    Parameters
    ----------
    stamps : {"kernel", "sender", "driver"}
        Origin of the time stamps. "kernel": arrival, however late the frame is read
        (SO_TIMESTAMPNS). "sender": sending (within one process). "driver": depends on the driver,
        the adapter's clock or the moment of reading.
    echoes : bool
        Whether own frames are received too.
    has_error_classes : bool
        Whether error frames have SocketCAN's error classes.
    """

    stamps: Stamps
    echoes: bool
    has_error_classes: bool


UNKNOWN_INTERFACE: Final = BackendCapabilities("driver", echoes=False, has_error_classes=False)


def backend_capabilities(address: BusAddress) -> BackendCapabilities:
    """Return the capabilities of the interface of an address."""
    asked = bool(address.options.get("receive_own_messages", False))
    if address.interface == "socketcan":
        return BackendCapabilities("kernel", echoes=asked, has_error_classes=True)
    if address.interface == "udp_multicast":
        # Elsewhere python-can stamps when it reads.
        stamps: Stamps = "kernel" if _LINUX else "driver"
        return BackendCapabilities(stamps, echoes=True, has_error_classes=False)
    stamps = "sender" if address.interface == "virtual" else "driver"
    return BackendCapabilities(stamps, echoes=asked, has_error_classes=False)


BUS_OFF: Final = "bus_off"
RESTARTED: Final = "restarted"
UNSPECIFIED: Final = "unspecified"

_CONTROLLER: Final = 0x004
_CLASSES: Final = {
    0x001: "transmit_timeout",
    0x002: "arbitration_lost",
    0x008: "protocol",
    0x010: "transceiver",
    0x020: "no_acknowledge",
    0x040: BUS_OFF,
    0x080: "bus_error",
    0x100: RESTARTED,
}
_CONTROLLER_STATES: Final = {
    0x01: "controller_receive_overflow",
    0x02: "controller_transmit_overflow",
    0x04: "receive_warning",
    0x08: "transmit_warning",
    0x10: "receive_passive",
    0x20: "transmit_passive",
    0x40: "error_active",
}


def error_kinds(message: can.Message) -> list[str]:
    """Return the error classes of a SocketCAN error frame (linux/can/error.h).

    The classes are bits of the id; python-can keeps the lower eleven, which are all that name a
    kind. The controller's state is in byte 1. A frame can have several kinds, or `UNSPECIFIED`.
    """
    classes = message.arbitration_id
    kinds = [name for bit, name in _CLASSES.items() if classes & bit]
    if classes & _CONTROLLER:
        state = message.data[1] if len(message.data) > 1 else 0
        states = [name for bit, name in _CONTROLLER_STATES.items() if state & bit]
        kinds += states or ["controller"]
    return kinds or [UNSPECIFIED]


_SO_MEMINFO: Final = 55
_MEMINFO: Final = struct.Struct("=9I")
_MEMINFO_DROPS: Final = 8


def _duplicate_socket(bus: can.BusABC) -> socket.socket:
    """Return a second handle of a bus's socket, which the driver keeps private.

    Raises
    ------
    OSError, NotImplementedError, ValueError
        If the bus is not a socket.
    """
    descriptor = os.dup(bus.fileno())
    try:
        return socket.socket(fileno=descriptor)
    except OSError:  # a device, an event of a driver
        os.close(descriptor)
        raise


def queue_drops(bus: can.BusABC) -> int | None:
    """Return the frames dropped by a full receive queue since the bus was opened (modulo 2³²).

    None where the system does not count them: buses that are not sockets, systems other than Linux.
    Read by SO_MEMINFO (Linux 4.12), which works at any time; SO_RXQ_OVFL comes with the next frame
    only, and python-can does not ask for it.
    """
    if not _LINUX:
        return None
    try:
        with _duplicate_socket(bus) as own:
            answer = own.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
    except (OSError, NotImplementedError, ValueError):
        return None
    return int(_MEMINFO.unpack(answer)[_MEMINFO_DROPS]) if len(answer) >= _MEMINFO.size else None


_PACKET_BYTES: Final = 4096
"""As in python-can: a longer packet is truncated, and hence not a frame."""
_STAMP: Final = struct.Struct("@ll")
_IDS_KEPT: Final = 4096
"""Most ids whose filter result is cached: multicast packets can have any id."""
_DO_NOT_WAIT: Final = int(socket.MSG_DONTWAIT) if sys.platform == "linux" else 0


class NoPendingFrameError(Exception):
    """The socket is empty (as `queue.Empty`)."""


class PendingFrames(Protocol):
    """Read the frames that are pending in the socket of a bus."""

    def next(self) -> can.Message | None:
        """Return the next pending frame; None for one that does not pass the filters.

        Raises
        ------
        NoPendingFrameError
        Exception
            Errors of python-can's `recv`.
        """

    def wait(self, timeout_s: float) -> bool:
        """Wait for a frame; return whether one is pending."""

    def forget_filters(self) -> None:
        """Drop cached filter results, after a change of the filters."""

    def close(self) -> None:
        """Release the socket; the bus stays open."""


def pending_frames(bus: can.BusABC) -> PendingFrames | None:
    """Return the reader of a bus's pending frames; None for other interfaces."""
    if not _LINUX:
        return None
    if isinstance(bus, SocketcanBus):
        return _SocketcanFrames(bus)
    if isinstance(bus, CheckedUdpBus):
        own = _duplicate_socket(bus)
        if own.getsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS):
            return _UdpFrames(bus, own)
        own.close()  # the kernel does not stamp the packets
    return None


class _SocketcanFrames:
    """Pending frames of SocketCAN; the kernel filters."""

    def __init__(self, bus: SocketcanBus) -> None:
        self._socket = bus.socket
        self._channel = bus.channel
        # `capture_message` uses `recvmsg` alone.
        self._non_blocking = cast("socket.socket", _NonBlockingSocket(bus.socket))

    def next(self) -> can.Message | None:
        message = capture_message(self._non_blocking, get_channel=not self._channel)
        if message is not None and self._channel:
            message.channel = self._channel
        return message

    def wait(self, timeout_s: float) -> bool:
        return bool(select.select([self._socket], [], [], timeout_s)[0])

    def forget_filters(self) -> None:
        pass

    def close(self) -> None:
        pass  # the socket is the bus's own


class _NonBlockingSocket:
    def __init__(self, own: socket.socket) -> None:
        self._socket = own

    def recvmsg(self, size: int, ancillary_size: int) -> tuple[Any, ...]:
        try:
            return self._socket.recvmsg(size, ancillary_size, _DO_NOT_WAIT)
        except BlockingIOError:
            raise NoPendingFrameError from None


class _UdpFrames:
    """Pending frames of UDP multicast; no message is built of a frame with an unwanted id."""

    def __init__(self, bus: CheckedUdpBus, own: socket.socket) -> None:
        self._bus = bus
        self._socket = own
        self._stamp_space = socket.CMSG_SPACE(_STAMP.size)
        self._carries_fd = bus.protocol is can.CanProtocol.CAN_FD
        self._passes: dict[Hashable, bool] = {}

    def next(self) -> can.Message | None:
        try:
            packet, ((_, _, stamp),), _, sender = self._socket.recvmsg(
                _PACKET_BYTES, self._stamp_space, _DO_NOT_WAIT
            )
        except BlockingIOError:
            raise NoPendingFrameError from None
        if not self._bus.is_accepted(sender):
            return None
        fields = unpack_fields(packet)
        key = fields.get("arbitration_id"), fields.get("is_extended_id")
        passes = self._passes.get(key)
        if passes is False:
            return None
        seconds, nanoseconds = _STAMP.unpack(stamp)
        message = as_message(fields, seconds + nanoseconds * 1.0e-9)
        if passes is None:
            if len(self._passes) >= _IDS_KEPT:
                self._passes.clear()
            # As python-can's `recv` does.
            passes = self._bus._matches_filters(message)  # noqa: SLF001
            self._passes[key] = passes
        return message if passes and (self._carries_fd or not message.is_fd) else None

    def wait(self, timeout_s: float) -> bool:
        return bool(select.select([self._socket], [], [], timeout_s)[0])

    def forget_filters(self) -> None:
        self._passes.clear()

    def close(self) -> None:
        self._socket.close()

"""An open bus: receive, send, classify the errors of drivers, reopen a lost bus.

A bad packet is counted and skipped; an error that means a lost bus becomes a `BusError`, which
`reconnecting` answers by opening it again. There are no threads: the caller runs the loop.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import sys
import time
from collections import Counter, deque
from collections.abc import Sequence
from contextlib import suppress
from typing import Final, Self

import can
from can.interfaces.socketcan import SocketcanBus
from can.interfaces.udp_multicast import UdpMulticastBus
from can.typechecking import CanFilter

from cangauge.bus.open import BusAddress
from cangauge.errors import CangaugeError

SEND_WITHIN_S: Final = 1.0
"""Longest wait for room in the transmit queue [s]."""
AT_ONCE: Final = 64
"""Most pending frames received in one call, so that the caller gets its turn."""
_RETRY_S: Final = 0.0005
_POSTED_RETRY_S: Final = 0.005
"""Interval at which posted frames are retried while the transmit queue is full [s]."""
_QUEUE_FULL: Final = {errno.ENOBUFS, errno.EAGAIN}

_ERRORS: Final = {
    0x001: "transmit_timeout",
    0x002: "arbitration_lost",
    0x008: "protocol",
    0x010: "transceiver",
    0x020: "no_acknowledge",
    0x040: "bus_off",
    0x080: "bus_error",
    0x100: "restarted",
    0x1_0000: "controller_receive_overflow",
    0x2_0000: "controller_transmit_overflow",
    0x4_0000: "receive_warning",
    0x8_0000: "transmit_warning",
    0x10_0000: "receive_passive",
    0x20_0000: "transmit_passive",
    0x40_0000: "error_active",
}
"""Error classes, and above them states of the controller (linux/can/error.h)."""


class BusError(CangaugeError):
    """The bus failed while in use (interface down, adapter unplugged)."""


def error_kinds(message: can.Message) -> list[str]:
    """Return the error classes of a SocketCAN error frame, at least one.

    The classes are bits of the id; with 0x004, the controller's state is in byte 1.
    """
    classes = message.arbitration_id & 0x1FF
    is_of_controller = bool(classes & 0x004)
    state = message.data[1] if is_of_controller and len(message.data) > 1 else 0
    kinds = [name for bit, name in _ERRORS.items() if (state << 16 | classes) & bit]
    if is_of_controller and not state & 0x7F:
        kinds.append("controller")
    return kinds or ["unspecified"]


def _queue_drops(bus: can.BusABC) -> int | None:
    """Return the frames dropped by a full receive queue since the bus was opened (modulo 2³²).

    None where the system does not count them: buses that are not sockets, systems other than Linux.
    Read by SO_MEMINFO (Linux 4.12), which works at any time; SO_RXQ_OVFL comes with the next frame
    only, and python-can does not ask for it.
    """
    if sys.platform != "linux":
        return None
    with suppress(OSError, NotImplementedError, ValueError):
        with socket.socket(fileno=os.dup(bus.fileno())) as own:
            # SO_MEMINFO: nine numbers of 32 bits, the last of which are the drops.
            answer = own.getsockopt(socket.SOL_SOCKET, 55, 36)
        return int.from_bytes(answer[32:], sys.byteorder)
    return None


class BusConnection:
    """A bus in use; closed by `close`, or at the end of a `with` block.

    Parameters
    ----------
    bus : can.BusABC, optional
        None: no bus at present.
    address : BusAddress

    Attributes
    ----------
    garbled, unsent : int
        Packets that were no CAN frames (`udp_multicast` carries others too); frames dropped
        because the transmit queue stayed full (no other node?), or without a bus.
    error_frames, error_kinds : int, Counter of str
        Error frames of the controller, and their kinds; one frame may have several.
    is_off, is_drained : bool
        Whether the controller reported bus-off, with no frame received since; whether the receive
        queue was empty after the latest call that received.
    """

    def __init__(self, bus: can.BusABC | None, address: BusAddress) -> None:
        self.address = address
        self.name = str(address)
        self.garbled = self.error_frames = self.unsent = 0
        self.error_kinds: Counter[str] = Counter()
        self.is_off = self.is_drained = False
        self._bus = bus
        self._failed: BusError | None = None
        self._posted: deque[tuple[float, can.Message]] = deque()
        self._dropped_before: int | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the bus; the statistics remain."""
        if (bus := self._detach()) is not None:
            bus.shutdown()

    def receive(self, timeout_s: float) -> can.Message | None:
        """Return the next frame that passes the filters; None if none came in time."""
        messages = self.receive_pending(timeout_s, 1)
        return messages[0] if messages else None

    def receive_pending(self, timeout_s: float, at_most: int = AT_ONCE) -> list[can.Message]:
        """Return the pending frames that pass the filters; wait for the first.

        Raises BusError if the bus is gone.
        """
        if self._posted:
            self._send_posted()
            timeout_s = min(timeout_s, _POSTED_RETRY_S)
        bus = self._open_bus()
        messages: list[can.Message] = []
        if isinstance(bus, SocketcanBus | UdpMulticastBus) and self.is_drained:
            # python-can's `recv` measures its time-out by a clock that can be set.
            select.select([bus], [], [], timeout_s)
            timeout_s = 0.0
        self.is_drained = False
        for _ in range(AT_ONCE):
            wait_s, timeout_s = timeout_s, 0.0
            try:
                message = bus.recv(wait_s)
            except Exception as error:
                self._classify(error)
                if self._failed is not None:
                    if messages:  # those read before; the driver may not repeat the error
                        break
                    raise self._failed from error
                continue
            if message is None:
                self.is_drained = True
                break
            if message.is_error_frame:
                # Return now: a caller that checks `is_off` after each call must see every change.
                self.is_off = self.is_off and not messages
                self._count_error(message)
                return messages
            messages.append(message)
            if len(messages) == at_most:
                break
        self.is_off = self.is_off and not messages
        return messages

    def send(self, message: can.Message, within_s: float = SEND_WITHIN_S) -> bool:
        """Send a frame; return False if the transmit queue stayed full for `within_s` [s].

        Raises BusError if the bus is gone.
        """
        until_s = time.monotonic() + within_s
        while not self._try_to_send(message):
            if time.monotonic() >= until_s:
                self.unsent += 1
                return False
            time.sleep(_RETRY_S)
        return True

    def post(self, message: can.Message, within_s: float = SEND_WITHIN_S) -> None:
        """Send a frame without waiting; raise BusError if the bus is gone.

        While the transmit queue is full, posted frames are retried in order with every call that
        receives, and dropped after `within_s` [s].
        """
        self._posted.append((time.monotonic() + within_s, message))
        self._send_posted()

    @property
    def queue_drops(self) -> int | None:
        """Frames dropped because the receive queue was full; None where not counted."""
        now, before = None if self._bus is None else _queue_drops(self._bus), self._dropped_before
        return before if now is None else now + (before or 0)

    def set_filters(self, filters: Sequence[CanFilter]) -> None:
        """Receive only frames that pass these filters from now on; BusError if the bus is gone."""
        bus = self._open_bus()
        try:
            bus.set_filters(filters)
        except Exception as error:  # drivers raise anything
            raise self._lost(error, "setting filters") from error

    @property
    def carries_fd(self) -> bool:
        """Whether the bus is open for CAN FD frames."""
        return self._bus is not None and self._bus.protocol is not can.CanProtocol.CAN_20

    def _detach(self) -> can.BusABC | None:
        """Release the bus, if any, without closing it."""
        self._dropped_before = self.queue_drops
        bus, self._bus = self._bus, None
        self.unsent += len(self._posted)
        self._posted.clear()
        self.is_off = False
        return bus

    def _open_bus(self) -> can.BusABC:
        if self._failed is not None or self._bus is None:
            raise self._failed or BusError(f"{self.name}: not open")
        return self._bus

    def _try_to_send(self, message: can.Message) -> bool:
        """Return whether the transmit queue had room."""
        bus = self._open_bus()
        try:
            bus.send(message)
        except Exception as error:  # drivers raise anything
            if _is_queue_full(error):
                return False
            raise self._lost(error, "sending") from error
        return True

    def _send_posted(self) -> None:
        now_s = time.monotonic()
        while self._posted:
            until_s, message = self._posted[0]
            if now_s >= until_s:
                self.unsent += 1
            elif not self._try_to_send(message):
                return
            self._posted.popleft()

    def _count_error(self, message: can.Message) -> None:
        self.error_frames += 1
        has_classes = self.address.interface == "socketcan"
        kinds = error_kinds(message) if has_classes else ["unspecified"]
        self.error_kinds.update(kinds)
        self.is_off = "bus_off" in kinds or (self.is_off and "restarted" not in kinds)

    def _classify(self, error: Exception) -> None:
        """Count a packet that is no frame as garbled; take any other error as a lost bus.

        A driver that cannot unpack a packet raises a `CanOperationError`. Its cause is then an
        error of Python code, neither an OSError nor a CanError.
        """
        cause = error.__cause__
        is_packet = isinstance(error, can.CanOperationError) and cause is not None
        if is_packet and not isinstance(cause, OSError | can.CanError):
            self.garbled += 1
        else:
            self._failed = self._lost(error, "receiving")

    def _lost(self, error: BaseException, action: str) -> BusError:
        cause = " ".join(str(error.__cause__ or error).split()) or type(error).__name__
        return BusError(f"{self.name}: {action} failed: {cause}; is the bus up?")


def _is_queue_full(error: BaseException) -> bool:
    if isinstance(error, can.CanTimeoutError):
        return True
    code = getattr(error, "error_code", None)
    if code is None:
        cause = error.__cause__ or error
        code = cause.errno if isinstance(cause, OSError) else None
    return code in _QUEUE_FULL or "buffer full" in str(error)

"""An open bus: receive, send, classify the errors of drivers, reopen a lost bus.

A bad packet is counted and skipped; an error that means a lost bus becomes a `BusError`, which
`reconnecting` answers by opening it again. There are no threads: the caller runs the loop.
"""

from __future__ import annotations

import errno
import socket
import sys
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from itertools import chain, repeat
from typing import Final, Self

import can
from can.typechecking import CanFilter

from cangauge.bus.open import BusAddress, socket_of
from cangauge.errors import CangaugeError

AT_ONCE: Final = 64
"""Most pending frames received in one call, so that the caller gets its turn."""
_RETRY_S: Final = 0.001
"""Interval at which a frame is retried while the transmit queue is full [s]: half a frame of a slow
bus."""


class BusError(CangaugeError):
    """The bus failed while in use (interface down, adapter unplugged)."""


def _queue_drops(bus: can.BusABC) -> int | None:
    """Return the frames dropped by a full receive queue since the bus was opened (modulo 2³²).

    None where the system does not count them: buses that are not sockets, systems other than Linux.
    Read by SO_MEMINFO (Linux 4.12), which works at any time; SO_RXQ_OVFL comes with the next frame
    only, and python-can does not ask for it.
    """
    if sys.platform == "linux":
        with suppress(OSError, NotImplementedError, ValueError), socket_of(bus) as own:
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
    garbled, unsent, error_frames : int
        Packets that were no CAN frames (`udp_multicast` carries others too); frames dropped
        because the transmit queue stayed full (no other node?), or without a bus; error frames of
        the controller.
    is_off, is_drained : bool
        Whether the controller reported bus-off, with no frame received since; whether the receive
        queue was empty after the latest call that received.
    """

    def __init__(self, bus: can.BusABC | None, address: BusAddress) -> None:
        self.address = address
        self.name = str(address)
        self.garbled = self.error_frames = self.unsent = 0
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

        While posted frames wait for room, they are retried first, and the wait is short. Raises
        BusError if the bus is gone.
        """
        if self._posted:
            self._send_posted()
            timeout_s = min(timeout_s, _RETRY_S)
        return self._read(timeout_s, at_most)

    def _read(self, timeout_s: float, at_most: int) -> list[can.Message]:
        """Return up to `at_most` pending frames, as `receive_pending`.

        None after an error frame: a caller that checks `is_off` after each call sees every change.
        """
        bus, messages = self._open_bus(), list[can.Message]()
        self.is_drained = False
        for wait_s in chain([timeout_s], repeat(0.0, AT_ONCE - 1)):
            try:
                message = bus.recv(wait_s)
            except Exception as error:  # drivers raise anything
                if _is_of_packet(error):
                    self.garbled += 1
                    continue
                self._failed = self._failure("receiving", error)
                if messages:  # those read before; the driver may not repeat the error
                    break
                raise self._failed from error
            if message is None:
                self.is_drained = True
                break
            if message.is_error_frame:
                self._note_error_frame(message)
                break
            self.is_off = False
            messages.append(message)
            if len(messages) == at_most:
                break
        return messages

    def send(self, message: can.Message, within_s: float = 1.0) -> bool:
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

    def post(self, message: can.Message, within_s: float) -> None:
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
            raise self._failure("setting filters", error) from error

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
            raise self._failure("sending", error) from error
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

    def _note_error_frame(self, message: can.Message) -> None:
        self.error_frames += 1
        if self.address.interface == "socketcan":  # bits of linux/can/error.h; elsewhere none
            bus_off, restarted = (message.arbitration_id & bit for bit in (0x040, 0x100))
            self.is_off = bool(bus_off or (self.is_off and not restarted))

    def _failure(self, action: str, error: Exception) -> BusError:
        cause = " ".join(str(error.__cause__ or error).split()) or type(error).__name__
        return BusError(f"{self.name}: {action} failed: {cause}; is the bus up?")


def _is_of_packet(error: Exception) -> bool:
    """Return whether an error is that of a packet that is no frame, not of the bus.

    A driver that cannot unpack a packet raises a `CanOperationError`, whose cause is an error of
    Python code, neither an OSError nor a CanError.
    """
    cause = error.__cause__
    is_packet = isinstance(error, can.CanOperationError) and cause is not None
    return is_packet and not isinstance(cause, OSError | can.CanError)


def _is_queue_full(error: Exception) -> bool:
    cause = error.__cause__ or error
    code = getattr(error, "error_code", None) or getattr(cause, "errno", None)
    is_full = code in {errno.ENOBUFS, errno.EAGAIN} or "buffer full" in str(error)
    return is_full or isinstance(error, can.CanTimeoutError)

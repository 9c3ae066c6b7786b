"""An open bus: receive, send, classify the errors of drivers, reopen a lost bus.

A bad packet is counted and skipped; an error that means a lost bus becomes a `BusError`, which
`ReconnectingBus` answers by opening it again. There are no threads: the caller runs the
loop.

Pending frames of SocketCAN and UDP multicast are read from the socket until it is empty, one system
call per frame. python-can's `recv` calls `select` before every frame, and on UDP builds a message
of every packet before it looks at the id. The messages are those that `recv` gives.
"""

from __future__ import annotations

import errno
import logging
import os
import select
import socket
import struct
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Hashable, Sequence
from contextlib import suppress
from types import TracebackType
from typing import Any, Final, Protocol, Self, cast

import can
from can.interfaces.socketcan import SocketcanBus
from can.interfaces.socketcan.socketcan import capture_message
from can.interfaces.udp_multicast.bus import SO_TIMESTAMPNS
from can.typechecking import CanFilter

from cangauge._logging import emit
from cangauge.bus.open import (
    UNKNOWN_INTERFACE,
    BackendCapabilities,
    BusAddress,
    CheckedUdpBus,
    DriverMissingError,
    as_message,
    backend_capabilities,
    open_bus,
    unpack_fields,
)
from cangauge.bus.polling import PollCounts
from cangauge.errors import CangaugeError, InputError

_LOG = logging.getLogger(__name__)
_LINUX: Final = sys.platform == "linux"

SEND_WITHIN_S: Final = 1.0
"""Longest wait for room in the transmit queue [s]."""
AT_ONCE: Final = 64
"""Most pending frames received in one call, so that the caller gets its turn."""
_RETRY_S: Final = 0.0005
_POSTED_RETRY_S: Final = 0.005
"""Interval at which posted frames are retried while the transmit queue is full [s]."""
_QUEUE_FULL: Final = {errno.ENOBUFS, errno.EAGAIN}


class BusError(CangaugeError):
    """The bus failed while in use (interface down, adapter unplugged)."""


# --- Error frames (linux/can/error.h)

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
    """Return the error classes of a SocketCAN error frame.

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


# --- Pending frames

_SO_MEMINFO: Final = 55
_MEMINFO: Final = struct.Struct("=9I")
_MEMINFO_DROPS: Final = 8
_PACKET_BYTES: Final = 4096
"""As in python-can: a longer packet is truncated, and hence not a frame."""
_STAMP: Final = struct.Struct("@ll")
_IDS_KEPT: Final = 4096
"""Most ids whose filter result is cached: multicast packets can have any id."""
_DO_NOT_WAIT: Final = int(socket.MSG_DONTWAIT) if sys.platform == "linux" else 0


class NoPendingFrameError(Exception):
    """The bus has no frame at present (as `queue.Empty`)."""


class PendingFrames(Protocol):
    """Read the frames that are pending on a bus."""

    def next(self) -> can.Message | None:
        """Return the next frame; None for one that does not pass the filters.

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
        """Release what was opened; the bus stays open."""


def pending_frames(bus: can.BusABC) -> PendingFrames:
    """Return the reader of a bus's pending frames."""
    if _LINUX and isinstance(bus, SocketcanBus):
        return _SocketcanFrames(bus)
    if _LINUX and isinstance(bus, CheckedUdpBus):
        own = _duplicate_socket(bus)
        if own.getsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS):
            return _UdpFrames(bus, own)
        own.close()  # the kernel does not stamp the packets
    return _BusFrames(bus)


class _BusFrames:
    """Pending frames of any interface, by python-can's `recv`."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._waiting: can.Message | None = None

    def next(self) -> can.Message | None:
        message, self._waiting = self._waiting, None
        message = message or self._bus.recv(0.0)
        if message is None:
            raise NoPendingFrameError
        return message

    def wait(self, timeout_s: float) -> bool:
        self._waiting = self._bus.recv(timeout_s)
        return self._waiting is not None

    def forget_filters(self) -> None:
        pass

    def close(self) -> None:
        pass


class _SocketFrames:
    """Pending frames of a socket."""

    def __init__(self, own: socket.socket) -> None:
        self._socket = own

    def recvmsg(self, size: int, ancillary_size: int) -> tuple[Any, ...]:
        """Receive without waiting."""
        try:
            return self._socket.recvmsg(size, ancillary_size, _DO_NOT_WAIT)
        except BlockingIOError:
            raise NoPendingFrameError from None

    def wait(self, timeout_s: float) -> bool:
        return bool(select.select([self._socket], [], [], timeout_s)[0])

    def forget_filters(self) -> None:
        pass

    def close(self) -> None:
        pass


class _SocketcanFrames(_SocketFrames):
    """Pending frames of SocketCAN; the kernel filters."""

    def __init__(self, bus: SocketcanBus) -> None:
        super().__init__(bus.socket)
        self._channel = bus.channel

    def next(self) -> can.Message | None:
        # `capture_message` uses `recvmsg` alone.
        own = cast("socket.socket", self)
        message = capture_message(own, get_channel=not self._channel)
        if message is not None and self._channel:
            message.channel = self._channel
        return message


class _UdpFrames(_SocketFrames):
    """Pending frames of UDP multicast; no message is built of a frame with an unwanted id."""

    def __init__(self, bus: CheckedUdpBus, own: socket.socket) -> None:
        super().__init__(own)
        self._bus = bus
        self._stamp_space = socket.CMSG_SPACE(_STAMP.size)
        self._carries_fd = bus.protocol is can.CanProtocol.CAN_FD
        self._passes: dict[Hashable, bool] = {}

    def next(self) -> can.Message | None:
        packet, ((_, _, stamp),), _, sender = self.recvmsg(_PACKET_BYTES, self._stamp_space)
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
            passes = self._passes[key] = self._bus._matches_filters(message)  # noqa: SLF001
        return message if passes and (self._carries_fd or not message.is_fd) else None

    def forget_filters(self) -> None:
        self._passes.clear()

    def close(self) -> None:
        self._socket.close()


def _duplicate_socket(bus: can.BusABC) -> socket.socket:
    """Return a second handle of a bus's socket, which the driver keeps private."""
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


# --- A bus in use


class BusConnection:
    """A bus in use.

    Parameters
    ----------
    bus : can.BusABC, optional
        Closed by `close`, or at the end of a `with` block; None: no bus at present.
    name : str
        For messages.
    capabilities : BackendCapabilities, optional

    Attributes
    ----------
    garbled : int
        Packets that were no CAN frames (on `udp_multicast`, which carries other packets too).
    error_frames : int
        Error frames of the controller.
    error_kinds : Counter of str
        Their kinds; one frame may have several.
    is_off : bool
        Whether the controller reported bus-off, with no frame received since.
    unsent : int
        Frames dropped because the transmit queue stayed full (no other node?), or without a bus.
    is_drained : bool
        Whether the receive queue was empty after the latest call that received.
    foreign : int
        Frames from another sender with ids that the service sends; counted by its loop.
    polls : PollCounts or None
        What came of the loop's requests; None if it sends none.
    """

    def __init__(
        self,
        bus: can.BusABC | None,
        name: str,
        capabilities: BackendCapabilities = UNKNOWN_INTERFACE,
    ) -> None:
        self._bus: can.BusABC | None = None
        self._pending: PendingFrames | None = None
        self._is_empty = True
        self._failed: BusError | None = None
        self.name = name
        self.capabilities = capabilities
        self.garbled = 0
        self.error_frames = 0
        self.error_kinds: Counter[str] = Counter()
        self.is_off = False
        self.unsent = 0
        self.is_drained = False
        self.foreign = 0
        self.polls: PollCounts | None = None
        self._posted: deque[tuple[float, can.Message]] = deque()
        self._dropped_before: int | None = None
        if bus is not None:
            self._attach(bus)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the bus; the statistics remain."""
        bus = self._detach()
        if bus is not None:
            bus.shutdown()

    def receive(self, timeout_s: float) -> can.Message | None:
        """Return the next frame that passes the filters; None if none came in time.

        Raises
        ------
        BusError
            If the bus is gone.
        """
        messages = self._receive(timeout_s, 1)
        return messages[0] if messages else None

    def receive_pending(self, timeout_s: float) -> list[can.Message]:
        """Return the pending frames, at most `AT_ONCE`; wait for one if there are none.

        Returns
        -------
        list of can.Message
            Frames that pass the filters; empty if none came in time, or (sooner) none passed.

        Raises
        ------
        BusError
            If the bus is gone.
        """
        return self._receive(timeout_s, AT_ONCE)

    def _receive(  # noqa: C901 - one pass
        self, timeout_s: float, most: int
    ) -> list[can.Message]:
        pending = self._pending
        if self._posted:
            self._send_posted()
            timeout_s = min(timeout_s, _POSTED_RETRY_S)
        if self._failed is not None or pending is None:
            raise self._failed or BusError(f"{self.name}: not open")
        messages: list[can.Message] = []
        has_waited = False
        for _ in range(AT_ONCE):
            try:
                if self._is_empty:
                    if messages or has_waited or not pending.wait(timeout_s):
                        break
                    has_waited, self._is_empty = True, False
                message = pending.next()
            except NoPendingFrameError:
                self._is_empty = True
                continue
            except Exception as error:  # noqa: BLE001 - drivers raise anything
                try:
                    self._classify(error)
                except BusError as lost:
                    # Return the frames read before; the driver may not repeat the error.
                    self._failed = lost
                    if messages:
                        break
                    raise
                continue
            if message is None:
                continue
            if message.is_error_frame:
                # Return now: a caller that checks `is_off` after each call must see every change.
                self.is_off = self.is_off and not messages
                self._count_error(message)
                self.is_drained = False
                return messages
            messages.append(message)
            if len(messages) == most:
                break
        self.is_drained = self._is_empty
        self.is_off = self.is_off and not messages
        return messages

    def send(self, message: can.Message, within_s: float = SEND_WITHIN_S) -> bool:
        """Send a frame; return False if the transmit queue stayed full for `within_s` [s].

        Raises
        ------
        BusError
            If the bus is gone.
        """
        until_s = time.monotonic() + within_s
        while not self._try_to_send(message):
            if time.monotonic() >= until_s:
                self.unsent += 1
                return False
            time.sleep(_RETRY_S)
        return True

    def post(self, message: can.Message, within_s: float = SEND_WITHIN_S) -> None:
        """Send a frame without waiting.

        While the transmit queue is full, posted frames are retried in order with every call that
        receives, and dropped after `within_s` [s].

        Raises
        ------
        BusError
            If the bus is gone.
        """
        self._posted.append((time.monotonic() + within_s, message))
        self._send_posted()

    @property
    def queue_drops(self) -> int | None:
        """Frames dropped because the receive queue was full; None where not counted."""
        now = None if self._bus is None else queue_drops(self._bus)
        if now is None or self._dropped_before is None:
            return self._dropped_before if now is None else now
        return self._dropped_before + now

    def set_filters(self, filters: Sequence[CanFilter]) -> None:
        """Receive only frames that pass these filters from now on.

        Raises
        ------
        BusError
            If the bus is gone.
        """
        bus = self._open_bus()
        try:
            bus.set_filters(filters)
        except Exception as error:  # drivers raise anything
            raise self._lost(error, "setting filters") from error
        if self._pending is not None:
            self._pending.forget_filters()

    @property
    def carries_fd(self) -> bool:
        """Whether the bus is open for CAN FD frames."""
        return self._bus is not None and self._bus.protocol is not can.CanProtocol.CAN_20

    def _attach(self, bus: can.BusABC) -> None:
        self._bus, self._pending = bus, pending_frames(bus)
        self._is_empty, self._failed = True, None

    def _detach(self) -> can.BusABC | None:
        """Release the bus, if any, without closing it."""
        self._dropped_before = self.queue_drops
        bus, self._bus = self._bus, None
        if self._pending is not None:
            self._pending.close()
            self._pending = None
        self.unsent += len(self._posted)
        self._posted.clear()
        self.is_off = False
        return bus

    def _open_bus(self) -> can.BusABC:
        if self._bus is None:
            raise BusError(f"{self.name}: not open")
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
            if not self._try_to_send(message):
                if now_s < until_s:
                    return
                self.unsent += 1
            self._posted.popleft()

    def _count_error(self, message: can.Message) -> None:
        self.error_frames += 1
        kinds = error_kinds(message) if self.capabilities.has_error_classes else [UNSPECIFIED]
        self.error_kinds.update(kinds)
        if BUS_OFF in kinds:
            self.is_off = True
        elif RESTARTED in kinds:
            self.is_off = False

    def _classify(self, error: Exception) -> None:
        """Count an error of a single packet; raise any other as a lost bus.

        The driver could not unpack a packet where a `CanOperationError` has a cause in Python code.
        """
        cause = error.__cause__
        is_packet = isinstance(error, can.CanOperationError) and cause is not None
        if not is_packet or isinstance(cause, OSError | can.CanError):
            raise self._lost(error, "receiving") from error
        self.garbled += 1

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


# --- Reconnecting

FIRST_PAUSE_S: Final = 0.05
LONGEST_PAUSE_S: Final = 1.0
"""Pauses between attempts double from the first to the longest [s]. Frames between the return of
the bus and the next attempt are lost; the longest is below the gap that empties the delay line."""
STEADY_S: Final = 5.0
"""A bus lost after this time in use [s] is retried after the first pause; one that flaps keeps its
pause."""
REPORT_AFTER_S: Final = 1.0
"""Time without a bus after which failed attempts are logged [s]: a short outage needs one line."""

Opener = Callable[[BusAddress, Sequence[CanFilter] | None], can.BusABC]


class ReconnectingBus(BusConnection):
    """A bus in use that is reopened when it is lost. Never raises `BusError`.

    Without a bus, receiving waits and returns nothing, and frames to send are dropped and counted.
    Opening is retried with growing pauses, in the caller's thread: without a bus it has no more to
    do, and a driver that takes seconds to open delays it by them.
    Logs the events bus.missing, bus.lost, bus.away, bus.back, bus.off and bus.on.

    Parameters
    ----------
    address : BusAddress
    filters : sequence of CanFilter
    opener : callable, optional
        Opens the bus.

    Attributes
    ----------
    losses : int
        Number of times that the bus was lost.
    """

    def __init__(
        self, address: BusAddress, filters: Sequence[CanFilter], opener: Opener = open_bus
    ) -> None:
        super().__init__(None, str(address), backend_capabilities(address))
        self.losses = 0
        self._address = address
        self._filters = list(filters)
        self._opener = opener
        self._since_s = time.monotonic()
        self._away_s = 0.0
        self._is_closed = False
        self._pause_s = FIRST_PAUSE_S
        self._retry_at_s = 0.0
        self._was_off = False

    def open(self, *, wait: bool = False) -> None:
        """Open the bus for the first time.

        Parameters
        ----------
        wait : bool
            If the bus is missing, return without it; receiving retries.

        Raises
        ------
        InputError
            As `open_bus`; with `wait` only for a missing driver.
        """
        try:
            self._attach(self._opener(self._address, self._filters))
        except InputError as error:
            if not wait or isinstance(error, DriverMissingError):
                raise
            self._schedule_attempt()
            self._log(
                "bus.missing", logging.WARNING, f"not available yet ({error}); waiting for it"
            )
        self._since_s = time.monotonic()

    def close(self) -> None:
        """Close the bus, if any."""
        self._away_s = self.away_s
        self._is_closed = True
        super().close()

    def post(self, message: can.Message, within_s: float = SEND_WITHIN_S) -> None:
        """Send a frame without waiting; drop it while the bus is away."""
        if self._bus is None:
            self.unsent += 1
            return
        try:
            super().post(message, within_s)
        except BusError as error:
            self._lose(error)

    def set_filters(self, filters: Sequence[CanFilter]) -> None:
        """Receive only frames that pass these filters from now on."""
        self._filters = list(filters)
        if self._bus is None:
            return
        try:
            super().set_filters(self._filters)
        except BusError as error:
            self._lose(error)

    @property
    def is_away(self) -> bool:
        """Whether there is no bus at present."""
        return self._bus is None and not self._is_closed

    @property
    def away_s(self) -> float:
        """Total time without a bus [s]."""
        return self._away_s + (time.monotonic() - self._since_s if self.is_away else 0.0)

    @property
    def trouble(self) -> str:
        """Present problem of the bus as a phrase; "" without one."""
        phrases = []
        if self.is_away:
            phrases.append(f"bus away for {time.monotonic() - self._since_s:.0f} s")
        if self.is_off:
            phrases.append("bus-off")
        if drops := self.queue_drops:
            phrases.append(f"{drops} frames lost in the receive queue")
        return ", ".join(phrases)

    def _receive(self, timeout_s: float, most: int) -> list[can.Message]:
        """Receive; while the bus is away, wait and try to open it."""
        if self._bus is None:
            self._reconnect(timeout_s)
            return []
        try:
            messages = super()._receive(timeout_s, most)
        except BusError as error:
            self._lose(error)
            return []
        if self.is_off != self._was_off:
            self._was_off = self.is_off
            self._log_off()
        return messages

    def _lose(self, error: BusError) -> None:
        now_s = time.monotonic()
        if now_s - self._since_s >= STEADY_S:
            self._pause_s = FIRST_PAUSE_S
        self.losses += 1
        if (bus := self._detach()) is not None:
            # Drivers may raise anything when they close a lost bus; nothing depends on it.
            with suppress(Exception):
                bus.shutdown()
        self._was_off = False
        self._since_s = now_s
        self._schedule_attempt()
        emit(_LOG, logging.WARNING, "bus.lost", f"{error} Reconnecting")

    def _schedule_attempt(self) -> None:
        self._retry_at_s = time.monotonic() + self._pause_s
        self._pause_s = min(2.0 * self._pause_s, LONGEST_PAUSE_S)

    def _reconnect(self, timeout_s: float) -> None:
        """Try to open the bus when that is due, or wait for it."""
        left_s = self._retry_at_s - time.monotonic()
        if left_s > 0.0:
            time.sleep(min(left_s, timeout_s))
            return
        try:
            bus = self._opener(self._address, self._filters)
        except Exception as error:  # noqa: BLE001 - drivers raise anything
            self._schedule_attempt()
            away_s = time.monotonic() - self._since_s
            if away_s >= REPORT_AFTER_S:
                reason = str(error) or type(error).__name__
                text = f"away for {away_s:.0f} s ({reason}); retrying"
                self._log("bus.away", logging.WARNING, text)
            return
        now_s = time.monotonic()
        away_s, self._since_s = now_s - self._since_s, now_s
        self._away_s += away_s
        self._attach(bus)
        text = f"{'back' if self.losses else 'available'} after {away_s:.1f} s"
        self._log("bus.back", logging.INFO, text)

    def _log_off(self) -> None:
        if self.is_off:
            cure = f"ip link set {self._address.channel} type can restart-ms 100"
            text = f"the controller is bus-off until the kernel restarts it (automatically: {cure})"
            self._log("bus.off", logging.WARNING, text)
        else:
            self._log("bus.on", logging.INFO, "no longer bus-off")

    def _log(self, event: str, level: int, text: str) -> None:
        emit(_LOG, level, event, f"{self.name}: {text}")

"""What python-can's interfaces do differently, as far as the service must know it.

What SocketCAN's error frames tell (linux/can/error.h).

The classes are bits of the id, of which python-can hands on the lower eleven: all that name a
kind. What ails the controller stands in byte 1, and one frame may tell several kinds.

Frames that the kernel dropped because the receive queue of a bus's socket was full.

python-can asks for no such count. SO_RXQ_OVFL tells it beside the next frame that is received, so
only to whoever owns the receive call, and never if no more frames come. The same counter of the
socket can be read at any time by SO_MEMINFO (Linux 4.12 and later), on any socket: that is what is
done here, beside python-can and without touching how it receives.

Frames that wait in a bus's socket, read without asking first whether there is one.

python-can's `recv` asks by `select` ahead of every frame, and on UDP makes a message of every
packet before it looks at the id. For the two interfaces whose sockets are known, what waits is
read here until nothing is left: a system call a frame. The messages are made by python-can's own
functions, and are those that its `recv` gives.

Receiving and sending on an open bus, with the errors of drivers sorted out.

What is only one bad packet is counted and passed over; what means that the bus is gone becomes a
`BusError`. No threads: whoever calls owns the loop. (A bus that comes back: `lasting`.)
"""

from __future__ import annotations

import errno
import os
import select
import socket
import struct
import sys
import time
from collections import Counter, deque
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Final, Literal, Protocol, Self, cast

import can
from can.interfaces.socketcan import SocketcanBus
from can.interfaces.socketcan.socketcan import capture_message
from can.interfaces.udp_multicast import UdpMulticastBus
from can.interfaces.udp_multicast.bus import SO_TIMESTAMPNS
from can.typechecking import CanFilter

from cangauge.bus.open import BusAddress
from cangauge.errors import CangaugeError

# --- What python-can's interfaces do differently, as far as the service must know it

Stamps = Literal["kernel", "sender", "driver"]

_LINUX: Final = sys.platform == "linux"


@dataclass(frozen=True)
class BackendCapabilities:
    """What an interface does.

    Parameters
    ----------
    stamps : {"kernel", "sender", "driver"}
        Who stamps a received frame. "kernel": when it came in, however late it is read
        (SO_TIMESTAMPNS). "sender": when it was sent (within one process). "driver": whatever
        python-can's driver for it gives, the adapter's own clock or the moment of reading.
    echoes : bool
        Whether one's own frames come back.
    has_error_classes : bool
        Whether error frames tell their kinds as SocketCAN's do.
    """

    stamps: Stamps
    echoes: bool
    has_error_classes: bool


UNKNOWN_INTERFACE: Final = BackendCapabilities("driver", echoes=False, has_error_classes=False)


def backend_capabilities(address: BusAddress) -> BackendCapabilities:
    """Return what the interface of an address does."""
    asked = bool(address.options.get("receive_own_messages", False))
    if address.interface == "socketcan":
        return BackendCapabilities("kernel", echoes=asked, has_error_classes=True)
    if address.interface == "udp_multicast":
        # Elsewhere python-can stamps when it reads.
        stamps: Stamps = "kernel" if _LINUX else "driver"
        return BackendCapabilities(stamps, echoes=True, has_error_classes=False)
    stamps = "sender" if address.interface == "virtual" else "driver"
    return BackendCapabilities(stamps, echoes=asked, has_error_classes=False)


# --- What SocketCAN's error frames tell (linux/can/error.h)

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
    """Return what one error frame of SocketCAN tells; `UNSPECIFIED` where it names no kind."""
    classes = message.arbitration_id
    kinds = [name for bit, name in _CLASSES.items() if classes & bit]
    if classes & _CONTROLLER:
        state = message.data[1] if len(message.data) > 1 else 0
        states = [name for bit, name in _CONTROLLER_STATES.items() if state & bit]
        kinds += states or ["controller"]
    return kinds or [UNSPECIFIED]


# --- Frames that the kernel dropped because the receive queue of a bus's socket was full

_SO_MEMINFO: Final = 55
_MEMINFO: Final = struct.Struct("=9I")
_DROPS: Final = 8
"""Place of SK_MEMINFO_DROPS among the numbers."""


def queue_drops(bus: can.BusABC) -> int | None:
    """Return the frames dropped since the bus was opened (modulo 2³²).

    None where nobody counts: other systems than Linux, and buses that are no sockets.
    """
    if sys.platform != "linux":
        return None
    try:
        # The driver keeps its socket to itself; a duplicate of the descriptor is the same socket.
        descriptor = os.dup(bus.fileno())
    except (OSError, NotImplementedError, ValueError):
        return None
    try:
        own = socket.socket(fileno=descriptor)
    except OSError:  # no socket: a device, an event of a driver
        os.close(descriptor)
        return None
    with own:
        try:
            answer = own.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
        except OSError:
            return None
    if len(answer) < _MEMINFO.size:
        return None
    return int(_MEMINFO.unpack(answer)[_DROPS])


# --- Frames that wait in a bus's socket, read without asking first whether there is one

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


class PendingFrames(Protocol):
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


def pending_frames(bus: can.BusABC) -> PendingFrames | None:
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


# --- Receiving and sending on an open bus, with the errors of drivers sorted out

SEND_WITHIN_S: Final = 1.0
"""How long sending may wait for room in the transmit queue [s]."""

AT_ONCE: Final = 64
"""So many frames that wait are received in one go at most: there is more to do than receive."""

_RETRY_S: Final = 0.0005
_POSTED_RETRY_S: Final = 0.005
"""So soon posted frames that found the transmit queue full are tried again [s]."""
_QUEUE_FULL: Final = {errno.ENOBUFS, errno.EAGAIN}


class BusError(CangaugeError):
    """The bus failed while in use (interface down, adapter unplugged)."""


class BusConnection:
    """A bus in use.

    Parameters
    ----------
    bus : can.BusABC, optional
        Closed by `close`, or at the end of a `with` block; None: there is none at present.
    name : str
        For messages.
    facts : BackendCapabilities, optional
        What its interface does.

    Attributes
    ----------
    garbled : int
        Packets that were no CAN frames (on `udp_multicast`, where anybody may send).
    error_frames : int
        Error frames that the controller reported.
    error_kinds : Counter of str
        What they told; one frame may tell several kinds.
    is_off : bool
        The controller has told that it is bus-off, and nothing came since.
    unsent : int
        Frames given up because the transmit queue stayed full (nobody else on the bus?), or
        because there was no bus.
    """

    def __init__(
        self, bus: can.BusABC | None, name: str, facts: BackendCapabilities = UNKNOWN_INTERFACE
    ) -> None:
        self._bus: can.BusABC | None = None
        self._waiting: PendingFrames | None = None
        self._is_empty = True
        self._failed: BusError | None = None
        self.name = name
        self.facts = facts
        self.garbled = 0
        self.error_frames = 0
        self.error_kinds: Counter[str] = Counter()
        self.is_off = False
        self.unsent = 0
        self._posted: deque[tuple[float, can.Message]] = deque()
        self._dropped_before: int | None = None
        if bus is not None:
            self._use(bus)

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
        """Close the bus; what was counted stays."""
        bus = self._take_bus()
        if bus is not None:
            bus.shutdown()

    def receive(self, timeout_s: float) -> can.Message | None:
        """Return the next frame that passes the filters; None if none came in time.

        Raises
        ------
        BusError
            If the bus is gone.
        """
        timeout_s = self._before_receiving(timeout_s)
        try:
            message = self._open_bus().recv(timeout_s)
        except BusError:
            raise
        except Exception as error:  # noqa: BLE001 - drivers raise what they like
            self._sort_out(error)
            return None
        if message is None:
            return None
        if message.is_error_frame:
            self._count_error(message)
            return None
        self.is_off = False
        return message

    def receive_waiting(self, timeout_s: float) -> list[can.Message]:
        """Return the frames that wait, `AT_ONCE` at most; if none does, wait for one.

        Returns
        -------
        list of can.Message
            Those that pass the filters; empty if none came in time, or (sooner) none that passes.

        Raises
        ------
        BusError
            If the bus is gone.
        """
        if self._waiting is None:
            message = self.receive(timeout_s)
            return [] if message is None else [message]
        timeout_s = self._before_receiving(timeout_s)
        if self._failed is not None:
            raise self._failed
        try:
            # While they come faster than they are taken, nobody needs to ask whether any waits.
            if self._is_empty and not self._waiting.wait(timeout_s):
                return []
        except Exception as error:  # noqa: BLE001 - as above
            self._sort_out(error)
        return self._read(self._waiting)

    def _read(self, waiting: PendingFrames) -> list[can.Message]:
        found: list[can.Message] = []
        self._is_empty = False
        take_next = waiting.next
        for _ in range(AT_ONCE):
            try:
                message = take_next()
            except NothingWaitsError:
                self._is_empty = True
                break
            except Exception as error:  # noqa: BLE001 - as above
                try:
                    self._sort_out(error)
                except BusError as lost:
                    # What was read before is good; the error comes but once.
                    self._failed = lost
                    if found:
                        break
                    raise
                continue
            if message is None:
                continue
            if message.is_error_frame:
                # Ends this go: whoever looks at `is_off` after each misses no change of it.
                self.is_off = self.is_off and not found
                self._count_error(message)
                return found
            found.append(message)
        if found:
            self.is_off = False
        return found

    def send(self, message: can.Message, within_s: float = SEND_WITHIN_S) -> bool:
        """Send a frame; return False if the transmit queue stayed full for `within_s` [s].

        Raises
        ------
        BusError
            If the bus is gone.
        """
        give_up_s = 0.0
        while not self._try_to_send(message):
            now_s = time.monotonic()
            give_up_s = give_up_s or now_s + within_s
            if now_s >= give_up_s:
                self.unsent += 1
                return False
            time.sleep(_RETRY_S)
        return True

    def post(self, message: can.Message, within_s: float = SEND_WITHIN_S) -> None:
        """Send a frame without ever waiting.

        While the transmit queue is full it is tried again whenever something is received or
        looked for, in order, and given up after `within_s` [s].

        Raises
        ------
        BusError
            If the bus is gone.
        """
        self._posted.append((time.monotonic() + within_s, message))
        self._send_posted()

    @property
    def queue_drops(self) -> int | None:
        """Frames that the kernel dropped because the receive queue was full; None: not told."""
        now = None if self._bus is None else queue_drops(self._bus)
        if now is None or self._dropped_before is None:
            return self._dropped_before if now is None else now
        return self._dropped_before + now

    def set_filters(self, filters: Sequence[CanFilter]) -> None:
        """Receive only what passes these filters from now on.

        Raises
        ------
        BusError
            If the bus is gone.
        """
        try:
            self._open_bus().set_filters(filters)
            if self._waiting is not None:
                self._waiting.forget_filters()
        except BusError:
            raise
        except Exception as error:  # as when receiving
            raise self._lost(error, "setting filters") from error

    @property
    def carries_fd(self) -> bool:
        """Whether the bus is open for CAN FD frames."""
        return self._bus is not None and self._bus.protocol is not can.CanProtocol.CAN_20

    def _before_receiving(self, timeout_s: float) -> float:
        """Send what waits for room; return how long receiving may block then [s]."""
        if not self._posted:
            return timeout_s
        self._send_posted()
        return min(timeout_s, _POSTED_RETRY_S)

    def _sort_out(self, error: Exception) -> None:
        """Count what is one packet's fault only; raise what means that the bus is gone.

        Drivers raise what they like, asserts and errors of libraries included. One bad packet is
        none of the bus's; whatever else it was, this bus is of no more use.
        """
        if not _is_one_packets(error):
            raise self._lost(error, "receiving") from error
        self.garbled += 1

    def _use(self, bus: can.BusABC) -> None:
        self._bus, self._waiting = bus, pending_frames(bus)
        self._is_empty, self._failed = True, None

    def _open_bus(self) -> can.BusABC:
        if self._bus is None:
            raise BusError(f"{self.name}: not open")
        return self._bus

    def _take_bus(self) -> can.BusABC | None:
        """Give up the bus, if there is one, without closing it."""
        self._dropped_before = self.queue_drops
        bus, self._bus = self._bus, None
        if self._waiting is not None:
            self._waiting.close()
            self._waiting = None
        self.unsent += len(self._posted)
        self._posted.clear()
        self.is_off = False
        return bus

    def _try_to_send(self, message: can.Message) -> bool:
        """Return whether the transmit queue had room."""
        try:
            self._open_bus().send(message)
        except BusError:
            raise
        except Exception as error:  # as when receiving
            if _is_full(error):
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
        kinds = error_kinds(message) if self.facts.has_error_classes else [UNSPECIFIED]
        self.error_kinds.update(kinds)
        if BUS_OFF in kinds:
            self.is_off = True
        elif RESTARTED in kinds:
            self.is_off = False

    def _lost(self, error: BaseException, doing: str) -> BusError:
        said = " ".join(str(error.__cause__ or error).split()) or type(error).__name__
        return BusError(f"{self.name}: {doing} failed: {said}; is the bus up?")


def _is_one_packets(error: BaseException) -> bool:
    """Return whether receiving failed for one packet's content only, and not for good.

    That is told by an error of Python's own (the driver could not unpack it).
    """
    cause = error.__cause__
    if not isinstance(error, can.CanOperationError) or cause is None:
        return False
    return not isinstance(cause, OSError | can.CanError)


def _is_full(error: BaseException) -> bool:
    if isinstance(error, can.CanTimeoutError):
        return True
    code = getattr(error, "error_code", None)
    if code is None:
        cause = error.__cause__ or error
        code = cause.errno if isinstance(cause, OSError) else None
    return code in _QUEUE_FULL or "buffer full" in str(error)

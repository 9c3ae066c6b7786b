"""Receiving and sending on an open bus, with the errors of drivers sorted out.

What is only one bad packet is counted and passed over; what means that the bus is gone becomes a
`BusError`. No threads: whoever calls owns the loop. (A bus that comes back: `lasting`.)
"""

from __future__ import annotations

import errno
import time
from collections import Counter, deque
from collections.abc import Sequence
from types import TracebackType
from typing import Final, Self

import can
from can.typechecking import CanFilter

from cangauge.bus.error_frames import BUS_OFF, RESTARTED, UNSPECIFIED, error_kinds
from cangauge.bus.interface_facts import UNKNOWN_INTERFACE, InterfaceFacts
from cangauge.bus.queue_drops import queue_drops
from cangauge.bus.waiting import NothingWaitsError, WaitingFrames, waiting_frames
from cangauge.errors import CangaugeError

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


class BusPort:
    """A bus in use.

    Parameters
    ----------
    bus : can.BusABC, optional
        Closed by `close`, or at the end of a `with` block; None: there is none at present.
    name : str
        For messages.
    facts : InterfaceFacts, optional
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
        self, bus: can.BusABC | None, name: str, facts: InterfaceFacts = UNKNOWN_INTERFACE
    ) -> None:
        self._bus: can.BusABC | None = None
        self._waiting: WaitingFrames | None = None
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

    def _read(self, waiting: WaitingFrames) -> list[can.Message]:
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
        self._bus, self._waiting = bus, waiting_frames(bus)
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

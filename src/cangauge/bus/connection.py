"""An open bus: receive, send, and classify the errors of drivers.

A bad packet is counted and skipped; an error that means a lost bus becomes a `BusError`. There are
no threads: the caller runs the loop. `reconnect.ReconnectingBus` reopens a lost bus.
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

from cangauge.bus.backend import (
    BUS_OFF,
    RESTARTED,
    UNKNOWN_INTERFACE,
    UNSPECIFIED,
    BackendCapabilities,
    NoPendingFrameError,
    PendingFrames,
    error_kinds,
    pending_frames,
    queue_drops,
)
from cangauge.bus.polling import PollCounts
from cangauge.errors import CangaugeError

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
        timeout_s = self._before_receiving(timeout_s)
        self.is_drained = False
        try:
            message = self._open_bus().recv(timeout_s)
        except BusError:
            raise
        except Exception as error:  # noqa: BLE001 - drivers raise anything
            self._classify(error)
            return None
        if message is None:
            self.is_drained = True
            return None
        if message.is_error_frame:
            self._count_error(message)
            return None
        self.is_off = False
        return message

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
        if self._pending is None:
            return self._receive_one_by_one(timeout_s)
        timeout_s = self._before_receiving(timeout_s)
        if self._failed is not None:
            raise self._failed
        try:
            # After a full read more frames are probably pending: do not wait.
            if self._is_empty and not self._pending.wait(timeout_s):
                self.is_drained = True
                return []
        except Exception as error:  # noqa: BLE001 - as above
            self._classify(error)
        return self._read(self._pending)

    def _receive_one_by_one(self, timeout_s: float) -> list[can.Message]:
        found: list[can.Message] = []
        if self._failed is not None:
            raise self._failed
        while len(found) < AT_ONCE:
            try:
                message = self.receive(0.0 if found else timeout_s)
            except BusError as lost:
                if not found:
                    raise
                self._failed = lost  # as below
                break
            if message is None:
                break
            found.append(message)
        return found

    def _read(self, pending: PendingFrames) -> list[can.Message]:
        found: list[can.Message] = []
        self._is_empty = self.is_drained = False
        for _ in range(AT_ONCE):
            try:
                message = pending.next()
            except NoPendingFrameError:
                self._is_empty = self.is_drained = True
                break
            except Exception as error:  # noqa: BLE001 - as above
                try:
                    self._classify(error)
                except BusError as lost:
                    # Return the frames read before; the driver may not repeat the error.
                    self._failed = lost
                    if found:
                        break
                    raise
                continue
            if message is None:
                continue
            if message.is_error_frame:
                # Return now: a caller that checks `is_off` after each call must see every change.
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
        try:
            self._open_bus().set_filters(filters)
            if self._pending is not None:
                self._pending.forget_filters()
        except BusError:
            raise
        except Exception as error:  # as when receiving
            raise self._lost(error, "setting filters") from error

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

    def _before_receiving(self, timeout_s: float) -> float:
        """Send posted frames; return how long receiving may block then [s]."""
        if not self._posted:
            return timeout_s
        self._send_posted()
        return min(timeout_s, _POSTED_RETRY_S)

    def _try_to_send(self, message: can.Message) -> bool:
        """Return whether the transmit queue had room."""
        try:
            self._open_bus().send(message)
        except BusError:
            raise
        except Exception as error:  # as when receiving
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

        Drivers raise anything, including asserts and errors of libraries. The driver could not
        unpack a packet where a `CanOperationError` has a cause in Python code.
        """
        cause = error.__cause__
        if (
            not isinstance(error, can.CanOperationError)
            or cause is None
            or isinstance(cause, OSError | can.CanError)
        ):
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

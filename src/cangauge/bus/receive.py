"""Receiving and sending on an open bus, with the errors of drivers sorted out.

What is only one bad packet is counted and passed over; what means that the bus is gone becomes a
`BusError`. No threads: whoever calls owns the loop.
"""

from __future__ import annotations

import errno
import time
from types import TracebackType
from typing import Final, Self

import can
from can.typechecking import CanFilter

from cangauge.errors import CangaugeError

SEND_WITHIN_S: Final = 1.0
"""How long sending may wait for room in the transmit queue [s]."""

_RETRY_S: Final = 0.0005
_QUEUE_FULL: Final = {errno.ENOBUFS, errno.EAGAIN}


class BusError(CangaugeError):
    """The bus failed while in use (interface down, adapter unplugged)."""


class BusPort:
    """A bus in use.

    Parameters
    ----------
    bus : can.BusABC
        Closed by `close`, or at the end of a `with` block.
    name : str
        For messages.

    Attributes
    ----------
    garbled : int
        Packets that were no CAN frames (on `udp_multicast`, where anybody may send).
    error_frames : int
        Error frames that the controller reported.
    unsent : int
        Frames given up because the transmit queue stayed full: nobody else on the bus?
    """

    def __init__(self, bus: can.BusABC, name: str) -> None:
        self._bus = bus
        self.name = name
        self.garbled = 0
        self.error_frames = 0
        self.unsent = 0

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
        """Close the bus."""
        self._bus.shutdown()

    def receive(self, timeout_s: float) -> can.Message | None:
        """Return the next frame that passes the filters; None if none came in time.

        Raises
        ------
        BusError
            If the bus is gone.
        """
        try:
            message = self._bus.recv(timeout_s)
        except can.CanOperationError as error:
            if _is_lost(error):
                raise self._lost(error, "receiving") from error
            self.garbled += 1
            return None
        except (OSError, can.CanError, ValueError) as error:
            # ValueError: select on a socket that was closed.
            raise self._lost(error, "receiving") from error
        if message is not None and message.is_error_frame:
            self.error_frames += 1
            return None
        return message

    def send(self, message: can.Message, within_s: float = SEND_WITHIN_S) -> bool:
        """Send a frame; return False if the transmit queue stayed full for `within_s` [s].

        Raises
        ------
        BusError
            If the bus is gone.
        """
        give_up_s = 0.0
        while True:
            try:
                self._bus.send(message)
            except (OSError, can.CanError, ValueError) as error:
                if not _is_full(error):
                    raise self._lost(error, "sending") from error
            else:
                return True
            now_s = time.monotonic()
            give_up_s = give_up_s or now_s + within_s
            if now_s >= give_up_s:
                self.unsent += 1
                return False
            time.sleep(_RETRY_S)

    def set_filters(self, filters: list[CanFilter]) -> None:
        """Receive only what passes these filters from now on."""
        self._bus.set_filters(filters)

    @property
    def carries_fd(self) -> bool:
        """Whether the bus is open for CAN FD frames."""
        return self._bus.protocol is not can.CanProtocol.CAN_20

    def _lost(self, error: BaseException, doing: str) -> BusError:
        said = " ".join(str(error.__cause__ or error).split()) or type(error).__name__
        return BusError(f"{self.name}: {doing} failed: {said}; is the bus up?")


def _is_lost(error: can.CanOperationError) -> bool:
    """Return whether receiving failed for good, and not only for one packet's content.

    Only the latter is told by an error of Python's own (the driver could not unpack it).
    """
    return error.__cause__ is None or isinstance(error.__cause__, OSError | can.CanError)


def _is_full(error: BaseException) -> bool:
    code = getattr(error, "error_code", None)
    if code is None:
        cause = error.__cause__ or error
        code = cause.errno if isinstance(cause, OSError) else None
    return code in _QUEUE_FULL or "buffer full" in str(error)

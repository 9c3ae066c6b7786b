"""A bus that may go and come back: interface down, removed or not there yet, adapter unplugged.

`ReconnectingBus` never raises once it is open. While the bus is away, receiving waits and returns
nothing, frames to send are counted and dropped, and opening is tried again and again with growing
pauses, in a thread of its own since some drivers take seconds for it.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final, TypeVar

import can
from can.typechecking import CanFilter

from cangauge._logging import emit
from cangauge.bus.connection import SEND_WITHIN_S, BusConnection, BusError, backend_capabilities
from cangauge.bus.open import BusAddress, DriverMissingError, open_bus
from cangauge.errors import InputError

FIRST_PAUSE_S: Final = 0.05
LONGEST_PAUSE_S: Final = 1.0
"""Pauses between tries double from the first to this [s]. What arrives in the last one is lost."""

STEADY_S: Final = 5.0
"""A bus that held for so long [s] is tried again at once when it goes; one that comes and goes is
not."""

REMIND_S: Final = 60.0
"""While nothing changes, a bus that is away is mentioned so often [s]."""

_LOG = logging.getLogger(__name__)
_Received = TypeVar("_Received")
Opener = Callable[[BusAddress, Sequence[CanFilter] | None], can.BusABC]


class ReconnectingBus(BusConnection):
    """A bus in use that is opened again when it was lost.

    Parameters
    ----------
    address : BusAddress
    filters : sequence of CanFilter
    opener : callable, optional
        Opens the bus.

    Attributes
    ----------
    losses : int
        How often the bus was lost.
    """

    def __init__(
        self,
        address: BusAddress,
        filters: Sequence[CanFilter],
        opener: Opener = open_bus,
    ) -> None:
        super().__init__(None, str(address), backend_capabilities(address))
        self.losses = 0
        self._address = address
        self._filters = list(filters)
        self._opener = opener
        self._attempt: _Attempt | None = None
        self._lost_bus: can.BusABC | None = None
        self._since_s = time.monotonic()
        self._away_s = 0.0
        self._is_closed = False
        self._pause_s = FIRST_PAUSE_S
        self._try_at_s = 0.0
        self._reason = ""
        self._remind_at_s = 0.0
        self._was_off = False

    def open(self, *, wait: bool = False) -> None:
        """Open the bus for the first time.

        Parameters
        ----------
        wait : bool
            If it is not there, come back without it and go on trying while receiving.

        Raises
        ------
        InputError
            As `open_bus`; with `wait` only where waiting cannot help.
        """
        try:
            self._use(self._opener(self._address, self._filters))
        except DriverMissingError:
            raise
        except InputError as error:
            if not wait:
                raise
            self._go_away(str(error))
            _report(
                logging.WARNING,
                "bus.missing",
                f"{self.name}: not there yet ({error}); waiting for it",
            )
            return
        self._since_s = time.monotonic()

    def close(self) -> None:
        """Close the bus, or give up the try to open it."""
        if self._attempt is not None:
            self._attempt.abandon()
            self._attempt = None
        self._away_s = self.away_s
        self._is_closed = True
        super().close()

    def receive(self, timeout_s: float) -> can.Message | None:
        """Return the next frame that passes the filters; None if none came in time.

        While the bus is away it waits, and tries to open it.
        """
        return self._received(super().receive, timeout_s)

    def receive_waiting(self, timeout_s: float) -> list[can.Message]:
        """Return the frames that wait; empty if none came in time.

        While the bus is away it waits, and tries to open it.
        """
        return self._received(super().receive_waiting, timeout_s) or []

    def post(self, message: can.Message, within_s: float = SEND_WITHIN_S) -> None:
        """Send a frame without ever waiting; while the bus is away it is dropped."""
        if self._bus is None:
            self.unsent += 1
            return
        try:
            super().post(message, within_s)
        except BusError as error:
            self._lose(error)

    def set_filters(self, filters: Sequence[CanFilter]) -> None:
        """Receive only what passes these filters from now on."""
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
        """For how long there was no bus, in total [s]."""
        return self._away_s + (time.monotonic() - self._since_s if self.is_away else 0.0)

    @property
    def trouble(self) -> str:
        """What is or went wrong with the bus, in words; empty if nothing did."""
        found = []
        if self.is_away:
            found.append(f"bus away for {time.monotonic() - self._since_s:.0f} s")
        if self.is_off:
            found.append("bus-off")
        if drops := self.queue_drops:
            found.append(f"{drops} frames lost in the receive queue")
        return ", ".join(found)

    def _received(
        self, receive: Callable[[float], _Received], timeout_s: float
    ) -> _Received | None:
        """Return what is received; None if the bus is away or goes."""
        if self._bus is None:
            self._try_again(timeout_s)
            return None
        try:
            received = receive(timeout_s)
        except BusError as error:
            self._lose(error)
            return None
        if self.is_off != self._was_off:
            self._tell_off()
        return received

    def _lose(self, error: BusError) -> None:
        now_s = time.monotonic()
        if now_s - self._since_s >= STEADY_S:
            self._pause_s = FIRST_PAUSE_S
        self.losses += 1
        self._lost_bus = self._take_bus()
        self._was_off = False
        self._go_away("")
        _report(logging.WARNING, "bus.lost", f"{error} Trying again until it is back")

    def _go_away(self, reason: str) -> None:
        now_s = self._since_s = time.monotonic()
        self._reason = reason
        self._remind_at_s = now_s + REMIND_S
        self._try_later(now_s)

    def _try_later(self, now_s: float) -> None:
        self._try_at_s = now_s + self._pause_s
        self._pause_s = min(2.0 * self._pause_s, LONGEST_PAUSE_S)

    def _try_again(self, timeout_s: float) -> None:
        if self._attempt is None:
            left_s = self._try_at_s - time.monotonic()
            if left_s > 0.0:
                time.sleep(min(left_s, timeout_s))
                return
            self._attempt = _Attempt(self._opener, self._address, self._filters, self._lost_bus)
            self._lost_bus = None
        outcome = self._attempt.wait(timeout_s)
        if outcome is None:
            return
        filters, self._attempt = self._attempt.filters, None
        now_s = time.monotonic()
        if isinstance(outcome, str):
            self._try_later(now_s)
            is_news = self._reason not in {outcome, ""}
            self._reason = outcome
            if is_news or now_s >= self._remind_at_s:
                self._remind_at_s = now_s + REMIND_S
                away = f"away for {now_s - self._since_s:.0f} s"
                text = f"{self.name}: {away} ({outcome}); trying again"
                _report(logging.WARNING, "bus.away", text)
            return
        self._use(outcome)
        away_s = now_s - self._since_s
        self._away_s += away_s
        self._since_s = now_s
        text = f"{self.name}: {'back' if self.losses else 'there'} after {away_s:.1f} s"
        _report(logging.INFO, "bus.back", text)
        if filters != self._filters:
            self.set_filters(self._filters)

    def _tell_off(self) -> None:
        self._was_off = self.is_off
        if self.is_off:
            _report(
                logging.WARNING,
                "bus.off",
                f"{self.name}: the controller is bus-off; it comes back when the kernel"
                f" restarts it (once for all: ip link set {self._address.channel} type can"
                " restart-ms 100)",
            )
        else:
            _report(logging.INFO, "bus.on", f"{self.name}: no longer bus-off")


def _report(level: int, event: str, text: str) -> None:
    emit(_LOG, level, event, text, limit="bus.state")


class _Attempt:
    """One try to open a bus, in a thread; what is left of the lost one is closed before."""

    def __init__(
        self,
        opener: Opener,
        address: BusAddress,
        filters: list[CanFilter],
        lost: can.BusABC | None,
    ) -> None:
        self.filters = filters
        self._opener = opener
        self._address = address
        self._lost = lost
        self._outcome: queue.SimpleQueue[can.BusABC | str] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._is_abandoned = False
        # A daemon: a driver that hangs must not keep the program from ending.
        threading.Thread(target=self._run, daemon=True).start()

    def wait(self, timeout_s: float) -> can.BusABC | str | None:
        """Return the bus, or why there is none; None if neither is known in time [s]."""
        try:
            return self._outcome.get(timeout=max(timeout_s, 0.0))
        except queue.Empty:
            return None

    def abandon(self) -> None:
        """Want the bus no more: it is closed as soon as it is open."""
        with self._lock:
            self._is_abandoned = True
        outcome = self.wait(0.0)
        if outcome is not None and not isinstance(outcome, str):
            outcome.shutdown()

    def _run(self) -> None:
        if self._lost is not None:
            # A driver may raise anything when what is gone is closed, and nothing depends on it.
            with suppress(Exception):
                self._lost.shutdown()
            self._lost = None
        outcome: can.BusABC | str
        try:
            outcome = self._opener(self._address, self.filters)
        except Exception as error:  # noqa: BLE001 - whatever a driver raises: there is no bus yet
            outcome = str(error) or type(error).__name__
        with self._lock:
            if not self._is_abandoned:
                self._outcome.put(outcome)
                return
        if not isinstance(outcome, str):
            outcome.shutdown()

"""Reconnect a lost bus: interface down or removed, adapter unplugged.

Without a bus, receiving waits and returns nothing, and frames to send are dropped and counted.
Opening is retried with growing pauses, in a thread because some drivers take seconds for it.
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
from cangauge.bus.backend import backend_capabilities
from cangauge.bus.connection import SEND_WITHIN_S, BusConnection, BusError
from cangauge.bus.open import BusAddress, DriverMissingError, open_bus
from cangauge.errors import InputError

FIRST_PAUSE_S: Final = 0.05
LONGEST_PAUSE_S: Final = 1.0
"""Pauses between attempts double from the first to the longest [s]. Frames between the return of
the bus and the next attempt are lost."""

STEADY_S: Final = 5.0
"""A bus lost after this time in use [s] is retried after the first pause; one that flaps keeps its
pause."""

REPORT_AFTER_S: Final = 1.0
"""Time without a bus after which failed attempts are logged [s]: a short outage needs one line."""

_LOG = logging.getLogger(__name__)
_Received = TypeVar("_Received")
Opener = Callable[[BusAddress, Sequence[CanFilter] | None], can.BusABC]


class ReconnectingBus(BusConnection):
    """A bus in use that is reopened when it is lost. Never raises `BusError`.

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
        self._attempt: _Attempt | None = None
        self._lost_bus: can.BusABC | None = None
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
        except DriverMissingError:
            raise
        except InputError as error:
            if not wait:
                raise
            self._schedule_attempt(away_since_s=time.monotonic())
            self._log(
                "bus.missing", logging.WARNING, f"not available yet ({error}); waiting for it"
            )
            return
        self._since_s = time.monotonic()

    def close(self) -> None:
        """Close the bus, or abandon the attempt to open it."""
        if self._attempt is not None:
            self._attempt.abandon()
            self._attempt = None
        self._away_s = self.away_s
        self._is_closed = True
        super().close()

    def receive(self, timeout_s: float) -> can.Message | None:
        """Return the next frame that passes the filters; None if none came in time.

        While the bus is away, wait and try to open it.
        """
        return self._received(super().receive, timeout_s)

    def receive_pending(self, timeout_s: float) -> list[can.Message]:
        """Return the pending frames; empty if none came in time.

        While the bus is away, wait and try to open it.
        """
        return self._received(super().receive_pending, timeout_s) or []

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
        """Return what `receive` returns; None while the bus is away or when it is lost."""
        if self._bus is None:
            self._reconnect(timeout_s)
            return None
        try:
            received = receive(timeout_s)
        except BusError as error:
            self._lose(error)
            return None
        if self.is_off != self._was_off:
            self._was_off = self.is_off
            self._log_off()
        return received

    def _lose(self, error: BusError) -> None:
        now_s = time.monotonic()
        if now_s - self._since_s >= STEADY_S:
            self._pause_s = FIRST_PAUSE_S
        self.losses += 1
        self._lost_bus = self._detach()
        self._was_off = False
        self._schedule_attempt(away_since_s=now_s)
        emit(_LOG, logging.WARNING, "bus.lost", f"{error} Reconnecting")

    def _schedule_attempt(self, away_since_s: float | None = None) -> None:
        now_s = time.monotonic()
        if away_since_s is not None:
            self._since_s = away_since_s
        self._retry_at_s = now_s + self._pause_s
        self._pause_s = min(2.0 * self._pause_s, LONGEST_PAUSE_S)

    def _reconnect(self, timeout_s: float) -> None:
        """Start an attempt when it is due, or wait for the current one."""
        if self._attempt is None:
            left_s = self._retry_at_s - time.monotonic()
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
        away_s = now_s - self._since_s
        if isinstance(outcome, str):
            self._schedule_attempt()
            if away_s >= REPORT_AFTER_S:
                text = f"away for {away_s:.0f} s ({outcome}); retrying"
                self._log("bus.away", logging.WARNING, text)
            return
        self._attach(outcome)
        self._away_s += away_s
        self._since_s = now_s
        text = f"{'back' if self.losses else 'available'} after {away_s:.1f} s"
        self._log("bus.back", logging.INFO, text)
        if filters != self._filters:
            self.set_filters(self._filters)

    def _log_off(self) -> None:
        if self.is_off:
            cure = f"ip link set {self._address.channel} type can restart-ms 100"
            text = f"the controller is bus-off until the kernel restarts it (automatically: {cure})"
            self._log("bus.off", logging.WARNING, text)
        else:
            self._log("bus.on", logging.INFO, "no longer bus-off")

    def _log(self, event: str, level: int, text: str) -> None:
        emit(_LOG, level, event, f"{self.name}: {text}")


class _Attempt:
    """One attempt to open a bus, in a thread; closes the lost bus first."""

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
        # A daemon: a hanging driver must not prevent the end of the program.
        threading.Thread(target=self._run, daemon=True).start()

    def wait(self, timeout_s: float) -> can.BusABC | str | None:
        """Return the bus or the error message; None if the attempt takes longer [s]."""
        try:
            return self._outcome.get(timeout=max(timeout_s, 0.0))
        except queue.Empty:
            return None

    def abandon(self) -> None:
        """Close the bus as soon as it is open."""
        with self._lock:
            self._is_abandoned = True
        outcome = self.wait(0.0)
        if outcome is not None and not isinstance(outcome, str):
            outcome.shutdown()

    def _run(self) -> None:
        if self._lost is not None:
            # Drivers may raise anything when they close a lost bus; nothing depends on it.
            with suppress(Exception):
                self._lost.shutdown()
            self._lost = None
        outcome: can.BusABC | str
        try:
            outcome = self._opener(self._address, self.filters)
        except Exception as error:  # noqa: BLE001 - drivers raise anything
            outcome = str(error) or type(error).__name__
        with self._lock:
            if not self._is_abandoned:
                self._outcome.put(outcome)
                return
        if not isinstance(outcome, str):
            outcome.shutdown()

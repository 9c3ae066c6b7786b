"""A bus that is opened again when it is lost, with growing pauses."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final

import can
from can.typechecking import CanFilter

from cangauge._logging import emit
from cangauge.bus.connection import AT_ONCE, BusConnection, BusError
from cangauge.bus.open import BusAddress, DriverMissingError, open_bus
from cangauge.errors import InputError

_LOG = logging.getLogger(__name__)

FIRST_PAUSE_S: Final = 0.05
LONGEST_PAUSE_S: Final = 1.0
"""Pauses between attempts double from the first to the longest [s]. Frames between the return of
the bus and the next attempt are lost; the longest is below the gap that empties the delay line."""
STEADY_S: Final = 5.0
"""A bus lost after this time in use [s] is retried after the first pause; one that flaps keeps its
pause."""

Opener = Callable[[BusAddress, Sequence[CanFilter] | None], can.BusABC]


class ReconnectingBus(BusConnection):
    """A bus in use that is reopened when it is lost. Never raises `BusError`.

    Without a bus, receiving waits and returns nothing, and frames to send are dropped and counted.
    Opening is retried with growing pauses, in the caller's thread: without a bus it has no more to
    do, and a driver that takes seconds to open delays it by them. `losses` counts them. Logs the
    events bus.missing, bus.lost, bus.away, bus.back, bus.off and bus.on.
    """

    def __init__(
        self, address: BusAddress, filters: Sequence[CanFilter], opener: Opener = open_bus
    ) -> None:
        super().__init__(None, address)
        self.losses = 0
        self._filters, self._opener = list(filters), opener
        self._since_s = time.monotonic()
        self._away_s = self._retry_at_s = 0.0
        self._pause_s = FIRST_PAUSE_S
        self._is_closed = self._was_off = False

    def open(self, *, wait: bool = False) -> None:
        """Open the bus for the first time; with `wait`, return without it if it is missing.

        Raises InputError as `open_bus`; with `wait` only for a missing driver.
        """
        try:
            self._bus = self._opener(self.address, self._filters)
        except InputError as error:
            if not wait or isinstance(error, DriverMissingError):
                raise
            self._schedule_attempt()
            text = f"not available yet ({error}); waiting for it"
            self._log("bus.missing", _LOG.warning, text)
        self._since_s = time.monotonic()

    def close(self) -> None:
        """Close the bus, if any."""
        self._away_s = self.away_s
        self._is_closed = True
        super().close()

    def post(self, message: can.Message, within_s: float) -> None:
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
        if self._bus is not None:
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

    def receive_pending(self, timeout_s: float, at_most: int = AT_ONCE) -> list[can.Message]:
        """Return the pending frames; while the bus is away, wait and try to open it."""
        if self._bus is None:
            self._reconnect(timeout_s)
            return []
        try:
            messages = super().receive_pending(timeout_s, at_most)
        except BusError as error:
            self._lose(error)
            return []
        if self.is_off != self._was_off:
            self._was_off = self.is_off
            if self.is_off:
                cure = f"ip link set {self.address.channel} type can restart-ms 100"
                text = "the controller is bus-off until the kernel restarts it"
                self._log("bus.off", _LOG.warning, f"{text} (automatically: {cure})")
            else:
                self._log("bus.on", _LOG.info, "no longer bus-off")
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
        self._was_off, self._failed, self._since_s = False, None, now_s
        self._schedule_attempt()
        emit(_LOG.warning, "bus.lost", f"{error} Reconnecting")

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
            bus = self._opener(self.address, self._filters)
        except Exception as error:  # noqa: BLE001 - drivers raise anything
            self._schedule_attempt()
            away_s = time.monotonic() - self._since_s
            if away_s >= LONGEST_PAUSE_S:  # a short outage needs one line
                reason = str(error) or type(error).__name__
                text = f"away for {away_s:.0f} s ({reason}); retrying"
                self._log("bus.away", _LOG.warning, text)
            return
        now_s = time.monotonic()
        away_s, self._since_s = now_s - self._since_s, now_s
        self._away_s += away_s
        self._bus = bus
        if self._is_closed:  # in another thread, while the driver opened it
            super().close()
            return
        text = f"{'back' if self.losses else 'available'} after {away_s:.1f} s"
        self._log("bus.back", _LOG.info, text)

    def _log(self, event: str, log: Callable[..., None], text: str) -> None:
        emit(log, event, f"{self.name}: {text}")

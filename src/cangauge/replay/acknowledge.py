"""Full speed without loss: sending no further ahead than the receiver has acknowledged.

The receiver (`cangauge run --time-source replay-clock`) tells in SOC_DETAIL how many samples it
has processed, every few samples, and again when nothing comes any more. Frames that wait in its
socket are bounded by a window, because the system's buffers drop what is too much without a word.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from typing import Final

from cangauge.bus.publish import SAMPLES_MODULO, SocDetail, SocEstimate, SocReader
from cangauge.bus.receive import BusPort
from cangauge.errors import CangaugeError
from cangauge.service.gauge import ACKNOWLEDGE_EVERY

WINDOW_SAMPLES: Final = 40
"""Samples under way at most."""

WINDOW_FRAMES: Final = 160
"""Frames under way at most: a socket's default buffer holds about 270, on Linux …"""

SAMPLES_AT_LEAST: Final = 2 * ACKNOWLEDGE_EVERY
"""… but so many samples always may be, or an acknowledgement would never become due."""

SLOW_S: Final = 0.5
"""Waiting this long for an acknowledgement is worth a hint [s]."""

_LOOK_S: Final = 0.05

_HINT = (
    "is `cangauge run --time-source replay-clock` listening on this bus, for the same --vehicle?"
)


class Receiver:
    """What is known of the receiver: its acknowledgements, and the SoC that it publishes.

    Parameters
    ----------
    port : BusPort
        Receives SOC_ESTIMATE and SOC_DETAIL only.
    reader : SocReader
    stop : callable
        Asked while waiting; True ends it.
    warn : callable, optional
        Takes a line of text.

    Attributes
    ----------
    soc : SocEstimate or None
        The latest that was published.
    acknowledged : int
        Samples processed since `wait_until_ready`.
    """

    def __init__(
        self,
        port: BusPort,
        reader: SocReader,
        stop: Callable[[], bool],
        warn: Callable[[str], None] | None = None,
    ) -> None:
        self._port = port
        self._reader = reader
        self._stop = stop
        self._warn = warn
        self.soc: SocEstimate | None = None
        self.acknowledged = 0
        self._told: int | None = None
        self._sent = 0
        self._frames_sent = 0
        # Frames that had been sent when a sample was complete: (sample, frames).
        self._marks: deque[tuple[int, int]] = deque()
        self._frames_acknowledged = 0

    def listen(self, within_s: float) -> None:
        """Take in what arrives, for so long at most [s]; return when the bus is quiet.

        Not without any time: where Python filters, one's own frames must be passed over first.
        """
        until_s = time.monotonic() + within_s
        while (left_s := until_s - time.monotonic()) > 0.0 and self.take(left_s):
            pass

    def wait_until_ready(self, within_s: float) -> None:
        """Wait for the receiver to show itself; its count so far is where counting begins.

        Raises
        ------
        CangaugeError
            If it does not within that time [s].
        """
        give_up_s = time.monotonic() + within_s
        while self._told is None and not self._stop():
            if time.monotonic() > give_up_s:
                raise CangaugeError(
                    f"{self._port.name}: nobody acknowledges: no SOC_DETAIL in {within_s:g} s;"
                    f" {_HINT}"
                )
            self.take(_LOOK_S)

    def sent(self, samples: int, frames: int) -> None:
        """Note how many samples and frames have been sent so far."""
        if samples != self._sent:
            self._marks.append((samples, frames))
        self._sent, self._frames_sent = samples, frames

    def wait_for_room(self, within_s: float) -> None:
        """Wait until the window has room.

        Raises
        ------
        CangaugeError
            If no acknowledgement comes within that time [s].
        """
        if not self._is_full():
            return
        # Once full it is emptied to a half, so that both sides work in strides.
        self._wait(within_s, lambda: self._under_way <= WINDOW_SAMPLES // 2 and not self._is_full())

    def wait_for_all(self, within_s: float) -> None:
        """Wait until everything is acknowledged.

        Raises
        ------
        CangaugeError
            If no acknowledgement comes within that time [s].
        """
        self._wait(within_s, lambda: self._under_way == 0)

    @property
    def _under_way(self) -> int:
        return self._sent - self.acknowledged

    def _is_full(self) -> bool:
        if self._under_way < SAMPLES_AT_LEAST:
            return False
        frames = self._frames_sent - self._frames_acknowledged
        return self._under_way >= WINDOW_SAMPLES or frames >= WINDOW_FRAMES

    def _wait(self, within_s: float, is_enough: Callable[[], bool]) -> None:
        began_s = last_s = time.monotonic()
        before = self.acknowledged
        while not is_enough() and not self._stop():
            self.take(_LOOK_S)
            now_s = time.monotonic()
            if self.acknowledged != before:
                before, last_s = self.acknowledged, now_s
            elif now_s - last_s > within_s:
                raise CangaugeError(
                    f"{self._port.name}: no acknowledgement in {within_s:g} s:"
                    f" {self.acknowledged} of {self._sent} samples sent have been processed;"
                    f" {_HINT}"
                )
            if now_s - began_s > SLOW_S and self._warn is not None:
                self._warn(f"the receiver acknowledges slowly; {_HINT}")
                self._warn = None

    def take(self, timeout_s: float) -> bool:
        """Take in one frame; return whether one came in time [s]."""
        message = self._port.receive(timeout_s)
        if message is None:
            return False
        content = self._reader.read(message)
        if isinstance(content, SocEstimate):
            if math.isfinite(content.soc_pct):
                self.soc = content
        elif isinstance(content, SocDetail):
            self._count(content.samples)
        return True

    def _count(self, told: int) -> None:
        if self._told is None or not self._sent:
            self._told = told
            return
        more = (told - self._told) % SAMPLES_MODULO
        if more == 0:
            return
        if more > self._under_way:
            raise CangaugeError(
                f"{self._port.name}: the receiver has processed {more} samples where"
                f" {self._under_way} were under way: it was started again, or somebody else sends"
                " or answers on this bus too"
            )
        self._told = told
        self.acknowledged += more
        while self._marks and self._marks[0][0] <= self.acknowledged:
            self._frames_acknowledged = self._marks.popleft()[1]

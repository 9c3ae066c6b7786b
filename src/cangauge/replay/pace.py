"""Keeping the recorded timing, at any speed."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

AHEAD_S: Final = 0.0002
"""Frames so near to their time are sent at once: sleeping would cost more than it mends [s]."""

REST_AT_MOST_S: Final = 0.2
"""Longer pauses are passed in parts, so that a signal is noticed."""


class Pacer:
    """Waits for the moments of log time.

    Every moment is counted from the first, by the monotonic clock, so that errors do not add up:
    what is late does not make the rest later.

    Parameters
    ----------
    speed : float
        Log seconds per second.
    stop : callable
        Asked while waiting; True ends it.
    rest : callable
        Passes at most so many seconds; may return earlier.
    """

    def __init__(
        self,
        speed: float,
        stop: Callable[[], bool],
        rest: Callable[[float], object] = time.sleep,
    ) -> None:
        self._us_per_s = 1e6 * speed
        self._stop = stop
        self._rest = rest
        self._origin: tuple[int, float] | None = None

    def wait(self, time_us: int) -> None:
        """Return when it is time for a log time [µs], or at once when it has passed."""
        if self._origin is None:
            self._origin = (time_us, time.monotonic())
        first_us, first_s = self._origin
        due_s = first_s + (time_us - first_us) / self._us_per_s
        while (ahead_s := due_s - time.monotonic()) > AHEAD_S and not self._stop():
            self._rest(min(ahead_s, REST_AT_MOST_S))

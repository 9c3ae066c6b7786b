"""Delayed currents I(t − dj): over a whole log, and online from a ring buffer.

Both interpolate linearly between time stamps, which may be irregular, and hold the current of the
first sample before it. After a gap longer than `GAP_S` they differ: `delayed_currents` interpolates
across it, `DelayLine` starts again. `filled_at` marks the times at which they agree.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cangauge._typing import FloatArray
from cangauge.settings import GAP_S


def delayed_currents(
    time_s: FloatArray, current_a: FloatArray, delay_s: Sequence[float], at_s: ArrayLike
) -> FloatArray:
    """Return I(t − dj), shape (len(at_s), len(delay_s)) [A].

    Parameters
    ----------
    time_s, current_a : array of shape (n,)
        The log's time [s] and current [A], positive = discharge.
    delay_s : sequence of floats
        Delays dj [s].
    at_s : array_like of shape (m,)
        Times t [s] to evaluate at.
    """
    at = np.asarray(at_s, dtype=np.float64)
    delayed = np.empty((at.size, len(delay_s)))
    if not delayed.size:
        return delayed
    # np.interp copies the whole log, however few times are asked for.
    first, last = np.searchsorted(time_s, [at.min() - max(delay_s), at.max()])
    near = slice(max(first - 1, 0), last + 1)
    time_s, current_a = time_s[near], current_a[near]
    for column, delay in zip(delayed.T, delay_s, strict=True):
        column[:] = np.interp(at - delay, time_s, current_a)
    return delayed


def filled_at(
    time_s: FloatArray, longest_delay_s: float, at_s: ArrayLike, gap_s: float = GAP_S
) -> NDArray[np.bool_]:
    """Return at which of the times `at_s` the delay line is full and free of gaps, shape (m,).

    It is filling for `longest_delay_s` after the start of a log, and after each gap longer than
    `gap_s`.
    """
    at = np.asarray(at_s, dtype=np.float64)
    after_gap = np.flatnonzero(np.diff(time_s) > gap_s) + 1
    starts = time_s[np.concatenate(([0], after_gap))]
    since = at - starts[np.searchsorted(starts, at, side="right") - 1]
    return np.asarray(since >= longest_delay_s)


SPACING_S = 0.009
"""Least distance of two kept samples with one between them [s]: bounds the memory at any rate."""

DROPPED = 512
"""Number of stale currents that are dropped at once."""


class DelayLine:
    """Ring buffer of the current over the longest delay.

    Parameters
    ----------
    delay_s : sequence of floats
        Delays [s], increasing.
    gap_s : float
        A longer step between two samples empties the line [s].
    spacing_s : float
        Least distance of two kept samples with one between them, except the newest [s]; see
        `SPACING_S`. 70 s at 100 Hz are kept completely.
    """

    def __init__(
        self, delay_s: Sequence[float], *, gap_s: float = GAP_S, spacing_s: float = SPACING_S
    ) -> None:
        self._delays = tuple(delay_s)
        self.longest_s = self._delays[-1]
        """The longest delay [s]."""
        self._gap = gap_s
        self._spacing = spacing_s
        self._times: list[float] = []
        self._currents: list[float] = []
        self._since = 0.0

    def push(self, time_s: float, current_a: float) -> None:
        """Append one sample; its time must be later than the previous one."""
        times, currents = self._times, self._currents
        if not times or time_s - times[-1] > self._gap:
            times.clear()
            currents.clear()
            self._since = time_s
        elif len(times) > 1 and time_s - times[-2] < self._spacing:
            times.pop()
            currents.pop()
        times.append(time_s)
        currents.append(current_a)
        # Many together: deleting the first element of a list at each push costs more.
        if len(times) > DROPPED + 1 and times[DROPPED + 1] <= time_s - self.longest_s:
            stale = bisect_right(times, time_s - self.longest_s) - 1
            del times[:stale]
            del currents[:stale]

    @property
    def filled_s(self) -> float:
        """Length of the gap-free stretch up to the newest sample [s]."""
        return self._times[-1] - self._since if self._times else 0.0

    def currents(self) -> list[float]:
        """Return I(t − dj) [A] for each delay, t being the newest sample's time."""
        return [self.current_at(delay_s) for delay_s in self._delays]

    def current_at(self, ago_s: float) -> float:
        """Return I(t − `ago_s`) [A], t being the newest sample's time."""
        times, currents = self._times, self._currents
        at = times[-1] - ago_s
        right = bisect_right(times, at)
        if right == 0:
            return currents[0]
        if right == len(times):
            return currents[-1]
        t0, t1 = times[right - 1], times[right]
        c0, c1 = currents[right - 1], currents[right]
        return c0 + (c1 - c0) * (at - t0) / (t1 - t0)

    @property
    def contents(self) -> tuple[list[float], list[float], float]:
        """Copies of the times [s] and currents [A], and the start of the gap-free stretch [s]."""
        return list(self._times), list(self._currents), self._since

    def fill(self, time_s: Sequence[float], current_a: Sequence[float], since_s: float) -> None:
        """Set times [s], increasing, currents [A], and start of the gap-free stretch [s]."""
        self._times, self._currents = list(time_s), list(current_a)
        self._since = since_s

"""Currents some seconds ago: over a whole log, and online from a ring buffer.

Both interpolate linearly between samples on real time stamps, at any and irregular rates; before
the first sample the current counts as the first sample's. The same rule, written twice (arrays
and one sample at a time), and checked against each other in the tests.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cangauge._typing import FloatArray

GAP_S = 2.0
"""A gap in the current longer than this empties the delay line [s]."""


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
    return np.column_stack([np.interp(at - delay, time_s, current_a) for delay in delay_s])


def settled(
    time_s: FloatArray, longest_delay_s: float, at_s: ArrayLike, gap_s: float = GAP_S
) -> NDArray[np.bool_]:
    """Return which of the times `at_s` have a full, gap-free delay line behind them.

    The first `longest_delay_s` of a log, and as long after a gap longer than `gap_s`, have not.
    """
    at = np.asarray(at_s, dtype=np.float64)
    after_gap = np.flatnonzero(np.diff(time_s) > gap_s) + 1
    starts = time_s[np.concatenate(([0], after_gap))]
    since = at - starts[np.searchsorted(starts, at, side="right") - 1]
    return np.asarray(since >= longest_delay_s)


_BLOCK = 512
"""So many currents that nobody needs any more are dropped at once."""


class DelayLine:
    """Ring buffer of current, as long as the longest delay.

    Parameters
    ----------
    delay_s : sequence of floats
        Delays [s], increasing.
    gap_s : float
        A longer step between two samples empties the line [s].
    spacing_s : float
        Samples closer together than this are not all kept [s]: the newest always is, older ones
        thin out, so that memory is bounded at any frame rate (100 Hz × 70 s are kept whole).
    """

    def __init__(
        self, delay_s: Sequence[float], *, gap_s: float = GAP_S, spacing_s: float = 0.009
    ) -> None:
        self._delays = tuple(delay_s)
        self._longest = self._delays[-1]
        self._gap = gap_s
        self._spacing = spacing_s
        self._times: list[float] = []
        self._currents: list[float] = []
        self._since = 0.0

    def push(self, time_s: float, current_a: float) -> None:
        """Take one sample; its time must be later than the last one's."""
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
        # Drop in blocks: popping one element from the front of a list at each push costs more.
        if len(times) > _BLOCK + 1 and times[_BLOCK + 1] <= time_s - self._longest:
            stale = bisect_right(times, time_s - self._longest) - 1
            del times[:stale]
            del currents[:stale]

    @property
    def longest_s(self) -> float:
        """The longest delay [s]."""
        return self._longest

    @property
    def filled_s(self) -> float:
        """How long a gap-free stretch the line has seen [s]."""
        return self._times[-1] - self._since if self._times else 0.0

    @property
    def full(self) -> bool:
        """Whether the longest delay lies within what has been seen."""
        return self.filled_s >= self._longest

    def currents(self) -> list[float]:
        """Return I(t − dj) [A] for each delay, t being the newest sample's time."""
        times, currents = self._times, self._currents
        now = times[-1]
        result = []
        for delay in self._delays:
            at = now - delay
            right = bisect_right(times, at)
            if right == 0:
                result.append(currents[0])
            elif right == len(times):
                result.append(currents[-1])
            else:
                t0, t1 = times[right - 1], times[right]
                c0, c1 = currents[right - 1], currents[right]
                result.append(c0 + (c1 - c0) * (at - t0) / (t1 - t0))
        return result

    @property
    def contents(self) -> tuple[list[float], list[float], float]:
        """Times [s] and currents [A] kept, and when the gap-free stretch began [s]: copies."""
        return list(self._times), list(self._currents), self._since

    def fill(self, time_s: Sequence[float], current_a: Sequence[float], since_s: float) -> None:
        """Take over the contents of another line: times [s], increasing, currents [A]."""
        self._times, self._currents = list(time_s), list(current_a)
        self._since = since_s

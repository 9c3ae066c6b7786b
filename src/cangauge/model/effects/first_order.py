"""First-order lag over irregular samples: y' = (x − y)/τ, with x linear between samples.

The same recursion offline and online, so that both give the same numbers to rounding:

    y_k = a·y_{k−1} + (1 − a)·x_k + b·(x_{k−1} − x_k),   a = e^(−Δ/τ),   b = (1 − a)·τ/Δ − a

Over a step longer than `rest_s` nobody saw x, and it counts as zero: y_k = a·y_{k−1}. That is the
rule of the Coulomb counter, which takes the pack to have rested.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from cangauge._typing import FloatArray

DECAY_A_BLOCK = 300.0
"""Time constants summed up at once: e³⁰⁰, and e⁵⁰ for a last step, are far from overflow."""

NOTHING_LEFT = 50.0
"""After so many time constants nothing is left (2·10⁻²²)."""


def decaying_sum(decay: FloatArray, drive: FloatArray, start: float) -> FloatArray:
    """Return y_k = e^(−decay_k)·y_{k−1} + drive_k with y_0 = start, shape (n + 1,).

    Parameters
    ----------
    decay, drive : array of shape (n,)
        Decay over each step, 0 or more, and what each step adds.
    start : float
    """
    result = np.empty(decay.size + 1)
    result[0] = start
    # Counting no further than `NOTHING_LEFT` a step keeps e^elapsed finite.
    elapsed = np.concatenate(([0.0], np.cumsum(np.minimum(decay, NOTHING_LEFT))))
    blocks = np.arange(DECAY_A_BLOCK, elapsed[-1], DECAY_A_BLOCK)
    edges = np.concatenate(([0], np.searchsorted(elapsed[1:], blocks), [decay.size]))
    last = start
    for first, after in itertools.pairwise(edges.tolist()):
        grown = np.exp(elapsed[first + 1 : after + 1] - elapsed[first])
        result[first + 1 : after + 1] = (last + np.cumsum(drive[first:after] * grown)) / grown
        last = float(result[after])
    return result


def low_passed(
    time_s: FloatArray,
    values: FloatArray,
    tau_s: float,
    start: float,
    rest_s: float = math.inf,
) -> FloatArray:
    """Return the lagged values, shape (n,).

    Parameters
    ----------
    time_s, values : array of shape (n,)
    tau_s : float
        Time constant [s].
    start : float
        Value of y at the first sample.
    rest_s : float
        Over a longer step the input counts as zero [s].
    """
    seconds = np.diff(time_s)
    step = seconds / tau_s
    rest = -np.expm1(-step)  # 1 − a
    b = rest / step - (1.0 - rest)
    drive = rest * values[1:] + b * (values[:-1] - values[1:])
    return decaying_sum(step, np.where(seconds > rest_s, 0.0, drive), start)


class LowPass:
    """The same lag, one sample at a time; the first sample sets the state to `start`.

    Parameters
    ----------
    tau_s : float
        Time constant [s].
    start : float, optional
        Value of y at the first sample; the first sample's own by default.
    rest_s : float
        Over a longer step the input counts as zero [s].
    """

    def __init__(self, tau_s: float, start: float | None = None, rest_s: float = math.inf) -> None:
        self._tau_s = tau_s
        self._start = start
        self._rest_s = rest_s
        self._last: tuple[float, float] | None = None
        self.value = 0.0

    def step(self, time_s: float, value: float) -> float:
        """Take one sample and return the lagged value."""
        if self._last is None:
            self.value = value if self._start is None else self._start
        else:
            seconds = time_s - self._last[0]
            step = seconds / self._tau_s
            a = math.exp(-step)
            self.value *= a
            if seconds <= self._rest_s:
                b = -math.expm1(-step) / step - a
                self.value += (1.0 - a) * value + b * (self._last[1] - value)
        self._last = (time_s, value)
        return self.value

    def memory(self) -> list[float]:
        """Return time [s], input and lagged value of the last sample; nothing before the first."""
        return [] if self._last is None else [*self._last, self.value]

    def remember(self, memory: Sequence[float], latest_s: float) -> None:
        """Go on from a memory, no later than `latest_s` [s]; may raise ValueError."""
        if not memory:
            self._last, self.value = None, 0.0
            return
        time_s, last, self.value = memory
        self._last = (time_s, last)
        if not all(map(math.isfinite, memory)):
            raise ValueError("not finite")
        if not time_s <= latest_s:
            raise ValueError("later than the latest sample")

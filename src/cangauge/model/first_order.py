"""First-order lag on irregular samples: τ·dy/dt = x − y, with x linear between samples.

    y_k = a·y_{k−1} + (1 − a)·x_k + b·(x_{k−1} − x_k),   a = e^(−Δ/τ),   b = (1 − a)·τ/Δ − a

Over a step longer than `rest_s` the input is unknown and counts as zero: y_k = a·y_{k−1}. The
Coulomb counter uses the same rule: the pack is assumed to have rested. A missing input (NaN)
changes nothing, and has no output.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from cangauge._typing import FloatArray
from cangauge.logs.gaps import BRIDGE_S


def decaying_sum(decay: FloatArray, drive: FloatArray, start: float) -> FloatArray:
    """Return y_k = e^(−decay_k)·y_{k−1} + drive_k with y_0 = start, shape (n + 1,).

    Parameters
    ----------
    decay, drive : array of shape (n,)
        Decay over each step (≥ 0) and the increment of each step.
    start : float
        Value before the first step.
    """
    result = np.empty(decay.size + 1)
    result[0] = start
    # A state has decayed completely after 50 time constants (2·10⁻²²), and blocks of 300 are summed
    # at a time: e³⁵⁰ does not overflow.
    block = 300.0
    elapsed = np.zeros(decay.size + 1)
    np.cumsum(np.minimum(decay, 50.0), out=elapsed[1:])
    edges = [0, decay.size]
    if elapsed[-1] > block:
        blocks = np.arange(block, elapsed[-1], block)
        edges[1:1] = np.searchsorted(elapsed[1:], blocks).tolist()
    last = start
    for first, after in itertools.pairwise(edges):
        grown = np.exp(elapsed[first + 1 : after + 1] - elapsed[first])
        part = result[first + 1 : after + 1]
        np.cumsum(drive[first:after] * grown, out=part)
        part += last
        part /= grown
        last = float(result[after])
    return result


class Lag:
    """A first-order lag; consecutive calls continue it.

    Parameters
    ----------
    tau_s : float
        Time constant [s].
    start : float, optional
        Output at the first sample; the first input by default.
    rest_s : float
        Over a longer step the input counts as zero [s].
    """

    def __init__(self, tau_s: float, start: float | None = None, rest_s: float = math.inf) -> None:
        self.tau_s = tau_s
        self._start = start
        self._rest_s = rest_s
        self._last: tuple[float, float, float] | None = None

    @property
    def value(self) -> float:
        """Latest output."""
        return 0.0 if self._last is None else self._last[2]

    def step(self, time_s: FloatArray, values: FloatArray) -> FloatArray:
        """Advance to samples of shape (n,) and return the outputs there."""
        missing = np.isnan(values)
        if missing.any():
            result = np.full(values.size, math.nan)
            result[~missing] = self.step(time_s[~missing], values[~missing])
            return result
        if not values.size:
            return values
        if self._last is None:
            first = float(values[0]) if self._start is None else self._start
            times, inputs, skip = time_s, values, 0
        else:
            latest_s, latest, first = self._last
            times, inputs = np.concatenate(([latest_s], time_s)), np.concatenate(([latest], values))
            skip = 1
        seconds = np.diff(times)
        result = decaying_sum(*self._increments(seconds, inputs), first)[skip:]
        self._last = (float(times[-1]), float(inputs[-1]), float(result[-1]))
        return result

    def _increments(self, seconds: FloatArray, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the decay over each step of shape (n,), and its increment."""
        step = seconds / self.tau_s
        gone = -np.expm1(-step)  # 1 − a
        drive = gone * inputs[1:] + (gone / step - (1.0 - gone)) * (inputs[:-1] - inputs[1:])
        drive[seconds > self._rest_s] = 0.0
        return step, drive

    def state(self) -> list[float]:
        """Return time [s], input and output at the latest sample; empty before the first."""
        return [] if self._last is None else [*self._last]

    def restore(self, state: Sequence[float]) -> None:
        """Continue from a saved state; raise ValueError if it is of something else."""
        self._last = None
        if state:
            time_s, latest, value = state
            self._last = time_s, latest, value


class Turned(Lag):
    """Lag of −sign(I) over a charge instead of time; 0 at the start, unchanged over gaps.

    Parameters
    ----------
    travel_as : float
        Charge that turns it [As].
    """

    def __init__(self, travel_as: float) -> None:
        super().__init__(travel_as, 0.0)

    def _increments(self, seconds: FloatArray, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        mean = 0.5 * (inputs[1:] + inputs[:-1])
        decay = np.where(seconds > BRIDGE_S, 0.0, np.abs(mean) * seconds / self.tau_s)
        return decay, np.sign(mean) * np.expm1(-decay)


class First:
    """Time of the first sample."""

    def __init__(self) -> None:
        self._first_s: float | None = None

    def of(self, time_s: FloatArray) -> float:
        """Return the time of the first sample ever [s], given the times of the next ones."""
        if self._first_s is None:
            self._first_s = float(time_s[0])
        return self._first_s

    def state(self) -> list[float]:
        """Return the time [s]; empty before the first sample."""
        return [] if self._first_s is None else [self._first_s]

    def restore(self, state: Sequence[float]) -> None:
        """Continue from a saved state; raise ValueError if it is of something else."""
        self._first_s = None
        if state:
            (self._first_s,) = state


def low_passed(
    time_s: FloatArray,
    values: FloatArray,
    tau_s: float,
    start: float | None = None,
    rest_s: float = math.inf,
) -> FloatArray:
    """Return the outputs of a `Lag` over a whole log, shape (n,)."""
    return Lag(tau_s, start, rest_s).step(time_s, values)

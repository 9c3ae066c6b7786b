"""First-order lag on irregular samples: τ·dy/dt = x − y, with x linear between samples.

The array form and the sample-by-sample form use the same recursion and agree to rounding:

    y_k = a·y_{k−1} + (1 − a)·x_k + b·(x_{k−1} − x_k),   a = e^(−Δ/τ),   b = (1 − a)·τ/Δ − a

Over a step longer than `rest_s` the input is unknown and counts as zero: y_k = a·y_{k−1}. The
Coulomb counter uses the same rule: the pack is assumed to have rested.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from cangauge._typing import FloatArray

NO_LAG_S = 1e-3
"""A time constant up to this is no lag: output = input [s]."""

BLOCK_TIME_CONSTANTS = 300.0
"""Time constants summed in one block: e³⁰⁰, times e⁵⁰ for a last step, does not overflow."""

FULL_DECAY = 50.0
"""Time constants after which a state has decayed completely (2·10⁻²²)."""


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
    # Limiting each step to `FULL_DECAY` keeps e^elapsed finite.
    elapsed = np.zeros(decay.size + 1)
    np.cumsum(np.minimum(decay, FULL_DECAY), out=elapsed[1:])
    blocks = np.arange(BLOCK_TIME_CONSTANTS, elapsed[-1], BLOCK_TIME_CONSTANTS)
    edges = np.concatenate(([0], np.searchsorted(elapsed[1:], blocks), [decay.size]))
    last = start
    for first, after in itertools.pairwise(edges.tolist()):
        grown = elapsed[first + 1 : after + 1] - elapsed[first]
        np.exp(grown, out=grown)
        part = result[first + 1 : after + 1]
        np.multiply(drive[first:after], grown, out=part)
        np.cumsum(part, out=part)
        part += last
        part /= grown
        last = float(result[after])
    return result


def low_passed(
    time_s: FloatArray,
    values: FloatArray,
    tau_s: float,
    start: float | None = None,
    rest_s: float = math.inf,
) -> FloatArray:
    """Return the lagged values, shape (n,).

    Parameters
    ----------
    time_s, values : array of shape (n,)
    tau_s : float
        Time constant [s]; up to `NO_LAG_S` the values themselves are returned.
    start : float, optional
        y at the first sample; the first value by default.
    rest_s : float
        Over a longer step the input counts as zero [s].
    """
    if tau_s <= NO_LAG_S:
        return values
    seconds = np.diff(time_s)
    step = seconds / tau_s
    rest = np.expm1(-step)
    np.negative(rest, out=rest)  # 1 − a
    drive = rest / step
    drive -= 1.0 - rest  # b
    drive *= values[:-1] - values[1:]
    rest *= values[1:]
    drive += rest
    drive[seconds > rest_s] = 0.0
    first = float(values[0]) if start is None else start
    return decaying_sum(step, drive, first)


class LowPass:
    """Sample-by-sample form of `low_passed`.

    Parameters
    ----------
    tau_s : float
        Time constant [s]; up to `NO_LAG_S` the output is the input.
    start : float, optional
        y at the first sample; the first sample's value by default.
    rest_s : float
        Over a longer step the input counts as zero [s].
    """

    STATE_SIZE = 3
    """Number of values in `state` after the first sample."""

    def __init__(self, tau_s: float, start: float | None = None, rest_s: float = math.inf) -> None:
        self.is_lagging = tau_s > NO_LAG_S
        self.value = 0.0
        self.tau_s = tau_s
        self._start = start
        self._rest_s = rest_s
        self._last: tuple[float, float] | None = None

    def step(self, time_s: float, value: float) -> float:
        """Advance to one sample and return the lagged value."""
        if not self.is_lagging:
            return value
        if self._last is None:
            self.value = value if self._start is None else self._start
        else:
            seconds = time_s - self._last[0]
            step = seconds / self.tau_s
            a = math.exp(-step)
            self.value *= a
            if seconds <= self._rest_s:
                b = -math.expm1(-step) / step - a
                self.value += (1.0 - a) * value + b * (self._last[1] - value)
        self._last = (time_s, value)
        return self.value

    def state(self) -> list[float]:
        """Return time [s], input and output at the latest sample; empty before the first."""
        return [] if self._last is None else [*self._last, self.value]

    def restore(self, state: Sequence[float], latest_s: float) -> None:
        """Continue from a saved state.

        Raises
        ------
        ValueError
            If the state is malformed or later than `latest_s` [s].
        """
        if not state:
            self._last, self.value = None, 0.0
            return
        time_s, last, self.value = state
        self._last = (time_s, last)
        if not all(map(math.isfinite, state)):
            raise ValueError("not finite")
        if not time_s <= latest_s:
            raise ValueError("later than the latest sample")

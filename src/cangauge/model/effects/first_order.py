"""First-order lag over irregular samples: y' = (x − y)/τ, with x linear between samples.

The same recursion offline and online, so that both give the same numbers to rounding:

    y_k = a·y_{k−1} + (1 − a)·x_k + b·(x_{k−1} − x_k),   a = e^(−Δ/τ),   b = (1 − a)·τ/Δ − a
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

DECAY_A_BLOCK = 30.0
"""Time constants summed up at once: e³⁰ is far from overflow."""


def low_passed(time_s: FloatArray, values: FloatArray, tau_s: float, start: float) -> FloatArray:
    """Return the lagged values, shape (n,).

    Parameters
    ----------
    time_s, values : array of shape (n,)
    tau_s : float
        Time constant [s].
    start : float
        Value of y at the first sample.
    """
    result = np.empty_like(values)
    result[0] = start
    if values.size == 1:
        return result
    step = np.diff(time_s) / tau_s
    a = np.exp(-step)
    b = -np.expm1(-step) / step - a
    drive = (1.0 - a) * values[1:] + b * (values[:-1] - values[1:])
    # After 50 time constants nothing is left; counting no further keeps e^elapsed finite.
    elapsed = np.concatenate(([0.0], np.cumsum(np.minimum(step, 50.0))))
    block = (elapsed[1:] // DECAY_A_BLOCK).astype(np.intp)
    edges = np.concatenate(([0], np.flatnonzero(np.diff(block)) + 1, [block.size]))
    last = start
    for first, after in itertools.pairwise(edges.tolist()):
        grown = np.exp(elapsed[first + 1 : after + 1] - elapsed[first])
        result[first + 1 : after + 1] = (last + np.cumsum(drive[first:after] * grown)) / grown
        last = float(result[after])
    return result


class LowPass:
    """The same lag, one sample at a time; the first sample sets the state to `start`."""

    def __init__(self, tau_s: float, start: float | None = None) -> None:
        self._tau_s = tau_s
        self._start = start
        self._last: tuple[float, float] | None = None
        self.value = 0.0

    def step(self, time_s: float, value: float) -> float:
        """Take one sample and return the lagged value."""
        if self._last is None:
            self.value = value if self._start is None else self._start
        else:
            step = (time_s - self._last[0]) / self._tau_s
            a = math.exp(-step)
            b = -math.expm1(-step) / step - a
            self.value = a * self.value + (1.0 - a) * value + b * (self._last[1] - value)
        self._last = (time_s, value)
        return self.value

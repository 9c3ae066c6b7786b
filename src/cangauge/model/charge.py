"""Charge by the trapezoidal rule: what the model, its effects and the estimator all count by.

C_i = C_{i−1} − (I_i + I_{i−1})·(t_i − t_{i−1})/2
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

BRIDGE_S = 60.0
"""Over a longer gap in the current no charge is counted [s]: the pack is taken to have rested."""


def discharged_ah(time_s: FloatArray, current_a: FloatArray) -> FloatArray:
    """Return the charge taken out since the first row [Ah], shape (n,), by the trapezoidal rule.

    Parameters
    ----------
    time_s, current_a : array of shape (n,)
        Time [s] and current [A], positive = discharge. Steps longer than `BRIDGE_S` count nothing.
    """
    step_s = np.diff(time_s)
    step_ah = np.where(step_s > BRIDGE_S, 0.0, (current_a[1:] + current_a[:-1]) * step_s / 7200.0)
    return np.concatenate(([0.0], np.cumsum(step_ah)))

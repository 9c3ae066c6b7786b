"""First-order relaxations x' = (u − x)/τ of a signal that runs straight between its samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

FloatArray = NDArray[np.float64]


def relax(signal: FloatArray, step_s: float, tau_s: FloatArray) -> FloatArray:
    """Return the relaxed signal for several time constants that may change as time passes.

    The update is exact for a straight signal and a constant τ within a step, and the state
    starts at rest (0).

    Parameters
    ----------
    signal : array of shape (n,)
    step_s : float
        Time between samples [s].
    tau_s : array of shape (n, k)
        Time constants [s], above 0.

    Returns
    -------
    array of shape (n, k)
    """
    ratio = step_s / tau_s
    keep = np.exp(-ratio)
    # Integral of the straight piece against the decaying exponential, split by its two ends.
    mean = -np.expm1(-ratio) / ratio
    push = (1.0 - mean) * signal[:, None]
    push[1:] += (mean[1:] - keep[1:]) * signal[:-1, None]
    result = np.empty_like(keep)
    state = np.zeros(keep.shape[1])
    for row in range(keep.shape[0]):
        state *= keep[row]
        state += push[row]
        result[row] = state
    return result


def lagged(signal: FloatArray, step_s: float, tau_s: float) -> FloatArray:
    """Return a signal after one constant lag, settled at its first value, shape (n,)."""
    if tau_s <= 0.0:
        return signal
    keep = float(np.exp(-step_s / tau_s))
    result, _ = lfilter(
        [1.0 - keep], [1.0, -keep], signal, zi=np.array([keep * signal[0]], dtype=np.float64)
    )
    return np.asarray(result, dtype=np.float64)

"""Inverse of the voltage model: the SoC at which the curve has a voltage, by Newton's method.

The curve rises, so there is one root. A step that leaves the bracket is replaced by bisection.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cangauge._typing import FloatArray
from cangauge.model.voltage_model import VoltageModel


def soc_from_ocv(
    ocv_at: Callable[[float], tuple[float, float]], ocv_v: float, guess_pct: float = 50.0
) -> tuple[float, bool]:
    """Return the SoC at which the pseudo-OCV at reference temperature equals a voltage.

    Parameters
    ----------
    ocv_at : callable
        SoC [%] → pseudo-OCV [V] and its slope [V per %], positive.
    ocv_v : float
        Voltage [V] less the parts that do not depend on SoC (loads and temperature).
    guess_pct : float
        Start of the iteration [%]; the previous SoC saves steps.

    Returns
    -------
    soc_pct : float
        State of charge [%], within 0–100.
    inside : bool
        False if the voltage lies outside the model's range and the SoC was clipped.
    """
    low, high = 0.0, 100.0
    for end, is_beyond in ((low, ocv_v.__le__), (high, ocv_v.__ge__)):
        end_v = ocv_at(end)[0]
        if is_beyond(end_v):
            return end, ocv_v == end_v
    soc = min(max(guess_pct, low), high)
    for _ in range(80):  # bisection alone needs 37 steps to the tolerance
        volts, slope = ocv_at(soc)
        error = volts - ocv_v
        if error > 0.0:
            high = soc
        else:
            low = soc
        following = soc - error / slope
        if abs(following - soc) < 1e-9:  # %
            return min(max(following, 0.0), 100.0), True
        soc = following if low < following < high else 0.5 * (low + high)
    return soc, True


def socs_from_ocv(model: VoltageModel, ocv_v: FloatArray) -> FloatArray:
    """Return `soc_from_ocv` of many voltages [%], shape (n,)."""
    grid = np.linspace(0.0, 100.0, 4001)
    curve_v = model.curve.values(grid)
    place = np.clip(np.searchsorted(curve_v, ocv_v), 1, grid.size - 1)
    low, high = grid[place - 1], grid[place]
    soc = np.interp(ocv_v, curve_v, grid)
    for _ in range(6):  # the error squares in each, from 0.03 % to below 1e-9 %
        error = model.curve.values(soc) - ocv_v
        soc = np.clip(soc - error / model.curve.slopes(soc), low, high)
    return np.clip(soc, 0.0, 100.0)

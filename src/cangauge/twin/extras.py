"""What the faults of a pack do to charge and voltage, whatever plant is underneath."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from cangauge.twin.condition import Condition, is_on
from cangauge.twin.day import Day
from cangauge.twin.relaxation import relax

FloatArray = NDArray[np.float64]

REFERENCE_K: Final = 298.15
_GLASS_K: Final = 230.0
_PLAYS: Final = (0.06, 0.15, 0.35, 0.65, 1.0)  # reach of the hysteresis operators
_BEND_A: Final = 3.0


def stiffness(condition: Condition, kelvin: FloatArray) -> FloatArray:
    """Return resistance over what it was before the law of temperature changed [-]."""
    exponent = 1.0 / (kelvin - _GLASS_K) - 1.0 / (REFERENCE_K - _GLASS_K)
    return np.exp(condition.cold_stiffness_k * exponent)


def discharged(day: Day, current_a: FloatArray, loss: float = 0.0) -> FloatArray:
    """Return the charge taken from the cells since the start [Ah], shape (n,)."""
    counted = np.where(current_a < 0.0, (1.0 - loss) * current_a, current_a)
    steps = 0.5 * (counted[1:] + counted[:-1]) * day.step_s / 3600.0
    return np.concatenate(([0.0], np.cumsum(steps)))


def hump_rise(condition: Condition, soc: FloatArray) -> FloatArray | float:
    """Return the rise of the ohmic resistance with the state of charge [-], shape of soc."""
    hump = condition.hump
    if hump is None:
        return 0.0
    return hump.height / (1.0 + np.exp((soc - hump.centre) / hump.width))


def extra_drop(
    day: Day, condition: Condition, current_a: FloatArray, kelvin: FloatArray
) -> FloatArray:
    """Return what the pack's own faults take from its voltage [V], shape (n,)."""
    drop = np.zeros_like(current_a)
    if condition.charging_ohm:
        # A bad contact that rectifies: the bend is rounded over some amperes.
        charging = 0.5 * (1.0 - current_a / np.hypot(current_a, _BEND_A))
        drop += condition.charging_ohm * current_a * charging
    if condition.step_ohm:
        drop += condition.step_ohm * current_a * (day.time_s >= condition.step_at_s)
    if condition.flicker is not None:
        drop += condition.flicker.size * current_a * is_on(condition.flicker, day.time_s)
    if condition.modes:
        taus = np.array([mode.tau_s for mode in condition.modes])
        slower = np.exp(1500.0 * (1.0 / kelvin - 1.0 / REFERENCE_K))
        states = relax(current_a, day.step_s, slower[:, None] * taus[None, :])
        drop += states @ np.array([mode.ohm for mode in condition.modes])
    return drop


def hysteresis_drop(day: Day, condition: Condition, charge: FloatArray) -> FloatArray:
    """Return what hysteresis takes from the voltage [V]: five stop operators on the charge.

    (Prandtl–Ishlinskii; each follows the charge until it has swung by its own reach.)
    """
    reach = condition.hysteresis_reach * np.array(_PLAYS)
    state = day.history * reach
    total = np.empty_like(charge)
    total[0] = float(np.mean(state / reach))
    low, high = -reach, reach
    share = 1.0 / (reach * reach.size)
    for row, moved in enumerate(np.diff(charge).tolist(), start=1):
        state += moved
        np.minimum(state, high, out=state)
        np.maximum(state, low, out=state)
        total[row] = share @ state
    return condition.hysteresis_v * total

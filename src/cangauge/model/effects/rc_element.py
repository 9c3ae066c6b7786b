"""A resistor beside a capacitor: the voltage of low-passed current, shared by two effects."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cangauge.model.charge import BRIDGE_S
from cangauge.model.effects.effect import FloatArray, OnlineEffect, PackState
from cangauge.model.effects.first_order import LowPass, low_passed


def rc_voltage(state: PackState, ohm: float, tau_s: float) -> FloatArray:
    """Return −R·(lagged current) [V], shape (n,), at rest before the first sample."""
    lagged = low_passed(state.time_s, state.current_a, tau_s, 0.0, rest_s=BRIDGE_S)
    return np.asarray(-ohm * lagged)


class OnlineRc(OnlineEffect):
    """The same, one sample at a time.

    Parameters
    ----------
    ohm : float
        Resistance [Ω], positive.
    tau_s : float
        Time constant [s].
    """

    def __init__(self, ohm: float, tau_s: float) -> None:
        self._ohm = ohm
        self._lagged = LowPass(tau_s, 0.0, rest_s=BRIDGE_S)

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        """Carry the capacitor to this sample."""
        del temperature_c, drop_v
        self._lagged.step(time_s, current_a)

    def extra_voltage(self, soc_pct: float) -> float:
        """Return the element's voltage [V]."""
        del soc_pct
        return -self._ohm * self._lagged.value

    def memory(self) -> list[float]:
        """Return the last sample's time, current and lagged current."""
        return self._lagged.memory()

    def remember(self, memory: Sequence[float]) -> None:
        """Go on from a memory; may raise ValueError."""
        self._lagged.remember(memory)

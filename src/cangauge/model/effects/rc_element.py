"""A resistor beside a capacitor: the voltage of low-passed current, shared by two effects."""

from __future__ import annotations

from collections.abc import Sequence

from cangauge.model.charge import BRIDGE_S
from cangauge.model.effects.arrhenius import arrhenius, arrhenius_at
from cangauge.model.effects.effect import FloatArray, OnlineEffect
from cangauge.model.effects.first_order import LowPass
from cangauge.model.effects.pack_state import PackState
from cangauge.model.effects.parameter import Parameter

ACTIVATION = Parameter("activation_k", "K", 0.0, 6000.0, neutral=None, grid=(0.0, 3000.0))
"""How the element's resistance rises in the cold; it is the stated one at 25 °C."""


def rc_voltage(state: PackState, ohm: float, tau_s: float, activation_k: float = 0.0) -> FloatArray:
    """Return −R(T)·(lagged current) [V], shape (n,), at rest before the first sample."""
    lagged = state.history.lagged_a(tau_s)
    if activation_k:
        lagged = lagged * arrhenius(state.temperature_c, activation_k)
    return -ohm * lagged


class OnlineRc(OnlineEffect):
    """The same, one sample at a time.

    Parameters
    ----------
    ohm : float
        Resistance [Ω], positive.
    tau_s : float
        Time constant [s].
    activation_k : float
        Of the resistance [K].
    """

    def __init__(self, ohm: float, tau_s: float, activation_k: float = 0.0) -> None:
        self._ohm = ohm
        self._activation_k = activation_k
        self._colder = 1.0
        self._lagged = LowPass(tau_s, 0.0, rest_s=BRIDGE_S)

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        """Carry the capacitor to this sample."""
        del drop_v
        if self._activation_k:
            self._colder = arrhenius_at(temperature_c, self._activation_k)
        self._lagged.step(time_s, current_a)

    def extra_voltage(self, soc_pct: float) -> float:
        """Return the element's voltage [V]."""
        del soc_pct
        return -self._ohm * self._colder * self._lagged.value

    def memory(self) -> list[float]:
        """Return the last sample's time, current and lagged current."""
        return self._lagged.memory()

    def remember(self, memory: Sequence[float], latest_s: float) -> None:
        """Go on from a memory; may raise ValueError."""
        self._lagged.remember(memory, latest_s)

"""What effects act on: measured signals, the count of charge, and the state that follows."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cangauge.model.effects.current_history import CurrentHistory, history_of
from cangauge.model.effects.first_order import low_passed
from cangauge.model.effects.parameter import Pack, Parameter
from cangauge.model.voltage_model import VoltageModel

FloatArray = NDArray[np.float64]

AT_ONCE_S: Final = 1e-3
"""A lag up to this is none [s]."""


@dataclass(frozen=True, eq=False)
class Signals:
    """Measured signals of one log, shape (n,) each; positive current discharges."""

    time_s: FloatArray
    current_a: FloatArray
    voltage_v: FloatArray
    temperature_c: FloatArray
    remembered: CurrentHistory | None = None
    """The current's history, of use as long as it is the same current."""

    @property
    def history(self) -> CurrentHistory:
        """The current's history: what is remembered of it, or a new one."""
        return history_of(self.time_s, self.current_a, self.remembered)

    def remembering(self) -> Signals:
        """Return the signals with a history that lasts as long as the current does."""
        return replace(self, remembered=CurrentHistory(self.time_s, self.current_a))


@dataclass(frozen=True)
class Counting:
    """How charge becomes SoC: S = S0 − 100·∫(I⁺ + η·I⁻)dt / C."""

    capacity_ah: float
    initial_soc_pct: float
    charge_efficiency: float = 1.0
    """η: part of the charge put in that can be taken out again."""

    def counted(self, current_a: FloatArray) -> FloatArray:
        """Return I⁺ + η·I⁻ [A], shape (n,): the current whose charge counts."""
        if self.charge_efficiency == 1.0:
            return current_a
        return np.where(current_a < 0.0, self.charge_efficiency * current_a, current_a)

    def counted_at(self, current_a: float) -> float:
        """Return I⁺ + η·I⁻ [A] of one sample."""
        return self.charge_efficiency * current_a if current_a < 0.0 else current_a


@dataclass(frozen=True, eq=False)
class PackState:
    """What an extra voltage may depend on, shape (n,) each, after correction and counting."""

    time_s: FloatArray
    current_a: FloatArray
    temperature_c: FloatArray
    soc_pct: FloatArray
    drop_v: FloatArray
    """Σ Rj·I(t − dj) of the voltage model [V]; negative while discharging."""
    remembered: CurrentHistory | None = None
    """The history of that current, where it is known already."""
    _inside_c: dict[float, FloatArray] = field(default_factory=dict, init=False, repr=False)
    _slopes: dict[VoltageModel, FloatArray] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def history(self) -> CurrentHistory:
        """The current's history."""
        return history_of(self.time_s, self.current_a, self.remembered)

    def inside_c(self, lag_s: float) -> FloatArray:
        """Return the temperature of cells that follow the measured one late [°C], shape (n,).

        At first the measured one; kept like the lagged currents.
        """
        if lag_s not in self._inside_c:
            measured = self.temperature_c
            self._inside_c[lag_s] = (
                low_passed(self.time_s, measured, lag_s, float(measured[0]))
                if lag_s > AT_ONCE_S
                else measured
            )
        return self._inside_c[lag_s]

    def ocv_slope(self, model: VoltageModel) -> FloatArray:
        """Return the slope of a model's pseudo-OCV [V per %], shape (n,); kept as well."""
        if model not in self._slopes:
            self._slopes[model] = model.pseudo_ocv_slope(self.soc_pct)
        return self._slopes[model]

    def scaled_drop_v(self, delayed: float, pack: Pack) -> FloatArray:
        """Return the drop that an effect scales [V], shape (n,) (`DELAYED`)."""
        now_v = -pack.resistance_ohm * self.current_a
        return delayed * self.drop_v + (1.0 - delayed) * now_v


def scaled_drop_at(drop_v: float, current_a: float, delayed: float, resistance_ohm: float) -> float:
    """Return the same of one sample, the pack's resistance being `resistance_ohm`."""
    return delayed * drop_v + (1.0 - delayed) * (-resistance_ohm * current_a)


DELAYED: Final = Parameter("delayed", "1", 0.0, 1.0, neutral=None, grid=(1.0, 0.0))
"""Whether an effect scales the whole drop of the voltage model (1), or only that of the current
now, over the sum of the resistances (0): contacts and electrolyte answer at once, diffusion not.
In between it scales a mixture of both."""

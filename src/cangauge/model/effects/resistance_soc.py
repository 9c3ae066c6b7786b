"""Resistance that rises toward empty, and perhaps toward full."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from cangauge.model.effects.effect import Effect, FloatArray, OnlineEffect, Values
from cangauge.model.effects.pack_state import DELAYED, PackState, scaled_drop_at
from cangauge.model.effects.parameter import Pack, Parameter
from cangauge.model.voltage_model import VoltageModel


class ResistanceSoc(Effect):
    """Relative change of the drop that falls off from empty and from full."""

    id = "resistance_soc"
    family = "resistance"
    is_structure: ClassVar[bool] = True
    parameters = (
        Parameter("at_empty", "1", -0.4, 3.0),
        Parameter("at_full", "1", -0.4, 1.5),
        Parameter("width_pct", "%", 3.0, 60.0, neutral=None, grid=(5.0, 10.0, 20.0, 40.0)),
        DELAYED,
    )
    signature = "I·f(S): the drop over the resistance, larger near empty"
    equation = "ΔU = ΣRj·I(t − dj)·(a·exp(−S/w) + b·exp(−(100 − S)/w)); or ΣRj·I in its place"
    source = "Waag, Käbitz, Sauer, Applied Energy 102 (2013) 885"
    separated_by = (
        "the same SoC at two temperatures: in one discharge SoC and temperature move together"
        " and it cannot be told from resistance_temperature"
    )

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        """Return the change of the drop [V]."""
        del model
        soc, width = np.clip(state.soc_pct, 0.0, 100.0), values["width_pct"]
        rise = values["at_empty"] * np.exp(-soc / width)
        rise += values["at_full"] * np.exp((soc - 100.0) / width)
        return np.asarray(state.scaled_drop_v(values["delayed"], pack) * rise)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the change of the drop at one sample at a time."""
        del model
        return _Online(values, pack.resistance_ohm)


class _Online(OnlineEffect):
    uses_soc = True

    def __init__(self, values: Values, resistance_ohm: float) -> None:
        self._at_empty = values["at_empty"]
        self._at_full = values["at_full"]
        self._width_pct = values["width_pct"]
        self._delayed = values["delayed"]
        self._resistance_ohm = resistance_ohm
        self._drop_v = 0.0

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        del time_s, temperature_c
        self._drop_v = scaled_drop_at(drop_v, current_a, self._delayed, self._resistance_ohm)

    def extra_voltage(self, soc_pct: float) -> float:
        soc = min(max(soc_pct, 0.0), 100.0)
        rise = self._at_empty * math.exp(-soc / self._width_pct)
        rise += self._at_full * math.exp((soc - 100.0) / self._width_pct)
        return self._drop_v * rise

"""Resistance while charging other than while discharging."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from cangauge.model.effects.effect import Effect, FloatArray, OnlineEffect, Values
from cangauge.model.effects.pack_state import PackState
from cangauge.model.effects.parameter import Pack, Parameter
from cangauge.model.voltage_model import VoltageModel


class ResistanceAsymmetry(Effect):
    """More (or less) resistance to charging current."""

    id = "resistance_asymmetry"
    family = "resistance"
    is_structure: ClassVar[bool] = True
    parameters = (Parameter("charging_ohm", "ohm", -0.6, 1.5, scale="resistance"),)
    signature = "min(I, 0): only while charging, in step with the current"
    equation = "ΔU = −r·min(I, 0)"
    source = "Hu, Li, Peng, J. Power Sources 198 (2012) 359"
    separated_by = (
        "charging and discharging pulses of several sizes: charge_transfer bends with the size"
        " of the current and alike in both directions"
    )

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        """Return the additional rise while charging [V]."""
        del model, pack
        return np.asarray(-values["charging_ohm"] * np.minimum(state.current_a, 0.0))

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the additional rise at one sample at a time."""
        del model, pack
        return _Online(values["charging_ohm"])


class _Online(OnlineEffect):
    def __init__(self, charging_ohm: float) -> None:
        self._charging_ohm = charging_ohm
        self._volts = 0.0

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        del time_s, temperature_c, drop_v
        self._volts = -self._charging_ohm * min(current_a, 0.0)

    def extra_voltage(self, soc_pct: float) -> float:
        del soc_pct
        return self._volts

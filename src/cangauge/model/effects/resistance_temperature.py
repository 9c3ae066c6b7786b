"""Resistance that rises in the cold, after Arrhenius."""

from __future__ import annotations

import math

import numpy as np

from cangauge.model.effects.effect import (
    Effect,
    FloatArray,
    OnlineEffect,
    Pack,
    PackState,
    Parameter,
    Values,
)
from cangauge.model.voltage_model import VoltageModel

ZERO_C_IN_K = 273.15
COLDEST_C, HOTTEST_C = -60.0, 120.0
"""Beyond these no temperature of a pack is believed [°C]; the law is held there."""


class ResistanceTemperature(Effect):
    """Arrhenius factor on the whole drop of the voltage model.

    It is 1 in the middle of the temperatures that the model was identified on.
    """

    id = "resistance_temperature"
    family = "resistance"
    parameters = (Parameter("activation_k", "K", 0.0, 6000.0),)
    signature = "the drop over the resistance, growing with (T₀ − T)"
    equation = "ΔU = ΣRj·I(t − dj)·(exp(B·(1/T − 1/T₀)) − 1), T₀ the middle of the model's range"
    source = "Waag, Käbitz, Sauer, Applied Energy 102 (2013) 885"
    separated_by = (
        "the same SoC at two temperatures (a second day): where temperature and SoC move"
        " together it cannot be told from resistance_soc"
    )

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        """Return the change of the drop [V]."""
        del pack
        inverse = 1.0 / (np.clip(state.temperature_c, COLDEST_C, HOTTEST_C) + ZERO_C_IN_K)
        return state.drop_v * np.expm1(values["activation_k"] * (inverse - _usual_per_k(model)))

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the change of the drop at one sample at a time."""
        del pack
        return _Online(values["activation_k"], _usual_per_k(model))


def _usual_per_k(model: VoltageModel) -> float:
    low, high = model.temperature_range_c
    return 1.0 / (0.5 * (low + high) + ZERO_C_IN_K)


class _Online(OnlineEffect):
    def __init__(self, activation_k: float, usual_per_k: float) -> None:
        self._activation_k = activation_k
        self._usual_per_k = usual_per_k
        self._volts = 0.0

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        del time_s, current_a
        inverse = 1.0 / (min(max(temperature_c, COLDEST_C), HOTTEST_C) + ZERO_C_IN_K)
        self._volts = drop_v * math.expm1(self._activation_k * (inverse - self._usual_per_k))

    def extra_voltage(self, soc_pct: float) -> float:
        del soc_pct
        return self._volts

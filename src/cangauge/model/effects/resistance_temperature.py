"""Resistance that rises in the cold, after Arrhenius."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from cangauge.model.effects.arrhenius import inverse_k, inverse_k_at
from cangauge.model.effects.effect import Effect, FloatArray, OnlineEffect, Values
from cangauge.model.effects.inside import LAG, Inside
from cangauge.model.effects.pack_state import DELAYED, PackState, scaled_drop_at
from cangauge.model.effects.parameter import WITHIN_C, Pack, Parameter
from cangauge.model.voltage_model import VoltageModel


class ResistanceTemperature(Effect):
    """A share of the voltage model's drop that follows Arrhenius' law.

    It adds nothing at `reference_c`, the middle of the temperatures that the model was identified
    on when the effect was added. It is the cells' inside that resists, which may follow the
    measured temperature late (`lag_s`, 0: at once).
    """

    id = "resistance_temperature"
    family = "resistance"
    is_structure: ClassVar[bool] = True
    parameters = (
        Parameter("share", "1", 0.0, 3.0),
        Parameter("activation_k", "K", 100.0, 8000.0, neutral=None, grid=(1000.0, 2500.0, 4500.0)),
        DELAYED,
        Parameter(
            "reference_c", "°C", *WITHIN_C, neutral=None, from_pack="temperature_c",
            elsewhere=(-15.0, 15.0),
        ),
        LAG,
    )  # fmt: skip
    signature = "the drop over the resistance, growing with (T₀ − T)"
    equation = (
        "ΔU = a·ΣRj·I(t − dj)·(exp(B·(1/T − 1/T₀)) − 1), T₀ = reference_c;"
        " or ΣRj·I in place of ΣRj·I(t − dj); τ·dT/dt = T_measured − T, τ = lag_s"
    )
    source = "Waag, Käbitz, Sauer, Applied Energy 102 (2013) 885"
    separated_by = (
        "the same SoC at two temperatures (a second day): where temperature and SoC move"
        " together it cannot be told from resistance_soc"
    )

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        """Return the change of the drop [V]."""
        del model
        drop_v = state.scaled_drop_v(values["delayed"], pack)
        colder = inverse_k(state.inside_c(values["lag_s"])) - inverse_k_at(values["reference_c"])
        return values["share"] * drop_v * np.expm1(values["activation_k"] * colder)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the change of the drop at one sample at a time."""
        del model
        return _Online(values, pack.resistance_ohm)


class _Online(OnlineEffect):
    def __init__(self, values: Values, resistance_ohm: float) -> None:
        self._share = values["share"]
        self._activation_k = values["activation_k"]
        self._delayed = values["delayed"]
        self._reference_per_k = inverse_k_at(values["reference_c"])
        self._resistance_ohm = resistance_ohm
        self._inside = Inside(values["lag_s"])
        self.follows_temperature = self._inside.is_late
        self._volts = 0.0

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        scaled_v = scaled_drop_at(drop_v, current_a, self._delayed, self._resistance_ohm)
        colder = inverse_k_at(self._inside.step(time_s, temperature_c)) - self._reference_per_k
        self._volts = self._share * scaled_v * math.expm1(self._activation_k * colder)

    def extra_voltage(self, soc_pct: float) -> float:
        del soc_pct
        return self._volts

    def memory(self) -> list[float]:
        return self._inside.memory()

    def remember(self, memory: Sequence[float], latest_s: float) -> None:
        self._inside.remember(memory, latest_s)

"""Open-circuit voltage whose temperature coefficient changes with SoC."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from cangauge.model.effects.effect import (
    WITHIN_C,
    Effect,
    FloatArray,
    OnlineEffect,
    Pack,
    PackState,
    Parameter,
    Values,
)
from cangauge.model.voltage_model import VoltageModel


class EntropicCoefficient(Effect):
    """Change of dU/dT: its level, slope and curvature over SoC, on top of the model's kt.

    The bounds are ± 0.4 mV/K a cell.
    """

    id = "entropic_coefficient"
    family = "equilibrium"
    is_structure: ClassVar[bool] = True
    parameters = (
        Parameter("level_v_per_k", "V/K", -1.1e-4, 1.1e-4, scale="voltage"),
        Parameter("slope_v_per_k", "V/K", -1.1e-4, 1.1e-4, scale="voltage"),
        Parameter("curve_v_per_k", "V/K", -1.1e-4, 1.1e-4, scale="voltage"),
    )
    signature = "(T − T_r)·f(S), at any current"
    equation = "ΔU = (T − T_r)·(c + a·x + b·(3x² − 1)/2), x = S/50 − 1"
    source = "Reynier, Yazami, Fultz, J. Power Sources 119–121 (2003) 850"
    separated_by = (
        "the same SoC, rested, at two temperatures; at one temperature it cannot be told from"
        " any other change of the OCV with SoC"
    )

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        """Return the additional open-circuit voltage [V]."""
        del pack
        warmer = np.clip(state.temperature_c, *WITHIN_C) - model.t_ref_c
        x = np.clip(state.soc_pct, 0.0, 100.0) / 50.0 - 1.0
        shape = values["level_v_per_k"] + values["slope_v_per_k"] * x
        shape += values["curve_v_per_k"] * (1.5 * x * x - 0.5)
        return np.asarray(warmer * shape)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the additional open-circuit voltage at one sample at a time."""
        del pack
        return _Online(
            values["level_v_per_k"], values["slope_v_per_k"], values["curve_v_per_k"], model.t_ref_c
        )


class _Online(OnlineEffect):
    uses_soc = True

    def __init__(
        self, level_v_per_k: float, slope_v_per_k: float, curve_v_per_k: float, t_ref_c: float
    ) -> None:
        self._level = level_v_per_k
        self._slope = slope_v_per_k
        self._curve = curve_v_per_k
        self._t_ref_c = t_ref_c
        self._warmer = 0.0

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        del time_s, current_a, drop_v
        low, high = WITHIN_C
        self._warmer = min(max(temperature_c, low), high) - self._t_ref_c

    def extra_voltage(self, soc_pct: float) -> float:
        x = min(max(soc_pct, 0.0), 100.0) / 50.0 - 1.0
        return self._warmer * (self._level + self._slope * x + self._curve * (1.5 * x * x - 0.5))

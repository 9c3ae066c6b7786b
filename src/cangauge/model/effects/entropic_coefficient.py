"""Open-circuit voltage whose temperature coefficient changes with SoC."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from cangauge.model.effects.effect import Effect, FloatArray, OnlineEffect, Values
from cangauge.model.effects.inside import LAG, Inside
from cangauge.model.effects.pack_state import PackState
from cangauge.model.effects.parameter import WITHIN_C, Pack, Parameter
from cangauge.model.voltage_model import VoltageModel


class EntropicCoefficient(Effect):
    """Change of dU/dT: its level, slope and curvature over SoC, on top of the model's kt.

    The bounds are ± 0.4 mV/K a cell. The temperature is that of the cells' inside, which may follow
    the measured one late (`lag_s`, 0: at once).
    """

    id = "entropic_coefficient"
    family = "equilibrium"
    is_structure: ClassVar[bool] = True
    parameters = (
        Parameter("level_v_per_k", "V/K", -1.1e-4, 1.1e-4, scale="voltage"),
        Parameter("slope_v_per_k", "V/K", -1.1e-4, 1.1e-4, scale="voltage"),
        Parameter("curve_v_per_k", "V/K", -1.1e-4, 1.1e-4, scale="voltage"),
        LAG,
    )
    signature = "(T − T_r)·f(S), at any current"
    equation = (
        "ΔU = (T − T_r)·(c + a·x + b·(3x² − 1)/2), x = S/50 − 1; τ·dT/dt = T_measured − T,"
        " τ = lag_s"
    )
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
        warmer = np.clip(state.inside_c(values["lag_s"]), *WITHIN_C) - model.t_ref_c
        x = np.clip(state.soc_pct, 0.0, 100.0) / 50.0 - 1.0
        shape = values["level_v_per_k"] + values["slope_v_per_k"] * x
        shape += values["curve_v_per_k"] * (1.5 * x * x - 0.5)
        return np.asarray(warmer * shape)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the additional open-circuit voltage at one sample at a time."""
        del pack
        return _Online(values, model.t_ref_c)


class _Online(OnlineEffect):
    uses_soc = True

    def __init__(self, values: Values, t_ref_c: float) -> None:
        self._level = values["level_v_per_k"]
        self._slope = values["slope_v_per_k"]
        self._curve = values["curve_v_per_k"]
        self._inside = Inside(values["lag_s"])
        self.follows_temperature = self._inside.is_late
        self._t_ref_c = t_ref_c
        self._warmer = 0.0

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        del current_a, drop_v
        low, high = WITHIN_C
        inside_at = self._inside.step(time_s, temperature_c)
        self._warmer = min(max(inside_at, low), high) - self._t_ref_c

    def extra_voltage(self, soc_pct: float) -> float:
        x = min(max(soc_pct, 0.0), 100.0) / 50.0 - 1.0
        return self._warmer * (self._level + self._slope * x + self._curve * (1.5 * x * x - 0.5))

    def memory(self) -> list[float]:
        return self._inside.memory()

    def remember(self, memory: Sequence[float], latest_s: float) -> None:
        self._inside.remember(memory, latest_s)

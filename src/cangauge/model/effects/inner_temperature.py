"""Cells that follow the temperature sensor late: their inside has mass, the sensor has none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from cangauge.model.effects.effect import Effect, FloatArray, OnlineEffect, Values
from cangauge.model.effects.first_order import LowPass
from cangauge.model.effects.pack_state import PackState
from cangauge.model.effects.parameter import Pack, Parameter
from cangauge.model.voltage_model import VoltageModel


class InnerTemperature(Effect):
    """Voltage and resistance that follow the low-passed temperature, beside the measured one.

    Any pack that is heated or cooled from outside shows it, more the larger its cells: it is
    structure and no fault. The diagnosis learns it from reference logs and never names it.
    """

    id = "inner_temperature"
    family = "thermal"
    is_structure: ClassVar[bool] = True
    is_cause: ClassVar[bool] = False
    parameters = (
        Parameter("voltage_v_per_k", "V/K", -5e-4, 5e-4, scale="voltage"),
        Parameter("drop_per_k", "1/K", -0.04, 0.04),
        Parameter("tau_s", "s", 100.0, 10000.0, neutral=None, grid=(400.0, 1200.0, 3600.0)),
    )
    signature = "in proportion to how far the temperature is from its own past, at rest and in use"
    equation = "ΔU = (c + b·ΣRj·I(t − dj))·(T_τ − T),  τ·dT_τ/dt = T − T_τ, T_τ = T at the start"
    source = "two-state thermal model, Forgez et al., J. Power Sources 195 (2010) 2961"
    separated_by = "other logs that warm or cool: what is in all of them is the pack's"

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        """Return the additional voltage [V]."""
        del model, pack
        per_k = values["voltage_v_per_k"] + values["drop_per_k"] * state.drop_v
        return per_k * (state.inside_c(values["tau_s"]) - state.temperature_c)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the additional voltage at one sample at a time."""
        del model, pack
        return _Online(values["voltage_v_per_k"], values["drop_per_k"], values["tau_s"])


class _Online(OnlineEffect):
    follows_temperature = True

    def __init__(self, voltage_v_per_k: float, drop_per_k: float, tau_s: float) -> None:
        self._voltage_v_per_k = voltage_v_per_k
        self._drop_per_k = drop_per_k
        self._inside = LowPass(tau_s)
        self._volts = 0.0

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        del current_a
        away = self._inside.step(time_s, temperature_c) - temperature_c
        self._volts = (self._voltage_v_per_k + self._drop_per_k * drop_v) * away

    def extra_voltage(self, soc_pct: float) -> float:
        del soc_pct
        return self._volts

    def memory(self) -> list[float]:
        return self._inside.memory()

    def remember(self, memory: Sequence[float], latest_s: float) -> None:
        self._inside.remember(memory, latest_s)

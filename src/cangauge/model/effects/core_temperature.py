"""Cells warmer inside than where the temperature is measured, by the heat of the current."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

from cangauge.model.charge import BRIDGE_S
from cangauge.model.effects.effect import (
    Effect,
    OnlineEffect,
    Pack,
    Parameter,
    Reading,
    Signals,
    Values,
)
from cangauge.model.effects.first_order import LowPass, low_passed
from cangauge.model.voltage_model import VoltageModel


class CoreTemperature(Effect):
    """Core above surface by low-passed Joule heat; the model sees the core's temperature.

    Without a temperature coefficient in the model, or an effect that uses the temperature, it
    changes nothing.
    """

    id = "core_temperature"
    family = "thermal"
    is_structure: ClassVar[bool] = True
    parameters = (
        Parameter("rise_k", "K", 0.0, 25.0),
        Parameter(
            "tau_s", "s", 150.0, 4000.0, neutral=None, grid=(200.0, 500.0, 1000.0, 2000.0, 3500.0)
        ),
    )
    signature = "kt times low-passed I²: it builds up over minutes of high current, of either sign"
    equation = "T = T_measured + ΔT,  τ·dΔT/dt = rise·(I/C)² − ΔT (rise: at a lasting 1 C)"
    source = "two-state thermal model, Forgez et al., J. Power Sources 195 (2010) 2961"
    separated_by = (
        "high current of alternating sign at constant SoC: slow_diffusion, linear in I, cancels;"
        " temperature_lag follows the sensor and not the current"
    )

    def correct(self, signals: Signals, values: Values, pack: Pack) -> Signals:
        """Return the signals with the core's temperature."""
        heat = (signals.current_a / pack.capacity_ah) ** 2
        above = low_passed(signals.time_s, heat, values["tau_s"], 0.0, rest_s=BRIDGE_S)
        return replace(signals, temperature_c=signals.temperature_c + values["rise_k"] * above)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the correction of one sample at a time."""
        del model
        return _Online(values["rise_k"], values["tau_s"], pack.capacity_ah)


class _Online(OnlineEffect):
    def __init__(self, rise_k: float, tau_s: float, capacity_ah: float) -> None:
        self._rise_k = rise_k
        self._capacity_ah = capacity_ah
        self._above = LowPass(tau_s, 0.0, rest_s=BRIDGE_S)

    def correct(self, reading: Reading) -> Sequence[Reading]:
        time_s, current_a, voltage_v, temperature_c = reading
        above = self._above.step(time_s, (current_a / self._capacity_ah) ** 2)
        return (Reading(time_s, current_a, voltage_v, temperature_c + self._rise_k * above),)

    def memory(self) -> list[float]:
        return self._above.memory()

    def remember(self, memory: Sequence[float], latest_s: float) -> None:
        self._above.remember(memory, latest_s)

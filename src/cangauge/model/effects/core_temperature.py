"""Cells whose inside is warmer than where the temperature is measured, and follows it late."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

from cangauge.model.charge import BRIDGE_S
from cangauge.model.effects.effect import Effect, OnlineEffect, Reading, Values
from cangauge.model.effects.first_order import LowPass, low_passed
from cangauge.model.effects.pack_state import Signals
from cangauge.model.effects.parameter import Pack, Parameter
from cangauge.model.voltage_model import VoltageModel


class CoreTemperature(Effect):
    """Core above surface by low-passed Joule heat; the model sees the core's temperature.

    What keeps the heat in keeps the surface's changes out, with one time constant: `late` is the
    part of them that the core follows late (1 where all of the cell is core, 0 where nothing is).
    Without a temperature coefficient in the model, or an effect that uses the temperature, it
    changes nothing.
    """

    id = "core_temperature"
    family = "thermal"
    is_structure: ClassVar[bool] = True
    parameters = (
        Parameter("rise_k", "K", 0.0, 25.0),
        Parameter("late", "1", 0.0, 1.0, formerly=0.0),
        Parameter(
            "tau_s", "s", 150.0, 4000.0, neutral=None, grid=(200.0, 500.0, 1000.0, 2000.0, 3500.0)
        ),
    )
    signature = (
        "kt times low-passed I²: it builds up over minutes of high current, of either sign; and"
        " the opposite of what the measured temperature does, for as long"
    )
    equation = (
        "T = T_m + ΔT + late·(T_τ − T_m),  τ·dΔT/dt = rise·(I/C)² − ΔT (rise: at a lasting 1 C),"
        " τ·dT_τ/dt = T_m − T_τ"
    )
    source = "two-state thermal model, Forgez et al., J. Power Sources 195 (2010) 2961"
    separated_by = (
        "high current of alternating sign at constant SoC: slow_diffusion, linear in I, cancels;"
        " temperature_lag follows the sensor and not the current"
    )

    def correct(self, signals: Signals, values: Values, pack: Pack) -> Signals:
        """Return the signals with the core's temperature."""
        above = signals.history.lagged_a2(values["tau_s"]) / pack.capacity_ah**2
        outside = signals.temperature_c
        core = outside + values["rise_k"] * above
        if values["late"]:
            followed = low_passed(signals.time_s, outside, values["tau_s"], float(outside[0]))
            core = core + values["late"] * (followed - outside)
        return replace(signals, temperature_c=core)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the correction of one sample at a time."""
        del model
        return _Online(values, pack.capacity_ah)


class _Online(OnlineEffect):
    def __init__(self, values: Values, capacity_ah: float) -> None:
        self._rise_k = values["rise_k"]
        self._late = values["late"]
        self._capacity_ah = capacity_ah
        self._above = LowPass(values["tau_s"], 0.0, rest_s=BRIDGE_S)
        self._followed = LowPass(values["tau_s"])

    def correct(self, reading: Reading) -> Sequence[Reading]:
        time_s, current_a, voltage_v, temperature_c = reading
        above = self._above.step(time_s, (current_a / self._capacity_ah) ** 2)
        core = temperature_c + self._rise_k * above
        if self._late and not math.isnan(temperature_c):
            core += self._late * (self._followed.step(time_s, temperature_c) - temperature_c)
        return (Reading(time_s, current_a, voltage_v, core),)

    def memory(self) -> list[float]:
        above, followed = self._above.memory(), self._followed.memory()
        return [*above, *followed] if self._late else above

    def remember(self, memory: Sequence[float], latest_s: float) -> None:
        half = 3
        self._above.remember(memory[:half], latest_s)
        if self._late:
            self._followed.remember(memory[half:], latest_s)
        elif memory[half:]:
            raise ValueError("longer than this effect remembers")

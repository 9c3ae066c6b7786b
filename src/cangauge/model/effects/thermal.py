"""Temperature sensor that lags behind what it measures by `tau_s`.

Cells whose inside is warmer than where the temperature is measured, and follows it late.

Cells that follow the temperature sensor late: their inside has mass, the sensor has none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

from cangauge._typing import FloatArray
from cangauge.model.charge import BRIDGE_S
from cangauge.model.effects.base import (
    Effect,
    OnlineEffect,
    Pack,
    PackState,
    Parameter,
    Reading,
    Signals,
    Values,
)
from cangauge.model.effects.first_order import LowPass, low_passed
from cangauge.model.voltage_model import VoltageModel

# --- Temperature sensor that lags behind what it measures by `tau_s`

SMOOTHING_S = 200.0
"""Time constant of the derivative's smoothing [s]: short against a pack's warming, long against
the steps of a sensor that shows whole degrees. It is the same for all lags, so that the effect
is linear in `tau_s`."""


class TemperatureLag(Effect):
    """First-order lag of the sensor, undone with a smoothed derivative that looks back only."""

    id = "temperature_lag"
    family = "thermal"
    is_structure: ClassVar[bool] = True
    parameters = (Parameter("tau_s", "s", 0.0, 2000.0),)
    signature = "kt·τ·dT/dt: while the pack warms or cools, gone when it is even"
    equation = "T = T_measured + τ·dT_measured/dt, the derivative smoothed over 200 s"
    source = "first-order response of a sensor; Michalski et al., Temperature Measurement, 2001"
    separated_by = "warming or cooling from outside without current: core_temperature needs current"

    def correct(self, signals: Signals, values: Values, pack: Pack) -> Signals:
        """Return the signals with the temperature ahead of the sensor."""
        del pack
        measured = signals.temperature_c
        smooth = low_passed(signals.time_s, measured, SMOOTHING_S, float(measured[0]))
        ahead = values["tau_s"] / SMOOTHING_S
        return replace(signals, temperature_c=measured + ahead * (measured - smooth))

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the correction of one sample at a time."""
        del model, pack
        return _TemperatureLagOnline(values["tau_s"] / SMOOTHING_S)


class _TemperatureLagOnline(OnlineEffect):
    def __init__(self, ahead: float) -> None:
        self._ahead = ahead
        self._smooth = LowPass(SMOOTHING_S)

    def correct(self, reading: Reading) -> Sequence[Reading]:
        time_s, current_a, voltage_v, measured = reading
        if math.isnan(measured):
            return (reading,)
        smooth = self._smooth.step(time_s, measured)
        return (
            Reading(time_s, current_a, voltage_v, measured + self._ahead * (measured - smooth)),
        )

    def memory(self) -> list[float]:
        return self._smooth.memory()

    def remember(self, memory: Sequence[float], latest_s: float) -> None:
        self._smooth.remember(memory, latest_s)


# --- Cells whose inside is warmer than where the temperature is measured, and follows it late


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
        return _CoreTemperatureOnline(values, pack.capacity_ah)


class _CoreTemperatureOnline(OnlineEffect):
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


# --- Cells that follow the temperature sensor late: their inside has mass, the sensor has none


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
        return _InnerTemperatureOnline(
            values["voltage_v_per_k"], values["drop_per_k"], values["tau_s"]
        )


class _InnerTemperatureOnline(OnlineEffect):
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

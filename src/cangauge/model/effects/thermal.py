"""Differences between the measured temperature and that of the cells."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

from cangauge._typing import FloatArray
from cangauge.model.coulomb_counting import BRIDGE_S
from cangauge.model.effects.base import (
    CoreForm,
    Effect,
    OnlineEffect,
    OnlineInteriorEffect,
    Pack,
    PackState,
    Parameter,
    Reading,
    Signals,
    Values,
)
from cangauge.model.effects.first_order import LowPass
from cangauge.model.voltage_model import VoltageModel

SMOOTHING_S = 200.0
"""Time constant of the smoothed derivative [s]: short against the warming of a pack, long against
the steps of a sensor with whole degrees; the same for all lags, so that the effect is linear in
`tau_s`."""


class TemperatureLag(Effect):
    """First-order lag of the temperature sensor, undone with a causal smoothed derivative."""

    id = "temperature_lag"
    family = "thermal"
    is_structure: ClassVar[bool] = True
    parameters = (Parameter("tau_s", "s", 0.0, 2000.0),)
    signature = "kt·τ·dT/dt: while the pack warms or cools, zero at constant temperature"
    equation = "T = T_measured + τ·dT_measured/dt, the derivative smoothed over 200 s"
    source = "first-order response of a sensor; Michalski et al., Temperature Measurement, 2001"
    separated_by = "warming or cooling from outside without current: core_temperature needs current"

    def correct(self, signals: Signals, values: Values, pack: Pack) -> Signals:
        measured = signals.temperature_c
        smooth = signals.history.lagged_c(measured, SMOOTHING_S)
        ahead = values["tau_s"] / SMOOTHING_S
        return replace(signals, temperature_c=measured + ahead * (measured - smooth))

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        return _TemperatureLagOnline(values["tau_s"] / SMOOTHING_S)


class _TemperatureLagOnline(OnlineEffect):
    def __init__(self, ahead: float) -> None:
        self._ahead = ahead
        self._smooth = LowPass(SMOOTHING_S)
        self.lags = (self._smooth,)

    def core_form(self) -> CoreForm:
        return CoreForm("temperature_lag", (self._ahead,), (SMOOTHING_S,))

    def correct(self, reading: Reading) -> Sequence[Reading]:
        time_s, current_a, voltage_v, measured = reading
        if math.isnan(measured):
            return (reading,)
        smooth = self._smooth.step(time_s, measured)
        return (
            Reading(time_s, current_a, voltage_v, measured + self._ahead * (measured - smooth)),
        )


class CoreTemperature(Effect):
    """Core temperature: surface plus low-passed Joule heat, instead of the measured temperature.

    The thermal insulation also delays changes of the ambient temperature, with the same time
    constant: `late` is the fraction of them that the core follows with the lag (1: the whole cell
    is core). It has an effect only in a model with a temperature coefficient, or together with an
    effect that uses the temperature.
    """

    id = "core_temperature"
    family = "thermal"
    is_structure: ClassVar[bool] = True
    parameters = (
        Parameter("rise_k", "K", 0.0, 25.0),
        Parameter("late", "1", 0.0, 1.0),
        Parameter(
            "tau_s", "s", 150.0, 4000.0, neutral=None, grid=(200.0, 500.0, 1000.0, 2000.0, 3500.0)
        ),
    )
    signature = (
        "kt times low-passed I²: it builds up over minutes of high current of either sign; and"
        " the negative change of the measured temperature over the same time"
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
        above = signals.history.lagged_a2(values["tau_s"]) / pack.capacity_ah**2
        outside = signals.temperature_c
        core = outside + values["rise_k"] * above
        if values["late"]:
            followed = signals.history.lagged_c(outside, values["tau_s"])
            core = core + values["late"] * (followed - outside)
        return replace(signals, temperature_c=core)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        return _CoreTemperatureOnline(values, pack.capacity_ah)


class _CoreTemperatureOnline(OnlineEffect):
    def __init__(self, values: Values, capacity_ah: float) -> None:
        self._rise_k = values["rise_k"]
        self._late = values["late"]
        self._capacity_ah = capacity_ah
        self._above = LowPass(values["tau_s"], 0.0, rest_s=BRIDGE_S)
        self._followed = LowPass(values["tau_s"])
        self.lags = (self._above, self._followed) if self._late else (self._above,)

    def core_form(self) -> CoreForm:
        values = (self._rise_k, self._late, self._capacity_ah)
        return CoreForm("core_temperature", values, (self._above.tau_s, self._followed.tau_s))

    def correct(self, reading: Reading) -> Sequence[Reading]:
        time_s, current_a, voltage_v, temperature_c = reading
        rate = current_a / self._capacity_ah
        above = self._above.step(time_s, rate * rate)
        core = temperature_c + self._rise_k * above
        if self._late and not math.isnan(temperature_c):
            core += self._late * (self._followed.step(time_s, temperature_c) - temperature_c)
        return (Reading(time_s, current_a, voltage_v, core),)


class InnerTemperature(Effect):
    """Voltage and resistance of a cell interior that lags behind the measured temperature.

    Every pack that is heated or cooled from outside has it, and larger cells have more of it: it is
    structure, not a fault. The diagnosis learns it from reference logs and never names it.
    """

    id = "inner_temperature"
    family = "thermal"
    is_pointwise: ClassVar[bool] = True
    is_structure: ClassVar[bool] = True
    is_cause: ClassVar[bool] = False
    parameters = (
        Parameter("voltage_v_per_k", "V/K", -5e-4, 5e-4, scale="voltage"),
        Parameter("drop_per_k", "1/K", -0.04, 0.04),
        Parameter("tau_s", "s", 100.0, 10000.0, neutral=None, grid=(400.0, 1200.0, 3600.0)),
    )
    signature = "in proportion to the recent change of temperature (minutes, hours), at any current"
    equation = "ΔU = (c + b·ΣRj·I(t − dj))·(T_τ − T),  τ·dT_τ/dt = T − T_τ, T_τ = T at the start"
    source = "two-state thermal model, Forgez et al., J. Power Sources 195 (2010) 2961"
    separated_by = "other logs that warm or cool: what all of them share belongs to the pack"

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        per_k = values["voltage_v_per_k"] + values["drop_per_k"] * state.drop_v
        return per_k * (state.lagged_temperature_c(values["tau_s"]) - state.temperature_c)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        return _InnerTemperatureOnline(values)


class _InnerTemperatureOnline(OnlineInteriorEffect):
    def __init__(self, values: Values) -> None:
        super().__init__(values["tau_s"])
        self._voltage_v_per_k = values["voltage_v_per_k"]
        self._drop_per_k = values["drop_per_k"]

    def core_form(self) -> CoreForm:
        values = (self._voltage_v_per_k, self._drop_per_k)
        return CoreForm("inner_temperature", values, (self.interior.tau_s,))

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        away = self.interior.step(time_s, temperature_c) - temperature_c
        self.volts = (self._voltage_v_per_k + self._drop_per_k * drop_v) * away

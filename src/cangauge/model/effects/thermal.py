"""Differences between the measured temperature and that of the cells."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from cangauge._typing import FloatArray
from cangauge.logs.gaps import BRIDGE_S
from cangauge.model.effects.base import (
    CoreForm,
    Effect,
    Load,
    Memories,
    Pack,
    Parameter,
    Signals,
    Values,
)
from cangauge.model.first_order import Lag
from cangauge.model.voltage_model import VoltageModel

SMOOTHING_S = 200.0
"""Time constant of the smoothed derivative [s]: short against the warming of a pack, long against
the steps of a sensor with whole degrees; the same for all lags, so that the effect is linear in
`tau_s`."""


class TemperatureLag(Effect):
    """First-order lag of the temperature sensor, undone with a causal smoothed derivative."""

    id = "temperature_lag"
    family = "thermal"
    parameters = (Parameter("tau_s", "s", 0.0, 2000.0),)
    signature = "kt·τ·dT/dt: while the pack warms or cools, zero at constant temperature"
    equation = "T = T_measured + τ·dT_measured/dt, the derivative smoothed over 200 s"
    source = "first-order response of a sensor; Michalski et al., Temperature Measurement, 2001"
    separated_by = "warming or cooling from outside without current: core_temperature needs current"

    def memory(self, values: Values, pack: Pack) -> Memories:
        return (Lag(SMOOTHING_S),)

    def correct(self, signals: Signals, values: Values, pack: Pack, memory: Memories) -> Signals:
        measured = signals.temperature_c
        smooth = memory[0].step(signals.time_s, measured)
        ahead = values["tau_s"] / SMOOTHING_S
        return signals._replace(temperature_c=measured + ahead * (measured - smooth))

    def core_form(self, values: Values, model: VoltageModel, pack: Pack) -> CoreForm:
        return CoreForm("temperature_lag", (values["tau_s"] / SMOOTHING_S,), (SMOOTHING_S,))


class CoreTemperature(Effect):
    """Core temperature: surface plus low-passed Joule heat, instead of the measured temperature.

    The thermal insulation also delays changes of the ambient temperature, with the same time
    constant: `late` is the fraction of them that the core follows with the lag (1: the whole cell
    is core). It has an effect only in a model with a temperature coefficient, or together with an
    effect that uses the temperature.
    """

    id = "core_temperature"
    family = "thermal"
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

    def memory(self, values: Values, pack: Pack) -> Memories:
        above = Lag(values["tau_s"], 0.0, rest_s=BRIDGE_S)
        return (above, Lag(values["tau_s"])) if values["late"] else (above,)

    def correct(self, signals: Signals, values: Values, pack: Pack, memory: Memories) -> Signals:
        time_s, current_a, _, outside = signals
        core = outside + values["rise_k"] * memory[0].step(
            time_s, (current_a / pack.capacity_ah) ** 2
        )
        if values["late"]:
            core = core + values["late"] * (memory[1].step(time_s, outside) - outside)
        return signals._replace(temperature_c=core)

    def core_form(self, values: Values, model: VoltageModel, pack: Pack) -> CoreForm:
        constants = (values["rise_k"], values["late"], pack.capacity_ah)
        return CoreForm("core_temperature", constants, (values["tau_s"],) * 2)


class InnerTemperature(Effect):
    """Voltage and resistance of a cell interior that lags behind the measured temperature.

    Every pack that is heated or cooled from outside has it, and larger cells have more of it: it is
    structure, not a fault. The diagnosis learns it from reference logs and never names it.
    """

    id = "inner_temperature"
    family = "thermal"
    scales_drop: ClassVar[bool] = True
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

    def memory(self, values: Values, pack: Pack) -> Memories:
        return (Lag(values["tau_s"]),)

    def drive(
        self, load: Load, values: Values, model: VoltageModel, pack: Pack, memory: Memories
    ) -> FloatArray:
        per_k = values["voltage_v_per_k"] + values["drop_per_k"] * load.drop_v
        away = memory[0].step(load.time_s, load.temperature_c) - load.temperature_c
        return np.asarray(per_k * away)

    def core_form(self, values: Values, model: VoltageModel, pack: Pack) -> CoreForm:
        constants = (values["voltage_v_per_k"], values["drop_per_k"])
        return CoreForm("inner_temperature", constants, (values["tau_s"],))

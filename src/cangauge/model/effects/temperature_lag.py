"""Temperature sensor that lags behind what it measures by `tau_s`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

from cangauge.model.effects.effect import Effect, OnlineEffect, Reading, Values
from cangauge.model.effects.first_order import LowPass, low_passed
from cangauge.model.effects.pack_state import Signals
from cangauge.model.effects.parameter import Pack, Parameter
from cangauge.model.voltage_model import VoltageModel

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
        return _Online(values["tau_s"] / SMOOTHING_S)


class _Online(OnlineEffect):
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

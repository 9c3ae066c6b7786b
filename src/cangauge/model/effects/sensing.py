"""Linear errors of the current and voltage sensors: measured = gain·true + offset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, Literal

from cangauge.model.effects.base import (
    CoreForm,
    Effect,
    OnlineEffect,
    Pack,
    Parameter,
    Reading,
    Signals,
    Values,
)
from cangauge.model.voltage_model import VoltageModel


class _LinearSensor(Effect):
    """Offset or gain error of one signal, undone by true = (measured − offset) / gain."""

    signal: ClassVar[Literal["current_a", "voltage_v"]]

    def offset_and_gain(self, values: Values) -> tuple[float, float]:
        """Return offset [unit of the signal] and gain [1] of the sensor."""
        (parameter,) = self.parameters
        value = values[parameter.name]
        return (0.0, 1.0 + value / 100.0) if parameter.unit == "%" else (value, 1.0)

    def correct(self, signals: Signals, values: Values, pack: Pack) -> Signals:
        offset, gain = self.offset_and_gain(values)
        if self.signal == "current_a":
            return replace(signals, current_a=(signals.current_a - offset) / gain)
        return replace(signals, voltage_v=(signals.voltage_v - offset) / gain)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        offset, gain = self.offset_and_gain(values)
        return _OnlineLinear(offset, gain, is_current=self.signal == "current_a")


class _OnlineLinear(OnlineEffect):
    def __init__(self, offset: float, gain: float, *, is_current: bool) -> None:
        self._offset = offset
        self._gain = gain
        self._is_current = is_current

    def core_form(self) -> CoreForm:
        kind = "current_sensor" if self._is_current else "voltage_sensor"
        return CoreForm(kind, (self._offset, self._gain))

    def correct(self, reading: Reading) -> Sequence[Reading]:
        time_s, current_a, voltage_v, temperature_c = reading
        if self._is_current:
            current_a = (current_a - self._offset) / self._gain
        else:
            voltage_v = (voltage_v - self._offset) / self._gain
        return (Reading(time_s, current_a, voltage_v, temperature_c),)


class CurrentOffset(_LinearSensor):
    """Zero error of the current sensor, or an unmeasured parasitic load (with opposite sign)."""

    id = "current_offset"
    family = "current_sensing"
    signal = "current_a"
    parameters = (Parameter("offset_a", "A", -0.15, 0.15, scale="capacity"),)
    signature = "a constant R·b, and a slope over time as the count drifts: OCV′·b·t/C"
    equation = "I = I_measured − b"
    source = "zero error, JCGM 200:2012 (VIM)"
    secant_points = (-0.3, 0.3)
    separated_by = (
        "a long rest with the bus awake: the count drifts while no current flows. Not separable"
        " from a load that bypasses the sensor; from capacity by alternating driving and resting"
    )


class CurrentGain(_LinearSensor):
    """Gain error of the current sensor: every current reads `gain_pct` too high."""

    id = "current_gain"
    family = "current_sensing"
    signal = "current_a"
    parameters = (Parameter("gain_pct", "%", -10.0, 10.0),)
    signature = "a scaled drop over the resistance, and a slope over SoC as the count is scaled"
    equation = "I = I_measured / (1 + g)"
    source = "sensitivity error, JCGM 200:2012 (VIM)"
    separated_by = (
        "a drive at high current over little SoC (drop) against a long gentle one (count);"
        " not separable from a joint change of capacity and resistance"
    )


class VoltageOffset(_LinearSensor):
    """Zero error of the voltage sensor: it reads `offset_v` too high."""

    id = "voltage_offset"
    family = "voltage_sensing"
    signal = "voltage_v"
    parameters = (Parameter("offset_v", "V", -0.04, 0.04, scale="voltage"),)
    signature = "a constant, at any current, SoC and temperature"
    equation = "U = U_measured − b"
    source = "zero error, JCGM 200:2012 (VIM)"
    separated_by = (
        "a log over much SoC: the error of an initial SoC shrinks where the OCV is flat, that of a"
        " gain follows the voltage, this one is constant; or the voltage with open contactors"
    )


class VoltageGain(_LinearSensor):
    """Gain error of the voltage sensor: every voltage reads `gain_pct` too high."""

    id = "voltage_gain"
    family = "voltage_sensing"
    signal = "voltage_v"
    parameters = (Parameter("gain_pct", "%", -4.0, 4.0),)
    signature = "in proportion to the voltage: nearly constant, a little smaller near empty"
    equation = "U = U_measured / (1 + g)"
    source = "sensitivity error, JCGM 200:2012 (VIM)"
    separated_by = (
        "a log from full to empty: at one SoC it is not separable from voltage_offset, since the"
        " voltage of a pack varies by only a fifth"
    )

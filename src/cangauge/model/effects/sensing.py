"""Linear errors of the current and voltage sensors: measured = gain·true + offset."""

from __future__ import annotations

from typing import ClassVar, Literal

from cangauge.model.effects.base import (
    CoreForm,
    Effect,
    Memories,
    Pack,
    Parameter,
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

    def correct(self, signals: Signals, values: Values, pack: Pack, memory: Memories) -> Signals:
        offset, gain = self.offset_and_gain(values)
        true = (getattr(signals, self.signal) - offset) / gain
        return signals._replace(**{self.signal: true})

    def core_form(self, values: Values, model: VoltageModel, pack: Pack) -> CoreForm:
        kind = "current_sensor" if self.signal == "current_a" else "voltage_sensor"
        return CoreForm(kind, self.offset_and_gain(values))


class CurrentOffset(_LinearSensor):
    """Zero error of the current sensor, or an unmeasured parasitic load (with opposite sign)."""

    id = "current_offset"
    family = "current_sensing"
    signal = "current_a"
    parameters = (Parameter("offset_a", "A", -0.15, 0.15, scale="capacity"),)
    signature = "a constant R·b, and a slope over time as the count drifts: OCV′·b·t/C"
    equation = "I = I_measured − b"
    source = "zero error, JCGM 200:2012 (VIM)"
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

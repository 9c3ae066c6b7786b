"""Current sensor with a zero error: it shows `offset_a` too much.

Current sensor with a wrong gain: it shows `gain_pct` too much of every current.

Voltage sensor with a zero error: it shows `offset_v` too much.

Voltage sensor with a wrong gain: it shows `gain_pct` too much of every voltage.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from cangauge.model.effects.base import (
    Effect,
    OnlineEffect,
    Pack,
    Parameter,
    Reading,
    Signals,
    Values,
)
from cangauge.model.voltage_model import VoltageModel

# --- Current sensor with a zero error: it shows `offset_a` too much


class CurrentOffset(Effect):
    """Zero error of the current sensor, or an unmeasured parasitic load (with the sign turned)."""

    id = "current_offset"
    family = "current_sensing"
    parameters = (Parameter("offset_a", "A", -0.15, 0.15, scale="capacity"),)
    signature = "a constant R·b, and a slope over time as the count drifts: OCV′·b·t/C"
    equation = "I = I_measured − b"
    source = "zero error, JCGM 200:2012 (VIM)"
    bends_at = (-0.3, 0.3)
    separated_by = (
        "a long rest with the bus awake: the count drifts with no current flowing. Not to be told"
        " from a load that bypasses the sensor; from capacity by driving and resting in turn"
    )

    def correct(self, signals: Signals, values: Values, pack: Pack) -> Signals:
        """Return the signals with the offset taken off."""
        del pack
        return replace(signals, current_a=signals.current_a - values["offset_a"])

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the correction of one sample at a time."""
        del model, pack
        return _CurrentOffsetOnline(values["offset_a"])


class _CurrentOffsetOnline(OnlineEffect):
    def __init__(self, offset_a: float) -> None:
        self._offset_a = offset_a

    def correct(self, reading: Reading) -> Sequence[Reading]:
        time_s, current_a, voltage_v, temperature_c = reading
        return (Reading(time_s, current_a - self._offset_a, voltage_v, temperature_c),)


# --- Current sensor with a wrong gain: it shows `gain_pct` too much of every current


class CurrentGain(Effect):
    """Wrong gain of the current sensor."""

    id = "current_gain"
    family = "current_sensing"
    parameters = (Parameter("gain_pct", "%", -10.0, 10.0),)
    signature = "a scaled drop over the resistance, and a slope over SoC as the count is scaled"
    equation = "I = I_measured / (1 + g)"
    source = "sensitivity error, JCGM 200:2012 (VIM)"
    separated_by = (
        "a drive at high current over little SoC (drop) against a long gentle one (count);"
        " not to be told from capacity and the level of resistance changing together"
    )

    def correct(self, signals: Signals, values: Values, pack: Pack) -> Signals:
        """Return the signals with the current scaled back."""
        del pack
        return replace(signals, current_a=signals.current_a / (1.0 + values["gain_pct"] / 100.0))

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the correction of one sample at a time."""
        del model, pack
        return _CurrentGainOnline(1.0 + values["gain_pct"] / 100.0)


class _CurrentGainOnline(OnlineEffect):
    def __init__(self, gain: float) -> None:
        self._gain = gain

    def correct(self, reading: Reading) -> Sequence[Reading]:
        time_s, current_a, voltage_v, temperature_c = reading
        return (Reading(time_s, current_a / self._gain, voltage_v, temperature_c),)


# --- Voltage sensor with a zero error: it shows `offset_v` too much


class VoltageOffset(Effect):
    """Zero error of the voltage sensor."""

    id = "voltage_offset"
    family = "voltage_sensing"
    parameters = (Parameter("offset_v", "V", -0.04, 0.04, scale="voltage"),)
    signature = "a constant, at any current, SoC and temperature"
    equation = "U = U_measured − b"
    source = "zero error, JCGM 200:2012 (VIM)"
    separated_by = (
        "a log over much SoC: an initial SoC's error shrinks where the OCV is flat, a gain's"
        " follows the voltage, this one stays; or the voltage with the contactors open"
    )

    def correct(self, signals: Signals, values: Values, pack: Pack) -> Signals:
        """Return the signals with the offset taken off."""
        del pack
        return replace(signals, voltage_v=signals.voltage_v - values["offset_v"])

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the correction of one sample at a time."""
        del model, pack
        return _VoltageOffsetOnline(values["offset_v"])


class _VoltageOffsetOnline(OnlineEffect):
    def __init__(self, offset_v: float) -> None:
        self._offset_v = offset_v

    def correct(self, reading: Reading) -> Sequence[Reading]:
        time_s, current_a, voltage_v, temperature_c = reading
        return (Reading(time_s, current_a, voltage_v - self._offset_v, temperature_c),)


# --- Voltage sensor with a wrong gain: it shows `gain_pct` too much of every voltage


class VoltageGain(Effect):
    """Wrong gain of the voltage sensor."""

    id = "voltage_gain"
    family = "voltage_sensing"
    parameters = (Parameter("gain_pct", "%", -4.0, 4.0),)
    signature = "in proportion to the voltage: nearly constant, a little smaller near empty"
    equation = "U = U_measured / (1 + g)"
    source = "sensitivity error, JCGM 200:2012 (VIM)"
    separated_by = (
        "a log from full to empty: at one SoC it cannot be told from voltage_offset, since a"
        " pack's voltage moves by only a fifth of itself"
    )

    def correct(self, signals: Signals, values: Values, pack: Pack) -> Signals:
        """Return the signals with the voltage scaled back."""
        del pack
        return replace(signals, voltage_v=signals.voltage_v / (1.0 + values["gain_pct"] / 100.0))

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the correction of one sample at a time."""
        del model, pack
        return _VoltageGainOnline(1.0 + values["gain_pct"] / 100.0)


class _VoltageGainOnline(OnlineEffect):
    def __init__(self, gain: float) -> None:
        self._gain = gain

    def correct(self, reading: Reading) -> Sequence[Reading]:
        time_s, current_a, voltage_v, temperature_c = reading
        return (Reading(time_s, current_a, voltage_v / self._gain, temperature_c),)

"""Voltage sensor with a zero error: it shows `offset_v` too much."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from cangauge.model.effects.effect import Effect, OnlineEffect, Reading, Values
from cangauge.model.effects.pack_state import Signals
from cangauge.model.effects.parameter import Pack, Parameter
from cangauge.model.voltage_model import VoltageModel


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
        return _Online(values["offset_v"])


class _Online(OnlineEffect):
    def __init__(self, offset_v: float) -> None:
        self._offset_v = offset_v

    def correct(self, reading: Reading) -> Sequence[Reading]:
        time_s, current_a, voltage_v, temperature_c = reading
        return (Reading(time_s, current_a, voltage_v - self._offset_v, temperature_c),)

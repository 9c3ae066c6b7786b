"""Current sensor with a zero error: it shows `offset_a` too much."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from cangauge.model.effects.effect import Effect, OnlineEffect, Reading, Values
from cangauge.model.effects.pack_state import Signals
from cangauge.model.effects.parameter import Pack, Parameter
from cangauge.model.voltage_model import VoltageModel


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
        return _Online(values["offset_a"])


class _Online(OnlineEffect):
    def __init__(self, offset_a: float) -> None:
        self._offset_a = offset_a

    def correct(self, reading: Reading) -> Sequence[Reading]:
        time_s, current_a, voltage_v, temperature_c = reading
        return (Reading(time_s, current_a - self._offset_a, voltage_v, temperature_c),)

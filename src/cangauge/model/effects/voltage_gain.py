"""Voltage sensor with a wrong gain: it shows `gain_pct` too much of every voltage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from cangauge.model.effects.effect import Effect, OnlineEffect, Reading, Values
from cangauge.model.effects.pack_state import Signals
from cangauge.model.effects.parameter import Pack, Parameter
from cangauge.model.voltage_model import VoltageModel


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
        return _Online(1.0 + values["gain_pct"] / 100.0)


class _Online(OnlineEffect):
    def __init__(self, gain: float) -> None:
        self._gain = gain

    def correct(self, reading: Reading) -> Sequence[Reading]:
        time_s, current_a, voltage_v, temperature_c = reading
        return (Reading(time_s, current_a, voltage_v / self._gain, temperature_c),)

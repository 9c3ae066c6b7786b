"""Current sensor with a wrong gain: it shows `gain_pct` too much of every current."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from cangauge.model.effects.effect import Effect, OnlineEffect, Reading, Values
from cangauge.model.effects.pack_state import Signals
from cangauge.model.effects.parameter import Pack, Parameter
from cangauge.model.voltage_model import VoltageModel


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
        return _Online(1.0 + values["gain_pct"] / 100.0)


class _Online(OnlineEffect):
    def __init__(self, gain: float) -> None:
        self._gain = gain

    def correct(self, reading: Reading) -> Sequence[Reading]:
        time_s, current_a, voltage_v, temperature_c = reading
        return (Reading(time_s, current_a / self._gain, voltage_v, temperature_c),)

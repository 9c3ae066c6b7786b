"""Capacity other than the model's: the SoC moves faster or slower than counted."""

from __future__ import annotations

from dataclasses import replace

from cangauge.model.effects.effect import Effect, OnlineEffect, Values
from cangauge.model.effects.pack_state import Counting
from cangauge.model.effects.parameter import Pack, Parameter
from cangauge.model.voltage_model import VoltageModel


class Capacity(Effect):
    """Relative change of capacity, by age, cold or a wrong figure."""

    id = "capacity"
    family = "charge"
    parameters = (Parameter("change_pct", "%", -35.0, 35.0),)
    signature = "OCV′·(Ah since the start): a slope over charge, steep in the knee near empty"
    equation = "S = S₀ − 100·∫I dt / (C·(1 + x))"
    source = "Plett, Battery Management Systems vol. II, Artech House 2015, ch. 4"
    bends_at = (-0.6, -0.2, 0.2, 0.5)
    separated_by = (
        "a discharge from full to the knee at steady temperature; from current_offset by driving"
        " and resting in turn, from current_gain by the drop over the resistance"
    )

    def count(self, counting: Counting, values: Values) -> Counting:
        """Return the counting with the changed capacity."""
        return replace(
            counting, capacity_ah=counting.capacity_ah * (1.0 + values["change_pct"] / 100.0)
        )

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return nothing to do a sample: the counter has the changed capacity."""
        del values, model, pack
        return OnlineEffect()

"""Charge put in that cannot all be taken out again."""

from __future__ import annotations

from dataclasses import replace

from cangauge.model.effects.effect import Effect, OnlineEffect, Values
from cangauge.model.effects.pack_state import Counting
from cangauge.model.effects.parameter import Pack, Parameter
from cangauge.model.voltage_model import VoltageModel


class CoulombicEfficiency(Effect):
    """Part of the charging current that counts."""

    id = "coulombic_efficiency"
    family = "charge"
    # Cells lose less than a tenth; more is a sensor that reads charging too high, or a charge that
    # goes past it, and looks the same.
    parameters = (Parameter("efficiency", "1", 0.7, 1.0, neutral=1.0),)
    signature = "OCV′·(Ah charged since the start): a drift that grows with regeneration only"
    equation = "S = S₀ − 100·∫(I⁺ + η·I⁻)dt / C"
    source = "Plett, Battery Management Systems vol. II, Artech House 2015, ch. 1"
    separated_by = (
        "logs with much and with little regeneration over the same discharge, or a full charge"
        " within the log; from capacity and current_offset not in a plain drive"
    )

    def count(self, counting: Counting, values: Values) -> Counting:
        """Return the counting with the efficiency of charging."""
        efficiency = counting.charge_efficiency * values["efficiency"]
        return replace(counting, charge_efficiency=efficiency)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return nothing to do a sample: the counter weighs the current."""
        del values, model, pack
        return OnlineEffect()

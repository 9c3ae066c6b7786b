"""Capacity other than the model's: the SoC moves faster or slower than counted.

SoC at the start other than assumed.

Charge put in that cannot all be taken out again.
"""

from __future__ import annotations

from dataclasses import replace

from cangauge.model.effects.base import Counting, Effect, OnlineEffect, Pack, Parameter, Values
from cangauge.model.voltage_model import VoltageModel

# --- Capacity other than the model's: the SoC moves faster or slower than counted


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


# --- SoC at the start other than assumed


class InitialSoc(Effect):
    """Error of the SoC that the count begins from; a property of a log, not of a pack.

    Online it is added to the initial SoC that the user gives; where the first voltage gives it,
    there is nothing to correct.
    """

    id = "initial_soc"
    family = "charge"
    parameters = (Parameter("offset_pct", "%", -12.0, 12.0),)
    signature = "OCV′(S): larger where the OCV is steep, at any current and time"
    equation = "S₀ = S₀_assumed + x"
    source = "definition"
    bends_at = (-0.7, -0.3, 0.3, 0.7)
    separated_by = (
        "a long rest before the start (the first voltage is then the OCV), or a log that reaches"
        " the steep ends of the OCV, where it grows and voltage_offset does not"
    )

    def count(self, counting: Counting, values: Values) -> Counting:
        """Return the counting from the changed start."""
        return replace(counting, initial_soc_pct=counting.initial_soc_pct + values["offset_pct"])

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return nothing to do a sample: the count begins elsewhere."""
        del values, model, pack
        return OnlineEffect()


# --- Charge put in that cannot all be taken out again


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

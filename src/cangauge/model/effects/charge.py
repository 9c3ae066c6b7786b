"""Errors of charge counting: capacity, initial SoC and coulombic efficiency.

None needs a state online: the estimator's counter uses the changed `Counting`.
"""

from __future__ import annotations

from dataclasses import replace

from cangauge.model.effects.base import Counting, Effect, Parameter, Values


class Capacity(Effect):
    """Relative change of capacity, by ageing, cold or a wrong data sheet."""

    id = "capacity"
    family = "charge"
    parameters = (Parameter("change_pct", "%", -35.0, 35.0),)
    signature = "OCV′·(Ah since the start): a slope over charge, steep in the knee near empty"
    equation = "S = S₀ − 100·∫I dt / (C·(1 + x))"
    source = "Plett, Battery Management Systems vol. II, Artech House 2015, ch. 4"
    separated_by = (
        "a discharge from full to the knee at steady temperature; from current_offset by"
        " alternating driving and resting, from current_gain by the drop over the resistance"
    )

    def count(self, counting: Counting, values: Values) -> Counting:
        return replace(
            counting, capacity_ah=counting.capacity_ah * (1.0 + values["change_pct"] / 100.0)
        )


class InitialSoc(Effect):
    """Error of the SoC at which the count starts; a property of a log, not of a pack.

    Online it is added to the initial SoC given by the user; an initial SoC from the first voltage
    needs no correction.
    """

    id = "initial_soc"
    family = "charge"
    parameters = (Parameter("offset_pct", "%", -12.0, 12.0),)
    signature = "OCV′(S): larger where the OCV is steep, at any current and time"
    equation = "S₀ = S₀_assumed + x"
    source = "definition"
    separated_by = (
        "a long rest before the start (the first voltage is then the OCV), or a log that reaches"
        " the steep ends of the OCV, where it grows and voltage_offset does not"
    )

    def count(self, counting: Counting, values: Values) -> Counting:
        return replace(counting, initial_soc_pct=counting.initial_soc_pct + values["offset_pct"])


class CoulombicEfficiency(Effect):
    """Fraction of the charging current that counts."""

    id = "coulombic_efficiency"
    family = "charge"
    # Cells lose less than a tenth. A larger loss is a sensor that reads charging too high, or
    # charge that bypasses it, with the same signature.
    parameters = (Parameter("efficiency", "1", 0.7, 1.0, neutral=1.0),)
    signature = "OCV′·(Ah charged since the start): a drift that grows with regeneration only"
    equation = "S = S₀ − 100·∫(I⁺ + η·I⁻)dt / C"
    source = "Plett, Battery Management Systems vol. II, Artech House 2015, ch. 1"
    separated_by = (
        "logs with much and with little regeneration over the same discharge, or a full charge"
        " within the log; not separable from capacity and current_offset in a plain drive"
    )

    def count(self, counting: Counting, values: Values) -> Counting:
        efficiency = counting.charge_efficiency * values["efficiency"]
        return replace(counting, charge_efficiency=efficiency)

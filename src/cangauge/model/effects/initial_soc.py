"""SoC at the start other than assumed."""

from __future__ import annotations

from dataclasses import replace

from cangauge.model.effects.effect import Effect, OnlineEffect, Values
from cangauge.model.effects.pack_state import Counting
from cangauge.model.effects.parameter import Pack, Parameter
from cangauge.model.voltage_model import VoltageModel


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

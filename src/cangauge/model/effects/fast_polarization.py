"""Polarisation within seconds: an RC element below 10 s."""

from __future__ import annotations

from typing import ClassVar

from cangauge.model.effects.effect import Effect, FloatArray, OnlineEffect, Values
from cangauge.model.effects.pack_state import PackState
from cangauge.model.effects.parameter import Pack, Parameter
from cangauge.model.effects.rc_element import ACTIVATION, OnlineRc, rc_voltage
from cangauge.model.voltage_model import VoltageModel


class FastPolarization(Effect):
    """Double layer and charge transfer, faster than the model's first delay."""

    id = "fast_polarization"
    family = "dynamics"
    is_structure: ClassVar[bool] = True
    parameters = (
        Parameter("ohm", "ohm", 0.0, 1.0, scale="resistance"),
        Parameter("tau_s", "s", 0.3, 9.0, neutral=None, grid=(0.5, 1.0, 2.0, 3.5, 6.0, 9.0)),
        ACTIVATION,
    )
    signature = "a tail of seconds after every change of load"
    equation = "ΔU = −R·y·exp(B·(1/T − 1/T₂₅)), τ·dy/dt = I − y"
    source = "Hu, Li, Peng, J. Power Sources 198 (2012) 359"
    separated_by = (
        "a log at 10 Hz or faster with sharp pulses: time_skew gives spikes without tails"
    )

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        """Return the element's voltage [V]."""
        del model, pack
        return rc_voltage(state, values["ohm"], values["tau_s"], values["activation_k"])

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the element, one sample at a time."""
        del model, pack
        return OnlineRc(values["ohm"], values["tau_s"], values["activation_k"])

"""Polarisation over many minutes: an RC element beyond the delay line's 70 s."""

from __future__ import annotations

from typing import ClassVar

from cangauge.model.effects.effect import (
    Effect,
    FloatArray,
    OnlineEffect,
    Pack,
    PackState,
    Parameter,
    Values,
)
from cangauge.model.effects.rc_element import ACTIVATION, OnlineRc, rc_voltage
from cangauge.model.voltage_model import VoltageModel


class SlowDiffusion(Effect):
    """Diffusion in the particles and the electrolyte, slower than the model's last delay."""

    id = "slow_diffusion"
    family = "dynamics"
    is_structure: ClassVar[bool] = True
    parameters = (
        Parameter("ohm", "ohm", 0.0, 1.5, scale="resistance"),
        Parameter(
            "tau_s", "s", 70.0, 2500.0, neutral=None,
            grid=(80.0, 130.0, 220.0, 400.0, 750.0, 1400.0, 2400.0),
        ),
        ACTIVATION,
    )  # fmt: skip
    signature = "low-passed current over 70–2500 s: it decays through a rest after a drive"
    equation = "ΔU = −R·y·exp(B·(1/T − 1/T₂₅)), τ·dy/dt = I − y"
    source = "Plett, Battery Management Systems vol. I, Artech House 2015, ch. 2"
    separated_by = (
        "a rest of an hour after a drive: hysteresis stays, this decays;"
        " core_temperature is even in the current"
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

"""Polarisation over many minutes: RC elements beyond the delay line's 70 s."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Final

import numpy as np

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

ELEMENTS: Final = 5
"""RC elements of a spread: with the slowest at 2400 s the fastest has 9 s."""

FASTER: Final = 4.0
"""Each element is so many times faster than the one before it …"""

SMALLER: Final = 2.0
"""… and has so many times less resistance: diffusion's goes with the root of the time."""


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
        Parameter(
            "spread", "1", 0.0, 1.0, neutral=None, grid=(0.0,), elsewhere=(1.0,), formerly=0.0
        ),
        ACTIVATION,
    )  # fmt: skip
    signature = "low-passed current over 70–2500 s: it decays through a rest after a drive"
    equation = (
        "ΔU = −R·Σ wₖ·yₖ·exp(B·(1/T − 1/T₂₅)), (τ/4ᵏ)·dyₖ/dt = I − yₖ, wₖ ∝ (spread/2)ᵏ, k = 0…4"
    )
    source = (
        "Plett, Battery Management Systems vol. I, Artech House 2015, ch. 2; elements spread like"
        " diffusion's: Oldham, J. Electroanal. Chem. 72 (1976) 371"
    )
    separated_by = (
        "a rest of an hour after a drive: hysteresis stays, this decays;"
        " core_temperature is even in the current"
    )

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        """Return the elements' voltage [V]."""
        del model, pack
        total = np.zeros_like(state.current_a)
        for ohm, tau_s in _elements(values):
            total += rc_voltage(state, ohm, tau_s, values["activation_k"])
        return total

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the elements, one sample at a time."""
        del model, pack
        return _OnlineElements(
            [OnlineRc(ohm, tau_s, values["activation_k"]) for ohm, tau_s in _elements(values)]
        )


def _elements(values: Values) -> list[tuple[float, float]]:
    """Return resistance [Ω] and time constant [s] of each element, the slowest first."""
    weights = [(values["spread"] / SMALLER) ** k for k in range(ELEMENTS)]
    return [
        (values["ohm"] * weight / sum(weights), values["tau_s"] / FASTER**k)
        for k, weight in enumerate(weights)
        if weight > 0.0
    ]


class _OnlineElements(OnlineEffect):
    """RC elements in series."""

    def __init__(self, elements: Sequence[OnlineRc]) -> None:
        self._elements = elements

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        """Carry the capacitors to this sample."""
        for element in self._elements:
            element.advance(time_s, current_a, temperature_c, drop_v)

    def extra_voltage(self, soc_pct: float) -> float:
        """Return the elements' voltage [V]."""
        return sum(element.extra_voltage(soc_pct) for element in self._elements)

    def memory(self) -> list[float]:
        """Return what each element remembers, one after the other."""
        return [value for element in self._elements for value in element.memory()]

    def remember(self, memory: Sequence[float], latest_s: float) -> None:
        """Go on from a memory; may raise ValueError."""
        each, over = divmod(len(memory), len(self._elements))
        if over:
            raise ValueError("not that of so many elements")
        for k, element in enumerate(self._elements):
            element.remember(memory[k * each : (k + 1) * each], latest_s)

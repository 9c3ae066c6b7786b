"""Polarisation over many minutes: RC elements beyond the delay line's 70 s."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Final

import numpy as np

from cangauge.model.effects.effect import Effect, FloatArray, OnlineEffect, Values
from cangauge.model.effects.pack_state import PackState
from cangauge.model.effects.parameter import Pack, Parameter
from cangauge.model.effects.rc_element import ACTIVATION, OnlineRc, rc_voltage
from cangauge.model.voltage_model import VoltageModel

ELEMENTS: Final = 5
"""RC elements of a spread: with the slowest at 2400 s the fastest has 9 s."""

FASTER: Final = 4.0
"""Each element is so many times faster than the one before it …"""

SMALLER: Final = 2.0
"""… and has so many times less resistance: diffusion's goes with the root of the time."""

ENDS_PCT: Final = (10.0, 90.0)
"""The open-circuit voltage's mean slope is that between these."""

STEEPEST: Final = 5.0
"""No slope counts as more than this many times the mean."""

FLATTEST: Final = 1e-6
"""And no mean is less [V per %]: a model that does not rise has no slope to follow."""


class SlowDiffusion(Effect):
    """Diffusion in the particles and the electrolyte, slower than the model's last delay.

    What diffuses in the particles is charge, and it shows by the slope of the open-circuit voltage
    (`by_slope` 1); in the electrolyte it shows alike at every SoC (0).
    """

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
        Parameter(
            "by_slope", "1", 0.0, 1.0, neutral=None, grid=(0.0,), elsewhere=(1.0,), formerly=0.0
        ),
    )  # fmt: skip
    signature = "low-passed current over 70–2500 s: it decays through a rest after a drive"
    equation = (
        "ΔU = −R·f(S)·Σ wₖ·yₖ·exp(B·(1/T − 1/T₂₅)), (τ/4ᵏ)·dyₖ/dt = I − yₖ, wₖ ∝ (spread/2)ᵏ,"
        " k = 0…4; f = 1 − b + b·U₀′(S)/mean U₀′, b = by_slope"
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
        del pack
        total = np.zeros_like(state.current_a)
        for ohm, tau_s in _elements(values):
            total += rc_voltage(state, ohm, tau_s, values["activation_k"])
        if values["by_slope"]:
            steepness = state.ocv_slope(model) / _mean_slope(model)
            total *= 1.0 + values["by_slope"] * (np.clip(steepness, 0.0, STEEPEST) - 1.0)
        return total

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the elements, one sample at a time."""
        del pack
        elements = [
            OnlineRc(ohm, tau_s, values["activation_k"]) for ohm, tau_s in _elements(values)
        ]
        return (
            _OnlineBySlope(elements, values, model)
            if values["by_slope"]
            else _OnlineElements(elements)
        )


def _elements(values: Values) -> list[tuple[float, float]]:
    """Return resistance [Ω] and time constant [s] of each element, the slowest first."""
    weights = [(values["spread"] / SMALLER) ** k for k in range(ELEMENTS)]
    return [
        (values["ohm"] * weight / sum(weights), values["tau_s"] / FASTER**k)
        for k, weight in enumerate(weights)
        if weight > 0.0
    ]


def _mean_slope(model: VoltageModel) -> float:
    """Return the mean slope of the pseudo-OCV [V per % SoC], positive."""
    low, high = ENDS_PCT
    rise_v = model.pseudo_ocv_at(high)[0] - model.pseudo_ocv_at(low)[0]
    return max(rise_v / (high - low), FLATTEST)


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


class _OnlineBySlope(_OnlineElements):
    """The same, whose voltage follows the slope of the pseudo-OCV."""

    uses_soc = True

    def __init__(self, elements: Sequence[OnlineRc], values: Values, model: VoltageModel) -> None:
        super().__init__(elements)
        self._by_slope = values["by_slope"]
        self._model = model
        self._mean_slope = _mean_slope(model)

    def extra_voltage(self, soc_pct: float) -> float:
        """Return the elements' voltage [V]."""
        steepness = self._model.pseudo_ocv_at(soc_pct)[1] / self._mean_slope
        share = 1.0 + self._by_slope * (min(max(steepness, 0.0), STEEPEST) - 1.0)
        return share * super().extra_voltage(soc_pct)

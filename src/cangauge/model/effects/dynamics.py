"""Dynamics that the delay line lacks: RC elements below 10 s and beyond 70 s, charge transfer."""

from __future__ import annotations

from typing import Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.logs.gaps import BRIDGE_S
from cangauge.model.effects.base import (
    CoreForm,
    Effect,
    Load,
    Memories,
    Pack,
    Parameter,
    Values,
)
from cangauge.model.effects.resistance import arrhenius
from cangauge.model.first_order import Lag
from cangauge.model.voltage_model import VoltageModel

ACTIVATION = Parameter("activation_k", "K", 0.0, 6000.0, neutral=None, grid=(0.0, 3000.0))
"""Arrhenius activation of an RC element's resistance, which is stated at 25 °C."""


class _Rc(Effect):
    """RC elements in series on the current, at rest before the first sample."""

    def memory(self, values: Values, pack: Pack) -> Memories:
        elements = self.rc_elements(values)
        return tuple(Lag(tau_s, 0.0, rest_s=BRIDGE_S) for _, tau_s in elements)

    def drive(
        self, load: Load, values: Values, model: VoltageModel, pack: Pack, memory: Memories
    ) -> FloatArray:
        volts = np.zeros_like(load.current_a)
        for (ohm, _), lag in zip(self.rc_elements(values), memory, strict=True):
            volts -= ohm * lag.step(load.time_s, load.current_a)
        return volts * arrhenius(load.temperature_c, values["activation_k"])

    def core_form(self, values: Values, model: VoltageModel, pack: Pack) -> CoreForm:
        ohm, tau_s = zip(*self.rc_elements(values), strict=True)
        by_slope = values.get("by_slope", 0.0)
        mean_slope = _mean_slope(model) if by_slope else 1.0
        return CoreForm("rc", (values["activation_k"], by_slope, mean_slope, *ohm), tau_s)


class FastPolarization(_Rc):
    """Double layer and charge transfer, faster than the model's first delay."""

    id = "fast_polarization"
    family = "dynamics"
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

    def rc_elements(self, values: Values) -> list[tuple[float, float]]:
        return [(values["ohm"], values["tau_s"])]


ELEMENTS: Final = 5
"""RC elements of a spread: with the slowest at 2400 s the fastest has 9 s."""

TAU_RATIO: Final = 4.0
"""Ratio of the time constants of neighbouring elements."""

RESISTANCE_RATIO: Final = 2.0
"""Ratio of their resistances: that of diffusion scales with the square root of time."""

MEAN_SLOPE_PCT: Final = (10.0, 90.0)
"""SoC between which the mean slope of the open-circuit voltage is taken [%]."""

STEEPNESS_AT_MOST: Final = 5.0
"""Upper limit of the slope, relative to the mean."""

MEAN_SLOPE_AT_LEAST: Final = 1e-6
"""Lower limit of the mean slope [V per %], so that the ratio exists."""


class SlowDiffusion(_Rc):
    """Diffusion in the particles and the electrolyte, slower than the model's last delay.

    In the particles charge diffuses, and its voltage follows the slope of the open-circuit voltage
    (`by_slope` 1); diffusion in the electrolyte is the same at every SoC (0).
    """

    id = "slow_diffusion"
    family = "dynamics"
    parameters = (
        Parameter("ohm", "ohm", 0.0, 1.5, scale="resistance"),
        Parameter(
            "tau_s", "s", 70.0, 2500.0, neutral=None,
            grid=(80.0, 130.0, 220.0, 400.0, 750.0, 1400.0, 2400.0),
        ),
        Parameter(
            "spread", "1", 0.0, 1.0, neutral=None, grid=(0.0,)
        ),
        ACTIVATION,
        Parameter(
            "by_slope", "1", 0.0, 1.0, neutral=None, grid=(0.0,)
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
        "a rest of an hour after a drive: hysteresis persists, this decays;"
        " core_temperature is even in the current"
    )

    def rc_elements(self, values: Values) -> list[tuple[float, float]]:
        weights = [(values["spread"] / RESISTANCE_RATIO) ** k for k in range(ELEMENTS)]
        return [
            (values["ohm"] * weight / sum(weights), values["tau_s"] / TAU_RATIO**k)
            for k, weight in enumerate(weights)
            if weight > 0.0
        ]

    def over_soc(
        self, soc_pct: FloatArray, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray | float:
        if not values["by_slope"]:
            return 1.0
        steepness = model.pseudo_ocv_slope(soc_pct) / _mean_slope(model)
        limited = np.clip(steepness, 0.0, STEEPNESS_AT_MOST)
        return np.asarray(1.0 + values["by_slope"] * (limited - 1.0))


def _mean_slope(model: VoltageModel) -> float:
    """Return the mean slope of the pseudo-OCV [V per % SoC], positive."""
    low, high = MEAN_SLOPE_PCT
    rise_v = model.pseudo_ocv_at(high)[0] - model.pseudo_ocv_at(low)[0]
    return max(rise_v / (high - low), MEAN_SLOPE_AT_LEAST)


BEND_ZERO_C_RATE = 1.0
"""Current at which the bend alone is zero, as at rest [1/h]: a model identified on logs of the same
pack already contains the mean slope over the currents of a drive."""

ACTIVATION_K = 5000.0
"""Usual activation of the exchange current [K], about 42 kJ/mol; `exchange_a` holds at 25 °C."""


class ChargeTransfer(Effect):
    """Butler–Volmer overpotential v·asinh(I/2I₀), or its bend against a straight line.

    With `bend_only` the line through 0 and ±1 C is subtracted. `scale_v` is 2RT/F per electrode
    (51 mV at 25 °C) times the cells in series; the bound allows two electrodes.
    """

    id = "charge_transfer"
    family = "dynamics"
    parameters = (
        Parameter("scale_v", "V", 0.0, 0.03, scale="voltage"),
        Parameter(
            "exchange_a", "A", 0.01, 2.0, neutral=None, scale="capacity",
            grid=(0.02, 0.05, 0.12, 0.3, 0.8),
        ),
        Parameter("bend_only", "1", 0.0, 1.0, neutral=None, grid=(0.0, 1.0)),
        Parameter(
            "activation_k", "K", 0.0, 10000.0, neutral=None, grid=(ACTIVATION_K,),
        ),
    )  # fmt: skip
    signature = "I − c·asinh(I/2I₀): too much drop at small currents, too little at large ones"
    equation = "ΔU = −v·(asinh(I/2I₀) − b·(I/I₁)·asinh(I₁/2I₀)), I₁ = 1 C, I₀ after Arrhenius (B)"
    source = "Newman, Thomas-Alyea, Electrochemical Systems, 3rd ed., Wiley 2004, ch. 8"
    separated_by = (
        "pulses of several sizes in both directions; resistance_asymmetry is straight on each"
        " side of zero"
    )

    def drive(
        self, load: Load, values: Values, model: VoltageModel, pack: Pack, memory: Memories
    ) -> FloatArray:
        per_a = 0.5 / values["exchange_a"] * arrhenius(load.temperature_c, values["activation_k"])
        zero_a = BEND_ZERO_C_RATE * pack.capacity_ah
        slope = values["bend_only"] * np.arcsinh(zero_a * per_a) / zero_a
        bend = np.arcsinh(load.current_a * per_a) - slope * load.current_a
        return np.asarray(-values["scale_v"] * bend)

    def core_form(self, values: Values, model: VoltageModel, pack: Pack) -> CoreForm:
        constants = (
            values["scale_v"],
            0.5 / values["exchange_a"],
            values["bend_only"],
            values["activation_k"],
            BEND_ZERO_C_RATE * pack.capacity_ah,
        )
        return CoreForm("charge_transfer", constants)

"""Dynamics that the delay line lacks: RC elements below 10 s and beyond 70 s, charge transfer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, Final

import numpy as np

from cangauge._arithmetic import total
from cangauge._typing import FloatArray
from cangauge.model.coulomb_counting import BRIDGE_S
from cangauge.model.effects.base import (
    CoreForm,
    Effect,
    OnlineEffect,
    Pack,
    PackState,
    Parameter,
    Values,
)
from cangauge.model.effects.first_order import LowPass
from cangauge.model.effects.resistance import arrhenius, arrhenius_at
from cangauge.model.voltage_model import VoltageModel

ACTIVATION = Parameter("activation_k", "K", 0.0, 6000.0, neutral=None, grid=(0.0, 3000.0))
"""Arrhenius activation of an RC element's resistance, which is stated at 25 °C."""


def _rc_voltage(
    state: PackState, ohm: float, tau_s: float, activation_k: float = 0.0
) -> FloatArray:
    """Return −R(T)·(lagged current) [V], shape (n,), at rest before the first sample."""
    lagged = state.history.lagged_a(tau_s)
    if activation_k:
        lagged = lagged * arrhenius(state.temperature_c, activation_k)
    return -ohm * lagged


class _OnlineRc(OnlineEffect):
    """RC elements in series, (resistance [Ω], time constant [s]) each, one sample at a time."""

    def __init__(self, elements: Sequence[tuple[float, float]], activation_k: float) -> None:
        self._ohm = [ohm for ohm, _ in elements]
        self.memory = elements
        self._activation_k = activation_k
        self.lags = [LowPass(tau_s, 0.0, rest_s=BRIDGE_S) for _, tau_s in elements]

    def core_form(self) -> CoreForm:
        values = (self._activation_k, 0.0, 1.0, *self._ohm)
        return CoreForm("rc", values, tuple(tau_s for _, tau_s in self.memory))

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        for lag in self.lags:
            lag.step(time_s, current_a)
        self._set_volts(
            arrhenius_at(temperature_c, self._activation_k) if self._activation_k else 1.0
        )

    def restore(self, state: Sequence[float], latest_s: float) -> None:
        if len(state) not in {0, LowPass.STATE_SIZE * len(self.lags)}:
            raise ValueError("not the state of this number of RC elements")
        super().restore(state, latest_s)
        self._set_volts(1.0)  # the temperature comes with the next sample

    def _set_volts(self, colder: float) -> None:
        self.volts = total(
            -ohm * colder * lag.value for ohm, lag in zip(self._ohm, self.lags, strict=True)
        )


class FastPolarization(Effect):
    """Double layer and charge transfer, faster than the model's first delay."""

    id = "fast_polarization"
    family = "dynamics"
    is_pointwise: ClassVar[bool] = True
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
        return _rc_voltage(state, values["ohm"], values["tau_s"], values["activation_k"])

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        return _OnlineRc([(values["ohm"], values["tau_s"])], values["activation_k"])


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


class SlowDiffusion(Effect):
    """Diffusion in the particles and the electrolyte, slower than the model's last delay.

    In the particles charge diffuses, and its voltage follows the slope of the open-circuit voltage
    (`by_slope` 1); diffusion in the electrolyte is the same at every SoC (0).
    """

    id = "slow_diffusion"
    family = "dynamics"
    is_pointwise: ClassVar[bool] = True
    is_structure: ClassVar[bool] = True
    parameters = (
        Parameter("ohm", "ohm", 0.0, 1.5, scale="resistance"),
        Parameter(
            "tau_s", "s", 70.0, 2500.0, neutral=None,
            grid=(80.0, 130.0, 220.0, 400.0, 750.0, 1400.0, 2400.0),
        ),
        Parameter(
            "spread", "1", 0.0, 1.0, neutral=None, grid=(0.0,), diagnosis_values=(1.0,)
        ),
        ACTIVATION,
        Parameter(
            "by_slope", "1", 0.0, 1.0, neutral=None, grid=(0.0,), diagnosis_values=(1.0,)
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

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        total = np.zeros_like(state.current_a)
        for ohm, tau_s in _elements(values):
            total += _rc_voltage(state, ohm, tau_s, values["activation_k"])
        if values["by_slope"]:
            steepness = state.ocv_slope(model) / _mean_slope(model)
            total *= 1.0 + values["by_slope"] * (np.clip(steepness, 0.0, STEEPNESS_AT_MOST) - 1.0)
        return total

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        if values["by_slope"]:
            return _OnlineRcBySlope(values, model)
        return _OnlineRc(_elements(values), values["activation_k"])


def _elements(values: Values) -> list[tuple[float, float]]:
    """Return resistance [Ω] and time constant [s] of each element, the slowest first."""
    weights = [(values["spread"] / RESISTANCE_RATIO) ** k for k in range(ELEMENTS)]
    return [
        (values["ohm"] * weight / total(weights), values["tau_s"] / TAU_RATIO**k)
        for k, weight in enumerate(weights)
        if weight > 0.0
    ]


def _mean_slope(model: VoltageModel) -> float:
    """Return the mean slope of the pseudo-OCV [V per % SoC], positive."""
    low, high = MEAN_SLOPE_PCT
    rise_v = model.pseudo_ocv_at(high)[0] - model.pseudo_ocv_at(low)[0]
    return max(rise_v / (high - low), MEAN_SLOPE_AT_LEAST)


class _OnlineRcBySlope(_OnlineRc):
    """RC elements whose voltage follows the slope of the pseudo-OCV."""

    uses_soc = True

    def __init__(self, values: Values, model: VoltageModel) -> None:
        super().__init__(_elements(values), values["activation_k"])
        self._by_slope = values["by_slope"]
        self._model = model
        self._mean_slope = _mean_slope(model)

    def core_form(self) -> CoreForm:
        (activation_k, _, _, *ohm), tau_s = super().core_form()[1:]
        return CoreForm("rc", (activation_k, self._by_slope, self._mean_slope, *ohm), tau_s)

    def extra_voltage(self, soc_pct: float) -> float:
        steepness = self._model.pseudo_ocv_at(soc_pct)[1] / self._mean_slope
        share = 1.0 + self._by_slope * (min(max(steepness, 0.0), STEEPNESS_AT_MOST) - 1.0)
        return share * self.volts


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
    is_pointwise: ClassVar[bool] = True
    is_structure: ClassVar[bool] = True
    parameters = (
        Parameter("scale_v", "V", 0.0, 0.03, scale="voltage"),
        Parameter(
            "exchange_a", "A", 0.01, 2.0, neutral=None, scale="capacity",
            grid=(0.02, 0.05, 0.12, 0.3, 0.8),
        ),
        Parameter("bend_only", "1", 0.0, 1.0, neutral=None, grid=(0.0, 1.0)),
        Parameter(
            "activation_k", "K", 0.0, 10000.0, neutral=None, grid=(ACTIVATION_K,),
            diagnosis_values=(0.0,),
        ),
    )  # fmt: skip
    signature = "I − c·asinh(I/2I₀): too much drop at small currents, too little at large ones"
    equation = "ΔU = −v·(asinh(I/2I₀) − b·(I/I₁)·asinh(I₁/2I₀)), I₁ = 1 C, I₀ after Arrhenius (B)"
    source = "Newman, Thomas-Alyea, Electrochemical Systems, 3rd ed., Wiley 2004, ch. 8"
    separated_by = (
        "pulses of several sizes in both directions; resistance_asymmetry is straight on each"
        " side of zero"
    )

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        per_a = 0.5 / values["exchange_a"] * arrhenius(state.temperature_c, values["activation_k"])
        zero_a = BEND_ZERO_C_RATE * pack.capacity_ah
        slope = values["bend_only"] * np.arcsinh(zero_a * per_a) / zero_a
        bend = np.arcsinh(state.current_a * per_a) - slope * state.current_a
        return np.asarray(-values["scale_v"] * bend)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        zero_a = BEND_ZERO_C_RATE * pack.capacity_ah
        return _ChargeTransferOnline(values, zero_a)


class _ChargeTransferOnline(OnlineEffect):
    def __init__(self, values: Values, zero_a: float) -> None:
        self._scale_v = values["scale_v"]
        self._per_a = 0.5 / values["exchange_a"]
        self._bend_only = values["bend_only"]
        self._activation_k = values["activation_k"]
        self._zero_a = zero_a

    def core_form(self) -> CoreForm:
        values = (
            self._scale_v, self._per_a, self._bend_only, self._activation_k, self._zero_a,
        )  # fmt: skip
        return CoreForm("charge_transfer", values)

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        per_a = self._per_a * arrhenius_at(temperature_c, self._activation_k)
        slope = self._bend_only * math.asinh(self._zero_a * per_a) / self._zero_a
        bend = math.asinh(current_a * per_a) - slope * current_a
        self.volts = -self._scale_v * bend

"""A resistor beside a capacitor: the voltage of low-passed current, shared by two effects.

Polarisation within seconds: an RC element below 10 s.

Polarisation over many minutes: RC elements beyond the delay line's 70 s.

Charge-transfer overpotential after Butler and Volmer: it flattens with current.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.model.charge import BRIDGE_S
from cangauge.model.effects.base import Effect, OnlineEffect, Pack, PackState, Parameter, Values
from cangauge.model.effects.first_order import LowPass
from cangauge.model.effects.resistance import arrhenius, arrhenius_at
from cangauge.model.voltage_model import VoltageModel

# --- A resistor beside a capacitor: the voltage of low-passed current, shared by two effects

ACTIVATION = Parameter("activation_k", "K", 0.0, 6000.0, neutral=None, grid=(0.0, 3000.0))
"""How the element's resistance rises in the cold; it is the stated one at 25 °C."""


def rc_voltage(state: PackState, ohm: float, tau_s: float, activation_k: float = 0.0) -> FloatArray:
    """Return −R(T)·(lagged current) [V], shape (n,), at rest before the first sample."""
    lagged = state.history.lagged_a(tau_s)
    if activation_k:
        lagged = lagged * arrhenius(state.temperature_c, activation_k)
    return -ohm * lagged


class OnlineRc(OnlineEffect):
    """The same, one sample at a time.

    Parameters
    ----------
    ohm : float
        Resistance [Ω], positive.
    tau_s : float
        Time constant [s].
    activation_k : float
        Of the resistance [K].
    """

    def __init__(self, ohm: float, tau_s: float, activation_k: float = 0.0) -> None:
        self._ohm = ohm
        self._activation_k = activation_k
        self._colder = 1.0
        self._lagged = LowPass(tau_s, 0.0, rest_s=BRIDGE_S)

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        """Carry the capacitor to this sample."""
        del drop_v
        if self._activation_k:
            self._colder = arrhenius_at(temperature_c, self._activation_k)
        self._lagged.step(time_s, current_a)

    def extra_voltage(self, soc_pct: float) -> float:
        """Return the element's voltage [V]."""
        del soc_pct
        return -self._ohm * self._colder * self._lagged.value

    def memory(self) -> list[float]:
        """Return the last sample's time, current and lagged current."""
        return self._lagged.memory()

    def remember(self, memory: Sequence[float], latest_s: float) -> None:
        """Go on from a memory; may raise ValueError."""
        self._lagged.remember(memory, latest_s)


# --- Polarisation within seconds: an RC element below 10 s


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


# --- Polarisation over many minutes: RC elements beyond the delay line's 70 s

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


# --- Charge-transfer overpotential after Butler and Volmer: it flattens with current

ALIKE_AT_C_RATE = 1.0
"""At this current [1/h] the bend alone adds nothing, as at none: where logs of the same pack gave
the model's resistance, it already holds the mean slope over the currents of a drive."""


ACTIVATION_K = 5000.0
"""Usual of the exchange current [K], about 42 kJ/mol; `exchange_a` is that at 25 °C."""


class ChargeTransfer(Effect):
    """An overpotential v·asinh(I/2I₀), or its bend against a straight line.

    That line (`bend_only`) meets it at 0 and ±1 C.

    `scale_v` is 2RT/F a cell and electrode (51 mV at 25 °C) times the cells in series, so the
    bound is that of two electrodes.
    """

    id = "charge_transfer"
    family = "dynamics"
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
            elsewhere=(0.0,), formerly=ACTIVATION_K,
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
        """Return the bend [V]."""
        del model
        per_a = 0.5 / values["exchange_a"] * arrhenius(state.temperature_c, values["activation_k"])
        alike_a = ALIKE_AT_C_RATE * pack.capacity_ah
        slope = values["bend_only"] * np.arcsinh(alike_a * per_a) / alike_a
        bend = np.arcsinh(state.current_a * per_a) - slope * state.current_a
        return np.asarray(-values["scale_v"] * bend)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the bend at one sample at a time."""
        del model
        alike_a = ALIKE_AT_C_RATE * pack.capacity_ah
        return _ChargeTransferOnline(values, alike_a)


class _ChargeTransferOnline(OnlineEffect):
    def __init__(self, values: Values, alike_a: float) -> None:
        self._scale_v = values["scale_v"]
        self._per_a = 0.5 / values["exchange_a"]
        self._bend_only = values["bend_only"]
        self._activation_k = values["activation_k"]
        self._alike_a = alike_a
        self._volts = 0.0

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        del time_s, drop_v
        per_a = self._per_a * arrhenius_at(temperature_c, self._activation_k)
        slope = self._bend_only * math.asinh(self._alike_a * per_a) / self._alike_a
        bend = math.asinh(current_a * per_a) - slope * current_a
        self._volts = -self._scale_v * bend

    def extra_voltage(self, soc_pct: float) -> float:
        del soc_pct
        return self._volts

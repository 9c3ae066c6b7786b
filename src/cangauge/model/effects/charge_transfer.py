"""Charge-transfer overpotential after Butler and Volmer: it flattens with current."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from cangauge.model.effects.arrhenius import arrhenius, arrhenius_at
from cangauge.model.effects.effect import Effect, FloatArray, OnlineEffect, Values
from cangauge.model.effects.pack_state import PackState
from cangauge.model.effects.parameter import Pack, Parameter
from cangauge.model.voltage_model import VoltageModel

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
        return _Online(values, alike_a)


class _Online(OnlineEffect):
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

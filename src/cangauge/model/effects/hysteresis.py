"""Open-circuit voltage that remembers whether the pack was charged or discharged."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from cangauge.model.charge import BRIDGE_S
from cangauge.model.effects.effect import Effect, FloatArray, OnlineEffect, Values
from cangauge.model.effects.first_order import decaying_sum
from cangauge.model.effects.pack_state import PackState
from cangauge.model.effects.parameter import Pack, Parameter
from cangauge.model.voltage_model import VoltageModel


class Hysteresis(Effect):
    """One-state hysteresis: the state follows −sign(I) over a few per cent of charge.

    It begins in the middle (0), since what went before a log is not known, and stays through a
    rest, however long.
    """

    id = "hysteresis"
    family = "equilibrium"
    is_structure: ClassVar[bool] = True
    parameters = (
        Parameter("half_width_v", "V", 0.0, 0.01, scale="voltage"),
        Parameter("travel_pct", "%", 0.5, 12.0, neutral=None, grid=(1.0, 2.0, 4.0, 7.0, 11.0)),
    )
    signature = "memory of sign(I) over Ah: it turns with lasting charge or discharge, and stays"
    equation = "ΔU = M·h, dh/dt = |I|/(γ·C)·(−sign(I) − h)"
    source = "one-state model, Plett, J. Power Sources 134 (2004) 262"
    separated_by = (
        "rests of an hour after a discharge and after a charge to the same SoC:"
        " slow_diffusion decays, this stays"
    )

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        """Return M·h [V]."""
        del model
        seconds = np.diff(state.time_s)
        mean = 0.5 * (state.current_a[1:] + state.current_a[:-1])
        travel_as = 36.0 * pack.capacity_ah * values["travel_pct"]
        decay = np.where(seconds > BRIDGE_S, 0.0, np.abs(mean) * seconds / travel_as)
        return values["half_width_v"] * decaying_sum(decay, np.sign(mean) * np.expm1(-decay), 0.0)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return M·h at one sample at a time."""
        del model
        return _Online(values["half_width_v"], 36.0 * pack.capacity_ah * values["travel_pct"])


class _Online(OnlineEffect):
    def __init__(self, half_width_v: float, travel_as: float) -> None:
        self._half_width_v = half_width_v
        self._travel_as = travel_as
        self._last: tuple[float, float] | None = None
        self._state = 0.0

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        del temperature_c, drop_v
        if self._last is not None and time_s - self._last[0] <= BRIDGE_S:
            mean = 0.5 * (current_a + self._last[1])
            decay = abs(mean) * (time_s - self._last[0]) / self._travel_as
            toward = math.copysign(1.0, mean)
            self._state = math.exp(-decay) * self._state + toward * math.expm1(-decay)
        self._last = (time_s, current_a)

    def extra_voltage(self, soc_pct: float) -> float:
        del soc_pct
        return self._half_width_v * self._state

    def memory(self) -> list[float]:
        return [] if self._last is None else [*self._last, self._state]

    def remember(self, memory: Sequence[float], latest_s: float) -> None:
        self._last = None
        if memory:
            time_s, current_a, self._state = memory
            self._last = (time_s, current_a)
            if not (all(map(math.isfinite, memory)) and abs(self._state) <= 1.0):
                raise ValueError("the state lies within ±1")
            if not time_s <= latest_s:
                raise ValueError("later than the latest sample")

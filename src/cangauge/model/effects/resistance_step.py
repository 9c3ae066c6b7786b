"""Resistance that changes at a moment: a contact works loose, or is mended."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cangauge.model.effects.effect import Effect, FloatArray, OnlineEffect, Values
from cangauge.model.effects.pack_state import PackState
from cangauge.model.effects.parameter import Pack, Parameter
from cangauge.model.voltage_model import VoltageModel


class ResistanceStep(Effect):
    """Additional resistance from a moment on, counted from the log's first sample.

    Online the time counts from the service's first sample. A step that has happened stays, so a
    model meant for later drives has `start_s` = 0.
    """

    id = "resistance_step"
    family = "resistance"
    parameters = (
        Parameter("step_ohm", "ohm", -0.4, 2.0, scale="resistance"),
        Parameter(
            "start_s", "s", 0.0, 1e7, neutral=None, is_moment=True,
            grid=(0.0, 300.0, 600.0, 1200.0, 1800.0, 2700.0, 3600.0, 5400.0, 7200.0),
        ),
    )  # fmt: skip
    signature = "I·1(t > t₀): the drop over the resistance changes at a moment and stays"
    equation = "ΔU = −r·I for t − t_first ≥ t₀, else 0"
    source = "definition"
    separated_by = (
        "the same load before and after at the same SoC and temperature:"
        " resistance_temperature and resistance_soc come back, a step does not"
    )

    def trials(self, parameter: Parameter, pack: Pack, time_s: FloatArray) -> tuple[float, ...]:
        """Return moments spread evenly over the log, its ends apart [s]."""
        if parameter.name != "start_s":
            return parameter.trials(pack)
        duration = float(time_s[-1] - time_s[0])
        return tuple(duration * part / 20.0 for part in range(1, 20))

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        """Return the additional drop [V]."""
        del model, pack
        after = state.time_s - state.time_s[0] >= values["start_s"]
        return np.where(after, -values["step_ohm"] * state.current_a, 0.0)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the additional drop at one sample at a time."""
        del model, pack
        return _Online(values["step_ohm"], values["start_s"])


class _Online(OnlineEffect):
    def __init__(self, step_ohm: float, start_s: float) -> None:
        self._step_ohm = step_ohm
        self._start_s = start_s
        self._first_s: float | None = None
        self._volts = 0.0

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        del temperature_c, drop_v
        if self._first_s is None:
            self._first_s = time_s
        after = time_s - self._first_s >= self._start_s
        self._volts = -self._step_ohm * current_a if after else 0.0

    def extra_voltage(self, soc_pct: float) -> float:
        del soc_pct
        return self._volts

    def memory(self) -> list[float]:
        return [] if self._first_s is None else [self._first_s]

    def remember(self, memory: Sequence[float], latest_s: float) -> None:
        self._first_s = None
        if memory:
            (self._first_s,) = memory
            if not self._first_s <= latest_s:
                raise ValueError("later than the latest sample")

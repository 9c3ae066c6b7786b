"""Resistance that rises toward empty, and perhaps toward full."""

from __future__ import annotations

import math

import numpy as np

from cangauge.model.effects.effect import (
    DELAYED,
    Effect,
    FloatArray,
    OnlineEffect,
    Pack,
    PackState,
    Parameter,
    Values,
)
from cangauge.model.voltage_model import VoltageModel


class ResistanceSoc(Effect):
    """Relative change of the whole drop that falls off from empty and from full."""

    id = "resistance_soc"
    family = "resistance"
    parameters = (
        Parameter("at_empty", "1", -0.4, 3.0),
        Parameter("at_full", "1", -0.4, 1.5),
        Parameter("width_pct", "%", 3.0, 60.0, neutral=None, grid=(5.0, 10.0, 20.0, 40.0)),
        DELAYED,
    )
    signature = "I·f(S): the drop over the resistance, larger near empty"
    equation = "ΔU = ΣRj·I(t − dj)·(a·exp(−S/w) + b·exp(−(100 − S)/w)); or ΣRj·I in its place"
    source = "Waag, Käbitz, Sauer, Applied Energy 102 (2013) 885"
    separated_by = (
        "the same SoC at two temperatures: in one discharge SoC and temperature move together"
        " and it cannot be told from resistance_temperature"
    )

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        """Return the change of the drop [V]."""
        del model
        soc, width = np.clip(state.soc_pct, 0.0, 100.0), values["width_pct"]
        rise = values["at_empty"] * np.exp(-soc / width)
        rise += values["at_full"] * np.exp((soc - 100.0) / width)
        return np.asarray(state.scaled_drop_v(values["delayed"], pack) * rise)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the change of the drop at one sample at a time."""
        del model
        now_ohm = None if values["delayed"] else pack.resistance_ohm
        return _Online(values["at_empty"], values["at_full"], values["width_pct"], now_ohm)


class _Online(OnlineEffect):
    uses_soc = True

    def __init__(
        self, at_empty: float, at_full: float, width_pct: float, now_ohm: float | None
    ) -> None:
        self._at_empty = at_empty
        self._at_full = at_full
        self._width_pct = width_pct
        self._now_ohm = now_ohm
        self._drop_v = 0.0

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        del time_s, temperature_c
        self._drop_v = drop_v if self._now_ohm is None else -self._now_ohm * current_a

    def extra_voltage(self, soc_pct: float) -> float:
        soc = min(max(soc_pct, 0.0), 100.0)
        rise = self._at_empty * math.exp(-soc / self._width_pct)
        rise += self._at_full * math.exp((soc - 100.0) / self._width_pct)
        return self._drop_v * rise

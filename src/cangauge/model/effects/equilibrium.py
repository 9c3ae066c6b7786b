"""Changes of the open-circuit voltage: hysteresis, entropy, shape, and weak cells in series."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, Final

import numpy as np

from cangauge._arithmetic import total
from cangauge._typing import FloatArray
from cangauge.model.coulomb_counting import BRIDGE_S
from cangauge.model.effects.base import (
    LAG,
    WITHIN_C,
    CoreForm,
    Effect,
    OnlineEffect,
    OnlineInteriorEffect,
    Pack,
    PackState,
    Parameter,
    Values,
)
from cangauge.model.voltage_model import VoltageModel


class Hysteresis(Effect):
    """One-state hysteresis: the state follows −sign(I) over a few per cent of charge.

    It starts at 0, since the charge before a log is unknown, and persists through any rest.
    """

    id = "hysteresis"
    family = "equilibrium"
    is_pointwise: ClassVar[bool] = True
    is_structure: ClassVar[bool] = True
    parameters = (
        Parameter("half_width_v", "V", 0.0, 0.01, scale="voltage"),
        Parameter("travel_pct", "%", 0.5, 12.0, neutral=None, grid=(1.0, 2.0, 4.0, 7.0, 11.0)),
    )
    signature = (
        "memory of sign(I) over Ah: reverses with lasting charge or discharge, persists at rest"
    )
    equation = "ΔU = M·h, dh/dt = |I|/(γ·C)·(−sign(I) − h)"
    source = "one-state model, Plett, J. Power Sources 134 (2004) 262"
    separated_by = (
        "rests of an hour after a discharge and after a charge to the same SoC:"
        " slow_diffusion decays, this persists"
    )

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        travel_as = 36.0 * pack.capacity_ah * values["travel_pct"]
        return values["half_width_v"] * state.history.turned(travel_as)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        return _HysteresisOnline(
            values["half_width_v"], 36.0 * pack.capacity_ah * values["travel_pct"]
        )


class _HysteresisOnline(OnlineEffect):
    def __init__(self, half_width_v: float, travel_as: float) -> None:
        self._half_width_v = half_width_v
        self._travel_as = travel_as
        self._last: tuple[float, float] | None = None
        self._state = 0.0

    def core_form(self) -> CoreForm:
        return CoreForm("hysteresis", (self._half_width_v, self._travel_as))

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        if self._last is not None and time_s - self._last[0] <= BRIDGE_S:
            mean = 0.5 * (current_a + self._last[1])
            decay = abs(mean) * (time_s - self._last[0]) / self._travel_as
            toward = math.copysign(1.0, mean)
            self._state = math.exp(-decay) * self._state + toward * math.expm1(-decay)
        self._last = (time_s, current_a)

    def extra_voltage(self, soc_pct: float) -> float:
        return self._half_width_v * self._state

    def state(self) -> list[float]:
        return [] if self._last is None else [*self._last, self._state]

    def restore(self, state: Sequence[float], latest_s: float) -> None:
        self._last = None
        if state:
            time_s, current_a, self._state = state
            self._last = (time_s, current_a)
            if not (all(map(math.isfinite, state)) and abs(self._state) <= 1.0):
                raise ValueError("the state lies within ±1")
            if not time_s <= latest_s:
                raise ValueError("later than the latest sample")


class EntropicCoefficient(Effect):
    """Level, slope and curvature of dU/dT over SoC, in addition to the model's kt.

    The bounds are ±0.4 mV/K per cell. The temperature is that of the cell interior, `lag_s` behind
    the measured one.
    """

    id = "entropic_coefficient"
    family = "equilibrium"
    is_pointwise: ClassVar[bool] = True
    is_structure: ClassVar[bool] = True
    parameters = (
        Parameter("level_v_per_k", "V/K", -1.1e-4, 1.1e-4, scale="voltage"),
        Parameter("slope_v_per_k", "V/K", -1.1e-4, 1.1e-4, scale="voltage"),
        Parameter("curve_v_per_k", "V/K", -1.1e-4, 1.1e-4, scale="voltage"),
        LAG,
    )
    signature = "(T − T_r)·f(S), at any current"
    equation = (
        "ΔU = (T − T_r)·(c + a·x + b·(3x² − 1)/2), x = S/50 − 1; τ·dT/dt = T_measured − T,"
        " τ = lag_s"
    )
    source = "Reynier, Yazami, Fultz, J. Power Sources 119–121 (2003) 850"
    separated_by = (
        "the same SoC, rested, at two temperatures; at one temperature it is not separable from"
        " any other change of the OCV with SoC"
    )

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        warmer = np.clip(state.lagged_temperature_c(values["lag_s"]), *WITHIN_C) - model.t_ref_c
        x = np.clip(state.soc_pct, 0.0, 100.0) / 50.0 - 1.0
        shape = values["level_v_per_k"] + values["slope_v_per_k"] * x
        shape += values["curve_v_per_k"] * (1.5 * x * x - 0.5)
        return np.asarray(warmer * shape)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        return _EntropicCoefficientOnline(values, model.t_ref_c)


class _EntropicCoefficientOnline(OnlineInteriorEffect):
    uses_soc = True

    def __init__(self, values: Values, t_ref_c: float) -> None:
        super().__init__(values["lag_s"])
        self._level = values["level_v_per_k"]
        self._slope = values["slope_v_per_k"]
        self._curve = values["curve_v_per_k"]
        self._t_ref_c = t_ref_c
        self._warmer = 0.0

    def core_form(self) -> CoreForm:
        values = (self._level, self._slope, self._curve, self._t_ref_c)
        return CoreForm("entropic", values, (self.interior.tau_s,))

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        low, high = WITHIN_C
        interior_c = self.interior.step(time_s, temperature_c)
        self._warmer = min(max(interior_c, low), high) - self._t_ref_c

    def extra_voltage(self, soc_pct: float) -> float:
        x = min(max(soc_pct, 0.0), 100.0) / 50.0 - 1.0
        return self._warmer * (self._level + self._slope * x + self._curve * (1.5 * x * x - 0.5))


CENTRES_PCT: Final = (3.0, 8.0, 14.0, 22.0, 32.0, 43.0, 54.0, 65.0, 76.0, 86.0, 94.0)
WIDTHS_PCT: Final = (3.0, 3.5, 4.5, 5.5, 6.5, 7.0, 7.0, 7.0, 6.5, 5.5, 4.5)
"""Centre and width of each bump [% SoC], narrower where the OCV of common chemistries bends."""


class OcvShape(Effect):
    """Smooth bumps over SoC: an open-circuit voltage that the published formula cannot represent.

    It is structure of a chemistry, not a fault: the diagnosis learns it from reference logs and
    never names it.
    """

    id = "ocv_shape"
    family = "equilibrium"
    is_pointwise: ClassVar[bool] = True
    is_structure: ClassVar[bool] = True
    is_cause: ClassVar[bool] = False
    parameters = tuple(
        Parameter(f"at_{centre:.0f}_pct_v", "V", -0.01, 0.01, scale="voltage")
        for centre in CENTRES_PCT
    )
    signature = "a curve over SoC, the same at any current, temperature and time"
    equation = "ΔU = Σ vₖ·exp(−½((S − cₖ)/wₖ)²)"
    source = "radial basis functions, Broomhead, Lowe, Complex Systems 2 (1988) 321"
    separated_by = "other logs over the same SoC: what all of them share belongs to the chemistry"

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        soc = np.clip(state.soc_pct, 0.0, 100.0)
        volts = np.zeros_like(soc)
        for parameter, centre, width in zip(self.parameters, CENTRES_PCT, WIDTHS_PCT, strict=True):
            height = values[parameter.name]
            if height:
                volts += height * np.exp(-0.5 * ((soc - centre) / width) ** 2)
        return volts

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        return _OcvShapeOnline([values[parameter.name] for parameter in self.parameters])


class _OcvShapeOnline(OnlineEffect):
    uses_soc = True

    def __init__(self, heights_v: list[float]) -> None:
        self._bumps = tuple(zip(heights_v, CENTRES_PCT, WIDTHS_PCT, strict=True))

    def core_form(self) -> CoreForm:
        return CoreForm("ocv_shape", tuple(height for height, _, _ in self._bumps))

    def extra_voltage(self, soc_pct: float) -> float:
        soc = min(max(soc_pct, 0.0), 100.0)
        return total(
            height * math.exp(-0.5 * away * away)
            for height, centre, width in self._bumps
            for away in ((soc - centre) / width,)
        )


class WeakCell(Effect):
    """A fraction of the cells with a capacity deficit: from full, their SoC falls faster.

    Below empty the weak cells follow the model's linear extrapolation. A reversed cell falls
    faster, but a pack is switched off before that.
    """

    id = "weak_cell"
    family = "imbalance"
    is_pointwise: ClassVar[bool] = True
    parameters = (
        Parameter("fraction", "1", 0.0, 0.15),
        Parameter(
            "deficit_pct",
            "%",
            2.0,
            65.0,
            neutral=None,
            grid=(4.0, 7.0, 11.0, 16.0, 23.0, 33.0, 48.0),
        ),
    )
    signature = "the knee near empty comes early, by the fraction of weak cells"
    equation = "ΔU = (n/N)·(OCV(S_w) − OCV(S)), 1 − S_w = (1 − S)/(1 − d)"
    source = "Dubarry, Vuillaume, Liaw, Int. J. Energy Res. 34 (2010) 216"
    separated_by = (
        "a discharge to below 10 %: a lost capacity of all cells brings the whole knee forward,"
        " weak cells a small one; or the cells' own voltages"
    )

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        ahead = 1.0 / (1.0 - values["deficit_pct"] / 100.0)
        weak = 100.0 - (100.0 - state.soc_pct) * ahead
        lack = model.pseudo_ocv(weak) - model.pseudo_ocv(state.soc_pct)
        return np.asarray(values["fraction"] * lack)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        return _WeakCellOnline(values["fraction"], values["deficit_pct"], model)


class _WeakCellOnline(OnlineEffect):
    uses_soc = True

    def __init__(self, fraction: float, deficit_pct: float, model: VoltageModel) -> None:
        self._fraction = fraction
        self._ahead = 1.0 / (1.0 - deficit_pct / 100.0)
        self._model = model

    def core_form(self) -> CoreForm:
        return CoreForm("weak_cell", (self._fraction, self._ahead))

    def extra_voltage(self, soc_pct: float) -> float:
        weak = 100.0 - (100.0 - soc_pct) * self._ahead
        lack = self._model.pseudo_ocv_at(weak)[0] - self._model.pseudo_ocv_at(soc_pct)[0]
        return self._fraction * lack

"""Changes of the open-circuit voltage: hysteresis, entropy, shape, and weak cells in series."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.logs.gaps import BRIDGE_S
from cangauge.model.effects.base import (
    LAG,
    WITHIN_C,
    CoreForm,
    Effect,
    Load,
    Memories,
    Pack,
    Parameter,
    Values,
)
from cangauge.model.first_order import Lag, Memory, decaying_sum
from cangauge.model.voltage_model import VoltageModel


class Hysteresis(Effect):
    """One-state hysteresis: the state follows −sign(I) over a few per cent of charge.

    It starts at 0, since the charge before a log is unknown, and persists through any rest.
    """

    id = "hysteresis"
    family = "equilibrium"
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

    def memory(self, values: Values, pack: Pack) -> Memories:
        return (_Turned(36.0 * pack.capacity_ah * values["travel_pct"]),)

    def drive(
        self, load: Load, values: Values, model: VoltageModel, pack: Pack, memory: Memories
    ) -> FloatArray:
        return np.asarray(values["half_width_v"] * memory[0].step(load.time_s, load.current_a))

    def core_form(self, values: Values, model: VoltageModel, pack: Pack) -> CoreForm:
        travel_as = 36.0 * pack.capacity_ah * values["travel_pct"]
        return CoreForm("hysteresis", (values["half_width_v"], travel_as))


class _Turned(Memory):
    """Memory of the current's sign over a charge [As]; 0 at the start, unchanged over gaps."""

    def __init__(self, travel_as: float) -> None:
        self._travel_as = travel_as
        self._last: tuple[float, float, float] | None = None

    def step(self, time_s: FloatArray, current_a: FloatArray) -> FloatArray:
        """Advance to samples of shape (n,) and return h there."""
        times, currents, first, skip = time_s, current_a, 0.0, 0
        if self._last is not None:
            latest_s, latest_a, first = self._last
            times, currents, skip = np.r_[latest_s, time_s], np.r_[latest_a, current_a], 1
        seconds = np.diff(times)
        mean = 0.5 * (currents[1:] + currents[:-1])
        decay = np.where(seconds > BRIDGE_S, 0.0, np.abs(mean) * seconds / self._travel_as)
        turned = decaying_sum(decay, np.sign(mean) * np.expm1(-decay), first)[skip:]
        self._last = (float(times[-1]), float(currents[-1]), float(turned[-1]))
        return turned

    def state(self) -> list[float]:
        return [] if self._last is None else [*self._last]

    def restore(self, state: Sequence[float]) -> None:
        self._last = None
        if state:
            time_s, current_a, turned = state
            if not (all(map(math.isfinite, state)) and abs(turned) <= 1.0):
                raise ValueError("the state lies within ±1")
            self._last = (time_s, current_a, turned)


class EntropicCoefficient(Effect):
    """Level, slope and curvature of dU/dT over SoC, in addition to the model's kt.

    The bounds are ±0.4 mV/K per cell. The temperature is that of the cell interior, `lag_s` behind
    the measured one.
    """

    id = "entropic_coefficient"
    family = "equilibrium"
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

    def memory(self, values: Values, pack: Pack) -> Memories:
        return (Lag(values["lag_s"]),)

    def drive(
        self, load: Load, values: Values, model: VoltageModel, pack: Pack, memory: Memories
    ) -> FloatArray:
        interior_c = memory[0].step(load.time_s, load.temperature_c)
        return np.asarray(np.clip(interior_c, *WITHIN_C) - model.t_ref_c)

    def over_soc(
        self, soc_pct: FloatArray, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        x = np.clip(soc_pct, 0.0, 100.0) / 50.0 - 1.0
        shape = values["level_v_per_k"] + values["slope_v_per_k"] * x
        return np.asarray(shape + values["curve_v_per_k"] * (1.5 * x * x - 0.5))

    def core_form(self, values: Values, model: VoltageModel, pack: Pack) -> CoreForm:
        names = ("level_v_per_k", "slope_v_per_k", "curve_v_per_k")
        constants = (*(values[name] for name in names), model.t_ref_c)
        return CoreForm("entropic", constants, (values["lag_s"],))


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
    is_cause: ClassVar[bool] = False
    parameters = tuple(
        Parameter(f"at_{centre:.0f}_pct_v", "V", -0.01, 0.01, scale="voltage")
        for centre in CENTRES_PCT
    )
    signature = "a curve over SoC, the same at any current, temperature and time"
    equation = "ΔU = Σ vₖ·exp(−½((S − cₖ)/wₖ)²)"
    source = "radial basis functions, Broomhead, Lowe, Complex Systems 2 (1988) 321"
    separated_by = "other logs over the same SoC: what all of them share belongs to the chemistry"

    def drive(
        self, load: Load, values: Values, model: VoltageModel, pack: Pack, memory: Memories
    ) -> FloatArray:
        return np.ones_like(load.current_a)

    def over_soc(
        self, soc_pct: FloatArray, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        away = (np.clip(soc_pct, 0.0, 100.0)[:, None] - CENTRES_PCT) / WIDTHS_PCT
        heights = np.array([values[parameter.name] for parameter in self.parameters])
        return np.asarray(np.exp(-0.5 * away * away) @ heights)

    def core_form(self, values: Values, model: VoltageModel, pack: Pack) -> CoreForm:
        return CoreForm("ocv_shape", tuple(values[item.name] for item in self.parameters))


class WeakCell(Effect):
    """A fraction of the cells with a capacity deficit: from full, their SoC falls faster.

    Below empty the weak cells follow the model's linear extrapolation. A reversed cell falls
    faster, but a pack is switched off before that.
    """

    id = "weak_cell"
    family = "imbalance"
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

    def drive(
        self, load: Load, values: Values, model: VoltageModel, pack: Pack, memory: Memories
    ) -> FloatArray:
        return np.full_like(load.current_a, values["fraction"])

    def over_soc(
        self, soc_pct: FloatArray, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        ahead = 1.0 / (1.0 - values["deficit_pct"] / 100.0)
        weak = 100.0 - (100.0 - soc_pct) * ahead
        return model.pseudo_ocv(weak) - model.pseudo_ocv(soc_pct)

    def core_form(self, values: Values, model: VoltageModel, pack: Pack) -> CoreForm:
        ahead = 1.0 / (1.0 - values["deficit_pct"] / 100.0)
        return CoreForm("weak_cell", (values["fraction"], ahead))

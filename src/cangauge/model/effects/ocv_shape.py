"""Open-circuit voltage of another shape than the published formula can take."""

from __future__ import annotations

import math
from typing import ClassVar, Final

import numpy as np

from cangauge.model.effects.effect import Effect, FloatArray, OnlineEffect, Values
from cangauge.model.effects.pack_state import PackState
from cangauge.model.effects.parameter import Pack, Parameter
from cangauge.model.voltage_model import VoltageModel

CENTRES_PCT: Final = (3.0, 8.0, 14.0, 22.0, 32.0, 43.0, 54.0, 65.0, 76.0, 86.0, 94.0)
WIDTHS_PCT: Final = (3.0, 3.5, 4.5, 5.5, 6.5, 7.0, 7.0, 7.0, 6.5, 5.5, 4.5)
"""Middle and width of each bump [% SoC], narrower where chemistries bend more."""


class OcvShape(Effect):
    """Smooth bumps over SoC.

    It is structure of a chemistry and no fault: the diagnosis learns it from reference logs, and
    never names it as a cause.
    """

    id = "ocv_shape"
    family = "equilibrium"
    is_structure: ClassVar[bool] = True
    is_cause: ClassVar[bool] = False
    parameters = tuple(
        Parameter(f"at_{centre:.0f}_pct_v", "V", -0.01, 0.01, scale="voltage")
        for centre in CENTRES_PCT
    )
    signature = "a curve over SoC, the same at any current, temperature and time"
    equation = "ΔU = Σ vₖ·exp(−½((S − cₖ)/wₖ)²)"
    source = "radial basis functions, Broomhead, Lowe, Complex Systems 2 (1988) 321"
    separated_by = "other logs over the same SoC: what is in all of them is the chemistry's"

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        """Return the additional open-circuit voltage [V]."""
        del model, pack
        soc = np.clip(state.soc_pct, 0.0, 100.0)
        volts = np.zeros_like(soc)
        for parameter, centre, width in zip(self.parameters, CENTRES_PCT, WIDTHS_PCT, strict=True):
            height = values[parameter.name]
            if height:
                volts += height * np.exp(-0.5 * ((soc - centre) / width) ** 2)
        return volts

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the additional open-circuit voltage at one sample at a time."""
        del model, pack
        return _Online([values[parameter.name] for parameter in self.parameters])


class _Online(OnlineEffect):
    uses_soc = True

    def __init__(self, heights_v: list[float]) -> None:
        self._bumps = tuple(zip(heights_v, CENTRES_PCT, WIDTHS_PCT, strict=True))

    def extra_voltage(self, soc_pct: float) -> float:
        soc = min(max(soc_pct, 0.0), 100.0)
        return sum(
            height * math.exp(-0.5 * ((soc - centre) / width) ** 2)
            for height, centre, width in self._bumps
        )

"""Some cells in series with less capacity than the others: they run empty first."""

from __future__ import annotations

import numpy as np

from cangauge.model.effects.effect import Effect, FloatArray, OnlineEffect, Values
from cangauge.model.effects.pack_state import PackState
from cangauge.model.effects.parameter import Pack, Parameter
from cangauge.model.voltage_model import VoltageModel


class WeakCell(Effect):
    """A fraction of the cells whose SoC runs ahead, from full, by a capacity deficit.

    Below empty the weak cells follow the straight line on which the model goes on outside its
    range: a cell that reverses falls faster, but a pack is stopped before that.
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
    signature = "the knee near empty comes early, by the share of the weak cells"
    equation = "ΔU = (n/N)·(OCV(S_w) − OCV(S)), 1 − S_w = (1 − S)/(1 − d)"
    source = "Dubarry, Vuillaume, Liaw, Int. J. Energy Res. 34 (2010) 216"
    separated_by = (
        "a discharge to below 10 %: a lost capacity of all cells brings the whole knee forward,"
        " weak cells a small one; or the cells' own voltages"
    )

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        """Return what the weak cells lack [V]."""
        del pack
        ahead = 1.0 / (1.0 - values["deficit_pct"] / 100.0)
        weak = 100.0 - (100.0 - state.soc_pct) * ahead
        lack = model.pseudo_ocv(weak) - model.pseudo_ocv(state.soc_pct)
        return np.asarray(values["fraction"] * lack)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return what the weak cells lack at one sample at a time."""
        del pack
        return _Online(values["fraction"], values["deficit_pct"], model)


class _Online(OnlineEffect):
    uses_soc = True

    def __init__(self, fraction: float, deficit_pct: float, model: VoltageModel) -> None:
        self._fraction = fraction
        self._ahead = 1.0 / (1.0 - deficit_pct / 100.0)
        self._model = model

    def extra_voltage(self, soc_pct: float) -> float:
        weak = 100.0 - (100.0 - soc_pct) * self._ahead
        lack = self._model.pseudo_ocv_at(weak)[0] - self._model.pseudo_ocv_at(soc_pct)[0]
        return self._fraction * lack

"""Estimators that the bench runs: each fits a model to logs and estimates other logs with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

import cangauge


class Estimated(NamedTuple):
    """SoC, its standard deviation and the SoC of the voltage alone at each row [%]."""

    soc_pct: np.ndarray
    std_pct: np.ndarray
    newton_pct: np.ndarray
    mismatch: bool = False


@dataclass(frozen=True)
class Told:
    """What an estimator is told of a pack."""

    chemistry: str
    cells: int
    capacity_ah: float


class Estimator(Protocol):
    """What the bench needs of an estimator."""

    def fit(self, logs: Sequence[cangauge.Log], told: Told) -> Any:
        """Return a model of logs that have a reference SoC."""

    def estimate(
        self, log: cangauge.Log, model: Any, start_pct: float | None, capacity_ah: float
    ) -> Estimated:
        """Estimate a log from a given start, or from an unknown one, with a capacity [Ah]."""


MODEL_MISMATCH = 1 << 18
"""Bit of the published reasons."""


class Cangauge:
    """cangauge through its public face."""

    effects = "none"

    def fit(self, logs: Sequence[cangauge.Log], told: Told) -> cangauge.Model:
        """Return the identified model."""
        return cangauge.fit(
            list(logs),
            capacity_ah=told.capacity_ah,
            chemistry=told.chemistry,
            cells=told.cells,
            effects=self.effects,
        ).model

    def estimate(
        self, log: cangauge.Log, model: cangauge.Model, start_pct: float | None, capacity_ah: float
    ) -> Estimated:
        """Run `cangauge.estimate`."""
        start = "auto" if start_pct is None else start_pct
        table = cangauge.estimate(log, model, initial_soc_pct=start, capacity_ah=capacity_ah)
        is_mismatch = bool(np.any(table.reasons & MODEL_MISMATCH))
        return Estimated(table.soc_pct, table.soc_std_pct, table.soc_newton_pct, is_mismatch)


class CangaugeEffects(Cangauge):
    """cangauge with the effects that left-out logs select."""

    effects = "auto"


ESTIMATORS = {"cangauge": Cangauge, "cangauge-effects": CangaugeEffects}

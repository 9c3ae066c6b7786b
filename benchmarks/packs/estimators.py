"""Estimators that the bench runs: each fits a model to logs and estimates other logs with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

import cangauge
import peer_filters
from equivalent_circuit import equivalent_circuit


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


class BareEkf(Cangauge):
    """filterpy's extended Kalman filter over the `equivalent_circuit` of our model.

    Nothing is tuned: noise of the voltage as the model states it, σ of a start 10 %, of the current
    1 A. An unknown start is that of the first voltage. It states no σ here.
    """

    def fit(self, logs: Sequence[cangauge.Log], told: Told) -> Any:
        """Return the tables of the circuit."""
        model = super().fit(logs, told)
        return equivalent_circuit(model) | {"noise_v": model.noise.voltage_rmse_v}

    def estimate(
        self, log: cangauge.Log, model: Any, start_pct: float | None, capacity_ah: float
    ) -> Estimated:
        """Run it at every row."""
        circuit = peer_filters.Circuit(model, float(np.mean(log.temperature_c)))
        circuit.capacity_as = 3600.0 * capacity_ah
        columns = {name: getattr(log, name) for name in ("time_s", "current_a", "voltage_v")}
        start = circuit.start(columns) if start_pct is None else start_pct / 100.0
        soc_pct, _ = peer_filters.run(peer_filters.bare_ekf(circuit, start), columns)
        unknown = np.full(len(log), np.nan)
        return Estimated(np.array(soc_pct), unknown, unknown)


ESTIMATORS = {
    "cangauge": Cangauge,
    "cangauge-effects": CangaugeEffects,
    "filterpy-ekf": BareEkf,
}

"""Estimators that the bench runs: each fits a model to logs and estimates other logs with it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

import cangauge
import peer_filters
from cangauge.estimation.compiled import make_estimator
from cangauge.estimation.offline import EstimateTable, samples_of, step_all
from cangauge.estimation.settings import EstimatorSettings
from cangauge.model.first_order import low_passed

from .recorded import counted_ah, one_hz


class Estimated(NamedTuple):
    """SoC, its standard deviation and the SoC of the voltage alone at each row [%]."""

    soc_pct: np.ndarray
    std_pct: np.ndarray
    newton_pct: np.ndarray
    status: np.ndarray | None = None
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
        return _estimated(table)

    def estimate_without_temperature(
        self, log: cangauge.Log, model: cangauge.Model, capacity_ah: float
    ) -> Estimated:
        """Estimate from an unknown start, as live without a temperature's frame."""
        estimator = make_estimator(model, EstimatorSettings(capacity_ah=capacity_ah))
        samples = (sample._replace(temperature_c=math.nan) for sample in samples_of(log))
        return _estimated(step_all(estimator, samples))

    def estimate_days(
        self, days: Sequence[cangauge.Log], model: cangauge.Model, capacity_ah: float
    ) -> Estimated:
        """Estimate drives on one clock by one estimator, which restarts from its state at each."""
        settings = EstimatorSettings(capacity_ah=capacity_ah)
        estimator, tables = make_estimator(model, settings), []
        for day in days:
            before = estimator.snapshot()
            estimator = make_estimator(model, settings)
            if before.samples:
                estimator.restore(before)
            tables.append(_estimated(step_all(estimator, day)))
        *columns, mismatches = zip(*tables, strict=True)
        return Estimated(*map(np.concatenate, columns), any(mismatches))


def _estimated(table: EstimateTable) -> Estimated:
    is_mismatch = bool(np.any(table.reasons & MODEL_MISMATCH))
    return Estimated(
        table.soc_pct, table.soc_std_pct, table.soc_newton_pct, table.status, is_mismatch
    )


class CangaugeEffects(Cangauge):
    """cangauge with the effects that left-out logs select."""

    effects = "auto"


class BareEkf:
    """filterpy's extended Kalman filter over a circuit of two RC pairs of the same logs.

    Nothing is tuned: noise of the voltage is the rms residual of the circuit, σ of a start 10 %, of
    the current 1 A. An unknown start is that of the first voltage. It states no σ here.
    """

    def fit(self, logs: Sequence[cangauge.Log], told: Told) -> Any:
        """Return the tables of the circuit."""
        return two_pairs(logs, told.capacity_ah)

    def estimate(
        self, log: cangauge.Log, model: Any, start_pct: float | None, capacity_ah: float
    ) -> Estimated:
        """Run it at every row."""
        circuit = peer_filters.Circuit(model, 20.0)
        circuit.capacity_as = 3600.0 * capacity_ah
        columns = {name: getattr(log, name) for name in ("time_s", "current_a", "voltage_v")}
        start = circuit.start(columns) if start_pct is None else start_pct / 100.0
        soc_pct, _ = peer_filters.run(peer_filters.bare_ekf(circuit, start), columns)
        unknown = np.full(len(log), np.nan)
        return Estimated(np.array(soc_pct), unknown, unknown)

    def estimate_without_temperature(
        self, log: cangauge.Log, model: Any, capacity_ah: float
    ) -> Estimated:
        """Estimate as ever: the circuit has no temperature."""
        return self.estimate(log, model, None, capacity_ah)

    def estimate_days(
        self, days: Sequence[cangauge.Log], model: Any, capacity_ah: float
    ) -> Estimated:
        """Estimate drives on one clock; while the car is away the current's σ of 1 A goes on."""
        columns = ("time_s", "current_a", "voltage_v", "temperature_c")
        joined = (np.concatenate([getattr(day, name) for day in days]) for name in columns)
        return self.estimate(cangauge.Log(*joined), model, None, capacity_ah)


PAIRS_S = (10.0, 140.0)
"""Time constants of the RC pairs [s]: seconds and minutes, as the polarization of a drive."""
CURVE_PCT = np.linspace(0.0, 100.0, 21)


def two_pairs(logs: Sequence[cangauge.Log], capacity_ah: float) -> dict[str, Any]:
    """Return the circuit of two RC pairs of some logs, by linear least squares.

    The open-circuit voltage is linear between 21 points. Where the logs do not go, it continues
    straight: its second differences are pulled to zero by as little as one row.
    """
    rows, volts = [], []
    for log in map(one_hz, logs):
        start_pct = float(log.soc_pct[np.isfinite(log.soc_pct)][0])
        soc_pct = np.clip(start_pct - 100.0 * counted_ah(log) / capacity_ah, 0.0, 100.0)
        hats = np.array([np.interp(soc_pct, CURVE_PCT, each) for each in np.eye(CURVE_PCT.size)]).T
        smooth = [low_passed(log.time_s, log.current_a, tau_s, 0.0) for tau_s in PAIRS_S]
        rows.append(np.column_stack([hats, -log.current_a, *(-each for each in smooth)]))
        volts.append(log.voltage_v)
    straight = np.zeros((CURVE_PCT.size - 2, rows[0].shape[1]))
    straight[:, : CURVE_PCT.size] = np.diff(np.eye(CURVE_PCT.size), 2, axis=0)
    columns = np.concatenate([*rows, straight])
    measured = np.concatenate([*volts, np.zeros(len(straight))])
    solution = np.linalg.lstsq(columns, measured, rcond=None)[0]
    residual_v = (measured - columns @ solution)[: -len(straight)]
    ocv_v, ohm = solution[: CURVE_PCT.size], np.maximum(solution[CURVE_PCT.size :], 1e-6)
    tables = [np.full((2, 2, 2), each) for each in ohm]
    return {
        "capacity_ah": capacity_ah,
        "temperature_c": [0.0, 40.0],
        "curve_soc_pct": CURVE_PCT,
        "ocv_v": [ocv_v, ocv_v],
        "current_a": [-capacity_ah, capacity_ah],
        "soc_pct": [0.0, 100.0],
        "series_ohm": tables[0],
        "pair_ohm": tables[1:],
        "pair_tau_s": PAIRS_S,
        "noise_v": float(np.sqrt(np.mean(residual_v**2))),
    }


ESTIMATORS = {
    "cangauge": Cangauge,
    "cangauge-effects": CangaugeEffects,
    "filterpy-ekf": BareEkf,
}

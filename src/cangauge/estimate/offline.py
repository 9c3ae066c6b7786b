"""The estimator over a whole log, and how well it did."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.estimate.estimator import Estimator
from cangauge.estimate.settings import EstimatorSettings
from cangauge.estimate.validity import Estimate, Sample, Status
from cangauge.logs.log import Log
from cangauge.model.model_file import Model

PROGRESS_EVERY = 5000
"""Samples between two calls of the progress callback."""


@dataclass(frozen=True, eq=False)
class EstimateTable:
    """Estimates of a whole log, shape (n,) each; the columns of the estimate file."""

    time_s: FloatArray
    soc_pct: FloatArray
    soc_std_pct: FloatArray
    soc_newton_pct: FloatArray
    soc_coulomb_pct: FloatArray
    voltage_model_v: FloatArray
    residual_v: FloatArray
    status: NDArray[np.int64]
    reasons: NDArray[np.int64]

    @classmethod
    def of(cls, estimates: Iterable[Estimate]) -> EstimateTable:
        """Collect estimates into columns."""
        columns = list(zip(*estimates, strict=True)) or [()] * len(Estimate._fields)
        by_name = dict(zip(Estimate._fields, columns, strict=True))
        numbers = {
            name: np.array(by_name[name], dtype=np.float64)
            for name in Estimate._fields
            if name not in {"status", "reasons", "samples"}
        }
        return cls(
            **numbers,
            status=np.array([int(item) for item in by_name["status"]], dtype=np.int64),
            reasons=np.array([int(item) for item in by_name["reasons"]], dtype=np.int64),
        )


@dataclass(frozen=True)
class Scores:
    """How well an estimate did; None where there is no reference."""

    rows: int
    seconds: float
    voltage_mae_pct: float | None
    soc_mae_pct: float | None
    soc_max_pct: float | None
    soc_newton_mae_pct: float | None
    soc_coulomb_mae_pct: float | None
    cover_2sigma: float | None
    valid_fraction: float


def samples_of(log: Log) -> Iterator[Sample]:
    """Yield the log's rows as samples."""
    yield from map(
        Sample._make,
        zip(
            log.time_s.tolist(),
            log.current_a.tolist(),
            log.voltage_v.tolist(),
            log.temperature_c.tolist(),
            strict=True,
        ),
    )


def run_estimator(
    samples: Iterable[Sample],
    model: Model,
    settings: EstimatorSettings,
    progress: Callable[[int], None] | None = None,
) -> EstimateTable:
    """Return the estimates of all samples, in order.

    Parameters
    ----------
    samples : iterable of Sample
    model : Model
    settings : EstimatorSettings
    progress : callable, optional
        Called with the number of samples done, every `PROGRESS_EVERY`.
    """
    estimator = Estimator(model, settings)
    estimates = []
    for done, sample in enumerate(samples, start=1):
        estimates.append(estimator.step(sample))
        if progress is not None and done % PROGRESS_EVERY == 0:
            progress(done)
    return EstimateTable.of(estimates)


def estimate_log(
    log: Log,
    model: Model,
    settings: EstimatorSettings,
    progress: Callable[[int], None] | None = None,
) -> tuple[EstimateTable, Scores]:
    """Estimate a log and compare with its reference SoC where it has one."""
    began = time.perf_counter()
    table = run_estimator(samples_of(log), model, settings, progress)
    seconds = time.perf_counter() - began
    return table, score(table, log, seconds)


def score(table: EstimateTable, log: Log, seconds: float = 0.0) -> Scores:
    """Compare estimates with the log that they were made from, over all rows with both."""
    voltage = np.isfinite(table.residual_v)
    reference = log.soc_pct if log.soc_pct is not None else np.full(len(log), np.nan)

    def mae(values: FloatArray) -> float | None:
        error = np.abs(values - reference)
        known = np.isfinite(error)
        # One finite value is the assumed start, not a reference to compare with.
        return (
            float(error[known].mean()) if np.isfinite(reference).sum() > 1 and known.any() else None
        )

    error = np.abs(table.soc_pct - reference)
    known = np.isfinite(error)
    compared = np.isfinite(reference).sum() > 1 and bool(known.any())
    return Scores(
        rows=len(log),
        seconds=seconds,
        voltage_mae_pct=100.0
        * float(np.mean(np.abs(table.residual_v[voltage]) / log.voltage_v[voltage]))
        if voltage.any()
        else None,
        soc_mae_pct=mae(table.soc_pct),
        soc_max_pct=float(error[known].max()) if compared else None,
        soc_newton_mae_pct=mae(table.soc_newton_pct),
        soc_coulomb_mae_pct=mae(table.soc_coulomb_pct),
        cover_2sigma=float(np.mean(error[known] <= 2.0 * table.soc_std_pct[known]))
        if compared
        else None,
        valid_fraction=float(np.mean(table.status == Status.VALID)),
    )

"""Run the estimator over a whole log, and score it against the log's reference SoC."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cangauge._dataframes import ArrowExport
from cangauge._extras import extra
from cangauge._typing import FloatArray
from cangauge.estimation.compiled import PROGRESS_EVERY, CompiledEstimator, make_estimator
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.settings import EstimatorSettings
from cangauge.logs.gaps import usual_gap_s
from cangauge.logs.log import Log, as_log
from cangauge.model.coulomb_counting import soc_at_first_row
from cangauge.model.effects.base import Signals
from cangauge.model.model_file import Model, as_model
from cangauge.settings import GAP_S, VALID_STD_PCT, FullCharge, LongRest, Method
from cangauge.types import Estimate, Sample, Status, reason_names

LONGEST_GAP_S = 3600.0
"""Upper limit of a gap that follows from a slow log's step [s]."""

NUMBERS = Estimate._fields[:7]
"""Columns of numbers, from `time_s` to `residual_v`."""


@dataclass(frozen=True)
class Scores:
    """Errors of an estimate; None where there is nothing to compare with."""

    rows: int
    seconds: float
    """Computing time [s]."""
    voltage_mae_pct: float | None
    """Mean absolute residual relative to the measured voltage [%]."""
    soc_mae_pct: float | None
    soc_max_pct: float | None
    soc_newton_mae_pct: float | None
    soc_coulomb_mae_pct: float | None
    """Errors against the log's reference SoC [% SoC]."""
    cover_2sigma: float | None
    """Fraction of the samples with the reference within two standard deviations."""
    valid_fraction: float
    """Fraction of the samples with a valid estimate."""


@dataclass(frozen=True, eq=False)
class EstimateTable(ArrowExport):
    """Estimates of all n samples of a log: the columns of the estimate file.

    Attributes
    ----------
    time_s : array of shape (n,)
        Time [s].
    soc_pct, soc_std_pct : array of shape (n,)
        State of charge of the chosen method and its standard deviation [%]; NaN while unknown.
    soc_newton_pct, soc_coulomb_pct : array of shape (n,)
        State of charge by inverse of the voltage model and by counting alone [%].
    voltage_model_v, residual_v : array of shape (n,)
        Predicted voltage, and measured minus predicted voltage [V]; NaN between the rows in which
        both were compared.
    status, reasons : array of int, shape (n,)
        `Status` and `Reason` bits.
    scores : Scores, optional
        Errors against the log's reference SoC, from `estimate`.
    """

    time_s: FloatArray
    soc_pct: FloatArray
    soc_std_pct: FloatArray
    soc_newton_pct: FloatArray
    soc_coulomb_pct: FloatArray
    voltage_model_v: FloatArray
    residual_v: FloatArray
    status: NDArray[np.int64]
    reasons: NDArray[np.int64]
    scores: Scores | None = None

    @classmethod
    def of(cls, estimates: Iterable[Estimate]) -> EstimateTable:
        """Collect estimates into columns."""
        columns = np.array([each[:9] for each in estimates], np.float64).reshape(-1, 9).T
        return cls(*columns[:7], *columns[7:].astype(np.int64))

    def __repr__(self) -> str:
        """Return the number of samples, the time and the SoC at both ends."""
        if not len(self):
            return "<EstimateTable: no samples>"
        known = self.soc_pct[~np.isnan(self.soc_pct)]
        soc = f"SoC {known[0]:.1f} … {known[-1]:.1f} %" if known.size else "SoC unknown"
        valid = np.mean(self.status == Status.VALID)
        hours = (self.time_s[-1] - self.time_s[0]) / 3600.0
        return f"<EstimateTable: {len(self)} samples, {hours:.2f} h, {soc}, valid {valid:.0%}>"

    def plot(self, log: Log | Any = None) -> Any:
        """Return SoC with ±2σ and voltage residual over time, for `bokeh.plotting.show`.

        Parameters
        ----------
        log : Log, path or DataFrame, optional
            Its reference SoC is drawn too.
        """
        log = None if log is None else as_log(log)
        return extra("report.estimate:estimate_figure")(self, log=log)

    def __len__(self) -> int:
        """Return the number of samples."""
        return int(self.time_s.size)

    def to_arrow(self) -> Any:
        """Return a pyarrow.Table of the columns; unknown is null, status and reasons are words."""
        import pyarrow as pa  # noqa: PLC0415 - slow to import, and not needed to estimate

        words = {code: reason_names(code) for code in np.unique(self.reasons).tolist()}
        return pa.table(
            {
                **{name: pa.array(getattr(self, name), from_pandas=True) for name in NUMBERS},
                "status": [Status(code).name.lower() for code in self.status.tolist()],
                "reasons": [words[code] for code in self.reasons.tolist()],
            }
        )


def estimate(
    log: Log | Any,
    model: Model | Any,
    *,
    method: Method = "ekf",
    initial_soc_pct: float | Literal["auto"] | None = None,
    initial_soc_std_pct: float = 1.0,
    valid_std_pct: float = VALID_STD_PCT,
    capacity_ah: float | None = None,
    gap_s: float | None = None,
    full_charge: FullCharge | None = None,
    long_rest: LongRest | None = None,
) -> EstimateTable:
    """Estimate the state of charge at every sample of a log.

    Parameters
    ----------
    log : Log, path or DataFrame
    model : Model, path or result of `fit`
    method : {"ekf", "newton", "coulomb"}
        Method whose SoC is `soc_pct`.
    initial_soc_pct : float or "auto", optional
        SoC at the first sample [%]; "auto" finds it from the first voltages. By default the log's
        first reference SoC, counted back to the first sample, or "auto" without one.
    initial_soc_std_pct : float
        Its standard deviation [%].
    valid_std_pct : float
        A SoC with a larger standard deviation is degraded [%].
    capacity_ah : float, optional
        Overrides the model's capacity [Ah].
    gap_s : float, optional
        A longer step between samples is a gap in the current [s]; by default 2 s, or three usual
        steps of a slower log.
    full_charge : FullCharge, optional
    long_rest : LongRest, optional
        Rules for an external SoC reference.

    Returns
    -------
    EstimateTable
        With `scores`.

    Raises
    ------
    InputError
        If a setting is out of range.

    Examples
    --------
    >>> import numpy as np
    >>> from cangauge.estimation.offline import estimate
    >>> from cangauge.logs.log import Log, as_log
    >>> from cangauge.model.published import leaf_2012_model_file
    >>> rest = np.ones(120)
    >>> log = Log(np.arange(120.0), 0.0 * rest, 385.0 * rest, 23.0 * rest)
    >>> table = estimate(log, leaf_2012_model_file(), initial_soc_pct=80.0)
    >>> len(table), round(float(table.soc_coulomb_pct[-1]), 1)
    (120, 80.0)
    """
    log, model = as_log(log), as_model(model)
    if initial_soc_pct is None:
        initial_soc_pct = initial_soc_of(log, capacity_ah or model.capacity_ah)
    settings = EstimatorSettings(
        method=method,
        initial_soc_pct=None if initial_soc_pct == "auto" else initial_soc_pct,
        initial_soc_std_pct=initial_soc_std_pct,
        valid_std_pct=valid_std_pct,
        capacity_ah=capacity_ah,
        gap_s=gap_of(log) if gap_s is None else gap_s,
        temperature_source=log.temperature_source,
        full_charge=full_charge,
        long_rest=long_rest,
    )
    table, scores = estimate_log(log, model, settings)
    return replace(table, scores=scores)


def initial_soc_of(log: Log, capacity_ah: float) -> float | None:
    """Return `soc_at_first_row` within 0–100 % [%]; None for a log without SoC.

    Parameters
    ----------
    log : Log
    capacity_ah : float
        Capacity [Ah].
    """
    soc_pct = soc_at_first_row(log, capacity_ah)
    return None if soc_pct is None else min(max(soc_pct, 0.0), 100.0)


def gap_of(log: Log) -> float:
    """Return the longest step that is no gap [s]: 2 s, or three usual steps of a slower log."""
    return min(usual_gap_s(log.time_s, GAP_S), LONGEST_GAP_S)


def estimate_log(
    log: Log, model: Model, settings: EstimatorSettings
) -> tuple[EstimateTable, Scores]:
    """Estimate a log with given settings, and score it; see `run_estimator` and `score`."""
    began = time.perf_counter()
    table = run_estimator(log, model, settings)
    return table, score(table, log, time.perf_counter() - began)


def samples_of(log: Log) -> Iterator[Sample]:
    """Yield the log's rows as samples."""
    yield from map(Sample._make, zip(*(each.tolist() for each in Signals.of(log)), strict=True))


def run_estimator(
    samples: Iterable[Sample] | Log, model: Model, settings: EstimatorSettings
) -> EstimateTable:
    """Return the estimates of all samples by a new estimator; see `step_all`."""
    return step_all(make_estimator(model, settings), samples)


def step_all(
    estimator: Estimator,
    samples: Iterable[Sample] | Log,
    *,
    progress: Callable[[int], None] | None = None,
    observe: Callable[[Sample], None] | None = None,
) -> EstimateTable:
    """Return the estimates of all samples, in order: the same step as live.

    Parameters
    ----------
    estimator : Estimator
    samples : iterable of Sample, or Log
    progress : callable, optional
        Called with the number of samples done, every `PROGRESS_EVERY`.
    observe : callable, optional
        Called with each sample after its step.
    """
    if isinstance(estimator, CompiledEstimator) and isinstance(samples, Log) and observe is None:
        found: list[Any] = estimator.run(Signals.of(samples), progress)
        return EstimateTable(*found)
    estimates = []
    rows = samples_of(samples) if isinstance(samples, Log) else samples
    for done, sample in enumerate(rows, start=1):
        row, estimate = estimator.row, estimator.step(sample)
        if estimator.row == row:
            estimate = estimate._replace(voltage_model_v=math.nan, residual_v=math.nan)
        estimates.append(estimate)
        if observe is not None:
            observe(sample)
        if progress is not None and done % PROGRESS_EVERY == 0:
            progress(done)
    return EstimateTable.of(estimates)


def score(table: EstimateTable, log: Log, seconds: float = 0.0) -> Scores:
    """Compare estimates with the log that they were made from, over all rows that have both."""
    reference = np.full(len(log), np.nan)
    # A single finite SoC is the assumed start, not a reference.
    if log.soc_pct is not None and np.isfinite(log.soc_pct).sum() > 1:
        reference = log.soc_pct
    rows = np.isfinite(table.residual_v)
    error = np.abs(table.soc_pct - reference)
    inside = np.where(np.isfinite(error), error <= 2.0 * table.soc_std_pct, np.nan)
    return Scores(
        rows=len(log),
        seconds=seconds,
        voltage_mae_pct=_mean(100.0 * np.abs(table.residual_v[rows]) / log.voltage_v[rows]),
        soc_mae_pct=_mean(error),
        soc_max_pct=_mean(error, np.max),
        soc_newton_mae_pct=_mean(np.abs(table.soc_newton_pct - reference)),
        soc_coulomb_mae_pct=_mean(np.abs(table.soc_coulomb_pct - reference)),
        cover_2sigma=_mean(inside),
        valid_fraction=float(np.mean(table.status == Status.VALID)),
    )


def _mean(values: FloatArray, of: Callable[[FloatArray], Any] = np.mean) -> float | None:
    """Return the mean, or another number, of the known values; None without any."""
    known = values[np.isfinite(values)]
    return float(of(known)) if known.size else None

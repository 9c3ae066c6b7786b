"""What the healthy pack does: the model, corrected by reference logs; and what it leaves open.

One linear model of all logs about the given model:

    r_l = X_l·δ + B_l·b_l + [l diagnosed]·c_k·a_k + ε,   ε ~ N(0, s²)

r [V] is the measured minus the modelled voltage. δ corrects the coefficients of the model (curve,
temperature, resistances: the columns and the prior of the fit) and adds the effects of a pack in
physical sizes. b_l ~ N(0, 1) are nuisance parameters: what one healthy log may differ by. c_k is
the column of a shape of a fault, and a_k its size.

References, logs without a fault, give δ. Left out one at a time they give s², the error of a
healthy log, and the excess o_k ≥ 1 by which their evidence of an effect exceeds chance. The noise
is white and as large as all that left-out references show: a model error is a function of current
and does not average out over thousands of rows.

`Rows` (`model.gaussian`) are the square-root information array of such a model: whitened rows
[X | r], made triangular by QR. Rows below each other add information, a prior is rows like any
other, `eliminated` integrates the first unknowns out, and `posterior` solves for the rest.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from cangauge._typing import FloatArray, IntArray
from cangauge.diagnosis.linear import (
    N,
    coefficient_columns,
    corrected,
    prior,
    stated_covariance,
    with_all_loads,
)
from cangauge.diagnosis.rows import Simulated, Trace, covered, without_outliers
from cangauge.diagnosis.shapes import Shape, shape_columns, shapes
from cangauge.model.effects.base import Pack
from cangauge.model.effects.library import LIBRARY
from cangauge.model.extended import ExtendedModel
from cangauge.model.gaussian import Rows
from cangauge.model.model_file import Model

STRUCTURES: Final = (0.003, 0.009, 0.03, 0.09)
"""Candidates for the standard deviation of a healthy pack's effects, relative to their bounds. The
pair with one of `CURVES` that predicts left-out references best is used."""
CURVES: Final = (0.1, 0.3, 1.0)
"""Candidates for the standard deviation of the curve about its level, relative to the prior's."""

LEAST_COVERED: Final = 0.2
"""A left-out reference with less of its rows at SoC that the others visit shows nothing."""

LEAST_NOISE, FIRST_NOISE = 5e-4, 3e-3
"""Least error of a healthy log, relative to the voltage: a sensor's resolution; and the error from
which the search for it begins."""

RIDGE: Final = 4.0
"""Prior precision of an amplitude in units of its larger bound."""

_OF_A_FAULT: Final = ("resistance_step", "resistance_growth")
"""Effects that no healthy pack has."""

SOC_SCATTER, SOC_RESOLUTION_PCT, SOC_STANDS_OUT = 0.02, 0.7, 3.0
"""Usual scatter of counted charge over the change of a log's own SoC [-]; resolution of such a SoC
[%], that of a start; and the standard deviations from which it is evidence: below, a gauge may
count with the faulty sensor itself."""


@dataclass(frozen=True, eq=False)
class LogRows:
    """One log about a linear model, on the rows that count.

    Its columns: m deviations b of a healthy log (1 σ), δ, k shapes of faults at their bounds,
    and the residual [V].
    """

    simulated: Simulated
    m: int
    """Number of deviations."""
    kept: IntArray
    """The rows that count, of those that take part."""
    is_covered: bool
    """Whether other logs visit enough of its SoC to judge it."""
    columns: FloatArray
    """Of the rows that count, each times the root of its seconds."""
    rows: Rows
    """The same, triangular."""

    @property
    def trace(self) -> Trace:
        """The log."""
        return self.simulated.trace

    @property
    def seconds(self) -> float:
        """Time that the rows stand for [s]."""
        return self.trace.row_s * self.kept.size


def log_rows(
    model: ExtendedModel, log: Trace, tried: Sequence[Shape], visited: Sequence[FloatArray]
) -> LogRows:
    """Return a log on the rows whose SoC other logs visited; on all if these are few."""
    of = Simulated(model, log)
    soc, residual_v = of.plain.soc_pct[log.rows], of.plain.residual_v
    near = covered(soc, visited)
    is_covered = bool(near.mean() >= LEAST_COVERED)
    if not is_covered:
        near[:] = True
    kept = np.flatnonzero(near & without_outliers(residual_v, model.pack.voltage_v))
    by_shape = shape_columns(of, tried)
    varying = [k for k, shape in enumerate(tried) if shape.healthy_std]
    deviations = by_shape[:, varying] * [tried[k].healthy_std for k in varying]
    beside = _nuisance_columns(model.pack, log.log.time_s[log.rows] - log.log.time_s[0], soc)
    delta = np.column_stack([coefficient_columns(of), by_shape[:, _healthy_shapes(tried)]])
    every = np.column_stack([deviations, beside, delta, by_shape, residual_v])
    table = every[kept] * np.sqrt(log.row_s)
    return LogRows(
        of,
        deviations.shape[1] + beside.shape[1],
        kept,
        is_covered,
        table,
        Rows(table, 0.0).reduced(),
    )


def _nuisance_columns(pack: Pack, time_s: FloatArray, soc_pct: FloatArray) -> FloatArray:
    """Return what healthy logs differ by besides effects, at one σ [V], shape (m, 3).

    A pack settles over 150 s and 1200 s after the start of a log: its voltage then differs by 1 %
    of the drop at 1 C. Near empty the knee differs by 0.15 % of the voltage, less by e every 4 %.
    """
    drop_v = pack.resistance_ohm * pack.capacity_ah
    unsettled = [0.01 * drop_v * np.exp(-time_s / tau_s) for tau_s in (150.0, 1200.0)]
    knee = np.exp(-np.clip(soc_pct, -4.0, 100.0) / 4.0)
    return np.column_stack([*unsettled, 0.0015 * pack.voltage_v * knee])


def _healthy_shapes(tried: Sequence[Shape]) -> IntArray:
    """Return the indices of shapes that a healthy pack has too: every second, as they are alike.

    They are the mechanisms that the equation may lack.
    """
    found = [
        k
        for k, shape in enumerate(tried)
        if shape.effect.id == "core_temperature"
        or (shape.effect.adds_voltage and shape.effect.id not in _OF_A_FAULT)
    ]
    return np.array(found[::2], dtype=np.intp)


def _untested() -> dict[str, float]:
    """Return the excess of every effect where fewer than two references show it.

    Nine of ten effects stay below it in development packs.
    """
    return dict.fromkeys(LIBRARY, 22.0)


@dataclass(frozen=True, eq=False)
class Healthy:
    """What the healthy pack does, and how much healthy logs differ."""

    model: ExtendedModel
    """The model that the references have corrected."""
    tried: tuple[Shape, ...]
    delta: Rows
    """What is known of δ, the prior included."""
    s2: float
    """Noise variance of one second [V²]."""
    references: tuple[Trace, ...] = ()
    visited: tuple[FloatArray, ...] = ()
    """SoC of each reference [%]."""
    mean_squares_v2: tuple[float, ...] = ()
    """Of each left-out reference [V²]."""
    mean_open_v2: float = 0.0
    """Variance of the prediction of a left-out reference by the others, mean of all [V²]."""
    nats: tuple[float, ...] = ()
    """Most evidence of any effect in each left-out reference [nats]."""
    excess: Mapping[str, float] = field(default_factory=_untested)
    """o_k of each effect."""
    soc_ratio: tuple[float, float] = (1.0, SOC_SCATTER)
    """Counted charge over the change of a log's own SoC: mean and scatter."""

    @property
    def healthy_v2(self) -> float:
        """Mean square error of a healthy log [V²]."""
        return float(np.mean(self.mean_squares_v2)) if self.mean_squares_v2 else self.s2

    @property
    def rmse_v(self) -> float:
        """RMS error of a healthy log [V]."""
        return float(np.sqrt(self.healthy_v2))

    @property
    def n(self) -> int:
        """Number of δ."""
        return int(self.delta.table.shape[1]) - 1

    def rows_of(self, log: LogRows) -> Rows:
        """Return a log's rows of δ and every shape, its own deviations integrated out."""
        rows = Rows(log.rows.table / np.sqrt(self.s2), 0.0)
        others = rows.table.shape[1] - 1 - log.m
        return (rows + Rows.prior(np.ones(log.m), others)).eliminated(log.m)

    def delta_rows_of(self, log: LogRows) -> Rows:
        """Return a log's rows of δ alone."""
        return self.rows_of(log).with_columns(range(self.n))

    def square_v2(
        self, log: LogRows, delta: FloatArray, column: int = -1, size: float = 0.0
    ) -> float:
        """Return a log's sum of squares with δ and a shape [V² s]; its own deviations remain."""
        table = log.rows.table[:, log.m :]
        left = table[:, -1] - table[:, : self.n] @ delta
        if column >= 0:
            left = left - size * table[:, self.n + column]
        return float(left @ left)

    def gap_v2(self, logs: Sequence[LogRows]) -> float:
        """Return the mean square error of logs by the healthy pack's model [V²]."""
        delta = self.delta.posterior().mean
        return sum(self.square_v2(log, delta) for log in logs) / total_s(logs)

    def open_v2(self, logs: Sequence[LogRows]) -> float:
        """Return the mean variance of the predicted voltage of logs by the covariance of δ [V²]."""
        root = self.delta.posterior().root
        tables = [log.rows.table[:, log.m : log.m + self.n] for log in logs]
        return sum(float(np.sum((table @ root) ** 2)) for table in tables) / total_s(logs)

    def own_soc(self, log: LogRows, soc_pct: FloatArray) -> float:
        """Return the counted less the log's own change of SoC, in standard deviations.

        The own change is scaled by `soc_ratio`. The difference is 0 where that without any effect
        does not stand out.

        Parameters
        ----------
        log : LogRows
        soc_pct : array of shape (n,)
            Counted SoC of all rows of the log, with or without an effect [%].
        """
        moved, counted = log.trace.own_change(log.simulated.plain.soc_pct)
        ratio, scatter = self.soc_ratio
        std = float(np.hypot(scatter * moved, SOC_RESOLUTION_PCT))
        if abs(counted - ratio * moved) < SOC_STANDS_OUT * std:
            return 0.0
        return (log.trace.own_change(soc_pct)[1] - ratio * moved) / std


def total_s(logs: Sequence[LogRows]) -> float:
    """Return the time that the rows of logs stand for [s]."""
    return sum(log.seconds for log in logs)


def total(delta: Rows, logs: Sequence[Rows]) -> Rows:
    """Return the rows of δ with those of logs."""
    return Rows(np.concatenate([delta.table, *(rows.table for rows in logs)]), 0.0).reduced()


def of_model(given: Model, stated_v: float) -> Healthy:
    """Return what the model alone states of a healthy pack, whose error is `stated_v` [V]."""
    model = with_all_loads(given.extended_model())
    tried = shapes(model.pack)
    covariance = stated_covariance(model, given)
    delta = _prior_rows((np.zeros(len(covariance)), covariance), 1.0, STRUCTURES[0], tried)
    return Healthy(model, tried, delta, max(stated_v, LEAST_NOISE * model.pack.voltage_v) ** 2)


def _prior_rows(
    known: tuple[FloatArray, FloatArray], curve: float, structure: float, tried: Sequence[Shape]
) -> Rows:
    """Return the rows of the prior of δ: coefficients, then a healthy pack's effects.

    Parameters
    ----------
    known : (array of shape (p,), array of shape (p, p))
        Mean and covariance of the coefficients.
    curve : float
        Standard deviation of the curve about its level, relative to the known one.
    structure : float
        That of a healthy pack's effects, relative to their bounds.
    tried : sequence of Shape
    """
    mean, covariance = known[0], known[1].copy()
    level = float(covariance[:N, :N].min())
    covariance[:N, :N] = (covariance[:N, :N] - level) * curve**2 + level
    p, q = mean.size, _healthy_shapes(tried).size
    scale = np.sqrt(np.diag(covariance))
    root = np.linalg.cholesky(covariance / np.outer(scale, scale) + 1e-9 * np.eye(p))
    rows = Rows.correlated(np.eye(p, p + q), mean, scale[:, None] * root)
    return Rows(np.concatenate([rows.table, np.eye(q, p + q + 1, p) / structure]), 0.0)


def corrected_by(references: Sequence[Trace], given: Model) -> tuple[Healthy, list[LogRows]]:
    """Return the healthy pack by references, and their rows.

    The model is corrected to the posterior mean of all references, with the prior of the fit. About
    that model δ has its prior again, now with the effects of a healthy pack.
    """
    model = with_all_loads(given.extended_model())
    logs = [log_rows(model, log, (), ()) for log in references]
    visited = [log.simulated.plain.soc_pct[log.trace.rows] for log in logs]
    seconds = [log.seconds for log in logs]
    volts = [log.log.voltage_v[log.rows].mean() for log in references]
    mean_v = float(np.average(volts, weights=seconds))
    mean_soc_pct = float(np.average([soc.mean() for soc in visited], weights=seconds))

    known = prior(model, given, mean_v, mean_soc_pct)
    first = Healthy(model, (), _prior_rows(known, 1.0, 1.0, ()), (FIRST_NOISE * mean_v) ** 2)
    least_v2 = (LEAST_NOISE * mean_v) ** 2
    first = _tuned(first, logs, known, least_v2)
    every = total(first.delta, [first.rows_of(log) for log in logs])

    model = corrected(model, every.posterior().mean)
    tried = shapes(model.pack)
    around = [visited[:k] + visited[k + 1 :] for k in range(len(logs))]
    logs = [
        log_rows(model, log, tried, others) for log, others in zip(references, around, strict=True)
    ]
    known = prior(model, given, mean_v, mean_soc_pct)
    healthy = Healthy(
        model,
        tried,
        _prior_rows(known, 1.0, 1.0, tried),
        first.s2,
        tuple(references),
        tuple(visited),
        soc_ratio=_soc_ratio(logs),
    )
    return _tuned(healthy, logs, known, least_v2), logs


def _tuned(
    healthy: Healthy,
    logs: Sequence[LogRows],
    known: tuple[FloatArray, FloatArray],
    least_v2: float,
) -> Healthy:
    """Return the healthy pack with the prior and noise that predict left-out references best.

    Twice, since the weight of the rows follows from the noise, of `least_v2` at least [V²].
    """
    judged = [k for k, log in enumerate(logs) if log.is_covered and len(logs) > 1]
    for _ in range(2):
        every = [_gram(healthy.delta_rows_of(log)) for log in logs]
        best, least = (healthy.delta, healthy.s2), np.inf
        for curve, structure in itertools.product(CURVES, STRUCTURES):
            rows = _prior_rows(known, curve, structure, healthy.tried)
            left_v2 = _left_out_v2(healthy, logs, judged, _gram(rows), every)
            loss = float(np.sum(np.log(np.add(left_v2, least_v2))))
            if loss < least:
                best, least = (rows, float(np.mean(left_v2 or healthy.s2))), loss
        rows, noise_v2 = best
        healthy = replace(healthy, delta=rows, s2=max(noise_v2, least_v2))
    return healthy


def _left_out_v2(
    healthy: Healthy,
    logs: Sequence[LogRows],
    judged: Sequence[int],
    of_prior: FloatArray,
    every: Sequence[FloatArray],
) -> list[float]:
    """Return the mean square error of each judged log by the others [V²].

    `of_prior` and `every` are the normal equations of the prior and of each log.
    """
    whole, left_v2 = of_prior + np.sum(every, axis=0), []
    for k in judged:
        others = whole - every[k]
        delta = np.linalg.solve(others[:-1, :-1], others[:-1, -1])
        left_v2.append(healthy.square_v2(logs[k], delta) / logs[k].seconds)
    return left_v2


def _gram(rows: Rows) -> FloatArray:
    return rows.table.T @ rows.table


def _soc_ratio(logs: Sequence[LogRows]) -> tuple[float, float]:
    """Return mean and scatter of counted charge over the change of the references' own SoC."""
    changes = [log.trace.own_change(log.simulated.plain.soc_pct) for log in logs]
    moved, counted = np.array([change for change in changes if change[0]]).reshape(-1, 2).T
    if not moved.size:
        return 1.0, SOC_SCATTER
    weight = moved**2 / ((SOC_SCATTER * moved) ** 2 + SOC_RESOLUTION_PCT**2)
    ratio = float(weight @ (counted / moved) / weight.sum())
    scatter2 = float(weight @ (counted / moved - ratio) ** 2 / weight.sum())
    n = moved.size
    return ratio, float(np.sqrt((2.0 * SOC_SCATTER**2 + n * scatter2) / (2.0 + n)))

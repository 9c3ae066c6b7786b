"""What the healthy pack does: the model, corrected by reference logs; and what it leaves open.

One linear model of all logs about the given model:

    r_l = X_l·δ + B_l·b_l + [l diagnosed]·c_k·a_k + ε,   ε ~ N(0, s²)

r [V] is the measured minus the modelled voltage. δ corrects the coefficients of the model (curve,
temperature, resistances: the columns and the prior of the fit) and adds the effects of a pack in
physical sizes. b_l ~ N(0, 1) are nuisance parameters: what one healthy log may differ by. c_k is
the column of a shape of a fault, and a_k its size. A fault has one or more effects, and an effect
one or more shapes. In a shape one amplitude of the effect is free, its other parameters are fixed.

References, logs without a fault, give δ. Left out one at a time they give s², the error of a
healthy log, and the excess o_k ≥ 1 by which their evidence of an effect exceeds chance. The noise
is white and as large as all that left-out references show: a model error is a function of current
and does not average out over thousands of rows.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from cangauge._typing import FloatArray, IntArray
from cangauge.diagnosis.linear import Linear, N
from cangauge.diagnosis.rows import Simulated, Trace, covered, without_outliers
from cangauge.diagnosis.shapes import Shape, columns, shapes, steps
from cangauge.model.gaussian import Rows
from cangauge.model.model_file import Model

STRUCTURES: Final = (0.003, 0.009, 0.03, 0.09)
"""Candidates for the standard deviation of a healthy pack's effects, relative to their bounds."""
CURVES: Final = (0.1, 0.3, 1.0)
"""Candidates for the standard deviation of the curve about its level, relative to the prior's. The
pair of candidates that predicts left-out references best is used."""

UNSETTLED: Final = {150.0: 0.01, 1200.0: 0.01}
"""Times over which a pack settles after the start of a log [s], and the part of the drop at 1 C by
which its voltage then differs."""
KNEE, KNEE_PCT = 0.0015, 4.0
"""Usual error of the knee near empty, relative to the voltage, and the SoC over which it decays
[%]."""

LEAST_COVERED: Final = 0.2
"""A left-out reference with less of its rows at SoC that the others visit shows nothing."""

LEAST_NOISE, FIRST_NOISE = 5e-4, 3e-3
"""Least error of a healthy log, relative to the voltage: a sensor's resolution; and the error from
which the search for it begins."""

RIDGE: Final = 4.0
"""Prior precision of an amplitude in units of its larger bound."""

SOC_SCATTER, SOC_RESOLUTION_PCT, SOC_STANDS_OUT = 0.02, 0.7, 3.0
"""Usual scatter of counted charge over the change of a log's own SoC [-]; resolution of such a SoC
[%], that of a start; and the standard deviations from which it is evidence: below, a gauge may
count with the faulty sensor itself."""

UNTESTED_EXCESS: Final = 22.0
"""Excess of an effect's evidence where fewer than two references show it: nine of ten effects stay
below it in development packs."""


@dataclass(frozen=True, eq=False)
class LogRows:
    """One log about a linear model, on the rows that count.

    Its columns: m deviations b of a healthy log (1 σ), δ, k shapes of faults at their bounds,
    and the residual [V].
    """

    trace: Trace
    of: Simulated
    m: int
    """Number of deviations."""
    soc_pct: FloatArray
    """Counted SoC of the rows that take part [%], shape (n,)."""
    kept: IntArray
    """Those of them that count."""
    columns: FloatArray
    """Of the rows that count, each times the root of its seconds."""
    rows: Rows
    """The same, triangular."""
    own_change: tuple[float, float] | None
    """Change of the log's own SoC, and of the counted one over the same time [%]."""
    count_by_shape: FloatArray
    """Change of that counted one by each shape at its bound [%], shape (k,)."""

    @property
    def seconds(self) -> float:
        """Time that the rows stand for [s]."""
        return float(self.trace.weights[self.kept].sum())


def log_rows(
    linear: Linear, log: Trace, tried: Sequence[Shape], others: list[FloatArray]
) -> LogRows:
    """Return a log on the rows whose SoC others visit; on all if these are few."""
    of = Simulated(linear.model, log)
    soc, residual_v = of.plain.soc_pct[log.rows], of.plain.residual_v
    near = covered(soc, others)
    if near.mean() < LEAST_COVERED:
        near[:] = True
    kept = np.flatnonzero(near & without_outliers(residual_v, linear.pack.voltage_v))
    by_shape = columns(of, tried)
    deviations = np.column_stack(
        [
            *(
                by_shape[:, k] * each.healthy_std
                for k, each in enumerate(tried)
                if each.healthy_std
            ),
            *_nuisance_columns(linear, log.log.time_s[log.rows] - log.log.time_s[0], soc),
        ]
    )
    delta = np.column_stack([linear.columns(of), by_shape[:, _healthy_shapes(tried)]])
    every = np.column_stack([deviations, delta, by_shape, residual_v])
    table = every[kept] * np.sqrt(log.weights[kept])[:, None]
    rows = Rows.of(table[:, :-1], table[:, -1], 1.0)
    change = log.own_change(of.plain.soc_pct)
    counts = np.array([_count_by(shape, of, change) for shape in tried])
    return LogRows(log, of, deviations.shape[1], soc, kept, table, rows, change, counts)


def _nuisance_columns(linear: Linear, time_s: FloatArray, soc_pct: FloatArray) -> list[FloatArray]:
    """Return what healthy logs differ by besides effects [V]: an unsettled start, and the knee."""
    drop_v = linear.pack.resistance_ohm * linear.pack.capacity_ah
    unsettled = [part * drop_v * np.exp(-time_s / tau_s) for tau_s, part in UNSETTLED.items()]
    knee = np.exp(-np.clip(soc_pct, -4.0, 100.0) / KNEE_PCT)
    return [*unsettled, KNEE * linear.pack.voltage_v * knee]


def _count_by(shape: Shape, of: Simulated, plain: tuple[float, float] | None) -> float:
    """Return the change of the counted SoC by a shape at its bound [%]."""
    if plain is None or not shape.changes_count:
        return 0.0
    now = of.of.own_change(of.with_effect(shape.effect, shape.values(shape.about)).soc_pct)
    return 0.0 if now is None else (plain[1] - now[1]) * shape.bound / shape.about


def _healthy_shapes(tried: Sequence[Shape]) -> IntArray:
    """Return the indices of shapes that a healthy pack has too: every second, as they are alike."""
    return np.array([k for k, shape in enumerate(tried) if shape.is_of_pack][::2], dtype=np.intp)


@dataclass(frozen=True, eq=False)
class Healthy:
    """What the healthy pack does, and how much healthy logs differ."""

    linear: Linear
    tried: tuple[Shape, ...]
    known: Rows
    """Rows of δ, the prior among them."""
    s2: float
    """Noise variance of one second [V²]."""
    references: tuple[Trace, ...] = ()
    visited: list[FloatArray] = field(default_factory=list)
    """SoC of each reference [%]."""
    mean_squares_v2: tuple[float, ...] = ()
    """Of each left-out reference [V²]."""
    mean_open_v2: float = 0.0
    """Variance of the prediction of a left-out reference by the others, mean of all [V²]."""
    nats: tuple[float, ...] = ()
    """Most evidence of any effect in each left-out reference [nats]."""
    excess: dict[str, float] = field(default_factory=dict)
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

    def excess_of(self, effect: str) -> float:
        """Return o_k of an effect."""
        return self.excess.get(effect, 1.0 if self.excess else UNTESTED_EXCESS)

    @property
    def n(self) -> int:
        """Number of δ."""
        return int(self.known.table.shape[1]) - 1

    def rows_of(self, log: LogRows) -> Rows:
        """Return a log's rows of δ and every shape, its own deviations integrated out."""
        rows = Rows(log.rows.table / np.sqrt(self.s2), 0.0)
        others = rows.table.shape[1] - 1 - log.m
        return (rows + Rows.prior(np.ones(log.m), others)).eliminated(log.m)

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
        delta = self.known.posterior().mean
        return sum(self.square_v2(log, delta) for log in logs) / total_s(logs)

    def open_v2(self, logs: Sequence[LogRows]) -> float:
        """Return the mean variance of the predicted voltage of logs by the covariance of δ [V²]."""
        root = self.known.posterior().root
        tables = [log.rows.table[:, log.m : log.m + self.n] for log in logs]
        return sum(float(np.sum((table @ root) ** 2)) for table in tables) / total_s(logs)

    def own_soc(self, log: LogRows, soc_pct: FloatArray) -> tuple[float, float]:
        """Return the counted less the log's own change of SoC [σ], and this σ [%].

        The own change is scaled by `soc_ratio`. The difference is 0 where that without any effect
        does not stand out.

        Parameters
        ----------
        log : LogRows
        soc_pct : array of shape (n,)
            Counted SoC of all rows of the log, with or without an effect [%].
        """
        change = log.trace.own_change(soc_pct)
        if log.own_change is None or change is None:
            return 0.0, 1.0
        moved, counted = log.own_change
        ratio, scatter = self.soc_ratio
        std = float(np.hypot(scatter * moved, SOC_RESOLUTION_PCT))
        if abs(counted - ratio * moved) < SOC_STANDS_OUT * std:
            return 0.0, std
        return (change[1] - ratio * moved) / std, std


def total_s(logs: Sequence[LogRows]) -> float:
    """Return the time that the rows of logs stand for [s]."""
    return sum(log.seconds for log in logs)


def of_model(model: Model, stated_v: float | None = None) -> Healthy:
    """Return what the model alone states of a healthy pack; its error is `stated_v` by default."""
    linear = Linear.of(model)
    tried = _tried(linear)
    mean, covariance = np.zeros(linear.p), linear.stated(model)
    known = _prior_rows(mean, covariance, STRUCTURES[0], tried)
    stated_v = model.noise.voltage_rmse_v if stated_v is None else stated_v
    return Healthy(linear, tried, known, max(stated_v, LEAST_NOISE * linear.pack.voltage_v) ** 2)


def _tried(linear: Linear) -> tuple[Shape, ...]:
    return (*shapes(linear.pack), *steps(linear.pack))


def _prior_rows(
    mean: FloatArray, covariance: FloatArray, structure: float, tried: Sequence[Shape]
) -> Rows:
    """Return the rows of the prior of δ: coefficients, then a healthy pack's effects."""
    p, q = mean.size, _healthy_shapes(tried).size
    scale = np.sqrt(np.diag(covariance))
    root = np.linalg.cholesky(covariance / np.outer(scale, scale) + 1e-9 * np.eye(p))
    whitened = np.linalg.solve(root, np.diag(1.0 / scale))
    table = np.zeros((p + q, p + q + 1))
    table[:p, :p], table[:p, -1] = whitened, whitened @ mean
    table[p:, p : p + q] = np.eye(q) / structure
    return Rows(table, 0.0)


def correct(model: Model, references: Sequence[Trace]) -> tuple[Healthy, list[LogRows], list[bool]]:
    """Return the healthy pack, the rows of its references, and which of these can be judged.

    The model is corrected to the posterior mean of all references, with the prior of the fit.
    `known` has the rows of the prior only: `learn` adds those of the references. A reference can be
    left out and judged where the others visit enough of its SoC.
    """
    given = Linear.of(model)
    first = [log_rows(given, log, (), []) for log in references]
    seconds = np.array([log.seconds for log in first])
    volts = [float(np.mean(log.log.voltage_v[log.rows])) for log in references]
    mean_v = float(seconds @ volts) / float(seconds.sum())
    mean_soc = float(seconds @ [log.soc_pct.mean() for log in first]) / float(seconds.sum())
    prior = given.prior(model, mean_v, mean_soc)
    least_v2 = (LEAST_NOISE * mean_v) ** 2
    healthy = Healthy(given, (), _prior_rows(*prior, 1.0, ()), (FIRST_NOISE * mean_v) ** 2)
    every = [len(first) > 1] * len(first)
    for _ in range(2):
        healthy = _tuned(healthy, first, every, prior, least_v2)
    rows = total(healthy.known, [healthy.rows_of(log) for log in first])
    linear = given.moved(rows.posterior().mean)
    tried, visited = _tried(linear), [log.soc_pct for log in first]
    logs, counts = [], []
    for k, log in enumerate(references):
        others = visited[:k] + visited[k + 1 :]
        logs.append(log_rows(linear, log, tried, others))
        counts.append(bool(others) and bool(covered(visited[k], others).mean() >= LEAST_COVERED))
    prior = linear.prior(model, mean_v, mean_soc)
    healthy = Healthy(
        linear,
        tried,
        _prior_rows(*prior, 1.0, tried),
        healthy.s2,
        tuple(references),
        visited,
        soc_ratio=_soc_ratio(logs),
    )
    for _ in range(2):
        healthy = _tuned(healthy, logs, counts, prior, least_v2)
    return healthy, logs, counts


def total(known: Rows, logs: Sequence[Rows]) -> Rows:
    """Return the rows of δ with those of logs."""
    return Rows(np.concatenate([known.table, *(rows.table for rows in logs)]), 0.0).reduced()


def _tuned(
    healthy: Healthy,
    logs: Sequence[LogRows],
    counts: Sequence[bool],
    prior: tuple[FloatArray, FloatArray],
    least_v2: float,
) -> Healthy:
    """Return the healthy pack with the prior and noise that predict left-out references best."""
    every = [_gram(healthy.rows_of(log).with_columns(range(healthy.n))) for log in logs]
    whole = np.sum(every, axis=0)
    judged = [k for k, is_judged in enumerate(counts) if is_judged]
    best, found = np.inf, healthy
    for curve, structure in itertools.product(CURVES, STRUCTURES):
        mean, covariance = prior
        known = _prior_rows(mean, _flatter(covariance, curve), structure, healthy.tried)
        others = _gram(known) + whole
        left = []
        for k in judged:
            without = others - every[k]
            delta = np.linalg.solve(without[:-1, :-1], without[:-1, -1])
            left.append(healthy.square_v2(logs[k], delta) / logs[k].seconds)
        loss = float(np.sum(np.log(np.add(left, least_v2)))) if left else 0.0
        if loss < best:
            noise_v2 = float(np.mean(left)) if left else healthy.s2
            best, found = loss, replace(healthy, known=known, s2=max(noise_v2, least_v2))
    return found


def _gram(rows: Rows) -> FloatArray:
    return rows.table.T @ rows.table


def _flatter(covariance: FloatArray, scale: float) -> FloatArray:
    """Return a prior's covariance with a curve that differs less, at any level."""
    level = float(covariance[:N, :N].min())
    result = covariance.copy()
    result[:N, :N] = (covariance[:N, :N] - level) * scale**2 + level
    return result


def _soc_ratio(logs: Sequence[LogRows]) -> tuple[float, float]:
    """Return mean and scatter of counted charge over the change of the references' own SoC."""
    changes = [log.own_change for log in logs if log.own_change is not None]
    if not changes:
        return 1.0, SOC_SCATTER
    moved, counted = np.array(changes).T
    weight = moved**2 / ((SOC_SCATTER * moved) ** 2 + SOC_RESOLUTION_PCT**2)
    ratio = float(weight @ (counted / moved) / weight.sum())
    scatter2 = float(weight @ (counted / moved - ratio) ** 2 / weight.sum())
    n = moved.size
    return ratio, float(np.sqrt((2.0 * SOC_SCATTER**2 + n * scatter2) / (2.0 + n)))

"""What the healthy pack does: the model, corrected by reference logs; and what it leaves open.

One linear model of all logs about the given model:

    r_l = X_l·δ + B_l·b_l + [l diagnosed]·c_k·a_k + ε,   ε ~ N(0, s²)

r [V] is the measured minus the modelled voltage. δ corrects the coefficients of the model (curve,
temperature, resistances: the columns and the prior of the fit) and adds the effects of a pack in
physical sizes. b_l ~ N(0, 1) is what one healthy log may differ by. c_k is the column of a shape of
a fault, and a_k its size.

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
from cangauge.diagnosis.rows import Simulated, Trace, covered, without_outliers
from cangauge.diagnosis.shapes import Shape, columns, shapes, steps
from cangauge.model.effects.base import Pack
from cangauge.model.extended import ExtendedModel
from cangauge.model.gaussian import Rows
from cangauge.model.model_file import Model
from cangauge.model.prior import CHEMISTRIES, LOW_PASS_S, PackPrior
from cangauge.model.voltage_model import (
    KNOTS_PCT,
    Arrhenius,
    HermiteCurve,
    Loads,
    hermite_basis,
    past_currents,
    resistance_factor,
)

N: Final = KNOTS_PCT.size

STRUCTURE: Final = 0.3
"""Standard deviation of a healthy pack's effect, in bounds, …"""
STRUCTURES: Final = (0.01, 0.03, 0.1, 0.3)
"""… times the one of these that predicts left-out references best; …"""
CURVES: Final = (0.1, 0.3, 1.0)
"""… and how far the curve may differ from the chemistry's, in its standard deviations, likewise."""

UNSETTLED_S: Final = (150.0, 1200.0)
"""Times over which a pack settles after the start of a log [s]; …"""
UNSETTLED: Final = 0.01
"""… its voltage differs by this part of the drop at 1 C."""
KNEE: Final = 0.0015
"""Usual error of the knee near empty, relative to the voltage; …"""
KNEE_PCT: Final = 4.0
"""… it decays over this SoC [%]."""

LEAST_COVERED: Final = 0.2
"""A left-out reference with less of its rows at SoC that the others visit shows nothing."""

START_NOISE: Final = 0.003
"""Noise without any knowledge, relative to the voltage."""
LEAST_NOISE: Final = 5e-4
"""Least error of a healthy log, relative to the voltage: a sensor's resolution."""

RIDGE: Final = 4.0
"""Prior precision of an amplitude in units of its larger bound."""

SOC_SCATTER: Final = 0.02
"""Usual scatter of counted charge over the change of a log's own SoC [-], …"""
SOC_RESOLUTION_PCT: Final = 0.7
"""… and the resolution of such a SoC [%]: that of a start."""
UNTESTED_EXCESS: Final = 22.0
"""Excess of an effect's evidence where fewer than two references show it: nine of ten effects stay
below it in development packs."""

UNKNOWN_PART: Final = 0.02
"""Part of the chemistry's uncertainty that a model leaves beside its principal functions."""

SOC_STANDS_OUT: Final = 3.0
"""Standard deviations from which a log's own SoC is evidence: below, a gauge may count with the
faulty sensor itself."""


@dataclass(frozen=True, eq=False)
class Linear:
    """The model about which the diagnosis is linear, and the columns of its coefficients."""

    model: ExtendedModel
    ohm: FloatArray
    """Resistances that the Arrhenius column scales [Ω], shape (M,)."""
    mean_c: float
    low_pass_s: tuple[float, ...]

    @classmethod
    def of(cls, model: Model) -> Linear:
        """Return the given model."""
        extended = model.extended_model()
        loads = extended.model.loads
        low_pass_s = loads.low_pass_s or LOW_PASS_S
        ohm = np.zeros(len(loads.delays_s) + len(low_pass_s))
        ohm[: len(loads.resistance_ohm)] = loads.resistance_ohm
        mean_c = 0.5 * sum(extended.model.range.temperature_c)
        if loads.arrhenius is not None:
            ohm, mean_c = np.array(loads.arrhenius.resistance_ohm), loads.arrhenius.mean_c
        return cls(extended, ohm, mean_c, low_pass_s)

    @property
    def pack(self) -> Pack:
        """Sizes of the pack."""
        return self.model.pack

    @property
    def p(self) -> int:
        """Number of coefficients."""
        return N + 2 + self.ohm.size

    def columns(self, of: Simulated) -> FloatArray:
        """Return the change of voltage by each coefficient on the rows of a log, shape (m, p)."""
        true, rows = of.plain.signals, of.of.rows
        delays = self.model.model.loads.delays_s
        currents = past_currents(true.time_s, true.current_a, rows, delays, self.low_pass_s)
        celsius = true.temperature_c[rows]
        colder = resistance_factor(celsius) / resistance_factor(self.mean_c) - 1.0
        return np.column_stack(
            [
                hermite_basis(of.plain.soc_pct[rows]),
                celsius - self.model.model.loads.t_ref_c,
                currents,
                colder * (currents @ self.ohm),
            ]
        )

    def prior(
        self, model: Model, mean_v: float, mean_soc_pct: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance of the change of the coefficients by the chemistry's prior."""
        voltage = self.model.model
        pack = PackPrior(CHEMISTRIES[model.chemistry], model.capacity_ah)
        known = pack.coefficients(mean_v, mean_soc_pct)
        number = self.ohm.size
        first = N + 1
        kept = [*range(first + 1), *[first + 1] * (number - 1), known.coefficients.size - 1]
        mean, covariance = known.coefficients[kept], known.covariance[np.ix_(kept, kept)].copy()
        later = slice(first + 1, first + number)
        covariance[later, later] = np.diag(np.diag(covariance[later, later]))
        now = np.zeros_like(mean)
        now[:N] = voltage.curve.values(KNOTS_PCT)
        loads = voltage.loads
        now[N] = loads.kt_v_per_k
        now[first : first + len(loads.resistance_ohm)] = loads.resistance_ohm
        now[-1] = 0.0 if loads.arrhenius is None else loads.arrhenius.factor
        return mean - now, covariance

    def moved(self, change: FloatArray) -> Linear:
        """Return the model with other coefficients."""
        voltage, loads = self.model.model, self.model.model.loads
        ohm = np.zeros(self.ohm.size)
        ohm[: len(loads.resistance_ohm)] = loads.resistance_ohm
        values = voltage.curve.values(KNOTS_PCT) + change[:N]
        factor = 0.0 if loads.arrhenius is None else loads.arrhenius.factor
        changed = Loads(
            t_ref_c=loads.t_ref_c,
            kt_v_per_k=float(loads.kt_v_per_k + change[N]),
            delays_s=loads.delays_s,
            low_pass_s=self.low_pass_s,
            resistance_ohm=tuple((ohm + change[N + 1 : -1]).tolist()),
            arrhenius=Arrhenius(float(factor + change[-1]), tuple(self.ohm.tolist()), self.mean_c),
        )
        curve = HermiteCurve.rising(KNOTS_PCT, values)
        corrected = replace(voltage, curve=curve, loads=changed)
        return replace(self, model=replace(self.model, model=corrected))


@dataclass(frozen=True, eq=False)
class LogRows:
    """One log about a linear model, on the rows that count.

    Its columns are those of the coefficients (p), of the shapes (k), of a healthy log's deviations
    beside shapes (3), and the residual.
    """

    trace: Trace
    of: Simulated
    soc_pct: FloatArray
    """Counted SoC of the rows that take part [%], shape (m,)."""
    kept: IntArray
    """Those of them that count, shape (n,)."""
    columns: FloatArray
    """Of the rows that count, each times the root of its seconds, shape (n, p + k + 4)."""
    rows: Rows
    """The same, triangular."""
    counted: SocCount | None

    @property
    def seconds(self) -> float:
        """Time that the rows stand for [s]."""
        return float(self.trace.weights[self.kept].sum())

    def mean_square_v2(self, coefficients: FloatArray) -> float:
        """Return the mean square of the residual less some columns [V²]."""
        left = self.rows.table @ np.r_[-coefficients, 1.0]
        return float(left @ left) / self.seconds


@dataclass(frozen=True, eq=False)
class SocCount:
    """Counted charge beside a log's own SoC."""

    moved_pct: float
    """Change of the log's own SoC [%]."""
    counted_pct: float
    """Change of the counted one over the same time [%]."""
    by_shape: FloatArray
    """Change of `counted_pct` by each shape at its bound [%]."""

    def std(self, ratio: tuple[float, float]) -> float:
        """Return the standard deviation of the counted change [%]."""
        return float(np.hypot(ratio[1] * self.moved_pct, SOC_RESOLUTION_PCT))

    def deviation(self, ratio: tuple[float, float], counted_pct: float) -> float:
        """Return a counted less the own change, in standard deviations."""
        return (counted_pct - ratio[0] * self.moved_pct) / self.std(ratio)


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
    time_s = log.log.time_s[log.rows] - log.log.time_s[0]
    size_v = UNSETTLED * linear.pack.resistance_ohm * linear.pack.capacity_ah
    beside = [size_v * np.exp(-time_s / tau_s) for tau_s in UNSETTLED_S]
    beside.append(KNEE * linear.pack.voltage_v * np.exp(-np.clip(soc, -4.0, 100.0) / KNEE_PCT))
    every = np.column_stack(
        [linear.columns(of), columns(of, tried), np.column_stack(beside), residual_v]
    )
    table = every[kept] * np.sqrt(log.weights[kept])[:, None]
    rows = Rows.of(table[:, :-1], table[:, -1], 1.0)
    return LogRows(log, of, soc, kept, table, rows, _soc_count(of, tried))


def _soc_count(of: Simulated, tried: Sequence[Shape]) -> SocCount | None:
    changes = of.of.own_change(of.plain.soc_pct)
    if changes is None:
        return None
    moved, counted = changes
    by_shape = np.zeros(len(tried))
    for k, shape in enumerate(tried):
        if not shape.changes_count:
            continue
        now = of.of.own_change(of.with_effect(shape.effect, shape.values(shape.about)).soc_pct)
        if now is not None:
            by_shape[k] = (counted - now[1]) * shape.bound / shape.about
    return SocCount(moved, counted, by_shape)


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
    known_v2: float = 0.0
    """Mean variance of left-out references by what the others leave open [V²]."""
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
    def size(self) -> int:
        """Number of δ."""
        return int(self.known.table.shape[1]) - 1

    def mean_square_v2(
        self, log: LogRows, delta: FloatArray, column: int = -1, size: float = 0.0
    ) -> float:
        """Return a log's mean square error with δ and a shape [V²]; its own deviations remain."""
        p = self.linear.p
        coefficients = np.zeros(p + len(self.tried) + 3)
        coefficients[:p] = delta[:p]
        coefficients[p + _structure(self.tried)] = delta[p:]
        if column >= 0:
            coefficients[p + column] += size
        return log.mean_square_v2(coefficients)

    def open_v2(self, log: LogRows) -> float:
        """Return the mean variance of a log by what references leave open [V²]."""
        p = self.linear.p
        table = log.rows.table
        delta = np.concatenate([table[:, :p], table[:, p + _structure(self.tried)]], axis=1)
        return float(np.sum((delta @ self.known.posterior().root) ** 2)) / log.seconds

    def fixed_columns(self, log: LogRows) -> tuple[FloatArray, FloatArray]:
        """Return the columns of a log's own deviations and of δ on the rows that count."""
        p, k = self.linear.p, len(self.tried)
        own, std = _own(self.tried)
        table = log.columns
        deviations = np.concatenate([table[:, p + own] * std, table[:, p + k : p + k + 3]], axis=1)
        delta = np.concatenate([table[:, :p], table[:, p + _structure(self.tried)]], axis=1)
        return deviations, delta

    def rows_of(self, log: LogRows) -> Rows:
        """Return a log's rows of δ and every shape, its own deviations integrated out."""
        p = self.linear.p
        own, std = _own(self.tried)
        beside = np.arange(p + len(self.tried), p + len(self.tried) + 3)
        table = log.rows.table / np.sqrt(self.s2)
        chosen = [
            table[:, p + own] * std,
            table[:, beside],
            table[:, :p],
            table[:, p + _structure(self.tried)],
            table[:, p : p + len(self.tried)],
            table[:, -1:],
        ]
        number = own.size + beside.size
        others = sum(part.shape[1] for part in chosen[2:-1])
        rows = Rows(np.concatenate(chosen, axis=1), 0.0)
        return (rows + Rows.prior(np.ones(number), others)).eliminated(number)


def _own(tried: Sequence[Shape]) -> tuple[IntArray, FloatArray]:
    """Return the shapes that a healthy log may differ by, and how far in bounds (1 σ)."""
    chosen = [k for k, shape in enumerate(tried) if shape.healthy_std > 0.0]
    return np.array(chosen, dtype=np.intp), np.array([tried[k].healthy_std for k in chosen])


def _structure(tried: Sequence[Shape]) -> IntArray:
    """Return the shapes that a healthy pack has too."""
    chosen = [k for k, shape in enumerate(tried) if shape.is_of_pack]
    return np.array(chosen[::2], dtype=np.intp)


def of_model(model: Model, stated_v: float | None = None) -> Healthy:
    """Return what the model alone states of a healthy pack; its error is `stated_v` by default."""
    linear = Linear.of(model)
    functions = model.principal_functions()
    number = N + 2 + linear.ohm.size
    change = np.zeros((number, functions.number))
    change[:N] = _at_knots(functions.soc_pct, functions.value)
    load = functions.load
    ohms = len(linear.model.model.loads.resistance_ohm)
    change[N : N + 1 + ohms] = load[: 1 + ohms]
    if load.shape[0] > 1 + ohms:
        change[-1] = load[1 + ohms]
    mean_v = linear.pack.voltage_v
    _, typical = linear.prior(model, mean_v, 50.0)
    covariance = change @ change.T + UNKNOWN_PART**2 * np.diag(np.diag(typical))
    tried = _tried(linear)
    stated_v = model.noise.voltage_rmse_v if stated_v is None else stated_v
    known = _prior_rows(np.zeros(number), covariance, STRUCTURES[0], tried)
    return Healthy(linear, tried, known, max(stated_v, LEAST_NOISE * mean_v) ** 2)


def _at_knots(soc_pct: FloatArray, values: FloatArray) -> FloatArray:
    found = [np.interp(KNOTS_PCT, soc_pct, each) for each in values.T]
    return np.array(found).reshape(-1, KNOTS_PCT.size).T


def _tried(linear: Linear) -> tuple[Shape, ...]:
    return (*shapes(linear.pack), *steps(linear.pack))


def _prior_rows(
    mean: FloatArray, covariance: FloatArray, structure: float, tried: Sequence[Shape]
) -> Rows:
    """Return the rows of the prior of δ: coefficients, then a healthy pack's effects."""
    p, q = mean.size, _structure(tried).size
    scale = np.sqrt(np.diag(covariance))
    root = np.linalg.cholesky(covariance / np.outer(scale, scale) + 1e-9 * np.eye(p))
    whitened = np.linalg.solve(root, np.diag(1.0 / scale))
    table = np.zeros((p + q, p + q + 1))
    table[:p, :p], table[:p, -1] = whitened, whitened @ mean
    table[p:, p : p + q] = np.eye(q) / (STRUCTURE * structure)
    return Rows(table, 0.0)


def correct(model: Model, references: Sequence[Trace]) -> tuple[Healthy, list[LogRows], list[bool]]:
    """Return the healthy pack by references, without them in it; and which of them count.

    The model is corrected by the references, by the prior of the fit. The effects that a pack has
    are as large as predicts left-out references best.
    """
    given = Linear.of(model)
    first = [log_rows(given, log, (), []) for log in references]
    seconds = np.array([log.seconds for log in first])
    volts = [float(np.mean(log.log.voltage_v[log.rows])) for log in references]
    mean_v = float(seconds @ volts) / float(seconds.sum())
    mean_soc = float(seconds @ [log.soc_pct.mean() for log in first]) / float(seconds.sum())
    prior = given.prior(model, mean_v, mean_soc)
    least_v2 = (LEAST_NOISE * mean_v) ** 2
    healthy = Healthy(given, (), _prior_rows(*prior, 1.0, ()), (START_NOISE * mean_v) ** 2)
    every = [len(first) > 1] * len(first)
    for _ in range(2):
        healthy = _predicting(healthy, first, every, prior, least_v2)
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
        healthy = _predicting(healthy, logs, counts, prior, least_v2)
    return healthy, logs, counts


def total(known: Rows, logs: Sequence[Rows]) -> Rows:
    """Return the rows of δ with those of logs."""
    return Rows(np.concatenate([known.table, *(rows.table for rows in logs)]), 0.0).reduced()


def _predicting(
    healthy: Healthy,
    logs: Sequence[LogRows],
    counts: Sequence[bool],
    prior: tuple[FloatArray, FloatArray],
    least_v2: float,
) -> Healthy:
    """Return the prior that predicts left-out references best, and the noise that they show."""
    n = healthy.linear.p + _structure(healthy.tried).size
    every = [_gram(healthy.rows_of(log).with_columns(range(n))) for log in logs]
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
            left.append(healthy.mean_square_v2(logs[k], delta))
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
    counts = [log.counted for log in logs if log.counted is not None]
    moved = np.array([one.moved_pct for one in counts])
    counted = np.array([one.counted_pct for one in counts])
    if not moved.size:
        return 1.0, SOC_SCATTER
    weight = moved**2 / ((SOC_SCATTER * moved) ** 2 + SOC_RESOLUTION_PCT**2)
    ratio = float(weight @ (counted / moved) / weight.sum())
    scatter2 = float(weight @ (counted / moved - ratio) ** 2 / weight.sum())
    number = moved.size
    return ratio, float(np.sqrt((2.0 * SOC_SCATTER**2 + number * scatter2) / (2.0 + number)))

"""Evidence of every effect in logs, against what reference logs show.

One linear model of all logs about a ridge fit of the references:

    r_l = X_l θ + B_l b_l + [l diagnosed] (r_l(0) − r_l(a_k)) + ε,   ε ~ N(0, s²) white

with r [V] the measured minus the modelled voltage, θ the structure that all logs share (OCV curve,
resistances, lags), b_l ~ N(0, 1) what one healthy log may differ by, and a_k the size of effect k,
which is re-simulated where it changes a signal.

The references give θ. Left out one at a time they give s², the error that a healthy log shows, and
the excess o_k ≥ 1 by which their evidence of effect k goes beyond chance. The noise is white and as
large as everything that left-out references show: a model error is a function of current and does
not average out over thousands of rows.

    known = learn([trace(log, capacity_ah) for log in references], capacity_ah)
    evidence = analyse(known, [columns(known, trace(log, capacity_ah)) for log in logs])

All functions are pure. Current > 0 discharges.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.special import log_ndtr, logsumexp

from cangauge._typing import FloatArray, IntArray
from cangauge.diagnosis.columns import (
    COVER_PCT,
    FOLDS,
    PLACES,
    Columns,
    all_columns,
    in_blocks,
    on_rows,
    rows_that_count,
    shared_columns,
    squares,
    without_own,
)
from cangauge.diagnosis.pack_fit import PackFit, Trace, fit_pack
from cangauge.diagnosis.trials import STEP, Trial, library, residual, slope, undone

WIDTHS = np.array([1.0, 0.3, 0.1, 0.03])
"""Equally probable widths of an amplitude's prior, in half bounds."""

RIDGE = 4.0
"""Prior precision of an amplitude in units of its largest bound, for its best value."""

VISIBLE_NATS = 6.0
"""Evidence from which an effect counts as visible [nats]: 400 to 1 for one effect."""

COVER_K = 3.0
"""References cover temperatures this far beyond their own [K]."""

UNTESTED_EXCESS = 22.0
"""Excess of an effect's evidence where fewer than two references are there to show it: nine of ten
effects stay below it in the packs that the weights were fitted to."""

STEPS, SHRINK, MIN_STEP, MIN_CHANGE = 5, 0.35, 1e-3, 0.03
"""Gauss–Newton: steps, the factor after one that lost evidence, and the steps at which it ends, in
units of the bound and relative to the size."""

AFTER = 2.0
"""A place beyond the end of a log, in parts of it: no step in it."""

MIN_PLACE = 0.01
"""A step of resistance is placed this closely, in parts of its log."""

START_PARTS = 0.5, 1.0
"""Parts of its bounds from which a wrong start is simulated: it moves all rows at once, beyond a
bend of the OCV curve."""

MOVES_SOC = ("current_offset", "current_gain", "capacity", "initial_soc", "coulombic_efficiency")
"""Effects that change the counted SoC."""

RESIMULATED_PART = 0.15
"""An effect that does not move the SoC is re-simulated from this part of the best one's evidence.
Effects that move it always are: linearised gain is meaningless beyond a bend of the OCV curve."""


@dataclass(frozen=True)
class EffectEvidence:
    """Evidence of one effect at its best shape and size."""

    trial: Trial
    nats: float
    """Gain of log likelihood over the excess o_k that references show of this effect [nats]."""
    left_v2: float
    """Mean square error that remains [V²]."""
    size: float
    """Amplitude [unit of the trial]."""
    std: float
    """Standard deviation of the amplitude by noise and excess [unit of the trial]."""
    visible: float
    """Smallest size that would have been visible [unit of the trial]; infinite: none."""
    chance: float
    """Largest χ² of its shapes: about 1 without the effect."""
    in_logs: tuple[float | None, ...]
    """Resistance step: its place in each log, in parts of it; None before it."""


@dataclass(frozen=True)
class Evidence:
    """Evidence of every effect in logs that share one cause."""

    effects: dict[str, EffectEvidence]
    gap_v2: float
    """Mean square error with the structure of the references [V²]."""


@dataclass(frozen=True, eq=False)
class References:
    """What reference logs show."""

    pack: PackFit
    trials: list[Trial]
    logs: list[Trace]
    s2: float
    """Noise: mean square error of left-out references [V²]."""
    a: FloatArray
    """Precision of θ, shape (p, p)."""
    b: FloatArray
    """Precision times mean of θ's change, shape (p,)."""
    left_out: tuple[Evidence, ...] = ()
    """Each reference as analysed by the others; empty below two."""
    excess: dict[str, float] = field(default_factory=dict)
    """o_k: by how much healthy evidence of an effect exceeds chance, 1 at least."""
    stated_v2: float = 0.0
    """Mean square error that the model file states, for fewer than two references [V²]."""

    @property
    def healthy_v2(self) -> float:
        """Mean square error of a healthy log [V²]."""
        if not self.left_out:
            return max(self.s2, self.stated_v2)
        return float(np.mean([one.gap_v2 for one in self.left_out]))

    @property
    def healthy_rmse_v(self) -> float:
        """RMS error of a healthy log [V]."""
        return float(np.sqrt(self.healthy_v2))

    @property
    def healthy_nats(self) -> FloatArray:
        """Most evidence of any effect in each left-out reference [nats]."""
        most = [
            max(float(e.nats) / self.excess_of(name) for name, e in one.effects.items())
            for one in self.left_out
        ]
        return np.asarray(np.maximum(most or [3.0], 0.0), dtype=np.float64)

    def excess_of(self, effect: str) -> float:
        """Return o_k of an effect."""
        return self.excess.get(effect, 1.0 if self.excess else UNTESTED_EXCESS)


def learn(
    references: Sequence[Trace], capacity_ah: float, stated_rmse_v: float = 0.0
) -> References:
    """Learn structure, noise and healthy evidence from reference logs, at least one.

    With fewer than two the error that the model file states [V] counts as noise.
    """
    pack = fit_pack(references, capacity_ah)
    trials = library(pack)
    full, out = [], []  # on all rows, and on those whose SoC the others visit
    for k, log in enumerate(references):
        every = all_columns(pack, log, trials)
        others, r = [*references[:k], *references[k + 1 :]], every[-1][:, 0]
        own, covered = (rows_that_count(pack, log, some, r) for some in ([], others))
        full.append(on_rows(log, every, own, folds=1))
        same = len(own) == len(covered)
        out.append(full[-1] if same else on_rows(log, every, covered, folds=1))
    s2 = _noise_v2(pack, full)
    p = pack.precision()
    if len(references) < 2:
        s2 = max(s2, stated_rmse_v**2)
    else:
        p, left_v2 = _predicting(pack, full, out, s2)
        s2 = max(s2, left_v2)
    q = [without_own(log.products, log, s2) for log in full]
    a, b = _normal(pack, p, q)
    known = References(pack, trials, list(references), s2, a, b, stated_v2=stated_rmse_v**2)
    if len(references) < 2:
        return known
    plain, nx = replace(known, excess={"": 1.0}), len(b)
    left_out = tuple(
        analyse(replace(plain, a=a - x[:nx, :nx], b=b - x[:nx, -1]), [log], exact=False)
        for x, log in zip(q, out, strict=True)
    )
    chance = {k: np.array([one.effects[k].chance for one in left_out]) for k in left_out[0].effects}
    usual = max(1.0, float(np.median([x.mean() for x in chance.values()])))
    excess = {k: max((x.sum() + 2.0 * usual) / (len(x) + 2.0), usual) for k, x in chance.items()}
    return replace(known, left_out=left_out, excess=excess)


def _normal(pack: PackFit, p: FloatArray, q: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return precision and right side of θ's change, the prior's precision being p about zero."""
    nx, total = len(pack.theta), np.sum(q, axis=0)
    return p + total[:nx, :nx], total[:nx, -1] - p @ pack.theta


def _noise_v2(pack: PackFit, full: Sequence[Columns]) -> float:
    """Return the mean square error of all references together [V²]."""
    s2, p, rows = (0.003 * pack.volts) ** 2, pack.precision(), sum(len(log.rows) for log in full)
    for _ in range(3):
        q = [without_own(log.products, log, s2) for log in full]
        a, b = _normal(pack, p, q)
        chi2 = sum(x[-1, -1] for x in q) + pack.theta @ p @ pack.theta - b @ np.linalg.solve(a, b)
        s2 *= float(chi2) / rows
    return max(s2, (1e-5 * pack.volts) ** 2)


def _predicting(
    pack: PackFit, full: Sequence[Columns], out: Sequence[Columns], s2: float
) -> tuple[FloatArray, float]:
    """Return the prior precision of θ that predicts left-out references best, and their error."""
    q, nx = [without_own(log.products, log, s2) for log in full], len(pack.theta)
    least_v2 = (5e-4 * pack.volts) ** 2
    best, found = np.inf, (pack.precision(), s2)
    for size, rough in itertools.product((0.03, 0.1, 0.3, 1.0), (0.2, 0.5, 1.5)):
        p = pack.precision(size, rough)
        a, b = _normal(pack, p, q)
        left_v2 = [
            squares(log, np.linalg.solve(a - x[:nx, :nx], b - x[:nx, -1])) / len(log.rows)
            for x, log in zip(q, out, strict=True)
        ]
        loss = float(np.sum(np.log(np.add(left_v2, least_v2))))
        if loss < best:
            best, found = loss, (p, float(np.mean(left_v2)))
    return found


def columns(known: References, log: Trace) -> Columns:
    """Return the columns of a log on the rows whose SoC the references visit."""
    every = all_columns(known.pack, log, known.trials)
    r = every[-1][:, 0]
    return on_rows(log, every, rows_that_count(known.pack, log, known.logs, r))


def bounded_evidence(g: FloatArray, s: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Return ln Bayes factors of amplitudes within bounds against none, shape (k,).

    The mean over normal priors of `WIDTHS`, cut off at the bounds low ≤ 0 ≤ high, of
    exp(g·a − s·a²/2): g and s are gradient at 0 and curvature of the log likelihood.
    """
    std = 0.5 * WIDTHS[:, None]
    precision = s + std**-2.0
    mode, root = g / precision, np.sqrt(precision)

    def mass(a: FloatArray, b: FloatArray) -> FloatArray:
        a, b = np.where(a > 0.0, -b, a), np.where(a > 0.0, -a, b)
        upper, lower = log_ndtr(b), log_ndtr(a)
        return np.asarray(upper + np.log1p(-np.exp(np.minimum(lower - upper, -1e-12))))

    free = 0.5 * g * mode - 0.5 * np.log(precision * std**2)
    inside = mass((low - mode) * root, (high - mode) * root) - mass(low / std, high / std)
    return np.asarray(logsumexp(free + inside, axis=0) - np.log(len(WIDTHS)))


def analyse(known: References, logs: Sequence[Columns], *, exact: bool = True) -> Evidence:
    """Return the evidence of every effect in logs that share one cause.

    `exact`: effects that change a signal are simulated again at the size found (Gauss–Newton).
    """
    tried, at = _tried(known, [log.log for log in logs])
    effects = np.array([trial.effect for trial in tried])
    bound = np.array([trial.bound for trial in tried])
    low = np.array([trial.low for trial in tried]) / bound
    high = np.array([trial.high for trial in tried]) / bound
    over = np.array([known.excess_of(name) for name in effects])
    nx, rows = len(known.b), sum(len(log.rows) for log in logs)
    q = [without_own(log.products, log, known.s2) for log in logs]
    a = known.a + sum(x[:nx, :nx] for x in q)
    b = known.b + sum(x[:nx, -1] for x in q)
    inverse = np.linalg.inv(a)
    theta = inverse @ b
    u, s, g = np.zeros((nx, len(tried))), np.zeros(len(tried)), np.zeros(len(tried))
    for x, place in zip(q, at, strict=True):
        on, column = place >= 0, nx + place[place >= 0]
        u[:, on] += x[:nx, column]
        s[on] += x[column, column]
        g[on] += x[column, -1]
    g = g - u.T @ theta
    s = np.maximum(s - np.sum(u * (inverse @ u), axis=0), 1e-9)
    size = np.clip(g / (s + RIDGE), low, high)
    gain = g * size - 0.5 * s * size**2
    evidence = bounded_evidence(g, s, low, high)
    result = {}
    for name in dict.fromkeys(effects.tolist()):
        k = np.flatnonzero(effects == name)
        top = int(k[np.argmax(evidence[k])])
        trial, amplitude, nats, left_v2 = tried[top], float(size[top]), float(gain[top]), None
        places: tuple[float | None, ...] = ()
        if name == STEP.effect:
            of_log = [int(place[top]) - len(known.trials) for place in at]
            places = tuple(PLACES[k] if k >= 0 else None for k in of_log)
        if exact and name in MOVES_SOC:
            starts = [amplitude]
            if name == "initial_soc":
                starts += [part * end for end in (low[top], high[top]) for part in START_PARTS]
            amplitude, nats, left_v2 = _resimulated(known, logs, trial, starts)
            starts = [amplitude, low[top] / 3.0, high[top] / 3.0]
            amplitude = _resimulated(known, logs, trial, starts, moved=True)[0]
        elif exact and gain[top] > RESIMULATED_PART * gain.max():
            if trial.changes_signal and trial.effect != "voltage_offset":
                amplitude, nats, left_v2 = _resimulated(known, logs, trial, [amplitude])
            elif places:
                places, amplitude, nats, left_v2 = _step_refined(known, logs, places)
        if left_v2 is None:
            moved = theta - inverse @ u[:, top] * amplitude
            left_v2 = (
                sum(
                    squares(log, moved, None if place[top] < 0 else int(place[top]), amplitude)
                    for log, place in zip(logs, at, strict=True)
                )
                / rows
            )
        result[name] = EffectEvidence(
            trial=trial,
            nats=nats / over[top],
            left_v2=left_v2,
            size=amplitude * trial.bound,
            std=float(np.sqrt(over[top] / (s[top] + RIDGE))) * trial.bound,
            visible=float(np.min(np.sqrt(2.0 * VISIBLE_NATS * over[k] / s[k]) * bound[k])),
            chance=float(np.max(g[k] ** 2 / (s[k] + RIDGE))),
            in_logs=places,
        )  # fmt: skip
    before = np.linalg.solve(known.a, known.b)
    return Evidence(result, sum(squares(log, before) for log in logs) / rows)


def _tried(known: References, logs: Sequence[Trace]) -> tuple[list[Trial], list[IntArray]]:
    """Return what is tried, and for each log the column of each trial, −1 for none.

    No log starts beyond full or empty. A step of resistance happens at one place of one log and
    lasts through the later ones. At the start of the first it happened before these logs.
    """
    n, starts = len(known.trials), [log.start_pct for log in logs]
    least = min(max(starts) - 100.0 - COVER_PCT, 0.0)
    most = max(min(starts) + COVER_PCT, 0.0)
    tried = [
        replace(trial, low=max(trial.low, least), high=min(trial.high, most), scale=trial.bound)
        if trial.effect == "initial_soc"
        else trial
        for trial in known.trials
    ]
    at = [list(range(n)) for _ in logs]
    for j in range(len(logs)):
        for k in range(len(PLACES)):
            tried.append(replace(STEP, shape=PLACES[k]))
            for log in range(len(logs)):
                at[log].append(-1 if log < j else n + (k if log == j else 0))
    return tried, [np.array(place, dtype=np.intp) for place in at]


def _step_refined(
    known: References, logs: Sequence[Columns], places: tuple[float | None, ...]
) -> tuple[tuple[float | None, ...], float, float, float]:
    """Return the places of a step found more closely, its size, gain [nats] and error [V²].

    The log in which it happens is the first that has it; halving the distance between the places
    that were tried, down to a hundredth of that log.
    """
    first = next(k for k, place in enumerate(places) if place is not None)
    low, high = STEP.low / STEP.bound, STEP.high / STEP.bound

    def fitted(place: float) -> tuple[float, float, float]:
        tried = [AFTER if k < first else place if k == first else 0.0 for k in range(len(logs))]
        steps = [replace(STEP, shape=each) for each in tried]
        one = _OneEffect.of(known, logs, _all_at_size(known, logs, steps, 0.0))
        size = float(np.clip(one.gradient / (one.curvature + RIDGE), low, high))
        return one.gradient * size - 0.5 * one.curvature * size**2, size, one.left_v2(size)

    best, step = float(places[first] or 0.0), 0.5 * (PLACES[1] - PLACES[0])
    found = fitted(best)
    while step > MIN_PLACE:
        for place in (best - step, best + step):
            trial = fitted(place) if 0.0 < place < 1.0 else found
            if trial[0] > found[0]:
                best, found = place, trial
        step *= 0.5
    refined = tuple(best if k == first else place for k, place in enumerate(places))
    return refined, found[1], found[0], found[2]


def at_size(
    known: References, log: Columns, trial: Trial, a: float, folds: int = 1, *, moved: bool = False
) -> FloatArray:
    """Return products of (x, b, slope, r) with an effect undone, by blocks, shape (folds, k, k).

    The amplitude `a` is in units of the bound, as is the slope. `moved`: θ is uncertain at the SoC
    without the effect. That is right for its size; between effects it favours those that move rows
    to SoC that no reference visits.
    """
    size, x = a * trial.bound, log.x
    r = residual(known.pack, log.log, trial, size)
    column = slope(known.pack, log.log, trial, size, r) * trial.bound
    if moved:
        x = shared_columns(known.pack, undone(known.pack, log.log, trial, size))[log.rows]
    every = np.column_stack([x, log.b, column[log.rows], r[log.rows]])
    return in_blocks(every, log.rows, folds)


def _all_at_size(
    known: References, logs: Sequence[Columns], trials: Sequence[Trial], a: float, **options: Any
) -> list[FloatArray]:
    """Return the products of `at_size` of each log on all its rows, shape (k, k) each."""
    return [
        at_size(known, log, trial, a, **options).sum(axis=0)
        for log, trial in zip(logs, trials, strict=True)
    ]


@dataclass(frozen=True)
class _OneEffect:
    """Likelihood of one effect about a size, everything else integrated out."""

    gradient: float
    curvature: float
    chi2: float
    theta: FloatArray
    changed: FloatArray
    """Change of θ for each unit of the effect, with the opposite sign."""
    products: FloatArray
    """Mean over the rows of all logs [V²]."""

    @classmethod
    def of(
        cls, known: References, logs: Sequence[Columns], products: Sequence[FloatArray]
    ) -> _OneEffect:
        nx = len(known.b)
        q = [without_own(z, log, known.s2) for log, z in zip(logs, products, strict=True)]
        total = np.sum(q, axis=0)
        a, b, u = known.a + total[:nx, :nx], known.b + total[:nx, -1], total[:nx, -2]
        theta, changed = np.linalg.solve(a, np.column_stack([b, u])).T
        return cls(
            gradient=float(total[-2, -1] - u @ theta),
            curvature=max(float(total[-2, -2] - u @ changed), 1e-9),
            chi2=float(total[-1, -1] - b @ theta),
            theta=theta,
            changed=changed,
            products=np.sum(products, axis=0) / sum(len(log.rows) for log in logs),
        )

    def left_v2(self, step: float = 0.0) -> float:
        """Return the mean square error with θ and a further step of the effect [V²]."""
        w = np.zeros(len(self.products))
        w[: len(self.theta)], w[-2:] = step * self.changed - self.theta, (-step, 1.0)
        return float(w @ self.products @ w)


def _resimulated(
    known: References,
    logs: Sequence[Columns],
    trial: Trial,
    starts: Sequence[float],
    *,
    moved: bool = False,
) -> tuple[float, float, float | None]:
    """Return size [bounds], gain [nats] and remaining error [V²] of an effect, re-simulated.

    From the best of several starts, since the true size may lie beyond a bend of the curve.
    """
    low, high = trial.low / trial.bound, trial.high / trial.bound
    trials = [trial] * len(logs)

    def fitted(size: float) -> _OneEffect:
        return _OneEffect.of(known, logs, _all_at_size(known, logs, trials, size, moved=moved))

    size, here, left_v2 = 0.0, fitted(0.0), None
    chi2_without = here.chi2
    if trial.effect == "time_skew" and trial.shape:  # a secant at 0, best at its shape
        starts = [trial.number / trial.bound]
    tried = {start: fitted(start) for start in starts if abs(start) >= MIN_STEP}
    step = min(tried, key=lambda start: tried[start].chi2, default=0.0)
    for _ in range(STEPS):
        if abs(step) < MIN_STEP:
            break
        there = tried.get(size + step) or fitted(size + step)
        if there.chi2 >= here.chi2:
            step *= SHRINK
            continue
        size, here, left_v2 = size + step, there, there.left_v2()
        change = (here.gradient - RIDGE * size) / (here.curvature + RIDGE)
        step = float(np.clip(size + change, low, high)) - size
        if abs(step) < MIN_CHANGE * abs(size):
            break
    return size, 0.5 * (chi2_without - here.chi2), left_v2


def held_out_sizes(
    known: References, logs: Sequence[Columns], evidence: EffectEvidence
) -> list[FloatArray]:
    """Return the size of an effect for each row of each log, found without its set of blocks."""
    trial, size = evidence.trial, evidence.size / evidence.trial.bound
    low, high = trial.low / trial.bound, trial.high / trial.bound
    places = [AFTER if place is None else place for place in evidence.in_logs]
    trials = [replace(trial, shape=place) for place in places] or [trial] * len(logs)
    moved = trial.effect in MOVES_SOC
    parts = [
        at_size(known, log, own, size, FOLDS, moved=moved)
        for log, own in zip(logs, trials, strict=True)
    ]
    sizes = []
    for k in range(FOLDS):
        one = _OneEffect.of(known, logs, [z.sum(axis=0) - z[k] for z in parts])
        change = (one.gradient - RIDGE * size) / (one.curvature + RIDGE)
        sizes.append(float(np.clip(size + change, low, high)) * trial.bound)
    return [np.array(sizes)[log.fold] for log in logs]

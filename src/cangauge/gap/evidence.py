"""The evidence for each effect: one linear Gaussian model of all logs, references and diagnosed.

    residual = baseline·δθ + own·o + repairs·ρ + effect·a + error

δθ are the voltage model's coefficients, held by the information that its own logs gave; o is what
differs from log to log without a cause (`columns.OWN`), held by how much clean logs differ; ρ are
effects that clean logs show too; a is the effect in question, which only the diagnosed logs have.
All but a are integrated out. What is left is a quadratic form in a, for all candidates at once:

    ln evidence(a) = g·a − ½ a·S·a,    and with a ~ N(0, τ²) the Bayes factor against no effect.

The error is correlated in time, so n rows count as n/κ independent ones, with κ from the
references. How alike two effects look to these logs is the correlation in S.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from cangauge.gap.columns import OWN, Candidate, LogTerms

FloatArray = NDArray[np.float64]

PRIOR_SIGMAS = 2.0
"""Half the width of an amplitude's bounds is this many prior standard deviations."""

PIN = 0.01
"""How far the structure of clean logs may move with the diagnosed ones, in parts of its bounds."""

JITTER = 1e-10
"""Relative diagonal load: coefficients that no log moves stay where they are."""


@dataclass(frozen=True)
class ErrorModel:
    """How far residuals stray without a cause."""

    rmse_v: float
    """Of a reference log under a model that did not see it [V]."""
    rows_alike: float
    """κ: so many rows in a row tell as much as one."""
    own_std: tuple[float, ...]
    """Standard deviation, from log to log, of each of `columns.OWN`."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """The quadratic form of all candidates' amplitudes."""

    frame: Frame
    gradient: FloatArray
    """g, shape (all amplitudes,)."""
    curvature: FloatArray
    """S, shape (all amplitudes, all amplitudes)."""
    squares: float
    """Weighted sum of squares that is left without any effect."""
    mean: FloatArray
    """Solution without any effect: δθ (scaled), repairs, then what is each log's own."""
    per_amplitude: FloatArray
    """How that solution falls as an amplitude rises, shape (…, all amplitudes)."""
    precision: FloatArray
    """Of that solution, shape (…, …)."""

    def of(self, k: int) -> slice:
        """Return where candidate k's amplitudes are."""
        return slice(int(self.frame.first[k]), int(self.frame.first[k + 1]))


@dataclass(frozen=True, eq=False)
class Score:
    """One effect, at its best shape."""

    effect_id: str
    log_bayes_factor: float
    """Against no effect, averaged over the effect's shapes."""
    candidate: int
    """Index of the best shape's candidate."""
    amplitude: FloatArray
    """Most probable amplitudes beside the neutral ones, within bounds, shape (k,)."""
    covariance: FloatArray
    """Shape (k, k)."""
    explained: float
    """By how much the weighted sum of squares falls."""


@dataclass(frozen=True, eq=False)
class Gram:
    """Products of a log's columns with each other: all that linear models need of its rows.

    Columns: baseline (p), all candidates' amplitudes, own (`columns.OWN`), residual.
    """

    products: FloatArray
    rows: int

    def __add__(self, other: Gram) -> Gram:
        """Return the products over the rows of both."""
        return Gram(self.products + other.products, self.rows + other.rows)

    def weakened(self, factor: float) -> Gram:
        """Return the products as if the errors' variance were `factor` times larger."""
        return Gram(self.products / factor, self.rows)

    def __sub__(self, other: Gram) -> Gram:
        """Return the products over the rows that the other has not."""
        return Gram(self.products - other.products, self.rows - other.rows)


def gram_of(terms: LogTerms, scale: FloatArray, keep: NDArray[np.bool_] | None = None) -> Gram:
    """Return a log's products, baseline columns divided by `scale`; of some rows if asked."""
    columns = np.column_stack([terms.baseline / scale, *terms.effects, terms.own, terms.residual_v])
    if keep is not None:
        columns = columns[keep]
    return Gram(columns.T @ columns, columns.shape[0])


@dataclass(frozen=True, eq=False)
class Frame:
    """What all evidence of one diagnosis shares."""

    choices: tuple[Candidate, ...]
    prior_root: FloatArray | None
    """Square root of the coefficients' information, shape (p, p), in scaled columns."""
    scale: FloatArray
    """Scale of the baseline's columns, shape (p,)."""
    repairs: tuple[int, ...] = ()
    """Candidates that clean logs show too; all logs share their amplitudes."""

    @cached_property
    def first(self) -> NDArray[np.intp]:
        """Index of each candidate's first amplitude, one more than candidates."""
        widths = [len(choice.amplitudes) for choice in self.choices]
        return np.concatenate(([0], np.cumsum(widths))).astype(np.intp)

    def amplitudes_of(self, chosen: Sequence[int]) -> NDArray[np.intp]:
        """Return the indices of some candidates' amplitudes."""
        parts = [np.arange(self.first[k], self.first[k + 1]) for k in chosen]
        return np.concatenate([np.zeros(0, dtype=np.intp), *parts])

    def bounds_of(self, chosen: Sequence[int]) -> FloatArray:
        """Return the bounds of some candidates' amplitudes, shape (…, 2)."""
        return np.vstack([np.zeros((0, 2)), *(self.choices[k].bounds for k in chosen)])


def gather(
    frame: Frame, references: Sequence[Gram], diagnosed: Sequence[Gram], error: ErrorModel
) -> Evidence:
    """Integrate out everything but the effects.

    Parameters
    ----------
    frame : Frame
    references, diagnosed : sequence of Gram
        Logs without and with the effect in question.
    error : ErrorModel
    """
    weight = 1.0 / (error.rmse_v**2 * error.rows_alike)
    p, amplitudes = frame.scale.size, int(frame.first[-1])
    own = p + amplitudes + np.arange(len(OWN))
    residual = int(own[-1]) + 1
    effects = p + np.arange(amplitudes)
    shared = np.concatenate((np.arange(p), p + frame.amplitudes_of(frame.repairs)))
    logs = [*references, *diagnosed]
    size = shared.size + own.size * len(logs)
    precision, right = np.zeros((size, size)), np.zeros(size)
    cross = np.zeros((size, amplitudes))
    curvature, gradient, squares = np.zeros((amplitudes, amplitudes)), np.zeros(amplitudes), 0.0
    for number, log in enumerate(logs):
        products = weight * log.products
        columns = np.concatenate((shared, own))
        used = np.concatenate(
            (np.arange(shared.size), shared.size + own.size * number + np.arange(own.size))
        )
        precision[np.ix_(used, used)] += products[np.ix_(columns, columns)]
        right[used] += products[columns, residual]
        squares += float(products[residual, residual])
        if number >= len(references):
            cross[used] += products[np.ix_(columns, effects)]
            curvature += products[np.ix_(effects, effects)]
            gradient += products[effects, residual]
    _add_priors(precision, frame, error, weight)
    if references and diagnosed and frame.repairs:
        _pin_repairs(precision, right, frame, gather(frame, references, [], error).mean)
    solve = _solver(precision)
    mean, per_amplitude = solve(right), solve(cross)
    return Evidence(
        frame=frame,
        gradient=gradient - cross.T @ mean,
        curvature=curvature - cross.T @ per_amplitude,
        squares=squares - float(right @ mean),
        mean=mean,
        per_amplitude=per_amplitude,
        precision=precision,
    )


def _add_priors(precision: FloatArray, frame: Frame, error: ErrorModel, weight: float) -> None:
    p = frame.scale.size
    block = precision[:p, :p]
    if frame.prior_root is not None:
        block += weight * frame.prior_root.T @ frame.prior_root
    block[np.diag_indices(p)] += JITTER * np.trace(block) / p
    repairs = prior_precision(frame.bounds_of(frame.repairs))
    at = p + np.arange(repairs.shape[0])
    precision[np.ix_(at, at)] += repairs
    own = np.arange(p + at.size, precision.shape[0])
    logs = own.size // len(OWN)
    precision[own, own] += np.tile(np.array(error.own_std) ** -2.0, logs)


def _pin_repairs(precision: FloatArray, right: FloatArray, frame: Frame, clean: FloatArray) -> None:
    """Hold the structure of clean logs near what the references say of it.

    Else it would take up a cause of its own kind: cold logs would only teach what resistance does
    in the cold, and nothing would be left to attribute.
    """
    p = frame.scale.size
    bounds = frame.bounds_of(frame.repairs)
    at = p + np.arange(bounds.shape[0])
    pin = (PIN * (bounds[:, 1] - bounds[:, 0])) ** -2.0
    precision[at, at] += pin
    right[at] += pin * clean[at]


def _solver(precision: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return what solves precision·x = right, balanced by the diagonal."""
    scale = 1.0 / np.sqrt(np.diag(precision))
    factor = cho_factor(precision * scale * scale[:, None])

    def solve(right: FloatArray) -> FloatArray:
        balance = scale if right.ndim == 1 else scale[:, None]
        return np.asarray(balance * cho_solve(factor, balance * right))

    return solve


def condition_on(evidence: Evidence, given: Sequence[int]) -> Evidence:
    """Return the evidence once some candidates are in the model, their amplitudes left free."""
    taken = evidence.frame.amplitudes_of(given)
    block = evidence.curvature[np.ix_(taken, taken)]
    block = block + prior_precision(evidence.frame.bounds_of(given))
    gain = np.linalg.solve(block, evidence.curvature[taken]).T
    return replace(
        evidence,
        gradient=evidence.gradient - gain @ evidence.gradient[taken],
        curvature=evidence.curvature - gain @ evidence.curvature[taken],
        squares=evidence.squares
        - float(evidence.gradient[taken] @ np.linalg.solve(block, evidence.gradient[taken])),
    )


def scores(evidence: Evidence, leave_out: Sequence[str] = ()) -> list[Score]:
    """Return every effect's score, the best first.

    Parameters
    ----------
    evidence : Evidence
    leave_out : sequence of str
        Effects that are not asked for.
    """
    by_effect: dict[str, list[Score]] = {}
    for k, choice in enumerate(evidence.frame.choices):
        if choice.effect.id not in leave_out:
            by_effect.setdefault(choice.effect.id, []).append(_score(evidence, k))
    best = []
    for shapes in by_effect.values():
        factors = np.array([score.log_bayes_factor for score in shapes])
        top = shapes[int(np.argmax(factors))]
        mean = float(np.log(np.mean(np.exp(factors - factors.max()))) + factors.max())
        best.append(
            Score(top.effect_id, mean, top.candidate, top.amplitude, top.covariance, top.explained)
        )
    return sorted(best, key=lambda score: -score.log_bayes_factor)


def _score(evidence: Evidence, k: int) -> Score:
    at, choice = evidence.of(k), evidence.frame.choices[k]
    gradient, curvature = evidence.gradient[at], evidence.curvature[at, at]
    prior = prior_precision(choice.bounds)
    total = curvature + prior
    amplitude = np.clip(np.linalg.solve(total, gradient), choice.bounds[:, 0], choice.bounds[:, 1])
    occam = 0.5 * float(np.linalg.slogdet(np.linalg.solve(prior, total))[1])
    factor = float(gradient @ amplitude - 0.5 * amplitude @ total @ amplitude) - occam
    return Score(
        effect_id=choice.effect.id,
        log_bayes_factor=factor,
        candidate=k,
        amplitude=amplitude,
        covariance=np.asarray(np.linalg.inv(total), dtype=np.float64),
        explained=float(2.0 * gradient @ amplitude - amplitude @ curvature @ amplitude),
    )


def prior_precision(bounds: FloatArray) -> FloatArray:
    """Return the precision of amplitudes with these bounds, shape (k, k)."""
    return np.diag((2.0 * PRIOR_SIGMAS / (bounds[:, 1] - bounds[:, 0])) ** 2)

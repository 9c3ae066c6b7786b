"""The evidence for each effect: one linear Gaussian model of all logs, references and diagnosed.

    residual = baseline·δθ + own·o + repairs·ρ + effect·a + error

δθ are the voltage model's coefficients, held by the information that its own logs gave; o is what
differs from log to log without a cause (`Frame.own`), held by how much clean logs differ; ρ are
effects that clean logs show too; a is the effect in question, which only the diagnosed logs have.
All but a are integrated out. What is left is a quadratic form in a, for all candidates at once:

    ln evidence(a) = g·a − ½ a·S·a,    and with a ~ N(0, τ²) the Bayes factor against no effect.

The error is correlated in time, so rows are weighed scale by scale (`scales`), each scale by the
error that the references show there. How alike two effects look to these logs is the correlation
in S.

The most probable coefficients, structure and amplitudes that physics allows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from cangauge._typing import FloatArray
from cangauge.diagnosis.design_matrix import DesignMatrix
from cangauge.diagnosis.hypotheses import Frame
from cangauge.errors import InputError
from cangauge.inference.least_squares import nearest_rising
from cangauge.inference.linearized import SLOPE_CHECKS
from cangauge.inference.time_scales import haar_transform
from cangauge.model.voltage_model import BASIS_NAMES, SLOPE_AT_LEAST, VoltageModel, ocv_basis_slope

# --- The evidence for each effect: one linear Gaussian model of all logs, references and dia…

PRIOR_SIGMAS = 2.0
"""Half the width of an amplitude's bounds is this many prior standard deviations."""

PIN = 0.1
"""How far the structure of clean logs may move with the diagnosed ones, in parts of its bounds."""

JITTER = 1e-10
"""Relative diagonal load: coefficients that no log moves stay where they are."""


@dataclass(frozen=True)
class ErrorModel:
    """How far residuals stray without a cause."""

    scale_v2: tuple[float, ...]
    """Variance of the coefficients of each scale (`scales.haar_transform`) [V²]."""
    own_std: tuple[float, ...]
    """Standard deviation, from log to log, of what is each log's own (`Frame.own_prior`)."""
    rmse_v: float
    """Root mean square error of a row, what is each log's own apart [V]."""
    strays: Mapping[str, float] = field(default_factory=dict)
    """By how much the squared evidence for each effect exceeds, on references left out, what
    chance alone would give; 1 where it is not listed."""
    clean_v2: float = 0.0
    """Mean square of what references left out keep, their own terms not taken off [V²]."""
    trust: float = 1.0
    """Weight of the information that the model file brings: less than 1 where the references
    contradict it."""
    structure: Mapping[str, float] = field(default_factory=dict)
    """How much of its physical range the structure of each effect may take (`Frame.repairs`); 1
    where it is not listed."""

    @property
    def lasting_v2(self) -> float:
        """Variance per row of an error that does not average out [V²]."""
        return self.scale_v2[-1]


@dataclass(frozen=True, eq=False)
class Evidence:
    """The quadratic form of all candidates' amplitudes."""

    frame: Frame
    error: ErrorModel
    gradient: FloatArray
    """g, shape (all amplitudes,)."""
    curvature: FloatArray
    """S, shape (all amplitudes, all amplitudes)."""
    squares: float
    """Weighted sum of squares that is left without any effect."""
    mean: FloatArray
    """Solution without any effect: δθ (scaled), repairs."""
    per_amplitude: FloatArray
    """How that solution falls as an amplitude rises, shape (…, all amplitudes)."""
    precision: FloatArray
    """Of that solution, shape (…, …)."""

    def of(self, k: int) -> slice:
        """Return where candidate k's amplitudes are."""
        return slice(int(self.frame.first[k]), int(self.frame.first[k + 1]))


@dataclass(frozen=True, eq=False)
class Gram:
    """Products of a log's columns with each other: all that linear models need of its rows.

    Columns: baseline (p), amplitudes (of all candidates; of a reference: of the repairs, then of
    what is each log's own), `columns.LEVELS`, residual; `Frame.diagnosed` and `Frame.reference`
    tell where.
    """

    products: FloatArray
    """One matrix a scale, shape (SCALES, columns, columns)."""
    counts: FloatArray
    """Coefficients of each scale, shape (SCALES,); fewer, if rows count less."""

    def weakened(self, factor: float) -> Gram:
        """Return the products as if the errors' variance were `factor` times larger."""
        return Gram(self.products / factor, self.counts)

    def weighed(self, error: ErrorModel) -> FloatArray:
        """Return the products, each scale by the inverse of its variance, summed [-]."""
        return np.asarray(np.tensordot(1.0 / np.array(error.scale_v2), self.products, axes=1))


def gram_of(terms: DesignMatrix, scale: FloatArray, weight: FloatArray | None = None) -> Gram:
    """Return a log's products, baseline columns divided by `scale`.

    Parameters
    ----------
    terms : DesignMatrix
    scale : array of shape (p,)
    weight : array of shape (m,), optional
        Weight of each row: one of a half counts as one whose error is twice as large. Rows of
        weight 0 are as if they had not been recorded.
    """
    columns = np.column_stack([terms.baseline / scale, *terms.effects, terms.own, terms.residual_v])
    part = 1.0
    if weight is not None:
        keep = weight > 0.0
        columns = columns[keep] * weight[keep, None]
        part = float(np.mean(weight[keep] ** 2))
    parts = haar_transform(columns)
    return Gram(
        np.stack([each.T @ each for each in parts]),
        part * np.array([float(len(each)) for each in parts]),
    )


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
    amplitudes, shared = int(frame.first[-1]), frame.reference.shared.size
    effects = shared + np.arange(amplitudes)
    precision, right = np.zeros((shared, shared)), np.zeros(shared)
    cross = np.zeros((shared, amplitudes))
    curvature, gradient, squares = np.zeros((amplitudes, amplitudes)), np.zeros(amplitudes), 0.0
    for log in references:
        products, _, _ = without_own(log, frame, error, is_reference=True)
        precision += products[:shared, :shared]
        right += products[:shared, -1]
        squares += float(products[-1, -1])
    for log in diagnosed:
        products, _, _ = without_own(log, frame, error, is_reference=False)
        precision += products[:shared, :shared]
        right += products[:shared, -1]
        squares += float(products[-1, -1])
        cross += products[np.ix_(np.arange(shared), effects)]
        curvature += products[np.ix_(effects, effects)]
        gradient += products[effects, -1]
    squares += _add_priors(precision, right, frame, error)
    if references and diagnosed and frame.repairs:
        clean = gather(frame, references, [], error).mean
        squares += _pin_repairs(precision, right, frame, clean)
    solve = _solver(precision)
    mean, per_amplitude = solve(right), solve(cross)
    return Evidence(
        frame=frame,
        error=error,
        gradient=gradient - cross.T @ mean,
        curvature=curvature - cross.T @ per_amplitude,
        squares=squares - float(right @ mean),
        mean=mean,
        per_amplitude=per_amplitude,
        precision=precision,
    )


def without_own(
    log: Gram, frame: Frame, error: ErrorModel, *, is_reference: bool
) -> tuple[FloatArray, FloatArray, float]:
    """Integrate out what is a log's own.

    Returns
    -------
    products : array
        Weighed products of the shared columns, all amplitudes' (not of a reference), residual.
    own : array
        By how much the log's own amplitudes follow each of these, shape (own, …).
    volume : float
        ln det of their precision over that of their prior.
    """
    weighed = log.weighed(error)
    layout = frame.reference if is_reference else frame.diagnosed
    own = layout.own
    kept = np.concatenate((layout.shared, layout.effects, [layout.residual]))
    # In units of how much logs differ, so that the prior is 1.
    std = np.array(error.own_std)
    block = weighed[np.ix_(own, own)] * std * std[:, None]
    block[np.diag_indices(own.size)] += 1.0
    toward = std[:, None] * weighed[np.ix_(own, kept)]
    factor = cho_factor(block)
    follows = cho_solve(factor, toward)
    volume = 2.0 * float(np.sum(np.log(np.diag(factor[0]))))
    return weighed[np.ix_(kept, kept)] - toward.T @ follows, std[:, None] * follows, volume


def log_likelihood(frame: Frame, references: Sequence[Gram], error: ErrorModel) -> float:
    """Return ln of the probability of some references, but for what no error model changes.

    Parameters
    ----------
    frame : Frame
    references : sequence of Gram
    error : ErrorModel
    """
    shared = frame.reference.shared.size
    precision, right, squares = np.zeros((shared, shared)), np.zeros(shared), 0.0
    volume = 0.0
    for log in references:
        products, _, own_volume = without_own(log, frame, error, is_reference=True)
        precision += products[:shared, :shared]
        right += products[:shared, -1]
        squares += float(products[-1, -1])
        volume += own_volume + float(log.counts @ np.log(error.scale_v2))
    squares += _add_priors(precision, right, frame, error)
    volume -= float(np.sum(np.log(structure_precision(frame, error))))
    return log_integral(precision, right) - 0.5 * (squares + volume)


def _add_priors(precision: FloatArray, right: FloatArray, frame: Frame, error: ErrorModel) -> float:
    """Add the priors (in place); return the square of what they are centred at."""
    squares = 0.0
    p = frame.scale.size
    block = precision[:p, :p]
    if frame.prior_root is not None:
        information = information_of(frame, error)
        block += information
        if frame.centre is not None:
            right[:p] += information @ frame.centre
            squares = float(frame.centre @ information @ frame.centre)
    block[np.diag_indices(p)] += JITTER * np.trace(block) / p
    repairs = structure_precision(frame, error)
    at = p + np.arange(repairs.size)
    precision[at, at] += repairs
    return squares


def structure_precision(frame: Frame, error: ErrorModel) -> FloatArray:
    """Return the precision with which each of the repairs' amplitudes is held at none."""
    repairs = [frame.choices[k] for k in frame.repairs]
    levels = [error.structure.get(item.effect.id, 1.0) for item in repairs for _ in item.amplitudes]
    prior = np.diag(prior_precision(frame.bounds_of(frame.repairs)))
    return np.asarray(prior / np.array(levels) ** 2)


def information_of(frame: Frame, error: ErrorModel) -> FloatArray:
    """Return the precision with which the model file holds the scaled coefficients, (p, p)."""
    if frame.prior_root is None:
        return np.zeros((frame.scale.size, frame.scale.size))
    return np.asarray(error.trust * frame.prior_root.T @ frame.prior_root / error.lasting_v2)


def _pin_repairs(
    precision: FloatArray, right: FloatArray, frame: Frame, clean: FloatArray
) -> float:
    """Hold the structure of clean logs near what the references say of it.

    Else it would take up a cause of its own kind: cold logs would only teach what resistance does
    in the cold, and nothing would be left to attribute. Returns the square of the pins' centre.
    """
    p = frame.scale.size
    bounds = frame.bounds_of(frame.repairs)
    at = p + np.arange(bounds.shape[0])
    pin = (PIN * (bounds[:, 1] - bounds[:, 0])) ** -2.0
    precision[at, at] += pin
    right[at] += pin * clean[at]
    return float(np.sum(pin * clean[at] ** 2))


def _solver(precision: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return what solves precision·x = right, balanced by the diagonal."""
    scale = 1.0 / np.sqrt(np.diag(precision))
    factor = cho_factor(precision * scale * scale[:, None])

    def solve(right: FloatArray) -> FloatArray:
        balance = scale if right.ndim == 1 else scale[:, None]
        return np.asarray(balance * cho_solve(factor, balance * right))

    return solve


def log_integral(precision: FloatArray, right: FloatArray) -> float:
    """Return ln of the integral over x of exp(right·x − ½ x·precision·x), but for the 2π.

    Parameters
    ----------
    precision : array, shape (n, n)
        Positive definite.
    right : array, shape (n,)
    """
    balance = 1.0 / np.sqrt(np.diag(precision))
    root = np.linalg.cholesky(precision * balance * balance[:, None])
    gained = solve_triangular(root, balance * right, lower=True, check_finite=False)
    volume = np.sum(np.log(np.diag(root))) - np.sum(np.log(balance))
    return float(0.5 * gained @ gained - volume)


def prior_precision(bounds: FloatArray) -> FloatArray:
    """Return the precision of amplitudes with these bounds, shape (k, k)."""
    return np.diag((2.0 * PRIOR_SIGMAS / (bounds[:, 1] - bounds[:, 0])) ** 2)


# --- The most probable coefficients, structure and amplitudes that physics allows


def within_bounds(
    evidence: Evidence, model: VoltageModel, chosen: Sequence[int]
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the most probable coefficients, structure and amplitudes that physics allows.

    One convex problem for all of them, so that what a bound takes from one goes to the others:
    the pseudo-OCV rises over the identified SoC, and structure and effects keep their bounds.

    Parameters
    ----------
    evidence : Evidence
    model : VoltageModel
        That the evidence starts from.
    chosen : sequence of int
        Candidates to be in the model.

    Returns
    -------
    solution : array
        δθ [V, V/K, Ω], then the amplitudes of `frame.repairs`.
    amplitudes : list of arrays
        Of each accepted effect, beside the neutral values.
    """
    frame = evidence.frame
    p, n = frame.scale.size, len(BASIS_NAMES)
    at = frame.amplitudes_of(chosen)
    limits = np.vstack([frame.bounds_of(frame.repairs), frame.bounds_of(chosen)])
    first, size = evidence.precision.shape[0], evidence.precision.shape[0] + at.size
    curvature = evidence.curvature[np.ix_(at, at)] + prior_precision(frame.bounds_of(chosen))
    upper = _root(evidence.precision)
    root, target = np.zeros((size, size)), np.zeros(size)
    root[:first, :first] = upper
    root[:first, first:] = upper @ evidence.per_amplitude[:, at]
    target[:first] = upper @ evidence.mean
    if at.size:
        lower = _root(curvature)
        root[first:, first:] = lower
        target[first:] = lower @ np.linalg.solve(curvature, evidence.gradient[at])
    slopes = ocv_basis_slope(np.linspace(*model.soc_range_pct, SLOPE_CHECKS), model.epsilon)
    rising = np.zeros((SLOPE_CHECKS, size))
    rising[:, :n] = slopes / frame.scale[:n]
    needed = SLOPE_AT_LEAST * model.pseudo_ocv_at(50.0)[0] - slopes @ np.array(model.ocv_v)
    repairs = p + np.arange(limits.shape[0] - at.size)
    bounded = np.concatenate((repairs, first + np.arange(at.size)))
    kept = np.zeros((bounded.size, size))
    kept[np.arange(bounded.size), bounded] = 1.0
    found = nearest_rising(
        root,
        target,
        np.vstack([rising, kept, -kept]),
        np.concatenate((needed, limits[:, 0], -limits[:, 1])),
    )
    solution = found[: p + repairs.size].copy()
    solution[:p] /= frame.scale
    amplitudes, begin = [], first
    for k in chosen:
        end = begin + len(frame.choices[k].amplitudes)
        amplitudes.append(found[begin:end])
        begin = end
    return solution, amplitudes


def _root(matrix: FloatArray) -> FloatArray:
    """Return the upper root R of a positive matrix, RᵀR, balanced by its diagonal."""
    scale = np.sqrt(np.diag(matrix))
    return np.asarray(np.linalg.cholesky(matrix / scale / scale[:, None]).T * scale)


def moved(model: VoltageModel, change: FloatArray) -> VoltageModel | None:
    """Return the model with its coefficients moved; None if its pseudo-OCV would not rise."""
    try:
        return model.with_coefficients(model.coefficients + change)
    except InputError:
        return None

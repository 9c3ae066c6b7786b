"""Error model of healthy logs, estimated from the references.

Each reference is left out in turn and predicted from the others and the model file; the residual
gives the error variance at each time scale and the size of the per-log effects. With fewer than two
references the model file's noise is used.

Prior scales of the shared structure and of the per-log effects maximise the marginal likelihood of
the references (automatic relevance determination: MacKay, Neural Computation 4 (1992) 415).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.diagnosis.bayes_factors import excess_chi_square, mean_square_v2
from cangauge.diagnosis.design_matrix import PER_LOG_STATES
from cangauge.diagnosis.hypotheses import Hypotheses, prior_precision
from cangauge.diagnosis.linear_gaussian import (
    ErrorModel,
    NormalEquations,
    SharedEquations,
    each_left_out,
    inverse,
    log_gaussian_integral,
    log_likelihood,
    marginalize,
    prior_information,
    structure_precision,
)
from cangauge.inference.time_scales import scale_variances
from cangauge.model.model_file import ModelNoise

EM_ROUNDS = 4
"""Rounds of expectation maximisation."""

STATED_LOGS = 0.05
"""Number of reference logs that the model file's noise counts as. It comes from logs held out of
fits to few logs, so it may be many times too large."""

AGREEING_COEFFICIENTS = 2.0
"""Coefficients assumed to agree with the model file, in addition to those compared."""

INFORMATION_WEIGHTS: tuple[float, ...] = tuple(np.logspace(-7.0, 0.0, 29).tolist())
"""Candidate weights of the model file's information."""

FEW_REFERENCES = 2.0
"""A mean of n squares is assumed to be too low by the factor 1 + this / n."""

LEAST_VARIANCE = 1e-4
"""Smallest variance of a scale relative to the largest."""

STRUCTURE_ROUNDS = 2
"""Passes over the structure effects."""

STRUCTURE_SCALES: tuple[float, ...] = (0.001, 0.03, 0.1, 0.3, 1.0)
"""Candidate prior scales of a structure effect, in parts of its physical range."""

PER_LOG_SCALES: tuple[float, ...] = (0.001, *np.logspace(-1.75, -0.5, 6).tolist())
"""Candidate factors on the prior of all per-log effects at once. None is above 1: all effects
together can mimic nearly any error of the model, and would hide every cause. Overdispersion covers
larger differences."""

PER_LOG_SCALE_STD = 1.0
"""Prior standard deviation of that factor's logarithm."""

PER_EFFECT_SCALES: tuple[float, ...] = (0.3, 2.0, 4.0)
PER_EFFECT_SCALE_STD = 1.0
"""Candidate factors on the prior of one per-log effect, and the prior standard deviation of their
logarithm."""


def error_from_noise(noise: ModelNoise, rate_hz: float, hypotheses: Hypotheses) -> ErrorModel:
    """Return the error model that a model file states, used without references."""
    slow_v2, fast_v2 = noise.slow_std_v**2, noise.fast_std_v**2
    total_v2 = max(slow_v2 + fast_v2, 1e-12)
    variance = scale_variances(
        fast_v2, noise.fast_time_s * rate_hz, slow_v2, noise.slow_time_s * rate_hz
    )
    return ErrorModel(
        scale_v2=_positive(variance),
        per_log_std=tuple(hypotheses.per_log_prior_std.tolist()),
        rmse_v=float(np.sqrt(total_v2)),
    )


def error_from_references(
    hypotheses: Hypotheses,
    references: Sequence[NormalEquations],
    stated: ErrorModel,
    least_weight: float = 0.0,
) -> ErrorModel:
    """Return the error model under which each reference is most probable, given the others.

    Alternates expectation maximisation of the variances with the choice of the information weight
    and the prior scales, then chooses a scale for each per-log effect. Structure and per-log
    effects start near zero and grow only where the references need them.

    Parameters
    ----------
    hypotheses : Hypotheses
    references : sequence of NormalEquations
        At least two.
    stated : ErrorModel
        Of the model file; its variances count as `STATED_LOGS` logs.
    least_weight : float
        Lower limit of the model file's information weight.
    """
    usual = np.array(stated.per_log_std)
    effects = dict.fromkeys(hypotheses.candidates[k].effect.id for k in hypotheses.structure)
    error = replace(
        stated,
        structure=dict.fromkeys(effects, STRUCTURE_SCALES[0]),
        per_log_std=tuple((PER_LOG_SCALES[0] * usual).tolist()),
    )

    def weight() -> float:
        return _information_weight(hypotheses, references, error, least_weight)

    # The information weight comes first: with overconfident information, a deviation common to all
    # references would be attributed to differences between logs.
    error = replace(error, information_weight=weight())
    stated_v2 = np.array(stated.scale_v2)
    counts = np.sum([log.counts for log in references], axis=0)
    stated_counts = STATED_LOGS * counts / len(references) + 1e-9
    for _ in range(EM_ROUNDS):
        squares = [
            _left_out_squares_v2(hypotheses, log, others, error)
            for log, others in zip(
                references, each_left_out(hypotheses, references, error), strict=True
            )
        ]
        variance = (np.sum(squares, axis=0) + stated_counts * stated_v2) / (counts + stated_counts)
        error = replace(
            error,
            scale_v2=_positive(variance),
            rmse_v=float(np.sqrt(np.sum(counts * variance) / np.sum(counts))),
        )
        error = replace(error, information_weight=weight())
        error = replace(error, structure=_structure_scales(hypotheses, references, error))
        error = replace(error, per_log_std=_common_per_log(hypotheses, references, error, usual))
    return replace(error, per_log_std=_per_log_by_effect(hypotheses, references, error))


@dataclass(frozen=True, eq=False)
class HealthyEvidence:
    """Evidence for each effect on each of n references, diagnosed with the others."""

    ratios: dict[str, FloatArray]
    """Squared evidence relative to that expected by chance, by effect, shape (n,)."""
    mean_squares_v2: FloatArray
    """Mean square error, per-log effects included, shape (n,) [V²]."""
    excess: tuple[float, ...]
    """Excess chi-square of each (`bayes_factors.excess_chi_square`)."""


def healthy_evidence(
    hypotheses: Hypotheses,
    references: Sequence[NormalEquations],
    error: ErrorModel,
    diagnosed: Sequence[NormalEquations],
    further: SharedEquations | None = None,
) -> HealthyEvidence:
    """Return the evidence for each effect on references, which have none.

    Parameters
    ----------
    hypotheses : Hypotheses
    references : sequence of NormalEquations
        At least two.
    error : ErrorModel
        From `error_from_references`.
    diagnosed : sequence of NormalEquations
        The same references as they count when diagnosed.
    further : SharedEquations, optional
        Of references that are not diagnosed.
    """
    columns = hypotheses.reference_columns
    size = len(hypotheses.structure)
    subset = replace(
        hypotheses,
        candidates=tuple(hypotheses.candidates[k] for k in columns),
        structure=tuple(range(size)),
        per_log=tuple(range(size, len(columns))),
    )
    ratios: dict[str, list[float]] = {}
    mean_squares, excess = [], []
    all_others = each_left_out(subset, references, error, further)
    for log, others in zip(diagnosed, all_others, strict=True):
        posterior = marginalize(subset, others, [log], error)
        without = marginalize(subset, others, [], error)
        mean_squares.append(mean_square_v2(subset, log, without.mean))
        excess.append(excess_chi_square(posterior, [log], without.chi_square))
        for k, candidate in enumerate(subset.candidates):
            at = posterior.slice_of(k)
            curvature, gradient = posterior.curvature[at, at], posterior.gradient[at]
            total = curvature + 1e-6 * prior_precision(candidate.bounds)
            chance = float(np.trace(np.linalg.solve(total, curvature)))
            square = float(gradient @ np.linalg.solve(total, gradient))
            ratios.setdefault(candidate.effect.id, []).append(square / max(chance, 1e-9))
    # All shapes of the first reference, then of the next.
    shape = (len(references), -1)
    by_effect = {name: np.reshape(seen, shape).mean(axis=1) for name, seen in ratios.items()}
    return HealthyEvidence(by_effect, np.array(mean_squares), tuple(excess))


def with_overdispersion(
    error: ErrorModel, healthy: HealthyEvidence, weights: Sequence[float]
) -> ErrorModel:
    """Return the error model with the overdispersion of each effect's evidence.

    Structure that the model lacks resembles an effect, more on one day than on another. The mean of
    an effect's squared evidence on references, relative to that expected by chance, divides the
    effect's evidence (quasi-likelihood: McCullagh, Nelder, Generalized Linear Models, 2nd ed. 1989,
    ch. 9).

    Parameters
    ----------
    error : ErrorModel
    healthy : HealthyEvidence
    weights : sequence of float
        Weight of each reference.
    """
    weight = np.array(weights)
    few = 1.0 + FEW_REFERENCES / float(weight.sum())
    overdispersion = {
        name: max(1.0, few * float(np.average(each, weights=weight)))
        for name, each in healthy.ratios.items()
    }
    # A model with some errors has others too. The median, since a large deviation of one effect is
    # no evidence on another.
    usual = float(np.median([*overdispersion.values()]))
    return replace(
        error,
        overdispersion={name: max(value, usual) for name, value in overdispersion.items()},
        reference_v2=float(np.average(healthy.mean_squares_v2, weights=weight)),
        reference_excess=healthy.excess,
    )


def _information_weight(
    hypotheses: Hypotheses,
    references: Sequence[NormalEquations],
    error: ErrorModel,
    least: float,
) -> float:
    """Return the most probable weight of the model file's information.

    If the references' coefficients deviate ten times as far as the file's standard errors allow,
    its information gets a weight of about a hundredth.
    """
    p = hypotheses.column_scale.size
    if hypotheses.prior_root is None:
        return 1.0
    found = marginalize(hypotheses, references, [], error)
    right = found.precision @ found.mean
    information = prior_information(hypotheses, replace(error, information_weight=1.0))
    mean = np.zeros(p) if hypotheses.prior_mean is None else hypotheses.prior_mean
    # The structure does not depend on the weight: it is integrated out once.
    known = np.linalg.solve(found.precision[p:, p:], found.precision[p:, :p])
    coefficients = found.precision[:p, :p] - found.precision[:p, p:] @ known
    toward_them = right[:p] - known.T @ right[p:]

    def log_probability(weight: float) -> float:
        more = (weight - error.information_weight) * information
        agreed = AGREEING_COEFFICIENTS * (np.log(weight) - weight)
        prior = p * np.log(weight) - weight * mean @ information @ mean
        integral = log_gaussian_integral(coefficients + more, toward_them + more @ mean)
        return integral + 0.5 * float(prior + agreed)

    return max((weight for weight in INFORMATION_WEIGHTS if weight >= least), key=log_probability)


def _structure_scales(
    hypotheses: Hypotheses, references: Sequence[NormalEquations], error: ErrorModel
) -> dict[str, float]:
    """Return the most probable prior scale of each structure effect.

    First one scale for all, then that of each given the others: a scale that one effect needs would
    leave the others unconstrained at operating points without references.
    """
    effects = list(error.structure)
    if not effects:
        return {}
    found = marginalize(hypotheses, references, [], error)
    right = found.precision @ found.mean
    names, unit = hypotheses.structure_prior
    places = {effect: np.flatnonzero([name == effect for name in names]) for effect in effects}
    at = hypotheses.column_scale.size + np.arange(unit.size)
    without = found.precision.copy()
    without[at, at] -= structure_precision(hypotheses, error)

    def with_scales(scales: Mapping[str, float]) -> FloatArray:
        precision = without.copy()
        precision[at, at] += structure_precision(hypotheses, replace(error, structure=scales))
        return precision

    def together(scale: float) -> float:
        integral = log_gaussian_integral(with_scales(dict.fromkeys(effects, scale)), right)
        return integral - unit.size * math.log(scale)

    scales = dict.fromkeys(effects, max(STRUCTURE_SCALES, key=together))
    covariance = inverse(with_scales(scales))
    for _ in range(STRUCTURE_ROUNDS):
        before = dict(scales)
        for effect in effects:
            place = at[places[effect]]
            best = _best_scale(covariance, right, place, unit[places[effect]], scales[effect])
            if best != scales[effect]:
                scales[effect] = best
                covariance = inverse(with_scales(scales))
        if scales == before:
            break
    return scales


def _best_scale(
    covariance: FloatArray,
    right: FloatArray,
    at: NDArray[np.intp],
    unit: FloatArray,
    current: float,
) -> float:
    """Return the most probable prior scale of the amplitudes at some places of a solution.

    All other amplitudes are integrated out once for all scales. `unit` is the prior precision at
    scale 1; the covariance holds for the current scale, which stays where none is better.
    """
    marginal = inverse(covariance[np.ix_(at, at)])
    toward = marginal @ (covariance[at] @ right)

    def log_probability(scale: float) -> float:
        precision = marginal + np.diag(unit * (scale**-2 - current**-2))
        return log_gaussian_integral(precision, toward) - unit.size * math.log(scale)

    return max((current, *STRUCTURE_SCALES), key=log_probability)


def _common_per_log(
    hypotheses: Hypotheses,
    references: Sequence[NormalEquations],
    error: ErrorModel,
    usual: FloatArray,
) -> tuple[float, ...]:
    """Return the per-log standard deviations with the most probable common factor."""

    def log_probability(scale: float) -> float:
        trial = replace(error, per_log_std=tuple((scale * usual).tolist()))
        prior = -0.5 * (np.log(scale) / PER_LOG_SCALE_STD) ** 2
        return log_likelihood(hypotheses, references, trial) + float(prior)

    return tuple((max(PER_LOG_SCALES, key=log_probability) * usual).tolist())


def _per_log_by_effect(
    hypotheses: Hypotheses, references: Sequence[NormalEquations], error: ErrorModel
) -> tuple[float, ...]:
    """Return the per-log standard deviations with the most probable factor of each effect."""
    std = np.array(error.per_log_std)
    best = log_likelihood(hypotheses, references, error)
    for at in _per_log_groups(hypotheses):
        current = std.copy()
        for scale in PER_EFFECT_SCALES:
            trial = std.copy()
            trial[at] *= scale
            changed = replace(error, per_log_std=tuple(trial.tolist()))
            prior = -0.5 * float(np.log(scale) / PER_EFFECT_SCALE_STD) ** 2
            probability = log_likelihood(hypotheses, references, changed) + prior
            if probability > best:
                best, current = probability, trial
        std = current
    return tuple(std.tolist())


def _per_log_groups(hypotheses: Hypotheses) -> list[NDArray[np.intp]]:
    """Return the per-log amplitudes of each effect, and of each of `PER_LOG_STATES`."""
    by_effect: dict[str, list[int]] = {}
    at = 0
    for k in hypotheses.per_log:
        candidate = hypotheses.candidates[k]
        group = by_effect.setdefault(candidate.effect.id, [])
        group += range(at, at + len(candidate.amplitudes))
        at += len(candidate.amplitudes)
    groups = [*by_effect.values(), *([at + k] for k in range(len(PER_LOG_STATES)))]
    return [np.array(group, dtype=np.intp) for group in groups]


def _left_out_squares_v2(
    hypotheses: Hypotheses,
    log: NormalEquations,
    rest: SharedEquations,
    error: ErrorModel,
) -> FloatArray:
    """Return the expected squared errors of one reference given the rest, shape (SCALES,)."""
    others = marginalize(hypotheses, rest, [], error)
    shared, per_log = others.mean.size, hypotheses.reference_layout.per_log
    prior = np.zeros((shared + per_log.size, shared + per_log.size))
    prior[:shared, :shared] = others.precision
    prior[per_log, per_log] = np.array(error.per_log_std) ** -2.0
    weighted = log.weighted(error)
    centre = np.concatenate((others.mean, np.zeros(per_log.size)))
    precision = prior + weighted[:-1, :-1]
    covariance = inverse(precision)
    mean = covariance @ (prior @ centre + weighted[:-1, -1])
    weights = np.append(-mean, 1.0)
    squares = (log.products @ weights) @ weights
    squares += np.tensordot(log.products[:, :-1, :-1], covariance, axes=2)
    return np.asarray(np.maximum(squares, 0.0))


def _positive(variance: FloatArray) -> tuple[float, ...]:
    least = max(LEAST_VARIANCE * float(variance.max()), 1e-12)
    return tuple(np.maximum(variance, least).tolist())

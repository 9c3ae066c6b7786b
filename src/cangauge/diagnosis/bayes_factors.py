"""Bayes factor of every effect against no effect, and the error that remains with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr, logsumexp

from cangauge._typing import FloatArray
from cangauge.diagnosis.hypotheses import Hypotheses, prior_precision
from cangauge.diagnosis.linear_gaussian import NormalEquations, Posterior
from cangauge.inference.time_scales import SCALES

PRIOR_WIDTHS = (1.0, 0.3, 0.1, 0.03)
"""Equally probable widths of the amplitude prior, relative to that of the bounds: an effect may be
as large as its bounds or much smaller."""

NOISE_VARIATION = 0.2
"""Part by which the error variance differs between healthy logs."""


@dataclass(frozen=True, eq=False)
class Score:
    """One effect at its best shape."""

    effect_id: str
    log_bayes_factor: float
    """Against no effect, averaged over the effect's shapes."""
    candidates: tuple[int, ...]
    """Candidate of the best shape, or two whose mixture is better than either."""
    amplitude: FloatArray
    """Most probable amplitudes relative to neutral, within bounds, shape (k,)."""
    covariance: FloatArray
    """Shape (k, k)."""
    explained: float
    """Decrease of the weighted sum of squares."""


def scores(posterior: Posterior, leave_out: Sequence[str] = ()) -> list[Score]:
    """Score every effect that can be a cause, best first.

    Parameters
    ----------
    posterior : Posterior
    leave_out : sequence of str
        Effects to skip.
    """
    hypotheses = posterior.hypotheses
    by_effect: dict[str, list[Score]] = {}
    for group in hypotheses.shapes.values():
        kept = [each for each in group if _is_tested(hypotheses, each, leave_out)]
        for score in _scores_of(posterior, kept):
            by_effect.setdefault(score.effect_id, []).append(score)
    best = []
    for shapes in by_effect.values():
        top = max(shapes, key=lambda score: score.log_bayes_factor)
        mean = _log_mean([score.log_bayes_factor for score in shapes])
        best.append(replace(top, log_bayes_factor=mean))
    return sorted(best, key=lambda score: -score.log_bayes_factor)


def _is_tested(hypotheses: Hypotheses, chosen: Sequence[int], leave_out: Sequence[str]) -> bool:
    effect = hypotheses.candidates[chosen[0]].effect
    return effect.is_cause and effect.id not in leave_out


def _scores_of(posterior: Posterior, group: Sequence[tuple[int, ...]]) -> list[Score]:
    """Score candidates or mixtures of two, all with as many amplitudes.

    A mixture that the bounds exclude has no score: one of the two alone is the best within bounds.
    """
    if not group:
        return []
    hypotheses = posterior.hypotheses
    at = np.stack([hypotheses.amplitudes_of(chosen) for chosen in group])
    bounds = np.stack([hypotheses.bounds_of(chosen) for chosen in group])
    names = [hypotheses.candidates[chosen[0]].effect.id for chosen in group]
    overdispersion = np.array([posterior.error.overdispersion_of(name) for name in names])
    gradient = posterior.gradient[at] / overdispersion[:, None]
    curvature = posterior.curvature[at[:, :, None], at[:, None, :]] / overdispersion[:, None, None]
    prior = np.array([prior_precision(each) for each in bounds])
    widths = np.array(PRIOR_WIDTHS)[:, None, None]
    factors, modes, covariances = bounded_evidence(
        gradient[:, None, None],
        curvature[:, None],
        prior[:, None] / widths**2,
        bounds[:, None],
    )
    amplitude = modes[:, 0, 0]
    within = np.clip(amplitude, bounds[..., 0], bounds[..., 1])
    factor = logsumexp(factors[..., 0], axis=1) - np.log(len(PRIOR_WIDTHS))
    explained = np.sum(
        within * (2.0 * gradient - np.einsum("gij,gj->gi", curvature, within)), axis=1
    )
    return [
        Score(
            effect_id=names[k],
            log_bayes_factor=float(factor[k]),
            candidates=chosen,
            amplitude=within[k],
            covariance=covariances[k, 0],
            explained=float(overdispersion[k] * explained[k]),
        )
        for k, chosen in enumerate(group)
        if len(chosen) == 1 or np.all(within[k] == amplitude[k])
    ]


def normal_evidence(
    gradient: FloatArray, curvature: FloatArray, prior: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return ln of the Bayes factor of unbounded amplitudes against none, and their posterior.

    Parameters
    ----------
    gradient : array of shape (…, n, k)
        Of the log likelihood without amplitudes.
    curvature, prior : array of shape (…, k, k)
        Of the log likelihood, and prior precision.

    Returns
    -------
    log_bayes : array of shape (…, n)
    mode : array of shape (…, n, k)
    covariance : array of shape (…, k, k)
    """
    total = curvature + prior
    covariance = np.asarray(np.linalg.inv(total), dtype=np.float64)
    mode = gradient @ covariance
    occam = 0.5 * (np.linalg.slogdet(total)[1] - np.linalg.slogdet(prior)[1])
    return 0.5 * np.sum(gradient * mode, axis=-1) - occam[..., None], mode, covariance


def bounded_evidence(
    gradient: FloatArray, curvature: FloatArray, prior: FloatArray, bounds: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the same for amplitudes within bounds, shape (…, k, 2).

    The integral over one amplitude is bounded, as is its prior. Over two it is that of a normal
    distribution, since mixtures whose mode is out of bounds are left out.
    """
    log_bayes, mode, covariance = normal_evidence(gradient, curvature, prior)
    if bounds.shape[-2] == 1:
        log_bayes += _log_mass((bounds - mode) * np.sqrt(curvature + prior))
        log_bayes -= _log_mass(bounds * np.sqrt(prior))
    return log_bayes, mode, covariance


def _log_mass(limits: FloatArray) -> FloatArray:
    """Return ln of the standard normal probability between limits, shape (…, 2), in tails too."""
    low, high = limits[..., 0], limits[..., 1]
    low, high = np.where(low > 0.0, (-high, -low), (low, high))
    lower, upper = log_ndtr(low), log_ndtr(high)
    return np.asarray(upper + np.log1p(-np.exp(lower - upper)))


def _log_mean(values: Sequence[float] | FloatArray) -> float:
    return float(logsumexp(values) - np.log(len(values)))


def condition_on(posterior: Posterior, given: Sequence[int]) -> Posterior:
    """Return the posterior with some candidates in the model and their amplitudes marginalised."""
    taken = posterior.hypotheses.amplitudes_of(given)
    block = posterior.curvature[np.ix_(taken, taken)]
    block = block + prior_precision(posterior.hypotheses.bounds_of(given))
    gain = np.linalg.solve(block, posterior.curvature[taken]).T
    explained = posterior.gradient[taken] @ np.linalg.solve(block, posterior.gradient[taken])
    return replace(
        posterior,
        gradient=posterior.gradient - gain @ posterior.gradient[taken],
        curvature=posterior.curvature - gain @ posterior.curvature[taken],
        chi_square=posterior.chi_square - float(explained),
    )


def mean_square_v2(
    hypotheses: Hypotheses,
    log: NormalEquations,
    solution: FloatArray,
    score: Score | None = None,
) -> float:
    """Return a log's mean square error with the shared solution and one effect [V²].

    Per-log effects are not subtracted: they could hide a gap that no effect explains.

    Parameters
    ----------
    hypotheses : Hypotheses
    log : NormalEquations
        Of a diagnosed log.
    solution : array
        As `Posterior.mean`.
    score : Score, optional
        Effect to include.
    """
    layout = hypotheses.diagnosed_layout
    weights = np.zeros(log.products.shape[1])
    weights[layout.shared] -= solution
    if score is not None:
        weights[layout.effects[hypotheses.amplitudes_of(score.candidates)]] -= score.amplitude
    weights[layout.residual] = 1.0
    return float(np.sum((log.products @ weights) @ weights) / np.sum(log.counts))


def excess_chi_square(
    posterior: Posterior,
    diagnosed: Sequence[NormalEquations],
    reference_chi_square: float,
    score: Score | None = None,
) -> float:
    """Return the weighted squares that the diagnosed logs add beyond chance.

    These are the squares of their errors, of their per-log effects and of the coefficients' change,
    and the increase of the references' squares. Errors count by time scale, and only beyond their
    variation between healthy logs: a slightly noisier sensor is not a gap.

    Parameters
    ----------
    posterior : Posterior
    diagnosed : sequence of NormalEquations
        Diagnosed logs of the posterior.
    reference_chi_square : float
        Weighted squares of the references alone.
    score : Score, optional
        Effect to include.
    """
    total = posterior.chi_square - reference_chi_square
    total -= 0.0 if score is None else score.explained
    counts = np.sum([log.counts for log in diagnosed], axis=0)
    errors = _residual_squares_v2(posterior, diagnosed, score) / np.array(posterior.error.scale_v2)
    usual = (1.0 + NOISE_VARIATION) * counts + 2.0 * np.sqrt(2.0 * counts)
    adjusted = max(total - float(errors.sum()), 0.0)
    return adjusted + float(np.sum(np.maximum(errors - usual, 0.0)))


def _residual_squares_v2(
    posterior: Posterior, diagnosed: Sequence[NormalEquations], score: Score | None
) -> FloatArray:
    """Return the diagnosed logs' squared errors with an effect included, shape (SCALES,) [V²]."""
    hypotheses = posterior.hypotheses
    layout = hypotheses.diagnosed_layout
    at = hypotheses.amplitudes_of(() if score is None else score.candidates)
    amplitude = np.zeros(0) if score is None else score.amplitude
    solution = posterior.mean - posterior.sensitivity[:, at] @ amplitude
    total = np.zeros(SCALES)
    for log in diagnosed:
        weights = np.zeros(log.products.shape[1])
        # A candidate may be structure, per-log effect and cause at once.
        weights[layout.shared] -= solution
        weights[layout.effects[at]] -= amplitude
        weights[layout.residual] = 1.0
        weights[layout.per_log] -= log.per_log_amplitudes(posterior.error, layout, weights)
        total += (log.products @ weights) @ weights
    return total

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
    singles = [(k,) for k in range(len(hypotheses.candidates))]
    for chosen in (*singles, *hypotheses.mixtures):
        effect = hypotheses.candidates[chosen[0]].effect
        if effect.is_cause and effect.id not in leave_out:
            score = _score(posterior, chosen)
            if score is not None:
                by_effect.setdefault(effect.id, []).append(score)
    best = []
    for shapes in by_effect.values():
        top = max(shapes, key=lambda score: score.log_bayes_factor)
        mean = _log_mean([score.log_bayes_factor for score in shapes])
        best.append(replace(top, log_bayes_factor=mean))
    return sorted(best, key=lambda score: -score.log_bayes_factor)


def _score(posterior: Posterior, chosen: tuple[int, ...]) -> Score | None:
    """Score a candidate or a mixture of two; None where bounds exclude the mixture."""
    hypotheses = posterior.hypotheses
    at, bounds = hypotheses.amplitudes_of(chosen), hypotheses.bounds_of(chosen)
    effect_id = hypotheses.candidates[chosen[0]].effect.id
    overdispersion = posterior.error.overdispersion_of(effect_id)
    gradient = posterior.gradient[at] / overdispersion
    curvature = posterior.curvature[np.ix_(at, at)] / overdispersion
    widths = np.array(PRIOR_WIDTHS)[:, None, None]
    factors, modes, covariances = bounded_evidence(
        gradient[None], curvature, prior_precision(bounds) / widths**2, bounds
    )
    amplitude = modes[0, 0]
    within = np.clip(amplitude, bounds[:, 0], bounds[:, 1])
    if len(chosen) > 1 and np.any(within != amplitude):
        return None  # one of the two alone is the best within bounds
    return Score(
        effect_id=effect_id,
        log_bayes_factor=_log_mean(factors[:, 0]),
        candidates=chosen,
        amplitude=within,
        covariance=covariances[0],
        explained=overdispersion * float(2.0 * gradient @ within - within @ curvature @ within),
    )


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

"""Every effect's score: its Bayes factor against no effect, at its best shape or mixture of two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from cangauge.gap.evidence import Evidence, prior_precision

FloatArray = NDArray[np.float64]

PRIOR_PARTS = (1.0, 0.3, 0.1, 0.03)
"""An effect may be as large as its bounds, or much smaller: the prior's width in parts of that of
the bounds, each as probable as the others."""


@dataclass(frozen=True, eq=False)
class Score:
    """One effect, at its best shape."""

    effect_id: str
    log_bayes_factor: float
    """Against no effect, averaged over the effect's shapes."""
    candidates: tuple[int, ...]
    """Index of the best shape's candidate, or of two whose mixture is better than either."""
    amplitude: FloatArray
    """Most probable amplitudes beside the neutral ones, within bounds, of all of them, (k,)."""
    covariance: FloatArray
    """Shape (k, k)."""
    explained: float
    """By how much the weighted sum of squares falls."""


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
    choices = evidence.frame.choices
    by_effect: dict[str, list[Score]] = {}
    for chosen in (*((k,) for k in range(len(choices))), *evidence.frame.neighbours):
        effect = choices[chosen[0]].effect
        if effect.is_cause and effect.id not in leave_out:
            score = _score(evidence, chosen)
            if score is not None:
                by_effect.setdefault(effect.id, []).append(score)
    best = []
    for shapes in by_effect.values():
        top = max(shapes, key=lambda score: score.log_bayes_factor)
        mean = _log_mean([score.log_bayes_factor for score in shapes])
        best.append(replace(top, log_bayes_factor=mean))
    return sorted(best, key=lambda score: -score.log_bayes_factor)


def _score(evidence: Evidence, chosen: tuple[int, ...]) -> Score | None:
    """Return the score of a candidate or of a mixture, None where physics allows no mixture."""
    frame = evidence.frame
    at, bounds = frame.amplitudes_of(chosen), frame.bounds_of(chosen)
    effect_id = frame.choices[chosen[0]].effect.id
    # What references left out bring up as well is worth so much less.
    strays = evidence.error.strays.get(effect_id, 1.0)
    gradient = evidence.gradient[at] / strays
    curvature = evidence.curvature[np.ix_(at, at)] / strays
    prior = prior_precision(bounds)
    total = curvature + prior
    amplitude = np.linalg.solve(total, gradient)
    within = np.clip(amplitude, bounds[:, 0], bounds[:, 1])
    if len(chosen) > 1 and np.any(within != amplitude):
        return None  # then one of them alone is the best that the bounds allow
    factors = [
        _log_bayes_factor(gradient, curvature, prior / part**2, bounds) for part in PRIOR_PARTS
    ]
    return Score(
        effect_id=effect_id,
        log_bayes_factor=_log_mean(factors),
        candidates=chosen,
        amplitude=within,
        covariance=np.asarray(np.linalg.inv(total), dtype=np.float64),
        explained=strays * float(2.0 * gradient @ within - within @ curvature @ within),
    )


def _log_bayes_factor(
    gradient: FloatArray, curvature: FloatArray, prior: FloatArray, bounds: FloatArray
) -> float:
    """Return ln of the Bayes factor of amplitudes with this prior against none."""
    total = curvature + prior
    occam = 0.5 * float(np.linalg.slogdet(np.linalg.solve(prior, total))[1])
    if gradient.size == 1 and np.any(bounds == 0.0):  # one sign only: a half-normal prior
        sign = 1.0 if bounds[0, 0] == 0.0 else -1.0
        root = float(np.sqrt(total[0, 0]))
        at = sign * float(gradient[0]) / root
        return 0.5 * at**2 - occam + float(np.log(2.0) + log_ndtr(at))
    best = np.clip(np.linalg.solve(total, gradient), bounds[:, 0], bounds[:, 1])
    return float(gradient @ best - 0.5 * best @ total @ best) - occam


def _log_mean(values: Sequence[float]) -> float:
    array = np.array(values)
    return float(np.log(np.mean(np.exp(array - array.max()))) + array.max())

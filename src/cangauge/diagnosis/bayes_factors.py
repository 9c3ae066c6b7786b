"""Every effect's score: its Bayes factor against no effect, at its best shape or mixture of two.

What is left of logs: by how much, beyond chance, with and without an effect.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr

from cangauge._typing import FloatArray
from cangauge.diagnosis.hypotheses import Frame
from cangauge.diagnosis.linear_gaussian import Evidence, Gram, prior_precision, without_own
from cangauge.inference.time_scales import SCALES

# --- Every effect's score: its Bayes factor against no effect, at its best shape or mixture …

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


# --- What is left of logs: by how much, beyond chance, with and without an effect

NOISIER = 0.2
"""Errors' variance differs from log to log by this part without a cause."""


def left_over(
    evidence: Evidence, diagnosed: Sequence[Gram], chosen: Sequence[int], amplitude: FloatArray
) -> FloatArray:
    """Return the diagnosed logs' squares once some candidates explain them, shape (SCALES,) [V²].

    Parameters
    ----------
    evidence : Evidence
    diagnosed : sequence of Gram
        Of the diagnosed logs, the last ones of the evidence.
    chosen : sequence of int
        Candidates.
    amplitude : array
        Of all of them, in order.
    """
    frame = evidence.frame
    layout, at = frame.diagnosed, frame.amplitudes_of(chosen)
    solution = evidence.mean - evidence.per_amplitude[:, at] @ amplitude
    known = np.zeros(solution.size + int(frame.first[-1]) + 1)
    known[: solution.size] = -solution
    known[solution.size + at] = -amplitude
    known[-1] = 1.0
    total = np.zeros(SCALES)
    for log in diagnosed:
        _, follows, _ = without_own(log, frame, evidence.error, is_reference=False)
        mine = follows @ known
        weights = np.zeros(log.products.shape[1])
        # A candidate may be structure, a log's own and the cause at once.
        weights[layout.shared] -= solution
        weights[layout.own] -= mine
        weights[layout.effects[at]] -= amplitude
        weights[layout.residual] = 1.0
        total += (log.products @ weights) @ weights
    return total


def kept_v2(
    frame: Frame,
    log: Gram,
    solution: FloatArray,
    chosen: Sequence[int] = (),
    amplitude: FloatArray | None = None,
) -> float:
    """Return a log's mean square error with what is shared and some effects alone [V²].

    What is the log's own is not taken off: it could hide a gap that no effect explains.

    Parameters
    ----------
    frame : Frame
    log : Gram
        With the columns of all of the frame's candidates.
    solution : array
        Coefficients and repairs, as `Evidence.mean`.
    chosen, amplitude : optional
        Candidates and all their amplitudes.
    """
    layout = frame.diagnosed
    weights = np.zeros(log.products.shape[1])
    weights[layout.shared] -= solution
    if amplitude is not None:
        weights[layout.effects[frame.amplitudes_of(chosen)]] -= amplitude
    weights[layout.residual] = 1.0
    return float(np.sum((log.products @ weights) @ weights) / np.sum(log.counts))


def expected_v2(log: Gram, alone: Evidence) -> float:
    """Return the mean square error to expect of a log without a cause [V²].

    Errors as the references have them, what is each log's own, and how surely the references and
    the model file know the coefficients and the structure where this log went.

    Parameters
    ----------
    log : Gram
        With the columns of all of the frame's candidates.
    alone : Evidence
        Of the references alone.
    """
    error, layout = alone.error, alone.frame.diagnosed
    shared, own = layout.shared, layout.own
    products = log.products.sum(axis=0)
    balance = 1.0 / np.sqrt(np.diag(alone.precision))
    spread = np.linalg.inv(alone.precision * balance * balance[:, None])
    spread *= balance * balance[:, None]
    squares = float(np.sum(products[np.ix_(shared, shared)] * spread))
    squares += float(np.diag(products)[own] @ np.array(error.own_std) ** 2)
    squares += float(log.counts @ np.array(error.scale_v2))
    return squares / float(np.sum(log.counts))


def excess(
    evidence: Evidence, diagnosed: Sequence[Gram], clean: float, score: Score | None = None
) -> float:
    """Return by how much the weighted squares of some logs exceed what chance leaves.

    These are the squares of their errors, of what their own terms and the coefficients had to
    give, and of what the references lost by it. Errors count only scale by scale and beyond what
    varies from log to log: a sensor that is a little noisier is no gap.

    Parameters
    ----------
    evidence : Evidence
    diagnosed : sequence of Gram
        The last logs of the evidence.
    clean : float
        Squares of the references alone.
    score : Score, optional
        An effect to add.
    """
    chosen = () if score is None else score.candidates
    amplitude = np.zeros(0) if score is None else score.amplitude
    total = evidence.squares - clean - (0.0 if score is None else score.explained)
    counts = np.sum([gram.counts for gram in diagnosed], axis=0)
    errors = left_over(evidence, diagnosed, chosen, amplitude) / np.array(evidence.error.scale_v2)
    usual = (1.0 + NOISIER) * counts + 2.0 * np.sqrt(2.0 * counts)
    given = max(total - float(errors.sum()), 0.0)
    return given + float(np.sum(np.maximum(errors - usual, 0.0)))

"""What reference logs say: how far the model strays without a cause.

Everything is judged on whole logs left out: each reference is seen with the coefficients that the
others (and the model's own information) leave open, and what then remains is the error, scale by
scale, and what is each log's own. Without at least two references the model file's own noise
stands in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cangauge.gap.evidence import (
    ErrorModel,
    Gram,
    gather,
    information_of,
    log_integral,
    prior_precision,
)
from cangauge.gap.frame import Frame
from cangauge.gap.levels import (
    OWN_LEVELS,
    STRUCTURE_LEVELS,
    own_level,
    own_levels,
    structure_levels,
)
from cangauge.gap.remainder import kept_v2
from cangauge.identify.scales import SCALES, scale_variances
from cangauge.model.model_file import ModelNoise

FloatArray = NDArray[np.float64]

ROUNDS = 4

KNOWN_LOGS = 0.05
"""What the model file says of the error counts like so much of a reference log. That error was
judged on logs left out of a fit to a few, so it may be many times too large."""

KNOWN_COEFFICIENTS = 2.0
"""So many coefficients are taken to agree with the model file, beside those that are looked at."""

TRUSTS: tuple[float, ...] = tuple(np.logspace(-7.0, 0.0, 29).tolist())
"""Weights of the model file's information to choose from."""

LEAST_TRUST_BEYOND = 0.1
"""At temperatures that no reference has, the model file is all that there is: it keeps this."""

FEW = 2.0
"""Chance on few references: a mean of n squares is taken to be low by this over n."""

LEAST = 1e-4
"""No scale's variance is below this part of the largest."""


def error_from_noise(noise: ModelNoise, rate_hz: float, frame: Frame) -> ErrorModel:
    """Return the error that a model file states, for want of references."""
    slow_v2, fast_v2 = noise.slow_std_v**2, noise.fast_std_v**2
    total_v2 = max(slow_v2 + fast_v2, 1e-12)
    variance = scale_variances(
        fast_v2, noise.fast_time_s * rate_hz, slow_v2, noise.slow_time_s * rate_hz
    )
    return ErrorModel(
        scale_v2=_positive(variance),
        own_std=tuple(frame.own_prior.tolist()),
        rmse_v=float(np.sqrt(total_v2)),
    )


def error_from_references(
    frame: Frame, grams: Sequence[Gram], stated: ErrorModel, least_trust: float = 0.0
) -> ErrorModel:
    """Return the error under which each reference is most probable, given the others.

    Expectation maximisation on the variance of every scale, in which what `stated` says counts like
    `KNOWN_LOGS` logs, in turn with the levels of the structure that all share and of all that is a
    log's own (`levels`); then the level of each effect's own. Structure and own begin at next to
    nothing and grow where the references need them.

    Parameters
    ----------
    frame : Frame
    grams : sequence of Gram
        Of the references, two at least.
    stated : ErrorModel
    least_trust : float
        The model file is trusted at least so far.
    """
    usual = np.array(stated.own_std)
    pieces = dict.fromkeys(frame.choices[k].effect.id for k in frame.repairs)
    error = replace(
        stated,
        structure=dict.fromkeys(pieces, STRUCTURE_LEVELS[0]),
        own_std=tuple((OWN_LEVELS[0] * usual).tolist()),
    )
    # What all references share comes first, or it is taken for what differs from log to log: under
    # information that is too sure the differences grow until they explain it, and it stays so.
    error = replace(error, trust=_trust(frame, grams, error, least_trust))
    known_v2 = np.array(stated.scale_v2)
    counts = np.sum([gram.counts for gram in grams], axis=0)
    known = KNOWN_LOGS * counts / len(grams) + 1e-9
    for _ in range(ROUNDS):
        seen = [_left_out(frame, grams, k, error) for k in range(len(grams))]
        variance = (np.sum(seen, axis=0) + known * known_v2) / (counts + known)
        error = replace(
            error,
            scale_v2=_positive(variance),
            rmse_v=float(np.sqrt(np.sum(counts * variance) / np.sum(counts))),
        )
        error = replace(error, trust=_trust(frame, grams, error, least_trust))
        error = replace(error, structure=structure_levels(frame, grams, error))
        error = replace(error, own_std=own_level(frame, grams, error, usual))
    return replace(error, own_std=own_levels(frame, grams, error))


def with_strays(
    frame: Frame,
    grams: Sequence[Gram],
    error: ErrorModel,
    covered: Sequence[float] = (),
    judged: Sequence[Gram] = (),
) -> ErrorModel:
    """Return the error with how far references stray that are diagnosed like the logs.

    A voltage model that lacks something shows it as if it were an effect, more on one day than on
    another. Each reference is diagnosed with the others as references; the mean of its squared
    evidence over what chance would give is what that effect's evidence must be divided by (a
    quasi-likelihood, McCullagh, Nelder, Generalized Linear Models, 2nd ed. 1989, ch. 9).

    Parameters
    ----------
    frame : Frame
    grams : sequence of Gram
        Of the references, two at least.
    error : ErrorModel
        From `error_from_references`.
    covered : sequence of float, optional
        How much each reference counts: the part of it that lies where the others have been.
    judged : sequence of Gram, optional
        What of each reference is diagnosed, if not the whole.
    """
    weights = np.array(covered) if len(covered) else np.ones(len(grams))
    shown = frame.shown
    few = replace(
        frame,
        choices=tuple(frame.choices[k] for k in shown),
        repairs=tuple(range(len(frame.repairs))),
        own=tuple(range(len(frame.repairs), len(shown))),
    )
    squares: dict[str, list[float]] = {}
    kept = []
    for number, gram in enumerate(judged or grams):
        others = [item for k, item in enumerate(grams) if k != number]
        evidence = gather(few, others, [gram], error)
        without = gather(few, others, [], error)
        kept.append(kept_v2(few, gram, without.mean))
        for k, choice in enumerate(few.choices):
            at = evidence.of(k)
            prior = prior_precision(choice.bounds)
            total = evidence.curvature[at, at] + 1e-6 * prior
            chance = float(np.trace(np.linalg.solve(total, evidence.curvature[at, at])))
            square = float(evidence.gradient[at] @ np.linalg.solve(total, evidence.gradient[at]))
            squares.setdefault(choice.effect.id, []).append(square / max(chance, 1e-9))
    few_logs = 1.0 + FEW / float(weights.sum())
    worth = {}
    for key, seen in squares.items():  # all shapes of the first reference, then of the second …
        each = np.reshape(seen, (len(grams), -1)).mean(axis=1)
        worth[key] = max(1.0, few_logs * float(np.average(each, weights=weights)))
    # A model that strays in some ways will stray in others too, on a day that nobody has seen.
    # (The median: one way to stray, however far, says nothing of a quite different one.)
    usual = float(np.median([*worth.values()]))
    worth = {key: max(value, usual) for key, value in worth.items()}
    return replace(error, strays=worth, clean_v2=float(np.average(kept, weights=weights)))


def _trust(frame: Frame, grams: Sequence[Gram], error: ErrorModel, least: float) -> float:
    """Return how far the references bear out the model file's information (`ErrorModel.trust`).

    It says where the coefficients are, and how surely. If the references put them ten times further
    away than it says they may lie, it counts for about a hundredth: the weight under which the
    references are most probable, everything else integrated out.
    """
    p = frame.scale.size
    if frame.prior_root is None:
        return 1.0
    found = gather(frame, grams, [], error)
    right = found.precision @ found.mean
    whole = information_of(frame, replace(error, trust=1.0))
    centre = np.zeros(p) if frame.centre is None else frame.centre

    def log_probability(trust: float) -> float:
        precision, toward = found.precision.copy(), right.copy()
        precision[:p, :p] += (trust - error.trust) * whole
        toward[:p] += (trust - error.trust) * whole @ centre
        agreed = KNOWN_COEFFICIENTS * (np.log(trust) - trust)
        held = p * np.log(trust) - trust * centre @ whole @ centre
        return log_integral(precision, toward) + 0.5 * float(held + agreed)

    return max((trust for trust in TRUSTS if trust >= least), key=log_probability)


def _left_out(frame: Frame, grams: Sequence[Gram], number: int, error: ErrorModel) -> FloatArray:
    """Return the expected squares of one reference's error, summed over each scale [V²]."""
    others = gather(frame, [gram for k, gram in enumerate(grams) if k != number], [], error)
    shared, own = others.mean.size, frame.reference.own
    prior = np.zeros((shared + own.size, shared + own.size))
    prior[:shared, :shared] = others.precision
    prior[own, own] = np.array(error.own_std) ** -2.0
    log = grams[number]
    data = log.weighed(error)[:-1, :-1]
    toward = log.weighed(error)[:-1, -1]
    centre = np.concatenate((others.mean, np.zeros(own.size)))
    spread = _inverse(prior + data)
    mean = spread @ (prior @ centre + toward)
    squares = np.empty(SCALES)
    for j, products in enumerate(log.products):
        block = products[:-1, :-1]
        squares[j] = (
            products[-1, -1]
            - 2.0 * mean @ products[:-1, -1]
            + mean @ block @ mean
            + np.sum(block * spread)
        )
    return np.maximum(squares, 0.0)


def _inverse(matrix: FloatArray) -> FloatArray:
    """Return the inverse, balanced by the diagonal."""
    balance = 1.0 / np.sqrt(np.diag(matrix))
    inverse = np.linalg.inv(matrix * balance * balance[:, None])
    return np.asarray(inverse * balance * balance[:, None])


def _positive(variance: FloatArray) -> tuple[float, ...]:
    least = max(LEAST * float(variance.max()), 1e-12)
    return tuple(np.maximum(variance, least).tolist())

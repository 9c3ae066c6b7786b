"""What reference logs say: how far the model strays without a cause.

Everything is judged on whole logs left out: each reference is seen with the coefficients that the
others (and the model's own information) leave open, and what then remains is the error, scale by
scale, and what is each log's own. Without at least two references the model file's own noise
stands in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cangauge.gap.evidence import (
    ErrorModel,
    Frame,
    Gram,
    excess,
    gather,
    information_of,
    kept_v2,
    prior_precision,
)
from cangauge.gap.scales import SCALES, scale_variances
from cangauge.model.model_file import ModelNoise

FloatArray = NDArray[np.float64]

ROUNDS = 5

KNOWN_LOGS = 0.5
"""What the model file says counts like so much of a reference log."""

KNOWN_COEFFICIENTS = 2.0
"""So many coefficients are taken to agree with the model file, beside those that are looked at."""

TRUSTS: tuple[float, ...] = tuple(np.logspace(-7.0, 0.0, 29).tolist())
"""Weights of the model file's information to choose from."""

LEAST_TRUST_BEYOND = 0.1
"""At temperatures that no reference has, the model file is all that there is: it keeps this."""

FEW = 2.0
"""Chance on few references: a mean of n squares is taken to be low by this over n."""

OWN_AT_MOST = 4.0
"""Nor by more than this many times it: effects that cancel each other could grow without end."""

OWN_AT_LEAST = 0.25
"""Few references cannot show that logs differ by less than this part of what is usual."""

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

    Expectation maximisation on the variance of every scale and of all that is a log's own; what
    `stated` says counts like `KNOWN_LOGS` logs.

    Parameters
    ----------
    frame : Frame
    grams : sequence of Gram
        Of the references, two at least.
    stated : ErrorModel
    """
    # What all references share comes first, or it is taken for what differs from log to log: under
    # information that is too sure the differences grow until they explain it, and it stays so.
    error = replace(stated, trust=_trust(frame, grams, stated, least_trust))
    known_v2, known_own = np.array(stated.scale_v2), np.array(stated.own_std)
    counts = np.sum([gram.counts for gram in grams], axis=0)
    known = KNOWN_LOGS * counts / len(grams) + 1e-9
    for _ in range(ROUNDS):
        seen = [_left_out(frame, grams, number, error) for number in range(len(grams))]
        squares = np.sum([item.squares_v2 for item in seen], axis=0)
        own = np.sum([item.own for item in seen], axis=0)
        variance = (squares + known * known_v2) / (counts + known)
        error = ErrorModel(
            scale_v2=_positive(variance),
            own_std=tuple(
                np.clip(
                    np.sqrt((own + KNOWN_LOGS * known_own**2) / (len(grams) + KNOWN_LOGS)),
                    OWN_AT_LEAST * known_own,
                    OWN_AT_MOST * known_own,
                ).tolist()
            ),
            rmse_v=float(np.sqrt(np.sum(counts * variance) / np.sum(counts))),
            trust=_trust(frame, grams, error, least_trust),
        )
    return error


def with_strays(frame: Frame, grams: Sequence[Gram], error: ErrorModel) -> ErrorModel:
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
    """
    shown = frame.shown
    few = replace(
        frame,
        choices=tuple(frame.choices[k] for k in shown),
        repairs=tuple(range(len(frame.repairs))),
        own=tuple(range(len(frame.repairs), len(shown))),
    )
    squares: dict[str, list[float]] = {}
    excesses, kept = [], []
    for number, gram in enumerate(grams):
        others = [item for k, item in enumerate(grams) if k != number]
        evidence = gather(few, others, [gram], error)
        without = gather(few, others, [], error)
        excesses.append(excess(evidence, [gram], without.squares))
        kept.append(kept_v2(few, gram, without.mean))
        for k, choice in enumerate(few.choices):
            at = evidence.of(k)
            prior = prior_precision(choice.bounds)
            total = evidence.curvature[at, at] + 1e-6 * prior
            chance = float(np.trace(np.linalg.solve(total, evidence.curvature[at, at])))
            square = float(evidence.gradient[at] @ np.linalg.solve(total, evidence.gradient[at]))
            squares.setdefault(choice.effect.id, []).append(square / max(chance, 1e-9))
    few_logs = 1.0 + FEW / len(grams)
    worth = {key: max(1.0, few_logs * float(np.mean(seen))) for key, seen in squares.items()}
    # A model that strays in some ways will stray in others too, on a day that nobody has seen.
    usual = float(np.mean([*worth.values()]))
    worth = {key: max(value, usual) for key, value in worth.items()}
    return replace(error, strays=worth, clean_v2=float(np.mean(kept)), clean_excess=max(excesses))


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
        balance = 1.0 / np.sqrt(np.diag(precision))
        balanced, toward = precision * balance * balance[:, None], toward * balance
        gained = toward @ np.linalg.solve(balanced, toward) - trust * centre @ whole @ centre
        volume = np.linalg.slogdet(balanced)[1] - 2.0 * np.sum(np.log(balance))
        agreed = KNOWN_COEFFICIENTS * (np.log(trust) - trust)
        return float(0.5 * (gained - volume + p * np.log(trust) + agreed))

    return max((trust for trust in TRUSTS if trust >= least), key=log_probability)


@dataclass(frozen=True, eq=False)
class _Seen:
    """Expected squares of one reference, its own coefficients' uncertainty included."""

    squares_v2: FloatArray
    """Of the error, summed over each scale [V²]."""
    own: FloatArray
    """Of all that is the log's own."""


def _left_out(frame: Frame, grams: Sequence[Gram], number: int, error: ErrorModel) -> _Seen:
    others = gather(frame, [gram for k, gram in enumerate(grams) if k != number], [], error)
    shared = others.mean.size
    own = np.arange(shared, shared + len(error.own_std))
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
    return _Seen(np.maximum(squares, 0.0), mean[own] ** 2 + np.diag(spread)[own])


def _inverse(matrix: FloatArray) -> FloatArray:
    """Return the inverse, balanced by the diagonal."""
    balance = 1.0 / np.sqrt(np.diag(matrix))
    inverse = np.linalg.inv(matrix * balance * balance[:, None])
    return np.asarray(inverse * balance * balance[:, None])


def _positive(variance: FloatArray) -> tuple[float, ...]:
    least = max(LEAST * float(variance.max()), 1e-12)
    return tuple(np.maximum(variance, least).tolist())

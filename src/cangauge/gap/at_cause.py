"""The amplitudes of accepted causes, found where the causes are and not where there is none.

A verdict takes the voltage's change by a small amplitude. A skew of seconds or a fifth of the
capacity is no small one, so residual and tangents are taken again at the values found, with
everything else integrated out as for the verdict (Gauss–Newton), until the values stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cangauge.gap.by_charge import variance_by_charge
from cangauge.gap.columns import LogTerms, residual
from cangauge.gap.evidence import Gram, gather, gram_of, prior_precision
from cangauge.gap.settle import Settled
from cangauge.identify.effects.prepared import as_modelled
from cangauge.model.effects.candidate import STEP, Candidate
from cangauge.model.effects.effect import Values
from cangauge.model.extended import ExtendedModel

FloatArray = NDArray[np.float64]

ROUNDS = 3

TANGENT_STD = 0.05
"""How well a tangent is known, as a part of it: it is the model's, and the plant is another. On
development cases of large evidence amplitudes were off by 1 to 15 % where chance left 0.3 %."""


@dataclass(frozen=True, eq=False)
class Cause:
    """An accepted effect."""

    candidate: int
    """Which of the frame's candidates its tangents stand for."""
    choice: Candidate
    values: Values

    @property
    def amplitude(self) -> FloatArray:
        """Amplitudes beside the neutral ones, shape (k,)."""
        return (
            np.array([self.values[name] for name in self.choice.amplitudes]) - self.choice.neutral
        )

    def moved(self, amplitude: FloatArray) -> Cause:
        """Return the cause with other amplitudes beside the neutral ones, within bounds."""
        low, high = self.choice.bounds[:, 0], self.choice.bounds[:, 1]
        total = self.choice.neutral + np.clip(amplitude, low, high)
        named = dict(zip(self.choice.amplitudes, total.tolist(), strict=True))
        return replace(self, values={**self.values, **named})


@dataclass(frozen=True, eq=False)
class AtCause:
    """Causes where residual and tangents agree with them."""

    causes: tuple[Cause, ...]
    covariance: FloatArray
    """Of all amplitudes, in order, shape (…, …)."""
    settled: Settled
    """The common ground with the causes taken off the diagnosed logs' residuals."""


def at_causes(settled: Settled, causes: Sequence[Cause]) -> AtCause:
    """Return the causes with their most probable amplitudes.

    Parameters
    ----------
    settled : Settled
    causes : sequence of Cause
        Where to begin, one at least.

    Notes
    -----
    An amplitude is known as well as chance and its tangent let it be, or as well as the bands of
    SoC agree on it, whichever is less (`by_charge`).
    """
    frame, error = settled.frame, settled.error
    at = frame.amplitudes_of([cause.candidate for cause in causes])
    bounds = frame.bounds_of([cause.candidate for cause in causes])
    prior = prior_precision(bounds)
    strays = np.concatenate(
        [
            np.full(len(cause.choice.amplitudes), error.strays.get(cause.choice.effect.id, 1.0))
            for cause in causes
        ]
    )
    worth = 1.0 / np.sqrt(strays)

    def solved(grams: Sequence[Gram], here: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return how far to go from here, and the precision of where that is."""
        evidence = gather(frame, settled.reference_grams, grams, error)
        total = evidence.curvature[np.ix_(at, at)] * worth * worth[:, None] + prior
        return np.linalg.solve(total, evidence.gradient[at] / strays - prior @ here), total

    found = tuple(causes)
    factors = [settled.hardness(terms) for terms in settled.diagnosed]
    for _ in range(ROUNDS):
        diagnosed = [_terms_at(terms, settled, found) for terms in settled.diagnosed]
        grams = [
            gram_of(terms, frame.scale).weakened(factor)
            for terms, factor in zip(diagnosed, factors, strict=True)
        ]
        here = np.concatenate([cause.amplitude for cause in found])
        step, total = solved(grams, here)
        ends = np.cumsum([0, *(len(cause.choice.amplitudes) for cause in found)])
        found = tuple(
            cause.moved((here + step)[ends[k] : ends[k + 1]]) for k, cause in enumerate(found)
        )
    differing = variance_by_charge(
        diagnosed, frame.scale, factors, lambda grams: solved(grams, here)[0]
    )
    diagnosed = [_terms_at(terms, settled, found, tangents=False) for terms in settled.diagnosed]
    of_tangents = TANGENT_STD * np.concatenate([cause.amplitude for cause in found])
    covariance = np.asarray(np.linalg.inv(total) + np.diag(of_tangents**2))
    covariance += np.diag(np.maximum(differing - np.diag(covariance), 0.0))
    return AtCause(found, covariance, replace(settled, diagnosed=tuple(diagnosed)))


def squares(settled: Settled, causes: Sequence[Cause]) -> float:
    """Return the weighed squares that the diagnosed logs keep with some causes."""
    grams = [
        gram_of(_terms_at(terms, settled, causes, tangents=False), settled.frame.scale).weakened(
            settled.hardness(terms)
        )
        for terms in settled.diagnosed
    ]
    return gather(settled.frame, settled.reference_grams, grams, settled.error).squares


def _terms_at(
    terms: LogTerms, settled: Settled, causes: Sequence[Cause], *, tangents: bool = True
) -> LogTerms:
    """Return a diagnosed log's terms with the causes in its residual, and their tangents there."""
    prepared, acting = terms.prepared.remembering(), settled.acting or settled.model
    changed = residual(prepared, with_causes(acting, causes)) - residual(prepared, acting)
    effects = list(terms.effects)
    if tangents:
        smooth = as_modelled(prepared, with_causes(acting, causes))
        here = residual(smooth, with_causes(acting, causes))
        for number, cause in enumerate(causes):
            columns = np.empty_like(effects[cause.candidate])
            for k, width in enumerate(np.diff(cause.choice.bounds)[:, 0]):
                step = np.zeros(columns.shape[1])
                step[k] = STEP * width
                if cause.amplitude[k] + step[k] > cause.choice.bounds[k, 1]:
                    step[k] = -step[k]
                beside = [*causes]
                beside[number] = cause.moved(cause.amplitude + step)
                there = residual(smooth, with_causes(acting, beside))
                columns[:, k] = (here - there) / step[k]
            effects[cause.candidate] = columns
    return replace(terms, residual_v=terms.residual_v + changed, effects=tuple(effects))


def with_causes(model: ExtendedModel, causes: Sequence[Cause]) -> ExtendedModel:
    """Return a model with the causes."""
    for cause in causes:
        model = model.with_effect(cause.choice.effect, cause.values)
    return model

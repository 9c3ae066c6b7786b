"""From one posterior to the answer: verdict, alarm, credible set, family, and the ceiling.

Everything here follows from the probabilities of `none`, of every effect and of `unknown`, and from
the curvature of the likelihood. Whether there is a fault (the alarm) and which it is (the verdict)
are two questions to the same posterior.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cangauge._typing import FloatArray
from cangauge.diagnosis.bayes_factors import Score, condition_on, normal_evidence, scores
from cangauge.diagnosis.hypotheses import prior_precision
from cangauge.diagnosis.linear_gaussian import Posterior
from cangauge.diagnosis.posterior import NONE, UNKNOWN, probabilities
from cangauge.diagnosis.problem import DiagnosisProblem
from cangauge.model.effects.library import LIBRARY

ALARM_BELOW = 0.02
"""Probability of `none` up to which a fault is reported: with calibrated probabilities at most one
alarm in fifty is false. `cangauge gap --alarm` sets it."""

CREDIBLE = 0.9
"""Probability that the credible set holds at least."""

SEPARATE_NATS = math.log(20.0)
"""Expected log Bayes factor at which two effects count as separable: 20 to 1."""

TIE_NATS = 1e-6
"""Evidence that differs by less is equal but for rounding; equal effects are named by chance."""

DRAWS = 400
"""Simulated logs of the ceiling; its standard error is at most 2.5 %."""

SECOND_MIN_LOG_BAYES, SECOND_MIN_PART, MAX_CAUSES = 12.0, 0.05, 2
"""Log Bayes factor that a further cause needs in addition to those accepted, also relative to the
first's: the misfit of a large cause's shape resembles a second cause. Chosen on development cases:
of 14 false second causes nine were below, of five true ones one."""


@dataclass(frozen=True, eq=False)
class Ceiling:
    """What any method could learn from these logs if the verdict is true, at the size found."""

    isolable_from: dict[str, float]
    """Expected log Bayes factor of the verdict against each rival, least separable first [nats]."""
    probability_of_best: float
    """Probability that an ideal observer, who knows pack and nuisances as well as the references
    allow, ranks the true effect first."""

    def to_dict(self) -> dict[str, Any]:
        """Return the object of `gap --json`."""
        return {
            "isolable_from": self.isolable_from,
            "probability_of_best": self.probability_of_best,
        }

    def parts_needed(self) -> dict[str, float]:
        """Return the size, in parts of that found, at which each rival would be separable.

        The expected log Bayes factor grows with the square of the size.
        """
        return {
            name: math.sqrt(SEPARATE_NATS / nats) if nats > 0.0 else math.inf
            for name, nats in self.isolable_from.items()
        }


@dataclass(frozen=True, eq=False)
class Verdict:
    """Cause of the gap, with probabilities."""

    cause: str
    """Most probable answer: an effect, `none` or `unknown`."""
    probabilities: dict[str, float]
    """Of each effect, of `none` and of `unknown`; they sum to 1."""
    accepted: tuple[Score, ...]
    """The named cause, and a second one if the logs show it; empty without a named cause."""
    candidates: tuple[Score, ...]
    """All effects, most probable first."""
    explained: float
    """Part of the gap that the best effect explains (0–1)."""
    alarm_below: float = ALARM_BELOW
    ceiling: Ceiling | None = None
    """None without a named cause."""

    @property
    def probability(self) -> float:
        """Probability of the verdict."""
        return self.probabilities[self.cause]

    @property
    def detected(self) -> bool:
        """Whether there is an alarm: `none` is no more probable than `alarm_below`."""
        return self.probabilities[NONE] <= self.alarm_below

    @property
    def credible_set(self) -> tuple[str, ...]:
        """Smallest set of answers that holds 90 %, most probable first."""
        return credible_set(self.probabilities)

    @property
    def ambiguous_with(self) -> tuple[str, ...]:
        """Effects of the credible set beside a named verdict."""
        if self.cause in {NONE, UNKNOWN}:
            return ()
        return tuple(name for name in self.credible_set if name not in {self.cause, NONE, UNKNOWN})

    @property
    def family(self) -> str:
        """Family of the verdict; `none` and `unknown` are their own."""
        return _family(self.cause)

    @property
    def family_probability(self) -> float:
        """Probability of all effects of the verdict's family."""
        return sum(p for name, p in self.probabilities.items() if _family(name) == self.family)


def credible_set(stated: Mapping[str, float], holds: float = CREDIBLE) -> tuple[str, ...]:
    """Return the smallest set of answers that holds a probability, most probable first."""
    chosen, total = [], 0.0
    for name, probability in sorted(stated.items(), key=lambda item: -item[1]):
        if total >= holds:
            break
        chosen.append(name)
        total += probability
    return tuple(chosen)


def decide(problem: DiagnosisProblem, alarm_below: float = ALARM_BELOW) -> Verdict:
    """Return the verdict on the diagnosed logs."""
    found = probabilities(problem)
    cause = max(found.of, key=lambda name: found.of[name])
    ranked = sorted((each.score for each in found.effects), key=lambda s: -found.of[s.effect_id])
    verdict = Verdict(cause, found.of, (), tuple(ranked), found.explained, alarm_below)
    if cause in {NONE, UNKNOWN}:
        return verdict
    return Verdict(
        cause,
        found.of,
        _causes(problem.posterior, ranked[0], verdict.ambiguous_with),
        tuple(ranked),
        found.explained,
        alarm_below,
        ceiling_of(problem.posterior, ranked[0]),
    )


def _family(answer: str) -> str:
    return LIBRARY[answer].family if answer in LIBRARY else answer


def _causes(posterior: Posterior, best: Score, ambiguous: Sequence[str]) -> tuple[Score, ...]:
    """Return the best effect, and a second cause if the logs show one."""
    accepted = [best]
    needed = max(SECOND_MIN_LOG_BAYES, SECOND_MIN_PART * best.log_bayes_factor)
    while len(accepted) < MAX_CAUSES:
        rest = scores(
            condition_on(posterior, [k for score in accepted for k in score.candidates]),
            leave_out=[*(score.effect_id for score in accepted), *ambiguous],
        )
        if not rest or rest[0].log_bayes_factor < needed:
            break
        accepted.append(rest[0])
    return tuple(accepted)


def ceiling_of(posterior: Posterior, true: Score) -> Ceiling:
    """Return what an ideal observer could know if an effect is the cause, at its size.

    From the curvature S of the log likelihood, with everything else marginalised and divided by the
    effect's overdispersion. With the true amplitude a, a gradient is S·a plus noise of covariance
    S. The observer averages over each effect's shapes and amplitudes, and finds all effects equally
    probable beforehand (Eriksson, Frisk, Krysander, Automatica 49 (2013) 1591: separability).

    Parameters
    ----------
    posterior : Posterior
    true : Score
        Effect with its shape and amplitude.
    """
    hypotheses = posterior.hypotheses
    at = hypotheses.amplitudes_of(true.candidates)
    curvature = posterior.curvature / posterior.error.overdispersion_of(true.effect_id)
    mean = curvature[:, at] @ true.amplitude
    full = float(true.amplitude @ mean[at])
    values, vectors = np.linalg.eigh(curvature)
    noise = np.random.default_rng(0).standard_normal((DRAWS, values.size))
    drawn = mean + (noise * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    gradients = np.vstack([mean, drawn])
    evidence: dict[str, list[FloatArray]] = {}
    nearest: dict[str, float] = {}
    for k, candidate in enumerate(hypotheses.candidates):
        name = candidate.effect.id
        if not candidate.effect.is_cause:
            continue
        mine = hypotheses.amplitudes_of([k])
        prior = prior_precision(candidate.bounds)
        log_bayes, mode, _ = normal_evidence(
            gradients[:, mine], curvature[np.ix_(mine, mine)], prior
        )
        evidence.setdefault(name, []).append(log_bayes[1:])
        explained = 0.5 * float(mean[mine] @ mode[0])
        nearest[name] = min(nearest.get(name, math.inf), max(0.5 * full - explained, 0.0))
    nearest.pop(true.effect_id, None)
    means = {
        name: np.logaddexp.reduce(each) - math.log(len(each)) for name, each in evidence.items()
    }
    lead = means[true.effect_id] - np.array([*means.values()])
    alike = np.sum(np.abs(lead) <= TIE_NATS, axis=0)  # itself included
    first = np.all(lead >= -TIE_NATS, axis=0)
    return Ceiling(
        dict(sorted(nearest.items(), key=lambda item: item[1])),
        float(np.mean(first / alike)),
    )

"""One posterior over `none`, every effect and `unknown`.

With the model exact, Bayes factors would be probabilities. It is not: on real packs hardly any of
them is below a million to one. What is left of the error under each answer is therefore compared
with what is left on healthy logs of the same pack, in three measures:

1. *nats*: log likelihood that the effect gains along its own direction, in units of what left-out
   references gain along it by chance (`ErrorModel.overdispersion`);
2. *excess*: weighted squares beyond chance on all time scales, in units of a left-out reference's;
3. *volts*: mean square error with the slow parts, in units of a left-out reference's.

Each has a Student tail: x times the healthy level has a probability in proportion to (1 + x)^−h.
One exponent h for the product of the three margins (composite likelihood: Varin, Reid, Firth,
Statistica Sinica 21 (2011) 5) accounts for their dependence and for tails heavier than normal.
`none` leaves all of the error; an effect what its fit leaves; `unknown`, a cause outside the
library, may fit as well as the best known one usually does.

No feature depends on the name of an effect, with one exception in the prior, of the cold.
`benchmarks/posterior_numbers.py` fits the three numbers to development cases; none of them is part
of a release's check.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from cangauge._typing import FloatArray
from cangauge.diagnosis.bayes_factors import (
    Score,
    excess_chi_square,
    mean_square_v2,
    scores,
)
from cangauge.diagnosis.hypotheses import Hypotheses, prior_precision
from cangauge.diagnosis.linear_gaussian import Posterior, marginalize
from cangauge.diagnosis.problem import DiagnosisProblem

NONE, UNKNOWN = "none", "unknown"


@dataclass(frozen=True)
class Calibration:
    """The three fitted numbers."""

    tail: float
    """Exponent h of the Student tails."""
    log_none: float
    """ln of the prior of `none`, relative to that of all effects together."""
    log_unknown: float
    """ln of that of `unknown`, with its Occam factor: it may fit any error."""


FITTED = Calibration(tail=1.085, log_none=1.085, log_unknown=-5.45)

UNEXPLAINED = 0.15
"""Part of the error that an unknown cause leaves. No effect of the library has exactly the shape of
a pack's fault, and an unknown cause must not win for explaining that too. Between 0.1 and 0.25 the
log score of the development cases changes by 0.01."""

USUAL_EXCESS = 90.0
"""Median over six development packs (i3, car1, LG at 0, 10 and 25 °C, simulated: 11–1110), used as
one further reference."""

EXPECTED_BEYOND = frozenset({"resistance_temperature"})
"""Beyond the references' temperatures the resistance of every healthy pack differs, so this has the
prior of `none` there."""

MIN_LOG_BAYES = 5.0
"""Log Bayes factor from which an effect is visible."""


@dataclass(frozen=True, eq=False)
class EffectEvidence:
    """Evidence for one effect, and the error that remains with it."""

    score: Score
    nats: float
    """Gain of log likelihood, divided by the effect's own overdispersion."""
    excess: float
    """Excess chi-square with it (`bayes_factors.excess_chi_square`)."""
    mean_square_v2: float
    """Of the logs with it, per-log effects included, at the references' current
    (`DiagnosisProblem.noise_scale`) [V²]."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """What every answer leaves of the error of the diagnosed logs."""

    effects: tuple[EffectEvidence, ...]
    all_nats: float
    """Gain of log likelihood if every candidate may contribute at once."""
    excess: float
    mean_square_v2: float
    """Without any effect, with the model as the references know it."""
    reference_excess: float
    reference_v2: float
    """The same on left-out references."""
    expected: frozenset[str] = frozenset()
    """Effects with the prior of `none`."""

    def support(self, nats: float, excess: float, mean_square_v2: float) -> float:
        """Return ln of the ratio of the three tails, without a cause to with one."""
        usual, usual_v2 = self.reference_excess, self.reference_v2
        return (
            math.log1p(max(nats, 0.0))
            + math.log((usual + self.excess) / (usual + max(excess, 0.0)))
            + math.log((usual_v2 + self.mean_square_v2) / (usual_v2 + mean_square_v2))
        )

    def explained(self, effect: EffectEvidence) -> float:
        """Return the part of the mean square error above the references' that it explains (0–1).

        By excess where the error is no larger than the references'.
        """
        gap = self.mean_square_v2 - self.reference_v2
        if gap > 0.0:
            left = max(effect.mean_square_v2, self.reference_v2)
            return min(max((self.mean_square_v2 - left) / gap, 0.0), 1.0)
        return min(max(1.0 - effect.excess / max(self.excess, 1e-9), 0.0), 1.0)


def evidence_of(problem: DiagnosisProblem) -> Evidence:
    """Return what every answer leaves of the error of the diagnosed logs."""
    hypotheses, error, logs = problem.hypotheses, problem.error, problem.weighted_equations
    posterior = problem.posterior
    references = marginalize(hypotheses, problem.reference_equations, [], error)
    usual = error.usual_overdispersion
    causes = {each.effect.id for each in hypotheses.candidates if each.effect.is_cause}
    shared = replace(posterior, error=replace(error, overdispersion=dict.fromkeys(causes, usual)))

    def mean_square(solution: FloatArray, score: Score | None = None) -> float:
        squares = [mean_square_v2(hypotheses, log, solution, score) for log in logs]
        return sum(squares) / len(logs)

    effects = []
    for score in scores(shared):
        at = hypotheses.amplitudes_of(score.candidates)
        effects.append(
            EffectEvidence(
                score=score,
                nats=0.5 * score.explained / error.overdispersion_of(score.effect_id),
                excess=excess_chi_square(posterior, logs, references.chi_square, score),
                mean_square_v2=mean_square(
                    posterior.mean - posterior.sensitivity[:, at] @ score.amplitude, score
                ),
            )
        )
    return Evidence(
        effects=tuple(effects),
        all_nats=0.5 * _explained_by_all(posterior) / usual,
        excess=excess_chi_square(posterior, logs, references.chi_square),
        mean_square_v2=mean_square(references.mean),
        reference_excess=reference_level(error.reference_excess),
        reference_v2=error.reference_v2 or error.rmse_v**2,
        expected=frozenset() if problem.covered else EXPECTED_BEYOND,
    )


def reference_level(seen: tuple[float, ...]) -> float:
    """Return the excess of a healthy log: the mean of those seen and of a usual one."""
    return (sum(seen) + USUAL_EXCESS) / (len(seen) + 1.0)


def _explained_by_all(posterior: Posterior) -> float:
    """Return the weighted squares that all candidates together explain within their priors."""
    deviation = _shared_deviation(posterior.hypotheses)
    gradient = deviation * posterior.gradient
    total = posterior.curvature * deviation * deviation[:, None]
    total[np.diag_indices(gradient.size)] += 1.0
    return float(gradient @ np.linalg.solve(total, gradient))


def _shared_deviation(hypotheses: Hypotheses) -> FloatArray:
    """Return the prior deviation of each amplitude if an effect's shapes share its variance."""
    everything = range(len(hypotheses.candidates))
    variance = 1.0 / np.diag(prior_precision(hypotheses.bounds_of(everything)))
    names = [each.effect.id for each in hypotheses.candidates for _ in each.amplitudes]
    shapes = [each.effect.id for each in hypotheses.candidates]
    return np.asarray(np.sqrt(variance / [float(shapes.count(name)) for name in names]))


@dataclass(frozen=True, eq=False)
class Probabilities:
    """The posterior over all answers, and the evidence behind it."""

    effects: tuple[EffectEvidence, ...]
    """All effects, most probable first."""
    of: dict[str, float]
    """Probability of every effect, of `none` and of `unknown`; they sum to 1."""
    explained: float
    """Part of the gap that the best effect explains (0–1)."""


def probabilities(problem: DiagnosisProblem) -> Probabilities:
    """Return the probabilities of `none`, of every effect and of `unknown`."""
    evidence = evidence_of(problem)
    of = posterior_of(evidence)
    effects = sorted(evidence.effects, key=lambda each: -of[each.score.effect_id])
    return Probabilities(tuple(effects), of, evidence.explained(effects[0]))


def posterior_of(evidence: Evidence, by: Calibration = FITTED) -> dict[str, float]:
    """Return the probability of every answer, by some calibration."""
    each = -math.log(len(evidence.effects))
    log_odds = {NONE: by.log_none}
    for effect in evidence.effects:
        name = effect.score.effect_id
        support = evidence.support(effect.nats, effect.excess, effect.mean_square_v2)
        prior = by.log_none if name in evidence.expected else each
        log_odds[name] = prior + by.tail * support
    best = evidence.support(
        (1.0 - UNEXPLAINED) * evidence.all_nats,
        UNEXPLAINED * evidence.excess,
        UNEXPLAINED * evidence.mean_square_v2,
    )
    log_odds[UNKNOWN] = by.log_unknown + by.tail * best
    return _normalized(log_odds)


def _normalized(log_odds: Mapping[str, float]) -> dict[str, float]:
    largest = max(log_odds.values())
    odds = {name: math.exp(value - largest) for name, value in log_odds.items()}
    total = sum(odds.values())
    return {name: value / total for name, value in odds.items()}

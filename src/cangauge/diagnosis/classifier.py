"""From Bayes factors to the probabilities of `none`, of every effect and of `unknown`.

A Bayes factor is exact only if the pack obeys the model and its error is that of the references. On
real packs an effect may have the most evidence and yet leave most of the gap unexplained. Each
effect is therefore described by several features, which a classifier fitted to cases with known
cause weighs:

1. *Which effect*: a conditional logit over the library (McFadden, in Frontiers in Econometrics,
   1974), given that one of the effects is the cause.
2. *Whether there is a cause*: a multinomial logit of three answers: none, the best effect, another.

No feature depends on the name of an effect. `benchmarks/classifier_weights.py` fits the weights to
development cases; none of them is part of a release's check.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cangauge._typing import FloatArray
from cangauge.diagnosis.bayes_factors import (
    Score,
    excess_chi_square,
    expected_mean_square_v2,
    mean_square_v2,
    scores,
)
from cangauge.diagnosis.linear_gaussian import marginalize
from cangauge.diagnosis.problem import DiagnosisProblem

NONE, UNKNOWN = "none", "unknown"

VISIBLE_GAP = 0.25
"""A gap of this part of the references' mean square is measured in volts, a smaller one in units of
chance."""

LEAST_EXCESS, MOST_EXCESS = 0.003, 2.0
LEAST_RMSE, MOST_RMSE = 0.05, 5.0
"""Limits of excess and RMSE with an effect, relative to those without it."""

NATS, RAW_LEAD_NATS = 5.0, 20.0
"""Log Bayes factors are compressed above the first. The lead without overdispersion is relative to
the best's log Bayes factor, or to the second if that is larger."""

CLEAR_NATS, LARGE_NATS = 2.0, 100.0
"""Other leads are clipped at the first, since overdispersion is estimated from few references, and
shrink where the best has more evidence than the second, since no shape of an effect is exactly the
pack's. Chosen among six pairs on the cases that the weights are trained on."""

DECISIVE_NATS = 8.0
"""More evidence, after the effect's own overdispersion, does not make a cause more certain."""

TIE_DECIMALS = 9
"""Decimals to which the utilities of tied effects agree."""

EFFECT_WEIGHTS = (0.561, 0.895, 1.328, 0.935, 0.421, 0.239)
"""Weights of `effect_features`."""

BEST_WEIGHTS = (-3.606, 0.261, 1.285, 0.244, 0.721, 2.337, 0.692, 0.837, 0.064)
OTHER_WEIGHTS = (-1.054, 0.083, 1.027, -0.042, 0.001, -0.146, 1.506, 1.355, 0.253)
"""Weights of `presence_features` for the best effect and for another, against no cause."""

MIN_LOG_BAYES = 5.0
"""Log Bayes factor from which an effect is visible. A verdict requires it only where overdispersion
is unknown: with fewer than two references, or beyond their temperatures."""

MIN_EXPLAINED = 0.4
"""Part of the gap that a named effect must explain there."""

PROBABILITY_CAP = 0.45
"""Largest probability of any effect there: less than an even chance."""

OUTSIDE_LIBRARY, TRAINED_OUTSIDE = 0.25, 0.75 / 1.75
"""Prior probability that a fault is none of the library's: assumed (one in four; a judgement, not
fitted), and in the fit of the weights, which repeats each case without its cause with the weight
0.75 (`benchmarks/classifier_weights.py`)."""

LIBRARY_AT_MOST = 0.9
"""Largest part of "another cause" that other effects of the library take."""

TEMPERATURE_EFFECTS = ("resistance_temperature",)
EXPECTED_FACTOR = 1.6
"""Beyond the references' temperatures the resistance of every healthy pack differs. Another effect
needs this many times its evidence to be named instead. Chosen after two groups of cold LG cells
needed 1.5; not tested on other data."""


@dataclass(frozen=True, eq=False)
class EffectFeatures:
    """Evidence for one effect, and the remaining error with it."""

    score: Score
    """With the mean overdispersion of all effects: an individual smaller one does not make an
    effect more likely."""
    own_log_bayes: float
    """Log Bayes factor with the effect's own overdispersion."""
    raw_log_bayes: float
    """Log Bayes factor without overdispersion."""
    rmse_v: float
    """RMSE of the logs with it, per-log effects included, at the references' current [V]
    (`DiagnosisProblem.noise_scale`)."""
    excess: float
    """Excess chi-square with it (`bayes_factors.excess_chi_square`)."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Features of all effects of the library on one diagnosis."""

    effects: tuple[EffectFeatures, ...]
    baseline_rmse_v: float
    """RMSE without any effect, with the model as the references know it [V]."""
    reference_rmse_v: float
    """The same on left-out references [V]."""
    baseline_excess: float
    expected_rmse_v: float
    """RMSE that logs at these operating points would have without a cause [V]."""
    overdispersion: float = 1.0
    """Geometric mean over the effects (`ErrorModel.overdispersion`)."""

    @property
    def max_log_bayes(self) -> float:
        """Largest log Bayes factor, each effect with its own overdispersion."""
        return max(each.own_log_bayes for each in self.effects)

    def explained(self, effect: EffectFeatures) -> float:
        """Return the part of the gap that an effect explains (0–1).

        By mean square error beyond the references'; by excess chi-square if that gap is small.
        """
        before, reference = self.baseline_rmse_v**2, self.reference_rmse_v**2
        gap = before - reference
        if gap > VISIBLE_GAP * reference:
            return float(np.clip((before - max(effect.rmse_v**2, reference)) / gap, 0.0, 1.0))
        if self.baseline_excess <= 0.0:
            return 0.0
        return float(np.clip(1.0 - effect.excess / self.baseline_excess, 0.0, 1.0))

    def log_rmse_reduction(self, effect: EffectFeatures) -> float:
        """Return ln of the RMSE without over that with an effect."""
        ratio = effect.rmse_v / max(self.baseline_rmse_v, 1e-9)
        return -math.log(min(max(ratio, LEAST_RMSE), MOST_RMSE))

    def log_excess_reduction(self, effect: EffectFeatures) -> float:
        """Return ln of the excess without over that with an effect."""
        ratio = effect.excess / max(self.baseline_excess, 1e-9)
        return -math.log(min(max(ratio, LEAST_EXCESS), MOST_EXCESS))


def compare_effects(problem: DiagnosisProblem) -> Comparison:
    """Return the features of every effect on the diagnosed logs."""
    hypotheses, error, logs = problem.hypotheses, problem.error, problem.weighted_equations
    posterior = problem.posterior
    references = marginalize(hypotheses, problem.reference_equations, [], error)
    mean = 1.0
    if error.overdispersion:
        mean = math.exp(float(np.mean(np.log([*error.overdispersion.values()]))))

    def by_effect(overdispersion: dict[str, float]) -> dict[str, Score]:
        changed = replace(posterior, error=replace(error, overdispersion=overdispersion))
        return {score.effect_id: score for score in scores(changed)}

    def rmse_v(score: Score) -> float:
        at = hypotheses.amplitudes_of(score.candidates)
        solution = posterior.mean - posterior.sensitivity[:, at] @ score.amplitude
        squares = [mean_square_v2(hypotheses, log, solution, score) for log in logs]
        return math.sqrt(sum(squares) / len(logs))

    own = by_effect(dict(error.overdispersion))
    raw = by_effect({})
    effects = tuple(
        EffectFeatures(
            score=score,
            own_log_bayes=own[effect_id].log_bayes_factor,
            raw_log_bayes=raw[effect_id].log_bayes_factor,
            rmse_v=rmse_v(score),
            excess=excess_chi_square(posterior, logs, references.chi_square, score),
        )
        for effect_id, score in by_effect(dict.fromkeys(error.overdispersion, mean)).items()
    )
    baseline_v2 = sum(mean_square_v2(hypotheses, log, references.mean) for log in logs) / len(logs)
    expected_v2 = sum(expected_mean_square_v2(log, references) for log in logs) / len(logs)
    return Comparison(
        effects=effects,
        baseline_rmse_v=math.sqrt(baseline_v2),
        reference_rmse_v=math.sqrt(error.reference_v2) or error.rmse_v,
        baseline_excess=excess_chi_square(posterior, logs, references.chi_square),
        expected_rmse_v=math.sqrt(expected_v2),
        overdispersion=mean,
    )


@dataclass(frozen=True, eq=False)
class Classification:
    """Effects in the order of their probability."""

    effects: tuple[EffectFeatures, ...]
    shares: FloatArray
    """Probability of each, given that one of them is the cause, shape (effects,)."""
    none: float
    """Probability that there is no cause."""
    best: float
    """Probability that the first effect is the cause."""


def classify(comparison: Comparison) -> Classification:
    """Return the probabilities of the effects and of no cause."""
    effects, shares = rank_effects(comparison, np.array(EFFECT_WEIGHTS))
    features = presence_features(comparison, effects[0], float(shares[0]))
    logits = np.array([0.0, features @ np.array(BEST_WEIGHTS), features @ np.array(OTHER_WEIGHTS)])
    probabilities = np.exp(logits - logits.max())
    probabilities /= probabilities.sum()
    return Classification(
        effects, shares, none=float(probabilities[0]), best=float(probabilities[1])
    )


def rank_effects(
    comparison: Comparison, weights: FloatArray
) -> tuple[tuple[EffectFeatures, ...], FloatArray]:
    """Return the effects, best first, and the share of each, by weights of `effect_features`."""
    utility = np.round(effect_features(comparison) @ weights, TIE_DECIMALS)
    remaining = [(each.rmse_v, each.excess) for each in comparison.effects]
    # Ties are broken by the smaller remaining error, so that the library's order does not matter.
    order = sorted(range(len(remaining)), key=lambda k: (-utility[k], *remaining[k]))
    shares = np.exp(utility[order] - utility.max())
    return tuple(comparison.effects[k] for k in order), shares / shares.sum()


def effect_features(comparison: Comparison) -> FloatArray:
    """Return the features that decide which effect it is, shape (effects, 6).

    Log Bayes factor; lead (≤ 0) without overdispersion; reduction of the RMSE; reduction of the
    excess; lead with the mean and with the own overdispersion.
    """
    own = np.array([each.own_log_bayes for each in comparison.effects])
    mean = np.array([each.score.log_bayes_factor for each in comparison.effects])
    raw = np.array([each.raw_log_bayes for each in comparison.effects])
    return np.column_stack(
        [
            np.arcsinh(mean / NATS),
            (raw - raw.max()) / max(float(raw.max()), RAW_LEAD_NATS),
            [comparison.log_rmse_reduction(each) for each in comparison.effects],
            [comparison.log_excess_reduction(each) for each in comparison.effects],
            -_deficit(mean),
            -_deficit(own),
        ]
    )


def _deficit(log_bayes: FloatArray) -> FloatArray:
    """Return how far each effect is behind the best, at most `CLEAR_NATS`."""
    best = float(log_bayes.max())
    deficit = (best - log_bayes) / (1.0 + max(best, 0.0) / LARGE_NATS)
    return np.asarray(np.minimum(deficit, CLEAR_NATS))


def presence_features(comparison: Comparison, best: EffectFeatures, share: float) -> FloatArray:
    """Return the features that decide whether there is a cause, shape (9,); the first is 1.

    The last two are near zero on nearly all healthy logs, whether or not the model fits the pack.
    """
    gap = comparison.baseline_rmse_v / max(comparison.expected_rmse_v, 1e-9)
    return np.array(
        [
            1.0,
            math.asinh(comparison.max_log_bayes / NATS),
            comparison.explained(best),
            comparison.log_excess_reduction(best),
            comparison.log_rmse_reduction(best),
            share,
            math.log(min(max(gap, 0.1), 20.0)),
            min(max(best.own_log_bayes / DECISIVE_NATS, 0.0), 1.0),
            math.asinh(best.raw_log_bayes / NATS) / comparison.overdispersion,
        ]
    )


@dataclass(frozen=True, eq=False)
class Probabilities:
    """The posterior over all answers, and the evidence behind it."""

    effects: tuple[EffectFeatures, ...]
    """All effects, most probable first."""
    of: dict[str, float]
    """Probability of every effect, of `none` and of `unknown`; they sum to 1."""
    explained: float
    """Part of the gap that the best effect explains (0–1)."""


def probabilities(problem: DiagnosisProblem) -> Probabilities:
    """Return the probabilities of `none`, of every effect and of `unknown`."""
    comparison = compare_effects(problem)
    found = classify(comparison)
    if not problem.covered:
        found = _prefer_expected(found, TEMPERATURE_EFFECTS)
    explained = comparison.explained(found.effects[0])
    stated = with_outside_prior(stated_probabilities(found))
    if not problem.error.overdispersion:
        visible = comparison.max_log_bayes >= MIN_LOG_BAYES
        stated = _capped(stated, visible=visible and explained >= MIN_EXPLAINED)
    return Probabilities(found.effects, stated, explained)


def with_outside_prior(
    stated: Mapping[str, float], outside: float = OUTSIDE_LIBRARY
) -> dict[str, float]:
    """Return the probabilities for another prior of faults outside the library.

    Bayes' rule with changed priors (Saerens, Latinne, Decaestecker, Neural Computation 14 (2002)
    21); the prior of `none` stays.
    """
    of_library = (1.0 - outside) / (1.0 - TRAINED_OUTSIDE)
    factors = {NONE: 1.0, UNKNOWN: outside / TRAINED_OUTSIDE}
    weighted = {name: p * factors.get(name, of_library) for name, p in stated.items()}
    total = sum(weighted.values())
    return {name: value / total for name, value in weighted.items()}


def _prefer_expected(found: Classification, expected: Sequence[str]) -> Classification:
    """Rank the expected effects first that are visible and nearly as good as the best."""
    needed = max(each.score.log_bayes_factor for each in found.effects) / EXPECTED_FACTOR
    first = [
        k
        for k, each in enumerate(found.effects)
        if each.score.effect_id in expected
        and each.own_log_bayes >= MIN_LOG_BAYES
        and each.score.log_bayes_factor >= needed
    ]
    order = [*first, *(k for k in range(len(found.effects)) if k not in first)]
    shares = found.shares.copy()
    shares[first] = np.maximum(shares[first], shares.max())
    shares = shares[order] / shares.sum()
    return replace(found, effects=tuple(found.effects[k] for k in order), shares=shares)


def _capped(stated: Mapping[str, float], *, visible: bool) -> dict[str, float]:
    """Cap the probability of an effect where overdispersion is unknown.

    Healthy logs may have the same features, so the excess goes to `none`, at most to half of what
    the cap leaves, then to `unknown`. Without a visible effect `none` takes what the cap leaves.
    """
    capped = dict(stated)
    if not visible:
        none = max(stated[NONE], 1.0 - PROBABILITY_CAP)
        rest = (1.0 - none) / max(1.0 - stated[NONE], 1e-12)
        return {name: none if name == NONE else rest * p for name, p in stated.items()}
    best = max(stated.keys() - {NONE, UNKNOWN}, key=lambda name: stated[name])
    excess = max(stated[best] - PROBABILITY_CAP, 0.0)
    to_none = min(excess, max(0.5 * (1.0 - PROBABILITY_CAP) - stated[NONE], 0.0))
    capped[best] -= excess
    capped[NONE] += to_none
    capped[UNKNOWN] += excess - to_none
    return capped


def stated_probabilities(found: Classification) -> dict[str, float]:
    """Return the probability of every effect, of `none` and of `unknown`.

    The probability of another cause is divided among the other effects by their shares; the
    remainder is `unknown`.
    """
    another = max(1.0 - found.none - found.best, 0.0)
    others = found.best * found.shares[1:] / found.shares[0]
    total = float(others.sum())
    if total > LIBRARY_AT_MOST * another:
        others = others * LIBRARY_AT_MOST * another / total
    stated = {
        each.score.effect_id: float(probability)
        for each, probability in zip(found.effects, [found.best, *others], strict=True)
    }
    stated[UNKNOWN] = max(another - float(others.sum()), 0.0)
    stated[NONE] = found.none
    return stated

"""From evidence to a verdict: an effect, `none`, or `unknown`, with a probability.

`none`: no effect beats "no effect" by more than chance does on clean logs. `unknown`: something
does, but the best effect leaves too much of the excess unexplained. Otherwise the effect with the
most evidence, with those that these logs cannot tell from it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cangauge.gap.evidence import Evidence, Score, condition_on, gather, scores
from cangauge.gap.settle import Settled

NONE, UNKNOWN = "none", "unknown"

ACCEPT_LOG_BAYES = 6.0
"""An effect is accepted above this log Bayes factor against no effect. On clean groups of real
trips it was rarely reached; see the README for the false alarms measured."""

FURTHER_LOG_BAYES = 12.0
"""A further effect must have this much evidence beside those accepted."""

FURTHER_AT_MOST = 2

EXPLAINED_AT_LEAST = 0.45
"""The best effect must explain this part of the excess, or the verdict is `unknown`."""

ALIKE_WITHIN = 3.0
"""Effects with a log Bayes factor this close to the best are not told from it."""

TEMPERING = 0.35
"""Log Bayes factors are multiplied by this before they become probabilities: the error is not
Gaussian and the plant is not the model, so evidence is worth less than it claims."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """What the logs say."""

    cause: str
    probability: float
    ambiguous_with: tuple[str, ...]
    accepted: tuple[Score, ...]
    candidates: tuple[Score, ...]
    chances: dict[str, float]
    """Probability of each effect, of `none` and of `unknown`."""
    explained: float
    """Part of the excess that the best effect explains."""


def decide(settled: Settled) -> Verdict:
    """Return the verdict on the diagnosed logs."""
    evidence = gather(
        settled.frame, settled.reference_grams, settled.diagnosed_grams, settled.error
    )
    ranked = scores(evidence)
    best = ranked[0]
    explained = min(best.explained / max(_excess(settled, evidence), best.explained, 1e-9), 1.0)
    chances = _chances(ranked, explained)
    if best.log_bayes_factor < ACCEPT_LOG_BAYES:
        return Verdict(NONE, chances[NONE], (), (), tuple(ranked), chances, explained)
    if explained < EXPLAINED_AT_LEAST:
        return Verdict(UNKNOWN, chances[UNKNOWN], (), (), tuple(ranked), chances, explained)
    alike = tuple(
        score.effect_id
        for score in ranked[1:]
        if score.log_bayes_factor > best.log_bayes_factor - ALIKE_WITHIN
    )
    accepted = _accepted(evidence, best, alike)
    return Verdict(
        best.effect_id,
        chances[best.effect_id],
        alike,
        accepted,
        tuple(ranked),
        chances,
        explained,
    )


def _accepted(evidence: Evidence, best: Score, alike: Sequence[str]) -> tuple[Score, ...]:
    accepted = [best]
    while len(accepted) < FURTHER_AT_MOST:
        rest = scores(
            condition_on(evidence, [score.candidate for score in accepted]),
            leave_out=[*(score.effect_id for score in accepted), *alike],
        )
        if not rest or rest[0].log_bayes_factor < FURTHER_LOG_BAYES:
            break
        accepted.append(rest[0])
    return tuple(accepted)


def _excess(settled: Settled, evidence: Evidence) -> float:
    """Return the weighted sum of squares beyond what clean logs show."""
    clean = 0.0
    if settled.reference_grams:
        alone = gather(settled.frame, settled.reference_grams, [], settled.error)
        clean = alone.squares
    error = settled.error
    rows = sum(gram.rows / error.rows_alike for gram in settled.diagnosed_grams)
    return evidence.squares - clean - rows


def _chances(ranked: Sequence[Score], explained: float) -> dict[str, float]:
    """Return tempered probabilities of every effect, of `none` and of `unknown`."""
    known = 1.0 / (1.0 + math.exp(-10.0 * (explained - EXPLAINED_AT_LEAST)))
    factors = np.array([score.log_bayes_factor for score in ranked])
    weights = np.exp(TEMPERING * (factors - max(factors.max(), ACCEPT_LOG_BAYES)))
    none = math.exp(TEMPERING * (ACCEPT_LOG_BAYES - max(factors.max(), ACCEPT_LOG_BAYES)))
    total = float(weights.sum()) + none
    chances = {
        score.effect_id: known * float(weight) / total
        for score, weight in zip(ranked, weights, strict=True)
    }
    chances[NONE] = none / total
    chances[UNKNOWN] = (1.0 - known) * float(weights.sum()) / total
    return chances

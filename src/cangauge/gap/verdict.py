"""From evidence to a verdict: an effect, `none`, or `unknown`, with a probability.

`none`: no effect beats "no effect" by more than chance does on clean logs. `unknown`: something
does, but the best effect leaves too much of the excess unexplained. Otherwise the effect with the
most evidence, with those that these logs cannot tell from it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cangauge.gap.evidence import Evidence, gather
from cangauge.gap.remainder import excess, kept_v2
from cangauge.gap.scores import Score, condition_on, scores
from cangauge.gap.settle import Settled

FloatArray = NDArray[np.float64]

NONE, UNKNOWN = "none", "unknown"

ACCEPT_LOG_BAYES = 5.0
"""An effect is accepted above this log Bayes factor against no effect. On clean groups of real
trips it was rarely reached; see the README for the false alarms measured."""

FURTHER_LOG_BAYES = 12.0
"""A further effect must have this much evidence beside those accepted."""

FURTHER_AT_MOST = 2

EXPLAINED_AT_LEAST = 0.4
"""The best effect must explain this part of the excess, or the verdict is `unknown`."""

VISIBLE = 0.25
"""A gap of this part of the clean mean square is seen in volts."""

UNKNOWN_BEYOND = 3.0
"""A gap that no effect explains must be so many times what the worst reference shows."""

ALIKE_WITHIN = 3.0
"""Effects with a log Bayes factor this close to the best are not told from it."""

ALIKE_PART = 0.002
"""Nor are those within this part of the best's: of evidence that large, so much is the model's."""

UNSEEN = 0.6
"""Probability of no cause where evidence is large but the best effect takes nothing visible away
and no more is left than references show: 11 of 17 development cases had none, or one of less than
half of the floor."""

TEMPERING = 0.35
"""Log Bayes factors are multiplied by this before they become probabilities: the error is not
Gaussian and the plant is not the model, so evidence is worth less than it claims."""

RIGHT = (-4.1, -0.57, 2.1, 1.95)
"""Logit of the probability that the best effect is the cause: a constant, and factors of the
logarithm of the part of the excess that it leaves, of its lead over the second in parts of its own
evidence, and of the part of the gap in volts that it explains. By logistic regression on
development cases, each diagnosed also with its cause out of the library."""

LEAST_LEFT = 0.003
"""No effect explains more than all but this part of the excess."""

OF_TEMPERATURE = ("resistance_temperature",)
EXPECTED_TIMES = 1.6
"""At temperatures that no reference has, the resistance differs for certain: every cell's grows in
the cold. What resembles it must have so many times its evidence to be named in its place. Chosen
after seeing that two groups of cold LG cells needed 1.5: no data has tested it."""

NONE_MISSED = 0.5
"""Odds that logs which show nothing hide a cause that is too small to be seen."""


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
    excess: float
    """What clean logs do not show, over the most that a reference left out shows."""


def decide(settled: Settled) -> Verdict:
    """Return the verdict on the diagnosed logs."""
    evidence = gather(
        settled.frame, settled.reference_grams, settled.diagnosed_grams, settled.error
    )
    ranked = believable(evidence, expected=() if settled.covered else OF_TEMPERATURE)
    best = ranked.candidates[0]
    alone = gather(settled.frame, settled.reference_grams, [], settled.error)
    before = excess(evidence, settled.diagnosed_grams, alone.squares)
    after = excess(evidence, settled.diagnosed_grams, alone.squares, best)
    explained = _explained(settled, evidence, alone, best)
    chances = _chances(ranked, explained, after / before if before > 0.0 else 1.0)
    beyond = before / max(settled.error.clean_excess, 1.0)

    def verdict(
        cause: str, alike: tuple[str, ...] = (), accepted: tuple[Score, ...] = ()
    ) -> Verdict:
        return Verdict(
            cause, chances[cause], alike, accepted, ranked.candidates, chances, explained, beyond
        )

    if ranked.found < ACCEPT_LOG_BAYES:
        return verdict(NONE)
    if explained < EXPLAINED_AT_LEAST and beyond <= UNKNOWN_BEYOND:
        if chances[NONE] < UNSEEN:
            rest = (1.0 - UNSEEN) / (1.0 - chances[NONE])
            chances = {cause: UNSEEN if cause == NONE else rest * p for cause, p in chances.items()}
        return verdict(NONE)
    if explained < EXPLAINED_AT_LEAST:
        chances[UNKNOWN] += chances[best.effect_id] - min(chances[best.effect_id], 0.1)
        chances[best.effect_id] = min(chances[best.effect_id], 0.1)
        return verdict(UNKNOWN)
    within = max(ALIKE_WITHIN, ALIKE_PART * best.log_bayes_factor)
    alike = tuple(
        score.effect_id
        for score in ranked.candidates[1:]
        if score.log_bayes_factor > best.log_bayes_factor - within
    )
    return verdict(best.effect_id, alike, _accepted(evidence, best, alike))


@dataclass(frozen=True, eq=False)
class Ranked:
    """Effects in the order in which they are believed."""

    candidates: tuple[Score, ...]
    """As if all strayed alike: that one strays less on the references makes it no more likely to
    be what the logs show."""
    found: float
    """Largest log Bayes factor against no effect, each effect by how far it strays itself."""


def believable(evidence: Evidence, expected: Sequence[str] = ()) -> Ranked:
    """Return the effects, the best first.

    That something is there is asked of every effect by its own strays, for a cause shows in more
    effects than its own; which one it is, as if all strayed alike.

    Parameters
    ----------
    evidence : Evidence
    expected : sequence of str
        Effects that come first if they are accepted and nearly as good as the best.
    """
    own = {score.effect_id: score.log_bayes_factor for score in scores(evidence)}
    strays = evidence.error.strays
    alike = (
        dict.fromkeys(strays, float(np.exp(np.mean(np.log([*strays.values()]))))) if strays else {}
    )
    ranked = scores(replace(evidence, error=replace(evidence.error, strays=alike)))
    enough = ranked[0].log_bayes_factor / EXPECTED_TIMES
    ranked.sort(
        key=lambda score: (
            not (
                score.effect_id in expected
                and own[score.effect_id] >= ACCEPT_LOG_BAYES
                and score.log_bayes_factor >= enough
            )
        )
    )
    return Ranked(tuple(ranked), max(own.values()))


def _accepted(evidence: Evidence, best: Score, alike: Sequence[str]) -> tuple[Score, ...]:
    accepted = [best]
    while len(accepted) < FURTHER_AT_MOST:
        rest = scores(
            condition_on(evidence, [k for score in accepted for k in score.candidates]),
            leave_out=[*(score.effect_id for score in accepted), *alike],
        )
        if not rest or rest[0].log_bayes_factor < FURTHER_LOG_BAYES:
            break
        accepted.append(rest[0])
    return tuple(accepted)


def _explained(settled: Settled, evidence: Evidence, alone: Evidence, score: Score) -> float:
    """Return the part of the mean square gap beyond that of clean logs that an effect takes away.

    From the model as the references alone know it, to that model with the effect; what is each
    log's own is not taken off in either.
    """
    frame, grams = settled.frame, settled.diagnosed_grams
    amplitude = score.amplitude
    at = frame.amplitudes_of(score.candidates)
    with_it = evidence.mean - evidence.per_amplitude[:, at] @ amplitude
    before = sum(kept_v2(frame, gram, alone.mean) for gram in grams) / len(grams)
    after = sum(kept_v2(frame, gram, with_it, score.candidates, amplitude) for gram in grams) / len(
        grams
    )
    clean = settled.error.clean_v2 or settled.error.rmse_v**2
    gap = before - clean
    if gap > VISIBLE * clean:
        return float(np.clip((before - max(after, clean)) / gap, 0.0, 1.0))
    # Too small to be seen in volts, yet perhaps certain: then in units of what chance leaves.
    chance = excess(evidence, grams, alone.squares)
    left = excess(evidence, grams, alone.squares, score)
    return float(np.clip(1.0 - left / chance, 0.0, 1.0)) if chance > 0.0 else 0.0


def _chances(ranked: Ranked, explained: float, left: float) -> dict[str, float]:
    """Return the probability of every effect, of `none` and of `unknown`.

    Parameters
    ----------
    ranked : Ranked
    explained : float
        Part of the gap in volts that the best effect explains.
    left : float
        Part of the excess that it leaves.
    """
    factors = np.array([score.log_bayes_factor for score in ranked.candidates])
    lead = (factors[0] - factors[1:].max()) / max(factors[0], 1.0) if factors.size > 1 else 1.0
    terms = (1.0, math.log(min(max(left, LEAST_LEFT), 1.5)), min(max(lead, 0.0), 1.0), explained)
    logit = sum(factor * term for factor, term in zip(RIGHT, terms, strict=True))
    weights = np.exp(TEMPERING * (factors - factors[0]).clip(max=0.0))
    # However well it explains, it is no surer than those allow that explain as much.
    right = min(1.0 / (1.0 + math.exp(-logit)), 1.0 / float(weights.sum()))
    # What the best does not have is shared by how close the others come; that none of them is it
    # counts like an effect as good as the best.
    rest = (1.0 - right) / float(weights.sum())
    something = 1.0 - _none(ranked.found)
    chances = {
        score.effect_id: something * rest * float(weight)
        for score, weight in zip(ranked.candidates, weights, strict=True)
    }
    chances[ranked.candidates[0].effect_id] = something * right
    chances[UNKNOWN] = something * rest
    chances[NONE] = 1.0 - something
    return chances


def _none(found: float) -> float:
    """Return the probability that there is no cause, by the best log Bayes factor against it."""
    return 1.0 / (1.0 + NONE_MISSED * math.exp(min(TEMPERING * max(found, 0.0), 700.0)))

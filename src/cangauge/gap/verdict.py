"""From evidence to a verdict: an effect, `none`, or `unknown`, with a probability.

`none`: what the logs show may well have no cause. `unknown`: they show something for certain, but
no effect is likely enough to be it. Otherwise the most likely effect, with those that are not much
less likely.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cangauge.gap.belief import Belief, believe
from cangauge.gap.compared import compare
from cangauge.gap.evidence import Evidence
from cangauge.gap.scores import Score, condition_on, scores
from cangauge.gap.settle import Settled

NONE, UNKNOWN = "none", "unknown"

ACCEPT_LOG_BAYES = 5.0
"""An effect is seen from this log Bayes factor against no effect. A verdict
asks for it only where nothing is known of how far evidence strays without a cause: with fewer than
two references, or at temperatures that they do not teach."""

EXPLAINED_AT_LEAST = 0.4
"""And, there, that it takes this part of the gap away."""

LARGE = 1.5
"""A gap of so many times what clean logs keep is there, explained or not."""

UNSURE = 0.45
"""Nor is any effect given more than this probability there: less than an even chance."""

SEEN_BELOW, SEEN_IN_SEVERAL_BELOW = 0.1, 0.2
"""Something is there if `none` has less than this probability: in one or two logs, and in more that
share one cause. Healthy days go astray each in its own way, seldom in the same: of 107 healthy
groups of three or four logs two had less than the second."""

SEVERAL = 3
"""Logs."""

NAMED_FROM = 0.2
"""And it is named if the best effect is it with this probability."""

ALIKE_FROM = 0.5
"""Effects that are at least so likely, in parts of the best, are not told from it."""

KNOWN_AT_MOST = 0.9
"""Of what is not the best effect, no more than this part is another of the library."""

FURTHER_LOG_BAYES = 12.0
"""A further effect must have this much evidence beside those accepted …"""

FURTHER_PART = 0.05
"""… and this part of the first one's: no shape of an effect is quite that of the pack, and the more
there is of it, the more is left that looks like another. Chosen on development cases: of 14 false
seconds beside a right first nine had less, of five true ones one."""

MOST_ACCEPTED = 2
"""Causes, the first one included."""

OF_TEMPERATURE = ("resistance_temperature",)
EXPECTED_TIMES = 1.6
"""At temperatures that no reference has, the resistance differs for certain: every cell's grows in
the cold. What resembles it must have so many times its evidence to be named in its place. Chosen
after seeing that two groups of cold LG cells needed 1.5: no data has tested it."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """What the logs say."""

    cause: str
    probability: float
    ambiguous_with: tuple[str, ...]
    accepted: tuple[Score, ...]
    candidates: tuple[Score, ...]
    """The best first."""
    chances: dict[str, float]
    """Probability of each effect, of `none` and of `unknown`."""
    explained: float
    """Part of the gap that the best effect explains."""


def decide(settled: Settled) -> Verdict:
    """Return the verdict on the diagnosed logs."""
    evidence, compared = compare(settled)
    belief = believe(compared)
    if not settled.covered:
        belief = _expecting(belief, OF_TEMPERATURE)
    best = belief.witnesses[0]
    explained = compared.explained(best)
    if settled.error.strays:
        chances = _chances(belief)
        several = len(settled.diagnosed) >= SEVERAL
        seen = belief.none < (SEEN_IN_SEVERAL_BELOW if several else SEEN_BELOW)
        named = seen and belief.best >= NAMED_FROM
    else:
        something = compared.found >= ACCEPT_LOG_BAYES
        explains = something and explained >= EXPLAINED_AT_LEAST
        # No name where `none` or `unknown` is likelier than all effects together.
        believed = _chances(belief)
        some = 1.0 - believed[UNKNOWN] - believed[NONE]
        named = explains and some >= max(believed[UNKNOWN], believed[NONE])
        chances = _chances(_unsure(belief, named=explains))
        seen = named or (something and compared.before_v >= LARGE * compared.clean_v)
    candidates = tuple(witness.score for witness in belief.witnesses)
    if not named:
        cause = UNKNOWN if seen else NONE
        return Verdict(cause, chances[cause], (), (), candidates, chances, explained)
    cause = best.score.effect_id
    alike = tuple(
        score.effect_id
        for score, share in zip(candidates[1:], belief.shares[1:], strict=True)
        if share >= ALIKE_FROM * belief.shares[0]
    )
    accepted = _accepted(evidence, best.score, alike)
    return Verdict(cause, chances[cause], alike, accepted, candidates, chances, explained)


def _expecting(belief: Belief, expected: Sequence[str]) -> Belief:
    """Return the belief with the expected effects first that are seen and nearly as good."""
    enough = max(each.score.log_bayes_factor for each in belief.witnesses) / EXPECTED_TIMES
    first = [
        k
        for k, each in enumerate(belief.witnesses)
        if each.score.effect_id in expected
        and each.own_log_bayes >= ACCEPT_LOG_BAYES
        and each.score.log_bayes_factor >= enough
    ]
    order = [*first, *(k for k in range(len(belief.witnesses)) if k not in first)]
    shares = belief.shares.copy()
    shares[first] = np.maximum(shares[first], shares.max())
    shares = shares[order] / shares.sum()
    return replace(belief, witnesses=tuple(belief.witnesses[k] for k in order), shares=shares)


def _unsure(belief: Belief, *, named: bool) -> Belief:
    """Return the belief where nothing is known of how far evidence strays without a cause."""
    if not named:
        none = max(belief.none, 1.0 - UNSURE)
        return replace(belief, none=none, best=min(belief.best, 0.5 * (1.0 - none)))
    best = min(belief.best, UNSURE)
    # What is taken from it is that healthy logs may be so there.
    none = belief.none + belief.best - best
    return replace(belief, best=best, none=min(none, 0.5 * (1.0 - best)))


def _chances(belief: Belief) -> dict[str, float]:
    """Return the probability of every effect, of `none` and of `unknown`.

    Effects beside the best are as likely as their shares say; what is left is that it is none that
    the library has.
    """
    another = max(1.0 - belief.none - belief.best, 0.0)
    others = belief.best * belief.shares[1:] / belief.shares[0]
    total = float(others.sum())
    if total > KNOWN_AT_MOST * another:
        others = others * KNOWN_AT_MOST * another / total
    chances = {
        each.score.effect_id: float(chance)
        for each, chance in zip(belief.witnesses, [belief.best, *others], strict=True)
    }
    chances[UNKNOWN] = max(another - float(others.sum()), 0.0)
    chances[NONE] = belief.none
    return chances


def _accepted(evidence: Evidence, best: Score, alike: Sequence[str]) -> tuple[Score, ...]:
    accepted = [best]
    enough = max(FURTHER_LOG_BAYES, FURTHER_PART * best.log_bayes_factor)
    while len(accepted) < MOST_ACCEPTED:
        rest = scores(
            condition_on(evidence, [k for score in accepted for k in score.candidates]),
            leave_out=[*(score.effect_id for score in accepted), *alike],
        )
        if not rest or rest[0].log_bayes_factor < enough:
            break
        accepted.append(rest[0])
    return tuple(accepted)

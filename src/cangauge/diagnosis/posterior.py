"""Every effect beside the others: not by its evidence alone, but by what it does to the gap.

A Bayes factor is right if the pack is the model and the error what the references showed. A real
pack is neither, and what mimics its cause in one respect fails in another: an effect may have the
most evidence and yet leave most volts of the gap. So each is looked at in several ways, of which
`belief` weighs each by how much it was worth on packs whose cause was known.

How likely each effect is the cause, learned from packs whose cause was known.

Two steps. *Which*: a conditional logit (McFadden, in Frontiers in Econometrics, 1974) over the
effects of the library, as if one of them were the cause. *Whether*: a multinomial logit of three
answers: there is none, the best is it, or it is another. Neither knows an effect's name, so what
was learned on one pack holds for another as far as evidence and volts mean the same there.

The weights come from `benchmarks/belief.py`, which diagnoses cases of several kinds of packs (none
of them among those of a release's check) and prints the weights below.

From evidence to a verdict: an effect, `none`, or `unknown`, with a probability.

`none`: what the logs show may well have no cause. `unknown`: they show something for certain, but
no effect is likely enough to be it. Otherwise the most likely effect, with those that are not much
less likely.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cangauge._typing import FloatArray
from cangauge.diagnosis.bayes_factors import (
    Score,
    condition_on,
    excess,
    expected_v2,
    kept_v2,
    scores,
)
from cangauge.diagnosis.linear_gaussian import Evidence, gather
from cangauge.diagnosis.problem import DiagnosisProblem

# --- Every effect beside the others: not by its evidence alone, but by what it does to the gap

VISIBLE = 0.25
"""A gap of this part of the clean mean square is seen in volts."""

LEAST_LEFT, MOST_LEFT = 0.003, 2.0
"""No effect leaves less, or counts as leaving more, than these parts of the excess …"""

LEAST_LEFT_V, MOST_LEFT_V = 0.05, 5.0
"""… and of the voltage."""


@dataclass(frozen=True, eq=False)
class Witness:
    """What speaks for one effect."""

    score: Score
    """As if all effects strayed alike on the references: that one strays less makes it no more
    likely to be what the logs show."""
    own_log_bayes: float
    """Log Bayes factor by how far it strays itself."""
    sharp_log_bayes: float
    """Log Bayes factor as if the references did not stray at all."""
    left_v: float
    """RMS of what the logs keep with it, what is each log's own not taken off, as if they were
    driven no harder than the references (`DiagnosisProblem.hardness`) [V]."""
    left_excess: float
    """What it leaves of the excess (`remainder.excess`)."""


@dataclass(frozen=True, eq=False)
class Compared:
    """All effects of the library on one diagnosis."""

    witnesses: tuple[Witness, ...]
    before_v: float
    """RMS of what the logs keep with the model as the references know it, likewise [V]."""
    clean_v: float
    """The same of references left out [V]."""
    before_excess: float
    expected_v: float
    """RMS of what such logs would keep without a cause, where these have been [V]."""
    strays: float = 1.0
    """By how much squared evidence exceeds, on references left out, what chance would give:
    geometric mean over the effects (`ErrorModel.strays`)."""

    @property
    def found(self) -> float:
        """Largest log Bayes factor against no effect, each by how far it strays itself."""
        return max(witness.own_log_bayes for witness in self.witnesses)

    def explained(self, witness: Witness) -> float:
        """Return the part of the gap that an effect takes away (0–1).

        In volts, of the mean square beyond that of clean logs; in units of what chance leaves where
        the gap is too small to be seen in volts, yet perhaps certain.
        """
        before, clean, after = self.before_v**2, self.clean_v**2, witness.left_v**2
        gap = before - clean
        if gap > VISIBLE * clean:
            return float(np.clip((before - max(after, clean)) / gap, 0.0, 1.0))
        if self.before_excess <= 0.0:
            return 0.0
        return float(np.clip(1.0 - witness.left_excess / self.before_excess, 0.0, 1.0))

    def taken_v(self, witness: Witness) -> float:
        """Return the logarithm of voltage before over after an effect."""
        left = witness.left_v / max(self.before_v, 1e-9)
        return -math.log(min(max(left, LEAST_LEFT_V), MOST_LEFT_V))

    def taken_excess(self, witness: Witness) -> float:
        """Return the logarithm of the excess before over after an effect."""
        left = witness.left_excess / max(self.before_excess, 1e-9)
        return -math.log(min(max(left, LEAST_LEFT), MOST_LEFT))


def compare(settled: DiagnosisProblem) -> tuple[Evidence, Compared]:
    """Return the evidence of the diagnosed logs, and every effect beside the others."""
    frame, error, grams = settled.frame, settled.error, settled.judged_grams
    evidence = gather(frame, settled.reference_grams, grams, error)
    alone = gather(frame, settled.reference_grams, [], error)
    own = _by_effect(evidence)
    strays = math.exp(float(np.mean(np.log([*error.strays.values()])))) if error.strays else 1.0
    usual = dict.fromkeys(error.strays, strays)
    alike = _by_effect(replace(evidence, error=replace(error, strays=usual)))
    sharp = _by_effect(replace(evidence, error=replace(error, strays={})))

    def left_v(score: Score) -> float:
        at = frame.amplitudes_of(score.candidates)
        solution = evidence.mean - evidence.per_amplitude[:, at] @ score.amplitude
        kept = [kept_v2(frame, gram, solution, score.candidates, score.amplitude) for gram in grams]
        return math.sqrt(sum(kept) / len(grams))

    witnesses = tuple(
        Witness(
            score=score,
            own_log_bayes=own[effect_id].log_bayes_factor,
            sharp_log_bayes=sharp[effect_id].log_bayes_factor,
            left_v=left_v(score),
            left_excess=excess(evidence, grams, alone.squares, score),
        )
        for effect_id, score in alike.items()
    )
    before_v2 = sum(kept_v2(frame, gram, alone.mean) for gram in grams) / len(grams)
    return evidence, Compared(
        witnesses=witnesses,
        before_v=math.sqrt(before_v2),
        clean_v=math.sqrt(error.clean_v2) or error.rmse_v,
        before_excess=excess(evidence, grams, alone.squares),
        expected_v=math.sqrt(sum(expected_v2(gram, alone) for gram in grams) / len(grams)),
        strays=strays,
    )


def _by_effect(evidence: Evidence) -> dict[str, Score]:
    return {score.effect_id: score for score in scores(evidence)}


# --- How likely each effect is the cause, learned from packs whose cause was known

NATS, SHARP_LEAD_NATS = 5.0, 20.0
"""Log Bayes factors count in full below the first; a lead where references would not stray is a
part of the best's own factor, or of the second where it has less."""

CLEAR_NATS, TOLD_NATS = 2.0, 100.0
"""Other leads count in nats, up to the first: how far references stray is known from a few. And
less where the best has more evidence than the second: no shape of an effect is quite that of the
pack, and a hundredth of the evidence tells none from another. Both chosen on the cases that the
weights are learned from, of six pairs that were tried."""

DECISIVE_NATS = 8.0
"""More evidence than this, by how far the effect strays itself, makes a cause no more certain."""

TIED_DECIMALS = 9
"""Effects whose utilities agree to so many decimals are equals."""

WHICH = (0.561, 0.895, 1.328, 0.935, 0.421, 0.239)
"""Weights of an effect's log Bayes factor, its lead (negative) without strays, what it takes away
in volts and of the excess, and its lead as far as references stray on the whole and in this very
effect (`which_features`)."""

BEST_IS_IT = (-3.606, 0.261, 1.285, 0.244, 0.721, 2.337, 0.692, 0.837, 0.064)
IS_ANOTHER = (-1.054, 0.083, 1.027, -0.042, 0.001, -0.146, 1.506, 1.355, 0.253)
"""Weights for "the best is it" and "it is another", against "none": of one, and of
`whether_features`."""


@dataclass(frozen=True, eq=False)
class Belief:
    """Effects in the order in which they are believed, and how much."""

    witnesses: tuple[Witness, ...]
    shares: FloatArray
    """Probability of each, as if one of them were the cause, shape (effects,)."""
    none: float
    """Probability that there is no cause."""
    best: float
    """Probability that the first is the cause."""


def believe(compared: Compared) -> Belief:
    """Return how likely each effect is the cause."""
    witnesses, shares = ranked(compared, np.array(WHICH))
    features = whether_features(compared, witnesses[0], float(shares[0]))
    logits = np.array([0.0, features @ np.array(BEST_IS_IT), features @ np.array(IS_ANOTHER)])
    chances = np.exp(logits - logits.max())
    chances /= chances.sum()
    return Belief(witnesses, shares, none=float(chances[0]), best=float(chances[1]))


def ranked(compared: Compared, which: FloatArray) -> tuple[tuple[Witness, ...], FloatArray]:
    """Return the effects, the best first, and the share of each, by weights of what is weighed."""
    utility = np.round(which_features(compared) @ which, TIED_DECIMALS)
    left = [(witness.left_v, witness.left_excess) for witness in compared.witnesses]
    # Of equals the one that leaves less, whatever order they come in.
    order = sorted(range(len(left)), key=lambda k: (-utility[k], *left[k]))
    shares = np.exp(utility[order] - utility.max())
    return tuple(compared.witnesses[k] for k in order), shares / shares.sum()


def which_features(compared: Compared) -> FloatArray:
    """Return what is weighed of each effect, shape (effects, 6)."""
    own = np.array([witness.own_log_bayes for witness in compared.witnesses])
    alike = np.array([witness.score.log_bayes_factor for witness in compared.witnesses])
    sharp = np.array([witness.sharp_log_bayes for witness in compared.witnesses])
    return np.column_stack(
        [
            np.arcsinh(alike / NATS),
            (sharp - sharp.max()) / max(float(sharp.max()), SHARP_LEAD_NATS),
            [compared.taken_v(witness) for witness in compared.witnesses],
            [compared.taken_excess(witness) for witness in compared.witnesses],
            -_lead(alike),
            -_lead(own),
        ]
    )


def _lead(log_bayes: FloatArray) -> FloatArray:
    """Return by how much the best is ahead of each, at most `CLEAR_NATS`."""
    best = float(log_bayes.max())
    lead = (best - log_bayes) / (1.0 + max(best, 0.0) / TOLD_NATS)
    return np.asarray(np.minimum(lead, CLEAR_NATS))


def whether_features(compared: Compared, best: Witness, share: float) -> FloatArray:
    """Return what is weighed of the best effect: one, and eight more, shape (9,).

    The last two are near zero on nearly all clean logs, on those of packs that the model fits well
    as on others.
    """
    gap = compared.before_v / max(compared.expected_v, 1e-9)
    return np.array(
        [
            1.0,
            math.asinh(compared.found / NATS),
            compared.explained(best),
            compared.taken_excess(best),
            compared.taken_v(best),
            share,
            math.log(min(max(gap, 0.1), 20.0)),
            min(max(best.own_log_bayes / DECISIVE_NATS, 0.0), 1.0),
            math.asinh(best.sharp_log_bayes / NATS) / compared.strays,
        ]
    )


# --- From evidence to a verdict: an effect, `none`, or `unknown`, with a probability

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


def decide(settled: DiagnosisProblem) -> Verdict:
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

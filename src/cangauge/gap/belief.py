"""How likely each effect is the cause, learned from packs whose cause was known.

Two steps. *Which*: a conditional logit (McFadden, in Frontiers in Econometrics, 1974) over the
effects of the library, as if one of them were the cause. *Whether*: a multinomial logit of three
answers: there is none, the best is it, or it is another. Neither knows an effect's name, so what
was learned on one pack holds for another as far as evidence and volts mean the same there.

The weights come from `benchmarks/belief.py`, which diagnoses cases of several kinds of packs (none
of them among those of a release's check) and prints the weights below.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cangauge.gap.compared import Compared, Witness

FloatArray = NDArray[np.float64]

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

"""Every effect beside the others: not by its evidence alone, but by what it does to the gap.

A Bayes factor is right if the pack is the model and the error what the references showed. A real
pack is neither, and what mimics its cause in one respect fails in another: an effect may have the
most evidence and yet leave most volts of the gap. So each is looked at in several ways, of which
`belief` weighs each by how much it was worth on packs whose cause was known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from cangauge.gap.evidence import Evidence, gather
from cangauge.gap.remainder import excess, expected_v2, kept_v2
from cangauge.gap.scores import Score, scores
from cangauge.gap.settle import Settled

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
    driven no harder than the references (`Settled.hardness`) [V]."""
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


def compare(settled: Settled) -> tuple[Evidence, Compared]:
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

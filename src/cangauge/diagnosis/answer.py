"""The answer: one posterior of `none`, `unknown` and the library, from which everything follows.

    u_k = w₁ ln(1 + n_k/o_k) − w₂ ln(V_k/v) + w₃ ln o_k − w₄ ln m_k

with n_k/o_k the evidence of effect k over what healthy logs show of it, V_k the mean square error
with it, v that of a healthy log, and m_k its number of shapes. Effects compete within the library,
which competes with `none` and `unknown` (nested logit: Train, Discrete Choice Methods with
Simulation, 2nd ed., 2009, ch. 4). The group is what a user acts on, so groups, sums of their
effects, are stated first.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.resources import files
from typing import Final, get_args

import numpy as np
from scipy.special import logsumexp

from cangauge._typing import FloatArray
from cangauge.diagnosis.columns import PLACES
from cangauge.diagnosis.evidence import Evidence, References
from cangauge.diagnosis.trials import STEP
from cangauge.model.effects.base import Group
from cangauge.model.effects.library import LIBRARY

NONE: Final = "none"
UNKNOWN: Final = "unknown"

GROUPS: Final[Mapping[str, tuple[str, ...]]] = {
    group: tuple(name for name, effect in LIBRARY.items() if effect.group == group)
    for group in get_args(Group)
}
"""Group → its effects."""

GROUP_OF: Final = {name: effect.group for name, effect in LIBRARY.items()}

TITLES: Final[Mapping[str, str]] = {
    "sensors_and_count": "the sensors and the count of charge",
    "overpotential": "resistance and polarization of the cells",
    "clock": "the time stamps of current and voltage",
    "thermal": "the temperature",
    "weak_cell": "a weak cell",
    NONE: "no gap",
    UNKNOWN: "a cause outside the library",
}
"""Group → what a user reads."""

CHECKS: Final[Mapping[str, str]] = {
    "sensors_and_count": (
        "Rest the pack for an hour at a known SoC, then charge it fully: this separates the"
        " current sensor's offset, the start and the capacity. Check the voltage with a meter."
    ),
    "overpotential": (
        "Measure the resistance with the same pulse at one SoC, warm and cold, and look for a"
        " loose contact."
    ),
    "clock": "Compare the time stamps of current and voltage on a sharp pulse of load.",
    "thermal": "Compare the temperature sensor with a second one, at rest and under load.",
    "weak_cell": "Read the voltages of the single cells near empty.",
    NONE: "Nothing: these logs show no gap beyond that of healthy logs.",
    UNKNOWN: (
        "Check that the references are of this pack and without the fault; then look where the"
        " error lies."
    ),
}
"""Group → what to check first, and what it settles."""

ALARM: Final = 0.05
"""Probability of `none` up to which a gap is reported."""

LIKELY: Final = 0.2
"""Probability of `none` up to which a gap is called likely: odds of 4 to 1."""

STATED: Final = 0.8
"""Part of the library from which one group is stated; else two."""

NAMED: Final = 0.6
"""Part of its group from which an effect is named."""

CREDIBLE: Final = 0.9
"""Probability that the credible set holds at least."""

UNTESTED: Final = 3.0
"""A healthy log may have this many times the error that a model file states: it is of other logs,
and no left-out reference shows how much logs differ."""

Weights = Mapping[str, Sequence[float]]
"""Numbers of the posterior, fitted to labelled cases (`benchmarks/weights`): `inner` of
`Features.inner`; slope and offset of the `library`'s inclusive value; `none` and `unknown` of
`Features.outer`."""


@cache
def shipped_weights() -> Weights:
    """Return the weights in `weights.json`."""
    content = files("cangauge.diagnosis").joinpath("weights.json").read_text("utf-8")
    return dict(json.loads(content)["weights"])


@dataclass(frozen=True, eq=False)
class Features:
    """What the posterior sees of a case."""

    names: tuple[str, ...]
    """Effects of the library, k of them."""
    inner: FloatArray
    """Per effect: ln(1 + n_k/o_k), −ln(V_k/v), ln o_k, −ln m_k; shape (k, 4)."""
    outer: FloatArray
    """ln(V_best/v + 0.1), ln(1 + max n/o), the same less that of healthy logs, ln(V/v), 1."""


def features(known: References, evidence: Evidence, without: Collection[str] = ()) -> Features:
    """Return what the posterior sees of a case, without some effects of the library."""
    effects = {name: e for name, e in evidence.effects.items() if name not in without}
    v, shapes = known.healthy_v2, Counter(trial.effect for trial in known.trials)
    shapes[STEP.effect] = len(PLACES)
    inner = np.array([
        [
            math.log1p(max(e.nats, 0.0)), -math.log(max(e.left_v2 / v, 1e-6)),
            math.log(known.excess_of(name)), -math.log(shapes[name]),
        ]
        for name, e in effects.items()
    ])  # fmt: skip
    left_v2 = np.array([e.left_v2 for e in effects.values()])
    best = np.argmax(inner[:, 0] - np.log(v + left_v2))
    most, usual = float(inner[:, 0].max()), float(np.log1p(known.healthy_nats).mean())
    gap = math.log(evidence.gap_v2 / v) - (0.0 if known.left_out else 2.0 * math.log(UNTESTED))
    outer = [math.log(left_v2[best] / v + 0.1), most, most - usual, gap, 1.0]
    return Features(tuple(effects), inner, np.array(outer))


def probabilities(case: Features, by: Weights) -> dict[str, float]:
    """Return the probability of `none`, `unknown` and every effect; they sum to 1."""
    u = case.inner @ by["inner"]
    library, (slope, offset) = float(logsumexp(u)), by["library"]
    outer = np.array(
        [case.outer @ by["none"], case.outer @ by["unknown"], slope * library + offset]
    )
    none, unknown, any_effect = np.exp(outer - logsumexp(outer)).tolist()
    effects = any_effect * np.exp(u - library)
    return {NONE: none, UNKNOWN: unknown} | dict(zip(case.names, effects.tolist(), strict=True))


@dataclass(frozen=True, eq=False)
class Posterior:
    """One posterior, and what follows from it."""

    probabilities: dict[str, float]
    """Of `none`, `unknown` and every effect; they sum to 1."""
    left_over: float
    """Error that the best effect leaves, in multiples of a healthy log's (RMS)."""
    visible_from: dict[str, float | None]
    """Smallest size of each effect that these logs would have shown; None: no physical size."""
    alarm: float = ALARM
    """P(none) up to which a gap is reported."""

    @cached_property
    def ranked(self) -> dict[str, float]:
        """All answers, most probable first."""
        return dict(sorted(self.probabilities.items(), key=lambda item: -item[1]))

    @property
    def effects(self) -> dict[str, float]:
        """Probability of each effect, most probable first."""
        return {name: p for name, p in self.ranked.items() if name in GROUP_OF}

    @cached_property
    def groups(self) -> dict[str, float]:
        """Probability of each group, of `none` and of `unknown`, most probable first."""
        sums: Counter[str] = Counter()
        for name, p in self.ranked.items():
            sums[GROUP_OF.get(name, name)] += p  # type: ignore[assignment]
        return dict(sums.most_common())

    @property
    def detected(self) -> bool:
        """Whether a gap is reported: `none` is at most as probable as the alarm."""
        return self.probabilities[NONE] <= self.alarm

    @property
    def likely(self) -> bool:
        """Whether there is something to check: a gap is reported, or likely."""
        return self.probabilities[NONE] <= max(self.alarm, LIKELY)

    @property
    def stated_groups(self) -> tuple[str, ...]:
        """The group that holds `STATED` of the library, else the first two."""
        first, *others = [name for name in self.groups if name in GROUPS]
        library = 1.0 - self.probabilities[NONE] - self.probabilities[UNKNOWN]
        return (first, *others[: self.groups[first] < STATED * library])

    @property
    def leading_group(self) -> str:
        """The likeliest group, or `unknown` where that is likelier than the whole library."""
        p = self.probabilities
        return UNKNOWN if 2.0 * p[UNKNOWN] > 1.0 - p[NONE] else self.stated_groups[0]

    @property
    def members(self) -> list[str]:
        """Effects of the likeliest group, most probable first."""
        return [name for name in self.effects if GROUP_OF[name] == self.stated_groups[0]]

    @property
    def name(self) -> str | None:
        """Effect with `NAMED` of the likeliest group; None if no effect stands out."""
        first, group = self.members[0], self.groups[self.stated_groups[0]]
        return first if self.probabilities[first] >= NAMED * group else None

    @property
    def named(self) -> bool:
        """Whether a gap is reported, a library cause leads, and one effect stands out in it."""
        return self.detected and self.verdict == self.name

    @property
    def verdict(self) -> str:
        """Most probable single answer: an effect, `none` or `unknown`."""
        return next(iter(self.ranked))

    @property
    def probability(self) -> float:
        """Probability of the verdict."""
        return self.ranked[self.verdict]

    @property
    def credible_set(self) -> tuple[str, ...]:
        """Smallest set of answers that holds 90 %, most probable first."""
        before = np.cumsum([0.0, *self.ranked.values()])
        return tuple(self.ranked)[: int(np.searchsorted(before, CREDIBLE))]

    @property
    def ambiguous_with(self) -> tuple[str, ...]:
        """Effects of the credible set beside the verdict."""
        return tuple(x for x in self.credible_set if x in GROUP_OF and x != self.verdict)

    @property
    def check_first(self) -> str:
        """What to look at first, and what would settle the cause."""
        return CHECKS[self.leading_group if self.likely else NONE]


def answer(
    known: References,
    evidence: Evidence,
    *,
    without: Collection[str] = (),
    alarm: float = ALARM,
) -> Posterior:
    """Return the posterior of a case, without some effects, and what follows from it."""
    case = features(known, evidence, without)
    stated = probabilities(case, shipped_weights())
    best = evidence.effects[max(case.names, key=lambda name: stated[name])]
    visible = {name: evidence.effects[name] for name in case.names}
    return Posterior(
        stated,
        left_over=math.sqrt(best.left_v2 / max(known.healthy_v2, 1e-300)),
        visible_from={k: e.visible if e.visible <= e.trial.bound else None
                      for k, e in visible.items()},
        alarm=alarm,
    )  # fmt: skip

"""The answer: one posterior of `none`, `unknown` and the library, from which everything follows.

    u_k = w₁ ln(1 + n_k / o_k) + w₂ ln((v + V) / (v + V_k)) − w₃ ln m_k + w₄ [in the cold]

with n_k / o_k the evidence of effect k over what healthy logs show of it, V, V_k, v the mean square
errors without it, with it, and of a healthy log, and m_k its number of shapes. Effects compete
within the library, which competes with `none` and `unknown` (nested logit: Train, Discrete Choice
Methods with Simulation, 2nd ed., 2009, ch. 4). The group is what a user acts on, so groups, sums of
their effects, are stated first.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any, Final, Self

import numpy as np
from scipy.special import logsumexp

from cangauge._typing import FloatArray
from cangauge.diagnosis.columns import PLACES
from cangauge.diagnosis.evidence import Evidence, References
from cangauge.diagnosis.trials import STEP

NONE: Final = "none"
UNKNOWN: Final = "unknown"

GROUPS: Final[Mapping[str, tuple[str, ...]]] = {
    "sensors_and_count": (
        "current_offset", "current_gain", "voltage_offset", "voltage_gain", "capacity",
        "initial_soc", "coulombic_efficiency",
    ),
    "overpotential": (
        "resistance_temperature", "resistance_soc", "resistance_asymmetry", "resistance_step",
        "charge_transfer", "fast_polarization", "slow_diffusion", "hysteresis",
    ),
    "clock": ("time_skew",),
    "thermal": ("temperature_lag", "core_temperature", "entropic_coefficient"),
    "weak_cell": ("weak_cell",),
}  # fmt: skip
"""Group → its effects: what an engineer would look at together."""

GROUP_OF: Final = {effect: group for group, effects in GROUPS.items() for effect in effects}

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
"""Probability of `none` up to which a gap is reported. With every data set held out, 3 of 92
healthy logs raised an alarm at it (../docs)."""

STATED: Final = 0.8
"""Part of the library from which one group is stated; else two. Groups with as much were right in
97 % of cases of held-out data sets."""

NAMED: Final = 0.6
"""Part of its group from which an effect is named."""

CREDIBLE: Final = 0.9
"""Probability that the credible set holds at least."""

COLDER_K: Final = 3.0
"""Distance from the references' temperatures at which a rise of resistance is expected [K]."""


@dataclass(frozen=True)
class Weights:
    """Numbers of the posterior, fitted to labelled cases (`benchmarks/weights`)."""

    nats: float
    """w₁."""
    volts: float
    """w₂."""
    shapes: float
    """w₃."""
    cold: float
    """w₄, for resistance_temperature beyond the references' temperatures."""
    library: tuple[float, float]
    """Slope and offset of the library's inclusive value."""
    none: tuple[float, float, float, float]
    """Of `Features.outer`."""
    unknown: tuple[float, float, float, float]
    """Of `Features.outer`."""

    @classmethod
    def of(cls, numbers: Mapping[str, Any]) -> Self:
        """Return the weights of a mapping with these names."""
        fields: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in numbers.items()
        }
        return cls(**fields)

    @classmethod
    def shipped(cls) -> Self:
        """Return the weights in `weights.json`."""
        return cls.of(_weights_file()["weights"])


@cache
def _weights_file() -> dict[str, Any]:
    content = files("cangauge.diagnosis").joinpath("weights.json").read_text("utf-8")
    return dict(json.loads(content))


@dataclass(frozen=True, eq=False)
class Features:
    """What the posterior sees of a case."""

    names: tuple[str, ...]
    """Effects of the library, k of them."""
    inner: FloatArray
    """Per effect: ln(1 + n_k/o_k), ln((v + V)/(v + V_k)), −ln m_k, cold; shape (k, 4)."""
    outer: FloatArray
    """ln(V_best/v + 0.1), ln(1 + max n/o), the same less that of healthy logs, 1; shape (4,)."""


def features(
    known: References, evidence: Evidence, colder_k: float = 0.0, without: Collection[str] = ()
) -> Features:
    """Return what the posterior sees of a case.

    Parameters
    ----------
    known : References
    evidence : Evidence
    colder_k : float
        Distance of the logs from the references' temperatures [K].
    without : collection of str
        Effects taken out of the library.
    """
    effects = {name: e for name, e in evidence.effects.items() if name not in without}
    v, shapes = known.healthy_v2, Counter(trial.effect for trial in known.trials)
    shapes[STEP.effect] = len(PLACES)
    inner = np.array([
        [
            np.log1p(max(e.nats, 0.0)),
            np.log((v + evidence.gap_v2) / (v + e.left_v2)),
            -math.log(shapes[name]),
            min(colder_k / COLDER_K, 1.0) * (name == "resistance_temperature"),
        ]
        for name, e in effects.items()
    ])  # fmt: skip
    best = list(effects.values())[int(np.argmax(inner[:, 0] + inner[:, 1]))]
    most = float(inner[:, 0].max())
    usual = float(np.log1p(known.healthy_nats).mean())
    outer = np.array([np.log(best.left_v2 / v + 0.1), most, most - usual, 1.0])
    return Features(tuple(effects), inner, outer)


def probabilities(case: Features, by: Weights) -> dict[str, float]:
    """Return the probability of `none`, `unknown` and every effect; they sum to 1.

    Parameters
    ----------
    case : Features
    by : Weights
    """
    u = case.inner @ [by.nats, by.volts, by.shapes, by.cold]
    library = float(logsumexp(u))
    outer = np.array([
        case.outer @ by.none, case.outer @ by.unknown, by.library[0] * library + by.library[1]
    ])  # fmt: skip
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

    @property
    def groups(self) -> dict[str, float]:
        """Probability of each group, of `none` and of `unknown`, most probable first."""
        sums = {name: self.probabilities[name] for name in (NONE, UNKNOWN)}
        for effect, p in self.probabilities.items():
            if effect in GROUP_OF:
                sums[GROUP_OF[effect]] = sums.get(GROUP_OF[effect], 0.0) + p
        return dict(sorted(sums.items(), key=lambda item: -item[1]))

    @property
    def group_shares(self) -> dict[str, float]:
        """Part of the library that each group holds, largest first."""
        library = {name: p for name, p in self.groups.items() if name in GROUPS}
        total = max(sum(library.values()), 1e-300)
        return {name: p / total for name, p in library.items()}

    @property
    def effects(self) -> dict[str, float]:
        """Probability of each effect, most probable first."""
        ranked = sorted(self.probabilities.items(), key=lambda item: -item[1])
        return {name: p for name, p in ranked if name in GROUP_OF}

    @property
    def detected(self) -> bool:
        """Whether a gap is reported: `none` is at most as probable as the alarm."""
        return self.probabilities[NONE] <= self.alarm

    @property
    def stated_groups(self) -> tuple[str, ...]:
        """The group that holds `STATED` of the library, else the first two; () if unknown leads."""
        first, *others = self.group_shares.items()
        if first[1] >= STATED or not others:
            return (first[0],)
        return first[0], others[0][0]

    @property
    def name(self) -> str | None:
        """Effect with `NAMED` of the first group; None if no effect stands out."""
        group = self.stated_groups[0]
        of_group = [name for name in self.effects if GROUP_OF[name] == group]
        total = sum(self.probabilities[name] for name in of_group)
        stands_out = self.probabilities[of_group[0]] >= NAMED * total
        return of_group[0] if stands_out else None

    @property
    def named(self) -> bool:
        """Whether a gap is reported, a library cause leads, and one effect stands out in it."""
        return self.detected and self.verdict == self.name

    @property
    def verdict(self) -> str:
        """Most probable single answer: an effect, `none` or `unknown`."""
        return max(self.probabilities, key=lambda name: self.probabilities[name])

    @property
    def probability(self) -> float:
        """Probability of the verdict."""
        return self.probabilities[self.verdict]

    @property
    def credible_set(self) -> tuple[str, ...]:
        """Smallest set of answers that holds 90 %, most probable first."""
        chosen, total = [], 0.0
        for name, p in sorted(self.probabilities.items(), key=lambda item: -item[1]):
            if total >= CREDIBLE:
                break
            chosen.append(name)
            total += p
        return tuple(chosen)

    @property
    def ambiguous_with(self) -> tuple[str, ...]:
        """Effects of the credible set beside the verdict."""
        apart = {self.verdict, NONE, UNKNOWN}
        return tuple(name for name in self.credible_set if name not in apart)

    @property
    def check_first(self) -> str:
        """What to look at first, and what would settle the cause."""
        if not self.detected:
            return CHECKS[NONE]
        return CHECKS[self.leading_group]

    @property
    def leading_group(self) -> str:
        """The likeliest group, or `unknown` where that is likelier than the whole library."""
        p = self.probabilities
        library = 1.0 - p[NONE] - p[UNKNOWN]
        return UNKNOWN if p[UNKNOWN] > library else self.stated_groups[0]


def answer(
    known: References,
    evidence: Evidence,
    colder_k: float = 0.0,
    *,
    weights: Weights | None = None,
    without: Collection[str] = (),
    alarm: float = ALARM,
) -> Posterior:
    """Return the posterior of a case and what follows from it.

    Parameters
    ----------
    known : References
    evidence : Evidence
    colder_k : float
        Distance of the logs from the references' temperatures [K].
    weights : Weights, optional
        By default those that ship.
    without : collection of str
        Effects taken out of the library.
    alarm : float
        P(none) up to which a gap is reported.
    """
    case = features(known, evidence, colder_k, without)
    stated = probabilities(case, weights or Weights.shipped())
    effects = {name: evidence.effects[name] for name in case.names}
    best = max(case.names, key=lambda name: stated[name])
    return Posterior(
        stated,
        left_over=math.sqrt(effects[best].left_v2 / max(known.healthy_v2, 1e-300)),
        visible_from={
            name: e.visible if e.visible <= e.trial.bound else None for name, e in effects.items()
        },
        alarm=alarm,
    )

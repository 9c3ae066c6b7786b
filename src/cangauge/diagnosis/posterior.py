"""One calibrated posterior of `none`, `unknown` and nine faults.

    u_k = w₁·ln(1 + n_k/o_k) − w₂·ln(1 + V_k/v) − w₃·ln(1 + (n_max − n_k)/o_k)
    P(fault | gap) ∝ (mean over its effects of e^u_k)^γ

with n_k/o_k the evidence of effect k over what healthy logs show of it, V_k the mean square error
that it leaves, v that of a healthy log, and n_max the largest evidence of any effect. Many
effects explain much of a large fault, so the first two terms hardly separate them. The third term
does: it is the evidence that an effect lacks against the best one.

The faults compete with each other, and together with `none` and `unknown` (nested logit: Train,
Discrete Choice Methods with Simulation, 2nd ed., 2009, ch. 4). w, γ and the weights of the outer
features are fitted to labelled cases with packs held out (`benchmarks/weights`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.resources import files
from operator import itemgetter
from typing import Any, Final, get_args

import numpy as np
from scipy.special import logsumexp, softmax

from cangauge._typing import FloatArray
from cangauge.diagnosis.evidence import Evidence
from cangauge.diagnosis.pack import Healthy, LogRows
from cangauge.model.effects.base import FaultName
from cangauge.model.effects.library import LIBRARY

NONE: Final = "none"
UNKNOWN: Final = "unknown"

FAULTS: Final[tuple[str, ...]] = get_args(FaultName)

ALARM, LIKELY = 0.05, 0.2
"""Probability of `none` up to which a gap is reported, and up to which it is called likely: odds of
4 to 1."""

ALIKE: Final = {
    "level of the voltage": ("voltage_reading", "start", "slow_voltage"),
    "count of the charge": ("current_reading", "capacity"),
    "drop under load": ("resistance", "temperature"),
}
"""What is off → faults that make it so and look alike over a narrow SoC or temperature."""

UNTESTED: Final = 3.0
"""Assumed where no left-out reference shows how much healthy logs differ: a healthy log has this
many times the RMS error that the model file states, and this many nats of evidence of some
effect."""


@cache
def shipped_weights() -> Mapping[str, Any]:
    """Return the weights in `weights.json`."""
    content = files("cangauge.diagnosis").joinpath("weights.json").read_text("utf-8")
    return dict(json.loads(content)["weights"])


@dataclass(frozen=True, eq=False)
class Features:
    """What the posterior sees of a case.

    Parameters
    ----------
    effects : dict of str to array of shape (3,)
        ln(1 + n_k/o_k), −ln(1 + V_k/v) and −ln(1 + (n_max − n_k)/o_k) of each effect.
    outer : array
        ln(V_best/v + 0.1), ln(1 + max n/o), the same less that of healthy logs, ln(V/v), 1; V is
        the mean square error, and v that of a healthy log at these SoC and temperatures.
    """

    effects: dict[str, FloatArray]
    outer: FloatArray


def features(
    healthy: Healthy, logs: Sequence[LogRows], evidence: Mapping[str, Evidence]
) -> Features:
    """Return what the posterior sees of a case."""
    v = healthy.healthy_v2 + max(healthy.open_v2(logs) - healthy.mean_open_v2, 0.0)
    over = np.array([healthy.excess[name] for name in evidence])
    nats = np.maximum([e.nats for e in evidence.values()], 0.0)
    left = np.array([e.left_v2 for e in evidence.values()]) / v
    lacking = (nats.max() - nats) / over
    each = np.column_stack([np.log1p(nats / over), -np.log1p(left), -np.log1p(lacking)])
    best, most = int(np.argmax(each[:, 0] + each[:, 1])), float(each[:, 0].max())
    usual = np.mean(np.log1p(healthy.nats or UNTESTED))
    gap = healthy.gap_v2(logs) / v / (1.0 if healthy.nats else UNTESTED**2)
    outer = np.array([np.log(left[best] + 0.1), most, most - usual, np.log(gap), 1.0])
    return Features(dict(zip(evidence, each, strict=True)), outer)


def probabilities(case: Features, by: Mapping[str, Any]) -> dict[str, float]:
    """Return the probability of `none`, `unknown` and every effect; they sum to 1."""
    value, within = [], {}
    for fault in FAULTS:
        names = [name for name in case.effects if LIBRARY[name].fault == fault]
        u = np.array([np.dot(by["inner"], case.effects[name]) for name in names])
        value.append(by["exponent"] * (logsumexp(u) - np.log(u.size)))
        within[fault] = dict(zip(names, softmax(u).tolist(), strict=True))
    slope, offset = by["library"]
    outer = [case.outer @ by[NONE], case.outer @ by[UNKNOWN], slope * logsumexp(value) + offset]
    none, unknown, any_fault = softmax(outer).tolist()
    found = {NONE: none, UNKNOWN: unknown}
    for p, parts in zip((any_fault * softmax(value)).tolist(), within.values(), strict=True):
        found |= {name: p * part for name, part in parts.items()}
    return found


@dataclass(frozen=True, eq=False)
class Posterior:
    """Probability of `none`, `unknown` and every effect, and what follows from it.

    Parameters
    ----------
    probabilities : dict of str to float
        They sum to 1.
    alarm : float
        P(none) up to which a gap is reported.
    stated_from : float
        P(fault | gap) from which a fault is stated alone.
    """

    probabilities: Mapping[str, float]
    alarm: float
    stated_from: float

    @property
    def none(self) -> float:
        """Probability that these logs have no fault."""
        return self.probabilities[NONE]

    @property
    def unknown(self) -> float:
        """Probability of a fault that is none of the nine."""
        return self.probabilities[UNKNOWN]

    @cached_property
    def faults(self) -> dict[str, float]:
        """Probability of each fault, most probable first."""
        sums = {fault: sum(self.effects(fault).values()) for fault in FAULTS}
        return dict(sorted(sums.items(), key=itemgetter(1), reverse=True))

    def effects(self, fault: str) -> dict[str, float]:
        """Return the probability of each effect of a fault, most probable first."""
        mine = {
            name: p
            for name, p in self.probabilities.items()
            if name in LIBRARY and LIBRARY[name].fault == fault
        }
        return dict(sorted(mine.items(), key=itemgetter(1), reverse=True))

    @property
    def level(self) -> str:
        """`gap`, `likely` or `none`."""
        if self.none <= self.alarm:
            return "gap"
        return "likely" if self.none <= max(self.alarm, LIKELY) else "none"

    @property
    def leans_to_fault(self) -> bool:
        """Whether a fault is likelier than none."""
        return self.none < 0.5

    @cached_property
    def stated(self) -> tuple[str, ...]:
        """Faults that are stated: the likeliest, with the second where it is not sure enough.

        Empty without a gap, and where `unknown` has more than half of the gap's probability.
        """
        if self.level == "none" or 2.0 * self.unknown > 1.0 - self.none:
            return ()
        first, second, *_ = self.faults
        return (first,) if self.within_gap(first) >= self.stated_from else (first, second)

    @property
    def named(self) -> tuple[str, ...]:
        """Stated faults that the answer names: the second only if both together are sure."""
        return self.stated if self._are_sure(self.stated) else self.stated[:1]

    @property
    def is_sure(self) -> bool:
        """Whether the named faults are together as sure as one must be to be stated alone."""
        return self._are_sure(self.named)

    def _are_sure(self, faults: Sequence[str]) -> bool:
        return sum(map(self.within_gap, faults)) >= self.stated_from

    @property
    def alike(self) -> str | None:
        """What is off, where faults that look alike are together as sure as one must be."""
        if len(self.stated) < 2:
            return None
        sure = (what for what, faults in ALIKE.items() if self._are_sure(faults))
        return next(sure, None)

    def within_gap(self, fault: str) -> float:
        """Return P(fault | gap), the gap being every case but `none`."""
        return self.faults[fault] / max(1.0 - self.none, 1e-12)


def posterior(
    healthy: Healthy,
    logs: Sequence[LogRows],
    evidence: Mapping[str, Evidence],
    alarm: float = ALARM,
) -> Posterior:
    """Return the posterior of a case by the weights that ship."""
    by = shipped_weights()
    return Posterior(probabilities(features(healthy, logs, evidence), by), alarm, by["stated"])

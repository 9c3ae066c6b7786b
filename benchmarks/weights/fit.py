"""Weights by maximum likelihood with ridge, every data set weighing alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import logsumexp

from cangauge.diagnosis.posterior import FAULTS, NONE, UNKNOWN, Features, probabilities
from cangauge.model.effects.library import LIBRARY

CENTRE = np.array([0.7, 0.6, 0.5, 1.5, 0.5, *[0.0] * 11])
SPREAD = np.array([1.0, 1.0, 1.0, 1.0, 0.5, 3.0, *[3.0, 1.0, 1.0, 1.0, 3.0] * 2])
"""Ridge: prior mean and deviation of the three inner weights, the exponent, slope and offset of the
library, and the outer weights of none and unknown."""


@dataclass(frozen=True, eq=False)
class Example:
    """One case: what the posterior sees of it, and the truth.

    Parameters
    ----------
    pack : str
    world : str
    features : Features
    truth : dict
        As drawn; `fault` is a fault, none or unknown.
    logs, references : int
        Their number.
    found : dict
        What else a table reports.
    """

    pack: str
    world: str
    features: Features
    truth: dict[str, Any]
    logs: int
    references: int
    found: dict[str, Any]

    @property
    def floors(self) -> float:
        """Size [floors]; 0 of a healthy case."""
        return float(self.truth.get("floors", 0.0))


def _values(examples: Sequence[Example], inner: np.ndarray) -> np.ndarray:
    """Return the mean of e^u over the effects of each fault, logarithm, shape (n, 9)."""
    columns = []
    for fault in FAULTS:
        names = [name for name, effect in LIBRARY.items() if effect.fault == fault]
        u = np.array([[x.features.effects[name] for name in names] for x in examples]) @ inner
        columns.append(logsumexp(u, axis=1) - np.log(len(names)))
    return np.column_stack(columns)


def fit(examples: Sequence[Example]) -> dict[str, Any]:
    """Return the weights: inner weight and exponent from known faults, then the outer ones."""
    truth = [x.truth["fault"] for x in examples]
    weight = _alike([x.pack for x in examples])
    known = np.array([fault in FAULTS for fault in truth])
    at = np.array([FAULTS.index(fault) for fault in truth if fault in FAULTS])
    few = [x for x, is_known in zip(examples, known, strict=True) if is_known]

    def ridge(v: np.ndarray, first: int) -> float:
        part = slice(first, first + v.size)
        return 0.5 * float(np.sum(((v - CENTRE[part]) / SPREAD[part]) ** 2))

    def fault_loss(v: np.ndarray) -> float:
        u = v[3] * _values(few, v[:3])
        loss = u[np.arange(at.size), at] - logsumexp(u, axis=1)
        return -float(weight[known] @ loss) + ridge(v, 0)

    *inner, exponent = minimize(fault_loss, CENTRE[:4], method="L-BFGS-B").x
    library = logsumexp(exponent * _values(examples, np.array(inner)), axis=1)
    outer = np.array([x.features.outer for x in examples])
    kind = np.array([0 if k else 1 if fault == NONE else 2
                     for k, fault in zip(known, truth, strict=True)])  # fmt: skip

    def outer_loss(v: np.ndarray) -> float:
        z = np.column_stack([v[0] * library + v[1], outer @ v[2:7], outer @ v[7:]])
        loss = z[np.arange(kind.size), kind] - logsumexp(z, axis=1)
        return -float(weight @ loss) + ridge(v, 4)

    found = minimize(outer_loss, CENTRE[4:], method="L-BFGS-B").x.round(4).tolist()
    return {
        "inner": np.round(inner, 4).tolist(),
        "exponent": round(float(exponent), 4),
        "library": found[:2],
        NONE: found[2:7],
        UNKNOWN: found[7:],
    }


def _alike(packs: Sequence[str]) -> np.ndarray:
    """Return weights by which a data set counts as the root of its cases."""
    weight = np.array([packs.count(pack) ** -0.5 for pack in packs])
    return np.asarray(weight * len(packs) / weight.sum())


def held_out(examples: Sequence[Example]) -> list[dict[str, float]]:
    """Return probabilities of every example by weights fitted without its data set."""
    found: list[dict[str, float]] = [{} for _ in examples]
    for pack in sorted({x.pack for x in examples}):
        by = fit([x for x in examples if x.pack != pack])
        for k, x in enumerate(examples):
            if x.pack == pack:
                found[k] = probabilities(x.features, by)
    return found

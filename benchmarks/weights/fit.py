"""Weights by maximum likelihood with ridge, every data set weighing alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from benchmarks.weights.engine import GROUP_OF
from scipy.optimize import minimize
from scipy.special import logsumexp

PARTS = {"inner": 4, "library": 2, "none": 5, "unknown": 5}
"""Numbers of each part, in one array: see `cangauge.diagnosis.answer.Features`."""
INNER, LIBRARY, NONE, UNKNOWN = slice(0, 4), slice(4, 6), slice(6, 11), slice(11, 16)
CENTRE = np.array([1.5, 0.5, 0.5, 0.0, 0.5, *[0.0] * 11])
SPREAD = np.array([1.5, 1.0, 1.0, 1.0, 0.5, 3, 1, 1, 1, 1, 3, 1, 1, 1, 1, 3])
"""Ridge: prior mean and deviation of each number."""
CAUSE_OUT = 0.03
"""Weight of a case whose own effect was taken out of the library; it moves the outer numbers. From
a tenth on they are called `unknown`, but so are one in thirteen healthy logs."""


@dataclass
class Example:
    """One case with its features and truth."""

    pack: str
    world: str
    names: tuple[str, ...]
    inner: np.ndarray
    outer: np.ndarray
    truth: str
    """Effect id, none or unknown."""
    floors: float
    cause_out: bool = False
    case: int = 0
    more: dict[str, Any] = field(default_factory=dict)


class Stack:
    """Examples as arrays: effects of the library in one order, absent ones masked."""

    def __init__(self, examples: Sequence[Example]) -> None:
        self.order = list(GROUP_OF)
        n, k = len(examples), len(self.order)
        self.inner, self.absent = np.zeros((n, k, 4)), np.zeros((n, k))
        self.outer = np.array([x.outer for x in examples])
        for row, x in enumerate(examples):
            at = [self.order.index(name) for name in x.names]
            self.inner[row, at] = x.inner
            self.absent[row, np.setdiff1d(np.arange(k), at)] = -1e9

    def names(self, inner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return ln P(name | library), shape (n, k), and the library's inclusive value, (n,)."""
        u = self.inner @ inner + self.absent
        value = logsumexp(u, axis=1)
        return u - value[:, None], value

    def parts(self, w: np.ndarray, value: np.ndarray) -> np.ndarray:
        """Return ln P of library, none, unknown, shape (n, 3)."""
        library = value * w[LIBRARY][0] + w[LIBRARY][1]
        z = np.column_stack([library, self.outer @ w[NONE], self.outer @ w[UNKNOWN]])
        return z - logsumexp(z, axis=1)[:, None]


def probabilities(w: np.ndarray, examples: Sequence[Example]) -> list[dict[str, float]]:
    """Return the probability of none, unknown and every effect, for each example."""
    stack = Stack(examples)
    names, value = stack.names(w[INNER])
    outer = stack.parts(w, value)
    every = np.exp(outer[:, :1] + names)
    return [
        {"none": float(o[1]), "unknown": float(o[2])}
        | {k: float(v) for k, v in zip(stack.order, row, strict=True) if k in x.names}
        for o, row, x in zip(np.exp(outer), every, examples, strict=True)
    ]


def fit(examples: Sequence[Example], cause_out: float = CAUSE_OUT) -> np.ndarray:
    """Return the weights: the inner ones from effects in the library, then the outer ones."""
    weight = np.array([cause_out if x.cause_out else 1.0 for x in examples])
    pack = np.array([x.pack for x in examples])

    def alike(kept: np.ndarray) -> np.ndarray:
        out = np.zeros(len(pack))
        for p in set(pack[kept]):
            mine = kept & (pack == p)
            out[mine] = kept.sum() / len(set(pack[kept])) / mine.sum()
        return out * weight

    named = np.array([x.truth in x.names and not x.cause_out for x in examples])
    stack = Stack(examples)
    few = Stack([x for x, k in zip(examples, named, strict=True) if k])
    at = np.array([few.order.index(x.truth) for x, k in zip(examples, named, strict=True) if k])
    a = alike(named)[named]

    def name_loss(v: np.ndarray) -> float:
        loss = -float(a @ few.names(v)[0][np.arange(len(at)), at])
        return loss + 0.5 * float(np.sum(((v - CENTRE[:4]) / SPREAD[:4]) ** 2))

    inner = minimize(name_loss, CENTRE[:4], method="L-BFGS-B", bounds=[(0, None)] * 4).x
    value = stack.names(inner)[1]
    target = np.array(
        [1 if x.truth == "none" else 2 if x.truth == "unknown" else 0 for x in examples]
    )
    b, rows = alike(np.ones(len(pack), bool)), np.arange(len(pack))

    def outer_loss(v: np.ndarray) -> float:
        loss = -float(b @ stack.parts(np.concatenate([inner, v]), value)[rows, target])
        return loss + 0.5 * float(np.sum(((v - CENTRE[4:]) / SPREAD[4:]) ** 2))

    return np.concatenate([inner, minimize(outer_loss, CENTRE[4:], method="L-BFGS-B").x])


def held_out(examples: Sequence[Example], **options: Any) -> list[dict[str, float]]:
    """Return probabilities of every example by weights fitted without its data set."""
    out: list[dict[str, float]] = [{} for _ in examples]
    for p in {x.pack for x in examples}:
        w = fit([x for x in examples if x.pack != p], **options)
        at = [k for k, x in enumerate(examples) if x.pack == p]
        for k, found in zip(at, probabilities(w, [examples[k] for k in at]), strict=True):
            out[k] = found
    return out

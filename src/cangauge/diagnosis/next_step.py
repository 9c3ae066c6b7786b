"""The measurement that settles the stated fault, or that separates the two."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from cangauge.diagnosis.evidence import Evidence
from cangauge.diagnosis.faults import FAULT
from cangauge.diagnosis.posterior import Posterior

RESOLUTION: Final = 0.025
"""Resolution of a measurement without a healthy scatter, in bounds of the effect."""
NODES: Final = 7
"""Readings over which an expectation is taken (Gauss–Hermite)."""


@dataclass(frozen=True)
class NextStep:
    """A measurement, and what it is expected to bring.

    Parameters
    ----------
    measurement, instruction : str
    between : (str, str or None)
        The faults to tell apart; the second is None where one is stated.
    before, after : float
        Probability of the true fault among these, today and after the measurement.
    """

    measurement: str
    instruction: str
    between: tuple[str, str | None]
    before: float
    after: float

    def to_dict(self) -> dict[str, Any]:
        """Return the step as in `gap --json`."""
        return {
            "measurement": self.measurement,
            "between": list(self.between),
            "probability_now": self.before,
            "probability_after": self.after,
        }


def next_step(evidence: Evidence, posterior: Posterior) -> NextStep | None:
    """Return the measurement that settles the stated fault; None where none is stated."""
    if not posterior.stated:
        return None
    first = posterior.stated[0]
    second = posterior.stated[1] if len(posterior.stated) > 1 else None
    tried = []
    for fault in posterior.stated:
        before, after = _expected(evidence, posterior, fault)
        tried.append((after, before, fault))
    after, before, fault = max(tried)
    words = FAULT[fault]
    return NextStep(words.measurement, words.instruction, (first, second), before, after)


def _expected(evidence: Evidence, posterior: Posterior, measured: str) -> tuple[float, float]:
    """Return the probability of the truth among the stated faults, now and after a measurement.

    A measurement reads the size of its fault, and nothing of the others.
    """
    effect = next(iter(posterior.effects(measured)))
    of = evidence.effects[effect]
    resolution = of.shape.usual or RESOLUTION * of.shape.bound
    spread = float(np.hypot(resolution, of.std))
    nodes, weights = np.polynomial.hermite_e.hermegauss(NODES)
    now = np.array([posterior.faults[fault] for fault in posterior.stated])
    after = []
    for fault in posterior.stated:
        mean, std = (of.size, spread) if fault == measured else (0.0, resolution)
        each = []
        for reading in (mean + std * nodes).tolist():
            here = _density(reading, of.size, spread)
            others = _density(reading, 0.0, resolution)
            each.append(_settled(posterior, measured, here, others)[fault])
        after.append(float(weights @ each / weights.sum()))
    return float(now @ now / now.sum()), float(now @ after / now.sum())


def _settled(posterior: Posterior, measured: str, here: float, others: float) -> dict[str, float]:
    """Return the probability of each fault after a reading, by Bayes' rule.

    `here` and `others` are the densities of the reading with the measured fault and without; an
    unknown fault may have either.
    """
    found = {fault: p * others for fault, p in posterior.faults.items()}
    found[measured] = posterior.faults[measured] * here
    unknown = posterior.unknown * 0.5 * (here + others)
    total = sum(found.values()) + posterior.none * others + unknown
    return {fault: p / total for fault, p in found.items()}


def _density(x: float, mean: float, std: float) -> float:
    return max(float(np.exp(-0.5 * ((x - mean) / std) ** 2) / std), 1e-300)

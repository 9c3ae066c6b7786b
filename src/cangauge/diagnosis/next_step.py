"""The measurement that settles the stated fault, or that separates the two."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from cangauge.diagnosis.evidence import Evidence
from cangauge.diagnosis.posterior import Posterior

RESOLUTION: Final = 0.025
"""Resolution of a measurement without a healthy scatter, in bounds of the effect."""


def next_step(
    evidence: Mapping[str, Evidence], posterior: Posterior
) -> tuple[str, float, float] | None:
    """Return the stated fault to measure; None where none is stated.

    With it the probability of the truth among the stated faults, now and after the measurement.
    """
    if not posterior.stated:
        return None
    tried = {fault: _expected(evidence, posterior, fault) for fault in posterior.stated}
    after, before, fault = max((after, before, fault) for fault, (before, after) in tried.items())
    return fault, before, after


def _expected(
    evidence: Mapping[str, Evidence], posterior: Posterior, measured: str
) -> tuple[float, float]:
    """Return the probability of the truth among the stated faults, now and after a measurement.

    A measurement reads the size of its fault, and nothing of the others.
    """
    of = evidence[next(iter(posterior.effects(measured)))]
    resolution = of.shape.usual or RESOLUTION * of.shape.bound
    spread = float(np.hypot(resolution, of.std))
    nodes, weights = np.polynomial.hermite_e.hermegauss(7)
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

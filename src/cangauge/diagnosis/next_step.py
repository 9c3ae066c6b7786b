"""The measurement that settles the stated fault, or that separates the two."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cangauge._typing import FloatArray
from cangauge.diagnosis.evidence import Evidence
from cangauge.diagnosis.posterior import Posterior


def next_step(
    evidence: Mapping[str, Evidence], posterior: Posterior
) -> tuple[str, float, float] | None:
    """Return the stated fault to measure; None where none is stated.

    With it the probability of the truth among the stated faults, now and after the measurement.
    """
    if not posterior.stated:
        return None
    now = np.array([posterior.faults[fault] for fault in posterior.stated])
    after, measured = max(
        (_settled(evidence[next(iter(posterior.effects(fault)))], posterior, now), fault)
        for fault in posterior.stated
    )
    return measured, float(now @ now / now.sum()), after / float(now.sum())


def _settled(of: Evidence, posterior: Posterior, now: FloatArray) -> float:
    """Return the probability of the truth that is expected after a fault is measured.

    A measurement reads the size of its fault, and nothing of the others; an unknown fault may show
    either. Its resolution is the healthy scatter, else 2.5 % of the bound.
    """
    resolution = of.shape.usual or 0.025 * of.shape.bound
    spread = float(np.hypot(resolution, of.std))
    nodes, weights = np.polynomial.hermite_e.hermegauss(7)
    is_measured = np.array([fault == of.fault for fault in posterior.stated])[:, None]
    reading = np.where(is_measured, of.size + spread * nodes, resolution * nodes)
    here = np.exp(-0.5 * ((reading - of.size) / spread) ** 2) / spread
    none_of_it = np.exp(-0.5 * (reading / resolution) ** 2) / resolution
    p = posterior.faults[of.fault] + 0.5 * posterior.unknown
    total = np.maximum(p * here + (1.0 - p) * none_of_it, 1e-300)
    after = np.where(is_measured, here, none_of_it) / total
    return float(now**2 @ after @ weights / weights.sum())

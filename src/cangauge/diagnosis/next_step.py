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
        (float(now @ _settled(evidence, posterior, fault)), fault) for fault in posterior.stated
    )
    return measured, float(now @ now / now.sum()), after / float(now.sum())


def _settled(evidence: Mapping[str, Evidence], posterior: Posterior, measured: str) -> FloatArray:
    """Return the probability of each stated fault that is expected after a measurement, if true.

    A measurement reads the size of its fault, and nothing of the others; an unknown fault may show
    either. Its resolution is the healthy scatter, else 2.5 % of the bound.
    """
    of = evidence[next(iter(posterior.effects(measured)))]
    resolution = of.shape.usual or 0.025 * of.shape.bound
    spread = float(np.hypot(resolution, of.std))
    nodes, weights = np.polynomial.hermite_e.hermegauss(7)
    p = np.array([posterior.faults[fault] for fault in posterior.stated])[:, None]
    is_measured = np.array([fault == measured for fault in posterior.stated])[:, None]
    reading = np.where(is_measured, of.size + spread * nodes, resolution * nodes)
    here = np.exp(-0.5 * ((reading - of.size) / spread) ** 2) / spread
    none_of_it = np.exp(-0.5 * (reading / resolution) ** 2) / resolution
    fault, unknown = posterior.faults[measured], posterior.unknown
    total = (fault + 0.5 * unknown) * here + (1.0 - fault - 0.5 * unknown) * none_of_it
    after = p * np.where(is_measured, here, none_of_it) / np.maximum(total, 1e-300)
    return np.asarray(after @ weights / weights.sum())

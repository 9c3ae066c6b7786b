"""Evidence of a case by the engine under test."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from cangauge.diagnosis.answer import GROUP_OF, GROUPS, Features, features
from cangauge.diagnosis.evidence import Evidence, References, analyse, columns, learn
from cangauge.diagnosis.pack_fit import trace
from cangauge.logs.log import Log

__all__ = ["GROUPS", "GROUP_OF", "colder_k", "evidence", "features_of", "floor_v", "references"]


def references(logs: Sequence[Log], capacity_ah: float) -> References:
    """Learn what reference logs show."""
    return learn([trace(log, capacity_ah) for log in logs], capacity_ah)


def floor_v(logs: Sequence[Log], capacity_ah: float) -> float:
    """Return the RMS error of left-out references [V]."""
    return float(np.sqrt(references(logs, capacity_ah).healthy_v2))


def colder_k(known: References, logs: Sequence[Log]) -> float:
    """Return how far logs lie outside the references' temperatures [K]."""
    low = min(float(x.temperature_c.min()) for x in known.logs)
    high = max(float(x.temperature_c.max()) for x in known.logs)
    seen = np.concatenate([log.temperature_c for log in logs])
    return max(0.0, low - 3.0 - float(seen.min()), float(seen.max()) - high - 3.0)


def evidence(known: References, logs: Sequence[Log], capacity_ah: float) -> Evidence:
    """Return the evidence of every effect in logs that share one cause."""
    return analyse(known, [columns(known, trace(log, capacity_ah)) for log in logs])


def features_of(
    known: References, found: Evidence, logs: Sequence[Log], without: Collection[str] = ()
) -> Features:
    """Return the features of a case."""
    return features(known, found, colder_k(known, logs), without)

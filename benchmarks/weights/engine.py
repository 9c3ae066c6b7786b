"""Evidence of a case by the engine under test."""

from __future__ import annotations

from collections.abc import Sequence

from cangauge.diagnosis.answer import GROUP_OF, GROUPS, features
from cangauge.diagnosis.evidence import Evidence, References, analyse, columns, learn
from cangauge.diagnosis.pack_fit import trace
from cangauge.logs.log import Log

__all__ = ["GROUPS", "GROUP_OF", "evidence", "features", "floor_v", "references"]


def references(logs: Sequence[Log], capacity_ah: float) -> References:
    """Learn what reference logs show."""
    return learn([trace(log, capacity_ah) for log in logs], capacity_ah)


def floor_v(logs: Sequence[Log], capacity_ah: float) -> float:
    """Return the RMS error of left-out references [V]."""
    return references(logs, capacity_ah).healthy_rmse_v


def evidence(known: References, logs: Sequence[Log], capacity_ah: float) -> Evidence:
    """Return the evidence of every effect in logs that share one cause."""
    return analyse(known, [columns(known, trace(log, capacity_ah)) for log in logs])

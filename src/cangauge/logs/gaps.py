"""Gaps of a recorded log: what counts as one, over which charge is counted, where to split.

The usual step of a log is its median: a logger that writes a row every 30 s has no gap of 30 s.
Over a gap up to `bridge_s` charge is interpolated; over a longer one nothing is counted, since the
pack may have rested, or been charged or driven.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.logs.log import Log

BRIDGE_S: Final = 60.0
"""No charge is counted over a longer gap in the current [s]: the pack is assumed to rest."""
USUAL_STEPS: Final = 3.0
"""A step is a gap, whatever its length, above this many usual steps [-]: two rows lost."""
MOVED_PCT: Final = 1.0
"""Change of a log's own SoC over an uncounted gap from which the pack was used in it [%]: the
resolution of a dashboard."""
PIECE_S: Final = 300.0
"""Shortest piece of a split log that is kept [s]: the delay line fills for 70 s of it."""


def usual_step_s(time_s: FloatArray) -> float:
    """Return the median time between rows [s]; 0 for a single row."""
    return float(np.median(np.diff(time_s))) if time_s.size > 1 else 0.0


def usual_gap_s(time_s: FloatArray, gap_s: float) -> float:
    """Return the duration of a gap in a recorded log [s]: `gap_s`, at least 3 usual steps."""
    return max(gap_s, USUAL_STEPS * usual_step_s(time_s))


def bridge_s(time_s: FloatArray) -> float:
    """Return the longest step over which charge is counted [s]."""
    return usual_gap_s(time_s, BRIDGE_S)


def discharged_ah(time_s: FloatArray, current_a: FloatArray) -> FloatArray:
    """Return the charge discharged since the first row [Ah], shape (n,), by the trapezoidal rule.

    Parameters
    ----------
    time_s, current_a : array of shape (n,)
        Time [s] and current [A], positive = discharge. Steps longer than `bridge_s` count nothing.
    """
    step_s = np.diff(time_s)
    if np.max(step_s, initial=0.0) > BRIDGE_S:  # else the median of all steps is not needed
        step_s[step_s > bridge_s(time_s)] = 0.0
    total_ah = np.zeros(time_s.size)
    step_ah = total_ah[1:]  # in place: a log may have millions of rows
    np.add(current_a[1:], current_a[:-1], out=step_ah)
    step_ah *= step_s
    step_ah /= 7200.0
    np.cumsum(step_ah, out=step_ah)
    return total_ah


def uncounted_gaps(time_s: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Return the row before each gap over which nothing is counted."""
    return np.flatnonzero(np.diff(time_s) > bridge_s(time_s))


def split_where_moved(log: Log) -> list[Log]:
    """Split a log at the uncounted gaps over which its own SoC moved: it was charged or driven.

    Each piece begins with its own SoC; those shorter than `PIECE_S` are left out. A log without
    SoC, and one that rested, stays whole.
    """
    if log.soc_pct is None:
        return [log]
    gaps, known = uncounted_gaps(log.time_s), np.flatnonzero(np.isfinite(log.soc_pct))
    after = np.searchsorted(known, gaps, side="right")
    is_between = (after > 0) & (after < known.size)
    gaps, after = gaps[is_between], after[is_between]
    moved_pct = log.soc_pct[known[after]] - log.soc_pct[known[after - 1]]
    cuts = gaps[np.abs(moved_pct) >= MOVED_PCT] + 1
    if not cuts.size:
        return [log]
    ends = pairwise([0, *cuts.tolist(), len(log)])
    pieces = (
        replace(log.rows(slice(*each)), name=f"{log.name} part {k}")
        for k, each in enumerate(ends, start=1)
    )
    return [piece for piece in pieces if piece.duration_s >= PIECE_S] or [log]

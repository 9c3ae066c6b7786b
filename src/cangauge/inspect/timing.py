"""Rates and gaps of a log."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from cangauge.logs.log import FloatArray

GAP_S: Final = 2.0
"""The delay line of the model does not bridge more [s]."""
LISTED_GAPS: Final = 10


@dataclass(frozen=True, slots=True)
class Gap:
    """Time without rows: time of the last row before it, and its length [s]."""

    start_s: float
    length_s: float


@dataclass(frozen=True, slots=True)
class Timing:
    """When the rows of a log are.

    Parameters
    ----------
    start_s, duration_s : float
        Time of the first row, time from it to the last [s].
    interval_median_s, interval_min_s, interval_max_s : float or None
        Time between rows [s]; None for a single row.
    rate_hz : float or None
        1 / median interval [1/s].
    regular : bool
        Whether 99 % of the intervals are within 10 % of the median.
    gap_limit_s : float
        Longer intervals are gaps [s].
    gap_count : int
    gap_total_s : float
        Sum of the gaps [s].
    longest_gaps : tuple of Gap
        The longest first, at most ten.
    """

    start_s: float
    duration_s: float
    interval_median_s: float | None
    interval_min_s: float | None
    interval_max_s: float | None
    rate_hz: float | None
    regular: bool
    gap_limit_s: float
    gap_count: int
    gap_total_s: float
    longest_gaps: tuple[Gap, ...]


def describe_timing(time_s: FloatArray, gap_limit_s: float = GAP_S) -> Timing:
    """Describe increasing time stamps [s] of shape (n,)."""
    step = np.diff(time_s)
    gaps = np.flatnonzero(step > gap_limit_s)
    longest = gaps[np.argsort(-step[gaps], kind="stable")][:LISTED_GAPS]
    median = float(np.median(step)) if step.size else None
    return Timing(
        start_s=float(time_s[0]),
        duration_s=float(time_s[-1] - time_s[0]),
        interval_median_s=median,
        interval_min_s=float(step.min()) if step.size else None,
        interval_max_s=float(step.max()) if step.size else None,
        rate_hz=1.0 / median if median else None,
        regular=bool(median and np.mean(np.abs(step - median) <= 0.1 * median) >= 0.99),
        gap_limit_s=gap_limit_s,
        gap_count=int(gaps.size),
        gap_total_s=float(step[gaps].sum()),
        longest_gaps=tuple(Gap(float(time_s[i]), float(step[i])) for i in longest),
    )

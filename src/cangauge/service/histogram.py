"""Counts in fixed buckets: what the loop fills in a fraction of a microsecond, and others read."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from typing import Final

BOUNDS_S: Final = (
    5e-6, 1e-5, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4,
    1e-3, 2e-3, 5e-3, 1e-2, 2e-2, 5e-2, 0.1, 0.2, 0.5, 1.0,
)  # fmt: skip
"""Upper bounds of the buckets [s]; one more holds what is larger."""


@dataclass(frozen=True, slots=True)
class HistogramCounts:
    """An unchanging copy.

    Parameters
    ----------
    counts : tuple of int
        Per bucket of `BOUNDS_S`, and one for what is larger.
    total_s : float
        Sum of all values [s].
    """

    counts: tuple[int, ...]
    total_s: float

    @property
    def count(self) -> int:
        """Number of values."""
        return sum(self.counts)

    def at_most_s(self, share: float) -> float | None:
        """Return a bound that this share of the values keeps [s].

        It is a bucket's upper end: the quantile lies at it or below, by no more than the bucket.
        None without values, infinite where the quantile is above all bounds.
        """
        count = self.count
        if not count:
            return None
        wanted, seen = share * count, 0
        for bound, number in zip((*BOUNDS_S, float("inf")), self.counts, strict=True):
            seen += number
            if seen >= wanted:
                return bound
        return float("inf")


class Histogram:
    """Counts durations in seconds; for one thread."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS_S) + 1)
        self._total_s = 0.0

    def add(self, value_s: float) -> None:
        """Count one duration [s]."""
        self._counts[bisect_left(BOUNDS_S, value_s)] += 1
        self._total_s += value_s

    def copy(self) -> HistogramCounts:
        """Return what was counted so far."""
        return HistogramCounts(tuple(self._counts), self._total_s)

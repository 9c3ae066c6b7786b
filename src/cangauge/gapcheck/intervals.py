"""95 % intervals: Wilson's for shares, bootstrap percentiles for what is no share."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_Z: Final = 1.959963984540054
_DRAWS: Final = 2000


@dataclass(frozen=True)
class Share:
    """How many of how many."""

    hits: int
    of: int

    @property
    def value(self) -> float | None:
        """Share, or None of nothing."""
        return self.hits / self.of if self.of else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """Wilson's 95 % interval (Wilson 1927)."""
        if not self.of:
            return None
        share, n = self.hits / self.of, self.of
        middle = (share + _Z**2 / (2.0 * n)) / (1.0 + _Z**2 / n)
        half = math.sqrt(share * (1.0 - share) / n + _Z**2 / (4.0 * n**2)) * _Z / (1.0 + _Z**2 / n)
        return max(0.0, middle - half), min(1.0, middle + half)

    def to_dict(self) -> dict[str, Any]:
        """Return value, interval and counts."""
        interval = self.interval
        return {
            "value": self.value,
            "ci": None if interval is None else list(interval),
            "hits": self.hits,
            "of": self.of,
        }


def share(flags: Sequence[bool]) -> Share:
    """Return how many flags are set."""
    return Share(sum(flags), len(flags))


def estimate(values: Sequence[float], statistic: Callable[[FloatArray], float]) -> dict[str, Any]:
    """Return a statistic with its bootstrap interval; the draws are always the same.

    Parameters
    ----------
    values : sequence of float
    statistic : callable
        Array → number, such as the median.
    """
    data = np.asarray(values, dtype=np.float64)
    if data.size == 0:
        return {"value": None, "ci": None, "of": 0}
    rng = np.random.default_rng(0)
    draws = [statistic(data[rng.integers(data.size, size=data.size)]) for _ in range(_DRAWS)]
    low, high = np.quantile(draws, (0.025, 0.975)).tolist()
    return {"value": float(statistic(data)), "ci": [low, high], "of": int(data.size)}

"""How much amplitudes depend on where the pack was charged.

A model's slope over SoC is least known where the curve bends, near empty, and a cause of the charge
is seen best there: chance alone says that its size is known well, and it is wrong by the slope.
What is found without one band of SoC after the other says how far it may be wrong (a jackknife that
leaves out groups: Efron, The Jackknife, the Bootstrap and Other Resampling Plans, 1982, ch. 3).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from cangauge.gap.columns import LogTerms
from cangauge.gap.evidence import Gram, gram_of

FloatArray = NDArray[np.float64]

BANDS = 6
"""Bands of SoC, with as many rows each."""

LEAST_ROWS = 30
"""Fewer rows of a log in a band are left out with no band, having no slow scale of their own."""


def variance_by_charge(
    logs: Sequence[LogTerms],
    scale: FloatArray,
    factors: Sequence[float],
    amplitudes: Callable[[Sequence[Gram]], FloatArray],
) -> FloatArray:
    """Return the variance of amplitudes that differ with the band of SoC that is left out.

    Parameters
    ----------
    logs : sequence of LogTerms
    scale : array of shape (p,)
        Of the baseline's columns.
    factors : sequence of float
        By how much larger each log's error is, as variance (`Gram.weakened`).
    amplitudes : callable
        Returns amplitudes, shape (k,), from the products of the logs.

    Returns
    -------
    array of shape (k,)
    """
    soc_pct = np.concatenate([terms.prepared.rows.soc_pct for terms in logs])
    edges = np.quantile(soc_pct, np.linspace(0.0, 1.0, BANDS + 1)[1:-1])
    of_logs = []
    for terms, factor in zip(logs, factors, strict=True):
        band = np.searchsorted(edges, terms.prepared.rows.soc_pct)
        of_logs.append(
            {
                number: gram_of(terms.at(band == number), scale).weakened(factor)
                for number in range(BANDS)
                if np.count_nonzero(band == number) >= LEAST_ROWS
            }
        )
    found = []
    for left_out in range(BANDS):
        rest = [[gram for k, gram in each.items() if k != left_out] for each in of_logs]
        if any(rest):
            found.append(amplitudes([_sum(grams) for grams in rest if grams]))
    if len(found) < 2:
        return np.zeros(0 if not found else found[0].size)
    differ = np.array(found) - np.mean(found, axis=0)
    return np.asarray((len(found) - 1) / len(found) * np.sum(differ**2, axis=0))


def _sum(grams: Sequence[Gram]) -> Gram:
    """Return the products of parts of one log, whose own terms they share."""
    return Gram(
        np.sum([gram.products for gram in grams], axis=0),
        np.sum([gram.counts for gram in grams], axis=0),
    )

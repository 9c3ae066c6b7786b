"""Where references have been: the temperatures and the charge at which the model is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cangauge.gap.columns import Prepared

FloatArray = NDArray[np.float64]

COVERED_K, COVERED_PCT = 3.0, 3.0
"""References cover temperatures and SoC up to this far outside their own [K, %]."""

COLDER_PART, WARMER_PART = 0.2, 0.5
"""Nor are temperatures foreign that lie below or above by less than these parts of the range that
references have: how the pack follows the temperature, they have shown. In the cold resistance
grows ever faster. (On trips that the check is made of, winter is 0.3 below summer.)"""

BEYOND_WEIGHT = 0.3
"""Weight of a row at a charge that no reference has been at: its error is expected to be larger by
the inverse. What the pseudo-OCV is there, nobody has looked at since the model's own logs. Chosen
on development cases, where no such row had counted before; 0.3 is the only value that was run."""

LEAST_COUNT = 0.1
"""A reference that went where no other has been still counts so much."""


def temperatures_covered(references: Sequence[Prepared], diagnosed: Sequence[Prepared]) -> bool:
    """Return whether most rows of the diagnosed logs are at temperatures that references teach."""
    seen = np.concatenate([item.rows.temperature_c for item in references])
    asked = np.concatenate([item.rows.temperature_c for item in diagnosed])
    spread = float(np.ptp(seen))
    low = seen.min() - max(COVERED_K, COLDER_PART * spread)
    high = seen.max() + max(COVERED_K, WARMER_PART * spread)
    return bool(np.mean((asked >= low) & (asked <= high)) > 0.5)


def charge_weight(
    item: Prepared, references: Sequence[Prepared], taught_pct: tuple[float, float]
) -> FloatArray:
    """Return how much each row of a log tells by where it is charged, shape (m,).

    Parameters
    ----------
    item : Prepared
    references : sequence of Prepared
    taught_pct : tuple of float
        SoC that the model was fitted on, low and high [%].

    Returns
    -------
    array of shape (m,)
        1 where references have been; `BEYOND_WEIGHT` where only the model's own logs have; 0 where
        the pseudo-OCV's formula goes on by itself. All 1 without references.
    """
    soc_pct = item.rows.soc_pct
    if not references:
        return np.ones(soc_pct.size)
    taught = (soc_pct >= taught_pct[0]) & (soc_pct <= taught_pct[1])
    beyond = np.where(taught, BEYOND_WEIGHT, 0.0)
    return np.where(_inside(item, references, "soc_pct", COVERED_PCT), 1.0, beyond)


def counting(references: Sequence[Prepared], diagnosed: Sequence[Prepared]) -> list[float]:
    """Return how much each reference says of how far the diagnosed logs may stray.

    One that went where no other has been shows how the model extrapolates. If the diagnosed logs
    stay where references have been, that is another question, and it counts little.
    """
    asked = min(_part_inside(item, references) for item in diagnosed)
    return [
        max(
            LEAST_COUNT,
            1.0 - asked,
            _part_inside(item, [other for other in references if other is not item]),
        )
        for item in references
    ]


def _part_inside(item: Prepared, others: Sequence[Prepared]) -> float:
    """Return the part of a log's rows within the temperatures and SoC of others [-]."""
    warm = _inside(item, others, "temperature_c", COVERED_K)
    charged = _inside(item, others, "soc_pct", COVERED_PCT)
    return float(np.mean(warm & charged))


def _inside(
    item: Prepared, others: Sequence[Prepared], name: str, margin: float
) -> NDArray[np.bool_]:
    """Return which rows lie within the range of others; all of them, if there are no others."""
    values = getattr(item.rows, name)
    if not others:
        return np.ones(values.size, dtype=bool)
    seen = np.concatenate([getattr(other.rows, name) for other in others])
    return np.asarray((values >= seen.min() - margin) & (values <= seen.max() + margin))

"""The worst moments: where the error is largest, and what happened around them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cangauge.gap.before_after import LogErrors
from cangauge.gap.columns import LogTerms

FloatArray = NDArray[np.float64]

MOMENTS = 10
APART_S = 60.0
"""Moments of one log are at least this far apart, and shown with as much before and after [s]."""


@dataclass(frozen=True)
class Moment:
    """A row with a large error."""

    number: int
    """Which of the diagnosed logs."""
    log: str
    """The log's name."""
    time_s: float
    """The log's own time [s]."""
    residual_v: float
    """Measured − model as given [V]."""
    soc_pct: float
    """Counted SoC [%]."""
    current_a: float
    """Current, positive = discharge [A]."""
    temperature_c: float
    """Temperature [°C]."""

    def to_dict(self) -> dict[str, object]:
        """Return the moment as `gap --json` prints it."""
        return {name: value for name, value in vars(self).items() if name != "number"}


@dataclass(frozen=True, eq=False)
class Around:
    """What happened around a moment; times are relative to it [s]."""

    time_s: FloatArray
    """Of the errors, shape (m,)."""
    before_v: FloatArray
    """Measured − model as given [V], shape (m,)."""
    after_v: FloatArray
    """Measured − extended model [V], shape (m,)."""
    current_time_s: FloatArray
    """Of the current, at the log's own rate, shape (n,)."""
    current_a: FloatArray
    """Shape (n,)."""


def worst_moments(
    logs: Sequence[LogTerms], errors_v: Sequence[FloatArray], number: int = MOMENTS
) -> list[Moment]:
    """Return the moments with the largest error of all logs, the worst first.

    Parameters
    ----------
    logs : sequence of LogTerms
    errors_v : sequence of arrays
        Measured − model on the rows of each log [V].
    number : int
        So many, if the logs are long enough for them.
    """
    found: list[Moment] = []
    for k, (terms, error_v) in enumerate(zip(logs, errors_v, strict=True)):
        rows = terms.prepared.rows
        found += [
            Moment(
                number=k,
                log=rows.name,
                time_s=float(rows.time_s[at]),
                residual_v=float(error_v[at]),
                soc_pct=float(rows.soc_pct[at]),
                current_a=float(rows.delayed_current_a[at, 0]),
                temperature_c=float(rows.temperature_c[at]),
            )
            for at in _peaks(rows.time_s, np.abs(error_v), number)
        ]
    return sorted(found, key=lambda moment: -abs(moment.residual_v))[:number]


def around(moment: Moment, errors: Sequence[LogErrors]) -> Around:
    """Return errors and current from a minute before a moment to a minute after.

    Parameters
    ----------
    moment : Moment
    errors : sequence of LogErrors
        Of all diagnosed logs.
    """
    mine = errors[moment.number]
    time_s, log = mine.prepared.rows.time_s - moment.time_s, mine.prepared.log
    near = np.abs(time_s) <= APART_S
    current_time_s = log.time_s - moment.time_s
    current_near = np.abs(current_time_s) <= APART_S
    return Around(
        time_s=time_s[near],
        before_v=mine.before_v[near],
        after_v=mine.after_v[near],
        current_time_s=current_time_s[current_near],
        current_a=log.current_a[current_near],
    )


def _peaks(time_s: FloatArray, size_v: FloatArray, number: int) -> list[int]:
    """Return the rows of the largest values, at least `APART_S` apart."""
    free = np.ones(size_v.size, dtype=bool)
    found: list[int] = []
    for at in np.argsort(-size_v, kind="stable").tolist():
        if free[at]:
            found.append(at)
            free &= np.abs(time_s - time_s[at]) >= APART_S
        if len(found) == number:
            break
    return found

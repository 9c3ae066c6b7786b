"""How large a fault must be to open a wanted gap."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from cangauge.validation.twin.day import Day
from cangauge.validation.twin.faults import Fault, apply_faults
from cangauge.validation.twin.plant import Plant
from cangauge.validation.twin.simulate import Truth, gap_v, simulate

TOLERANCE: Final = 0.03
_MAX_TRIES: Final = 14
_SHORTEST_S: Final = 900.0


@dataclass(frozen=True, eq=False)
class Scaled:
    """A fault with its size, and the gap that it opens.

    Parameters
    ----------
    fault : Fault
    wanted_v, reached_v : float
        RMS gap over all days [V].
    limited : bool
        Whether the physical limits of the size kept it from what was wanted.
    """

    fault: Fault
    wanted_v: float
    reached_v: float
    limited: bool


def rms_gap_v(
    plant: Plant, days: Sequence[Day], healthy: Sequence[Truth], faults: tuple[Fault, ...]
) -> float:
    """Return the RMS gap that faults open over some days [V]; inf if a car would hardly start.

    Parameters
    ----------
    plant : Plant
    days, healthy : sequences of equal length
        The days and what happens on them without a fault.
    faults : tuple of Fault
    """
    condition = apply_faults(plant.pack, faults)
    total, rows = 0.0, 0
    for day, clean in zip(days, healthy, strict=True):
        truth = simulate(plant, day, condition, clean)
        if truth.rows * day.step_s < min(_SHORTEST_S, 0.5 * float(day.time_s[-1])):
            return float("inf")
        gap = gap_v(plant, day, truth, clean)
        total += float(np.sum(gap**2)) * day.step_s
        rows += round(truth.rows * day.step_s)
    return float(np.sqrt(total / max(rows, 1)))


def scale_to_gap(
    plant: Plant,
    days: Sequence[Day],
    fault: Fault,
    wanted_v: float,
    healthy: Sequence[Truth] | None = None,
) -> Scaled:
    """Return the fault with the size that opens the wanted gap, within its physical limits.

    The search goes by secants in log size against log gap, and halves its bracket where these
    leave it. The fault's own size gives the sign.

    Parameters
    ----------
    plant : Plant
    days : sequence of Day
        The gap is that over all of them.
    fault : Fault
    wanted_v : float
        RMS gap [V].
    healthy : sequence of Truth, optional
        What happens on the days without a fault, if it is known already.
    """
    clean = [simulate(plant, day) for day in days] if healthy is None else healthy
    return find_size(
        lambda sized: rms_gap_v(plant, days, clean, (sized,)),
        fault,
        wanted_v,
        fault.kind.limits(plant.pack),
    )


def find_size(
    gap_of: Callable[[Fault], float], fault: Fault, wanted_v: float, limits: tuple[float, float]
) -> Scaled:
    """Return the fault with the size at which `gap_of` gives the wanted gap.

    Parameters
    ----------
    gap_of : callable
        Fault → RMS gap [V]; inf where the size is impossible.
    fault : Fault
        Its size gives the sign.
    wanted_v : float
        RMS gap [V].
    limits : tuple of float
        Smallest and largest size, positive.
    """
    sign = -1.0 if fault.size < 0.0 else 1.0
    low, high = (float(np.log(limit)) for limit in limits)
    target = float(np.log(wanted_v))
    below: tuple[float, float] | None = None
    above: tuple[float, float] | None = None
    best: tuple[float, float, float] | None = None
    at = 0.5 * (low + high)
    slope = 1.0
    previous: tuple[float, float] | None = None
    for _ in range(_MAX_TRIES):
        gap = gap_of(fault.sized(sign * float(np.exp(at))))
        level = float(np.log(max(gap, 1e-9)))
        away = abs(level - target)
        if np.isfinite(level) and (best is None or away < best[0]):
            best = (away, at, gap)
        if away < TOLERANCE:
            break
        if level < target:
            below = (at, level) if below is None or at > below[0] else below
        else:
            above = (at, level) if above is None or at < above[0] else above
        if (level < target and at >= high) or (level > target and at <= low):
            break
        if previous is not None and np.isfinite(level) and abs(at - previous[0]) > 1e-6:
            slope = float(np.clip((level - previous[1]) / (at - previous[0]), 0.3, 4.0))
        if np.isfinite(level):
            previous = (at, level)
        step_to = at + (target - level) / slope if np.isfinite(level) else low
        at = _inside(step_to, below, above, low, high)
    if best is None:  # even the smallest size stops the car
        return Scaled(fault.sized(0.0), wanted_v, 0.0, limited=True)
    return Scaled(
        fault.sized(sign * float(np.exp(best[1]))),
        wanted_v,
        best[2],
        limited=best[0] > 2.0 * TOLERANCE,
    )


def _inside(
    at: float,
    below: tuple[float, float] | None,
    above: tuple[float, float] | None,
    low: float,
    high: float,
) -> float:
    """Return `at` if it lies within what is known, else the middle of that."""
    first = low if below is None else below[0]
    last = high if above is None else above[0]
    if below is not None and above is not None:
        margin = 0.02 * (last - first)
        return at if first + margin < at < last - margin else 0.5 * (first + last)
    return float(np.clip(at, first, last))

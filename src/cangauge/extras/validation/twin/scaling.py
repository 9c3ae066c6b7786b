"""Size of a fault that opens a given RMS gap, within the physical limits of the fault."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from cangauge.extras.validation.twin.drive import Drive
from cangauge.extras.validation.twin.faults import Fault, apply_faults
from cangauge.extras.validation.twin.plant import Plant
from cangauge.extras.validation.twin.recording import GroundTruth, gap_v, simulate_truth

_TOLERANCE: Final = 0.03
"""Relative error of the gap at which the search stops [-]."""
_MAX_EVALUATIONS: Final = 14
_MIN_DURATION_S: Final = 900.0
"""A size that ends a drive before this, or before its half, is impossible."""


@dataclass(frozen=True, eq=False)
class ScaledFault:
    """A fault scaled to a gap.

    Parameters
    ----------
    fault : Fault
    target_v, reached_v : float
        RMS gap, wanted and reached [V].
    limited : bool
        Whether the physical limits of the size prevent the wanted gap.
    """

    fault: Fault
    target_v: float
    reached_v: float
    limited: bool


def scale_to_gap(
    plant: Plant, drive: Drive, fault: Fault, target_v: float, healthy: GroundTruth
) -> ScaledFault:
    """Scale a fault to an RMS gap [V] over a simulated drive.

    The size of `fault` gives the sign; `healthy` is the drive without it.
    """

    def gap_of(sized: Fault) -> float:
        condition = apply_faults(plant.pack, (sized,))
        truth = simulate_truth(plant, drive, condition, healthy)
        if truth.rows * drive.step_s < min(_MIN_DURATION_S, 0.5 * float(drive.time_s[-1])):
            return float("inf")
        total = float(np.sum(gap_v(plant, drive, truth, healthy) ** 2)) * drive.step_s
        return float(np.sqrt(total / max(round(truth.rows * drive.step_s), 1)))

    return find_size(gap_of, fault, target_v, fault.kind.limits(plant.pack))


def find_size(
    gap_of: Callable[[Fault], float], fault: Fault, target_v: float, limits: tuple[float, float]
) -> ScaledFault:
    """Find the size of a fault at which `gap_of` returns the wanted gap.

    Secant search in log size over log gap, with bisection where a secant leaves the bracket.

    Parameters
    ----------
    gap_of : callable
        Fault → RMS gap [V]; inf if the size is impossible.
    fault : Fault
        Its size gives the sign.
    target_v : float
        RMS gap [V].
    limits : tuple of float
        Smallest and largest size, positive.
    """
    sign = -1.0 if fault.size < 0.0 else 1.0
    low, high = float(np.log(limits[0])), float(np.log(limits[1]))
    target = float(np.log(target_v))
    first, last = low, high
    has_smaller = has_larger = False  # sizes whose gap is too small, and too large
    tried: list[tuple[float, float, float]] = []  # log size, log gap, gap
    at, slope = 0.5 * (low + high), 1.0
    for _ in range(_MAX_EVALUATIONS):
        gap = gap_of(fault.sized(sign * float(np.exp(at))))
        level = float(np.log(max(gap, 1e-9)))
        following = low
        if np.isfinite(level):
            if tried and abs(at - tried[-1][0]) > 1e-6:
                secant = (level - tried[-1][1]) / (at - tried[-1][0])
                slope = float(np.clip(secant, 0.3, 4.0))
            tried.append((at, level, gap))
            following = at + (target - level) / slope
        if abs(level - target) < _TOLERANCE:
            break
        if level < target:
            first, has_smaller = max(first, at), True
        else:
            last, has_larger = min(last, at), True
        if (level < target and at >= high) or (level > target and at <= low):
            break
        margin = 0.02 * (last - first)
        if not (has_smaller and has_larger):
            at = float(np.clip(following, first, last))
        elif first + margin < following < last - margin:
            at = following
        else:
            at = 0.5 * (first + last)
    if not tried:  # even the smallest size is impossible
        return ScaledFault(fault.sized(0.0), target_v, 0.0, limited=True)
    at, level, gap = min(tried, key=lambda each: abs(each[1] - target))
    sized = fault.sized(sign * float(np.exp(at)))
    return ScaledFault(sized, target_v, gap, limited=abs(level - target) > 2.0 * _TOLERANCE)

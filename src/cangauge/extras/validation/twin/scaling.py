"""Size of a fault that opens a given RMS gap, within the physical limits of the fault."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
        RMS gap over all drives, wanted and reached [V].
    limited : bool
        Whether the physical limits of the size prevent the wanted gap.
    """

    fault: Fault
    target_v: float
    reached_v: float
    limited: bool


def _rms_gap_v(
    plant: Plant, drives: Sequence[Drive], healthy: Sequence[GroundTruth], faults: tuple[Fault, ...]
) -> float:
    """Return the RMS gap of faults over some drives [V]; inf if the pack is empty too early."""
    condition = apply_faults(plant.pack, faults)
    total, rows = 0.0, 0
    for drive, clean in zip(drives, healthy, strict=True):
        truth = simulate_truth(plant, drive, condition, clean)
        if truth.rows * drive.step_s < min(_MIN_DURATION_S, 0.5 * float(drive.time_s[-1])):
            return float("inf")
        gap = gap_v(plant, drive, truth, clean)
        total += float(np.sum(gap**2)) * drive.step_s
        rows += round(truth.rows * drive.step_s)
    return float(np.sqrt(total / max(rows, 1)))


def scale_to_gap(
    plant: Plant,
    drives: Sequence[Drive],
    fault: Fault,
    target_v: float,
    healthy: Sequence[GroundTruth] | None = None,
) -> ScaledFault:
    """Scale a fault to an RMS gap over simulated drives.

    Parameters
    ----------
    plant : Plant
    drives : sequence of Drive
    fault : Fault
        Its size gives the sign.
    target_v : float
        RMS gap over all drives [V].
    healthy : sequence of GroundTruth, optional
        The drives without a fault, if known already.
    """
    clean = [simulate_truth(plant, drive) for drive in drives] if healthy is None else healthy
    return find_size(
        lambda sized: _rms_gap_v(plant, drives, clean, (sized,)),
        fault,
        target_v,
        fault.kind.limits(plant.pack),
    )


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
    low, high = (float(np.log(limit)) for limit in limits)
    target = float(np.log(target_v))
    below: tuple[float, float] | None = None
    above: tuple[float, float] | None = None
    best: tuple[float, float, float] | None = None
    at = 0.5 * (low + high)
    slope = 1.0
    previous: tuple[float, float] | None = None
    for _ in range(_MAX_EVALUATIONS):
        gap = gap_of(fault.sized(sign * float(np.exp(at))))
        level = float(np.log(max(gap, 1e-9)))
        away = abs(level - target)
        if np.isfinite(level) and (best is None or away < best[0]):
            best = (away, at, gap)
        if away < _TOLERANCE:
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
    if best is None:  # even the smallest size is impossible
        return ScaledFault(fault.sized(0.0), target_v, 0.0, limited=True)
    return ScaledFault(
        fault.sized(sign * float(np.exp(best[1]))),
        target_v,
        best[2],
        limited=best[0] > 2.0 * _TOLERANCE,
    )


def _inside(
    at: float,
    below: tuple[float, float] | None,
    above: tuple[float, float] | None,
    low: float,
    high: float,
) -> float:
    """Return `at` if it lies within the bracket, else the middle of the bracket."""
    first = low if below is None else below[0]
    last = high if above is None else above[0]
    if below is not None and above is not None:
        margin = 0.02 * (last - first)
        return at if first + margin < at < last - margin else 0.5 * (first + last)
    return float(np.clip(at, first, last))

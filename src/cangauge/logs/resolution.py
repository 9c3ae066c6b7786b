"""Resolution of a channel: its quantization step, and a current read without its sign."""

from __future__ import annotations

from itertools import product
from typing import Final

import numpy as np
from scipy import special

from cangauge._typing import FloatArray
from cangauge.logs.quantities import CURRENT_FIELDS

_FREQUENT: Final = (3, 6, 12, 50)
"""Numbers of most frequent values whose differences are candidates for the quantum."""
_MIN_PLACES: Final = 4
"""Fewest occupied places of a grid."""
_ON_PLACE: Final = 0.9
"""Least share of the rows on a grid that hold the main value of their place."""
_ON_GRID: Final = 0.95
"""Least share of the rows on a grid."""
_OFF_GRID: Final = 0.05
"""Largest distance from a place of the grid, in quanta."""
_HUGS: Final = 0.05
"""Largest distance of the reading nearest to zero from it, relative to the range [-]."""
_BY_CHANCE: Final = 1e-4
"""Probability below which the voltage does not follow the steps of a current by chance [-]: tables
are many, and few of them wrap."""


def wrapped_current(
    current_a: FloatArray, voltage_v: FloatArray
) -> tuple[float, int, float] | None:
    """Return where a current wraps [A], width [bit] and step [A] of its field; None if nowhere.

    A signed current that was read as unsigned continues below zero from `2**width * step`.

    The readings have one sign. Less `wraps_at_a` where they exceed its half, some come near zero,
    and the voltage follows their steps better than those of the readings: it does not move where
    a current passes zero, which is a step of `wraps_at_a` in the readings. Readings without such a
    step must be multiples of the field's.

    Parameters
    ----------
    current_a, voltage_v : array of shape (n,)
        Readings [A], of either sign, and voltage [V].
    """
    if np.any(current_a > 0.0) and np.any(current_a < 0.0):
        return None
    readings = np.abs(current_a)
    largest = float(readings.max())
    steps = np.diff(readings)
    passes_zero = bool(np.any(np.abs(steps) > 0.5 * largest))
    if not passes_zero and readings.min() <= 0.5 * largest:
        return None
    is_high = readings > 0.5 * largest
    range_a = float(np.ptp(np.where(is_high, readings - largest, readings)))
    fields = [
        (2.0**bits * step_a, step_a, bits)
        for bits, step_a in product(CURRENT_FIELDS["bits"], CURRENT_FIELDS["steps_a"])
        if 0.0 <= 2.0**bits * step_a * (1.0 + 1e-9) - largest <= _HUGS * range_a
    ]
    if not fields:
        return None
    wraps_at_a, _, _ = min(fields)
    shows_step, step_a, bits = max(  # the coarsest step that the readings show
        (_is_multiple(readings, step_a), step_a, bits)
        for top_a, step_a, bits in fields
        if top_a == wraps_at_a
    )
    if passes_zero:
        unwrapped = np.where(is_high, readings - wraps_at_a, readings)
        moved_v = np.diff(voltage_v)
        share = _explained(np.diff(unwrapped), moved_v)
        # Of the share that as many random steps explain (Student's t, as a beta distribution).
        by_chance = float(special.betainc(0.5 * max(steps.size - 1, 1), 0.5, 1.0 - share))
        is_wrapped = by_chance < _BY_CHANCE and share > _explained(steps, moved_v)
    else:
        is_wrapped = shows_step and bits in CURRENT_FIELDS["bits"][:3]  # never near zero: the usual
    return (wraps_at_a, bits, step_a) if is_wrapped else None


def _is_multiple(values: FloatArray, step: float) -> bool:
    """Return whether all values are multiples of a step."""
    places = values / step
    return bool(np.all(np.abs(places - np.rint(places)) < 0.01))


def _explained(steps_a: FloatArray, moved_v: FloatArray) -> float:
    """Return the share of the voltage's steps that follows steps of a current [-]."""
    size = float(np.sum(steps_a**2) * np.sum(moved_v**2))
    return float(np.sum(steps_a * moved_v)) ** 2 / size if size else 0.0


def quantum_of(values: FloatArray) -> float | None:
    """Return the quantization step of finite values, shape (n,), or None if there is none.

    It is the largest step on whose grid (through the most frequent value) 95 % of the values lie,
    so that a few interpolated rows do not hide it. Candidates are differences between
    neighbouring values, of the frequent ones and of all.
    """
    distinct, count = np.unique(values, return_counts=True)
    if distinct.size < _MIN_PLACES:
        return None
    noise = 1e-9 * max(abs(float(distinct[0])), abs(float(distinct[-1])))
    by_count = distinct[np.argsort(-count, kind="stable")]
    groups = (*(by_count[:k] for k in _FREQUENT), distinct)
    steps = [np.quantile(np.diff(np.sort(each)), [0.0, 0.02, 0.1, 0.5]) for each in groups]
    for step in sorted({float(step) for each in steps for step in each}, reverse=True):
        if step <= noise:
            break
        offset = (distinct - by_count[0]) / step
        near = np.abs(offset - np.rint(offset)) < _OFF_GRID
        place, weight = np.rint(offset[near]), count[near]
        places, first = np.unique(place, return_index=True)
        if places.size < _MIN_PLACES or weight.sum() < _ON_GRID * values.size:
            continue
        # Several values at one place (64.98 and 65.00 on a grid of 65) mean a finer step.
        if np.maximum.reduceat(weight, first).sum() >= _ON_PLACE * weight.sum():
            from_origin = distinct[near] - by_count[0]
            fitted = np.sum(weight * place * from_origin) / np.sum(weight * place * place)
            return float(f"{fitted:.5g}")
    return None

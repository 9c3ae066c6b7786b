"""Resolution of a channel: its quantization step, and a current read without its sign."""

from __future__ import annotations

from itertools import product
from typing import Final

import numpy as np
from scipy import special

from cangauge._typing import FloatArray
from cangauge.logs.quantities import CURRENT_FIELDS

_ODD: Final = 0.05
"""Share of rows off a grid that are allowed, and their distance from it in quanta [-]."""
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
    if current_a.min() < 0.0 < current_a.max():
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
    wraps_at_a = min(fields)[0]
    shows_step, step_a, bits = max(  # the coarsest step that the readings show
        (_is_multiple(readings, step_a), step_a, bits)
        for top_a, step_a, bits in fields
        if top_a == wraps_at_a
    )
    is_wrapped = shows_step and bits in CURRENT_FIELDS["bits"][:3]  # never near zero: the usual
    if passes_zero:
        moved_v = np.diff(voltage_v)
        share = _explained(np.diff(np.where(is_high, readings - wraps_at_a, readings)), moved_v)
        # Of the share that as many random steps explain (Student's t, as a beta distribution).
        by_chance = float(special.betainc(0.5 * max(steps.size - 1, 1), 0.5, 1.0 - share))
        is_wrapped = by_chance < _BY_CHANCE and share > _explained(steps, moved_v)
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
    if distinct.size < 4:
        return None
    noise = 1e-9 * float(np.max(np.abs(distinct)))
    by_count = distinct[np.argsort(-count, kind="stable")]
    from_origin = distinct - by_count[0]
    groups = [np.sort(by_count[:most]) for most in (3, 6, 12, 50, distinct.size)]
    steps = np.unique([np.quantile(np.diff(each), [0.0, 0.02, 0.1, 0.5]) for each in groups])
    for step in steps[steps > noise][::-1].tolist():
        place = np.rint(from_origin / step)
        near = np.abs(from_origin / step - place) < _ODD
        weight, (places, first) = count[near], np.unique(place[near], return_index=True)
        if places.size < 4 or weight.sum() < (1.0 - _ODD) * values.size:
            continue
        # Several values at one place (64.98 and 65.00 on a grid of 65) mean a finer step.
        if np.maximum.reduceat(weight, first).sum() >= (1.0 - 2.0 * _ODD) * weight.sum():
            moment = np.sum(weight * place[near] * from_origin[near])
            return float(f"{moment / np.sum(weight * place[near] ** 2):.5g}")
    return None

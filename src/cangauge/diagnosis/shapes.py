"""Shapes of the faults: every effect of the model library as columns of a linear model.

A *fault* is what an engineer would repair, such as the voltage reading. It shows as one of several
*effects* of the model library, such as an offset or a gain. An effect has one or more *shapes*: in
each, one amplitude is free and every other parameter has one trial value. The column of a shape is
the change of the residual by it, in units of the amplitude's larger bound.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.diagnosis.rows import Simulated
from cangauge.model.effects.base import Effect, Inputs, Pack
from cangauge.model.effects.library import LIBRARY, EffectCandidate, candidates

STEP_ID: Final = "resistance_step"

PLACES: Final = tuple(float(part) for part in np.arange(10) / 10)
"""Places of a step of resistance, in parts of a log; at its start it has grown before."""

SECANTS_S: Final = (-3.0, -0.7, 0.7, 3.0)
"""Skews about which a column is a secant [s]: beyond the width of a change of load the tangent at
zero is blind."""


@dataclass(frozen=True, eq=False)
class Shape:
    """One amplitude of an effect of a fault, its other parameters fixed.

    Parameters
    ----------
    effect : Effect
        Its `fault` is the fault.
    name : str
        Of the amplitude.
    fixed : dict of str to float
        The other parameters.
    neutral : float
        Amplitude that changes nothing.
    low, high : float
        Bounds of the amplitude relative to `neutral`.
    about : float
        Size of the finite difference.
    usual : float
        Standard deviation of the amplitude between healthy logs.
    place : float, optional
        Of a step of resistance: the part of a log at which it happens; 0 is before its first row.
    """

    effect: Effect
    name: str
    fixed: Mapping[str, float]
    neutral: float
    low: float
    high: float
    about: float
    usual: float = 0.0
    place: float | None = None

    @property
    def bound(self) -> float:
        """The larger bound."""
        return max(-self.low, self.high)

    @property
    def unit(self) -> str:
        """Unit of the amplitude."""
        return next(item.unit for item in self.effect.parameters if item.name == self.name)

    def values(self, size: float) -> dict[str, float]:
        """Return the effect's parameters at a size relative to neutral."""
        return {**self.fixed, self.name: self.neutral + size}

    @property
    def healthy_std(self) -> float:
        """Standard deviation between healthy logs [bounds], of the shape at zero."""
        if self.place is not None or self.low == 0.0 or self.high == 0.0:
            return 0.0
        return self.usual / self.bound

    def in_log(self, duration_s: float) -> Shape:
        """Return the shape in a log of a duration: a step of resistance has its time there."""
        if self.place is None:
            return self
        return replace(self, fixed={**self.fixed, "start_s": self.place * duration_s})


def shapes(pack: Pack) -> tuple[Shape, ...]:
    """Return every shape of every effect, a step of resistance at each place of a log last."""
    found = []
    for effect in LIBRARY.values():
        grids = {item.name: item.trials(pack) for item in effect.shapes if effect.amplitudes}
        # A switch refines a shape that has a grid; its first value is tried.
        first = {
            name: values[0] for name, values in grids.items() if len(values) < 3 and len(grids) > 1
        }
        for item in candidates([effect], pack):
            if all(item.shape.get(name) == value for name, value in first.items()):
                found += _shapes_of(item, pack)
    steps = [shape for shape in found if shape.effect.id == STEP_ID]
    others = [shape for shape in found if shape.effect.id != STEP_ID]
    return (*others, *(replace(step, place=part) for step in steps for part in PLACES))


def _shapes_of(item: EffectCandidate, pack: Pack) -> list[Shape]:
    """Return the shapes of an effect with one trial value of each other parameter."""
    effect, neutral = item.effect, dict(zip(item.amplitudes, item.neutral.tolist(), strict=True))
    usual = {each.name: each.healthy_std * each.factor(pack) for each in effect.parameters}
    if item.shape.get("delayed") == 0.0:
        usual = dict.fromkeys(usual, 0.0)
    fixed = {**neutral, **item.shape}
    sizes = zip(item.amplitudes, item.bounds.tolist(), item.steps.tolist(), strict=True)
    found = [
        Shape(effect, name, fixed, neutral[name], low, high, step, usual[name])
        for name, (low, high), step in sizes
    ]
    if effect.moves_time:
        for about in SECANTS_S:
            low, high = sorted((0.0, 1.5 * about))
            found.append(replace(found[0], low=low, high=high, about=about))
    return found


def shape_columns(of: Simulated, tried: Sequence[Shape]) -> FloatArray:
    """Return the change of voltage by each shape at its bound [V], shape (m, k)."""
    plain, model, rows = of.plain, of.model, of.trace.rows
    true = plain.signals
    currents = model.model.currents(true.time_s, true.current_a, slice(None))
    table = model.model.load_columns(true.temperature_c, currents)
    drop_v = table[:, 1:] @ model.model.load_coefficients[1:]
    inputs = Inputs(true.time_s, true.current_a, true.temperature_c, drop_v)
    soc = plain.soc_pct[rows]
    found = np.empty((rows.size, len(tried)))
    for k, each in enumerate(tried):
        shape = each.in_log(of.trace.log.duration_s)
        effect, values = shape.effect, shape.values(shape.about)
        if effect.adds_voltage:
            changed = effect.added_v(inputs, rows, soc, values, model)
        else:
            changed = plain.residual_v - of.with_effect(effect, values).residual_v
        found[:, k] = changed * (shape.bound / shape.about)
    return found

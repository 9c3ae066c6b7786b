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
from cangauge.model.effects.base import Effect, Inputs, Pack, Parameter
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
    amplitude : Parameter
    fixed : dict of str to float
        All parameters, with an amplitude that changes nothing.
    low, high : float
        Bounds of the amplitude relative to that.
    about : float
        Size of the finite difference.
    usual : float
        Standard deviation of the amplitude between healthy logs.
    place : float, optional
        Of a step of resistance: the part of a log at which it happens; 0 is before its first row.
    """

    effect: Effect
    amplitude: Parameter
    fixed: Mapping[str, float]
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
        return self.amplitude.unit

    def values(self, size: float) -> dict[str, float]:
        """Return the effect's parameters at a size relative to neutral."""
        name = self.amplitude.name
        return {**self.fixed, name: self.fixed[name] + size}

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
    for item in candidates(tuple(LIBRARY.values()), pack):
        grids = {each.name: each.trials(pack) for each in item.effect.shapes}
        # A switch refines a shape that has a grid; its first value is tried.
        if len(grids) == 1 or all(
            item.shape.get(name, grid[0]) == grid[0]
            for name, grid in grids.items()
            if len(grid) < 3
        ):
            found += _shapes_of(item, pack)
    others = [shape for shape in found if shape.effect.id != STEP_ID]
    steps = [shape for shape in found if shape.effect.id == STEP_ID]
    return (*others, *(replace(step, place=part) for step in steps for part in PLACES))


def _shapes_of(item: EffectCandidate, pack: Pack) -> list[Shape]:
    """Return the shapes of an effect with one trial value of each other parameter."""
    effect, found = item.effect, []
    fixed = item.values(np.zeros_like(item.neutral))
    sizes = zip(effect.amplitudes, item.bounds.tolist(), item.steps.tolist(), strict=True)
    for amplitude, (low, high), step in sizes:
        usual = amplitude.healthy_std * amplitude.factor(pack) * fixed.get("delayed", 1.0)
        found.append(Shape(effect, amplitude, fixed, low, high, step, usual))
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

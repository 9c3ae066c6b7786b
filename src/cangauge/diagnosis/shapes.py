"""Shapes of the faults: every effect of the model library as columns of a linear model.

A shape is one amplitude of an effect with one trial value of each of its other parameters. Its
column is the change of the residual by it, in units of the amplitude's larger bound.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.diagnosis.rows import Simulated
from cangauge.model.effects.base import Effect, Load, Pack
from cangauge.model.effects.library import LIBRARY, EffectCandidate, candidates

STEP_ID: Final = "resistance_step"

GROWTH_ID: Final = "resistance_growth"

PLACES: Final = tuple(float(part) for part in np.arange(10) / 10)
"""Places of a step of resistance, in parts of a log; at its start it has grown before."""

SECANTS_S: Final = (-3.0, -0.7, 0.7, 3.0)
"""Skews about which a column is a secant [s]: beyond the width of a change of load the tangent at
zero is blind."""


@dataclass(frozen=True, eq=False)
class Shape:
    """One amplitude of an effect, its other parameters fixed.

    Parameters
    ----------
    effect : Effect
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
    place : float, optional
        Of a step of resistance: the part of a log at which it happens.
    """

    effect: Effect
    name: str
    fixed: Mapping[str, float]
    neutral: float
    low: float
    high: float
    about: float
    place: float | None = None
    usual: float = 0.0
    """Standard deviation between healthy logs."""

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
    def is_tangent(self) -> bool:
        """Whether the column is a derivative at neutral, and no secant."""
        return abs(self.about) < 0.1 * self.bound

    @property
    def changes_count(self) -> bool:
        """Whether it changes how charge is counted beyond the start."""
        return self.effect.fault in ("current_reading", "capacity")

    @property
    def is_of_pack(self) -> bool:
        """Whether a healthy pack has some of it: a mechanism that the equation may lack."""
        added = self.effect.adds_voltage and self.effect.id not in (STEP_ID, GROWTH_ID)
        return added or self.effect.id == "core_temperature"

    @property
    def healthy_std(self) -> float:
        """Standard deviation between healthy logs [bounds], of the shape at zero."""
        if self.place is not None or self.low == 0.0 or self.high == 0.0:
            return 0.0
        return self.usual / self.bound

    def at(self, part: float, duration_s: float) -> Shape:
        """Return a step of resistance at a part of a log."""
        return replace(self, fixed={**self.fixed, "start_s": part * duration_s}, place=part)


def _shapes_of(item: EffectCandidate, pack: Pack) -> list[Shape]:
    shapes = []
    usual = {each.name: each.healthy_std * each.factor(pack) for each in item.effect.parameters}
    if item.shape.get("delayed") == 0.0:
        usual = {}
    for k, name in enumerate(item.amplitudes):
        neutral = dict(zip(item.amplitudes, item.neutral.tolist(), strict=True))
        low, high = item.bounds[k].tolist()
        one = Shape(
            item.effect,
            name,
            {**neutral, **item.shape},
            neutral[name],
            low,
            high,
            float(item.steps[k]),
            usual=usual.get(name, 0.0),
        )
        shapes.append(one)
    if item.effect.moves_time:
        whole = shapes[0]
        for about in SECANTS_S:
            low, high = sorted((0.0, 1.5 * about))
            shapes.append(replace(whole, low=low, high=high, about=about))
    return shapes


def shapes(pack: Pack) -> list[Shape]:
    """Return every shape of every effect; steps of resistance are added by `steps`."""
    found = []
    for effect in LIBRARY.values():
        if effect.id == STEP_ID:
            continue
        grids = {item.name: item.trials(pack) for item in effect.shapes if effect.amplitudes}
        # A switch refines a shape that has a grid; its first value is tried.
        first = {
            name: values[0] for name, values in grids.items() if len(values) < 3 and len(grids) > 1
        }
        for item in candidates([effect], pack):
            if all(item.shape.get(name) == value for name, value in first.items()):
                found += _shapes_of(item, pack)
    return found


def steps(pack: Pack) -> list[Shape]:
    """Return a step of resistance at each place of a log."""
    (item,) = candidates([LIBRARY[STEP_ID]], pack)
    (one,) = _shapes_of(item, pack)
    return [replace(one, place=part) for part in PLACES]


def columns(of: Simulated, tried: Sequence[Shape]) -> FloatArray:
    """Return the change of voltage by each shape at its bound [V], shape (m, k)."""
    plain, model = of.plain, of.model
    rows = of.of.rows
    true = plain.signals
    currents = of.model.model.currents(true.time_s, true.current_a, slice(None))
    table = model.model.load_columns(true.temperature_c, currents)
    drop_v = table[:, 1:] @ model.model.load_coefficients[1:]
    load = Load(true.time_s, true.current_a, true.temperature_c, drop_v)
    soc = plain.soc_pct[rows]
    found = np.empty((rows.size, len(tried)))
    duration_s = of.of.log.duration_s
    for k, each in enumerate(tried):
        shape = each if each.place is None else each.at(each.place, duration_s)
        effect, values = shape.effect, shape.values(shape.about)
        if effect.adds_voltage:
            changed = effect.added_v(load, rows, soc, values, model)
        else:
            changed = plain.residual_v - of.with_effect(effect, values).residual_v
        found[:, k] = changed * (shape.bound / shape.about)
    return found

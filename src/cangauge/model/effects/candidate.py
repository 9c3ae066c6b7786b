"""One effect with one value of each shape: what a search over effects tries."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cangauge.model.effects.effect import Effect
from cangauge.model.effects.parameter import Pack

FloatArray = NDArray[np.float64]

STEP = 0.02
"""Finite-difference step, relative to the width of the amplitude's bounds."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect with one value of each shape: a few columns."""

    effect: Effect
    shape: Mapping[str, float]
    amplitudes: tuple[str, ...]
    neutral: FloatArray
    """Amplitudes at which the effect does nothing, shape (k,)."""
    bounds: FloatArray
    """Physical bounds of the amplitudes, less the neutral values, shape (k, 2)."""
    steps: FloatArray
    """Change of each amplitude over which the voltage's change is taken, shape (k,)."""
    is_usual: bool = True
    """Whether a fit tries it as well (else see `Parameter.elsewhere`)."""

    def values(self, amplitude: FloatArray) -> dict[str, float]:
        """Return the effect's parameters for amplitudes beside the neutral ones."""
        total = (self.neutral + amplitude).tolist()
        return {**dict(zip(self.amplitudes, total, strict=True)), **self.shape}


def candidates(
    effects: Sequence[Effect], pack: Pack, time_s: FloatArray, *, elsewhere: bool = False
) -> list[Candidate]:
    """Return every effect with every value of its shapes.

    Parameters
    ----------
    effects : sequence of Effect
    pack : Pack
    time_s : array
        Times of a log; the k-th shape means the same on every log of a group.
    elsewhere : bool
        Whether that is tried too which a fit does not try (`Parameter.elsewhere`).
    """
    result = []
    for effect in effects:
        neutral = effect.neutral(pack)
        amplitudes = effect.amplitudes or effect.parameters[:1]  # time_skew's is a shape as well
        names = tuple(parameter.name for parameter in amplitudes)
        centre = np.array([neutral[name] for name in names])
        bounds = np.array([parameter.bounds(pack) for parameter in amplitudes]) - centre[:, None]
        shapes = effect.shapes if effect.amplitudes else ()
        grids = [
            (*effect.trials(parameter, pack, time_s), *(parameter.elsewhere if elsewhere else ()))
            for parameter in shapes
        ]
        constants = effect.constants_to_try(pack) if elsewhere else [effect.constants(pack)]
        for constant, choice in itertools.product(constants, itertools.product(*grids)):
            shape = dict(zip((p.name for p in shapes), choice, strict=True)) | constant
            is_usual = constant == constants[0] and not any(
                value in parameter.elsewhere
                for parameter, value in zip(shapes, choice, strict=True)
            )
            result += [
                Candidate(effect, shape, names, centre, bounds, steps, is_usual)
                for steps in _steps(effect, bounds)
            ]
    return result


def _steps(effect: Effect, bounds: FloatArray) -> list[FloatArray]:
    """Return over which changes of the amplitudes the voltage's change is taken."""
    widest = float(np.abs(bounds).max()) if effect.bends_at else 0.0
    return [_tangent_steps(bounds), *(np.array([part * widest]) for part in effect.bends_at)]


def _tangent_steps(bounds: FloatArray) -> FloatArray:
    """Return small changes of the amplitudes, within their bounds, shape (k,)."""
    small = STEP * (bounds[:, 1] - bounds[:, 0])
    return np.where(small > bounds[:, 1], -small, small)

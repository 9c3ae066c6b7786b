"""All effects by id, their form in the model file, and the candidates of a search."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.model.effects.base import BOUND_MARGIN, Effect, Pack, Parameter, Values
from cangauge.model.effects.signals import CORRECTIONS, COUNTS
from cangauge.model.effects.voltages import VOLTAGES
from cangauge.model.fields import CURE

LIBRARY: Mapping[str, Effect] = {effect.id: effect for effect in (*CORRECTIONS, *COUNTS, *VOLTAGES)}
"""Effect id → effect, in the order in which effects are applied."""


def effect_of(effect_id: object, field: str = "effects") -> Effect:
    """Return the effect with an id.

    Raises
    ------
    InputError
        If the id is unknown; lists the known ones.
    """
    if isinstance(effect_id, str) and effect_id in LIBRARY:
        return LIBRARY[effect_id]
    raise InputError(
        "unknown effect", field=field, value=effect_id, cure="known are " + ", ".join(LIBRARY)
    )


def parse_effects(entries: Sequence[object], pack: Pack) -> list[tuple[Effect, Values]]:
    """Return effects and their values from a model file's list.

    Parameters
    ----------
    entries : sequence
        Each `{"id": …, "parameters": {name: value}}`.
    pack : Pack
        Sizes that the bounds scale with.

    Raises
    ------
    InputError
        If an entry is malformed, unknown, or repeated with the same shape. If a parameter is
        missing, unknown, not a number or outside its physical bounds. Names the field.
    """
    parsed: list[tuple[Effect, Values]] = []
    for number, entry in enumerate(entries):
        field = f"effects.{number}"
        of = _fields(entry, ("id", "parameters"), "an effect", field)
        effect = effect_of(of["id"], f"{field}.id")
        names = [parameter.name for parameter in effect.parameters]
        given = _fields(of["parameters"], names, effect.id, f"{field}.parameters")
        values = {
            parameter.name: _value(
                parameter, given[parameter.name], pack, f"{field}.parameters.{parameter.name}"
            )
            for parameter in effect.parameters
        }
        # Two elements with different time constants form a chain; the same one twice is an error.
        if shape_key(effect, values) in {shape_key(*other) for other in parsed}:
            raise InputError("given twice", field=f"{field}.id", value=effect.id, cure=CURE)
        parsed.append((effect, values))
    return parsed


def _fields(given: object, names: Sequence[str], owner: str, field: str) -> Mapping[str, Any]:
    """Return a mapping of exactly some names; raise InputError for anything else."""
    if isinstance(given, Mapping) and set(given) == set(names):
        return given
    raise InputError(
        f"{owner} has the fields {', '.join(names)} only",
        field=field,
        value=given,
        cure="fit again",
    )


def _value(parameter: Parameter, given: object, pack: Pack, field: str) -> float:
    """Return a parameter of a model file; raise InputError if it is impossible for the pack."""
    low, high = parameter.bounds(pack, BOUND_MARGIN)
    rounding = 1e-9 * (high - low)
    if isinstance(given, bool) or not isinstance(given, int | float):
        raise InputError("must be a number", field=field, value=given, cure=CURE)
    # Not a number, and an integer beyond any float, are outside too.
    if not low - rounding <= given <= high + rounding:
        raise InputError(
            f"must lie within {low:.6g} … {high:.6g} {parameter.unit} for this pack",
            field=field,
            value=given,
            cure="check the value, its unit and the model's capacity",
        )
    return float(given)


def effect_entries(effects: Sequence[tuple[Effect, Values]]) -> list[dict[str, object]]:
    """Return the model file's list for effects and their values."""
    return [
        {
            "id": effect.id,
            "parameters": {item.name: float(values[item.name]) for item in effect.parameters},
        }
        for effect, values in effects
    ]


def shape_key(effect: Effect, values: Values) -> tuple[object, ...]:
    """Return id and shapes: equal for two effects that differ in amplitude only."""
    amplitudes = {parameter.name for parameter in effect.amplitudes}
    return (effect.id, *(values[p.name] for p in effect.parameters if p.name not in amplitudes))


@dataclass(frozen=True, eq=False)
class EffectCandidate:
    """An effect with one trial value of each shape; its amplitudes are columns of a fit."""

    effect: Effect
    shape: Mapping[str, float]
    amplitudes: tuple[str, ...]
    neutral: FloatArray
    """Amplitudes at which the effect does nothing, shape (k,)."""
    bounds: FloatArray
    """Physical bounds of the amplitudes, relative to `neutral`, shape (k, 2)."""
    steps: FloatArray
    """Finite-difference step of each amplitude, shape (k,)."""

    def values(self, amplitude: FloatArray) -> dict[str, float]:
        """Return the effect's parameters for amplitudes relative to `neutral`, shape (k,)."""
        total = (self.neutral + amplitude).tolist()
        return {**dict(zip(self.amplitudes, total, strict=True)), **self.shape}


def candidates(effects: Sequence[Effect], pack: Pack) -> list[EffectCandidate]:
    """Return every effect with every combination of trial values of its shapes."""
    result = []
    for effect in effects:
        neutral = effect.neutral(pack)
        names = tuple(parameter.name for parameter in effect.amplitudes)
        centre = np.array([neutral[name] for name in names])
        bounds = (
            np.array([parameter.bounds(pack) for parameter in effect.amplitudes]) - centre[:, None]
        )
        small = 0.02 * (bounds[:, 1] - bounds[:, 0])
        steps = np.where(small > bounds[:, 1], -small, small)
        grids = [parameter.trials(pack) for parameter in effect.shapes]
        for choice in itertools.product(*grids):
            shape = dict(zip((item.name for item in effect.shapes), choice, strict=True))
            result.append(EffectCandidate(effect, shape, names, centre, bounds, steps))
    return result

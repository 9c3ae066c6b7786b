"""All effects by id, their form in the model file, and the candidates of a search."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.model.effects.base import BOUND_MARGIN, Effect, Pack, Parameter, Values
from cangauge.model.effects.signals import CORRECTIONS, COUNTS
from cangauge.model.effects.voltages import VOLTAGES

LIBRARY: Mapping[str, Effect] = {effect.id: effect for effect in (*CORRECTIONS, *COUNTS, *VOLTAGES)}
"""Effect id → effect, in the order in which effects are applied."""

LARGEST = 1e30
"""Upper limit of any parameter in a model file, in any unit."""

RETIRED = ("inner_temperature", "ocv_shape")
"""Effects of earlier versions. A model file with one is refused."""

RETIRED_PARAMETERS: Mapping[str, str] = {
    "resistance_temperature": "lag_s",
    "entropic_coefficient": "lag_s",
    "slow_diffusion": "spread",
}
"""Effect → parameter of earlier versions. At 0 it changes nothing and is dropped."""

STEP = 0.02
"""Finite-difference step, relative to the width of an amplitude's bounds or to a shape."""


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
        If an entry is malformed, of an earlier version, or repeated with the same shape. If a
        parameter is missing, unknown, not a number or outside its physical bounds. Names the field.
    """
    parsed: list[tuple[Effect, Values]] = []
    seen: set[tuple[object, ...]] = set()
    for number, entry in enumerate(entries):
        field = f"effects.{number}"
        if not isinstance(entry, Mapping) or set(entry) != {"id", "parameters"}:
            raise InputError(
                "an effect has the fields id and parameters only",
                field=field,
                value=sorted(map(str, entry)) if isinstance(entry, Mapping) else entry,
            )
        if entry["id"] in RETIRED:
            raise InputError(
                f"{entry['id']} is an effect of an earlier version",
                field=f"{field}.id",
                cure="fit again",
            )
        effect = effect_of(entry["id"], f"{field}.id")
        values = _parse_values(effect, entry["parameters"], pack, f"{field}.parameters")
        # Two elements with different time constants form a chain; the same one twice is an error.
        key = shape_key(effect, values)
        if key in seen:
            raise InputError("given twice", field=f"{field}.id", value=effect.id)
        seen.add(key)
        parsed.append((effect, values))
    return parsed


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
    """Return id, shapes and constants: equal for two effects that differ in amplitude only."""
    amplitudes = {parameter.name for parameter in effect.amplitudes}
    return (effect.id, *(values[p.name] for p in effect.parameters if p.name not in amplitudes))


def _parse_values(effect: Effect, given: object, pack: Pack, field: str) -> Values:
    names = [parameter.name for parameter in effect.parameters]
    retired = RETIRED_PARAMETERS.get(effect.id)
    if isinstance(given, Mapping) and retired in given:
        value = given[retired]
        if isinstance(value, bool) or value != 0.0:
            raise InputError(
                "a parameter of an earlier version, which must be 0",
                field=f"{field}.{retired}",
                value=value,
                cure="fit again",
            )
        given = {name: each for name, each in given.items() if name != retired}
    if not isinstance(given, Mapping) or set(given) != set(names):
        raise InputError(
            f"{effect.id} has the parameters {', '.join(names)}",
            field=field,
            value=sorted(map(str, given)) if isinstance(given, Mapping) else given,
        )
    return {
        parameter.name: _parse_value(
            parameter, given[parameter.name], pack, f"{field}.{parameter.name}"
        )
        for parameter in effect.parameters
    }


def _parse_value(parameter: Parameter, given: object, pack: Pack, field: str) -> float:
    # JSON integers have any length; only those of up to 308 digits convert to a float.
    if (
        isinstance(given, bool)
        or not isinstance(given, int | float)
        or not -LARGEST <= given <= LARGEST
    ):
        raise InputError("must be a finite number", field=field, value=given)
    low, high = parameter.bounds(pack, BOUND_MARGIN)
    rounding = 1e-9 * (high - low)
    if not low - rounding <= given <= high + rounding:
        raise InputError(
            f"must lie within {low:.6g} … {high:.6g} {parameter.unit} for this pack",
            field=field,
            value=given,
            cure="check the value, its unit and the model's capacity",
        )
    return float(given)


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
        amplitudes = effect.amplitudes or effect.parameters[:1]  # time_skew's is a shape as well
        names = tuple(parameter.name for parameter in amplitudes)
        centre = np.array([neutral[name] for name in names])
        bounds = np.array([parameter.bounds(pack) for parameter in amplitudes]) - centre[:, None]
        small = STEP * (bounds[:, 1] - bounds[:, 0])
        steps = np.where(small > bounds[:, 1], -small, small)
        shapes = effect.shapes if effect.amplitudes else ()
        grids = [parameter.trials(pack) for parameter in shapes]
        for choice in itertools.product(*grids):
            shape = dict(zip((item.name for item in shapes), choice, strict=True))
            shape |= effect.constants(pack)
            result.append(EffectCandidate(effect, shape, names, centre, bounds, steps))
    return result

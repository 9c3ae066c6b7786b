"""One effect with one value of each shape: what a search over effects tries.

All effects, by id, and their form in the model file.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.model.effects.base import LEEWAY, Effect, Pack, Parameter, Values
from cangauge.model.effects.charge import Capacity, CoulombicEfficiency, InitialSoc
from cangauge.model.effects.dynamics import ChargeTransfer, FastPolarization, SlowDiffusion
from cangauge.model.effects.equilibrium import EntropicCoefficient, Hysteresis, OcvShape, WeakCell
from cangauge.model.effects.resistance import (
    ResistanceAsymmetry,
    ResistanceSoc,
    ResistanceStep,
    ResistanceTemperature,
)
from cangauge.model.effects.sensing import CurrentGain, CurrentOffset, VoltageGain, VoltageOffset
from cangauge.model.effects.thermal import CoreTemperature, InnerTemperature, TemperatureLag
from cangauge.model.effects.timing import TimeSkew

# --- One effect with one value of each shape: what a search over effects tries

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


# --- All effects, by id, and their form in the model file

# In the order in which they correct: sensors before what is computed from their signals.
_EFFECTS: tuple[Effect, ...] = (
    CurrentOffset(),
    CurrentGain(),
    VoltageOffset(),
    VoltageGain(),
    TimeSkew(),
    TemperatureLag(),
    CoreTemperature(),
    Capacity(),
    InitialSoc(),
    CoulombicEfficiency(),
    ResistanceTemperature(),
    ResistanceSoc(),
    ResistanceAsymmetry(),
    ResistanceStep(),
    ChargeTransfer(),
    FastPolarization(),
    SlowDiffusion(),
    Hysteresis(),
    EntropicCoefficient(),
    InnerTemperature(),
    OcvShape(),
    WeakCell(),
)

LIBRARY: Mapping[str, Effect] = {effect.id: effect for effect in _EFFECTS}
"""Effect id → effect, in the order in which effects are applied."""

LARGEST = 1e30
"""No parameter is larger, in any unit."""


def effect_of(effect_id: object, field: str = "effects") -> Effect:
    """Return the effect with an id.

    Raises
    ------
    InputError
        If there is none; names those that are.
    """
    if isinstance(effect_id, str) and effect_id in LIBRARY:
        return LIBRARY[effect_id]
    raise InputError(
        "is no effect that this release knows",
        field=field,
        value=effect_id,
        cure="known are " + ", ".join(LIBRARY),
    )


def parse_effects(entries: Sequence[object], pack: Pack) -> list[tuple[Effect, Values]]:
    """Return effects and their values from a model file's list.

    Parameters
    ----------
    entries : sequence
        Each `{"id": …, "parameters": {name: value}}`.
    pack : Pack
        What the bounds are relative to.

    Raises
    ------
    InputError
        If an entry is no effect, is given twice with one shape, or a parameter is missing,
        unknown, no number,
        or outside its physical bounds; names the field.
    """
    parsed: list[tuple[Effect, Values]] = []
    seen: set[tuple[object, ...]] = set()
    for number, entry in enumerate(entries):
        field = f"effects.{number}"
        if not isinstance(entry, Mapping) or set(entry) != {"id", "parameters"}:
            raise InputError(
                "an effect has the fields id and parameters, and no others",
                field=field,
                value=sorted(map(str, entry)) if isinstance(entry, Mapping) else entry,
            )
        effect = effect_of(entry["id"], f"{field}.id")
        values = _values(effect, entry["parameters"], pack, f"{field}.parameters")
        # Two elements of different time constants are a chain; the same one twice is a slip.
        one = one_of(effect, values)
        if one in seen:
            raise InputError("is given twice", field=f"{field}.id", value=effect.id)
        seen.add(one)
        parsed.append((effect, values))
    return parsed


def one_of(effect: Effect, values: Values) -> tuple[object, ...]:
    """Return what makes two effects the same but for how large they are: id, shapes, constants."""
    sizes = {parameter.name for parameter in effect.amplitudes}
    return (effect.id, *(values[p.name] for p in effect.parameters if p.name not in sizes))


def effect_entries(effects: Sequence[tuple[Effect, Values]]) -> list[dict[str, object]]:
    """Return the model file's list for effects and their values."""
    return [
        {
            "id": effect.id,
            "parameters": {item.name: float(values[item.name]) for item in effect.parameters},
        }
        for effect, values in effects
    ]


def _values(effect: Effect, given: object, pack: Pack, field: str) -> Values:
    names = [parameter.name for parameter in effect.parameters]
    # A file from before a constant was kept: it was the pack's then too.
    constants = effect.constants(pack) | {
        item.name: item.formerly * item.factor(pack)
        for item in effect.parameters
        if item.formerly is not None
    }
    if isinstance(given, Mapping):
        given = {**constants, **given}
    if not isinstance(given, Mapping) or set(given) != set(names):
        raise InputError(
            f"{effect.id} has the parameters {', '.join(names)}",
            field=field,
            value=sorted(set(map(str, given)) - set(constants))
            if isinstance(given, Mapping)
            else given,
        )
    return {
        parameter.name: _value(parameter, given[parameter.name], pack, f"{field}.{parameter.name}")
        for parameter in effect.parameters
    }


def _value(parameter: Parameter, given: object, pack: Pack, field: str) -> float:
    # Whole numbers of JSON have any length, and only those of up to 308 digits become a float.
    if (
        isinstance(given, bool)
        or not isinstance(given, int | float)
        or not -LARGEST <= given <= LARGEST
    ):
        raise InputError("must be a finite number", field=field, value=given)
    low, high = parameter.bounds(pack, LEEWAY)
    rounding = 1e-9 * (high - low)
    if not low - rounding <= given <= high + rounding:
        raise InputError(
            f"must lie within {low:.6g} … {high:.6g} {parameter.unit} for this pack",
            field=field,
            value=given,
            cure="check the value, its unit and the model's capacity",
        )
    return float(given)

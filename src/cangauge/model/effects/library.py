"""All effects, by id, and their form in the model file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from cangauge.errors import InputError
from cangauge.model.effects.capacity import Capacity
from cangauge.model.effects.charge_transfer import ChargeTransfer
from cangauge.model.effects.core_temperature import CoreTemperature
from cangauge.model.effects.coulombic_efficiency import CoulombicEfficiency
from cangauge.model.effects.current_gain import CurrentGain
from cangauge.model.effects.current_offset import CurrentOffset
from cangauge.model.effects.effect import Effect, Values
from cangauge.model.effects.entropic_coefficient import EntropicCoefficient
from cangauge.model.effects.fast_polarization import FastPolarization
from cangauge.model.effects.hysteresis import Hysteresis
from cangauge.model.effects.initial_soc import InitialSoc
from cangauge.model.effects.inner_temperature import InnerTemperature
from cangauge.model.effects.ocv_shape import OcvShape
from cangauge.model.effects.parameter import LEEWAY, Pack, Parameter
from cangauge.model.effects.resistance_asymmetry import ResistanceAsymmetry
from cangauge.model.effects.resistance_soc import ResistanceSoc
from cangauge.model.effects.resistance_step import ResistanceStep
from cangauge.model.effects.resistance_temperature import ResistanceTemperature
from cangauge.model.effects.slow_diffusion import SlowDiffusion
from cangauge.model.effects.temperature_lag import TemperatureLag
from cangauge.model.effects.time_skew import TimeSkew
from cangauge.model.effects.voltage_gain import VoltageGain
from cangauge.model.effects.voltage_offset import VoltageOffset
from cangauge.model.effects.weak_cell import WeakCell

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

"""`load_vehicle`: a vehicle by the name of a preset, or by a DBC and a map file."""

from __future__ import annotations

import math
from os import PathLike
from pathlib import Path

from cangauge.bus.binding import bind_vehicle
from cangauge.bus.bound import EXTENDED, BoundSignal, MessageRule, Role, Vehicle
from cangauge.bus.mapping import VehicleMap
from cangauge.bus.overrides import NO_OVERRIDES, Overrides
from cangauge.bus.presets import PRESETS, Preset
from cangauge.bus.validation import read_toml, validated
from cangauge.errors import InputError
from cangauge.nearest import closest
from cangauge.share import shared_file

__all__ = [
    "EXTENDED",
    "BoundSignal",
    "MessageRule",
    "Role",
    "Vehicle",
    "find_preset",
    "load_vehicle",
    "preset_vehicle",
]


def load_vehicle(
    preset: str | None = None,
    dbc: str | PathLike[str] | None = None,
    map_file: str | PathLike[str] | None = None,
    *,
    temperature_c: float | None = None,
    pair_within_s: float | None = None,
    overrides: Overrides = NO_OVERRIDES,
) -> Vehicle:
    """Return a vehicle by the name of a preset, or by a DBC and a map file.

    Parameters
    ----------
    preset : str, optional
        See `PRESETS`.
    dbc, map_file : path-like, optional
        DBC and TOML file of another car; see `cangauge.bus.mapping`.
    temperature_c : float, optional
        Fixed temperature instead of the bus's [°C]; its source is then unknown.
    pair_within_s : float, optional
        Instead of the mapping's [s].
    overrides : Overrides, optional
        Protection and checks that go before the mapping's.

    Raises
    ------
    InputError
        Names the file, the field, the value and the cure: unknown preset, both or neither given,
        unknown keys, signals that the DBC lacks, units that are no current, voltage,
        temperature; a preset without temperature on the bus when `temperature_c` is not given.
    """
    _check_temperature(temperature_c)
    if preset is not None:
        if dbc is not None or map_file is not None:
            raise InputError(
                "given together with --dbc or --map",
                field="--vehicle",
                value=preset,
                cure="give one or the other",
            )
        return _from_preset(preset, temperature_c, pair_within_s, overrides)
    if map_file is None:
        raise InputError(
            "no vehicle is given" if dbc is None else "a DBC alone does not say which signals",
            source=None if dbc is None else str(dbc),
            field="--map" if dbc is not None else "--vehicle",
            cure="give --map FILE, which names three signals"
            if dbc is not None
            else f"give --vehicle ({', '.join(PRESETS)}), or --dbc FILE --map FILE",
        )
    mapping = validated(VehicleMap, read_toml(map_file), map_file)
    own = [Path(map_file).parent / name for name in mapping.dbc]
    files = [*([Path(dbc)] if dbc is not None else []), *own]
    if not files:
        raise InputError(
            "is missing", source=map_file, field="dbc", cure="add it, or give --dbc FILE"
        )
    vehicle = bind_vehicle(
        mapping,
        files,
        source=map_file,
        temperature_c=temperature_c,
        pair_within_s=pair_within_s,
        overrides=overrides,
    )
    if vehicle.temperature is None and math.isnan(vehicle.fixed_temperature_c):
        raise InputError(
            "is missing",
            source=map_file,
            field="temperature",
            cure="name its signal, or give --temperature °C",
        )
    return vehicle


def _from_preset(
    name: str,
    temperature_c: float | None,
    pair_within_s: float | None,
    overrides: Overrides,
) -> Vehicle:
    preset = find_preset(name)
    if preset.lacks_temperature and temperature_c is None:
        raise InputError(
            "this car puts no pack temperature on the bus that is known",
            field="--vehicle",
            value=name,
            cure="give --temperature °C",
        )
    return preset_vehicle(
        preset, temperature_c=temperature_c, pair_within_s=pair_within_s, overrides=overrides
    )


def find_preset(name: str) -> Preset:
    """Return the preset of that name, in any case, with `-` or `_`.

    Raises
    ------
    InputError
        If there is none.
    """
    try:
        return PRESETS[name.strip().lower().replace("-", "_")]
    except KeyError:
        near = closest(name, PRESETS)
        known = f"known are {', '.join(PRESETS)}; for another car give --dbc FILE --map FILE"
        raise InputError(
            "unknown vehicle",
            field="--vehicle",
            value=name,
            cure=f"did you mean {near}?" if near else known,
        ) from None


def preset_vehicle(
    preset: Preset,
    *,
    temperature_c: float | None = None,
    pair_within_s: float | None = None,
    overrides: Overrides = NO_OVERRIDES,
) -> Vehicle:
    """Return a preset's vehicle, even if it then has no temperature at all."""
    dbc = shared_file("dbc", preset.dbc)
    return bind_vehicle(
        preset.mapping,
        [dbc],
        source=dbc,
        temperature_c=temperature_c,
        pair_within_s=pair_within_s,
        overrides=overrides,
    )


def _check_temperature(temperature_c: float | None) -> None:
    if temperature_c is not None and not -60.0 <= temperature_c <= 120.0:
        raise InputError(
            "is no battery's temperature in °C", field="--temperature", value=temperature_c
        )

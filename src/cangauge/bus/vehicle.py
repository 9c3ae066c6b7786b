"""What a vehicle is once its mapping is bound to its DBC: signals ready to decode and encode.

The vehicles that `--vehicle` knows by name.

Protection and checks that a service's configuration states, before those of the car's mapping.

What changes the numbers of a car for good belongs into its map file, which `estimate` reads, too;
these are for a car that is known by name, or for a bus with a quirk of its own::

    [messages.BATTERY_1DB]
    protection = "leaf"

    [checks.voltage]
    lowest = 240
    highest = 410

Which protection a message has: the words of a mapping → a rule, with helpful errors.

A mapping of signals, bound to the DBC files that define them, once.

`load_vehicle`: a vehicle by the name of a preset, or by a DBC and a map file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Final, Literal

import numpy as np
from cantools.database.can import Database, Message, Signal
from numpy.typing import NDArray

from cangauge._config import read_toml, validated
from cangauge._resources import shared_file
from cangauge._typing import FloatArray
from cangauge.bus.database import (
    Field,
    SignalCodec,
    find_message,
    find_signal,
    load_dbc,
    signal_codec,
)
from cangauge.bus.mapping import (
    CheckMap,
    MessageMap,
    RuleMap,
    SignalMap,
    TemperatureMap,
    VehicleMap,
)
from cangauge.bus.plausibility import SignalChecks, checks_of
from cangauge.bus.protection import PROFILES, RULES, CounterRule, E2eRule, Protection
from cangauge.errors import InputError, closest
from cangauge.logs.log import TemperatureSource
from cangauge.logs.units import convert

# --- What a vehicle is once its mapping is bound to its DBC: signals ready to decode and encode

Role = Literal["current", "voltage", "temperature", "soc_reference"]
EXTENDED: Final = 1 << 31
"""Added to an extended id, as SocketCAN does, so that it differs from the standard one."""


@dataclass(frozen=True, slots=True)
class VehicleSignal:
    """One of a vehicle's signals: where it is in which frame, and what it means.

    Parameters
    ----------
    role : {"current", "voltage", "temperature", "soc_reference"}
    key : int
        Arbitration id, plus `EXTENDED` for an extended one.
    message : str
        Name of the message.
    length : int
        Bytes of the message.
    codec : SignalCodec
    gain, offset : float
        value = gain × (value in the DBC's unit) + offset, in A (positive = discharge), V, °C, %.
    checks : SignalChecks
        When its values are believed.
    """

    role: Role
    key: int
    message: str
    length: int
    codec: SignalCodec
    gain: float
    offset: float
    checks: SignalChecks = field(default_factory=SignalChecks)

    def decode(self, payload: bytes | bytearray) -> float:
        """Return the value in A, V, °C or % of a payload of `length` bytes; NaN: not available."""
        return self.gain * self.codec.decode(payload) + self.offset

    def encode_into(self, payload: bytearray, value: float) -> None:
        """Set the value in A, V, °C or %; NaN becomes "not available".

        Raises
        ------
        InputError
            If it does not fit.
        """
        self.codec.encode_into(payload, (value - self.offset) / self.gain)

    def quantise(self, values: FloatArray) -> FloatArray:
        """Return what `decode` gives after `encode_into`, for every value."""
        dbc_values = self.codec.quantise((np.asarray(values) - self.offset) / self.gain)
        return np.asarray(self.gain * dbc_values + self.offset)

    def fits(self, values: FloatArray) -> NDArray[np.bool_]:
        """Return which values `encode_into` takes; NaN counts as one that it does."""
        return self.codec.fits((np.asarray(values) - self.offset) / self.gain)

    @property
    def half_step(self) -> float:
        """Largest error of rounding in a frame, in A, V, °C or %; 0 for floats."""
        return abs(self.gain) * self.codec.half_step

    @property
    def range(self) -> tuple[float, float]:
        """Smallest and largest value that a frame can carry, in A, V, °C or %."""
        ends = [self.gain * end + self.offset for end in self.codec.range]
        return min(ends), max(ends)

    @property
    def arbitration_id(self) -> int:
        """The id without the mark of extended ones."""
        return self.key & ~EXTENDED

    @property
    def is_extended(self) -> bool:
        """Whether the id has 29 bits."""
        return bool(self.key & EXTENDED)


@dataclass(frozen=True, slots=True)
class MessageProtection:
    """Protection and period of one message."""

    rule: Protection | None
    period_s: float | None


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A vehicle's signals, ready to decode and encode.

    Parameters
    ----------
    name : str
    current, voltage : VehicleSignal
    temperature, soc_reference : VehicleSignal or None
    fixed_temperature_c : float
        Temperature where no signal gives it [°C]; NaN: none.
    temperature_source : {"cell", "pack", "coolant", "room", "unknown"}
    pair_within_s : float
        Current and voltage at most this far apart in bus time belong together [s].
    messages : dict of int to MessageProtection
        By key (id, plus `EXTENDED`), for every message with a wanted signal.
    dbc_files : tuple of str
    """

    name: str
    current: VehicleSignal
    voltage: VehicleSignal
    temperature: VehicleSignal | None
    soc_reference: VehicleSignal | None
    fixed_temperature_c: float
    temperature_source: TemperatureSource
    pair_within_s: float
    messages: dict[int, MessageProtection]
    dbc_files: tuple[str, ...]

    @property
    def signals(self) -> tuple[VehicleSignal, ...]:
        """All signals that there are: current, voltage, temperature, reference SoC."""
        found = (self.current, self.voltage, self.temperature, self.soc_reference)
        return tuple(signal for signal in found if signal is not None)

    @property
    def wanted_ids(self) -> tuple[int, ...]:
        """Arbitration ids that carry a wanted signal, each once."""
        return tuple(dict.fromkeys(signal.arbitration_id for signal in self.signals))

    @property
    def filters(self) -> list[dict[str, int | bool]]:
        """The wanted ids as filters of python-can (`bus.set_filters`), for the kernel."""
        keys = dict.fromkeys(signal.key for signal in self.signals)
        return [
            {
                "can_id": key & ~EXTENDED,
                "can_mask": 0x1FFFFFFF if key & EXTENDED else 0x7FF,
                "extended": bool(key & EXTENDED),
            }
            for key in keys
        ]


# --- The vehicles that `--vehicle` knows by name

_LEAF_MESSAGES: Final = {
    "BATTERY_1DB": MessageMap(protection="leaf", period_s=0.010),
    "BATTERY_55B": MessageMap(protection="leaf", period_s=0.100),
}
_LEAF_CURRENT: Final = SignalMap(message="BATTERY_1DB", signal="current_a", sign=-1)
_LEAF_VOLTAGE: Final = SignalMap(message="BATTERY_1DB", signal="voltage_v")
_LEAF_SOC: Final = SignalMap(message="BATTERY_55B", signal="soc_pct")
_LEAF_TEMPERATURE: Final = TemperatureMap(
    message="BATTERY_5C0", signal="temperature_average_c", timeout_s=10.0
)


@dataclass(frozen=True, slots=True)
class Preset:
    """A known vehicle.

    Parameters
    ----------
    dbc : str
        File in `dbc/`.
    mapping : VehicleMap
    about : str
        One line for help texts.
    periods_s : dict of int to float
        Periods by which captures of this vehicle are told from those of its relatives [s].
    lacks_temperature : bool
        Whether it puts no pack temperature on the bus that is known.
    """

    dbc: str
    mapping: VehicleMap
    about: str
    periods_s: dict[int, float] = field(default_factory=dict)

    @property
    def lacks_temperature(self) -> bool:
        """Whether it puts no pack temperature on the bus that is known."""
        return self.mapping.temperature is None


PRESETS: Final[dict[str, Preset]] = {
    "generic": Preset(
        dbc="generic_pack.dbc",
        about="a pack without a car: what replay sends by default",
        mapping=VehicleMap(
            name="generic pack",
            current=SignalMap(message="PACK_CURRENT", signal="current_a"),
            voltage=SignalMap(message="PACK_VOLTAGE", signal="voltage_v"),
            temperature=TemperatureMap(message="PACK_TEMPERATURE", signal="temperature_c"),
            soc_reference=SignalMap(message="PACK_SOC", signal="soc_pct"),
            messages={
                name: MessageMap(protection="generic")
                for name in ("PACK_CURRENT", "PACK_VOLTAGE", "PACK_TEMPERATURE", "PACK_SOC")
            },
        ),
    ),
    "leaf_ze0": Preset(
        dbc="nissan_leaf.dbc",
        about="Nissan Leaf 24 kWh, 2011-12",
        mapping=VehicleMap(
            name="Nissan Leaf ZE0",
            current=_LEAF_CURRENT,
            voltage=_LEAF_VOLTAGE,
            temperature=_LEAF_TEMPERATURE,
            soc_reference=_LEAF_SOC,
            temperature_source="pack",
            messages=_LEAF_MESSAGES,
        ),
        periods_s={0x5BC: 0.500},
    ),
    "leaf_aze0": Preset(
        dbc="nissan_leaf.dbc",
        about="Nissan Leaf 24/30 kWh, 2013-17; e-NV200; 40 kWh pack in such a car",
        mapping=VehicleMap(
            name="Nissan Leaf AZE0",
            current=_LEAF_CURRENT,
            voltage=_LEAF_VOLTAGE,
            temperature=_LEAF_TEMPERATURE,
            soc_reference=_LEAF_SOC,
            temperature_source="pack",
            messages=_LEAF_MESSAGES,
        ),
        periods_s={0x5BC: 0.100},
    ),
    "leaf_ze1": Preset(
        dbc="nissan_leaf.dbc",
        about="Nissan Leaf 40/62 kWh, from 2018; needs --temperature",
        mapping=VehicleMap(
            name="Nissan Leaf ZE1",
            current=_LEAF_CURRENT,
            voltage=_LEAF_VOLTAGE,
            soc_reference=_LEAF_SOC,
            messages=_LEAF_MESSAGES,
        ),
        periods_s={0x5BC: 0.100},
    ),
}
"""By the name that `--vehicle` takes."""


# --- Protection and checks that a service's configuration states, before those of the car's …


@dataclass(frozen=True, slots=True)
class Overrides:
    """What goes before a mapping.

    Parameters
    ----------
    source : str
        Where it comes from, for messages.
    messages : mapping of str to MessageMap
        By name or id; what one leaves out is the mapping's.
    rules : mapping of str to RuleMap
    checks : mapping of str to CheckMap
        By role: "current", "voltage", "temperature", "soc_reference".
    """

    source: str = ""
    messages: Mapping[str, MessageMap] = field(default_factory=lambda: MappingProxyType({}))
    rules: Mapping[str, RuleMap] = field(default_factory=lambda: MappingProxyType({}))
    checks: Mapping[str, CheckMap] = field(default_factory=lambda: MappingProxyType({}))

    def stated_messages(
        self, mapping: VehicleMap, source: str, key_of: Callable[[str], int]
    ) -> dict[int, tuple[MessageMap, str]]:
        """Return what both state, by the messages' keys, and where the word on it was spoken.

        Another protection drops the mapping's figures for its own one; the period stays.
        """
        stated = {key_of(name): (each, source) for name, each in mapping.messages.items()}
        for name, each in self.messages.items():
            key = key_of(name)
            before = stated[key][0] if key in stated else MessageMap()
            if each.protection is not None:
                before = MessageMap(period_s=before.period_s)
            given = {name: getattr(each, name) for name in each.model_fields_set}
            stated[key] = (before.model_copy(update=given), self.source)
        return stated


NO_OVERRIDES: Final = Overrides()


# --- Which protection a message has: the words of a mapping → a rule, with helpful errors

COUNTER: Final = "counter"
"""Protection by a counter alone."""

_OF_COUNTER: Final = ("counter", "counter_modulus")
_OF_PROFILE: Final = ("data_id", "data_id_list", "data_id_mode", "header_byte", "protected_bytes")


def choose_rule(
    message: Message, stated: MessageMap, own: Mapping[str, RuleMap], *, source: str
) -> Protection | None:
    """Return the rule that a mapping states for a message; None where it states none.

    Parameters
    ----------
    message : cantools.database.can.Message
    stated : MessageMap
    own : mapping of str to RuleMap
        The user's own rules.
    source : str
        The file, for messages.

    Raises
    ------
    InputError
        If the rule is not known, lacks a figure, has one too many, or does not fit.
    """
    name, where = stated.protection, f"messages.{message.name}"
    _refuse_strangers(name, stated, where, source)
    if name is None:
        return None
    try:
        rule = _rule(name, message, stated, own)
    except InputError as error:
        field = (error.field or "").rpartition(".")[2]
        raise InputError(
            error.problem,
            source=source,
            field=f"{where}.{field}",
            value=error.value,
            cure=error.cure,
        ) from error
    if not rule.fits(message.length):
        raise InputError(
            f"the rule does not fit into the {message.length} bytes of the message",
            source=source,
            field=f"{where}.protection",
            value=name,
        )
    return rule


def _rule(
    name: str, message: Message, stated: MessageMap, own: Mapping[str, RuleMap]
) -> Protection:
    if name in own:
        return own[name].rule(name)
    if name == COUNTER:
        return _counter_rule(message, stated)
    if name in PROFILES:
        return _profile_rule(name, stated)
    try:
        return RULES[name]
    except KeyError:
        raise InputError(
            "unknown protection rule",
            field="protection",
            value=name,
            cure=f"known are {', '.join([*RULES, COUNTER, *PROFILES, *own])};"
            f" or define it under [rules.{name}]",
        ) from None


def _counter_rule(message: Message, stated: MessageMap) -> CounterRule:
    if stated.counter is None:
        raise InputError(
            "is missing", field="counter", cure="name the signal that counts, in the DBC"
        )
    signal = next((each for each in message.signals if each.name == stated.counter), None)
    if signal is None:
        raise InputError(
            f"message {message.name} has no such signal", field="counter", value=stated.counter
        )
    place = Field.of(signal, message.length)
    return CounterRule(COUNTER, place, message.length, stated.counter_modulus or 1 << place.width)


def _profile_rule(name: str, stated: MessageMap) -> E2eRule:
    wanted = "data_id" if PROFILES[name].id_bits else "data_id_list"
    if getattr(stated, wanted) is None:
        raise InputError(
            "is missing", field=wanted, cure=f"the CRC of {name} covers it: ask the sender's maker"
        )
    return E2eRule(
        name,
        data_id=stated.data_id or 0,
        data_ids=bytes(stated.data_id_list or ()),
        data_id_mode=stated.data_id_mode or "both",
        header_byte=stated.header_byte or 0,
        protected_bytes=stated.protected_bytes or 0,
    )


def _refuse_strangers(name: str | None, stated: MessageMap, where: str, source: str) -> None:
    """Refuse figures that the stated protection does not have: a sign of a mistake."""
    strange = (
        *(() if name == COUNTER else _OF_COUNTER),
        *(() if name in PROFILES else _OF_PROFILE),
    )
    for key in strange:
        if getattr(stated, key) is not None:
            needs = "an e2e profile" if key in _OF_PROFILE else f'"{COUNTER}"'
            raise InputError(
                f"belongs to {needs}",
                source=source,
                field=f"{where}.{key}",
                cure=f"set protection to {needs}, or take it out",
            )


# --- A mapping of signals, bound to the DBC files that define them, once

_LOG_FIELD: Final = {
    "current": "current_a",
    "voltage": "voltage_v",
    "temperature": "temperature_c",
    "soc_reference": "soc_pct",
}
LONGEST_CYCLE_MS: Final = 1e9


def bind_vehicle(
    mapping: VehicleMap,
    dbc_files: list[Path],
    *,
    source: str | PathLike[str],
    temperature_c: float | None = None,
    pair_within_s: float | None = None,
    overrides: Overrides = NO_OVERRIDES,
) -> Vehicle:
    """Find the mapping's signals in the DBC files.

    Parameters
    ----------
    mapping : VehicleMap
    dbc_files : list of Path
        A signal is taken from the first file that has it.
    source : path-like
        Where the mapping comes from, for messages.
    temperature_c, pair_within_s : float, optional
        Instead of the mapping's.
    overrides : Overrides, optional
        Protection and checks that go before the mapping's.

    Raises
    ------
    InputError
        As `load_vehicle`.
    """
    databases = [load_dbc(path) for path in dbc_files]
    binder = _Binder(mapping, databases, dbc_files, str(source), overrides)
    temperature = mapping.temperature
    fixed = temperature_c if temperature_c is not None else None
    if fixed is None and temperature is not None:
        fixed = temperature.fixed_c
    current = binder.signal("current", mapping.current)
    voltage = binder.signal("voltage", mapping.voltage)
    bound = None if fixed is not None or temperature is None else temperature
    within = mapping.pair_within_s if pair_within_s is None else pair_within_s
    if not 0.0 <= within <= 1.0:
        raise InputError("must be within 0–1 s", field="pair_within_s", value=within)
    return Vehicle(
        name=mapping.name,
        current=current,
        voltage=voltage,
        temperature=None if bound is None else binder.signal("temperature", bound),
        soc_reference=None
        if mapping.soc_reference is None
        else binder.signal("soc_reference", mapping.soc_reference),
        fixed_temperature_c=math.nan if fixed is None else float(fixed),
        temperature_source=mapping.temperature_source if temperature_c is None else "unknown",
        pair_within_s=within,
        messages=binder.messages(),
        dbc_files=tuple(str(path) for path in dbc_files),
    )


def _cycle_s(message: Message) -> float | None:
    """Return the period that the DBC states [s]; None where that is no time."""
    stated: object = message.cycle_time
    if not isinstance(stated, int | float) or not 0.0 < stated <= LONGEST_CYCLE_MS:
        return None
    return stated / 1000.0


class _Binder:
    """Finds the signals of one mapping and remembers the messages that they are in."""

    def __init__(
        self,
        mapping: VehicleMap,
        databases: list[Database],
        files: list[Path],
        source: str,
        overrides: Overrides,
    ) -> None:
        self._mapping = mapping
        self._databases = databases
        self._files = files
        self._source = source
        self._overrides = overrides
        self._found: dict[int, Message] = {}

    def signal(self, role: Role, wanted: SignalMap) -> VehicleSignal:
        message, signal, file = self._find(role, wanted)
        codec = signal_codec(
            message,
            signal,
            source=file,
            field=role,
            not_available=wanted.not_available,
            when=wanted.when,
        )
        key = message.frame_id | (EXTENDED if message.is_extended_frame else 0)
        self._found[key] = message
        factor, offset = self._unit(role, wanted, codec)
        return VehicleSignal(
            role=role,
            key=key,
            message=message.name,
            length=message.length,
            codec=codec,
            gain=wanted.sign * wanted.scale * factor,
            # A stated offset is in the canonical unit; the sign does not turn it.
            offset=wanted.offset + wanted.sign * offset,
            checks=self._checks(role, wanted),
        )

    def messages(self) -> dict[int, MessageProtection]:
        """Return protection and period of the messages found so far."""
        stated = self._overrides.stated_messages(self._mapping, self._source, self._key)
        own: dict[str, RuleMap] = {**self._mapping.rules, **self._overrides.rules}
        rules: dict[int, MessageProtection] = {}
        for key, message in self._found.items():
            each, source = stated.get(key, (None, self._source))
            period = None if each is None else each.period_s
            if period is None:
                period = _cycle_s(message)
            rule = None if each is None else choose_rule(message, each, own, source=source)
            rules[key] = MessageProtection(rule, period)
        return rules

    def _checks(self, role: Role, wanted: SignalMap) -> SignalChecks:
        first = self._overrides.checks.get(role, CheckMap())
        checks = checks_of(role, wanted, first)
        if checks.lowest >= checks.highest:
            raise InputError(
                "nothing lies between lowest and highest",
                source=self._source,
                field=role,
                value=f"{checks.lowest:g} … {checks.highest:g}",
            )
        return checks

    def _find(self, role: Role, wanted: SignalMap) -> tuple[Message, Signal, Path]:
        first: InputError | None = None
        for database, file in zip(self._databases, self._files, strict=True):
            try:
                message, signal = find_signal(
                    database, wanted.message, wanted.signal, source=file, field=role
                )
            except InputError as error:
                first = first or error
            else:
                return message, signal, file
        raise first or InputError("no DBC is given", field=role)

    def _key(self, name: str) -> int:
        """Return the key of the message that a key of [messages] means."""
        first: InputError | None = None
        for database, file in zip(self._databases, self._files, strict=True):
            try:
                message = find_message(database, name, source=file, field=f"messages.{name}")
            except InputError as error:
                first = first or error
            else:
                return message.frame_id | (EXTENDED if message.is_extended_frame else 0)
        raise first or InputError("no DBC is given", field=f"messages.{name}")

    def _unit(self, role: Role, wanted: SignalMap, codec: SignalCodec) -> tuple[float, float]:
        """Return factor and offset from the DBC's unit to the canonical one."""
        if wanted.states_unit:
            return 1.0, 0.0
        ends = np.array([0.0, 1.0])
        try:
            ends, _ = convert(
                ends, _LOG_FIELD[role], codec.unit, source=self._source, label=codec.name
            )
        except InputError as error:
            raise InputError(
                f"the DBC's unit of {codec.name} is not known for {_LOG_FIELD[role]}",
                source=self._source,
                field=f"{role}.signal",
                value=codec.unit,
                cure="name another signal, or state scale and offset in the map file"
                " (scale = 1 takes it as it is)",
            ) from error
        return float(ends[1] - ends[0]), float(ends[0])


# --- `load_vehicle`: a vehicle by the name of a preset, or by a DBC and a map file


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

"""Vehicles: signals of a map file bound to a DBC, ready to decode and encode; presets.

`Vehicle.load` gives a vehicle by the name of a preset, or by a DBC and a map file.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, TypeVar

from can.interfaces.socketcan.constants import CAN_EFF_FLAG, MSK_ARBID
from can.typechecking import CanFilter, StringPathLike
from cantools.database.can import Message

from cangauge._config import read_toml, validated
from cangauge._resources import shared_file
from cangauge.bus.database import (
    BitField,
    SignalCodec,
    find_message,
    find_signal,
    load_dbc,
    signal_codec,
)
from cangauge.bus.isotp import (
    READ_BY_IDENTIFIER,
    REPLY_BIT,
    PollTarget,
    reply_id,
    reply_start,
)
from cangauge.bus.mapping import CellsMap, MessageMap, SignalMap, VehicleMap
from cangauge.bus.plausibility import SignalChecks
from cangauge.bus.protection import Protection
from cangauge.errors import InputError, closest, located, require_temperature
from cangauge.logs.quantities import unit_of
from cangauge.settings import VOLTAGE_ACCURACY_PCT, TemperatureSource

_T = TypeVar("_T")
Role = Literal["current", "voltage", "temperature", "soc_reference", "cells"]
LOG_COLUMNS: Final = {
    "current": "current_a",
    "voltage": "voltage_v",
    "temperature": "temperature_c",
    "soc_reference": "soc_pct",
    "cells": "voltage_v",
}
"""Column of the canonical log by role."""


def pgn_mask(key: int) -> int:
    """Return the bits of an extended id that are its PGN (SAE J1939-21)."""
    # Below 0xF0 the PDU format is followed by a destination, which is no part of the PGN.
    return 0x03FF0000 if (key >> 16 & 0xFF) < 0xF0 else 0x03FFFF00


@dataclass(frozen=True, slots=True)
class VehicleSignal:
    """One signal of a vehicle in A (positive = discharge), V, °C or %, and its message.

    `key` is the arbitration id, plus `CAN_EFF_FLAG` for an extended one.
    """

    role: Role
    key: int
    message: str
    length: int
    codec: SignalCodec
    checks: SignalChecks

    @property
    def arbitration_id(self) -> int:
        """The id without the flag of extended ones."""
        return self.key & ~CAN_EFF_FLAG

    @property
    def is_extended(self) -> bool:
        """Whether the id has 29 bits."""
        return bool(self.key & CAN_EFF_FLAG)


class MessageProtection(NamedTuple):
    """Protection and period [s] of one message, where known, and how it is identified.

    `name`: of the protection in the map file.
    `reply`: first bytes of a reply over ISO-TP; b"" for other messages. `request_id`: on which it
    may be asked for; `by_pgn`: from any source address (J1939).
    """

    rule: Protection | None
    period_s: float | None
    reply: bytes = b""
    by_pgn: bool = False
    request_id: int | None = None
    name: str | None = None


@dataclass(frozen=True, slots=True)
class Vehicle:
    """Signals of a vehicle, ready to decode and encode; None: the vehicle has none.

    `voltage_accuracy_pct` is the standard deviation of the voltage sensor's lasting error [%].
    `fixed_temperature_c` is the temperature where no signal has it [°C]. `pair_within_s` is the
    largest distance in bus time between paired current and voltage [s]. `messages` has every
    message with a wanted signal, by key (id, plus `CAN_EFF_FLAG`). `cells` are the cell voltages
    that `cells_map` states: one signal per cell, or those of one group, numbered in a frame by
    `cell_index`. `remarks` list deviations from the DBC files as written.
    """

    name: str
    current: VehicleSignal
    voltage: VehicleSignal
    temperature: VehicleSignal | None
    soc_reference: VehicleSignal | None
    fixed_temperature_c: float | None
    temperature_source: TemperatureSource
    pair_within_s: float
    messages: dict[int, MessageProtection]
    dbc_files: tuple[str, ...]
    voltage_accuracy_pct: float = VOLTAGE_ACCURACY_PCT
    cells: tuple[VehicleSignal, ...] = ()
    cell_index: BitField | None = None
    cells_map: CellsMap | None = None
    remarks: tuple[str, ...] = ()

    @classmethod
    def load(
        cls,
        preset: str | None = None,
        dbc: StringPathLike | None = None,
        map: StringPathLike | None = None,  # noqa: A002 - as the option --map
        *,
        temperature_c: float | None = None,
        pair_within_s: float | None = None,
    ) -> Vehicle:
        """Load a vehicle by the name of a preset, or by a DBC and a map file.

        Parameters
        ----------
        preset : str, optional
            One of `PRESETS`.
        dbc, map : path-like, optional
            DBC and TOML file of another car; see `cangauge.bus.mapping`.
        temperature_c : float, optional
            Fixed temperature instead of the signal [°C]; its source is then unknown.
        pair_within_s : float, optional
            Largest distance between paired current and voltage [s]; default: from the map file.

        Raises
        ------
        InputError
            Names file, field, value and cure: unknown preset, both or neither given, unknown keys,
            signals missing in the DBC, units that do not suit the role; a preset without a
            temperature on the bus when `temperature_c` is not given.

        Examples
        --------
        >>> vehicle = Vehicle.load("leaf_aze0")
        >>> vehicle.name, vehicle.current.codec.name, hex(vehicle.current.arbitration_id)
        ('Nissan Leaf AZE0', 'current_a', '0x1db')
        """
        require_temperature(temperature_c)
        if preset is not None:
            if dbc is not None or map is not None:
                problem, cure = "given together with a DBC or a map", "give one or the other"
                raise InputError(problem, field="--vehicle", value=preset, cure=cure)
            known = _find_preset(preset, field="--vehicle")
            if known.lacks_temperature and temperature_c is None:
                problem = "no pack temperature is known on the bus of this car"
                cure = "give --temperature °C"
                raise InputError(problem, field="--vehicle", value=preset, cure=cure)
            return known.vehicle(temperature_c, pair_within_s)
        if map is None:
            if dbc is None:
                cure = f"give --vehicle ({', '.join(PRESETS)}), or --map FILE"
                raise InputError("no vehicle is given", field="--vehicle", cure=cure)
            problem = "a DBC alone does not name the signals"
            cure = "give --map FILE, which names three signals; to write one:"
            cure += f" cangauge init CAPTURE --dbc {dbc} -o mycar"
            raise InputError(problem, source=str(dbc), field="--map", cure=cure)
        mapping = validated(VehicleMap, _with_preset(read_toml(map), map), map)
        files = [] if dbc is None else [Path(dbc)]
        files += [Path(map).parent / name for name in mapping.dbc]
        if not files:
            cure = 'name the DBC: dbc = "car.dbc"'
            raise InputError("is missing", source=map, field="dbc", cure=cure)
        if mapping.temperature is None and temperature_c is None:
            cure = "name its signal, or give --temperature °C"
            raise InputError("is missing", source=map, field="temperature", cure=cure)
        return _Binder(mapping, files, str(map)).vehicle(temperature_c, pair_within_s)

    @property
    def signals(self) -> tuple[VehicleSignal, ...]:
        """The signals that exist: current, voltage, temperature, reference SoC."""
        signals = (self.current, self.voltage, self.temperature, self.soc_reference)
        return tuple(signal for signal in signals if signal is not None)

    @property
    def battery(self) -> str:
        """Identity of the battery: messages, bits and sign of current and voltage."""
        parts = []
        for signal in (self.current, self.voltage):
            codec = signal.codec
            pages = [(field, sorted(values)) for field, values in codec.conditions]
            form = codec.field, codec.is_signed, codec.float_format
            parts.append((signal.key, *form, pages, codec.gain * codec.factor > 0.0))
        return repr(parts)

    @property
    def frame_keys(self) -> tuple[int, ...]:
        """Ids of the frames with a wanted signal, plus `CAN_EFF_FLAG`, each once."""
        keys = [signal.key for signal in (*self.signals, *self.cells)]
        ids = (reply_id(key) if self.messages[key].reply else key for key in keys)
        return tuple(dict.fromkeys(ids))

    @property
    def wanted_ids(self) -> tuple[int, ...]:
        """Arbitration ids with a wanted signal, each once."""
        return tuple(dict.fromkeys(key & ~CAN_EFF_FLAG for key in self.frame_keys))

    @property
    def poll_targets(self) -> list[PollTarget]:
        """Replies to request, where the map states a request id."""
        return [
            PollTarget(each.request_id, reply_id(key), each.reply)
            for key, each in self.messages.items()
            if each.reply and each.request_id is not None
        ]

    @property
    def filters(self) -> list[CanFilter]:
        """The wanted ids as filters of python-can (`bus.set_filters`)."""
        filters: list[CanFilter] = []
        for key in self.frame_keys:
            number, is_extended = key & MSK_ARBID, bool(key & CAN_EFF_FLAG)
            mask = MSK_ARBID if is_extended else 0x7FF
            if key in self.messages and self.messages[key].by_pgn:
                mask = pgn_mask(key)
            filters.append({"can_id": number, "can_mask": mask, "extended": is_extended})
        return filters


_EXTENDED_KINDS: Final = {
    "j1939": "0x18F08AF3",
    "isotp": "0x7BB6104 for 61 04 on 0x7BB",
    "uds": "0x7EC0101 for 62 01 01 on 0x7EC",
}


class _Binder:
    """Find the signals of a map file in its DBC files; a signal is taken from the first with it.

    `source` is the map file, for error messages.
    """

    def __init__(self, mapping: VehicleMap, files: Sequence[Path], source: str) -> None:
        self._mapping, self._source = mapping, source
        self._remarks: list[str] = []
        self._databases = [(load_dbc(path, self._remarks), path) for path in files]
        self._messages: dict[int, Message] = {}

    def vehicle(self, temperature_c: float | None, pair_within_s: float | None) -> Vehicle:
        """Return the vehicle; arguments as in `Vehicle.load`."""
        mapping = self._mapping
        within_s = mapping.pair_within_s if pair_within_s is None else pair_within_s
        if not 0.0 <= within_s <= 1.0:
            raise InputError("must be within 0–1 s", field="pair_within_s", value=within_s)
        temperature, fixed_c = mapping.temperature, temperature_c
        if temperature is not None and fixed_c is None:
            fixed_c = temperature.fixed_c
        wanted_cells = [] if mapping.cells is None else mapping.cells.signal_maps()
        cells = tuple(self._signal("cells", each) for each in wanted_cells)
        return Vehicle(
            name=mapping.name,
            current=self._signal("current", mapping.current),
            voltage=self._signal("voltage", mapping.voltage),
            voltage_accuracy_pct=mapping.voltage.accuracy_pct,
            cells=cells,
            cell_index=self._cell_index(mapping.cells, cells),
            cells_map=mapping.cells,
            temperature=self._optional("temperature", temperature if fixed_c is None else None),
            soc_reference=self._optional("soc_reference", mapping.soc_reference),
            fixed_temperature_c=fixed_c,
            temperature_source=mapping.temperature_source if temperature_c is None else "unknown",
            pair_within_s=within_s,
            messages=self._protections(),
            dbc_files=tuple(str(path) for _, path in self._databases),
            remarks=tuple(self._remarks),
        )

    def _cell_index(
        self, wanted: CellsMap | None, cells: Sequence[VehicleSignal]
    ) -> BitField | None:
        """Return the bits of a group's number; its signals share the frame."""
        if wanted is None or wanted.index is None:
            return None
        if len({(cell.key, cell.codec.conditions) for cell in cells}) > 1:
            problem = "the signals of a group are not in the same frame"
            raise InputError(problem, source=self._source, field="cells.signals")
        numbering = SignalMap(message=wanted.message, signal=wanted.index, scale=1.0)
        return self._signal("cells", numbering).codec.field

    def _in_first(
        self, find: Callable[..., _T], field: str, *names: str | int | None
    ) -> tuple[_T, Path]:
        """Return what `find` gives for names in the first DBC that has them, and the DBC.

        Raises the first DBC's error.
        """
        errors = []
        for database, file in self._databases:
            try:
                with located(file, field):
                    return find(database, *names), file
            except InputError as error:
                errors.append(error)
        raise errors[0]

    def _optional(self, role: Role, wanted: SignalMap | None) -> VehicleSignal | None:
        return None if wanted is None else self._signal(role, wanted)

    def _signal(self, role: Role, wanted: SignalMap) -> VehicleSignal:
        (message, signal), file = self._in_first(find_signal, role, wanted.message, wanted.signal)
        with located(file, role):
            codec = signal_codec(
                message,
                signal,
                not_available=wanted.not_available,
                when=wanted.when,
                signed=wanted.signed,
            )
        key = _key(message)
        self._messages[key] = message
        factor, offset = (1.0, 0.0) if wanted.states_unit else self._unit(role, codec)
        # A stated offset is in the canonical unit and keeps its sign.
        gain, shift = wanted.sign * wanted.scale * factor, wanted.offset + wanted.sign * offset
        codec = dataclasses.replace(codec, gain=gain, shift=shift)
        return VehicleSignal(role, key, message.name, message.length, codec, wanted)

    def _unit(self, role: Role, codec: SignalCodec) -> tuple[float, float]:
        """Return factor and offset from the DBC's unit to the canonical one."""
        column = LOG_COLUMNS[role]
        scale = unit_of(column, codec.unit) if codec.unit.strip() else (1.0, 0.0)
        if scale is None:
            problem = f"the unit of {codec.name} in the DBC is unknown for {column}"
            cure = "name another signal, or state scale and offset in the map file"
            cure += " (scale = 1 takes the values as they are)"
            where, unit = f"{role}.signal", codec.unit
            raise InputError(problem, source=self._source, field=where, value=unit, cure=cure)
        return scale

    def _protections(self) -> dict[int, MessageProtection]:
        """Return protection and period of the messages with a signal."""
        stated, protections = dict[int, MessageMap](), {}
        for name, table in self._mapping.messages.items():
            key = self._message_key(name)  # a preset may name what the map gives by its id
            own = table.model_dump(exclude_unset=True)
            stated[key] = stated.get(key, MessageMap()).model_copy(update=own)
        for key, message in self._messages.items():
            each = stated.get(key, MessageMap())
            cycle_ms, period_s = message.cycle_time, each.period_s
            # In some DBC files it is not a number.
            if period_s is None and isinstance(cycle_ms, int | float) and 0 < cycle_ms < math.inf:
                period_s = cycle_ms / 1000.0
            with located(self._source, f"messages.{message.name}"):
                rule = each.rule(message, self._mapping.rules)
                reply = self._reply_of(message, each)
            protections[key] = MessageProtection(
                rule, period_s, reply, each.j1939, each.request_id, each.protection
            )
        return protections

    @staticmethod
    def _reply_of(message: Message, stated: MessageMap) -> bytes:
        """Return the first bytes of a reply over ISO-TP; b"" for another message.

        Raises InputError if the message's id cannot be what the map says of it.
        """
        number, problem, cure = message.frame_id, "", ""
        begins_with = number >> 8 & 0xFF
        is_plain = stated.isotp and not stated.uds
        field = next((kind for kind in _EXTENDED_KINDS if getattr(stated, kind)), "")
        if field and not message.is_extended_frame:
            problem = f"{field} needs an extended id"
            cure = f"give it that number in the DBC, as {_EXTENDED_KINDS[field]}"
        elif is_plain and begins_with == READ_BY_IDENTIFIER:
            field, sender = "isotp", f"0x{reply_id(number):X}"
            problem = "replies that begin with 62 differ in two further bytes"
            cure = f"state uds = true, and number it {sender} and both bytes: {sender}0101 for"
            cure += " 62 01 01"
        elif is_plain and begins_with < REPLY_BIT and stated.request_id is not None:
            field = "request_id"
            problem = f"a reply that begins with {begins_with:02X} answers no request"
            cure = f"number it in the DBC by a reply to one, as {_EXTENDED_KINDS['isotp']}"
        if problem:
            raise InputError(problem, field=field, value=f"0x{number:X}", cure=cure)
        return reply_start(number, stated.uds) if stated.isotp or stated.uds else b""

    def _message_key(self, name: str) -> int:
        """Return the key of the message for a name or id in [messages]."""
        message, _ = self._in_first(find_message, f"messages.{name}", name)
        return _key(message)


def _key(message: Message) -> int:
    return message.frame_id | (CAN_EFF_FLAG if message.is_extended_frame else 0)


# --- Presets


@dataclass(frozen=True, slots=True)
class Preset:
    """A known vehicle: its file in `dbc/`, its map, and one line for help texts.

    `periods_s` are message periods that distinguish it from similar ones in a capture [s].
    """

    dbc: str
    mapping: VehicleMap
    about: str
    periods_s: dict[int, float] = dataclasses.field(default_factory=dict)

    @property
    def lacks_temperature(self) -> bool:
        """Whether no pack temperature is known on its bus."""
        return self.mapping.temperature is None

    def vehicle(
        self, temperature_c: float | None = None, pair_within_s: float | None = None
    ) -> Vehicle:
        """Return the vehicle, with or without a temperature; arguments as in `Vehicle.load`."""
        dbc = shared_file("dbc", self.dbc)
        return _Binder(self.mapping, [dbc], str(dbc)).vehicle(temperature_c, pair_within_s)


_NAMES_A_SIGNAL: Final = {"signal", "index", "fixed_c"}


def _added(base: Any, own: Any) -> Any:
    """Return tables with those of another map added; one that names a signal replaces the first's.

    So a map that changes a check keeps the signal, and one with another signal keeps no sign.
    """
    if not isinstance(base, dict) or not isinstance(own, dict) or _NAMES_A_SIGNAL & own.keys():
        return own
    return base | {key: _added(base.get(key), value) for key, value in own.items()}


def _presets() -> dict[str, Preset]:
    path = shared_file("dbc", "presets.toml")
    tables, presets = read_toml(path), {}
    for name, own in tables.items():
        table = _added(tables.get(own.get("like"), {}), own)
        table.pop("like", None)
        dbc, about = table.pop("dbc"), table.pop("about")
        periods_s = {int(key, 0): value for key, value in table.pop("periods_s", {}).items()}
        presets[name] = Preset(dbc, validated(VehicleMap, table, path), about, periods_s)
    return presets


PRESETS: Final = _presets()
"""By the name that `--vehicle` takes."""


def _find_preset(name: str, *, field: str, source: StringPathLike | None = None) -> Preset:
    """Return the preset of that name; case does not matter, nor does `-` for `_`.

    Raises InputError with `field` and `source` if there is none.
    """
    preset = PRESETS.get(name.strip().lower().replace("-", "_"))
    if preset is not None:
        return preset
    near = closest(name, PRESETS)
    known = f"known are {', '.join(PRESETS)}; for another car give --map FILE"
    cure = f"did you mean {near}?" if near else known
    raise InputError("unknown vehicle", source=source, field=field, value=name, cure=cure)


def _with_preset(own: dict[str, Any], source: StringPathLike) -> dict[str, Any]:
    """Return the tables of a map file, added to those of the preset that it is `like`, if any."""
    if "like" not in own:
        return own
    preset = _find_preset(str(own.pop("like")), source=source, field="like")
    if "soc" in own:
        own["soc_reference"] = own.pop("soc")
    tables = preset.mapping.model_dump(exclude_unset=True)
    tables["dbc"] = str(shared_file("dbc", preset.dbc))
    return dict(_added(tables, own))

"""The map file: which signals of a DBC are current, voltage and temperature; their conversion.

A TOML file, for any car with a DBC; `docs/map-file.md` shows each key.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from cantools.database.can import Message
from pydantic import AliasChoices, Field, PositiveFloat, model_validator

from cangauge._config import read_toml
from cangauge.bus.database import BitField, named_signal
from cangauge.bus.plausibility import SignalChecks
from cangauge.bus.protection import (
    PROFILES,
    RULES,
    Byte,
    CounterRule,
    DataIdMode,
    E2eRule,
    Protection,
    ProtectionRule,
)
from cangauge.errors import InputError
from cangauge.estimation.cells import CELLS_AT_MOST
from cangauge.logs.column_map import ColumnMap
from cangauge.model.fields import Fields
from cangauge.settings import VOLTAGE_ACCURACY_PCT, TemperatureSource, VoltageAccuracyPct

COUNTER: Final = "counter"
"""Protection by a counter alone."""
_NUMBERED: Final = re.compile(r"[^{}]*(\{n(:0?\d?[dxX]?)?\}[^{}]*)*")
"""A name with "{n}" or "{n:02d}"; other forms of `str.format` may fail, or take gigabytes."""


class SignalMap(SignalChecks):
    """One signal of the DBC: value = sign × scale × (DBC value) + offset.

    `message` is a name or id, optional where the signal's name is unique. `sign` is −1 where the
    bus has the opposite sign (current: negative = discharge). `signed` reads the bits as a signed
    number where the DBC does not. Stating `scale` or `offset` overrides the DBC's unit. `when` are
    raw values that other signals of the frame must have (multiplexers missing in the DBC),
    `not_available` raw codes without a value besides those of the value table.
    """

    message: str | int | None = None
    signal: str
    sign: Literal[1, -1] = 1
    signed: bool = False
    scale: PositiveFloat = 1.0
    offset: float = 0.0
    when: dict[str, int] = Field(default_factory=dict)
    not_available: tuple[int, ...] = ()

    @property
    def states_unit(self) -> bool:
        """Whether the map file states the conversion to the canonical unit."""
        return bool({"scale", "offset"} & self.model_fields_set)


class VoltageMap(SignalMap):
    """The voltage's signal, with the standard deviation of its sensor's lasting error [%]."""

    accuracy_pct: VoltageAccuracyPct = VOLTAGE_ACCURACY_PCT


class TemperatureMap(SignalMap):
    """A temperature signal, or a fixed temperature where the bus has none."""

    signal: str = ""
    fixed_c: Annotated[float, Field(ge=-60.0, le=120.0)] | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if bool(self.signal) == (self.fixed_c is not None):
            raise ValueError("give either signal or fixed_c")
        return self


class CellsMap(Fields):
    """Voltages of the cells in series: one signal a cell, or groups numbered by a signal.

    `signal` and `message` are names with "{n}" for the cell's number, from `first` on; or the raw
    value of `index` numbers the group in a frame, from `first_index` on, and `signals` are those of
    a group, in the order of the cells. The other keys are as in `SignalMap` [V, s].
    """

    count: Annotated[int, Field(ge=2, le=CELLS_AT_MOST)]
    first: Annotated[int, Field(ge=0, le=CELLS_AT_MOST)] = 1
    signal: str | None = None
    message: str | int | None = None
    index: str | None = None
    signals: tuple[str, ...] = ()
    first_index: int = 0
    scale: PositiveFloat = 1.0
    offset: float = 0.0
    not_available: tuple[int, ...] = ()
    lowest: float = 0.2
    highest: float = 6.0  # below and above any lithium cell
    timeout_s: PositiveFloat = 10.0  # large packs send a round of cells in some seconds

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        is_group, of_group = self.signal is None, (self.index, self.signals or None)
        is_whole = of_group.count(None) == (0 if is_group else 2)
        if not is_whole or (is_group and self.message is None):
            raise ValueError("give either signal, or index, signals and message")
        if self.signal is not None and "{n" not in self.signal:
            raise ValueError('signal needs "{n}" for the number of the cell')
        for name in (self.signal, self.message):
            if isinstance(name, str) and _NUMBERED.fullmatch(name) is None:
                raise ValueError(f"{name!r} is not a name with {{n}}")
        return self

    def signal_maps(self) -> list[SignalMap]:
        """Return the map of each cell's signal, or of each signal of a group."""
        names = [(name, self.message) for name in self.signals]
        if self.signal is not None:
            numbers = range(self.first, self.first + self.count)
            names = [(self.signal.format(n=n), _numbered(self.message, n)) for n in numbers]
        stated = {name: getattr(self, name) for name in {"scale", "offset"} & self.model_fields_set}
        return [
            SignalMap(message=message, signal=name, not_available=self.not_available, **stated)
            for name, message in names
        ]


def _numbered(name: str | int | None, number: int) -> str | int | None:
    return name.format(n=number) if isinstance(name, str) else name


class MessageMap(Fields):
    """Protection and period of a message.

    `protection` is one of `protection.RULES`, of [rules] or of `protection.PROFILES` (see `E2eRule`
    for their keys), or "counter", with its signal and the number of its values, by default all that
    its bits can hold. `j1939`: its PGN identifies it, from any source address and at any priority.
    `isotp`: it is a reply over ISO-TP, `uds`: one to ReadDataByIdentifier, each with the id of
    `isotp.reply_start` in the DBC; the service may ask for it on `request_id`.
    """

    protection: str | None = None
    j1939: bool = False
    isotp: bool = False
    uds: bool = False
    request_id: Annotated[int, Field(ge=0, le=0x7FF)] | None = None
    period_s: PositiveFloat | None = None
    data_id: Annotated[int, Field(ge=0, lt=1 << 32)] | None = None
    data_id_list: Annotated[tuple[Byte, ...], Field(min_length=16, max_length=16)] | None = None
    data_id_mode: DataIdMode | None = None
    header_byte: Annotated[int, Field(ge=0, le=63)] | None = None
    protected_bytes: Annotated[int, Field(ge=1, le=64)] | None = None
    counter: str | None = None
    counter_modulus: Annotated[int, Field(ge=3, lt=1 << 32)] | None = None

    def rule(self, message: Message, rules: Mapping[str, ProtectionRule]) -> Protection | None:
        """Return the protection of a message; None where none is stated.

        `rules` are the user's own. Raises InputError if the rule is unknown, does not fit, lacks a
        field or has one of another protection.
        """
        name, known = self.protection, {**RULES, **rules}
        owner = f'"{COUNTER}"' if name == COUNTER else "an e2e profile" if name in PROFILES else ""
        stated = self.model_dump(include=set(_OWNERS), exclude_none=True)
        for field in stated:
            if _OWNERS[field] != owner:
                cure = f"set protection to {_OWNERS[field]}, or remove this field"
                raise InputError(f"belongs to {_OWNERS[field]}", field=field, cure=cure)
        rule: Protection
        if name is None:
            return None
        if name in known:
            rule = known[name]
        elif name in PROFILES:
            rule = E2eRule(name, **stated)
        elif name == COUNTER:
            rule = self._counter_rule(message)
        else:
            cure = f"known are {', '.join([*RULES, COUNTER, *PROFILES, *rules])};"
            cure += f" or define it under [rules.{name}]"
            raise InputError("unknown protection rule", field="protection", value=name, cure=cure)
        if not rule.fits(message.length):
            problem = f"the rule does not fit into the {message.length} bytes of the message"
            raise InputError(problem, field="protection", value=name)
        return rule

    def _counter_rule(self, message: Message) -> CounterRule:
        if self.counter is None:
            cure = "name the signal of the alive counter"
            raise InputError("is missing", field="counter", cure=cure)
        bits = BitField.of(named_signal(message, self.counter, "counter"), message.length)
        return CounterRule(bits, self.counter_modulus or 1 << bits.width)


_OWNERS: Final = {
    **dict.fromkeys(["counter", "counter_modulus"], f'"{COUNTER}"'),
    **dict.fromkeys(
        ["data_id", "data_id_list", "data_id_mode", "header_byte", "protected_bytes"],
        "an e2e profile",
    ),
}
"""The protection to which a field of a message belongs."""


class VehicleMap(Fields):
    """Content of a map file.

    `dbc` are files relative to it. The temperature may be given as an option; `soc_reference`
    (also: `soc`) is the car's own state of charge. `columns` are those of
    the car's logs that are tables (`logs.column_map.ColumnMap`). `pair_within_s` is the largest
    distance in bus time between paired current and voltage [s]. Messages go by name or id.
    """

    name: str = "own map"
    dbc: tuple[str, ...] = ()
    current: SignalMap
    voltage: VoltageMap
    temperature: TemperatureMap | None = None
    soc_reference: SignalMap | None = Field(
        default=None, validation_alias=AliasChoices("soc_reference", "soc")
    )
    columns: dict[str, Any] | None = None
    cells: CellsMap | None = None
    temperature_source: TemperatureSource = "unknown"
    pair_within_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.020
    messages: dict[str, MessageMap] = Field(default_factory=dict)
    rules: dict[str, ProtectionRule] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _short_forms(cls, data: dict[str, Any]) -> dict[str, Any]:
        """Accept `dbc = "a.dbc"`, and `soc = "DisplaySoc"` for a table with the signal alone."""
        if isinstance(data.get("dbc"), str):
            data = {**data, "dbc": (data["dbc"],)}
        roles = ("current", "voltage", "temperature", "soc", "soc_reference")
        short = {name: {"signal": data[name]} for name in roles if isinstance(data.get(name), str)}
        return {**data, **short}


def columns_of_map(path: Path | str) -> ColumnMap | None:
    """Return `[columns]` of a map file, or None; the file may hold nothing else.

    Raises InputError if the file cannot be read, or a column is not understood.
    """
    columns = read_toml(path).get("columns")
    return None if columns is None else ColumnMap.of(columns, f"{path}: columns")

"""What a car's signals are called and how they are meant: the map file, checked by pydantic.

A map file in TOML, for any car with a DBC::

    name = "my car"
    dbc = "my_car.dbc"              # optional: --dbc says it too
    temperature_source = "pack"     # cell, pack, coolant, room, unknown
    pair_within_s = 0.020

    [current]
    message = "BMS_Status"          # name or id ("0x1DB"); optional where the signal is unique
    signal = "PackCurrent"
    sign = -1                       # -1: on the bus, negative current discharges
    lowest = -400                   # optional, as all below: [A], [V], [°C], in cangauge's sign
    highest = 400
    max_jump = 300                  # between two values, whatever the time between them …
    max_rate_per_s = 5000           # … and so much more a second
    invalid_after = 5               # refused values in a row, then the signal is invalid …
    valid_after = 3                 # … until so many good ones in a row
    timeout_s = 0.5                 # without: from the message's period

    [voltage]
    signal = "PackVoltage"

    [temperature]
    signal = "PackTemperature"      # or: fixed_c = 21.5
    when = { Selector = 2 }         # only in frames where this signal has this raw value

    [soc_reference]                 # optional, to compare with
    signal = "DisplaySoc"

    [messages.BMS_Status]           # optional
    protection = "my_rule"          # leaf, generic, crc_only, counter, e2e_01, e2e_02, e2e_04,
                                    # e2e_05, e2e_06, e2e_07, e2e_11, or one of [rules]
    period_s = 0.01                 # without: the DBC's, or learned from the frames

    [messages.BMS_Temps]
    protection = "e2e_05"           # AUTOSAR end-to-end protection
    data_id = 0x1234                # e2e_02: data_id_list = [16 numbers of 0-255]
    # data_id_mode = "nibble"       # e2e_01, e2e_11: both (default), alternating, low, nibble
    # header_byte = 0               # where the header begins
    # protected_bytes = 8           # default: all bytes of the message

    [messages.BMS_Limits]
    protection = "counter"          # no CRC that is known
    counter = "AliveCounter"        # signal of the DBC
    counter_modulus = 15            # default: all values of its bits

    [rules.my_rule]
    polynomial = 0x2F
    initial = 0xFF
    xor_out = 0xFF
    crc_byte = 0
    counter_byte = 1
    counter_bits = 4
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from cangauge.bus.protection import LIST_LENGTH, DataIdMode, ProtectionRule
from cangauge.logs.log import TemperatureSource

PAIR_WITHIN_S = 0.020
"""Current and voltage at most this far apart in bus time belong together [s]."""

_Byte = Annotated[int, Field(ge=0, le=255)]
_Place = Annotated[int, Field(ge=-64, le=63)]
_Positive = Annotated[FiniteFloat, Field(gt=0.0)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)


class CheckMap(_Strict):
    """When values of a signal are believed; what is not stated is by default (`checks_of`).

    Parameters
    ----------
    lowest, highest : float, optional
        What a value can be [A, positive = discharge; V; °C; %].
    max_jump, max_rate_per_s : float, optional
        A value may differ from the latest good one by `max_jump`, and by `max_rate_per_s` more
        for every second since [A, V, K, %].
    invalid_after, valid_after : int, optional
        So many refused values in a row make the signal invalid; so many good ones valid again.
    stuck_after_s : float, optional
        Standing still for so long is suspicious [s]: current and voltage while the other one
        moves, temperature whatever the others do (only where this is stated).
    timeout_s : float, optional
        The value holds for so long [s]; by default a multiple of the message's period.
    """

    lowest: FiniteFloat | None = None
    highest: FiniteFloat | None = None
    max_jump: _Positive | None = None
    max_rate_per_s: _Positive | None = None
    invalid_after: Annotated[int, Field(ge=1, le=1000)] | None = None
    valid_after: Annotated[int, Field(ge=1, le=1000)] | None = None
    stuck_after_s: _Positive | None = None
    timeout_s: _Positive | None = None

    @model_validator(mode="after")
    def _a_range(self) -> Self:
        if self.lowest is not None and self.highest is not None and self.lowest >= self.highest:
            raise ValueError("lowest must lie below highest")
        if (self.max_rate_per_s is None) is not (self.max_jump is None):
            raise ValueError("max_jump and max_rate_per_s belong together")
        return self


class SignalMap(CheckMap):
    """One signal of the DBC and what it means: value = sign × scale × (DBC value) + offset.

    Parameters
    ----------
    message : str or int, optional
        Name or id; may be left out where the signal's name is unique in the DBC.
    signal : str
    sign : {1, -1}
        -1 where the bus counts the other way round (current: negative = discharge).
    scale, offset : float
        For a DBC with a wrong or foreign unit; stating either also overrides the DBC's unit.
    when : dict of str to int
        Raw values that other signals of the frame must have (multiplexers that the DBC lacks).
    not_available : tuple of int
        Raw codes that mean "no value", besides those that the DBC's value table names so.
    lowest, … timeout_s
        As in `CheckMap`.
    """

    message: str | int | None = None
    signal: str
    sign: Literal[1, -1] = 1
    scale: _Positive = 1.0
    offset: FiniteFloat = 0.0
    when: dict[str, int] = Field(default_factory=dict)
    not_available: tuple[int, ...] = ()

    @property
    def states_unit(self) -> bool:
        """Whether the mapping itself says how to come to the canonical unit."""
        return bool({"scale", "offset"} & self.model_fields_set)


class TemperatureMap(SignalMap):
    """A temperature signal, or a fixed temperature where the bus has none."""

    signal: str = ""
    fixed_c: Annotated[FiniteFloat, Field(ge=-60.0, le=120.0)] | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> TemperatureMap:
        if bool(self.signal) == (self.fixed_c is not None):
            raise ValueError("give either signal or fixed_c")
        return self


class MessageMap(_Strict):
    """What is known of a message: its protection, and its period when no frame is lost [s].

    Parameters
    ----------
    protection : str, optional
        A rule that is known, one of [rules], "counter", or a profile of `e2e_rule.PROFILES`.
    period_s : float, optional
    data_id, data_id_list, data_id_mode, header_byte, protected_bytes
        Of a profile; see `E2eRule`.
    counter : str, optional
        Signal that counts, for "counter".
    counter_modulus : int, optional
        Its number of values, where they are not all that its bits can hold.
    """

    protection: str | None = None
    period_s: _Positive | None = None
    data_id: Annotated[int, Field(ge=0, lt=1 << 32)] | None = None
    data_id_list: (
        Annotated[tuple[_Byte, ...], Field(min_length=LIST_LENGTH, max_length=LIST_LENGTH)] | None
    ) = None
    data_id_mode: DataIdMode | None = None
    header_byte: Annotated[int, Field(ge=0, le=63)] | None = None
    protected_bytes: Annotated[int, Field(ge=1, le=64)] | None = None
    counter: str | None = None
    counter_modulus: Annotated[int, Field(ge=3, lt=1 << 32)] | None = None


class RuleMap(_Strict):
    """A protection rule of the user's own; see `ProtectionRule`."""

    polynomial: _Byte
    initial: _Byte = 0
    xor_out: _Byte = 0
    crc_byte: _Place = -1
    counter_bits: Annotated[int, Field(ge=0, le=8)] = 4
    counter_byte: _Place = -2
    counter_shift: Annotated[int, Field(ge=0, le=7)] = 0

    def rule(self, name: str) -> ProtectionRule:
        """Return it as a rule."""
        return ProtectionRule(name, **self.model_dump())


class VehicleMap(_Strict):
    """A whole map file.

    Parameters
    ----------
    name : str
    dbc : tuple of str
        DBC files, relative to the map file; `--dbc` goes before them.
    current, voltage : SignalMap
    temperature : TemperatureMap, optional
        Without it, a fixed temperature must be given elsewhere.
    soc_reference : SignalMap, optional
        The car's own state of charge, to compare with.
    temperature_source : {"cell", "pack", "coolant", "room", "unknown"}
    pair_within_s : float
        Current and voltage at most this far apart in bus time belong together [s].
    messages : dict of str to MessageMap
        By name or id.
    rules : dict of str to RuleMap
    """

    name: str = "own map"
    dbc: tuple[str, ...] = ()
    current: SignalMap
    voltage: SignalMap
    temperature: TemperatureMap | None = None
    soc_reference: SignalMap | None = None
    temperature_source: TemperatureSource = "unknown"
    pair_within_s: Annotated[FiniteFloat, Field(ge=0.0, le=1.0)] = PAIR_WITHIN_S
    messages: dict[str, MessageMap] = Field(default_factory=dict)
    rules: dict[str, RuleMap] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _single_dbc(cls, data: object) -> object:
        if isinstance(data, dict) and isinstance(data.get("dbc"), str):
            return {**data, "dbc": (data["dbc"],)}
        return data

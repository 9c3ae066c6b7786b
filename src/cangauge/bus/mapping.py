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

    [voltage]
    signal = "PackVoltage"

    [temperature]
    signal = "PackTemperature"      # or: fixed_c = 21.5
    when = { Selector = 2 }         # only in frames where this signal has this raw value

    [soc_reference]                 # optional, to compare with
    signal = "DisplaySoc"

    [messages.BMS_Status]           # optional
    protection = "my_rule"          # leaf, generic, crc_only, or one of [rules]
    period_s = 0.01

    [rules.my_rule]
    polynomial = 0x2F
    initial = 0xFF
    xor_out = 0xFF
    crc_byte = 0
    counter_byte = 1
    counter_bits = 4
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from cangauge.bus.protection import ProtectionRule
from cangauge.logs.log import TemperatureSource

PAIR_WITHIN_S = 0.020
"""Current and voltage at most this far apart in bus time belong together [s]."""

_Byte = Annotated[int, Field(ge=0, le=255)]
_Place = Annotated[int, Field(ge=-64, le=63)]
_Positive = Annotated[FiniteFloat, Field(gt=0.0)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)


class SignalMap(_Strict):
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
    timeout_s : float, optional
        The value holds for so long [s].
    """

    message: str | int | None = None
    signal: str
    sign: Literal[1, -1] = 1
    scale: _Positive = 1.0
    offset: FiniteFloat = 0.0
    when: dict[str, int] = Field(default_factory=dict)
    not_available: tuple[int, ...] = ()
    timeout_s: _Positive | None = None

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
    """What is known of a message: its protection, and its period when no frame is lost [s]."""

    protection: str | None = None
    period_s: _Positive | None = None


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

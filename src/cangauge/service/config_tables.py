"""Tables of the service's configuration below the top level, and the description of each key.

A key is a field with its type, bounds, default, unit and help (`key`); `keys_of` lists them for the
command line and the reference.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, StrictBool
from pydantic.fields import FieldInfo

from cangauge.bus.mapping import CheckMap


@dataclass(frozen=True)
class OptionInfo:
    """Data of a key for the command line and the reference.

    Parameters
    ----------
    metavar : str
        Placeholder of the value in help texts; "" for a key of the file only.
    flags : tuple of str
        Option names; empty: the key's name with dashes.
    unit : str
    default : str
        Default in words, where the field's own default is not enough.
    needs_restart : bool
        A reload does not apply a change of this key.
    is_path : bool
        A path, relative to the file that it is in.
    bare : str
        Value of the option where none follows it; "" if one must.
    """

    metavar: str = ""
    flags: tuple[str, ...] = ()
    unit: str = ""
    default: str = ""
    needs_restart: bool = False
    is_path: bool = False
    bare: str = ""


def key(
    default: Any,
    text: str,
    metavar: str = "",
    *flags: str,
    unit: str = "",
    default_text: str = "",
    needs_restart: bool = False,
    is_path: bool = False,
    bare: str = "",
    **bounds: float | str,
) -> Any:
    """Return the field of a key; arguments as of `OptionInfo`, bounds as of pydantic's Field."""
    info = OptionInfo(metavar, flags, unit, default_text, needs_restart, is_path, bare)
    field: FieldInfo = Field(default, description=text, **bounds)  # type: ignore[call-overload] # bounds are numbers or patterns
    field.metadata.append(info)
    return field


def option_info(field: FieldInfo) -> OptionInfo:
    """Return the option data of a key's field."""
    return next((each for each in field.metadata if isinstance(each, OptionInfo)), OptionInfo())


_TOPIC: Final = r"^[^/+#\s\x00]+(/[^/+#\s\x00]+)*$"
"""Topic of MQTT without wildcards and empty levels."""


class Strict(BaseModel):
    """A table that refuses unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class IdsConfig(Strict):
    """Standard ids of the published frames and of the replay clock."""

    soc_estimate: int = key(0x5A0, "Id of SOC_ESTIMATE.", "ID", "--soc-estimate-id", ge=0, le=0x7FF)
    soc_detail: int = key(0x5A1, "Id of SOC_DETAIL.", "ID", "--soc-detail-id", ge=0, le=0x7FF)
    replay_clock: int = key(
        0x5AF, "Id of REPLAY_CLOCK.", "ID", "--replay-clock-id", ge=0, le=0x7FF, needs_restart=True
    )
    soc_health: int = key(0x5A2, "Id of SOC_HEALTH.", "ID", "--soc-health-id", ge=0, le=0x7FF)
    soc_power: int = key(0x5A3, "Id of SOC_POWER.", "ID", "--soc-power-id", ge=0, le=0x7FF)
    soc_cells: int = key(
        0x5A4,
        "Id of SOC_CELLS, sent where the vehicle gives cell voltages.",
        "ID",
        "--soc-cells-id",
        ge=0,
        le=0x7FF,
    )


class ChecksConfig(Strict):
    """Plausibility checks by signal, as in a map file; see `CheckMap`."""

    current: CheckMap = key(CheckMap(), "Plausibility check of the current.")
    voltage: CheckMap = key(CheckMap(), "Plausibility check of the voltage.")
    temperature: CheckMap = key(CheckMap(), "Plausibility check of the temperature.")
    soc_reference: CheckMap = key(CheckMap(), "Plausibility check of the vehicle's own SoC.")


class FullChargeConfig(Strict):
    """Condition of a full pack; see `FullCharge`."""

    voltage_v: FiniteFloat = key(..., "Least voltage.", unit="V", gt=0.0, le=1e4)
    current_a: FiniteFloat = key(..., "Largest absolute current.", unit="A", ge=0.0, le=5e3)
    hold_s: FiniteFloat = key(60.0, "Duration of both.", unit="s", ge=0.0, le=86400.0)
    soc_pct: FiniteFloat = key(100.0, "SoC then.", unit="%", ge=0.0, le=100.0)
    soc_std_pct: FiniteFloat = key(0.5, "Its standard deviation.", unit="%", ge=0.01, le=100.0)


class LongRestConfig(Strict):
    """Condition of an open-circuit voltage at rest; see `LongRest`."""

    after_s: FiniteFloat = key(
        7200.0, "Least duration of the rest.", unit="s", ge=60.0, le=30.0 * 86400.0
    )
    soc_std_pct: FiniteFloat = key(
        2.0, "Standard deviation of the SoC by its voltage.", unit="%", ge=0.01, le=100.0
    )


def _limit(text: str, default_text: str, *, unit: str, le: float = 1e4) -> Any:
    return key(None, text, unit=unit, default_text=default_text, ge=0.0, le=le)


class PollConfig(Strict):
    """Requests for replies over ISO-TP; see `Poller`."""

    every_s: FiniteFloat = key(
        10.0,
        "Interval between requests for the same reply. One is sent at a time; without an answer"
        " the interval doubles, up to a minute; while another tester asks, none is sent.",
        unit="s",
        ge=1.0,
        le=3600.0,
    )


class LimitsConfig(Strict):
    """Limits for the possible currents and the energy left; see `PackLimits`."""

    min_voltage_v: FiniteFloat | None = _limit(
        "Lowest pack voltage.", "the pseudo-OCV at the lower end of the identified SoC", unit="V"
    )
    max_voltage_v: FiniteFloat | None = _limit(
        "Highest pack voltage.", "the pseudo-OCV at the upper end of the identified SoC", unit="V"
    )
    max_discharge_a: FiniteFloat | None = _limit(
        "Largest discharge current.", "the largest that the model was identified on", unit="A"
    )
    max_charge_a: FiniteFloat | None = _limit(
        "Largest charge current, positive.",
        "the largest that the model was identified on",
        unit="A",
    )
    cutoff_soc_pct: FiniteFloat | None = _limit(
        "SoC at which the energy ends; it also ends at the lowest voltage.",
        "the lower end of the identified SoC",
        unit="%",
        le=100.0,
    )


class MqttConfig(Strict):
    """MQTT broker that takes the state; see `MqttSettings`."""

    broker: str = key(
        ..., "Host name or address of the MQTT broker.", needs_restart=True, min_length=1
    )
    port: int | None = key(
        None,
        "Its port.",
        default_text="1883, with TLS 8883",
        needs_restart=True,
        ge=1,
        le=65535,
    )
    tls: StrictBool = key(False, "Encrypt, and check its certificate.", needs_restart=True)
    ca_file: str | None = key(
        None,
        "PEM file of the authority that signed it.",
        default_text="the system's",
        needs_restart=True,
        is_path=True,
    )
    user: str | None = key(None, "User name.", needs_restart=True)
    password_file: str | None = key(
        None,
        "File with the password; or in CANGAUGE_MQTT_PASSWORD.",
        needs_restart=True,
        is_path=True,
    )
    topic_prefix: str = key(
        "cangauge",
        "Topics are PREFIX/DEVICE/state and PREFIX/DEVICE/availability.",
        needs_restart=True,
        pattern=_TOPIC,
    )
    discovery_prefix: str = key(
        "homeassistant",
        'Home Assistant\'s prefix of discovery; "" without discovery.',
        needs_restart=True,
        pattern=f"{_TOPIC}|^$",
    )
    device: str | None = key(
        None,
        "Name of this service among those of the broker.",
        default_text="cangauge_HOST_CHANNEL",
        needs_restart=True,
        pattern=r"^[A-Za-z0-9_-]{1,64}$",
    )
    every_s: FiniteFloat = key(
        1.0, "Interval of the states.", unit="s", needs_restart=True, ge=0.1, le=3600.0
    )


@dataclass(frozen=True)
class ConfigKey:
    """A key of the configuration, for the reference and the command line.

    Parameters
    ----------
    name : str
        Dotted key of the TOML file, such as "ids.soc_detail".
    option : str
        Option names, such as "-m, --model"; "" for a key of the file only.
    kind : str
        Type in words.
    default, unit, bounds, text : str
    info : OptionInfo
    """

    name: str
    option: str
    kind: str
    default: str
    unit: str
    bounds: str
    text: str
    info: OptionInfo

    @property
    def help(self) -> str:
        """Help text of the option, with unit and default."""
        first, dot, rest = self.text.partition(". ")
        unit = f" [{self.unit}]" if self.unit else ""
        text = f"{first}{unit}. {rest}" if dot else f"{first.removesuffix('.')}{unit}."
        return f"{text} Default: {self.default}." if self.default else text


def own_model(field: FieldInfo) -> type[BaseModel] | None:
    """Return the model of a key that is a table of further keys."""
    return next(
        (each for each in (field.annotation, *get_args(field.annotation)) if _is_own(each)), None
    )


def keys_of(model: type[BaseModel], prefix: str = "") -> Iterator[ConfigKey]:
    """Yield the keys of a table and of its inner tables, with dotted names."""
    for name, field in model.model_fields.items():
        if (inner := own_model(field)) is not None:
            yield from keys_of(inner, f"{prefix}{name}.")
            continue
        info = option_info(field)
        flags = info.flags or ((f"--{name.replace('_', '-')}",) if info.metavar else ())
        yield ConfigKey(
            name=prefix + name,
            option=", ".join(flags),
            kind=_kind(field.annotation),
            default=info.default or _default(field, info),
            unit=info.unit,
            bounds=_bounds(field),
            text=field.description or "",
            info=info,
        )


def _is_own(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, Strict)


def _kind(annotation: Any) -> str:
    if get_origin(annotation) is Annotated:
        return _kind(get_args(annotation)[0])
    if get_origin(annotation) is Literal:
        return "one of " + ", ".join(map(str, get_args(annotation)))
    if get_origin(annotation) is dict:
        return "table"
    if isinstance(annotation, type):
        names = {bool: "true or false", float: "number", int: "whole number", str: "text"}
        return names.get(annotation, "table")
    return next(_kind(each) for each in get_args(annotation) if each is not type(None))


def _default(field: FieldInfo, info: OptionInfo) -> str:
    value = field.default
    if field.is_required() or value is None or isinstance(value, dict | BaseModel):
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    if info.metavar == "ID":
        return f"0x{value:X}"
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def _bounds(field: FieldInfo) -> str:
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    found = [
        f"{sign} {getattr(part, name):g}"
        for part in field.metadata
        for name, sign in signs.items()
        if isinstance(getattr(part, name, None), int | float)
    ]
    return ", ".join(found)

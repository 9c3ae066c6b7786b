"""What a user can set, each setting declared once: for code, TOML, options and the reference.

The annotation of a setting has its bounds, unit and meaning. Values of a file are checked by
pydantic, those given in Python by `check_settings`, both from this annotation. Nothing that
computes is imported here: help pages read this module.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, ClassVar, Final, Literal, get_args

from pydantic import ConfigDict, Field, FiniteFloat, TypeAdapter

from cangauge.errors import InputError, require_number

Method = Literal["ekf", "newton", "coulomb"]
"""Published SoC: fusion, the inverse of the voltage model, or Coulomb counting."""
TimeSourceName = Literal["receive", "replay-clock"]
"""Bus time: receive stamps of the frames, or the log time that a replay sends."""
TemperatureSource = Literal["cell", "pack", "coolant", "room", "unknown"]
"""Location of a temperature sensor."""
TEMPERATURE_SOURCES: Final[tuple[str, ...]] = get_args(TemperatureSource)
REPLAY_CLOCK_ID: Final = 0x5AF

VALID_STD_PCT: Final = 5.0
"""Largest standard deviation of a valid SoC [%]: 19 of 20 such SoC lie within 10 %.

With the start withheld the filter settles at 2 to 4 % in a trip of half an hour. The error of the
voltage sensor limits it.
"""
VOLTAGE_ACCURACY_PCT: Final = 0.25
"""Lasting error of a pack's voltage sensor [% of the voltage]: the class of usual pack monitors."""
START_STD_PCT: Final = 1.0
"""Standard deviation of a given initial SoC [%]."""
GAP_S: Final = 2.0
"""A gap in the current longer than this empties the delay line [s]."""


def setting(text: str, **more: Any) -> Any:
    """Return what the annotation of a setting holds.

    Parameters
    ----------
    text : str
        Meaning, one sentence.
    **more
        Bounds of pydantic (`ge`, `gt`, `le`, …); `unit`; `default_text`, the default in words where
        the value is not enough; `option` of `cangauge run` with the `metavar` of its value;
        `restart`, if a reload does not apply a change; `is_path`, if it is relative to the file.
    """
    names = ("unit", "default_text", "option", "metavar", "restart", "is_path")
    about = {name: more.pop(name) for name in names if name in more}
    return Field(description=text, json_schema_extra=about, **more)


def check_settings(settings: Any, table: str = "") -> None:
    """Raise InputError if a value of a dataclass is outside its declared bounds.

    `table` is the one of the configuration that it stands for, which the error names.
    """
    kind: Any = type(settings)
    for name, (low, above, high) in _bounds_of(kind).items():
        value = getattr(settings, name)
        if value is None:
            continue
        field = f"{table}.{name}" if table else name
        require_number(value, field)
        if not (low <= value <= high and value > above):  # NaN too
            raise InputError(f"must lie within {low:g} … {high:g}", field=field, value=value)


@cache
def _bounds_of(kind: Any) -> dict[str, tuple[float, float, float]]:
    """Return least value, the value that it must exceed, and largest value of each number."""
    found = {}
    for name, field in TypeAdapter(kind).json_schema()["properties"].items():
        bounds = field.get("anyOf", [field])[0]  # of an optional number the other one is null
        if "maximum" in bounds:
            above = bounds.get("exclusiveMinimum", -math.inf)
            found[name] = bounds.get("minimum", above), above, bounds["maximum"]
    return found


STRICT: Final = ConfigDict(extra="forbid")
"""Unknown keys of a table are refused."""


# --- Settings of the estimator

StartPct = Annotated[
    FiniteFloat,
    setting(
        "SoC at the first sample. auto: estimated from the first voltages.",
        option="--initial-soc",
        metavar="P|auto",
        unit="%",
        default_text="auto",
        ge=0.0,
        le=100.0,
    ),
]
StartStdPct = Annotated[
    FiniteFloat,
    setting(
        "Standard deviation of the initial SoC.",
        option="--initial-soc-std",
        metavar="X",
        unit="%",
        ge=0.0,
        le=100.0,
    ),
]
ValidStdPct = Annotated[
    FiniteFloat,
    setting(
        "Standard deviation of the SoC above which the status is degraded.",
        unit="%",
        ge=0.01,
        le=100.0,
    ),
]
CapacityAh = Annotated[
    FiniteFloat,
    setting("Charge from 100 to 0 %.", unit="Ah", default_text="the model's", ge=1e-3, le=1e5),
]
VoltageAccuracyPct = Annotated[
    FiniteFloat,
    setting(
        "Standard deviation of the voltage sensor's lasting error, of the voltage.",
        unit="%",
        ge=0.0,
        le=10.0,
    ),
]
GapSeconds = Annotated[
    FiniteFloat,
    setting("Longest interval between samples that is not a gap.", unit="s", ge=1e-3, le=3600.0),
]


@dataclass(frozen=True)
class FullCharge:
    """Rule: the pack is full once the voltage is high and the charging current has tapered off.

    Raises
    ------
    InputError
        If a value is out of range.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    voltage_v: Annotated[
        FiniteFloat, setting("Lowest voltage of a full pack.", unit="V", gt=0.0, le=1e4)
    ]
    current_a: Annotated[
        FiniteFloat,
        setting("Largest absolute current at the end of a full charge.", unit="A", ge=0.0, le=5e3),
    ]
    hold_s: Annotated[
        FiniteFloat,
        setting(
            "Time for which voltage and current must fulfil these limits.",
            unit="s",
            ge=0.0,
            le=86400.0,
        ),
    ] = 60.0
    soc_pct: Annotated[
        FiniteFloat, setting("SoC of the full pack.", unit="%", ge=0.0, le=100.0)
    ] = 100.0
    soc_std_pct: Annotated[
        FiniteFloat, setting("Standard deviation of this SoC.", unit="%", ge=0.01, le=100.0)
    ] = 0.5

    def __post_init__(self) -> None:
        check_settings(self, "full_charge")


@dataclass(frozen=True)
class LongRest:
    """Rule: after a long rest the voltage is the open-circuit voltage, and its inverse the SoC.

    Raises
    ------
    InputError
        If a value is out of range.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    after_s: Annotated[
        FiniteFloat, setting("Shortest duration of the rest.", unit="s", ge=60.0, le=30.0 * 86400.0)
    ] = 7200.0
    soc_std_pct: Annotated[
        FiniteFloat,
        setting(
            "Standard deviation of the SoC that follows from the voltage.",
            unit="%",
            ge=0.01,
            le=100.0,
        ),
    ] = 2.0

    def __post_init__(self) -> None:
        check_settings(self, "long_rest")


def _limit(text: str, default: str, unit: str, le: float = 1e4) -> Any:
    return setting(text, unit=unit, default_text=default, ge=0.0, le=le)


@dataclass(frozen=True)
class PackLimits:
    """Limits for the possible currents and the energy left; None: from the model.

    Raises
    ------
    InputError
        If a value is out of range, or the voltages contradict each other.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    min_voltage_v: Annotated[
        FiniteFloat | None,
        _limit(
            "Lowest pack voltage.", "the pseudo-OCV at the lower end of the identified SoC", "V"
        ),
    ] = None
    max_voltage_v: Annotated[
        FiniteFloat | None,
        _limit(
            "Highest pack voltage.", "the pseudo-OCV at the upper end of the identified SoC", "V"
        ),
    ] = None
    max_discharge_a: Annotated[
        FiniteFloat | None,
        _limit("Largest discharge current.", "the largest that the model was identified on", "A"),
    ] = None
    max_charge_a: Annotated[
        FiniteFloat | None,
        _limit(
            "Largest charge current, positive.", "the largest that the model was identified on", "A"
        ),
    ] = None
    cutoff_soc_pct: Annotated[
        FiniteFloat | None,
        _limit(
            "The energy left is counted down to this SoC, or to the lowest voltage if that comes"
            " first.",
            "the lower end of the identified SoC",
            "%",
            100.0,
        ),
    ] = None

    def __post_init__(self) -> None:
        check_settings(self, "limits")
        low = self.min_voltage_v
        high_v = self.max_voltage_v
        if low is not None and high_v is not None and low >= high_v:
            raise InputError(
                "is not below limits.max_voltage_v", field="limits.min_voltage_v", value=low
            )


# --- Ids of the frames


def _id(name: str, *, restart: bool = False) -> Any:
    return setting(f"Id of {name}.", metavar="ID", restart=restart, ge=0, le=0x7FF)


@dataclass(frozen=True)
class FrameIds:
    """Standard ids of the published frames and of the replay clock; InputError if two are equal."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    soc_estimate: Annotated[int, _id("SOC_ESTIMATE")] = 0x5A0
    soc_detail: Annotated[int, _id("SOC_DETAIL")] = 0x5A1
    replay_clock: Annotated[int, _id("REPLAY_CLOCK", restart=True)] = REPLAY_CLOCK_ID
    soc_health: Annotated[int, _id("SOC_HEALTH")] = 0x5A2
    soc_power: Annotated[int, _id("SOC_POWER")] = 0x5A3
    soc_cells: Annotated[int, _id("SOC_CELLS, sent where the vehicle gives cell voltages")] = 0x5A4

    @property
    def published(self) -> dict[int, str]:
        """Names of the frames that the service sends, by id."""
        return {number: name for name, number in vars(self).items() if name != "replay_clock"}

    def __post_init__(self) -> None:
        names: dict[int, str] = {}
        for name, value in vars(self).items():
            if value in names:
                raise InputError(
                    f"{names[value]} has the same id", field=f"ids.{name}", value=f"0x{value:X}"
                )
            names[value] = name

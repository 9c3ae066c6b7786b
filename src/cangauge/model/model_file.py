"""The model file: JSON, versioned, validated on load with an error that names the field."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from cangauge._config import schema_error
from cangauge._io import MAX_MODEL_BYTES, MAX_MODEL_COLUMNS, MAX_MODEL_ITEMS, read_bounded
from cangauge.errors import InputError
from cangauge.logs.log import TemperatureSource
from cangauge.model.effects.base import Pack
from cangauge.model.effects.library import parse_effects
from cangauge.model.extended import ExtendedModel
from cangauge.model.voltage_model import BASIS_NAMES, VoltageModel

MODEL_FORMAT = "cangauge-model"
MODEL_VERSION = 1
_CURE = "make the file again with `cangauge fit`"

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]

# Wider than any pack needs, and narrow enough that nothing overflows on the way to a voltage.
_Value = Annotated[float, Field(ge=-1e12, le=1e12)]
_Soc = Annotated[float, Field(ge=-10, le=110)]
_Celsius = Annotated[float, Field(ge=-273.15, le=1000)]
_Ampere = Annotated[float, Field(ge=-1e6, le=1e6)]
_Volts = Annotated[float, Field(ge=0, le=1e6)]
_Delay = Annotated[float, Field(ge=0, le=3600)]
_Seconds = Annotated[float, Field(ge=0, le=1e9)]
SocSpan = tuple[_Soc, _Soc]
TemperatureSpan = tuple[_Celsius, _Celsius]
CurrentSpan = tuple[_Ampere, _Ampere]
Columns = Field(max_length=MAX_MODEL_COLUMNS)
Items = Field(max_length=MAX_MODEL_ITEMS)


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Coefficient(_Strict):
    """One coefficient of the voltage model."""

    value: _Value
    std_error: NotNegative | None = None
    unit: Literal["V", "V/K", "ohm"]


class Ranges(_Strict):
    """What the model was identified on; beyond it, it is flagged and bounded."""

    soc_pct: SocSpan
    temperature_c: TemperatureSpan
    current_a: CurrentSpan


class ModelNoise(_Strict):
    """The model's voltage error on data that its fit did not see."""

    fast_std_v: _Volts
    fast_time_s: _Seconds
    slow_std_v: _Volts
    slow_time_s: Annotated[float, Field(gt=0, le=1e9)]
    lasting_std_v: _Volts
    voltage_mae_pct: NotNegative
    voltage_rmse_v: _Volts
    judged_on: str


class Information(_Strict):
    """Square root of the identification data's information, in scaled columns.

    With X the columns divided by `scale` and y the voltage, `root` is R and `projected` is Qᵀy of
    X = QR. The information matrix is RᵀR, the least-squares solution R⁻¹Qᵀy / scale, and data of
    another log can be stacked below: joint identification without the old logs.
    """

    columns: Annotated[list[str], Columns]
    scale: Annotated[list[Positive], Columns]
    root: Annotated[list[Annotated[list[Finite], Columns]], Columns]
    projected: Annotated[list[Finite], Columns]
    rows: Annotated[int, Field(gt=0)]
    residual_sum_v2: NotNegative

    @model_validator(mode="after")
    def _shapes(self) -> Self:
        n = len(self.columns)
        lengths = [len(self.scale), len(self.projected), len(self.root), *map(len, self.root)]
        if any(length != n for length in lengths):
            raise ValueError(f"shapes differ: {n} columns need {n} × {n} numbers")
        return self


class SourceLog(_Strict):
    """A log that the model was identified on."""

    name: str
    rows: int
    sha256: str


class Made(_Strict):
    """How the model was made."""

    by: str
    options: Annotated[dict[str, str | float | int | bool | list[float] | None], Items]
    logs: Annotated[list[SourceLog], Items]
    fingerprint: str


class Model(_Strict):
    """Everything that a model file holds."""

    format: Literal["cangauge-model"] = "cangauge-model"
    version: Literal[1] = 1
    name: str
    coefficients: Annotated[dict[str, Coefficient], Items]
    epsilon: Annotated[float, Field(ge=1e-4, lt=0.5)]
    t_ref_c: _Celsius
    delays_s: Annotated[list[_Delay], Field(min_length=1, max_length=64)]
    rate_hz: Annotated[float, Field(ge=1e-3, le=1e4)]
    capacity_ah: Annotated[float, Field(ge=1e-3, le=1e5)]
    effects: Annotated[list[dict[str, object]], Items] = []
    temperature_source: TemperatureSource
    range: Ranges
    noise: ModelNoise
    information: Information | None = None
    made: Made

    @field_validator("delays_s")
    @classmethod
    def _increasing(cls, delays_s: list[float]) -> list[float]:
        if any(high <= low for low, high in pairwise(delays_s)):
            raise ValueError(f"must increase, with R1 … R{len(delays_s)} in the same order")
        return delays_s

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        wanted = set(self.coefficient_names)
        given = set(self.coefficients)
        if given != wanted:
            missing, extra = sorted(wanted - given), sorted(given - wanted)
            words = [f"missing are {', '.join(missing)}"] if missing else []
            words += [f"not known are {', '.join(extra)}"] if extra else []
            count = len(self.delays_s)
            raise ValueError(
                f"coefficients: {'; '.join(words)} ({count} delays_s need R1 … R{count})"
            )
        if self.information is not None and self.information.columns != self.coefficient_names:
            names = ", ".join(self.coefficient_names)
            raise ValueError(f"information: its columns must be {names}, in this order")
        return self

    @property
    def coefficient_names(self) -> list[str]:
        """Names of the coefficients in the order of a solution: k0 … k7, kt, R1 … Rn."""
        return [*BASIS_NAMES, "kt", *resistance_names(len(self.delays_s))]

    def voltage_model(self) -> VoltageModel:
        """Return the voltage model that the file describes.

        Raises
        ------
        InputError
            If its pseudo-OCV does not rise, or its delays do not.
        """
        value = {name: item.value for name, item in self.coefficients.items()}
        return VoltageModel(
            ocv_v=tuple(value[name] for name in BASIS_NAMES),
            kt_v_per_k=value["kt"],
            resistance_ohm=tuple(value[name] for name in resistance_names(len(self.delays_s))),
            delay_s=tuple(self.delays_s),
            epsilon=self.epsilon,
            t_ref_c=self.t_ref_c,
            soc_range_pct=self.range.soc_pct,
            temperature_range_c=self.range.temperature_c,
            current_range_a=self.range.current_a,
        )

    def extended_model(self) -> ExtendedModel:
        """Return the voltage model with the file's effects.

        Raises
        ------
        InputError
            As `voltage_model`, or if an effect is unknown or a parameter out of its bounds.
        """
        model = self.voltage_model()
        effects = parse_effects(self.effects, Pack.of(model, self.capacity_ah))
        return ExtendedModel(model, self.capacity_ah, tuple(effects))


def resistance_names(number: int) -> list[str]:
    """Return R1 … Rn."""
    return [f"R{k}" for k in range(1, number + 1)]


def model_json(model: Model) -> str:
    """Return the model file's text."""
    return json.dumps(model.model_dump(mode="json"), indent=1, allow_nan=False) + "\n"


def load_model(path: Path | str) -> Model:
    """Read and validate a model file.

    Raises
    ------
    InputError
        If it cannot be read or does not describe a usable model; names the field.
    """
    path = Path(path)
    data = read_bounded(path, MAX_MODEL_BYTES, "a model file")
    try:
        raw = json.loads(data, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"is no JSON ({error})", source=path, cure="a model file is made by `cangauge fit`"
        ) from error
    if not isinstance(raw, dict) or raw.get("format") != MODEL_FORMAT:
        raise InputError(
            "is no cangauge model",
            source=path,
            field="format",
            value=raw.get("format") if isinstance(raw, dict) else type(raw).__name__,
            cure="a model file is made by `cangauge fit`",
        )
    if raw.get("version") != MODEL_VERSION:
        raise InputError(
            f"this release reads version {MODEL_VERSION}",
            source=path,
            field="version",
            value=raw.get("version"),
            cure="make it again with `cangauge fit`",
        )
    try:
        model = Model.model_validate(raw)
        model.extended_model()
    except ValidationError as error:
        raise schema_error(error, Model, path, _CURE) from error
    except InputError as error:
        raise InputError(
            error.problem, source=path, field=error.field, value=error.value, cure=error.cure
        ) from error
    return model


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no number that a model may hold")


def effective_error_std_v(noise: ModelNoise, interval_s: float) -> float:
    """Return the standard deviation to give a voltage that is used every `interval_s` [V].

    The fast error lasts `fast_time_s`, so samples closer together share it: n of them tell as
    much as n / (1 + 2·τ/Δt) independent ones.
    """
    shared = 1.0 + 2.0 * noise.fast_time_s / interval_s
    return math.sqrt(shared) * noise.fast_std_v

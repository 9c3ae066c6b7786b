"""Model file: versioned JSON, validated on load with an error that names the field."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Final, Literal, Self

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from cangauge._arithmetic import total
from cangauge._config import schema_error
from cangauge._io import (
    MAX_MODEL_BYTES,
    MAX_MODEL_COLUMNS,
    MAX_MODEL_EFFECTS,
    MAX_MODEL_ITEMS,
    read_bounded,
    time_limit,
    write_text_atomic,
)
from cangauge.errors import InputError
from cangauge.logs.log import Log, TemperatureSource
from cangauge.model.effects.base import RESISTANCE_AT_LEAST, Pack, Signals
from cangauge.model.effects.library import parse_effects
from cangauge.model.extended import ExtendedModel, Prediction
from cangauge.model.voltage_model import BASIS_NAMES, VoltageModel

MODEL_FORMAT = "cangauge-model"
MODEL_VERSION = 1
MAX_CURVE_KNOTS, MAX_CURVE_FUNCTIONS = 201, 16
_CURE = "create the file with `cangauge fit`"

_NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
# Wider than any pack needs, narrow enough that no voltage overflows.
_Value = Annotated[float, Field(ge=-1e12, le=1e12)]
_Scale = Annotated[float, Field(ge=1e-12, le=1e12)]
_Soc = Annotated[float, Field(ge=-10, le=110)]
_Celsius = Annotated[float, Field(ge=-273.15, le=1000)]
_Ampere = Annotated[float, Field(ge=-1e6, le=1e6)]
_Volts = Annotated[float, Field(ge=0, le=1e6)]
_Delay = Annotated[float, Field(ge=0, le=3600)]
_Seconds = Annotated[float, Field(ge=0, le=1e9)]
_Columns = Field(max_length=MAX_MODEL_COLUMNS)
_Items = Field(max_length=MAX_MODEL_ITEMS)


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Coefficient(_Strict):
    """One coefficient of the voltage model."""

    value: _Value
    std_error: _NotNegative | None = None
    unit: Literal["V", "V/K", "ohm"]


class Ranges(_Strict):
    """Identified ranges; an estimate outside is flagged and its extrapolation bounded."""

    soc_pct: tuple[_Soc, _Soc]
    temperature_c: tuple[_Celsius, _Celsius]
    current_a: tuple[_Ampere, _Ampere]


class CurveNoise(_Strict):
    """Error of pseudo-OCV and temperature coefficient (`inference.error_model`)."""

    soc_pct: Annotated[list[_Soc], Field(min_length=2, max_length=MAX_CURVE_KNOTS)]
    """Increasing knots."""
    functions_v: Annotated[
        list[Annotated[list[_Value], Field(max_length=MAX_CURVE_KNOTS)]],
        Field(max_length=MAX_CURVE_FUNCTIONS),
    ]
    """Independent functions of the curve's error, of standard deviation 1, at the knots."""
    temperature_c: _Celsius
    """Mean temperature of the logs."""
    kt_std_v_per_k: _Volts
    """Standard deviation of kt."""
    resistance_std_per_k: _NotNegative
    """Standard deviation of the resistance's relative change with temperature."""

    @model_validator(mode="after")
    def _shapes(self) -> Self:
        if any(high <= low for low, high in pairwise(self.soc_pct)):
            raise ValueError("soc_pct must increase")
        if any(len(function) != len(self.soc_pct) for function in self.functions_v):
            raise ValueError(f"each function needs {len(self.soc_pct)} values, one per soc_pct")
        return self


class ModelNoise(_Strict):
    """Voltage error of the model, in parts of different duration, and the error of the curve."""

    fast_std_v: _Volts
    fast_time_s: _Seconds
    slow_std_v: _Volts
    slow_time_s: Annotated[float, Field(gt=0, le=1e9)]
    lasting_std_v: _Volts
    lasting_time_s: Annotated[float, Field(gt=0, le=1e9)] = 7200.0
    lasting_soc_pct: Annotated[float, Field(gt=0, le=1e3)] = 8.0
    """Mean duration and SoC span of the logs: beyond, the lasting error may be another."""
    curve: CurveNoise | None = None
    """None: not known, so only the lasting part covers it."""
    voltage_mae_pct: _NotNegative
    voltage_rmse_v: _Volts
    judged_on: str


class Information(_Strict):
    """Square root of the identification data's information matrix, in scaled columns.

    With X the columns divided by `scale` and y the voltage, `root` is R and `projected` is Qᵀy of
    X = QR. The information matrix is RᵀR and the least-squares solution R⁻¹Qᵀy / scale; rows of
    another log can be stacked below, for joint identification without the original logs.
    """

    columns: Annotated[list[str], _Columns]
    scale: Annotated[list[_Scale], _Columns]
    root: Annotated[list[Annotated[list[_Value], _Columns]], _Columns]
    projected: Annotated[list[_Value], _Columns]

    @model_validator(mode="after")
    def _shapes(self) -> Self:
        n = len(self.columns)
        lengths = [len(self.scale), len(self.projected), len(self.root), *map(len, self.root)]
        if any(length != n for length in lengths):
            raise ValueError(f"shapes differ: {n} columns need {n} × {n} numbers")
        # RᵀR is symmetric and semidefinite for any R; R is triangular if it is a QR's.
        if any(any(row[:place]) for place, row in enumerate(self.root)):
            raise ValueError("root: must be upper triangular")
        return self


class SourceLog(_Strict):
    """A log used for the identification."""

    name: str
    rows: int
    sha256: str


class Made(_Strict):
    """How the model was made."""

    by: str
    options: Annotated[dict[str, str | float | int | bool | list[float] | None], _Items]
    logs: Annotated[list[SourceLog], _Items]
    fingerprint: str


class Model(_Strict):
    """A pack's identified model: coefficients, effects, ranges, noise and origin.

    Examples
    --------
    >>> model = Model.load("pack.json")  # doctest: +SKIP
    >>> model.predict(log).residual_v  # doctest: +SKIP
    """

    format: Literal["cangauge-model"] = "cangauge-model"
    version: Literal[1] = 1
    name: str
    coefficients: Annotated[dict[str, Coefficient], _Items]
    epsilon: Annotated[float, Field(ge=1e-4, lt=0.5)]
    t_ref_c: _Celsius
    delays_s: Annotated[list[_Delay], Field(min_length=1, max_length=64)]
    rate_hz: Annotated[float, Field(ge=1e-3, le=1e4)]
    capacity_ah: Annotated[float, Field(ge=1e-3, le=1e5)]
    effects: Annotated[list[dict[str, object]], Field(max_length=MAX_MODEL_EFFECTS)] = []
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
            words += [f"unknown are {', '.join(extra)}"] if extra else []
            count = len(self.delays_s)
            raise ValueError(
                f"coefficients: {'; '.join(words)} ({count} delays_s need R1 … R{count})"
            )
        if self.information is not None and self.information.columns != self.coefficient_names:
            names = ", ".join(self.coefficient_names)
            raise ValueError(f"information: the columns must be {names}, in this order")
        return self

    @property
    def coefficient_names(self) -> list[str]:
        """Coefficient names in the order of a solution: k0 … k7, kt, R1 … Rn."""
        return [*BASIS_NAMES, "kt", *resistance_names(len(self.delays_s))]

    def voltage_model(self) -> VoltageModel:
        """Return the voltage model without effects.

        Raises
        ------
        InputError
            If the pseudo-OCV does not rise with SoC.
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
        """Return the voltage model with the effects.

        Raises
        ------
        InputError
            If a coefficient is physically impossible for the pack, an effect is unknown, or a
            parameter is out of bounds.
        """
        model = self.voltage_model()
        _check_voltage(model)
        _check_coefficients(model, self.capacity_ah)
        self._check_noise(model)
        effects = parse_effects(self.effects, Pack.of(model, self.capacity_ah))
        return ExtendedModel(model, self.capacity_ah, tuple(effects))

    def _check_noise(self, model: VoltageModel) -> None:
        volts = model.pseudo_ocv_at(50.0)[0]
        for name in ("fast_std_v", "slow_std_v", "lasting_std_v"):
            if getattr(self.noise, name) > volts:
                raise InputError(
                    f"is more than the {volts:.4g} V of the pack",
                    field=f"noise.{name}",
                    value=getattr(self.noise, name),
                    cure="check the value and its unit",
                )

    @classmethod
    def load(cls, path: Path | str) -> Model:
        """Read and validate a model file.

        Raises
        ------
        InputError
            If the file cannot be read or does not describe a usable model; names the field.
        """
        path = Path(path)
        with time_limit(path):
            return cls._load(path)

    @classmethod
    def _load(cls, path: Path) -> Model:
        data = read_bounded(path, MAX_MODEL_BYTES, "a model file")
        try:
            raw = json.loads(data, parse_constant=_refuse_constant)
        except (ValueError, RecursionError) as error:
            raise InputError(f"not JSON ({error})", source=path, cure=_CURE) from error
        if not isinstance(raw, dict) or raw.get("format") != MODEL_FORMAT:
            raise InputError(
                "not a cangauge model",
                source=path,
                field="format",
                value=raw.get("format") if isinstance(raw, dict) else type(raw).__name__,
                cure=_CURE,
            )
        if raw.get("version") != MODEL_VERSION:
            raise InputError(
                f"this release reads version {MODEL_VERSION}",
                source=path,
                field="version",
                value=raw.get("version"),
                cure=_CURE,
            )
        try:
            model = cls.model_validate(raw)
            model.extended_model()
        except ValidationError as error:
            raise schema_error(error, cls, path, _CURE) from error
        except InputError as error:
            raise InputError(
                error.problem, source=path, field=error.field, value=error.value, cure=error.cure
            ) from error
        return model

    def to_json(self) -> str:
        """Return the text of the model file."""
        return json.dumps(self.model_dump(mode="json"), indent=1, allow_nan=False) + "\n"

    def save(self, path: Path | str) -> None:
        """Write the model file; an existing file is replaced atomically."""
        write_text_atomic(Path(path), self.to_json())

    def predict(self, log: Log, *, initial_soc_pct: float | None = None) -> Prediction:
        """Predict the voltage of a log, with `residual_v` = measured − predicted.

        Parameters
        ----------
        log : Log
        initial_soc_pct : float, optional
            SoC at the first row [%]; by default the count starts from the first finite value of
            the log's reference SoC.

        Returns
        -------
        Prediction
            For every row of the log.

        Raises
        ------
        InputError
            If the initial SoC is unknown.
        """
        start = log.first_soc() if initial_soc_pct is None else (0, initial_soc_pct)
        if start is None:
            raise InputError(
                "unknown initial SoC",
                source=log.source or log.name,
                field="initial_soc_pct",
                cure="give initial_soc_pct, or a log with soc_pct",
            )
        row, soc_pct = start
        signals = Signals(log.time_s, log.current_a, log.voltage_v, log.temperature_c)
        rows = np.arange(len(log))
        return self.extended_model().predict(signals, soc_pct, rows, initial_row=row)


HIGHEST_VOLTS: Final = 1e4
"""Largest pseudo-OCV [V]: electrical systems of vehicles and stores stay below 1.5 kV."""
VOLTAGE_RATIO: Final = 3.0
"""Largest ratio of the pseudo-OCV of a full pack to that of an empty one [-]: lithium cells are
used between 2.0 and 4.4 V, lead and nickel cells over a narrower range."""
DROP_AT_1C: Final = 1.0
"""Largest voltage that one resistance drops at 1 C, relative to the pseudo-OCV [-]: such a pack
could not be discharged in an hour at all. 0.02 for a Leaf, 0.3 for a small cell in the cold."""
SLOPE_BY_TEMPERATURE: Final = 0.01
"""Largest temperature coefficient relative to the pseudo-OCV [1/K]; 0.002 as published for a Leaf,
0.0003 by the entropy of the cells."""


def _check_voltage(model: VoltageModel) -> None:
    """Raise InputError for a pseudo-OCV that no pack has; it rises, so its ends suffice."""
    (low, high), middle = model.pseudo_ocv([*model.soc_range_pct]), model.pseudo_ocv_at(50.0)[0]
    low, high = min(low, middle), max(high, middle)
    if not (low > 0.0 and high <= min(HIGHEST_VOLTS, VOLTAGE_RATIO * low)):
        raise InputError(
            f"the pseudo-OCV of {low:.5g} … {high:.5g} V is not that of a battery",
            field="coefficients",
            cure="check k0 … k7 and their unit (V), or create the file with `cangauge fit`",
        )


def _check_coefficients(model: VoltageModel, capacity_ah: float) -> None:
    """Raise InputError for a resistance or temperature coefficient beyond the size of the pack."""
    pack = Pack.of(model, capacity_ah)
    largest = DROP_AT_1C * pack.voltage_v / capacity_ah
    for name, value in zip(
        resistance_names(len(model.resistance_ohm)), model.resistance_ohm, strict=True
    ):
        if abs(value) > largest:
            raise InputError(
                f"must lie within ±{largest:.3g} ohm for a pack of {pack.voltage_v:.4g} V and"
                f" {capacity_ah:.4g} Ah",
                field=f"coefficients.{name}.value",
                value=value,
                cure="check the value and its unit, or the capacity",
            )
    # A log of constant current leaves the sign open, and there the resistances cancel.
    (low_a, high_a), lasting_ohm = model.current_range_a, total(model.resistance_ohm)
    if lasting_ohm * (high_a - low_a) > RESISTANCE_AT_LEAST * pack.voltage_v:
        raise InputError(
            "the sum of the resistances is positive, so that discharging would raise the voltage",
            field="coefficients",
            value=lasting_ohm,
            cure="positive current discharges, so resistances are negative",
        )
    steepest = SLOPE_BY_TEMPERATURE * pack.voltage_v
    if abs(model.kt_v_per_k) > steepest:
        raise InputError(
            f"must lie within ±{steepest:.3g} V/K for a pack of {pack.voltage_v:.4g} V",
            field="coefficients.kt.value",
            value=model.kt_v_per_k,
            cure="check the value and its unit",
        )


def resistance_names(number: int) -> list[str]:
    """Return R1 … Rn."""
    return [f"R{k}" for k in range(1, number + 1)]


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a finite number")


def effective_error_std_v(noise: ModelNoise, interval_s: float) -> float:
    """Return the equivalent white-noise standard deviation of a voltage every `interval_s` [V].

    The fast error is correlated over τ = `fast_time_s`: n samples carry the information of
    n / (1 + 2·τ/Δt) independent ones.
    """
    inflation = 1.0 + 2.0 * noise.fast_time_s / interval_s
    return math.sqrt(inflation) * noise.fast_std_v

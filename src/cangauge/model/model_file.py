"""Model file: versioned JSON, validated on load with an error that names the field."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from cangauge._config import schema_error
from cangauge._files import MIB, as_path, read_bounded, write_text_atomic
from cangauge._text import number, significant, span
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.log import Log, TemperatureSource, as_log
from cangauge.model.delay_line import GAP_S
from cangauge.model.effects.base import Pack, Signals
from cangauge.model.effects.library import parse_effects
from cangauge.model.extended import ExtendedModel, OnlineModel, Prediction
from cangauge.model.physics import check_physics
from cangauge.model.prior import (
    BLOCK_S,
    CHEMISTRIES,
    DELAYS_S,
    FAST_FLOOR,
    LOW_PASS_S,
    SLOW_S,
    SLOW_SHARE,
    Chemistry,
    ChemistryName,
    principal_functions,
    prior_of,
    usual_loads,
)
from cangauge.model.version1 import upgraded
from cangauge.model.voltage_model import (
    BASIS_NAMES,
    KNOTS_PCT,
    REFERENCE_C,
    Arrhenius,
    Functions,
    HermiteCurve,
    PublishedCurve,
    VoltageModel,
    hermite_slopes,
    resistance_factor,
)

PRIOR_MADE_BY = "prior of the chemistry"
"""`made.by` of a model without any log."""
MODEL_FORMAT = "cangauge-model"
MODEL_VERSION = 2
_CURE = "create the file with `cangauge fit`"

_NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
# Wider than any pack needs, narrow enough that no voltage overflows.
_Value = Annotated[float, Field(ge=-1e12, le=1e12)]
_Soc = Annotated[float, Field(ge=-10, le=110)]
_Celsius = Annotated[float, Field(ge=-273.15, le=1000)]
_Ampere = Annotated[float, Field(ge=-1e6, le=1e6)]
_Volts = Annotated[float, Field(ge=0, le=1e6)]
_Seconds = Annotated[float, Field(gt=0, le=1e5)]
_Delays = Annotated[list[Annotated[float, Field(ge=0, le=3600)]], Field(min_length=1)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Coefficient(_Strict):
    """One coefficient of the published equation."""

    value: _Value
    std_error: _NotNegative | None = None
    unit: Literal["V", "V/K", "ohm"]


class Published(_Strict):
    """The published equation: k0 … k7, kt, R1 … Rn."""

    coefficients: dict[str, Coefficient]
    epsilon: Annotated[float, Field(ge=1e-4, lt=0.5)]
    t_ref_c: _Celsius
    delays_s: _Delays

    @classmethod
    def of(
        cls,
        values: Iterable[float],
        std: Iterable[float | None] = itertools.repeat(None),
        *,
        epsilon: float,
        t_ref_c: float,
        delays_s: Sequence[float],
    ) -> Published:
        """Return the equation of the values k0 … k7, kt, R1 … Rn and their standard errors."""
        units = {"kt": "V/K", "k": "V", "R": "ohm"}
        coefficients = {
            name: {"value": value, "std_error": error, "unit": units.get(name) or units[name[0]]}
            for name, value, error in zip(published_names(len(delays_s)), values, std, strict=False)
        }
        return cls.model_validate({
            "coefficients": coefficients, "epsilon": epsilon, "t_ref_c": t_ref_c,
            "delays_s": list(delays_s),
        })  # fmt: skip

    @model_validator(mode="after")
    def _complete(self) -> Self:
        _check_increasing(self.delays_s, "delays_s")
        wanted, given = set(published_names(len(self.delays_s))), set(self.coefficients)
        if given != wanted:
            missing, extra = sorted(wanted - given), sorted(given - wanted)
            words = [f"missing are {', '.join(missing)}"] if missing else []
            words += [f"unknown are {', '.join(extra)}"] if extra else []
            raise ValueError(f"coefficients: {'; '.join(words)}")
        return self


class CurveKnots(_Strict):
    """Curve of a `knots` model."""

    soc_pct: Annotated[list[_Soc], Field(min_length=2)]
    voltage_v: list[_Value]

    @model_validator(mode="after")
    def _shapes(self) -> Self:
        _check_increasing(self.soc_pct, "soc_pct")
        _check_length(self.voltage_v, len(self.soc_pct), "voltage_v")
        return self


class ArrheniusFields(_Strict):
    """Change of the resistances with temperature (`voltage_model.Arrhenius`)."""

    factor: _Value
    resistance_ohm: list[_Value]
    mean_c: _Celsius


class Loads(_Strict):
    """Temperature coefficient and resistances of a `knots` model."""

    t_ref_c: _Celsius
    kt_v_per_k: _Value
    delays_s: _Delays
    low_pass_s: list[_Seconds]
    resistance_ohm: list[_Value]
    arrhenius: ArrheniusFields

    @model_validator(mode="after")
    def _shapes(self) -> Self:
        _check_increasing(self.delays_s, "delays_s")
        number = len(self.delays_s) + len(self.low_pass_s)
        _check_length(self.resistance_ohm, number, "resistance_ohm")
        _check_length(self.arrhenius.resistance_ohm, number, "arrhenius.resistance_ohm")
        return self


class FunctionFields(_Strict):
    """Joint principal functions of the coefficients' covariance, of standard deviation 1."""

    soc_pct: Annotated[list[_Soc], Field(min_length=2)]
    curve_v: list[list[_Value]]
    """Part of each function in the curve at `soc_pct` [V]."""
    load: list[list[_Value]]
    """Part of each function in the coefficients of the load columns."""

    @model_validator(mode="after")
    def _shapes(self) -> Self:
        _check_increasing(self.soc_pct, "soc_pct")
        _check_length(self.load, len(self.curve_v), "load")
        for function in self.curve_v:
            _check_length(function, len(self.soc_pct), "curve_v: each function")
        return self


class Noise(_Strict):
    """Errors of the voltage that the coefficients do not explain."""

    level_std_v: _Volts
    """Lasts a whole log."""
    slow_std_v: _Volts
    slow_time_s: _Seconds = SLOW_S
    fast_std_v: _Volts
    """Of the mean of a block."""
    block_s: _Seconds = BLOCK_S
    soc_std_pct: Annotated[float, Field(ge=0, le=50)]
    """δ: SoC against voltage (surface, hysteresis, reference), for a log and in each block."""
    cold_exponent: Annotated[float, Field(ge=0, le=4)]
    """The voltage errors grow with a(T) to this power below 20 °C."""
    residual_std_v: _Volts
    """Rms residual of the rows of the fit."""
    left_out_scale: Annotated[float, Field(ge=1, le=1e6)] = 1.0
    """κ²: `level_std_v` and the covariance of the coefficients contain it already."""
    voltage_mae_pct: _NotNegative
    voltage_rmse_v: _Volts
    """Errors of left-out logs."""
    judged_on: str

    def cold(self, temperature_c: float) -> float:
        """Return the growth of the voltage errors in the cold [-], 1 or more."""
        return float(max(1.0, float(resistance_factor(temperature_c))) ** self.cold_exponent)


class Ranges(_Strict):
    """Identified ranges; an estimate outside is flagged."""

    soc_pct: tuple[_Soc, _Soc]
    temperature_c: tuple[_Celsius, _Celsius]
    current_a: tuple[_Ampere, _Ampere]
    voltage_v: tuple[_Volts, _Volts] | None = None
    """Lowest and highest voltage of the logs, under their currents."""


class Information(_Strict):
    """Posterior of all coefficients: RᵀR is its precision, R·θ = `projected` its mean.

    The prior and the scale of left-out logs are in it. Rows of another log, divided by their noise,
    can be stacked below it: a joint fit without the original logs.
    """

    columns: list[str]
    root: list[list[_Value]]
    projected: list[_Value]

    @model_validator(mode="after")
    def _shapes(self) -> Self:
        _check_length(self.projected, len(self.columns), "projected")
        _check_length(self.root, len(self.columns), "root")
        for row in self.root:
            _check_length(row, len(self.columns), "root: each row")
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
    options: dict[str, str | float | int | bool | list[float] | None]
    logs: list[SourceLog]
    fingerprint: str


class Model(_Strict):
    """A pack's identified model: coefficients, their covariance, effects, ranges and origin.

    Examples
    --------
    >>> model = Model.load("pack.json")  # doctest: +SKIP
    >>> model.predict(log).residual_v  # doctest: +SKIP
    """

    format: Literal["cangauge-model"] = "cangauge-model"
    version: Literal[2] = 2
    name: str
    equation: Literal["knots", "published"]
    chemistry: ChemistryName
    cells: Annotated[int, Field(ge=1, le=2000)] | None = None
    """Cells in series; None where it is not known."""
    capacity_ah: Annotated[float, Field(ge=1e-3, le=1e5)]
    rate_hz: Annotated[float, Field(ge=1e-3, le=1e4)] = 1.0
    temperature_source: TemperatureSource
    curve: CurveKnots | None = None
    loads: Loads | None = None
    published: Published | None = None
    functions: FunctionFields
    noise: Noise
    effects: list[dict[str, object]] = []
    range: Ranges
    information: Information | None = None
    made: Made

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.equation == "published" and self.published is None:
            raise ValueError("published: missing, though the equation is published")
        if self.equation == "knots" and (self.curve is None or self.loads is None):
            raise ValueError("curve, loads: missing, though the equation is knots")
        columns = len(self.voltage_model().load_coefficients)
        for function in self.functions.load:
            _check_length(function, columns, "functions.load: each function")
        return self

    def __repr__(self) -> str:
        """Return what the model is of and where it holds."""
        cells = f", {self.cells} cells" if self.cells else ""
        effects = ", ".join(str(effect["id"]) for effect in self.effects) or "none"
        error = number(self.noise.voltage_mae_pct, 2, "%")
        return "\n".join([
            f"<Model {self.name!r}",
            f"  {self.equation}, {self.chemistry}{cells}, {significant(self.capacity_ah, 4, 'Ah')}",
            f"  identified at {span(*self.range.soc_pct, 0, '% SoC')},"
            f" {span(*self.range.temperature_c, 0, '°C')}, {span(*self.range.current_a, 0, 'A')}",
            f"  voltage error {error} on {self.noise.judged_on}",
            f"  effects: {effects}>",
        ])  # fmt: skip

    @property
    def coefficients(self) -> dict[str, Coefficient]:
        """The published equation's, also beside a curve of knots; none where not identified."""
        return {} if self.published is None else self.published.coefficients

    def voltage_model(self) -> VoltageModel:
        """Return the voltage model without effects.

        Raises
        ------
        InputError
            If the pseudo-OCV of a published equation does not rise with SoC.
        """
        ranges: dict[str, Any] = {
            "soc_range_pct": self.range.soc_pct,
            "temperature_range_c": self.range.temperature_c,
            "current_range_a": self.range.current_a,
            "voltage_range_v": self.range.voltage_v,
        }
        if self.equation == "knots" and self.curve is not None and self.loads is not None:
            soc_pct, volts = np.array(self.curve.soc_pct), np.array(self.curve.voltage_v)
            colder = self.loads.arrhenius
            return VoltageModel(
                HermiteCurve.rising(soc_pct, volts),
                kt_v_per_k=self.loads.kt_v_per_k,
                resistance_ohm=tuple(self.loads.resistance_ohm),
                delay_s=tuple(self.loads.delays_s),
                low_pass_s=tuple(self.loads.low_pass_s),
                arrhenius=Arrhenius(colder.factor, tuple(colder.resistance_ohm), colder.mean_c),
                t_ref_c=self.loads.t_ref_c,
                **ranges,
            )
        fields = self.published
        if fields is None:
            raise ValueError("no published equation")
        value = {name: item.value for name, item in fields.coefficients.items()}
        names = published_names(len(fields.delays_s))
        ocv_v = tuple(value[name] for name in BASIS_NAMES)
        return VoltageModel(
            PublishedCurve(ocv_v, fields.epsilon, self.range.soc_pct),
            kt_v_per_k=value["kt"],
            resistance_ohm=tuple(value[name] for name in names[len(BASIS_NAMES) + 1 :]),
            delay_s=tuple(fields.delays_s),
            t_ref_c=fields.t_ref_c,
            **ranges,
        )

    def principal_functions(self) -> Functions:
        """Return the covariance of the coefficients in reduced form."""
        number = len(self.functions.curve_v)
        soc_pct = np.array(self.functions.soc_pct)
        value = np.array(self.functions.curve_v).reshape(number, soc_pct.size).T
        columns = len(self.voltage_model().load_coefficients)
        load = np.array(self.functions.load).reshape(number, columns).T
        return Functions(soc_pct, value, hermite_slopes(soc_pct, value), load)

    def extended_model(self) -> ExtendedModel:
        """Return the voltage model with the effects.

        Raises
        ------
        InputError
            If a coefficient is physically impossible for the pack, an effect is unknown, or a
            parameter is out of bounds.
        """
        model = self.voltage_model()
        check_physics(model, self)
        effects = parse_effects(self.effects, Pack.of(model, self.capacity_ah))
        return ExtendedModel(model, self.capacity_ah, tuple(effects))

    def online(self, capacity_ah: float | None = None, gap_s: float = GAP_S) -> OnlineModel:
        """Return the model one sample at a time, before the first sample.

        Parameters
        ----------
        capacity_ah : float, optional
            Capacity set by the user [Ah]; effects do not change it.
        gap_s : float
            A longer step between two samples empties the delay line [s].
        """
        functions = self.principal_functions()
        return OnlineModel(self.extended_model(), functions, self.noise, capacity_ah, gap_s)

    @classmethod
    def prior(cls, chemistry: ChemistryName, cells: int, capacity_ah: float) -> Model:
        """Return a model of a pack without logs: the typical cell, with its honest uncertainty.

        Parameters
        ----------
        chemistry : {"oxide", "lfp"}
        cells : int
            Cells in series.
        capacity_ah : float
            [Ah].

        Examples
        --------
        >>> Model.prior("oxide", cells=96, capacity_ah=60.0).equation
        'knots'
        """
        known = CHEMISTRIES[chemistry]
        volts = cells * float(np.interp(50.0, KNOTS_PCT, known.curve_v))
        prior = prior_of(known, volts, 50.0, capacity_ah)
        return knots_model(
            prior.mean,
            prior.covariance,
            arrhenius_ohm=prior.resistance_ohm,
            mean_c=REFERENCE_C,
            name=f"{cells} {chemistry} cells of {capacity_ah:g} Ah",
            chemistry=chemistry,
            cells=cells,
            capacity_ah=capacity_ah,
            noise=noise_of(known, volts, prior.residual_v),
            temperature_source="unknown",
            range=Ranges(soc_pct=(0.0, 100.0), temperature_c=PRIOR_RANGE_C,
                         current_a=(-PRIOR_C_RATE * capacity_ah, PRIOR_C_RATE * capacity_ah)),
            made=Made(by=PRIOR_MADE_BY, options={}, logs=[], fingerprint="prior"),
        )  # fmt: skip

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Model:
        """Read and validate a model file, of this version or version 1.

        Raises
        ------
        InputError
            If the file cannot be read or does not describe a usable model; names the field.
        """
        path = as_path(path)
        data = read_bounded(path, 4 * MIB, "a model file")
        try:
            raw = json.loads(data, parse_constant=_refuse_constant)
            json.dumps(raw, ensure_ascii=False).encode()  # half of a surrogate pair is no text
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
        if raw.get("version") not in (1, MODEL_VERSION):  # no set: it may be a list
            raise InputError(
                f"this release reads versions 1 and {MODEL_VERSION}",
                source=path,
                field="version",
                value=raw.get("version"),
                cure=_CURE,
            )
        try:
            model = cls.model_validate(upgraded(raw) if raw["version"] == 1 else raw)
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

    def predict(
        self, log: Log | Path | str | Any, *, initial_soc_pct: float | None = None
    ) -> Prediction:
        """Predict the voltage of a log, with `residual_v` = measured − predicted.

        Parameters
        ----------
        log : Log, path or DataFrame
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
        log = as_log(log)
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


PRIOR_RANGE_C = (-20.0, 50.0)
"""Temperatures that the prior's cells are specified for, in typical data sheets [°C]."""
PRIOR_C_RATE = 3.0
"""Current that they are specified for [1/h]."""


def as_model(model: Any) -> Model:
    """Return a model for a `Model`, the path of its file, or the result of `fit`."""
    found = getattr(model, "model", model)
    if isinstance(found, str | PathLike):
        return Model.load(found)
    if not isinstance(found, Model):
        cure = "give a Model, the path of its file, or the result of fit"
        raise InputError("not a model", field="model", value=type(model).__name__, cure=cure)
    return found


def noise_of(
    chemistry: Chemistry, volts: float, residual_v: float, *, scale: float = 1.0, **judged: Any
) -> Noise:
    """Return the errors of a fitted or prior model.

    Parameters
    ----------
    chemistry : Chemistry
    volts : float
        Mean voltage V0 [V].
    residual_v : float
        Rms residual of the fit [V].
    scale : float
        κ² of left-out logs.
    judged
        `voltage_mae_pct`, `voltage_rmse_v` and `judged_on`; the residual if left out.
    """
    fields: dict[str, Any] = {
        "voltage_mae_pct": 100.0 * residual_v / volts,
        "voltage_rmse_v": residual_v,
        "judged_on": "prior of the chemistry",
    }
    return Noise(
        level_std_v=chemistry.level_std * volts * scale**0.5,
        slow_std_v=float(np.hypot(chemistry.slow_std * volts, SLOW_SHARE * residual_v)),
        fast_std_v=float(np.hypot(chemistry.fast_factor * residual_v, FAST_FLOOR * volts)),
        soc_std_pct=chemistry.soc_std_pct,
        cold_exponent=chemistry.cold_exponent,
        residual_std_v=residual_v,
        left_out_scale=scale,
        **(fields | judged),
    )


def knots_model(
    coefficients: FloatArray,
    covariance: FloatArray,
    *,
    arrhenius_ohm: FloatArray,
    mean_c: float,
    **fields: Any,
) -> Model:
    """Return the model file of fitted or prior coefficients of the curve of knots.

    Parameters
    ----------
    coefficients : array of shape (p,)
        Knots [V], kt [V/K], resistances [Ω], b [-].
    covariance : array of shape (p, p)
        Theirs.
    arrhenius_ohm : array of shape (M,)
        Resistances that b scales [Ω].
    mean_c : float
        Temperature at which the resistances hold [°C].
    fields
        The other fields of `Model`.
    """
    n = KNOTS_PCT.size
    kt, *ohm, factor = coefficients[n:].tolist()
    loads = usual_loads(fields["capacity_ah"], len(ohm), arrhenius_ohm)
    return Model(
        equation="knots",
        curve=CurveKnots(soc_pct=KNOTS_PCT.tolist(), voltage_v=coefficients[:n].tolist()),
        loads=Loads(
            t_ref_c=REFERENCE_C,
            kt_v_per_k=kt,
            delays_s=list(DELAYS_S),
            low_pass_s=list(LOW_PASS_S),
            resistance_ohm=ohm,
            arrhenius=ArrheniusFields(
                factor=factor, resistance_ohm=arrhenius_ohm.tolist(), mean_c=mean_c
            ),
        ),
        functions=function_fields(covariance, loads),
        **fields,
    )


def function_fields(covariance: FloatArray, loads: FloatArray) -> FunctionFields:
    """Return a covariance in reduced form (`prior.principal_functions`)."""
    functions = principal_functions(covariance, loads)
    n = KNOTS_PCT.size
    return FunctionFields(
        soc_pct=KNOTS_PCT.tolist(),
        curve_v=functions[:, :n].tolist(),
        load=functions[:, n:].tolist(),
    )


def published_names(delays: int) -> list[str]:
    """Return k0 … k7, kt, R1 … Rn."""
    return [*BASIS_NAMES, "kt", *(f"R{k}" for k in range(1, delays + 1))]


def _check_increasing(values: list[float], name: str) -> None:
    if any(high <= low for low, high in itertools.pairwise(values)):
        raise ValueError(f"{name} must increase")


def _check_length(values: list[Any], number: int, name: str) -> None:
    if len(values) != number:
        raise ValueError(f"{name} needs {number} values, not {len(values)}")


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a finite number")

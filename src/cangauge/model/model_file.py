"""Model file: versioned JSON, validated on load with an error that names the field."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
from pydantic import (
    Field,
    NonNegativeFloat,
    ValidationError,
    model_validator,
)

from cangauge._config import schema_error
from cangauge._files import MIB, as_path, read_bounded, write_text_atomic
from cangauge._text import number, span
from cangauge.errors import InputError, located, naming_arguments
from cangauge.logs.log import Log, as_log
from cangauge.model.coulomb_counting import start_of
from cangauge.model.curve import BASIS_NAMES, KNOTS_PCT, HermiteCurve, PublishedCurve
from cangauge.model.effects.base import Pack, Signals
from cangauge.model.effects.library import parse_effects
from cangauge.model.extended import ExtendedModel, OnlineModel, Prediction
from cangauge.model.fields import (
    CURE,
    Celsius,
    Delays,
    Fields,
    Knots,
    Value,
    check_shape,
)
from cangauge.model.noise import Noise
from cangauge.model.physics import check_physics
from cangauge.model.prior import (
    CHEMISTRIES,
    LOW_PASS_S,
    ChemistryName,
    Distribution,
    PackPrior,
    principal_functions,
)
from cangauge.model.voltage_model import (
    DELAYS_S,
    REFERENCE_C,
    Arrhenius,
    Functions,
    Loads,
    Ranges,
    VoltageModel,
)
from cangauge.settings import GAP_S, VOLTAGE_ACCURACY_PCT, TemperatureSource

PRIOR_MADE_BY: Final = "prior of the chemistry"
"""`made.by` of a model without any log."""
PRIOR_RANGE_C: Final = (-20.0, 50.0)
"""Temperatures that the prior's cells are specified for, in typical data sheets [°C]."""
PRIOR_C_RATE: Final = 3.0
"""Current that they are specified for [1/h]."""


class Coefficient(Fields):
    """One coefficient of the published equation."""

    value: Value
    std_error: NonNegativeFloat | None = None
    unit: Literal["V", "V/K", "ohm"]


class Published(Fields):
    """The published equation: k0 … k7, kt, R1 … Rn."""

    coefficients: dict[str, Coefficient]
    epsilon: Annotated[float, Field(ge=1e-4, lt=0.5)]
    t_ref_c: Celsius
    delays_s: Delays

    @property
    def values(self) -> list[float]:
        """The coefficients k0 … k7, kt, R1 … Rn."""
        return [self.coefficients[name].value for name in coefficient_names(self.delays_s)]

    @property
    def loads(self) -> Loads:
        """The part of the equation beside its curve."""
        kt, *ohm = self.values[len(BASIS_NAMES) :]
        return Loads(
            t_ref_c=self.t_ref_c,
            kt_v_per_k=kt,
            delays_s=self.delays_s,
            low_pass_s=(),
            resistance_ohm=tuple(ohm),
            arrhenius=None,
        )

    @model_validator(mode="after")
    def _complete(self) -> Self:
        wanted, given = set(coefficient_names(self.delays_s)), set(self.coefficients)
        for word, names in (("missing", wanted - given), ("unknown", given - wanted)):
            if names:
                raise ValueError(f"coefficients: {word} are {', '.join(sorted(names))}")
        return self


def coefficient_names(delays_s: Sequence[float]) -> list[str]:
    """Return the names of the published coefficients for some delays [s]."""
    return [*BASIS_NAMES, "kt", *(f"R{k}" for k, _ in enumerate(delays_s, start=1))]


class CurveKnots(Fields):
    """Curve of a `knots` model."""

    soc_pct: Knots
    voltage_v: tuple[Value, ...]


class Information(Fields):
    """Posterior of all coefficients: RᵀR is its precision, R·θ = `projected` its mean.

    The prior and the scale of left-out logs are in it. Rows of another log, divided by their noise,
    can be stacked below it: a joint fit without the original logs.
    """

    columns: list[str]
    root: list[list[Value]]
    projected: list[Value]


class SourceLog(Fields):
    """A log used for the identification."""

    name: str
    rows: int
    sha256: str


class Made(Fields):
    """How the model was made."""

    by: str
    options: dict[str, str | float | int | bool | list[float] | None]
    logs: list[SourceLog]
    fingerprint: str


class Model(Fields):
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
    functions: Functions
    noise: Noise
    effects: list[dict[str, Any]] = Field(default=[])
    range: Ranges
    information: Information | None = None
    made: Made

    @model_validator(mode="after")
    def _sizes_agree(self) -> Self:
        if (curve := self.curve) is not None:
            check_shape("curve.voltage_v", curve.voltage_v, len(curve.soc_pct))
        functions, columns = self.functions, self.voltage_model().load_coefficients.size
        knots = len(functions.soc_pct)
        check_shape("functions.curve_v", functions.curve_v, functions.number, knots)
        check_shape("functions.load", functions.load, functions.number, columns)
        if (information := self.information) is not None:
            p = len(information.columns)
            check_shape("information.root", information.root, p, p)
            check_shape("information.projected", information.projected, p)
        return self

    def __repr__(self) -> str:
        """Return what the model is of, where it holds, and how well."""
        ranges = self.range
        effects = ", ".join(effect["id"] for effect in self.effects) or "none"
        return (
            f"<Model {self.name!r}: {self.equation}, {self.chemistry}, {self.capacity_ah:.4g} Ah;"
            f" identified at {span(*ranges.soc_pct, 0, '% SoC')},"
            f" {span(*ranges.temperature_c, 0, '°C')};"
            f" voltage error {number(self.noise.voltage_mae_pct, 2, '%')}; effects: {effects}>"
        )

    __str__ = __repr__

    @property
    def coefficients(self) -> dict[str, Coefficient]:
        """The published equation's, also beside a curve of knots; none where not identified."""
        return {} if self.published is None else self.published.coefficients

    def voltage_model(self) -> VoltageModel:
        """Return the voltage model without effects.

        Raises
        ------
        InputError
            If the fields of the equation are missing, or the pseudo-OCV of a published equation
            does not rise with SoC.
        """
        if self.equation == "knots" and self.curve is not None and self.loads is not None:
            knots = np.array(self.curve.soc_pct), np.array(self.curve.voltage_v)
            return VoltageModel(HermiteCurve.rising(*knots), self.loads, self.range)
        if self.equation == "published" and self.published is not None:
            ocv_v = tuple(self.published.values[: len(BASIS_NAMES)])
            curve = PublishedCurve(ocv_v, self.published.epsilon, self.range.soc_pct)
            return VoltageModel(curve, self.published.loads, self.range)
        lacking = "published" if self.equation == "published" else "curve, loads"
        problem = f"missing, though the equation is {self.equation}"
        raise InputError(problem, field=lacking, cure=CURE)

    def extended_model(self) -> ExtendedModel:
        """Return the voltage model with the effects.

        Raises
        ------
        InputError
            If a coefficient is physically impossible for the pack, an effect is unknown, or a
            parameter is out of bounds.
        """
        model = self.voltage_model()
        check_physics(model, self.capacity_ah, self.noise)
        effects = parse_effects(self.effects, Pack.of(model, self.capacity_ah))
        return ExtendedModel(model, self.capacity_ah, tuple(effects))

    def online(
        self,
        capacity_ah: float | None = None,
        gap_s: float = GAP_S,
        voltage_accuracy_pct: float = VOLTAGE_ACCURACY_PCT,
    ) -> OnlineModel:
        """Return the model one sample at a time, before the first sample.

        Parameters
        ----------
        capacity_ah : float, optional
            Capacity set by the user [Ah]; effects do not change it.
        gap_s : float
            A longer step between two samples empties the delay line [s].
        voltage_accuracy_pct : float
            Least standard deviation of the voltage's lasting error [% of the voltage]. The logs of
            a fit do not show that of their sensor: one made them all.
        """
        extended = self.extended_model()
        least_v = 0.01 * voltage_accuracy_pct * extended.model.nominal_v
        level_v = max(self.noise.level_std_v, least_v)
        noise = self.noise.model_copy(update={"level_std_v": level_v})
        return OnlineModel(extended, self.functions, noise, capacity_ah, gap_s)

    @naming_arguments
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
        row, soc_pct = start_of(log) if initial_soc_pct is None else (0, initial_soc_pct)
        rows = np.arange(len(log))
        return self.extended_model().predict(Signals.of(log), soc_pct, rows, initial_row=row)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Model:
        """Read and validate a model file.

        Raises
        ------
        InputError
            If the file cannot be read or does not describe a usable model; names the field.
        """
        path = as_path(path)
        try:
            data = read_bounded(path, 4 * MIB, "a model file")
        except InputError as error:
            if isinstance(error.__cause__, FileNotFoundError):
                cure = f"{error.cure}, or {CURE}"
                raise InputError(error.problem, source=path, cure=cure) from error
            raise
        with located(path):
            try:
                raw = json.loads(data)
                json.dumps(raw, ensure_ascii=False).encode()  # half of a surrogate pair is no text
            except (ValueError, RecursionError) as error:
                raise InputError(f"not JSON ({error})", cure=CURE) from error
            head = raw if isinstance(raw, dict) else {}
            if head.get("format") != "cangauge-model":
                value = head.get("format")
                raise InputError("not a cangauge model", field="format", value=value, cure=CURE)
            if head.get("version") != 2:
                problem, value = "this release reads version 2: fit again", head.get("version")
                raise InputError(problem, field="version", value=value, cure=CURE)
            try:
                model = cls.model_validate(raw)
            except ValidationError as error:
                raise schema_error(error, cls, path, CURE) from error
            model.extended_model()
        return model

    def to_json(self) -> str:
        """Return the text of the model file."""
        return json.dumps(self.model_dump(mode="json"), indent=1, allow_nan=False) + "\n"

    def save(self, path: Path | str) -> None:
        """Write the model file; an existing file is replaced atomically."""
        write_text_atomic(Path(path), self.to_json())

    @classmethod
    def of_knots(cls, known: Distribution, judged: Mapping[str, Any], **fields: Any) -> Model:
        """Return the model of a curve of knots.

        Parameters
        ----------
        known : Distribution
            Prior or posterior; coefficients beyond b are ignored.
        judged : dict
            The errors of left-out logs (`Noise`).
        fields
            The other fields of `Model`.
        """
        n, p = KNOTS_PCT.size, KNOTS_PCT.size + known.arrhenius_ohm.size + 2
        chemistry: ChemistryName = fields["chemistry"]
        kt, *ohm, b = known.coefficients[n:p].tolist()
        loads = Loads(
            t_ref_c=REFERENCE_C,
            kt_v_per_k=kt,
            delays_s=DELAYS_S,
            low_pass_s=LOW_PASS_S,
            resistance_ohm=tuple(ohm),
            arrhenius=Arrhenius(
                factor=b,
                resistance_ohm=tuple(known.arrhenius_ohm.tolist()),
                mean_c=known.mean_c,
            ),
        )
        curve_v = known.coefficients[:n].tolist()
        covariance = known.covariance[:p, :p]
        return cls(
            equation="knots",
            curve=CurveKnots(soc_pct=tuple(KNOTS_PCT.tolist()), voltage_v=tuple(curve_v)),
            loads=loads,
            functions=principal_functions(chemistry, covariance, loads, fields["capacity_ah"]),
            noise=Noise.of(
                chemistry,
                known.mean_v,
                known.residual_v,
                judged,
                scale=known.scale,
                strain=known.strain,
            ),
            **fields,
        )

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
        typical = CHEMISTRIES[chemistry]
        half_full_v = cells * float(np.interp(50.0, KNOTS_PCT, typical.curve_v))
        prior = PackPrior(typical, capacity_ah, cells).coefficients(half_full_v, 50.0)
        judged = {
            "voltage_mae_pct": 100.0 * prior.residual_v / half_full_v,
            "voltage_rmse_v": prior.residual_v,
            "judged_on": PRIOR_MADE_BY,
        }
        most_a = PRIOR_C_RATE * capacity_ah
        return cls.of_knots(
            prior,
            judged,
            name=f"{cells} {chemistry} cells of {capacity_ah:g} Ah",
            chemistry=chemistry,
            cells=cells,
            capacity_ah=capacity_ah,
            temperature_source="unknown",
            range=Ranges(
                soc_pct=(0.0, 100.0), temperature_c=PRIOR_RANGE_C, current_a=(-most_a, most_a)
            ),
            made=Made(by=PRIOR_MADE_BY, options={}, logs=[], fingerprint="prior"),
        )


def as_model(model: Any) -> Model:
    """Return a model for a `Model`, the path of its file, or the result of `fit`."""
    found = getattr(model, "model", model)
    if isinstance(found, str | PathLike):
        return Model.load(found)
    if not isinstance(found, Model):
        cure = "give a Model, the path of its file, or the result of fit"
        raise InputError("not a model", field="model", value=type(model).__name__, cure=cure)
    return found

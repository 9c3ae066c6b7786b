"""C sources of a model: the files of the core, and its constants as initialised structures."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from cangauge.errors import InputError
from cangauge.estimation.core_constants import (
    Constants,
    core_forms,
    model_constants,
    settings_constants,
)
from cangauge.estimation.estimator import Estimator
from cangauge.model.curve import HermiteCurve, PublishedCurve
from cangauge.model.effects.base import CoreForm
from cangauge.model.model_file import Model
from cangauge.model.voltage_model import VoltageModel

CORE_SOURCES: Final = ("cangauge.c", "cangauge_filter.c", "cangauge_model.c")
CORE_HEADERS: Final = ("cangauge.h", "cangauge_internal.h")
WIDE: Final = ("ocv_v", "epsilon", "golden")
"""Fields that are doubles where the others are floats, and rows of the tests."""

KNOTS: Final = 201
"""Knots of a table of the published curve: every half per cent, as many as `CG_KNOTS`."""

EDGE_PCT: Final = 1e-3
"""Distance from the identified SoC at which a table has the slope beyond it [%]: the curve has a
kink there, which a cubic between two knots cannot have."""


class TabulatedModel(Model):
    """A model of the published equation whose curve is a table.

    The equation has logarithms and negative powers of the SoC, which cost a microcontroller without
    doubles four times as much as all the rest of a voltage update.
    """

    @classmethod
    def of(cls, model: Model) -> Model:
        """Return a model with its curve as a table."""
        fields = {name: getattr(model, name) for name in Model.model_fields}
        return model if model.equation == "knots" else cls.model_construct(**fields)

    def voltage_model(self) -> VoltageModel:
        """Return the voltage model; see `Model.voltage_model`."""
        voltage = super().voltage_model()
        curve = voltage.curve
        if not isinstance(curve, PublishedCurve):
            return voltage
        low, high = voltage.range.soc_pct
        inside = np.linspace(low, high, KNOTS - 2)
        soc_pct = np.r_[low - EDGE_PCT, inside, high + EDGE_PCT]
        slope = np.r_[curve.beyond[0], curve.slopes(inside), curve.beyond[1]]
        return replace(voltage, curve=HermiteCurve(soc_pct, curve.values(soc_pct), slope))


@dataclass(frozen=True)
class CoreConstants:
    """Constants that the core is started with.

    Parameters
    ----------
    model, settings : Constants
        Fields of a `cg_model` without its effects, and of a `cg_settings`.
    effects : list of CoreForm
    """

    model: Constants
    settings: Constants
    effects: list[CoreForm]


def exported_constants(model: Model) -> CoreConstants:
    """Return the constants of a model with the usual settings.

    Raises
    ------
    InputError
        If the core lacks one of the model's effects.
    """
    estimator = Estimator(model)
    try:
        forms = core_forms(estimator.online)
    except ValueError as lacking:
        raise InputError(
            str(lacking),
            field="effects",
            value=[entry["id"] for entry in model.effects],
            cure="fit the model without it",
        ) from lacking
    return CoreConstants(model_constants(estimator, forms), settings_constants(estimator), forms)


def line_size(constants: CoreConstants, spacing_s: float) -> int:
    """Return the length of a delay line, as `CG_LINE_SIZE`."""
    return int(2.0 * constants.model["delay_s"][-1] / spacing_s) + 9


def initialiser(value: Any, field: str = "") -> str:
    """Return a C initialiser.

    Parameters
    ----------
    value : number, dict, array, list, tuple or str
        A dict is a structure, a string an expression in C.
    field : str
        Field that the value is of.
    """
    if isinstance(value, dict):
        fields = (f".{name} = {initialiser(each, name)}" for name, each in value.items())
        return "{" + ", ".join(fields) + "}"
    if isinstance(value, np.ndarray | list | tuple):
        return "{" + (", ".join(initialiser(item, field) for item in value) or "0") + "}"
    if isinstance(value, float):
        if not math.isfinite(value):
            return "NAN" if math.isnan(value) else ("-" * (value < 0.0) + "INFINITY")
        return ("" if field in WIDE else "(cg_real)") + repr(float(value))
    return value if isinstance(value, str) else str(int(value))


def model_definition(name: str, constants: CoreConstants) -> str:
    """Return the definition of a model's constants, a `cg_model`."""
    effects = [
        {"kind": f"CG_{form.kind.upper()}", "value": form.values, "tau_s": form.tau_s}
        for form in constants.effects
    ]
    lines = [
        f"    .{field} = {initialiser(value, field)},\n"
        for field, value in (constants.model | {"effect": effects}).items()
        if np.size(value)
    ]
    return f"const cg_model {name} = {{\n{''.join(lines)}}};\n"

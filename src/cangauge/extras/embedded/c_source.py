"""C sources of a model: the files of the core, and its constants as initialised structures."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Final

from cangauge.errors import InputError
from cangauge.estimation.core_constants import CoreConstants, core_constants, effect_fields
from cangauge.estimation.settings import EstimatorSettings
from cangauge.model.model_file import Model

CORE_SOURCES: Final = ("cangauge.c", "cangauge_filter.c", "cangauge_model.c")
CORE_HEADERS: Final = ("cangauge.h", "cangauge_internal.h")
WIDE: Final = ("ocv_v", "epsilon", "skew_s")
"""Fields that are doubles where the others are floats."""


def exported_constants(model: Model) -> CoreConstants:
    """Return the constants of a model with the usual settings.

    Raises
    ------
    InputError
        If the core lacks one of the model's effects.
    """
    constants = core_constants(model, EstimatorSettings())
    if constants is None:
        raise InputError(
            "the core has no form of an effect, or the model has time_skew twice",
            field="effects",
            value=[entry["id"] for entry in model.effects],
            cure="fit the model without it",
        )
    return constants


def line_size(longest_s: float, spacing_s: float) -> int:
    """Return the length of a delay line, as `CG_LINE_SIZE`."""
    return int(2.0 * longest_s / spacing_s) + 9


def initialiser(value: Any, field: str = "") -> str:
    """Return a C initialiser.

    Parameters
    ----------
    value : number, str, list, tuple or dict
        A string is an expression in C, a dict a structure.
    field : str
        Field that the value is of.
    """
    if isinstance(value, dict):
        return "{" + ", ".join(_fields(value)) + "}"
    if isinstance(value, list | tuple):
        is_nested = any(isinstance(item, list | tuple | dict) for item in value)
        joined = (",\n        " if is_nested else ", ").join(
            initialiser(item, field) for item in value
        )
        return "{" + (joined or "0") + "}"
    if isinstance(value, float):
        if not math.isfinite(value):
            return "NAN" if math.isnan(value) else ("-" * (value < 0.0) + "INFINITY")
        return ("" if field in WIDE else "(cg_real)") + repr(float(value))
    return str(int(value) if isinstance(value, bool) else value)


def model_definition(name: str, constants: CoreConstants) -> str:
    """Return the definition of a model's constants, a `cg_model`."""
    fields = constants.model | {
        "function_v": constants.functions,
        "effect": [
            effect_fields(form) | {"kind": f"CG_{form.kind.upper()}"} for form in constants.effects
        ],
    }
    body = "".join(f"    {field},\n" for field in _fields(fields))
    return f"const cg_model {name} = {{\n{body}}};\n"


def _fields(structure: dict[str, Any]) -> Iterator[str]:
    for name, value in structure.items():
        if value != []:
            yield f".{name} = {initialiser(value, name)}"

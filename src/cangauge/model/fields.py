"""Numbers that a model file may hold, and the base of its parts."""

from __future__ import annotations

import itertools
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field


def increasing(values: list[float]) -> list[float]:
    """Return increasing values; raise ValueError for others."""
    if any(high <= low for low, high in itertools.pairwise(values)):
        raise ValueError("must increase")
    return values


# Wider than any pack needs, narrow enough that no voltage overflows.
Value = Annotated[float, Field(ge=-1e12, le=1e12)]
Soc = Annotated[float, Field(ge=-10, le=110)]
Celsius = Annotated[float, Field(ge=-273.15, le=1000)]
Ampere = Annotated[float, Field(ge=-1e6, le=1e6)]
Volts = Annotated[float, Field(ge=0, le=1e6)]
Seconds = Annotated[float, Field(gt=0, le=1e5)]
Delay = Annotated[float, Field(ge=0, le=3600)]
Delays = Annotated[list[Delay], Field(min_length=1), AfterValidator(increasing)]
Knots = Annotated[list[Soc], Field(min_length=2), AfterValidator(increasing)]


class Fields(BaseModel):
    """Part of a model file: no further fields, no change, no infinite number."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

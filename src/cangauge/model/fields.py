"""Numbers that a model file may hold, and the base of its parts."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from cangauge.errors import InputError


def increasing(values: tuple[float, ...]) -> tuple[float, ...]:
    """Return increasing values; raise ValueError for others."""
    if any(high <= low for low, high in itertools.pairwise(values)):
        raise ValueError("must increase")
    return values


CURE = "create the file with `cangauge fit`"

# Wider than any pack needs, narrow enough that no voltage overflows.
Value = Annotated[float, Field(ge=-1e12, le=1e12)]
Soc = Annotated[float, Field(ge=-10, le=110)]
Celsius = Annotated[float, Field(ge=-273.15, le=1000)]
Ampere = Annotated[float, Field(ge=-1e6, le=1e6)]
Volts = Annotated[float, Field(ge=0, le=1e6)]
Seconds = Annotated[float, Field(gt=0, le=1e5)]
Delay = Annotated[float, Field(ge=0, le=3600)]
Delays = Annotated[tuple[Delay, ...], Field(min_length=1), AfterValidator(increasing)]
Knots = Annotated[tuple[Soc, ...], Field(min_length=2), AfterValidator(increasing)]


class Fields(BaseModel):  # noqa: PLW1641 (frozen: pydantic gives its hash)
    """Part of a model file or a map file: no further fields, no change, no infinite number."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    def __eq__(self, other: object) -> bool:
        """Return whether all fields are equal; arrays that are cached beside them do not count."""
        return isinstance(other, type(self)) and self.model_dump() == other.model_dump()


def check_shape(field: str, values: Sequence[Any], number: int, *inner: int) -> None:
    """Raise InputError, with the field, if nested values have another shape."""
    if len(values) != number:
        problem = f"needs {number} values"
        raise InputError(problem, field=field, value=len(values), cure=CURE)
    for place, row in enumerate(values) if inner else ():
        check_shape(f"{field}.{place}", row, *inner)

"""Faults of a simulated pack and its sensors: kinds, sizes, and how a user writes them.

`faults.toml` has the kinds. A fault has one size, whose unit and physical limits its kind states,
and shape parameters (where, when, how fast) that are given or drawn from a seed. As text it is
`ID`, `ID:parameter=value` or `ID:parameter=value,shape=value`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

import numpy as np

from cangauge.errors import InputError
from cangauge.extras.validation.twin.pack import TwinPack, log_uniform, read_table

GAP: Final = "gap_v"
"""Parameter that replaces the size in a text: RMS gap to open [V]."""


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault; `faults.toml` says what it does.

    Parameters
    ----------
    id : str
        As in the effects library.
    parameter, unit : str
        Name and unit of the size.
    span : tuple of float
        Smallest and largest physical size, positive.
    times : str, optional
        Property of the pack whose multiples these are.
    signed : bool
        Whether the size may be negative.
    shape : dict of str to dict
        Further parameters, each with the arguments of `_draw`; `accepted` is the range that a user
        may give, by default from `low` to `high`.
    """

    id: str
    parameter: str
    unit: str
    span: tuple[float, float]
    times: str | None = None
    signed: bool = False
    shape: Mapping[str, dict[str, Any]] = field(default_factory=dict)

    def limits(self, pack: TwinPack) -> tuple[float, float]:
        """Return the smallest and largest physical size for a pack, both positive."""
        low, high = self.span
        unit = 1.0 if self.times is None else getattr(pack, self.times)
        return low * unit, high * unit

    def draw_shape(self, seed: int) -> dict[str, float]:
        """Draw all shape parameters."""
        rng = np.random.default_rng(seed)
        return {name: _draw(rng, **of) for name, of in self.shape.items()}


FAULT_KINDS: Final = {name: FaultKind(name, **of) for name, of in read_table("faults.toml").items()}
"""Kinds of faults by their ids."""


@dataclass(frozen=True)
class Fault:
    """One fault of a pack.

    Parameters
    ----------
    id : str
        Id of its kind.
    size : float
        In the unit of its kind; 0 has no effect.
    shape : dict of str to float
        Given shape parameters; the others are drawn from `seed`.
    seed : int
    """

    id: str
    size: float
    shape: Mapping[str, float] = field(default_factory=dict)
    seed: int = 0

    @property
    def kind(self) -> FaultKind:
        """Kind of the fault."""
        return FAULT_KINDS[self.id]

    @cached_property
    def full_shape(self) -> dict[str, float]:
        """All shape parameters, given or drawn."""
        return {**self.kind.draw_shape(self.seed), **self.shape}


def _draw(
    rng: np.random.Generator,
    low: float,
    high: float,
    *,
    logarithmic: bool = False,
    whole: bool = False,
    **_: object,
) -> float:
    """Draw a number from low to high: even, even in the logarithm, or whole."""
    if whole:
        return float(rng.integers(int(low), int(high) + 1))
    return log_uniform(rng, low, high) if logarithmic else rng.uniform(low, high)


Faults = Mapping[str, Fault]
"""Faults of a pack and its sensors by id; empty: healthy."""


def faults_by_id(faults: Iterable[Fault]) -> Faults:
    """Return the faults of a size by id; InputError for two of one kind."""
    found: dict[str, Fault] = {}
    for fault in faults:
        if fault.id in found:
            raise _refused("given twice", fault.id, "give each once")
        found[fault.id] = fault
    return {name: fault for name, fault in found.items() if fault.size}


def size_of(faults: Faults, fault_id: str) -> float:
    """Return the size of a fault, 0 without it."""
    return faults[fault_id].size if fault_id in faults else 0.0


HEALTHY: Final[Faults] = {}


def parse_effect(text: str, pack: TwinPack, *, seed: int) -> tuple[Fault, float | None]:
    """Parse an effect given as text.

    Parameters
    ----------
    text : str
        For example `current_offset:offset_a=2` or `resistance_step:step_ohm=0.02,at_s=1200`.
        `gap_v=` instead of the size gives the RMS gap to open; without either it is 0.3 % of the
        nominal voltage.
    pack : TwinPack
        Sets the physical limits of the size.
    seed : int
        Seed of shape parameters that are not given.

    Returns
    -------
    fault : Fault
        Of size 1 if a gap is to be opened.
    gap_v : float or None
        RMS gap to open [V]; None if the size was given.

    Raises
    ------
    InputError
        For an unknown effect or parameter, or a value that is no number or outside its limits.
    """
    name, _, rest = text.partition(":")
    kind = FAULT_KINDS.get(name.strip())
    if kind is None:
        raise _refused("unknown effect", name, f"use {', '.join(FAULT_KINDS)}")
    _, largest = kind.limits(pack)
    ranges = {
        kind.parameter: (-largest if kind.signed else 0.0, largest),
        GAP: (1e-6, 0.2 * pack.nominal_v),
        **{name: of.get("accepted", (of["low"], of["high"])) for name, of in kind.shape.items()},
    }
    given: dict[str, float] = {}
    for part in filter(None, rest.split(",")):
        name, _, value = (item.strip() for item in part.partition("="))
        if name not in ranges or not value:
            cure = f"use {', '.join(f'{item}=NUMBER' for item in ranges)}"
            raise _refused(f"unknown parameter of {kind.id}", part, cure)
        try:
            given[name] = float(value)
        except ValueError:
            raise _refused("not a number", part) from None
        low, high = ranges[name]
        if not low <= given[name] <= high:
            problem = f"{name} of {kind.id} lies within {low:.4g} … {high:.4g} for this pack"
            raise _refused(problem, value)
    size, gap_v = given.pop(kind.parameter, None), given.pop(GAP, None)
    if size is None:
        return Fault(kind.id, 1.0, given, seed), 0.003 * pack.nominal_v if gap_v is None else gap_v
    if gap_v is not None:
        raise _refused("either a size or a gap", text, f"leave {GAP} out")
    return Fault(kind.id, size, given, seed), None


def _refused(problem: str, value: object, cure: str | None = None) -> InputError:
    return InputError(problem, field="--effect", value=value, cure=cure)

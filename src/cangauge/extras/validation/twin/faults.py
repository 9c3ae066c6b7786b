"""Faults of a simulated pack and its sensors: kinds, sizes, and how a user writes them.

`faults.toml` has the kinds. A fault has one size, whose unit and physical limits its kind states,
and shape parameters (where, when, how fast) that are given or drawn from a seed. As text it is
`ID`, `ID:parameter=value` or `ID:parameter=value,shape=value`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any, Final

import numpy as np
from scipy.optimize import brentq

from cangauge._typing import BoolArray, FloatArray
from cangauge.errors import InputError
from cangauge.extras.validation.twin.pack import TwinPack, log_uniform, read_table

GAP: Final = "gap_v"
"""Parameter that replaces the size in a text: RMS gap to open [V]."""
_TOLERANCE: Final = 0.03
"""Relative error of the gap at which the search for a size stops [-]."""


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault; `faults.toml` says what it does.

    Parameters
    ----------
    id : str
        As in the effects library, unless `outside` it.
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
    outside: bool = False
    shape: Mapping[str, dict[str, Any]] = field(default_factory=dict)

    def limits(self, pack: TwinPack) -> tuple[float, float]:
        """Return the smallest and largest physical size for a pack, both positive."""
        low, high = self.span
        unit = 1.0 if self.times is None else getattr(pack, self.times)
        return low * unit, high * unit


_KINDS: Final = {name: FaultKind(name, **of) for name, of in read_table("faults.toml").items()}


def fault_kinds(*, outside: bool = False) -> tuple[FaultKind, ...]:
    """Return the kinds with a counterpart in the effects library, or those outside it."""
    return tuple(kind for kind in _KINDS.values() if kind.outside is outside)


def fault_kind(fault_id: str) -> FaultKind:
    """Return a kind by its id; InputError for an unknown one."""
    if fault_id not in _KINDS:
        raise _refused("unknown effect", fault_id, f"use {', '.join(_KINDS)}")
    return _KINDS[fault_id]


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
        return fault_kind(self.id)

    @cached_property
    def full_shape(self) -> dict[str, float]:
        """All shape parameters, given or drawn."""
        rng = np.random.default_rng(self.seed)
        drawn = {name: _draw(rng, **of) for name, of in self.kind.shape.items()}
        return {**drawn, **self.shape}

    def is_active(self, time_s: FloatArray) -> BoolArray:
        """Return where a fault that comes and goes is active, shape (n,); it starts inactive.

        Its phases last `on_s` (stale frames: its size) and `off_s` on average.
        """
        shape = {"on_s": self.size, **self.full_shape}
        on_s, off_s = shape["on_s"], shape["off_s"]
        pairs = int(2.0 * float(time_s[-1] - time_s[0]) / (on_s + off_s)) + 4
        # Drawn in pairs, so that another duration stretches the same sequence.
        lengths = np.random.default_rng(self.seed).exponential(1.0, (pairs, 2)) * (off_s, on_s)
        edges = time_s[0] + np.cumsum(lengths.ravel())
        return np.asarray(np.searchsorted(edges, time_s, side="right") % 2 == 1)


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
    """Return the faults of a size by id; InputError for an unknown kind, or two of one."""
    found: dict[str, Fault] = {}
    for fault in faults:
        if fault.kind.id in found:
            raise _refused("given twice", fault.id, "give each once")
        found[fault.id] = fault
    return {name: fault for name, fault in found.items() if fault.size}


def size_of(faults: Faults, fault_id: str) -> float:
    """Return the size of a fault, 0 without it."""
    return faults[fault_id].size if fault_id in faults else 0.0


HEALTHY: Final[Faults] = {}


def find_size(
    gap_of: Callable[[Fault], float], fault: Fault, target_v: float, pack: TwinPack
) -> tuple[Fault, float]:
    """Return a fault of the size at which `gap_of` returns the wanted RMS gap, and that gap.

    Where the physical limits of the size do not allow the wanted gap, it is the nearest.

    Parameters
    ----------
    gap_of : callable
        Fault → RMS gap [V]; inf if the size is impossible.
    fault : Fault
        Its size gives the sign.
    target_v : float
        RMS gap [V].
    pack : TwinPack
    """
    low, high = map(math.log, fault.kind.limits(pack))
    tried: list[tuple[float, float, float]] = []

    @cache  # brentq begins at both ends again
    def excess(log_size: float) -> float:
        """Return the logarithm of gap over target, 0 within the tolerance."""
        size = math.copysign(math.exp(log_size), fault.size)
        gap_v = gap_of(replace(fault, size=size))
        if not math.isfinite(gap_v):
            return high - low
        level = math.log(max(gap_v, 1e-9) / target_v)
        tried.append((abs(level), size, gap_v))
        return 0.0 if abs(level) < _TOLERANCE else level

    if excess(high) > 0.0 > excess(low):
        brentq(excess, low, high, xtol=0.1 * _TOLERANCE)
    _, size, gap_v = min(tried, default=(0.0, 0.0, 0.0))
    return replace(fault, size=size), gap_v


def is_reached(gap_v: float, target_v: float) -> bool:
    """Return whether a gap is the wanted one; otherwise the limits of the size prevent it."""
    return abs(math.log(max(gap_v, 1e-9) / target_v)) < 2.0 * _TOLERANCE


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
    fault_id, _, rest = text.partition(":")
    kind = fault_kind(fault_id.strip())
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

"""Faults as text: `ID`, `ID:parameter=value` or `ID:parameter=value,shape=value`."""

from __future__ import annotations

import math
from dataclasses import dataclass

from cangauge.errors import InputError
from cangauge.twin.fault_kind import Span
from cangauge.twin.faults import Fault, fault_kind
from cangauge.twin.pack import Pack

GAP = "gap_v"
"""In place of a size: the RMS gap that the fault shall open [V]."""


@dataclass(frozen=True)
class AskedFault:
    """A fault as asked for.

    Parameters
    ----------
    fault : Fault
        Of size 1 (or −1) if only a gap was asked for.
    gap_v : float, optional
        RMS gap to be opened [V]; None if the size was given.
    """

    fault: Fault
    gap_v: float | None


def parse_effect(text: str, pack: Pack, *, seed: int, default_gap_v: float) -> AskedFault:
    """Return the fault that a text asks for.

    Parameters
    ----------
    text : str
        For example `current_offset:offset_a=2` or `resistance_step:step_ohm=0.02,at_s=1200`.
        `gap_v=` in place of the size asks for a gap; without either, the gap is the default.
    pack : Pack
        For the physical limits of the size.
    seed : int
        Of what is not given.
    default_gap_v : float

    Raises
    ------
    InputError
        If the effect or a parameter is unknown, a value is no number or beyond what is physical.
    """
    fault_id, _, rest = text.partition(":")
    kind = fault_kind(fault_id.strip())
    given = {}
    for part in filter(None, rest.split(",")):
        name, sign, value = (item.strip() for item in part.partition("="))
        allowed = (kind.parameter, GAP, *kind.shape)
        if not sign or name not in allowed:
            raise InputError(
                f"no such parameter of {kind.id}",
                field="--effect",
                value=part,
                cure=f"use {', '.join(f'{item}=NUMBER' for item in allowed)}",
            )
        given[name] = _number(value, part)
        if name in kind.shape:
            _check_shape(kind.shape[name], given[name], part)
    size = given.pop(kind.parameter, None)
    gap_v = given.pop(GAP, None)
    if size is not None and gap_v is not None:
        raise InputError(
            "either a size or a gap", field="--effect", value=text, cure=f"leave {GAP} out"
        )
    if size is not None:
        _check_size(kind.id, size, pack)
        return AskedFault(Fault(kind.id, size, given, seed), None)
    wanted = default_gap_v if gap_v is None else gap_v
    if not 0.0 < wanted < 0.2 * pack.nominal_v:
        raise InputError(
            f"a gap lies between 0 and {0.2 * pack.nominal_v:.0f} V for this pack",
            field="--effect",
            value=wanted,
        )
    return AskedFault(Fault(kind.id, 1.0, given, seed), wanted)


def _check_shape(span: Span, value: float, part: str) -> None:
    low, high = span.allowed
    if not low <= value <= high:
        raise InputError(f"must lie within {low:g} … {high:g}", field="--effect", value=part)


def _check_size(fault_id: str, size: float, pack: Pack) -> None:
    kind = fault_kind(fault_id)
    _, high = kind.limits(pack)
    low = -high if kind.signed else 0.0
    if not low <= size <= high:
        raise InputError(
            f"{kind.parameter} of {kind.id} lies within {low:.4g} … {high:.4g} {kind.unit}"
            " for this pack",
            field="--effect",
            value=size,
        )


def _number(text: str, part: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError("not a number", field="--effect", value=part)
    return value

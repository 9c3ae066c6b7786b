"""Faults put into a simulated pack.

Twenty have a name that a diagnosis may use; some no diagnosis is expected to know.

A fault has one size, whose meaning and physical limits its kind states, and a shape (where,
when, how fast) drawn from a seed or given.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from cangauge.errors import InputError
from cangauge.twin.condition import HEALTHY, Condition
from cangauge.twin.fault_kind import OUTSIDE, FaultKind
from cangauge.twin.fault_list import NAMED
from cangauge.twin.outside_list import UNNAMED
from cangauge.twin.pack import Pack

KINDS_BY_ID: Final[dict[str, FaultKind]] = {kind.id: kind for kind in (*NAMED, *UNNAMED)}


@dataclass(frozen=True)
class Fault:
    """One fault of a pack.

    Parameters
    ----------
    id : str
        Of its kind.
    size : float
        In the unit of its kind; 0 does nothing.
    shape : dict of str to float
        As far as given; the rest is drawn from `seed`.
    seed : int
    """

    id: str
    size: float
    shape: Mapping[str, float] = field(default_factory=dict)
    seed: int = 0

    @property
    def kind(self) -> FaultKind:
        """What kind of fault it is."""
        return fault_kind(self.id)

    def full_shape(self) -> dict[str, float]:
        """Return the shape, drawn where it was not given."""
        rng = np.random.default_rng(self.seed)
        drawn = {name: span.draw(rng) for name, span in self.kind.shape.items()}
        return drawn | dict(self.shape)

    def sized(self, size: float) -> Fault:
        """Return the fault with another size."""
        return replace(self, size=size)


def apply_faults(pack: Pack, faults: tuple[Fault, ...]) -> Condition:
    """Return the condition of a pack that has these faults.

    Parameters
    ----------
    pack : Pack
    faults : tuple of Fault

    Raises
    ------
    InputError
        If a kind is unknown, or two faults are of the same kind.
    """
    condition = HEALTHY
    if len({fault.id for fault in faults}) != len(faults):
        raise InputError("a fault is given twice", field="--effect", cure="give each once")
    for fault in faults:
        if fault.size != 0.0:
            condition = fault.kind.apply(
                condition, pack, fault.size, fault.full_shape(), fault.seed
            )
    return condition


def fault_kind(fault_id: str) -> FaultKind:
    """Return a kind by its id.

    Raises
    ------
    InputError
        If there is none of this name.
    """
    try:
        return KINDS_BY_ID[fault_id]
    except KeyError:
        raise InputError(
            "no such effect",
            field="--effect",
            value=fault_id,
            cure=f"use one of: {', '.join(KINDS_BY_ID)}",
        ) from None


def fault_kinds(*, outside: bool = False) -> tuple[FaultKind, ...]:
    """Return the kinds that a diagnosis may name, or those outside of its knowledge."""
    return tuple(k for k in KINDS_BY_ID.values() if (k.family == OUTSIDE) is outside)

"""What a kind of fault is: its size, its limits, its shape and what it changes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from cangauge.twin.condition import Condition
from cangauge.twin.pack import Pack

OUTSIDE: Final = "outside"
"""Family of the faults that are meant to be unknown to a diagnosis."""


@dataclass(frozen=True)
class Span:
    """Range of a shape, drawn evenly or, over decades, evenly in its logarithm.

    Parameters
    ----------
    low, high : float
        What is drawn lies between them.
    logarithmic, whole : bool
        How it is drawn.
    outer : tuple of float, optional
        What a user may give; without, from low to high.
    """

    low: float
    high: float
    logarithmic: bool = False
    whole: bool = False
    outer: tuple[float, float] | None = None

    @property
    def allowed(self) -> tuple[float, float]:
        """Least and largest value that a user may give."""
        return (self.low, self.high) if self.outer is None else self.outer

    def draw(self, rng: np.random.Generator) -> float:
        """Return a value at random."""
        if self.whole:
            return float(rng.integers(int(self.low), int(self.high) + 1))
        if self.logarithmic:
            return float(np.exp(rng.uniform(np.log(self.low), np.log(self.high))))
        return float(rng.uniform(self.low, self.high))


Shape = Mapping[str, float]
Apply = Callable[[Condition, Pack, float, Shape, int], Condition]


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault.

    Parameters
    ----------
    id, family : str
        As in the diagnosis, or family `outside`.
    parameter, unit : str
        Name and unit of the size.
    limits : callable
        Pack → smallest and largest size that make physical sense, both positive.
    apply : callable
        (condition, pack, size, shape, seed) → condition with the fault.
    signed : bool
        Whether the size may be negative too.
    shape : dict of str to Span
        Further parameters.
    physical : bool
        Whether the size is a quantity that a diagnosis could state in the same unit.
    near : tuple of str
        For faults outside: effects whose signature it resembles.
    says : str
        What happens, in words.
    """

    id: str
    family: str
    parameter: str
    unit: str
    limits: Callable[[Pack], tuple[float, float]]
    apply: Apply
    signed: bool = False
    shape: Mapping[str, Span] = field(default_factory=dict)
    physical: bool = False
    near: tuple[str, ...] = ()
    says: str = ""

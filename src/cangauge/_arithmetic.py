"""Sums from left to right, each addition rounded, as a loop in C does them.

Python's `sum` compensates its rounding errors since 3.12: the last bits of what it returns depend
on the interpreter. The estimator gives the same bits on all of them, and in its C core.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import reduce
from operator import add, mul


def total(values: Iterable[float]) -> float:
    """Return the sum of the values, 0 if there are none."""
    return reduce(add, values, 0.0)


def dot(first: Iterable[float], second: Iterable[float]) -> float:
    """Return the sum of the products of two sequences, as long as the shorter one."""
    return reduce(add, map(mul, first, second), 0.0)

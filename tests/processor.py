"""Limits of processor time that hold on any machine, beside any load."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager

REFERENCE_S = 0.025
"""Processor time of the reference task, on the processor for which limits are stated [s]."""
MUCH_FASTER = 5.0
"""No processor is that many times as fast as the one of the reference."""


def _reference_task() -> None:
    """Do work of the readers' kind: split, match, convert and count texts."""
    counts: dict[str, float] = {}
    for number in range(20_000):
        name, value = f"signal_{number % 97};{number}.5".split(";")
        if re.fullmatch(r"[a-z]+_\d+", name):
            counts[name] = counts.get(name, 0.0) + float(value)


def _slowness() -> float:
    """Return how many times as long as its reference this processor needs now."""
    times_s = []
    for _ in range(3):
        began_s = time.process_time()
        _reference_task()
        times_s.append(time.process_time() - began_s)
    return min(times_s) / REFERENCE_S


@contextmanager
def at_most(seconds: float, what: str = "") -> Iterator[None]:
    """Fail where a block needs more processor time than that of the reference processor.

    The reference task is timed right after the block, so that a slow processor, or one whose
    caches others use, raises the limit as it raises the time. A block far below needs no reference.
    """
    began_s = time.process_time()
    yield
    took_s = time.process_time() - began_s
    if took_s > seconds / MUCH_FASTER:
        assert took_s < seconds * _slowness(), what

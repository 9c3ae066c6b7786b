"""Targets that fail in every way that the supervisor must notice."""

from __future__ import annotations

import os
import signal
import time
from random import Random

from cangauge.errors import InputError
from fuzzing.target import Target

HANGS, DIES, RAISES, GROWS = 13, 29, 41, 47


def targets() -> tuple[Target, ...]:
    return (Target("faulty", _make, _run, 1.0),)


def _make(rng: Random) -> bytes:
    return _make.numbers[rng.random()]  # type: ignore[attr-defined]


# The generator is named by seed, target and number: the first draw identifies the number.
_make.numbers = {  # type: ignore[attr-defined]
    Random(f"1/faulty/{number}").random(): bytes([number])  # noqa: S311 - no secret
    for number in range(60)
}


def _run(data: bytes) -> bool:
    number = data[0]
    if number == HANGS:
        time.sleep(1000.0)
    if number == DIES:
        os.kill(os.getpid(), signal.SIGKILL)
    if number == RAISES:
        raise KeyError(number)
    if number == GROWS:
        len(b"x" * (200 << 20))
    if number % 2:
        raise InputError("an odd number", value=number)
    return True

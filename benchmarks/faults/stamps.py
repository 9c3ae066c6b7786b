"""The service with changed time stamps, in the time of the fault: targets for `Fault.target`.

The kernel stamps the packets of UDP multicast; the service's process changes the stamps where its
backend reads them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from random import Random
from typing import Final

import can

from faults.frames import REAL
from faults.process import cangauge

DAY_S: Final = 86400.0
JITTER_S: Final = 0.9

StampChange = Callable[[float, float, Random], float]
"""(stamp, start of the fault by the same clock, random generator) → stamp, all in s."""


def _run(change: StampChange, arguments: list[str], *, lasts: bool = False) -> None:
    """Run the service with stamps changed during the fault, or from its start on."""
    from cangauge.bus import open as opening  # noqa: PLC0415 - in the service's process alone

    begin_s, end_s = REAL.fault_s
    make, rng, first_s = opening.message_of, Random(1), math.nan  # noqa: S311 - repeatable

    def restamped(packet: bytes, stamp_s: float) -> can.Message:
        nonlocal first_s
        if math.isnan(first_s):
            first_s = stamp_s
        if begin_s <= stamp_s - first_s and (lasts or stamp_s - first_s < end_s):
            stamp_s = change(stamp_s, first_s + begin_s, rng)
        return make(packet, stamp_s)

    opening.message_of = restamped
    cangauge(arguments)


def still(arguments: list[str]) -> None:
    """Run with stamps that stand still."""
    _run(lambda _stamp_s, begin_s, _rng: begin_s, arguments)


def backwards(arguments: list[str]) -> None:
    """Run with stamps that go back by 1 ms in a second."""
    _run(lambda stamp_s, begin_s, _rng: begin_s - 1e-3 * (stamp_s - begin_s), arguments)


def irregular(arguments: list[str]) -> None:
    """Run with stamps that are off at random by up to 0.9 s."""
    _run(lambda stamp_s, _b, rng: stamp_s + rng.uniform(-JITTER_S, JITTER_S), arguments)


def fast(arguments: list[str]) -> None:
    """Run with stamps that go ten times faster."""
    _run(lambda stamp_s, begin_s, _rng: begin_s + 10.0 * (stamp_s - begin_s), arguments)


def zero(arguments: list[str]) -> None:
    """Run without stamps, as with some drivers."""
    _run(lambda _stamp_s, _b, _rng: 0.0, arguments)


def forward(arguments: list[str]) -> None:
    """Set the stamps' clock forward by a day."""
    _run(lambda stamp_s, _b, _rng: stamp_s + DAY_S, arguments, lasts=True)


def back(arguments: list[str]) -> None:
    """Set the stamps' clock back by a day."""
    _run(lambda stamp_s, _b, _rng: stamp_s - DAY_S, arguments, lasts=True)


def from_1970(arguments: list[str]) -> None:
    """Set the stamps' clock forward as from 1970."""
    _run(lambda stamp_s, _b, _rng: stamp_s + 1.7e9, arguments, lasts=True)

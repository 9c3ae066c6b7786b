"""Every fault changes something, within its time only."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest

from cangauge.bus.vehicle import Vehicle
from faults.bench import vehicle_config
from faults.catalogue import EVERYTHING, ON_UDP, ON_VCAN
from faults.fault import Fault
from faults.frames import Event, Profile, events

PERMANENT = ("clock back", "clock forward")
"""Faults that set the clock."""

TINY = Profile("tiny", 130.0, 30.0, (10.0, 20.0), 1.0)

OF_FRAMES = [
    replace(fault, profile=TINY)
    for fault in ON_UDP
    if fault.frames is not None or fault.values is not None
]


def played(fault: Fault, folder: Path, seed: int) -> tuple[list[Event], list[Event]]:
    """Frames with and without a fault."""
    names = vehicle_config(fault.vehicle, folder)
    vehicle = Vehicle.load(names.get("vehicle"), names.get("dbc"), names.get("map"))
    rng = Random(seed)  # noqa: S311 - must be repeatable
    found = events(fault.profile, vehicle, values=fault.values, untrusted=fault.untrusted, rng=rng)
    if fault.frames is not None:
        found = fault.frames(found, fault.profile, vehicle, rng)
    return found, events(fault.profile, vehicle)


def content(event: Event) -> tuple[object, ...]:
    frame = event.frame
    kind = (frame.is_extended_id, frame.is_remote_frame, frame.is_error_frame)
    return round(event.at_s, 6), frame.arbitration_id, kind, bytes(frame.data)


def test_names_are_unique() -> None:
    names = Counter(fault.name for fault in ON_UDP)
    assert max(names.values()) == 1
    assert len(EVERYTHING) >= 40
    assert {fault.name for fault in ON_VCAN} <= EVERYTHING.keys()
    assert all(
        fault.frames or fault.values or fault.plan or fault.target for fault in EVERYTHING.values()
    ), "a fault without a change"


@pytest.mark.parametrize("fault", OF_FRAMES, ids=lambda fault: fault.name)
def test_frames_differ_only_during_the_fault(fault: Fault, tmp_path: Path) -> None:
    found, usual = played(fault, tmp_path, seed=1)
    first, last = fault.profile.fault_s
    # Delayed frames come at most a few seconds later.
    after_s = last + 6.0
    assert [content(event) for event in found if event.at_s < first] == [
        content(event) for event in usual if event.at_s < first
    ]
    hit = Counter(content(event) for event in found if first <= event.at_s < after_s)
    assert hit != Counter(content(event) for event in usual if first <= event.at_s < after_s)
    if not fault.name.startswith(PERMANENT):
        # Except counters and CRC, which continue from the fault.
        later = [content(event)[:3] for event in found if event.at_s >= after_s]
        assert later == [content(event)[:3] for event in usual if event.at_s >= after_s]
    times = [event.at_s for event in found]
    assert times == sorted(times)


@pytest.mark.parametrize("name", ["drop 20 %", "CRC wrong, some", "reorder", "NaN at times"])
def test_seed_determines_the_frames(name: str, tmp_path: Path) -> None:
    def made(seed: int) -> list[tuple[object, ...]]:
        return [
            content(event)
            for event in played(replace(EVERYTHING[name], profile=TINY), tmp_path, seed)[0]
        ]

    assert made(1) == made(1) != made(2)

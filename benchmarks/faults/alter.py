"""Changes of values and frames: pure, seeded, composed by the catalogue.

Frame changes act within the profile's fault time, on the frames of some roles (default: all), on
a share of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from random import Random
from typing import Final

import can

from cangauge.bus.protection import ProtectionRule
from cangauge.bus.vehicle import Vehicle
from cangauge.estimate.validity import Sample
from faults.drive import ROLES, Event, FrameChange, Profile, ValueChange, altered

NOT_AVAILABLE: Final = {
    "current": b"\x00\x00\x00\x80",
    "voltage": b"\xff\xff\xff\xff",
    "temperature": b"\x00\x80",
}
"""Raw codes of `dbc/generic_pack.dbc`."""

BUS_CAPACITY_HZ: Final = 4000.0
"""Frames a second of a saturated 500 kbit/s bus."""

EachChange = Callable[[Event, Vehicle, Random], Iterable[Event]]


def each(change: EachChange, roles: tuple[str, ...] = ROLES, share: float = 1.0) -> FrameChange:
    """Return the change that puts `change(event)` in the place of each frame that is hit."""

    def whole(found: list[Event], profile: Profile, vehicle: Vehicle, rng: Random) -> list[Event]:
        first, last = profile.fault_s
        out: list[Event] = []
        for event in found:
            is_hit = first <= event.at_s < last and any(role in roles for role in event.roles)
            if is_hit and rng.random() < share:
                out.extend(change(event, vehicle, rng))
            else:
                out.append(event)
        return in_order(out)

    return whole


def in_order(found: list[Event]) -> list[Event]:
    """Return the frames by time; those of the same time stay as they stand."""
    return sorted(found, key=lambda event: event.at_s)


def both(*changes: FrameChange) -> FrameChange:
    """Return several changes, one after the other."""

    def whole(found: list[Event], profile: Profile, vehicle: Vehicle, rng: Random) -> list[Event]:
        for change in changes:
            found = change(found, profile, vehicle, rng)
        return found

    return whole


# --- which frames come, and when ----------------------------------------------------------------


def drop(share: float = 1.0, roles: tuple[str, ...] = ROLES) -> FrameChange:
    """Lose a share of the frames."""
    return each(lambda *_: (), roles, share)


def missing_for(seconds: float, roles: tuple[str, ...] = ROLES) -> FrameChange:
    """Lose all frames for so long [s]."""

    def whole(found: list[Event], profile: Profile, _v: Vehicle, _r: Random) -> list[Event]:
        first = profile.fault_s[0]
        return [
            event
            for event in found
            if not (first <= event.at_s < first + seconds and set(event.roles) & set(roles))
        ]

    return whole


def gate(off_s: float, period_s: float) -> FrameChange:
    """Lose all frames in the first part of every period [s]."""

    def whole(found: list[Event], profile: Profile, _v: Vehicle, _r: Random) -> list[Event]:
        first, last = profile.fault_s
        return [
            event
            for event in found
            if not (first <= event.at_s < last and (event.at_s - first) % period_s < off_s)
        ]

    return whole


def duplicate(share: float = 1.0, copies: int = 1) -> FrameChange:
    """Send frames more than once."""

    def more(event: Event, _v: Vehicle, _r: Random) -> list[Event]:
        return [event] + [replace(event, is_good=False)] * copies

    return each(more, share=share)


def shuffle(block_s: float) -> FrameChange:
    """Send all frames of each block of time in random order, at random times within it."""

    def whole(found: list[Event], profile: Profile, _v: Vehicle, rng: Random) -> list[Event]:
        first, last = profile.fault_s
        out = []
        for event in found:
            if first <= event.at_s < last and event.roles:
                block = math.floor(event.at_s / block_s)
                event = replace(event, at_s=(block + rng.random()) * block_s)  # noqa: PLW2901
            out.append(event)
        return in_order(out)

    return whole


def swap_neighbours() -> FrameChange:
    """Exchange every two successive samples."""

    def whole(found: list[Event], profile: Profile, _v: Vehicle, _r: Random) -> list[Event]:
        first, last = profile.fault_s
        times = sorted({event.at_s for event in found if first <= event.at_s < last})
        other = {}
        for one, two in zip(times[::2], times[1::2], strict=False):
            other[one], other[two] = two, one
        return in_order([replace(event, at_s=other.get(event.at_s, event.at_s)) for event in found])

    return whole


def delay(seconds: float, jitter_s: float = 0.0, roles: tuple[str, ...] = ROLES) -> FrameChange:
    """Send frames later [s], and by a random part more."""
    return each(lambda event, _v, rng: [event.later(seconds + rng.random() * jitter_s)], roles)


def hold(seconds: float) -> FrameChange:
    """Hold all frames back for so long [s], then send them at once; again and again."""

    def whole(found: list[Event], profile: Profile, _v: Vehicle, _r: Random) -> list[Event]:
        first, last = profile.fault_s
        out = []
        for event in found:
            if first <= event.at_s < last:
                turn = math.floor((event.at_s - first) / seconds) + 1
                event = replace(event, at_s=first + turn * seconds)  # noqa: PLW2901
            out.append(event)
        return in_order(out)

    return whole


def flood(make: Callable[[int, Random], can.Message], rate_hz: float = BUS_CAPACITY_HZ,
          seconds: float | None = None) -> FrameChange:  # fmt: skip
    """Send foreign frames besides, so many a second."""

    def whole(found: list[Event], profile: Profile, _v: Vehicle, rng: Random) -> list[Event]:
        first, last = profile.fault_s
        last = last if seconds is None else min(last, first + seconds)
        # The rate is the bus's, so it is one of real time.
        every_s = profile.speed / rate_hz
        extra = [
            Event(first + number * every_s, make(number, rng))
            for number in range(int((last - first) / every_s))
        ]
        return in_order(found + extra)

    return whole


def foreign(number: int, rng: Random) -> can.Message:
    """Return a frame of another control unit."""
    frame_id = 0x100 + number % 0x200
    return can.Message(arbitration_id=frame_id, is_extended_id=False, data=rng.randbytes(8))


def wanted_noise(number: int, rng: Random) -> can.Message:
    """Return noise under the pack's own ids."""
    frame_id = 0x400 + number % 3
    return can.Message(arbitration_id=frame_id, is_extended_id=False, data=rng.randbytes(6))


def error_frame(number: int, _rng: Random) -> can.Message:
    """Return an error frame as the kernel tells it: bus error, error passive, bus-off in turn."""
    kind = (0x08, 0x04, 0x40)[number % 3]
    data = bytes([0, 0x30 if kind == 0x04 else 0, 0, 0, 0, 0, 0x80, 0x80])
    return can.Message(arbitration_id=kind, is_error_frame=True, is_extended_id=False, data=data)


# --- what frames hold ---------------------------------------------------------------------------


def _rule(event: Event, vehicle: Vehicle) -> ProtectionRule | None:
    return vehicle.messages[event.frame.arbitration_id].rule


def _protected(event: Event, vehicle: Vehicle, data: bytes, counter: int | None = None) -> bytes:
    rule = _rule(event, vehicle)
    if rule is None:
        return data
    return rule.protect(bytearray(data), rule.counter(data) if counter is None else counter)


def crc_wrong(share: float = 1.0, roles: tuple[str, ...] = ROLES) -> FrameChange:
    """Turn a bit of the CRC, or of the values under it."""

    def turn(event: Event, _v: Vehicle, rng: Random) -> list[Event]:
        data = bytearray(event.frame.data)
        data[rng.choice((0, 1, len(data) - 1))] ^= 1 << rng.randrange(8)
        return [event.bad(data=bytes(data))]

    return each(turn, roles, share)


def counter_stuck() -> FrameChange:
    """Give every frame the same counter, with the CRC that belongs to it."""

    def stand(event: Event, vehicle: Vehicle, _r: Random) -> list[Event]:
        return [event.bad(data=_protected(event, vehicle, bytes(event.frame.data), 5))]

    return each(stand)


def counter_jumps(share: float = 0.2) -> FrameChange:
    """Give frames a random counter with a valid CRC: loss, but a value to use."""

    def jump(event: Event, vehicle: Vehicle, rng: Random) -> list[Event]:
        data = _protected(event, vehicle, bytes(event.frame.data), rng.randrange(16))
        return [replace(event, frame=altered(event.frame, data=data))]

    return each(jump, share=share)


def cut(length: int) -> FrameChange:
    """Send only so many bytes of each frame."""
    return each(lambda event, _v, _r: [event.bad(data=bytes(event.frame.data)[:length])])


def lengthened() -> FrameChange:
    """Send eight bytes where the message has fewer; the first ones are right."""

    def longer(event: Event, _v: Vehicle, _r: Random) -> list[Event]:
        data = bytes(event.frame.data).ljust(8, b"\x55")
        return [replace(event, frame=altered(event.frame, data=data))]

    return each(longer)


def not_available(role: str) -> FrameChange:
    """Send the code for "not available", with a valid CRC and counter."""

    def none(event: Event, vehicle: Vehicle, _r: Random) -> list[Event]:
        code = NOT_AVAILABLE[role]
        data = code + bytes(event.frame.data)[len(code) :]
        return [event.bad(data=_protected(event, vehicle, data))]

    return each(none, (role,))


def raw(payload: bytes, roles: tuple[str, ...] = ROLES, share: float = 1.0) -> FrameChange:
    """Send these bytes (for frames without protection)."""
    return each(lambda event, _v, _r: [event.bad(data=payload)], roles, share)


def as_frame(**changes: object) -> FrameChange:
    """Send frames with other attributes: another id, extended, remote, error."""
    return each(lambda event, _v, _r: [event.bad(**changes)])


# --- values -------------------------------------------------------------------------------------


def value(field: str, make: Callable[[float, Random], float], share: float = 1.0) -> ValueChange:
    """Change a field of the samples."""

    def change(sample: Sample, _first: Sample, rng: Random) -> Sample:
        if rng.random() >= share:
            return sample
        return sample._replace(**{field: make(getattr(sample, field), rng)})

    return change


def stuck(field: str) -> ValueChange:
    """Hold a field at what it was when the fault began."""
    return lambda sample, first, _rng: sample._replace(**{field: getattr(first, field)})

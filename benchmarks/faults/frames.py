"""Frames of a replayed log, and seeded changes of values and frames within the fault's time.

A frame change acts on a share of the frames of some roles, all by default.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from random import Random
from typing import Final

import can

from cangauge._resources import shared_file
from cangauge.bus.protection import ProtectionRule
from cangauge.bus.recording import read_log
from cangauge.bus.time_source import clock_frame
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.offline import samples_of
from cangauge.replay.encoder import FrameEncoder
from cangauge.types import Sample

LOG: Final = "leaf2012_reconstruction_10min.parquet"
ROLES: Final = ("current", "voltage", "temperature")


@dataclass(frozen=True)
class Profile:
    """A section of the log, its speed, and the time of the fault; in seconds of the log.

    Parameters
    ----------
    name : str
    begin_s : float
        Start in the log; the other times count from here [s].
    length_s : float
    fault_s : tuple of float
        Start and end of the fault; the delay line must be full before [s].
    speed : float
        1: receive stamps are the bus time; otherwise REPLAY_CLOCK.
    """

    name: str
    begin_s: float
    length_s: float
    fault_s: tuple[float, float]
    speed: float

    @property
    def is_real_time(self) -> bool:
        """Whether receive stamps drive the estimate."""
        return self.speed == 1.0

    @property
    def seconds(self) -> float:
        """Duration of the run [s]."""
        return self.length_s / self.speed


# The log is at rest for 90 s and then drives hard (±130 A) until its end.
FAST: Final = Profile("replay clock", 40.0, 430.0, (110.0, 170.0), 24.0)

REAL: Final = Profile("real time", 75.0, 190.0, (80.0, 100.0), 1.0)
SHORT: Final = Profile("replay clock, short", 40.0, 220.0, (110.0, 150.0), 25.0)
"""For tests: as `FAST`, with little time to recover."""


@dataclass(frozen=True, slots=True)
class Event:
    """One frame to send.

    Parameters
    ----------
    at_s : float
        Time in the profile [s].
    frame : can.Message
    roles : tuple of str
        Signals of `ROLES` in the frame; empty for foreign frames.
    is_good : bool
        Whether its values are true and recognizable as such: a basis for an estimate.
    """

    at_s: float
    frame: can.Message
    roles: tuple[str, ...] = ()
    is_good: bool = True

    def bad(self, **changes: object) -> Event:
        """Return a copy with other frame attributes, not good."""
        return replace(self, frame=altered(self.frame, **changes), is_good=False)

    def later(self, seconds: float) -> Event:
        """Return a delayed copy."""
        return replace(self, at_s=self.at_s + seconds)


ValueChange = Callable[[Sample, Sample, Random], Sample]
"""(sample, first sample of the fault, random generator) → sample."""

FrameChange = Callable[[list[Event], Profile, Vehicle, Random], list[Event]]


def altered(frame: can.Message, **changes: object) -> can.Message:
    """Return a copy of a frame with changed attributes."""
    given = {
        "arbitration_id": frame.arbitration_id,
        "is_extended_id": frame.is_extended_id,
        "is_remote_frame": frame.is_remote_frame,
        "is_error_frame": frame.is_error_frame,
        "data": bytes(frame.data),
        **changes,
    }
    return can.Message(**given)  # type: ignore[arg-type] # names and types are python-can's own


@lru_cache(maxsize=8)
def _samples(profile: Profile) -> tuple[tuple[Sample, ...], float]:
    log = read_log(shared_file("replay", LOG))
    rows = (log.time_s >= profile.begin_s) & (log.time_s < profile.begin_s + profile.length_s)
    piece = log.rows(slice(int(rows.argmax()), int(rows.argmax() + rows.sum())))
    if piece.soc_pct is None:
        raise ValueError(f"{LOG} has no soc_pct")
    shifted = [each._replace(time_s=each.time_s - profile.begin_s) for each in samples_of(piece)]
    return tuple(shifted), float(piece.soc_pct[0])


def initial_soc_pct(profile: Profile) -> float:
    """Return the true initial SoC of a profile [%]."""
    return _samples(profile)[1]


def events(
    profile: Profile,
    vehicle: Vehicle,
    *,
    values: ValueChange | None = None,
    untrusted: tuple[str, ...] = (),
    rng: Random | None = None,
) -> list[Event]:
    """Return the frames of a profile.

    Parameters
    ----------
    profile : Profile
    vehicle : Vehicle
    values : callable, optional
        Changes the samples within the fault's time, before encoding with valid counters and
        CRC.
    untrusted : tuple of str
        Roles whose frames are invalid then.
    rng : Random, optional
    """
    rng = rng or Random(0)  # noqa: S311 - a seed must give the same faults again
    encoder = FrameEncoder(vehicle)
    roles: dict[int, tuple[str, ...]] = {}
    for signal in vehicle.signals:
        if signal.role in ROLES:
            roles[signal.arbitration_id] = (*roles.get(signal.arbitration_id, ()), signal.role)
    made = []
    first, last = profile.fault_s
    samples, _ = _samples(profile)
    begin = next(sample for sample in samples if sample.time_s >= first)
    for sample in samples:
        is_hit = values is not None and first <= sample.time_s < last
        changed = values(sample, begin, rng) if values is not None and is_hit else sample
        for frame in encoder.encode(changed, math.nan):
            carries = roles.get(frame.arbitration_id, ())
            is_bad = is_hit and any(role in untrusted for role in carries)
            made.append(Event(sample.time_s, frame, carries, not is_bad))
    return made


NOT_AVAILABLE: Final = {
    "current": b"\x00\x00\x00\x80",
    "voltage": b"\xff\xff\xff\xff",
    "temperature": b"\x00\x80",
}
"""Raw codes of `dbc/generic_pack.dbc`."""

BUS_CAPACITY_HZ: Final = 4000.0
"""Frame rate of a saturated 500 kbit/s bus."""

EachChange = Callable[[Event, Vehicle, Random], Iterable[Event]]


def each(change: EachChange, roles: tuple[str, ...] = ROLES, share: float = 1.0) -> FrameChange:
    """Replace each affected frame by `change(event)`."""

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
    """Sort frames by time (stable)."""
    return sorted(found, key=lambda event: event.at_s)


def both(*changes: FrameChange) -> FrameChange:
    """Compose changes."""

    def whole(found: list[Event], profile: Profile, vehicle: Vehicle, rng: Random) -> list[Event]:
        for change in changes:
            found = change(found, profile, vehicle, rng)
        return found

    return whole


def drop(share: float = 1.0, roles: tuple[str, ...] = ROLES) -> FrameChange:
    """Drop a share of the frames."""
    return each(lambda *_: (), roles, share)


def missing_for(seconds: float, roles: tuple[str, ...] = ROLES) -> FrameChange:
    """Drop all frames for a time [s]."""

    def whole(found: list[Event], profile: Profile, _v: Vehicle, _r: Random) -> list[Event]:
        first = profile.fault_s[0]
        return [
            event
            for event in found
            if not (first <= event.at_s < first + seconds and set(event.roles) & set(roles))
        ]

    return whole


def gate(off_s: float, period_s: float) -> FrameChange:
    """Drop all frames in the first `off_s` of every period [s]."""

    def whole(found: list[Event], profile: Profile, _v: Vehicle, _r: Random) -> list[Event]:
        first, last = profile.fault_s
        return [
            event
            for event in found
            if not (first <= event.at_s < last and (event.at_s - first) % period_s < off_s)
        ]

    return whole


def duplicate(share: float = 1.0, copies: int = 1) -> FrameChange:
    """Duplicate frames."""

    def more(event: Event, _v: Vehicle, _r: Random) -> list[Event]:
        return [event] + [replace(event, is_good=False)] * copies

    return each(more, share=share)


def shuffle(block_s: float) -> FrameChange:
    """Send the frames of each block of time in random order."""

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
    """Swap successive samples pairwise."""

    def whole(found: list[Event], profile: Profile, _v: Vehicle, _r: Random) -> list[Event]:
        first, last = profile.fault_s
        times = sorted({event.at_s for event in found if first <= event.at_s < last})
        other = {}
        for one, two in zip(times[::2], times[1::2], strict=False):
            other[one], other[two] = two, one
        return in_order([replace(event, at_s=other.get(event.at_s, event.at_s)) for event in found])

    return whole


def delay(seconds: float, jitter_s: float = 0.0, roles: tuple[str, ...] = ROLES) -> FrameChange:
    """Delay frames by a time and a random jitter [s]."""
    return each(lambda event, _v, rng: [event.later(seconds + rng.random() * jitter_s)], roles)


def hold(seconds: float) -> FrameChange:
    """Hold all frames back, and send them together every `seconds` [s]."""

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
    """Add frames at a rate."""

    def whole(found: list[Event], profile: Profile, _v: Vehicle, rng: Random) -> list[Event]:
        first, last = profile.fault_s
        last = last if seconds is None else min(last, first + seconds)
        # The rate is one of real time.
        every_s = profile.speed / rate_hz
        extra = [
            Event(first + number * every_s, make(number, rng))
            for number in range(int((last - first) / every_s))
        ]
        return in_order(found + extra)

    return whole


def foreign(number: int, rng: Random) -> can.Message:
    """Make a frame of another control unit."""
    frame_id = 0x100 + number % 0x200
    return can.Message(arbitration_id=frame_id, is_extended_id=False, data=rng.randbytes(8))


def wanted_noise(number: int, rng: Random) -> can.Message:
    """Make a frame of random data with an id of the pack."""
    frame_id = 0x400 + number % 3
    return can.Message(arbitration_id=frame_id, is_extended_id=False, data=rng.randbytes(6))


def error_frame(number: int, _rng: Random) -> can.Message:
    """Make a SocketCAN error frame: bus error, error passive, bus-off in turn."""
    kind = (0x08, 0x04, 0x40)[number % 3]
    data = bytes([0, 0x30 if kind == 0x04 else 0, 0, 0, 0, 0, 0x80, 0x80])
    return can.Message(arbitration_id=kind, is_error_frame=True, is_extended_id=False, data=data)


def _rule(event: Event, vehicle: Vehicle) -> ProtectionRule | None:
    return vehicle.messages[event.frame.arbitration_id].rule


def _protected(event: Event, vehicle: Vehicle, data: bytes, counter: int | None = None) -> bytes:
    rule = _rule(event, vehicle)
    if rule is None:
        return data
    return rule.protect(bytearray(data), rule.counter(data) if counter is None else counter)


def forged(
    counter: int, later_s: float, roles: tuple[str, ...] = ROLES, every: int = 1, copies: int = 1
) -> FrameChange:
    """Add frames of false values with valid CRC, as another node's.

    Parameters
    ----------
    counter : int
        Alive counter, relative to that of the true frame.
    later_s : float
        Time after the true frame, and between copies [s].
    roles : tuple of str
    every : int
        Forge one frame for each `every` true ones.
    copies : int
        Forged frames for each, with increasing counters.
    """

    def whole(found: list[Event], profile: Profile, vehicle: Vehicle, _rng: Random) -> list[Event]:
        first, last = profile.fault_s
        out, seen = list(found), 0
        for event in found:
            rule = _rule(event, vehicle) if event.roles else None
            is_hit = first <= event.at_s + min(later_s, 0.0) and event.at_s < last
            if rule is None or not is_hit or not set(event.roles) & set(roles):
                continue
            seen += 1
            if seen % every:
                continue
            data = bytearray(event.frame.data)
            data[2 if len(data) > 4 else 1] ^= 0x04  # 26 A, 26 V, 10 K
            for number in range(copies):
                forged_data = rule.protect(data, rule.counter(data) + counter + number)
                out.append(event.bad(data=forged_data).later(later_s * (1 + number)))
        return in_order(out)

    return whole


def old_drive(seconds: float, later_s: float) -> FrameChange:
    """Add the frames of an earlier part of the drive, with their own counters [s]."""

    def whole(found: list[Event], profile: Profile, vehicle: Vehicle, _rng: Random) -> list[Event]:
        first, last = profile.fault_s
        encoder, out = FrameEncoder(vehicle), list(found)
        for sample in _samples(profile)[0]:
            if not first <= sample.time_s + seconds < last:
                continue
            at_s = sample.time_s + seconds + later_s
            frames = encoder.encode(sample, math.nan)
            out.extend(Event(at_s, frame, is_good=False) for frame in frames)
        return in_order(out)

    return whole


def detail(_number: int, rng: Random) -> can.Message:
    """Make a frame with the id of SOC_DETAIL."""
    return can.Message(arbitration_id=0x5A1, is_extended_id=False, data=rng.randbytes(8))


def crc_wrong(share: float = 1.0, roles: tuple[str, ...] = ROLES) -> FrameChange:
    """Flip a bit of the CRC or of the values."""

    def turn(event: Event, _v: Vehicle, rng: Random) -> list[Event]:
        data = bytearray(event.frame.data)
        data[rng.choice((0, 1, len(data) - 1))] ^= 1 << rng.randrange(8)
        return [event.bad(data=bytes(data))]

    return each(turn, roles, share)


def counter_stuck() -> FrameChange:
    """Send a constant counter with a valid CRC."""

    def stuck_counter(event: Event, vehicle: Vehicle, _r: Random) -> list[Event]:
        return [event.bad(data=_protected(event, vehicle, bytes(event.frame.data), 5))]

    return each(stuck_counter)


def counter_jumps(share: float = 0.2) -> FrameChange:
    """Send random counters with a valid CRC; the values are usable."""

    def jump(event: Event, vehicle: Vehicle, rng: Random) -> list[Event]:
        data = _protected(event, vehicle, bytes(event.frame.data), rng.randrange(16))
        return [replace(event, frame=altered(event.frame, data=data))]

    return each(jump, share=share)


def cut(length: int) -> FrameChange:
    """Truncate frames to a length."""
    return each(lambda event, _v, _r: [event.bad(data=bytes(event.frame.data)[:length])])


def lengthened() -> FrameChange:
    """Pad frames to eight bytes."""

    def longer(event: Event, _v: Vehicle, _r: Random) -> list[Event]:
        data = bytes(event.frame.data).ljust(8, b"\x55")
        return [replace(event, frame=altered(event.frame, data=data))]

    return each(longer)


def not_available(role: str) -> FrameChange:
    """Send the code "not available" with valid CRC and counter."""

    def none(event: Event, vehicle: Vehicle, _r: Random) -> list[Event]:
        code = NOT_AVAILABLE[role]
        data = code + bytes(event.frame.data)[len(code) :]
        return [event.bad(data=_protected(event, vehicle, data))]

    return each(none, (role,))


def raw(payload: bytes, roles: tuple[str, ...] = ROLES, share: float = 1.0) -> FrameChange:
    """Send a payload (for frames without protection)."""
    return each(lambda event, _v, _r: [event.bad(data=payload)], roles, share)


def as_frame(**changes: object) -> FrameChange:
    """Send frames with other attributes: id, extended, remote, error."""
    return each(lambda event, _v, _r: [event.bad(**changes)])


def value(field: str, make: Callable[[float, Random], float], share: float = 1.0) -> ValueChange:
    """Change a field of the samples."""

    def change(sample: Sample, _first: Sample, rng: Random) -> Sample:
        if rng.random() >= share:
            return sample
        return sample._replace(**{field: make(getattr(sample, field), rng)})

    return change


def stuck(field: str) -> ValueChange:
    """Hold a field at its value at the start of the fault."""
    return lambda sample, first, _rng: sample._replace(**{field: getattr(first, field)})


def clock_steps(seconds: float) -> FrameChange:
    """Shift the replay clock permanently."""

    def whole(found: list[Event], profile: Profile, _v: Vehicle, _r: object) -> list[Event]:
        first = profile.fault_s[0]
        out, last_s = [], -1.0
        for event in found:
            if event.at_s >= first and event.at_s != last_s:
                # It follows the true clock and overrides it.
                last_s = event.at_s
                out.append(Event(event.at_s, clock_frame(round((event.at_s + seconds) * 1e6))))
            out.append(event)
        return out

    return whole


def clock_damaged() -> FrameChange:
    """Add a clock to every sample that is an hour off and has a wrong CRC."""

    def whole(found: list[Event], profile: Profile, _v: Vehicle, _r: object) -> list[Event]:
        first, last = profile.fault_s
        out = []
        for event in found:
            if first <= event.at_s < last and "current" in event.roles:
                wrong = clock_frame(round((event.at_s + 3600) * 1e6))
                data = bytearray(wrong.data)
                data[7] ^= 0xFF
                out.append(Event(event.at_s, altered(wrong, data=bytes(data))))
            out.append(event)
        return out

    return whole


def faster_current() -> FrameChange:
    """Send the current at 100 Hz and the voltage at 1 Hz."""

    def whole(found: list[Event], profile: Profile, vehicle: Vehicle, _r: object) -> list[Event]:
        first, last = profile.fault_s
        out: list[Event] = []
        made = 0
        for event in found:
            is_hit = first <= event.at_s
            if (
                is_hit
                and event.at_s < last
                and "voltage" in event.roles
                and event.at_s % 1.0 > 0.05
            ):
                continue
            if not (is_hit and "current" in event.roles):
                out.append(event)
                continue
            for part in range(10 if event.at_s < last else 1):
                rule = vehicle.messages[event.frame.arbitration_id].rule
                data = bytes(event.frame.data)
                if rule is not None:
                    data = rule.protect(bytearray(data), rule.counter(event.frame.data) + made)
                made += part < 9 and event.at_s < last
                out.append(replace(event.later(part * 0.01), frame=altered(event.frame, data=data)))
        return in_order(out)

    return whole

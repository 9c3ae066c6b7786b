"""A log as frames with times: what is played on the bus, and what a fault may change of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from random import Random
from typing import Final

import can

from cangauge._resources import shared_file
from cangauge.bus.encoder import FrameEncoder
from cangauge.bus.vehicle import Vehicle
from cangauge.estimate.offline import samples_of
from cangauge.estimate.validity import Sample
from cangauge.logs.read import read_log

LOG: Final = "leaf2012_reconstruction_10min.parquet"
ROLES: Final = ("current", "voltage", "temperature")


@dataclass(frozen=True)
class Profile:
    """A piece of the log, how it is played, and when the fault acts; all in seconds of the log.

    Parameters
    ----------
    name : str
    begin_s : float
        Where in the log it begins; the other times count from here [s].
    length_s : float
    fault_s : tuple of float
        The fault acts from … to; before it the delay line must have filled.
    speed : float
        1: the receive stamps are bus time. Else: REPLAY_CLOCK is.
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
        """How long it takes to play [s]."""
        return self.length_s / self.speed


# The log stands still for its first 90 s and then drives hard (±130 A) until its end.
FAST: Final = Profile("replay clock", 40.0, 430.0, (110.0, 170.0), 24.0)
REAL: Final = Profile("real time", 75.0, 190.0, (80.0, 100.0), 1.0)
SHORT: Final = Profile("replay clock, short", 55.0, 200.0, (90.0, 130.0), 25.0)
"""For tests: as `FAST`, but with little time to recover."""


@dataclass(frozen=True, slots=True)
class Event:
    """One frame to send.

    Parameters
    ----------
    at_s : float
        When, in time of the profile [s].
    frame : can.Message
    roles : tuple of str
        Of `ROLES`, what it carries; empty for foreign frames.
    is_good : bool
        Whether it carries what is true now and can be known as such: what an estimate may rest on.
    """

    at_s: float
    frame: can.Message
    roles: tuple[str, ...] = ()
    is_good: bool = True

    def bad(self, **changes: object) -> Event:
        """Return a copy whose frame has other attributes, and that is not to be trusted."""
        return replace(self, frame=altered(self.frame, **changes), is_good=False)

    def later(self, seconds: float) -> Event:
        """Return a copy that is sent later."""
        return replace(self, at_s=self.at_s + seconds)


ValueChange = Callable[[Sample, Sample, Random], Sample]
"""Makes a sample of a sample and the one that the fault began with."""
FrameChange = Callable[[list[Event], Profile, Vehicle, Random], list[Event]]


def altered(frame: can.Message, **changes: object) -> can.Message:
    """Return a copy of a frame with other attributes."""
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
    """Return the true SoC at the begin [%]."""
    return _samples(profile)[1]


def events(
    profile: Profile,
    vehicle: Vehicle,
    *,
    values: ValueChange | None = None,
    untrue: tuple[str, ...] = (),
    rng: Random | None = None,
) -> list[Event]:
    """Return the frames of a profile.

    Parameters
    ----------
    profile : Profile
    vehicle : Vehicle
    values : callable, optional
        Changes the samples within the fault's time; frames are made after, with the counters and
        CRC that belong to them.
    untrue : tuple of str
        The roles whose frames cannot be trusted then.
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
        told = values(sample, begin, rng) if values is not None and is_hit else sample
        for frame in encoder.encode(told, math.nan):
            carries = roles.get(frame.arbitration_id, ())
            is_bad = is_hit and any(role in untrue for role in carries)
            made.append(Event(sample.time_s, frame, carries, not is_bad))
    return made

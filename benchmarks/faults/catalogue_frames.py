"""Faults of what comes over the bus."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from random import Random

from cangauge.bus.time_source import ClockFrames
from cangauge.bus.vehicle import Vehicle
from faults import alter
from faults.alter import both, delay, drop, flood, missing_for, stuck, value
from faults.drive import REAL, ROLES, Event, FrameChange, Profile, altered
from faults.fault import Fault

CURRENT, VOLTAGE, TEMPERATURE = (("current",), ("voltage",), ("temperature",))


def clock_steps(seconds: float) -> FrameChange:
    """Set the replay clock, for good: what follows has other times."""

    def whole(found: list[Event], profile: Profile, _v: Vehicle, _r: object) -> list[Event]:
        clock, first = ClockFrames(), profile.fault_s[0]
        out, last_s = [], -1.0
        for event in found:
            if event.at_s >= first and event.at_s != last_s:
                # It follows the true clock at once, and so stands for it.
                last_s = event.at_s
                out.append(Event(event.at_s, clock.at(round((event.at_s + seconds) * 1e6))))
            out.append(event)
        return out

    return whole


def clock_damaged() -> FrameChange:
    """Send besides every sample a clock that is wrong by an hour and has a wrong CRC."""

    def whole(found: list[Event], profile: Profile, _v: Vehicle, _r: object) -> list[Event]:
        clock, (first, last) = ClockFrames(), profile.fault_s
        out = []
        for event in found:
            if first <= event.at_s < last and "current" in event.roles:
                wrong = clock.at(round((event.at_s + 3600) * 1e6))
                data = bytearray(wrong.data)
                data[7] ^= 0xFF
                out.append(Event(event.at_s, altered(wrong, data=bytes(data))))
            out.append(event)
        return out

    return whole


def faster_current() -> FrameChange:
    """Repeat every current nine times in the tenth of a second after it; voltage once a second."""

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
        return alter.in_order(out)

    return whole


def _either(rng: Random, low: float, high: float) -> float:
    """Return a number of that size, of either sign."""
    return rng.choice((-1.0, 1.0)) * rng.uniform(low, high)


def _floats(current_a: float, voltage_v: float) -> bytes:
    return struct.pack("<ff", current_a, voltage_v)


LOSS = [
    Fault(f"drop {share} %", f"{share} % of all frames lost at random", frames=drop(share / 100))
    for share in (1, 5, 20, 50)
]

TIMES = [
    Fault("duplicate", "every frame twice", frames=alter.duplicate()),
    Fault("duplicate at times", "20 % of the frames five times", frames=alter.duplicate(0.2, 4)),
    Fault("swap", "every two successive samples exchanged", frames=alter.swap_neighbours()),
    Fault("reorder", "frames of each half second in random order", frames=alter.shuffle(0.5)),
    Fault("jitter", "every frame 0–80 ms late", frames=delay(0.0, 0.08)),
    Fault("jitter, real time", "every frame 0–80 ms late", REAL, frames=delay(0.0, 0.08)),
    Fault("voltage late", "voltage 150 ms after its current", frames=delay(0.15, 0.0, VOLTAGE)),
    Fault("delay", "all frames 1 s late", REAL, frames=delay(1.0)),
    Fault(
        "stall and burst", "frames held for 5 s, then sent at once", REAL, frames=alter.hold(5.0)
    ),
    Fault("mixed rates", "current at 100 Hz, voltage at 1 Hz", frames=faster_current()),
    Fault(
        "burst of others",
        "4,000 foreign frames/s besides (bus capacity)",
        REAL,
        frames=flood(alter.foreign),
    ),
    Fault(
        "burst of wanted ids",
        "1,000 frames/s of noise under the pack's ids besides",
        REAL,
        frames=flood(alter.wanted_noise, 1000.0),
    ),
]

PROTECTION = [
    Fault("CRC wrong, all", "a bit turned in every frame", frames=alter.crc_wrong()),
    Fault("CRC wrong, some", "a bit turned in 30 % of the frames", frames=alter.crc_wrong(0.3)),
    Fault("CRC wrong, current", "a bit turned in every current", REAL,
          frames=alter.crc_wrong(1.0, CURRENT)),
    Fault("counter stuck", "every frame with counter 5 and a valid CRC", REAL,
          frames=alter.counter_stuck()),
    Fault("counter jumps", "20 % of the counters random, CRC valid", frames=alter.counter_jumps()),
    Fault("DLC short", "frames of 3 bytes", frames=alter.cut(3)),
    Fault("DLC 0", "frames without data", frames=alter.cut(0)),
    Fault("DLC long", "frames of 8 bytes, the first ones right", frames=alter.lengthened()),
    Fault("wrong id", "all frames under an id that is one higher", REAL, frames=alter.each(
        lambda event, _v, _r: [event.bad(arbitration_id=event.frame.arbitration_id + 0x10)])),
    Fault("extended id", "all frames with extended ids", REAL,
          frames=alter.as_frame(is_extended_id=True)),
    Fault("remote frames", "all frames as remote frames", REAL,
          frames=alter.as_frame(is_remote_frame=True, data=b"")),
]  # fmt: skip

VALUES = [
    *[
        Fault(f"{role} not available", "its code, CRC valid", frames=alter.not_available(role))
        for role in ROLES
    ],
    Fault("current not available, real time", "its code for that, CRC valid", REAL,
          frames=alter.not_available("current")),
    Fault("current out of range", "±5,000 A, CRC valid", REAL, untrue=CURRENT,
          values=value("current_a", lambda _a, rng: rng.choice((-5e3, 5e3)))),
    Fault("current spikes", "3 % of the currents ±5,000 A", untrue=(),
          values=value("current_a", lambda _a, rng: rng.choice((-5e3, 5e3)), 0.03)),
    Fault("voltage 0", "0 V, CRC valid", REAL, untrue=VOLTAGE,
          values=value("voltage_v", lambda _v, _r: 0.0)),
    Fault("voltage out of range", "4,000 V, CRC valid", untrue=VOLTAGE,
          values=value("voltage_v", lambda _v, _r: 4e3)),
    Fault("temperature out of range", "200 °C, CRC valid", REAL, untrue=TEMPERATURE,
          values=value("temperature_c", lambda _t, _r: 200.0)),
    Fault("current implausibly quick", "100–300 A off at every sample", untrue=CURRENT,
          values=value("current_a", lambda a, rng: a + _either(rng, 100, 300))),
    Fault("voltage implausibly quick", "30–60 V off at every sample", untrue=VOLTAGE,
          values=value("voltage_v", lambda v, rng: v + _either(rng, 30, 60))),
    Fault("temperature implausibly quick", "40 K up and down", untrue=TEMPERATURE,
          values=value("temperature_c", lambda t, rng: t + rng.choice((-40.0, 40.0)))),
    Fault("current stuck", "held at its value, counter and CRC go on", values=stuck("current_a")),
    Fault("voltage stuck", "held at its value, counter and CRC go on", values=stuck("voltage_v")),
    Fault("temperature stuck", "held at its value, counter and CRC go on",
          values=stuck("temperature_c")),
    Fault("current dead", "0 A while it drives", values=value("current_a", lambda *_: 0.0)),
    Fault("current turned", "the sign turned", values=value("current_a", lambda a, _r: -a)),
    Fault("NaN", "IEEE floats: NaN in every field", vehicle="float",
          frames=both(alter.raw(_floats(math.nan, math.nan), CURRENT),
                      alter.raw(struct.pack("<f", math.nan), TEMPERATURE))),
    Fault("NaN at times", "IEEE floats: 30 % of the currents NaN", vehicle="float",
          frames=alter.raw(_floats(math.nan, 380.0), CURRENT, 0.3)),
    Fault("infinity", "IEEE floats: ±infinity and 1e38", vehicle="float",
          frames=both(alter.raw(_floats(math.inf, -math.inf), CURRENT, 0.5),
                      alter.raw(_floats(1e38, 1e38), CURRENT, 0.5),
                      alter.raw(struct.pack("<f", math.inf), TEMPERATURE))),
]  # fmt: skip

MISSING = [
    *[Fault(f"{role} missing", "no such frame for 20 s", REAL, frames=drop(1.0, (role,)))
      for role in ROLES],
    *[Fault(f"{role} missing, long", "no such frame for 60 s of the log", frames=drop(1.0, (role,)))
      for role in ROLES],
    Fault("all missing, short", "no frame for 1.5 s", REAL, frames=missing_for(1.5)),
    Fault("all missing", "no frame for 20 s", REAL, frames=drop()),
    Fault("all missing, again and again", "no frame in 4 of 8 seconds", REAL,
          frames=alter.gate(4.0, 8.0)),
    Fault("all missing, long", "no frame for 60 s of the log", frames=drop()),
]  # fmt: skip

CLOCK = [
    Fault("clock back 0.5 s", "replay clock set back by 0.5 s", frames=clock_steps(-0.5)),
    Fault("clock back 1 h", "replay clock set back by an hour", frames=clock_steps(-3600.0)),
    Fault("clock forward 1.5 s", "replay clock set forward by 1.5 s", frames=clock_steps(1.5)),
    Fault("clock forward 1 h", "replay clock set forward by an hour", frames=clock_steps(3600.0)),
    Fault("clock damaged", "clocks an hour wrong, CRC wrong, besides", frames=clock_damaged()),
]

ERRORS = [
    Fault("error frames", "200 error frames/s besides: bus error, passive, bus-off", REAL,
          frames=flood(alter.error_frame, 200.0)),
]  # fmt: skip

ALL = [*LOSS, *TIMES, *PROTECTION, *VALUES, *MISSING, *CLOCK, *ERRORS]

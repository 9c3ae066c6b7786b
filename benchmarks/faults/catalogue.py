"""All named faults, grouped by what they disturb.

To add a fault, append a `Fault` to the list of its kind: name, description, and one or more of
`values` (changes of samples), `frames` (changes of frames, see `frames`), `plan` (actions on the
service, the bus or the machine, see `actions`) and `target` (changed stamps, see `stamps`).
"""

from __future__ import annotations

import math
import signal
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Final

from cangauge.types import Reason
from faults import actions as do
from faults import frames as change
from faults import stamps
from faults.bench import Bench
from faults.fault import UNDISTURBED, Fault, Need, at, during
from faults.frames import REAL, ROLES, SHORT

CURRENT, VOLTAGE, TEMPERATURE = (("current",), ("voltage",), ("temperature",))


def _either(rng: Random, low: float, high: float) -> float:
    """Return a number between `low` and `high` with random sign."""
    return rng.choice((-1.0, 1.0)) * rng.uniform(low, high)


def _floats(current_a: float, voltage_v: float) -> bytes:
    return struct.pack("<ff", current_a, voltage_v)


LOSS = [
    Fault(
        f"drop {share} %",
        f"{share} % of all frames lost at random",
        frames=change.drop(share / 100),
    )
    for share in (1, 5, 20, 50)
]

TIMES = [
    Fault("duplicate", "every frame twice", frames=change.duplicate()),
    Fault("duplicate at times", "20 % of the frames five times", frames=change.duplicate(0.2, 4)),
    Fault("swap", "successive samples swapped pairwise", frames=change.swap_neighbours()),
    Fault("reorder", "frames of each 0.5 s in random order", frames=change.shuffle(0.5)),
    Fault("jitter", "every frame 0–80 ms late", frames=change.delay(0.0, 0.08)),
    Fault("jitter, real time", "every frame 0–80 ms late", REAL, frames=change.delay(0.0, 0.08)),
    Fault(
        "voltage late", "voltage 150 ms after its current", frames=change.delay(0.15, 0.0, VOLTAGE)
    ),
    Fault("delay", "all frames 1 s late", REAL, frames=change.delay(1.0)),
    Fault(
        "stall and burst", "frames held for 5 s, then sent at once", REAL, frames=change.hold(5.0)
    ),
    Fault("mixed rates", "current at 100 Hz, voltage at 1 Hz", frames=change.faster_current()),
    Fault(
        "burst of others",
        "4,000 foreign frames/s added (bus capacity)",
        REAL,
        frames=change.flood(change.foreign),
    ),
    Fault(
        "burst of wanted ids",
        "1,000 frames/s of random data with the pack's ids added",
        REAL,
        frames=change.flood(change.wanted_noise, 1000.0),
    ),
]

PROTECTION = [
    Fault("CRC wrong, all", "a bit flipped in every frame", frames=change.crc_wrong()),
    Fault("CRC wrong, some", "a bit flipped in 30 % of the frames", frames=change.crc_wrong(0.3)),
    Fault("CRC wrong, current", "a bit flipped in every current frame", REAL,
          frames=change.crc_wrong(1.0, CURRENT)),
    Fault("counter stuck", "every frame with counter 5 and a valid CRC", REAL,
          frames=change.counter_stuck()),
    Fault("counter jumps", "20 % of the counters random, CRC valid", frames=change.counter_jumps()),
    Fault("DLC short", "frames of 3 bytes", frames=change.cut(3)),
    Fault("DLC 0", "frames without data", frames=change.cut(0)),
    Fault("DLC long", "frames padded to 8 bytes", frames=change.lengthened()),
    Fault("wrong id", "all frames with another id", REAL, frames=change.each(
        lambda event, _v, _r: [event.bad(arbitration_id=event.frame.arbitration_id + 0x10)])),
    Fault("extended id", "all frames with extended ids", REAL,
          frames=change.as_frame(is_extended_id=True)),
    Fault("remote frames", "all frames as remote frames", REAL,
          frames=change.as_frame(is_remote_frame=True, data=b"")),
]  # fmt: skip

VALUES = [
    *[
        Fault(f"{role} not available", "code for not available, CRC valid",
              frames=change.not_available(role))
        for role in ROLES
    ],
    Fault("current not available, real time", "code for not available, CRC valid", REAL,
          frames=change.not_available("current")),
    Fault("current out of range", "±5,000 A, CRC valid", REAL, untrusted=CURRENT,
          values=change.value("current_a", lambda _a, rng: rng.choice((-5e3, 5e3)))),
    Fault("current spikes", "3 % of the currents ±5,000 A", untrusted=(),
          values=change.value("current_a", lambda _a, rng: rng.choice((-5e3, 5e3)), 0.03)),
    Fault("voltage 0", "0 V, CRC valid", REAL, untrusted=VOLTAGE,
          values=change.value("voltage_v", lambda _v, _r: 0.0)),
    Fault("voltage out of range", "4,000 V, CRC valid", untrusted=VOLTAGE,
          values=change.value("voltage_v", lambda _v, _r: 4e3)),
    Fault("temperature out of range", "200 °C, CRC valid", REAL, untrusted=TEMPERATURE,
          values=change.value("temperature_c", lambda _t, _r: 200.0)),
    Fault("current implausibly quick", "100–300 A off at every sample", untrusted=CURRENT,
          values=change.value("current_a", lambda a, rng: a + _either(rng, 100, 300))),
    Fault("voltage implausibly quick", "30–60 V off at every sample", untrusted=VOLTAGE,
          values=change.value("voltage_v", lambda v, rng: v + _either(rng, 30, 60))),
    Fault("temperature implausibly quick", "40 K up and down", untrusted=TEMPERATURE,
          values=change.value("temperature_c", lambda t, rng: t + rng.choice((-40.0, 40.0)))),
    Fault("current stuck", "held at its value; counter and CRC valid",
          values=change.stuck("current_a")),
    Fault("voltage stuck", "held at its value; counter and CRC valid",
          values=change.stuck("voltage_v")),
    Fault("temperature stuck", "held at its value; counter and CRC valid",
          values=change.stuck("temperature_c")),
    Fault("current dead", "0 A while driving", values=change.value("current_a", lambda *_: 0.0)),
    Fault("current turned", "sign inverted", values=change.value("current_a", lambda a, _r: -a)),
    Fault("NaN", "IEEE floats: NaN in every field", vehicle="float",
          frames=change.both(change.raw(_floats(math.nan, math.nan), CURRENT),
                      change.raw(struct.pack("<f", math.nan), TEMPERATURE))),
    Fault("NaN at times", "IEEE floats: 30 % of the currents NaN", vehicle="float",
          frames=change.raw(_floats(math.nan, 380.0), CURRENT, 0.3)),
    Fault("infinity", "IEEE floats: ±infinity and 1e38", vehicle="float",
          frames=change.both(change.raw(_floats(math.inf, -math.inf), CURRENT, 0.5),
                      change.raw(_floats(1e38, 1e38), CURRENT, 0.5),
                      change.raw(struct.pack("<f", math.inf), TEMPERATURE))),
]  # fmt: skip

MISSING = [
    *[Fault(f"{role} missing", "no such frame for 20 s", REAL, frames=change.drop(1.0, (role,)))
      for role in ROLES],
    *[Fault(f"{role} missing, long", "no such frame for 60 s of the log",
            frames=change.drop(1.0, (role,)))
      for role in ROLES],
    Fault("all missing, short", "no frame for 1.5 s", REAL, frames=change.missing_for(1.5)),
    Fault("all missing", "no frame for 20 s", REAL, frames=change.drop()),
    Fault("all missing, again and again", "no frame in 4 of 8 seconds", REAL,
          frames=change.gate(4.0, 8.0)),
    Fault("all missing, long", "no frame for 60 s of the log", frames=change.drop()),
]  # fmt: skip

CLOCK = [
    Fault("clock back 0.5 s", "replay clock set back by 0.5 s", frames=change.clock_steps(-0.5)),
    Fault("clock back 1 h", "replay clock set back by an hour", frames=change.clock_steps(-3600.0)),
    Fault(
        "clock forward 1.5 s", "replay clock set forward by 1.5 s", frames=change.clock_steps(1.5)
    ),
    Fault(
        "clock forward 1 h",
        "replay clock set forward by an hour",
        frames=change.clock_steps(3600.0),
    ),
    Fault(
        "clock damaged",
        "clock frames an hour off with wrong CRC added",
        frames=change.clock_damaged(),
    ),
]

ERRORS = [
    Fault("error frames", "200 error frames/s added: bus error, passive, bus-off", REAL,
          frames=change.flood(change.error_frame, 200.0)),
]  # fmt: skip

NEEDS_VCAN: Final = frozenset[Need]({"vcan"})

INTERFACE = [
    Fault("interface down", "down for 1 s", REAL, plan=do.down_for(1.0), needs=NEEDS_VCAN),
    Fault("interface down, long", "down for 15 s", REAL, plan=do.down_for(15.0), needs=NEEDS_VCAN),
    Fault("interface flaps", "down and up ten times in 10 s", REAL, plan=do.down_for(0.5, 10, 0.5),
          needs=NEEDS_VCAN),
    Fault("adapter unplugged", "interface removed, created again after 5 s", REAL,
          plan=do.unplugged_for(5.0), needs=NEEDS_VCAN),
    Fault("queue full", "interface accepts no frame for 10 s", REAL, plan=do.queue_full_for(10.0),
          needs=NEEDS_VCAN),
]  # fmt: skip

MACHINE_CLOCK = [
    Fault("machine's clock back", "set back by an hour", REAL, plan=do.clock_set(-3600.0),
          needs=frozenset({"vcan", "root", "alone"}), recovers=True),
    Fault("machine's clock forward", "set forward by an hour", REAL, plan=do.clock_set(3600.0),
          needs=frozenset({"vcan", "root", "alone"}), recovers=True),
]  # fmt: skip

RESTARTS = [
    Fault("SIGTERM, restart", "stopped and started again", REAL, plan=at(do.BEGIN, Bench.restart),
          needs=frozenset({"state"})),
]  # fmt: skip

_TWO: Final = Reason.DUPLICATE_SENDER
OTHERS = [
    Fault("forged ahead", "false values with valid CRC, 10 ms before the true frames", REAL,
          frames=change.forged(0, -0.01), reports=_TWO),
    Fault("forged after", "false values with the next counter, 20 ms after", REAL,
          frames=change.forged(1, 0.02), reports=_TWO),
    Fault("forged between", "false values with a counter of their own", REAL,
          frames=change.forged(7, 0.03), reports=_TWO),
    Fault("forged current", "false currents, 10 ms before the true ones", REAL,
          frames=change.forged(0, -0.01, CURRENT), reports=_TWO),
    Fault("forged voltage", "false voltages, 10 ms before the true ones", REAL,
          frames=change.forged(0, -0.01, VOLTAGE), reports=_TWO),
    Fault("forged flood", "ten false frames for each true one", REAL,
          frames=change.forged(3, 0.004, copies=10), reports=_TWO),
    Fault("old drive", "frames of 8 s ago sent again, between the true ones", REAL,
          frames=change.old_drive(8.0, 0.04), reports=_TWO),
    Fault("own id", "10 frames/s with the id of SOC_DETAIL", REAL,
          frames=change.flood(change.detail, 10.0), reports=_TWO),
]  # fmt: skip

_TIME: Final = Reason.TIME_UNCERTAIN
STAMPS = [
    Fault("stamps still", "receive stamps stand still", REAL, target=stamps.still, reports=_TIME),
    Fault("stamps backwards", "receive stamps run backwards slowly", REAL,
          target=stamps.backwards, reports=_TIME),
    Fault("stamps random", "receive stamps ± 0.9 s at random", REAL,
          target=stamps.irregular, reports=_TIME),
    Fault("stamps fast", "receive stamps run ten times faster", REAL,
          target=stamps.fast, reports=_TIME),
    Fault("stamps zero", "no receive stamps: all 0", REAL, target=stamps.zero, reports=_TIME),
    Fault("stamps forward", "the stamps' clock set forward by a day", REAL,
          target=stamps.forward, recovers=True),
    Fault("stamps back", "the stamps' clock set back by a day", REAL,
          target=stamps.back, recovers=True),
    Fault("stamps from 1970", "the stamps' clock set forward by 53 years", REAL,
          target=stamps.from_1970, recovers=True),
]  # fmt: skip

CONFIG = [
    Fault("reload, good", "SIGHUP with another max_gap_s", REAL, plan=at(do.BEGIN, do.good_config)),
    Fault("reload, unknown key", "SIGHUP with an unknown key", REAL,
          plan=at(do.BEGIN, do.unknown_key)),
    Fault("reload, not TOML", "SIGHUP with a file that is not TOML", REAL,
          plan=do.broken_config("model = [[[\n\x00")),
    Fault("reload, empty", "SIGHUP with an empty file", REAL, plan=do.broken_config("")),
    Fault("reload, gone", "SIGHUP with the file removed", REAL, plan=do.broken_config(None)),
    Fault("reload, often", "SIGHUP twenty times in 4 s", REAL, plan=at(do.BEGIN, do.reload_often)),
    Fault("reload, large DBC", "SIGHUP with a lawful DBC of 3.9 MB", REAL,
          plan=at(do.BEGIN, do.large_dbc)),
    Fault("reload, huge resistance", "SIGHUP with a model of R1 = -1e9 ohm", REAL,
          plan=at(do.BEGIN, do.impossible_model(
              lambda model: model["coefficients"]["R1"].update(value=-1e9)))),
    Fault("reload, negative voltage", "SIGHUP with a model of k0 = -0.5 V", REAL,
          plan=at(do.BEGIN, do.impossible_model(
              lambda model: model["coefficients"]["k0"].update(value=-0.5)))),
]  # fmt: skip

MACHINE = [
    Fault("process paused", "SIGSTOP for 10 s, then SIGCONT", REAL,
          plan=during((do.BEGIN, Bench.suspend), (0.55, Bench.resume))),
    Fault("paused in a burst", "SIGSTOP for 5 s, 2,000 foreign frames/s for 10 s", REAL,
          plan=during((do.BEGIN, Bench.suspend), (0.3, Bench.resume)),
          frames=change.flood(change.foreign, 2000.0, 10.0)),
    Fault("two services", "a second service with the same ids on the bus", REAL,
          plan=at(do.BEGIN, do.second_service), reports=_TWO),
    Fault("two services, one state", "a second service with the same --state", REAL,
          plan=at(do.BEGIN, do.same_files("state")), needs=frozenset({"state"})),
    Fault("two services, one recording", "a second service with the same --record", REAL,
          plan=at(do.BEGIN, do.same_files("record")), config={"record": "shared.log"}),
    Fault("slow HTTP clients", "64 connections with half a request; a health probe each second",
          REAL, plan=at(do.BEGIN, do.slow_clients),
          # Of its own: those of lines that differ in the port alone have one name.
          config={"http": "127.0.0.1:0", "status_socket": "status.sock"}),
    Fault("slow consumer", "a listener that never reads", REAL,
          plan=at(do.BEGIN, do.deaf_listener)),
    Fault("SIGUSR1, SIGPIPE", "signals without meaning to the service", REAL, plan=during(
        (do.BEGIN, lambda bench: bench.service.signal(signal.SIGPIPE)),
        (0.5, lambda bench: bench.service.signal(signal.SIGWINCH)))),
]  # fmt: skip

UDP_PACKETS = [
    Fault(
        "garbage packets",
        "2,000 packets that are not frames",
        REAL,
        plan=at(do.BEGIN, do.garbage),
    ),
]

_STATE_DAMAGE: list[tuple[str, str, Callable[[Bench], None]]] = [
    ("empty", "0 bytes", do.spoil(lambda _d, _r: b"")),
    ("one byte", "first byte only", do.spoil(lambda data, _r: data[:1])),
    ("half", "first half only", do.spoil(lambda data, _r: data[: len(data) // 2])),
    ("last byte", "last two bytes missing", do.spoil(lambda data, _r: data[:-2])),
    ("zeros", "zeros, same length", do.spoil(lambda data, _r: bytes(len(data)))),
    ("noise", "random bytes, same length", do.spoil(lambda data, rng: rng.randbytes(len(data)))),
    ("bit", "one bit flipped", do.spoil(do.flip)),
    ("twice", "content twice", do.spoil(lambda data, _r: data + data)),
    ("rubbish after", "random bytes appended", do.spoil(lambda d, rng: d + rng.randbytes(50))),
    ("numbers null", "every number null", do.spoil(do.numbers(lambda _n: None))),
    ("numbers NaN", "every number NaN", do.spoil(do.numbers(lambda _n: float("nan")))),
    ("numbers huge", "every number 1e308", do.spoil(do.numbers(lambda _n: 1e308))),
    ("numbers shifted", "every number plus 30", do.spoil(do.numbers(lambda number: number + 30.0))),
    ("numbers text", "every number a text", do.spoil(do.numbers(str))),
    ("keys missing", "half of the keys missing", do.spoil(do.without_keys)),
    ("not an object", "a JSON list", do.spoil(lambda _d, _r: b"[1, 2, 3]")),
    ("deep", "100,000 nested lists", do.spoil(lambda _d, _r: b"[" * 100_000)),
    ("large", "64 MB of spaces", do.spoil(lambda _d, _r: b" " * (64 << 20))),
    ("UTF-16", "another encoding",
     do.spoil(lambda data, _r: data.decode("utf-8", "replace").encode("utf-16"))),
    ("folder", "a folder instead", do.instead(Path.mkdir)),
    ("loop", "a link to itself", do.instead(lambda path: path.symlink_to(path))),
    ("gone", "removed", do.instead(lambda _path: None)),
]  # fmt: skip

# In real time: by the replay clock a start takes half a minute of the log.
STATE_FILE = [
    Fault(f"state: {name}", f"state file: {done}; restarted", REAL, plan=at(0.0, do),
          needs=frozenset({"state"}))
    for name, done, do in _STATE_DAMAGE
]  # fmt: skip

ON_ANY_BUS: Final = [
    *LOSS, *TIMES, *PROTECTION, *VALUES, *MISSING, *CLOCK, *ERRORS, *OTHERS, *RESTARTS, *CONFIG,
    *MACHINE, *STATE_FILE,
]  # fmt: skip
ON_UDP: Final = [*ON_ANY_BUS, *STAMPS, *UDP_PACKETS]
_ON_KERNEL: Final = ("error frames", "remote frames")
"""Faults that SocketCAN handles differently: run on vcan too."""
_VCAN_ONLY: Final = [*INTERFACE, *MACHINE_CLOCK]
ON_VCAN: Final = [*_VCAN_ONLY, *(fault for fault in ON_ANY_BUS if fault.name in _ON_KERNEL)]
"""Faults that run on vcan by default; all of `ON_ANY_BUS` can."""

EVERYTHING: Final = {fault.name: fault for fault in [*ON_UDP, *_VCAN_ONLY]}


def undisturbed(like: Fault) -> Fault:
    """Return the run without a fault that another one is compared with."""
    return Fault(UNDISTURBED, "nothing", like.profile, config=like.config, vehicle=like.vehicle)


def shortened(fault: Fault) -> Fault:
    """Return a fault of the replay clock with the short profile, for tests."""
    return replace(fault, profile=SHORT)

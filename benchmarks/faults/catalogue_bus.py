"""Faults of the bus's interface, the disk and the machine's clock: on vcan, with root's rights."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Final, Literal

from faults.drive import REAL
from faults.fault import Fault, Need, Plan, at
from faults.line import run
from faults.stage import Stage

DISK_KB: Final = 256
"""A disk that a state fits on several times [kB], until it is filled."""

VCAN: Final = frozenset[Need]({"vcan"})
STATE: Final = frozenset[Need]({"vcan", "root", "state"})


def down_for(seconds: float, times: int = 1, up_s: float = 0.0) -> Plan:
    """Take the interface down and up again."""

    def do(stage: Stage) -> None:
        with stage.without_bus():
            for _ in range(times):
                stage.line.link("set DEV down")
                stage.wait(seconds)
                stage.line.link("set DEV up")
                stage.wait(up_s)

    return at(0.0, do)


def unplugged_for(seconds: float) -> Plan:
    """Remove the interface and make it again."""

    def do(stage: Stage) -> None:
        with stage.without_bus():
            stage.line.remove()
            stage.wait(seconds)
            stage.line.create()

    return at(0.0, do)


def queue_full_for(seconds: float) -> Plan:
    """Let the interface refuse every frame: nobody acknowledges, the queue is full."""

    def do(stage: Stage) -> None:
        with stage.without_bus():
            run(["tc", "qdisc", "add", "dev", stage.line.channel, "root", "pfifo", "limit", "0"])
            stage.wait(seconds)
            run(["tc", "qdisc", "del", "dev", stage.line.channel, "root"])

    return at(0.0, do)


def small_disk(how: Literal["full", "read-only"]) -> Plan:
    """Put the state on a file system of its own, spoil it, then kill and start again."""

    def do(stage: Stage) -> None:
        folder = str(stage.state_path.parent)
        kept = stage.state_path.read_bytes() if stage.state_path.exists() else b""
        run(["mount", "-t", "tmpfs", "-o", f"size={DISK_KB}k", "tmpfs", folder])
        stage.at_end(lambda: run(["umount", "-l", folder]))
        if kept:
            stage.state_path.write_bytes(kept)
        if how == "read-only":
            run(["mount", "-o", "remount,ro", folder])
        else:
            _fill(Path(folder, "ballast"))
        stage.wait(5.0)
        stage.kill_and_restart()

    return at(0.0, do)


def _fill(path: Path) -> None:
    try:
        with path.open("wb") as file:
            for _ in range(2 * DISK_KB):
                file.write(bytes(1024))
                file.flush()
    except OSError:
        return  # full: as wanted


def clock_set(seconds: float) -> Plan:
    """Set the machine's clock."""

    def turn(by_s: float) -> None:
        time.clock_settime(time.CLOCK_REALTIME, time.time() + by_s)

    def do(stage: Stage) -> None:
        turn(seconds)
        stage.at_end(lambda: turn(-seconds))

    return at(0.0, do)


INTERFACE = [
    Fault("interface down", "down for 1 s", REAL, plan=down_for(1.0), needs=VCAN),
    Fault("interface down, long", "down for 15 s", REAL, plan=down_for(15.0), needs=VCAN),
    Fault("interface flaps", "down and up ten times in 10 s", REAL, plan=down_for(0.5, 10, 0.5),
          needs=VCAN),
    Fault("adapter unplugged", "interface removed, made again after 5 s", REAL,
          plan=unplugged_for(5.0), needs=VCAN),
    Fault("queue full", "the interface takes no frame for 10 s", REAL, plan=queue_full_for(10.0),
          needs=VCAN),
]  # fmt: skip

DISK = [
    Fault("disk full", "state on a full file system, then killed and started again", REAL,
          plan=small_disk("full"), needs=STATE),
    Fault("state read-only", "state on a read-only file system, then killed and started again",
          REAL, plan=small_disk("read-only"), needs=STATE),
]  # fmt: skip

CLOCK = [
    Fault("machine's clock back", "set back by an hour", REAL, plan=clock_set(-3600.0),
          needs=frozenset({"vcan", "root", "alone"})),
    Fault("machine's clock forward", "set forward by an hour", REAL, plan=clock_set(3600.0),
          needs=frozenset({"vcan", "root", "alone"})),
]  # fmt: skip

ALL = [*INTERFACE, *DISK, *CLOCK]

"""Faults of the service's process and of what surrounds it."""

from __future__ import annotations

import signal
import socket
from random import Random
from typing import Final

from faults.alter import flood, foreign
from faults.drive import REAL, Profile
from faults.fault import Action, Fault, Plan, at, during
from faults.line import Wire
from faults.stage import Stage

BEGIN: Final = 0.05


def kills(number: int) -> Plan:
    """Kill and start it again, at random moments of the fault's time."""

    def plan(profile: Profile, rng: Random) -> list[Action]:
        first, last = profile.fault_s
        moments = [rng.uniform(first, last) for _ in range(number)]
        return [Action(moment, Stage.kill_and_restart) for moment in moments]

    return plan


def broken_config(text: str | None) -> Plan:
    """Put this in the place of the configuration (None: remove it), and reload."""

    def do(stage: Stage) -> None:
        if text is None:
            stage.config_path.unlink()
        else:
            stage.config_path.write_text(text)
        stage.reload()

    return at(BEGIN, do)


def good_config(stage: Stage) -> None:
    """Change a setting, and reload."""
    stage.write_config(max_gap_s=3.0)
    stage.reload()


def unknown_key(stage: Stage) -> None:
    """Add a key that the configuration does not have, and reload."""
    stage.write_config(no_such_key=1)
    stage.reload()


def reload_often(stage: Stage) -> None:
    """Reload twenty times in a row."""
    for _ in range(20):
        stage.reload()
        stage.wait(0.2)


def second_service(stage: Stage) -> None:
    """Start a second service with the same configuration."""
    other = stage.another_service("second")
    stage.others.append(other)
    other.start()


def deaf_listener(stage: Stage) -> None:
    """Open the bus and never read."""
    deaf = Wire(stage.line, published_only=False)
    stage.at_end(deaf.close)


def garbage(stage: Stage) -> None:
    """Send packets that are no frames to the bus's address."""
    if stage.line.is_vcan:
        return
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        for number in range(2000):
            packet = stage.rng.randbytes(number % 200)
            sender.sendto(packet, (stage.line.channel, int(stage.line.options["port"])))
            if number % 20 == 0:
                stage.wait(0.2)


RESTARTS = [
    Fault("SIGTERM, restart", "ended and started again", REAL, plan=at(BEGIN, Stage.restart),
          needs=frozenset({"state"})),
    Fault("SIGKILL, restart", "killed at a random moment, a fresh interpreter started", REAL,
          plan=kills(1), needs=frozenset({"state"}), cold=True),
    Fault("SIGKILL three times", "killed at random moments and started again", REAL, plan=kills(3),
          needs=frozenset({"state"})),
]  # fmt: skip

CONFIG = [
    Fault("reload, good", "SIGHUP with another max_gap_s", REAL, plan=at(BEGIN, good_config)),
    Fault("reload, unknown key", "SIGHUP with a key that is not known", REAL,
          plan=at(BEGIN, unknown_key)),
    Fault("reload, not TOML", "SIGHUP with a file that is no TOML", REAL,
          plan=broken_config("model = [[[\n\x00")),
    Fault("reload, empty", "SIGHUP with an empty file", REAL, plan=broken_config("")),
    Fault("reload, gone", "SIGHUP with the file removed", REAL, plan=broken_config(None)),
    Fault("reload, often", "SIGHUP twenty times in 4 s", REAL, plan=at(BEGIN, reload_often)),
]  # fmt: skip

MACHINE = [
    Fault("process paused", "SIGSTOP for 10 s, then SIGCONT", REAL,
          plan=during((BEGIN, Stage.pause), (0.55, Stage.go_on))),
    Fault("paused in a burst", "SIGSTOP for 5 s, 2,000 foreign frames/s for 10 s", REAL,
          plan=during((BEGIN, Stage.pause), (0.3, Stage.go_on)),
          frames=flood(foreign, 2000.0, 10.0)),
    Fault("two services", "a second one with the same ids on the bus", REAL,
          plan=at(BEGIN, second_service)),
    Fault("slow consumer", "a listener that never reads", REAL, plan=at(BEGIN, deaf_listener)),
    Fault("SIGUSR1, SIGPIPE", "signals that mean nothing", REAL, plan=during(
        (BEGIN, lambda stage: stage.service.signal(signal.SIGPIPE)),
        (0.5, lambda stage: stage.service.signal(signal.SIGWINCH)))),
]  # fmt: skip

UDP_ONLY = [
    Fault("garbage packets", "2,000 packets that are no frames", REAL, plan=at(BEGIN, garbage)),
]

ALL = [*RESTARTS, *CONFIG, *MACHINE]

"""Services broken on purpose, which the harness must detect.

They take the command line of `cangauge run` and publish frames of `dbc/soc_estimate.dbc`.
"""

from __future__ import annotations

import signal
import sys
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import cantools

from cangauge._resources import shared_file
from cangauge.types import Status

AGE_S = 2.0
"""Age at which input counts as missing [s]; above the time that the harness listens on."""


def _serve(
    arguments: list[str], answer: Callable[[float, int], tuple[float, Status] | None]
) -> None:
    """Publish `answer(seconds since the last current, currents)` every 100 ms."""
    config: dict[str, Any] = tomllib.loads(Path(arguments[2]).read_text())
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    bus = can.Bus(
        interface=config["interface"], channel=config["channel"], ignore_config=True,
        **config["bus_options"],
    )  # fmt: skip
    database = cantools.database.load_file(shared_file("dbc", "soc_estimate.dbc"))
    layout, currents = database.get_message_by_name("SOC_ESTIMATE"), 0
    last_s = due_s = time.monotonic()
    while True:
        message = bus.recv(0.05)
        now_s = time.monotonic()
        if message is not None and message.arbitration_id == 0x400 and not message.is_extended_id:
            currents, last_s = currents + 1, now_s
        if now_s < due_s:
            continue
        due_s = now_s + 0.1
        reply = answer(now_s - last_s, currents)
        if reply is not None:
            soc_pct, status = reply
            values = dict.fromkeys((signal.name for signal in layout.signals), 0)
            values |= {"soc_pct": soc_pct, "soc_std_pct": 1.0, "status": int(status)}
            data = layout.encode(values)
            bus.send(can.Message(arbitration_id=layout.frame_id, is_extended_id=False, data=data))


def honest(arguments: list[str]) -> None:
    """Constant SoC, invalid without current: correct."""
    _serve(arguments, lambda age_s, _n: (70.0, Status.INVALID if age_s > AGE_S else Status.VALID))


def always_valid(arguments: list[str]) -> None:
    """Does not detect missing input."""
    _serve(arguments, lambda _age, _n: (70.0, Status.VALID))


def silent_after_a_fault(arguments: list[str]) -> None:
    """Stops publishing after missing input."""
    lost: list[bool] = []

    def answer(age_s: float, _n: int) -> tuple[float, Status] | None:
        if age_s > AGE_S:
            lost.append(True)
        return None if lost else (70.0, Status.VALID)

    _serve(arguments, answer)


def drifts_after_a_fault(arguments: list[str]) -> None:
    """Publishes a valid SoC that is 2 % off after missing input."""
    lost: list[bool] = []

    def answer(age_s: float, _n: int) -> tuple[float, Status] | None:
        if age_s > AGE_S:
            lost.append(True)
            return 70.0, Status.INVALID
        return (68.0 if lost else 70.0), Status.VALID

    _serve(arguments, answer)


def dies_of_a_fault(arguments: list[str]) -> None:
    """Ends with an exception on missing input."""

    def answer(age_s: float, _n: int) -> tuple[float, Status] | None:
        if age_s > AGE_S:
            raise RuntimeError("no input")
        return 70.0, Status.VALID

    _serve(arguments, answer)


def hard_to_stop(arguments: list[str]) -> None:
    """Ends with status 3 on SIGTERM."""
    try:
        honest(arguments)
    except SystemExit:
        sys.exit(3)


def never_valid(arguments: list[str]) -> None:
    """Never publishes a valid SoC."""
    _serve(arguments, lambda _age, _n: (70.0, Status.DEGRADED))


def does_not_start(arguments: list[str]) -> None:
    """Ends immediately."""
    sys.exit(f"error: {arguments[2]}: nothing is right")


def waits(arguments: list[str]) -> None:
    """Do nothing until SIGTERM."""
    del arguments
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    print("ready", flush=True)
    while True:
        signal.pause()

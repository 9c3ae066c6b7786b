"""One fault: starts the service, plays the frames, does what the fault does, watches."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Final

import can
import cantools

from cangauge._resources import shared_file
from cangauge.bus.time_source import ClockFrames
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import CangaugeError
from cangauge.replay.player import Pacer
from faults.drive import ROLES, Event, events
from faults.fault import Action, Fault
from faults.judge import RECOVERED_SHARE, Seen, Told
from faults.line import Line, Wire
from faults.process import Target, cangauge
from faults.stage import FIRST_START_S, Setting, Stage, remove, vehicle_config

LAST_WORDS_S: Final = 1.0
"""How long to listen after the last frame; less than the time-out of the input [s]."""


def run_fault(fault: Fault, line: Line, seed: int, target: Target = cangauge) -> Seen:
    """Run a fault on a line that nothing else uses.

    Parameters
    ----------
    fault : Fault
    line : Line
    seed : int
        With the fault's name it settles all that is chosen at random.
    target : callable
        The service.

    Returns
    -------
    Seen
    """
    folder = Path(tempfile.mkdtemp(prefix="fault-"))
    rng = Random(f"{seed} {fault.name}")  # noqa: S311 - must be repeatable
    setting = Setting(
        fault.config, fault.vehicle, with_state="state" in fault.needs, cold=fault.cold,
        target=target,
    )  # fmt: skip
    if line.is_vcan:
        line.create()
    stage = Stage(line, fault.profile, setting, folder, rng)
    listener = Listener(line)
    sender = Wire(line, published_only=True)
    try:
        return _played(fault, stage, sender, listener, rng)
    finally:
        stage.end()
        sender.close()
        listener.end()
        remove(folder)


def _played(fault: Fault, stage: Stage, sender: Wire, listener: Listener, rng: Random) -> Seen:
    profile = fault.profile
    vehicle = the_vehicle(fault, stage.folder)
    found = events(profile, vehicle, values=fault.values, untrue=fault.untrue, rng=rng)
    if fault.frames is not None:
        found = fault.frames(found, profile, vehicle, rng)
    actions = [] if fault.plan is None else fault.plan(profile, rng)
    stage.service.start()
    if not listener.wait(FIRST_START_S, stage.service.check):
        stage.troubles.append("does not start: " + " ".join(stage.service.said().split())[-200:])
        # Nothing to play to; what is missing is judged all the same.
        found, actions = found[:1], []
    seen = Seen(told=listener.told)
    player = _Player(sender, seen, profile.speed)
    player.begin()
    doer = _Doer(stage, actions, seen.began_s, profile.speed)
    doer.start()
    player.play(found)
    time.sleep(LAST_WORDS_S)
    doer.join(30.0)
    stage.service.check()
    listener.stop_listening()
    stage.end()
    first, last = profile.fault_s
    seen.fault_s = (seen.began_s + first / profile.speed, seen.began_s + last / profile.speed)
    seen.judged_from_s = seen.began_s + RECOVERED_SHARE * profile.seconds
    seen.excused = list(stage.excused)
    processes = (stage.service, *stage.others)
    seen.troubles = [*stage.troubles, *doer.troubles]
    for process in processes:
        seen.troubles += process.troubles
        if "Traceback" in process.said():
            seen.troubles.append("traceback: " + process.said().strip().splitlines()[-1][:200])
    seen.stop_s = max((s for each in processes for s in each.stop_seconds), default=float("nan"))
    return seen


def the_vehicle(fault: Fault, folder: Path) -> Vehicle:
    """Return the vehicle whose frames are played."""
    names = vehicle_config(fault.vehicle, folder)
    return Vehicle.load(names.get("vehicle"), names.get("dbc"), names.get("map"))


class _Player:
    """Sends frames at their times, and keeps when what went out."""

    def __init__(self, sender: Wire, seen: Seen, speed: float) -> None:
        self._sender = sender
        self._seen = seen
        self._speed = speed
        self._clock = None if speed == 1.0 else ClockFrames()
        self._pacer = Pacer(speed, lambda: False)
        seen.good_s = {role: [] for role in ROLES}

    def begin(self) -> None:
        self._pacer.wait(0)
        self._seen.began_s = self._seen.ended_s = time.monotonic()
        self._seen.sent_s.append(self._seen.began_s)
        self._seen.bus_s.append(0.0)

    def play(self, found: list[Event]) -> None:
        seen, send, last_s = self._seen, self._sender.send, -1.0
        for event in found:
            if event.at_s != last_s:
                self._pacer.wait(round(event.at_s * 1e6))
                if self._clock is not None:
                    send(self._clock.at(round(event.at_s * 1e6)))
                last_s = event.at_s
                seen.sent_s.append(time.monotonic())
                seen.bus_s.append(event.at_s)
                took_s = seen.sent_s[-1] - seen.sent_s[-2]
                meant_s = (seen.bus_s[-1] - seen.bus_s[-2]) / self._speed
                seen.late_s = max(seen.late_s, took_s - meant_s)
            if send(event.frame) and event.is_good:
                for role in event.roles:
                    seen.good_s[role].append(seen.sent_s[-1])
        seen.ended_s = time.monotonic()


class _Doer(threading.Thread):
    """Does actions at their times; one that takes long delays no frame."""

    def __init__(self, stage: Stage, actions: list[Action], began_s: float, speed: float) -> None:
        super().__init__(daemon=True)
        self._stage = stage
        self._actions = sorted(actions, key=lambda action: action.at_s)
        self._began_s = began_s
        self._speed = speed
        self.troubles: list[str] = []

    def run(self) -> None:
        for action in self._actions:
            due_s = self._began_s + action.at_s / self._speed
            time.sleep(max(due_s - time.monotonic(), 0.0))
            try:
                action.do(self._stage)
            except (CangaugeError, OSError) as error:
                self.troubles.append(f"the harness could not do it: {error}")


class Listener(threading.Thread):
    """Keeps every SOC_ESTIMATE that is published on a line, read by the DBC file alone."""

    def __init__(self, line: Line) -> None:
        super().__init__(daemon=True)
        database = cantools.database.load_file(shared_file("dbc", "soc_estimate.dbc"))
        self._message = database.get_message_by_name("SOC_ESTIMATE")
        self._wire = Wire(line, published_only=True)
        self._stopped = threading.Event()
        self._first = threading.Event()
        self.told: list[Told] = []
        self.start()

    def run(self) -> None:
        """Listen until told to stop."""
        while not self._stopped.is_set():
            frame = self._wire.receive(0.1)
            if frame is not None and frame.arbitration_id == self._message.frame_id:
                self._take(frame)

    def _take(self, frame: can.Message) -> None:
        if frame.is_extended_id or frame.is_error_frame or frame.is_remote_frame:
            return
        values = self._message.decode(frame.data, decode_choices=False, allow_truncated=True)
        # The raw codes for "not available" are the largest that the field holds.
        soc_pct = float(values["soc_pct"])
        self.told.append(
            Told(
                time.monotonic(),
                soc_pct if soc_pct <= 100.0 else float("nan"),
                int(values["status"]),
                int(values["reason"]),
                float(values["soc_std_pct"]),
            )
        )
        self._first.set()

    def wait(self, seconds: float, still: Callable[[], bool]) -> bool:
        """Wait for the first estimate, as long as `still()` holds."""
        until = time.monotonic() + seconds
        while not self._first.is_set():
            if time.monotonic() > until or not still():
                return False
            time.sleep(0.01)
        return True

    def stop_listening(self) -> None:
        """Keep nothing more."""
        self._stopped.set()
        self.join(5.0)

    def end(self) -> None:
        """Close the bus."""
        self.stop_listening()
        self._wire.close()

"""Runs of faults: one on its bus, or all of them in parallel, each with its undisturbed run."""

from __future__ import annotations

import math
import queue
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Final

import can
import cantools

from cangauge._resources import shared_file
from cangauge.bus.time_source import clock_frame
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import CangaugeError
from cangauge.replay.player import Pacer
from faults.bench import FIRST_START_S, Bench, ServiceSetup, remove, vehicle_config
from faults.catalogue import undisturbed
from faults.criteria import RECOVERED_SHARE, Estimate, Observation, Reference, Verdict, judge
from faults.fault import UNDISTURBED, Action, Fault
from faults.frames import ROLES, Event, events
from faults.line import BusLine, HarnessBus
from faults.process import Target, cangauge

LISTEN_AFTER_S: Final = 1.0
"""Time to listen after the last frame; below the time-outs of the input [s]."""

MAX_SEND_DELAY_S: Final = 1.5
"""Delay of the harness between frames that makes a run void: it is close to the time-outs of the
service [s]."""


def run_fault(fault: Fault, line: BusLine, seed: int, target: Target = cangauge) -> Observation:
    """Run a fault on a separate bus.

    Parameters
    ----------
    fault : Fault
    line : BusLine
    seed : int
        With the name of the fault the seed of all random choices.
    target : callable
        The service.

    Returns
    -------
    Observation
    """
    folder = Path(tempfile.mkdtemp(prefix="fault-"))
    rng = Random(f"{seed} {fault.name}")  # noqa: S311 - must be repeatable
    setup = ServiceSetup(
        fault.config, fault.vehicle, with_state="state" in fault.needs, target=target,
    )  # fmt: skip
    if line.is_vcan:
        line.create()
    bench = Bench(line, fault.profile, setup, folder, rng)
    listener = Listener(line)
    sender = HarnessBus(line, published_only=True)
    try:
        return _played(fault, bench, sender, listener, rng)
    finally:
        bench.end()
        sender.close()
        listener.end()
        remove(folder)


def _played(
    fault: Fault, bench: Bench, sender: HarnessBus, listener: Listener, rng: Random
) -> Observation:
    profile = fault.profile
    vehicle = load_fault_vehicle(fault, bench.folder)
    found = events(profile, vehicle, values=fault.values, untrusted=fault.untrusted, rng=rng)
    if fault.frames is not None:
        found = fault.frames(found, profile, vehicle, rng)
    actions = [] if fault.plan is None else fault.plan(profile, rng)
    bench.service.start()
    if not listener.wait(FIRST_START_S, bench.service.check):
        bench.incidents.append("does not start: " + " ".join(bench.service.output().split())[-200:])
        # The missing estimates are judged as in other runs.
        found, actions = found[:1], []
    observed = Observation(published=listener.published)
    player = _FramePlayer(sender, observed, profile.speed)
    player.begin()
    action_thread = _ActionThread(bench, actions, observed.began_s, profile.speed)
    action_thread.start()
    player.play(found)
    time.sleep(LISTEN_AFTER_S)
    action_thread.join(30.0)
    bench.service.check()
    listener.stop_listening()
    bench.end()
    first, last = profile.fault_s
    observed.fault_s = (
        observed.began_s + first / profile.speed,
        observed.began_s + last / profile.speed,
    )
    observed.recovered_from_s = observed.began_s + RECOVERED_SHARE * profile.seconds
    observed.expected_silence_s = list(bench.expected_silence_s)
    processes = (bench.service, *bench.others)
    observed.incidents = [*bench.incidents, *action_thread.incidents]
    for process in processes:
        observed.incidents += process.incidents
        if "Traceback" in process.output():
            observed.incidents.append(
                "traceback: " + process.output().strip().splitlines()[-1][:200]
            )
    observed.stop_s = max(
        (s for each in processes for s in each.stop_seconds), default=float("nan")
    )
    return observed


def load_fault_vehicle(fault: Fault, folder: Path) -> Vehicle:
    """Return the vehicle whose frames are sent."""
    names = vehicle_config(fault.vehicle, folder)
    return Vehicle.load(names.get("vehicle"), names.get("dbc"), names.get("map"))


class _FramePlayer:
    """Sends frames on time and records when."""

    def __init__(self, sender: HarnessBus, observed: Observation, speed: float) -> None:
        self._sender = sender
        self._observation = observed
        self._speed = speed
        self._sends_clock = speed != 1.0
        self._pacer = Pacer(speed, lambda: False)
        observed.good_sent_s = {role: [] for role in ROLES}

    def begin(self) -> None:
        self._pacer.wait(0)
        self._observation.began_s = self._observation.ended_s = time.monotonic()
        self._observation.sent_s.append(self._observation.began_s)
        self._observation.bus_s.append(0.0)

    def play(self, found: list[Event]) -> None:
        observed, send, last_s = self._observation, self._sender.send, -1.0
        for event in found:
            if event.at_s != last_s:
                self._pacer.wait(round(event.at_s * 1e6))
                if self._sends_clock:
                    send(clock_frame(round(event.at_s * 1e6)))
                last_s = event.at_s
                observed.sent_s.append(time.monotonic())
                observed.bus_s.append(event.at_s)
                took_s = observed.sent_s[-1] - observed.sent_s[-2]
                meant_s = (observed.bus_s[-1] - observed.bus_s[-2]) / self._speed
                observed.late_s = max(observed.late_s, took_s - meant_s)
                if observed.late_s > MAX_SEND_DELAY_S:
                    break
            if send(event.frame) and event.is_good:
                for role in event.roles:
                    observed.good_sent_s[role].append(observed.sent_s[-1])
        observed.ended_s = time.monotonic()


class _ActionThread(threading.Thread):
    """Takes actions on time, in a thread so that none delays a frame."""

    def __init__(self, bench: Bench, actions: list[Action], began_s: float, speed: float) -> None:
        super().__init__(daemon=True)
        self._bench = bench
        self._actions = sorted(actions, key=lambda action: action.at_s)
        self._began_s = began_s
        self._speed = speed
        self.incidents: list[str] = []

    def run(self) -> None:
        for action in self._actions:
            due_s = self._began_s + action.at_s / self._speed
            time.sleep(max(due_s - time.monotonic(), 0.0))
            try:
                action.do(self._bench)
            except (CangaugeError, OSError) as error:
                self.incidents.append(f"an action of the harness failed: {error}")


class Listener(threading.Thread):
    """Records all published SOC_ESTIMATE frames, decoded by the DBC file."""

    def __init__(self, line: BusLine) -> None:
        super().__init__(daemon=True)
        database = cantools.database.load_file(shared_file("dbc", "soc_estimate.dbc"))
        self._message = database.get_message_by_name("SOC_ESTIMATE")
        self._bus = HarnessBus(line, published_only=True)
        self._stopped = threading.Event()
        self._first = threading.Event()
        self.published: list[Estimate] = []
        self.start()

    def run(self) -> None:
        """Listen until stopped."""
        while not self._stopped.is_set():
            frame = self._bus.receive(0.1)
            if frame is not None and frame.arbitration_id == self._message.frame_id:
                self._take(frame)

    def _take(self, frame: can.Message) -> None:
        if frame.is_extended_id or frame.is_error_frame or frame.is_remote_frame:
            return
        values = self._message.decode(frame.data, decode_choices=False, allow_truncated=True)
        # The raw code for "not available" is the largest of the field.
        soc_pct = float(values["soc_pct"])
        self.published.append(
            Estimate(
                time.monotonic(),
                soc_pct if soc_pct <= 100.0 else float("nan"),
                int(values["status"]),
                int(values["reason"]),
                float(values["soc_std_pct"]),
            )
        )
        self._first.set()

    def wait(self, seconds: float, still: Callable[[], bool]) -> bool:
        """Wait for the first estimate while `still()` is true."""
        until = time.monotonic() + seconds
        while not self._first.is_set():
            if time.monotonic() > until or not still():
                return False
            time.sleep(0.01)
        return True

    def stop_listening(self) -> None:
        """Stop recording."""
        self._stopped.set()
        self.join(5.0)

    def end(self) -> None:
        """Close the bus."""
        self.stop_listening()
        self._bus.close()


OVERHEAD_S: Final = 4.0
"""Time of a run besides its frames, for start and end [s]."""

IMPORT_S: Final = 10.0
"""Time to import the service once [s]."""


@dataclass(frozen=True)
class Jobs:
    """Number of faults that run in parallel.

    Parameters
    ----------
    fast, real : int
        By the replay clock (a quarter of a core each), and in real time (little load).
    """

    fast: int = 3
    real: int = 24


@dataclass(frozen=True)
class Result:
    """A fault that was run; without a verdict where the run is void, with the reason."""

    fault: Fault
    verdict: Verdict | None
    reason: str = ""


def seconds(faults: list[Fault], jobs: Jobs) -> float:
    """Return the estimated time of `run_all` [s]."""
    runs = _with_undisturbed(faults)
    alone = [fault for fault in runs if "alone" in fault.needs]
    parallel = [fault for fault in runs if "alone" not in fault.needs]
    total = IMPORT_S + sum(fault.profile.seconds + OVERHEAD_S for fault in alone)
    pools = []
    for is_real, width in ((True, jobs.real), (False, jobs.fast)):
        lengths = [
            fault.profile.seconds + OVERHEAD_S
            for fault in parallel
            if fault.profile.is_real_time == is_real
        ]
        rounds = math.ceil(len(lengths) / width)
        pools.append(rounds * max(lengths, default=0.0))
    return total + max(pools)


REPEATS: Final = 5
"""Most repetitions of a run that the machine's other work made void."""


def run_all(
    faults: list[Fault],
    lines: Callable[[int], BusLine],
    jobs: Jobs,
    seed: int,
    *,
    target: Target = cangauge,
    repeats: int = REPEATS,
    until_s: float = math.inf,
) -> Iterator[Result]:
    """Run faults and their undisturbed runs, and yield each result as soon as it is known.

    A void run is repeated when all others are over, alone on the machine.

    Parameters
    ----------
    faults : list of Fault
    lines : callable
        Returns a bus by number.
    jobs : Jobs
    seed : int
    target : callable
        The service.
    repeats : int
        Most repetitions of a void run.
    until_s : float
        Monotonic time after which no run begins [s].

    Yields
    ------
    Result
    """
    runs = _with_undisturbed(faults)
    free: queue.SimpleQueue[BusLine] = queue.SimpleQueue()
    for number in range(jobs.fast + jobs.real):
        free.put(lines(number))

    def observe(fault: Fault) -> Observation | None:
        line = free.get()
        try:
            if time.monotonic() > until_s:
                return None
            return run_fault(fault, line, seed, fault.target or target)
        finally:
            free.put(line)

    court = _Court()
    for fault, observed in _each_once(runs, observe, jobs):
        yield from court.judge(fault, observed)
    for _ in range(repeats):
        for fault in court.void():
            yield from court.judge(fault, observe(fault))
    yield from court.unjudged()


def _each_once(
    runs: list[Fault], observe: Callable[[Fault], Observation | None], jobs: Jobs
) -> Iterator[tuple[Fault, Observation | None]]:
    """Run faults in parallel, then one by one those that need the machine alone."""
    with ThreadPoolExecutor(jobs.fast) as fast, ThreadPoolExecutor(jobs.real) as real:
        futures: dict[Future[Observation | None], Fault] = {}
        for fault in runs:
            if "alone" not in fault.needs:
                pool = real if fault.profile.is_real_time else fast
                futures[pool.submit(observe, fault)] = fault
                # Staggered: simultaneous starts delay each other.
                time.sleep(0.05)
        for future in as_completed(futures):
            yield futures[future], future.result()
    for fault in runs:
        if "alone" in fault.needs:
            yield fault, observe(fault)


_Key = tuple[str, tuple[str, str, str]]


class _Court:
    """Judges each run as soon as the undisturbed run that it is compared with is known."""

    def __init__(self) -> None:
        self._references: dict[tuple[str, str, str], Reference] = {}
        self._waiting: list[tuple[Fault, Observation]] = []
        self._void: dict[_Key, Result] = {}

    def judge(self, fault: Fault, observed: Observation | None) -> Iterator[Result]:
        """Take one run; yield the results that are now known."""
        key = fault.name, fault.reference_key
        if observed is None:
            self._void.setdefault(key, Result(fault, None, "no time was left for it"))
            return
        reason = self._void_reason(fault, observed)
        if reason:
            self._void[key] = Result(fault, None, reason)
            return
        self._void.pop(key, None)
        self._waiting.insert(0, (fault, observed))
        for each in self._waiting:
            if each[0].reference_key in self._references:
                yield self._result(*each)
        self._waiting = [
            each for each in self._waiting if each[0].reference_key not in self._references
        ]

    def void(self) -> list[Fault]:
        """Return the faults of void runs, undisturbed ones first."""
        faults = [result.fault for result in self._void.values()]
        return sorted(faults, key=lambda fault: fault.name != UNDISTURBED)

    def unjudged(self) -> Iterator[Result]:
        """Yield what stays void, and what has no valid undisturbed run."""
        yield from self._void.values()
        for fault, _ in self._waiting:
            yield Result(fault, None, self._void[UNDISTURBED, fault.reference_key].reason)

    def _void_reason(self, fault: Fault, observed: Observation) -> str:
        """Return why a run is void, "" if it is not; keep an undisturbed run."""
        if observed.late_s > MAX_SEND_DELAY_S:
            return f"the machine delayed its frames by {observed.late_s:.1f} s"
        if fault.name == UNDISTURBED:
            try:
                self._references[fault.reference_key] = Reference(observed)
            except ValueError as error:
                return str(error)
        return ""

    def _result(self, fault: Fault, observed: Observation) -> Result:
        reference = self._references[fault.reference_key]
        verdict = judge(observed, reference, reports=fault.reports, recovers=fault.recovers)
        return Result(fault, verdict)


def _with_undisturbed(faults: list[Fault]) -> list[Fault]:
    needed = {fault.reference_key: undisturbed(fault) for fault in faults}
    return [*needed.values(), *faults]

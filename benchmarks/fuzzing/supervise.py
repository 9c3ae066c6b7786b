"""Fuzzing workers, and a supervisor that replaces those that hang or die.

Seed, target and number identify an input, so that another worker can continue the share of one that
is lost.
"""

from __future__ import annotations

import contextlib
import math
import multiprocessing as mp
import resource
import time
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from multiprocessing.connection import Connection, wait
from pathlib import Path
from random import Random
from typing import Any

from fuzzing.target import Target, attempt

SLOW_S = 2.0
"""CPU time of one input (or 200 frames) above which it is a finding [s]."""
HANG_S = 120.0
"""Real time of one input after which its worker is killed [s]."""
GROWTH_MB = 128.0
"""Growth of memory by one input above which it is a finding [MB]."""
DATA_LIMIT = 4 << 30
"""Memory limit of a worker [bytes]."""
CHUNK = 250
_STATUS = Path("/proc/self/status")


@dataclass
class Example:
    """First input of a finding, and the number of inputs with it."""

    number: int
    text: str
    count: int = 1


@dataclass
class Tally:
    """Results of the inputs of one target."""

    inputs: int = 0
    accepted: int = 0
    refused: int = 0
    findings: dict[tuple[str, str], Example] = field(default_factory=dict)
    slowest_s: float = 0.0
    slowest: int = -1
    peak_mb: float = 0.0

    def add(self, other: Tally) -> None:
        """Add another tally."""
        self.inputs += other.inputs
        self.accepted += other.accepted
        self.refused += other.refused
        self.peak_mb = max(self.peak_mb, other.peak_mb)
        if other.slowest_s > self.slowest_s:
            self.slowest_s, self.slowest = other.slowest_s, other.slowest
        for key, example in other.findings.items():
            self.note(key, example)

    def note(self, key: tuple[str, str], example: Example) -> None:
        """Count a finding."""
        known = self.findings.get(key)
        if known is None:
            self.findings[key] = example
        else:
            known.count += example.count
            if example.number < known.number:
                known.number, known.text = example.number, example.text


@dataclass(frozen=True)
class Share:
    """A range of inputs of one target."""

    target: str
    start: int
    stop: int


def input_of(target: Target, seed: int, number: int) -> bytes:
    """Return an input by its number."""
    return target.make(Random(f"{seed}/{target.name}/{number}"))  # noqa: S311 - no secret


def try_one(target: Target, data: bytes, number: int, tally: Tally) -> None:
    """Run one input and count the result."""
    tally.inputs += target.weight
    before_mb, began_s = _memory_mb(), time.process_time()
    try:
        if attempt(target, data):
            tally.accepted += target.weight
        else:
            tally.refused += target.weight
    except Exception as error:  # noqa: BLE001 - any exception is a finding
        tally.note(_where(error), Example(number, str(error)[:300]))
    taken_s, memory_mb = time.process_time() - began_s, _memory_mb()
    tally.peak_mb = max(tally.peak_mb, memory_mb)
    if taken_s > tally.slowest_s:
        tally.slowest_s, tally.slowest = taken_s, number
    if taken_s > SLOW_S:
        tally.note(("too slow", target.name), Example(number, f"{taken_s:.1f} s of CPU"))
    if memory_mb - before_mb > GROWTH_MB:
        text = f"{before_mb:.0f} → {memory_mb:.0f} MB"
        tally.note(("too much memory", target.name), Example(number, text))


def fuzz(
    shares: Sequence[Share],
    seed: int,
    workers: int,
    progress: Callable[[str, int], None],
    *,
    module: str = "fuzzing.targets",
    hang_s: float = HANG_S,
) -> dict[str, Tally]:
    """Run all shares; return a tally for each target.

    Parameters
    ----------
    shares : sequence of Share
    seed : int
    workers : int
        Number of processes.
    progress : callable
        Called with the target and the number of inputs of each finished share.
    module : str
        Module whose `targets()` are run.
    hang_s : float
        Real time of one input after which its worker is killed [s].
    """
    weights = {target.name: target.weight for target in import_module(module).targets()}
    tallies = {share.target: Tally() for share in shares}
    pending = deque(shares)
    team = [_Worker(seed, module) for _ in range(workers)]
    try:
        while pending or any(worker.share for worker in team):
            for worker in team:
                if worker.share is None and pending:
                    worker.give(pending.popleft())
            ready = wait([worker.connection for worker in team if worker.share], timeout=1.0)
            for place, worker in enumerate(team):
                share = worker.share
                if share is None:
                    continue
                done: Tally | None = None
                if worker.connection in ready:
                    done = worker.take()
                    if done is None:
                        what = f"died with exit code {worker.exit_code()}"
                    else:
                        tallies[share.target].add(done)
                        progress(share.target, done.inputs)
                        continue
                elif worker.stuck(hang_s):
                    what = "hung"
                else:
                    continue
                number = worker.number
                tallies[share.target].inputs += weights[share.target]
                tallies[share.target].note((what, share.target), Example(number, ""))
                pending.extendleft(
                    part
                    for part in (
                        Share(share.target, share.start, number),
                        Share(share.target, number + 1, share.stop),
                    )
                    if part.start < part.stop
                )
                worker.end()
                team[place] = _Worker(seed, module)
    finally:
        for worker in team:
            worker.end()
    return tallies


class _Worker:
    """A process that tries one share at a time."""

    def __init__(self, seed: int, module: str) -> None:
        context = mp.get_context("spawn")
        self.connection, theirs = context.Pipe()
        # Number and start time of the current input.
        self._at = context.RawArray("d", 2)
        self.share: Share | None = None
        self._process = context.Process(
            target=_work, args=(theirs, self._at, seed, module), daemon=True
        )
        self._process.start()
        theirs.close()

    def give(self, share: Share) -> None:
        self.share = share
        # The time starts with the first input, not with the process.
        self._at[0], self._at[1] = share.start, math.inf
        self.connection.send(share)

    def take(self) -> Tally | None:
        """Return the tally of its share; None if it died."""
        try:
            done: Tally = self.connection.recv()
        except (EOFError, OSError):
            return None
        self.share = None
        return done

    @property
    def number(self) -> int:
        return int(self._at[0])

    def stuck(self, hang_s: float) -> bool:
        return time.monotonic() - self._at[1] > hang_s

    def exit_code(self) -> int | None:
        self._process.join(5.0)
        return self._process.exitcode

    def end(self) -> None:
        """End the process: cleanly if it is idle, else by SIGKILL."""
        self.connection.close()
        if self.share is None:
            self._process.join(5.0)
        self._process.kill()
        self._process.join()


def _work(connection: Connection, at: Any, seed: int, module: str) -> None:
    warnings.simplefilter("error", RuntimeWarning)  # numpy's, visible to users on stderr
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_DATA, (DATA_LIMIT, DATA_LIMIT))
    by_name: dict[str, Target] = {each.name: each for each in import_module(module).targets()}
    warm: set[str] = set()
    while True:
        try:
            share: Share = connection.recv()
        except (EOFError, OSError):
            return
        target, tally = by_name[share.target], Tally()
        if share.target not in warm:  # caches count for no input
            warm.add(share.target)
            at[1] = time.monotonic()
            with contextlib.suppress(Exception):
                attempt(target, input_of(target, seed, share.start))
        for number in range(share.start, share.stop):
            at[0], at[1] = number, time.monotonic()
            try_one(target, input_of(target, seed, number), number, tally)
        connection.send(tally)


def _where(error: BaseException) -> tuple[str, str]:
    """Return the exception type and the innermost line of cangauge."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "cangauge" in frame.filename.split("/")] or frames
    return type(error).__name__, f"{ours[-1].filename.rpartition('/')[2]}:{ours[-1].lineno}"


def _memory_mb() -> float:
    """Return the peak memory of this process [MB]."""
    try:
        with _STATUS.open() as status:
            return next(float(line.split()[1]) for line in status if line[:6] == "VmHWM:") / 1024.0
    except (OSError, StopIteration):
        # Not on Linux, where it would include the parent.
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0

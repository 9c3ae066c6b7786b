"""Which faults run beside which, how long that takes, and in what order."""

from __future__ import annotations

import math
import queue
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final

from faults.catalogue import undisturbed
from faults.fault import UNDISTURBED, Fault
from faults.judge import Reference, Seen, Verdict, judge
from faults.line import Line
from faults.process import Target, cangauge
from faults.run import run_fault

AROUND_S: Final = 4.0
"""What a run takes besides its frames: starting, last words, ending [s]."""
SERVER_S: Final = 10.0
"""What it takes to import the service once [s]."""


@dataclass(frozen=True)
class Jobs:
    """How many faults run at once.

    Parameters
    ----------
    fast, real : int
        Of those by the replay clock (they take a quarter of a core each), of those in real time
        (they take little).
    """

    fast: int = 3
    real: int = 24


LATE_S: Final = 1.5
"""Where the harness itself left such a gap between frames, the run says nothing [s]: it comes near
the service's time-outs."""


@dataclass(frozen=True)
class Done:
    """A fault that was run; without a verdict where its undisturbed run is no reference."""

    fault: Fault
    verdict: Verdict | None
    why_not: str = ""


def seconds(faults: list[Fault], jobs: Jobs) -> float:
    """Return how long `run_all` will take, about [s]."""
    runs = _with_undisturbed(faults)
    alone = [fault for fault in runs if "alone" in fault.needs]
    beside = [fault for fault in runs if "alone" not in fault.needs]
    total = SERVER_S + sum(fault.profile.seconds + AROUND_S for fault in alone)
    pools = []
    for is_real, width in ((True, jobs.real), (False, jobs.fast)):
        lengths = [
            fault.profile.seconds + AROUND_S
            for fault in beside
            if fault.profile.is_real_time == is_real
        ]
        rounds = math.ceil(len(lengths) / width)
        pools.append(rounds * max(lengths, default=0.0))
    return total + max(pools)


def run_all(
    faults: list[Fault],
    lines: Callable[[int], Line],
    jobs: Jobs,
    seed: int,
    *,
    target: Target = cangauge,
    progress: Callable[[str], None] = lambda _name: None,
    again_if_disturbed: bool = True,
) -> list[Done]:
    """Run faults and their undisturbed runs, and judge them.

    Parameters
    ----------
    faults : list of Fault
    lines : callable
        Gives a bus by number.
    jobs : Jobs
    seed : int
    target : callable
        The service.
    progress : callable
        Told the name of each run that is over.
    again_if_disturbed : bool
        Whether a run that the machine held up, and an undisturbed run that is no reference, are
        tried once more.

    Returns
    -------
    list of Done
        In the order of `faults`, the undisturbed runs first.

    """
    runs = _with_undisturbed(faults)
    free: queue.SimpleQueue[Line] = queue.SimpleQueue()
    for number in range(jobs.fast + jobs.real):
        free.put(lines(number))

    def one(fault: Fault) -> Seen:
        line = free.get()
        try:
            return run_fault(fault, line, seed, target)
        finally:
            free.put(line)
            progress(fault.name)

    seen = _run_each(runs, one, jobs)
    references = _references(runs, seen)
    # A busy machine disturbs runs, too: once more, before anything is said of the service.
    again = [
        number
        for number, fault in enumerate(runs)
        if seen[number].late_s > LATE_S
        or (fault.name == UNDISTURBED and isinstance(references[fault.alike], str))
    ]
    if again and again_if_disturbed:
        repeated = _run_each([runs[number] for number in again], one, jobs)
        seen = [*seen]
        for number, found in zip(again, repeated, strict=True):
            seen[number] = found
        references = _references(runs, seen)
    return [
        _done(fault, seen[number], references[fault.alike]) for number, fault in enumerate(runs)
    ]


def _run_each(runs: list[Fault], one: Callable[[Fault], Seen], jobs: Jobs) -> list[Seen]:
    """Run those that may side by side, then the others one by one."""
    futures: dict[int, Future[Seen]] = {}
    with ThreadPoolExecutor(jobs.fast) as fast, ThreadPoolExecutor(jobs.real) as real:
        for number, fault in enumerate(runs):
            if "alone" not in fault.needs:
                pool = real if fault.profile.is_real_time else fast
                futures[number] = pool.submit(one, fault)
                # Not all at the same moment: a dozen starts at once would delay each other.
                time.sleep(0.05)
    return [
        futures[number].result() if number in futures else one(fault)
        for number, fault in enumerate(runs)
    ]


def _references(runs: list[Fault], seen: list[Seen]) -> dict[tuple[str, str, str], Reference | str]:
    return {
        fault.alike: _reference(found)
        for fault, found in zip(runs, seen, strict=True)
        if fault.name == UNDISTURBED
    }


def _reference(seen: Seen) -> Reference | str:
    try:
        return Reference(seen)
    except ValueError as error:
        return str(error)


def _done(fault: Fault, seen: Seen, reference: Reference | str) -> Done:
    if isinstance(reference, str):
        return Done(fault, None, reference)
    if seen.late_s > LATE_S:
        return Done(fault, None, f"this machine held frames up for {seen.late_s:.1f} s, twice")
    return Done(fault, judge(seen, reference))


def _with_undisturbed(faults: list[Fault]) -> list[Fault]:
    needed = {fault.alike: undisturbed(fault) for fault in faults}
    return [*needed.values(), *faults]

"""A job over all logs of a fleet on a Dask scheduler.

Dask runs a task again where its worker is lost, and gives up a task that loses several workers;
its logs are set aside, and tried again by the next run. At most a few tasks for each thread are in
flight, so that the scheduler's memory does not grow with the fleet. The client alone writes the
results.
"""

from __future__ import annotations

import json
import logging
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from tempfile import TemporaryDirectory
from typing import Any, Final

from cangauge._files import text_sha256
from cangauge._version import __version__
from cangauge.errors import CangaugeError, InputError
from cangauge.extras.fleet.jobs import Job, Task
from cangauge.extras.fleet.results import Finished, Results, by_kind, reason_of

_LOG = logging.getLogger(__name__)

CONNECT_S: Final = 10.0
"""Time for the scheduler to answer [s]."""
FLUSH_S: Final = 10.0
"""Time after which finished rows are written with the next one [s]: what a killed run loses."""
_TASKS_PER_THREAD: Final = 4
"""Tasks in flight for each thread of the workers: enough to hide the way to the scheduler."""
_ASK_S: Final = 1.0
"""Interval of questions to the scheduler for its workers, and of the progress shown [s]."""
_FIELD: Final = "--workers"
_LOST: Final = "the scheduler was lost; finished logs are kept: run the same command again"


@dataclass
class Summary:
    """Counts of a run.

    Parameters
    ----------
    skipped : int
        Done by an earlier run with the same model and options.
    done, bad : int
        Computed, and set aside, now.
    bad_before : int
        Set aside for good by an earlier run.
    seconds : float
    workers : int
        Largest number of workers at a time.
    reasons : dict
        Of the logs set aside now, with their number: the first one of each kind.
    of : str
        What is counted: logs, or vehicles.
    """

    skipped: int = 0
    done: int = 0
    bad: int = 0
    bad_before: int = 0
    seconds: float = 0.0
    workers: int = 0
    reasons: dict[str, int] = field(default_factory=dict)
    of: str = "logs"

    def __str__(self) -> str:
        """Return the counts in a phrase."""
        aside = self.bad + self.bad_before
        return f"{self.of}: {self.done} computed, {self.skipped} known before, {aside} set aside"


def run_id(job: Job) -> str:
    """Return what identifies a run: job, model, options and version."""
    identity = job.identity() | {"read": job.options.described}
    return text_sha256(json.dumps([job.kind, __version__, identity], sort_keys=True))[:32]


@contextmanager
def connected(workers: str | None = None) -> Iterator[Any]:
    """Yield a Dask client; a local cluster ends with the block.

    Parameters
    ----------
    workers : str, optional
        Worker processes of a local cluster, by default the number of cores; or the address of a
        scheduler, such as "tcp://10.0.0.5:8786".

    Raises
    ------
    InputError
        If Dask is not installed, the number is none, the scheduler does not answer, or a worker has
        another version.
    """
    number = workers or str(os.cpu_count() or 1)
    if "://" not in number and not (number.isdecimal() and int(number)):
        cure = "give a number of processes, or the address of a scheduler: tcp://HOST:8786"
        raise InputError("neither a number nor an address", field=_FIELD, value=workers, cure=cure)
    try:
        import dask  # noqa: PLC0415 - an extra, slow to import
        from distributed import Client, LocalCluster  # noqa: PLC0415
    except ImportError as error:
        raise InputError(
            "dask.distributed is not installed",
            cure="pip install 'cangauge[fleet]'",
        ) from error
    for name in ("distributed", "distributed.client"):
        # A lost worker or scheduler is reported here, without their tracebacks.
        logging.getLogger(name).setLevel(logging.CRITICAL)
    if "://" not in number:
        # Whoever reaches a scheduler runs code as its user: a certificate of this run keeps other
        # users of the machine out, and no page is served. Dask imports modules from its folder and
        # keeps pickles there: by default one that any user can make first.
        closed: dict[str, Any] = {
            f"distributed.{of}.http.routes": [] for of in ("scheduler", "worker")
        }
        with (
            TemporaryDirectory(prefix="cangauge-fleet-") as own,
            dask.config.set(closed | {"temporary-directory": own}),
            LocalCluster(
                n_workers=int(number),
                threads_per_worker=1,
                processes=True,
                security=True,
                dashboard_address="127.0.0.1:0",
                scheduler_kwargs={"dashboard": False},
                silence_logs=logging.CRITICAL,
            ) as cluster,
            Client(cluster, set_as_default=False) as client,
        ):
            yield client
        return
    try:
        client = Client(number, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            "no Dask scheduler answers",
            field=_FIELD,
            value=number,
            cure="start one with `dask scheduler`, or give a number of processes",
        ) from error
    with client:
        _check_versions(client)
        _LOG.info("dashboard: %s", client.dashboard_link)
        yield client


def worker_version() -> str:
    """Return the version of cangauge, on a worker."""
    return __version__


def _check_versions(client: Any) -> None:
    cure = f"install 'cangauge[fleet]' {__version__} where the workers run"
    try:
        found = set(client.run(worker_version).values())
    except OSError as error:  # the connection's
        raise CangaugeError(_LOST) from error
    except Exception as error:
        problem = f"the workers cannot run cangauge: {error}"
        raise InputError(problem, field=_FIELD, cure=cure) from error
    if other := found - {__version__}:
        problem = f"a worker has cangauge {other.pop()}"
        raise InputError(problem, field=_FIELD, cure=cure)


def run_job(job: Job, tasks: Sequence[Task], results: Results, client: Any) -> Summary:
    """Compute the rows of all tasks that are not known yet.

    Parameters
    ----------
    job : Job
    tasks : sequence of Task
    results : Results
        Its rows of the same run are kept.
    client : distributed.Client

    Raises
    ------
    CangaugeError
        If the scheduler is lost; finished rows are kept.
    """
    began, run = time.monotonic(), run_id(job)
    known = results.known(run)
    summary = Summary(of=job.of)
    todo = []
    for task in tasks:
        stamp, good, aside = known.get(task.name, ("", 0, 0))
        if stamp == task.stamp:
            summary.skipped += good
            summary.bad_before += aside
        else:
            todo.append(task)
    waiting: dict[str, dict[str, Finished]] = {}  # by vehicle and task
    reasons: list[dict[str, Any]] = []

    def flush() -> None:
        for vehicle, finished in waiting.items():
            results.put(vehicle, finished)
        waiting.clear()

    flushed = began
    try:
        for task, finished in _computed(job, run, todo, client, summary):
            keys = {"task": task.name, "stamp": task.stamp, "run": run}
            for row in (*finished.rows, *finished.bad):
                row.update(keys)
            waiting.setdefault(task.vehicle, {})[task.name] = finished
            summary.done += len(finished.rows)
            summary.bad += len(finished.bad)
            reasons += finished.bad
            if time.monotonic() - flushed >= FLUSH_S:
                flush()
                flushed = time.monotonic()
    finally:
        flush()
    summary.reasons = {reason_of(row): number for row, number in by_kind(reasons)}
    summary.seconds = time.monotonic() - began
    _LOG.info("%s: %s", job.kind, summary)
    return summary


def _computed(
    job: Job, run: str, todo: Sequence[Task], client: Any, summary: Summary
) -> Iterator[tuple[Task, Finished]]:
    """Yield tasks with what became of them, as they finish."""
    from distributed import as_completed  # noqa: PLC0415 - an extra

    if not todo:
        return
    shared = client.submit(_share, job, key=f"job-{run}")
    done = as_completed(loop=client.loop, with_results=True, raise_errors=False)
    queue, in_flight = iter(todo), dict[str, Task]()
    asked, wanted = -_ASK_S, 2
    while True:
        if time.monotonic() - asked >= _ASK_S:
            asked, threads = time.monotonic(), client.nthreads()
            summary.workers = max(summary.workers, len(threads))
            wanted = max(2, _TASKS_PER_THREAD * sum(threads.values()))
            waits = "" if threads else ", waiting for workers"
            _LOG.debug("%s: %s (%d workers%s)", job.kind, summary, len(threads), waits)
        while len(in_flight) < wanted and (task := next(queue, None)) is not None:
            key = f"{job.kind}-{text_sha256(f'{run}{task.name}{task.stamp}')[:24]}"
            in_flight[key] = task
            done.add(client.submit(perform, shared, task, key=key, pure=False))
        if not in_flight:
            return
        future, result = next(done)
        task = in_flight.pop(future.key)
        if not isinstance(result, Finished):
            if future.status in {"cancelled", "lost"}:
                raise CangaugeError(_LOST)
            if shared.status == "error":
                raise CangaugeError(f"the workers cannot load the job: {shared.exception()!r}")
            # distributed gives type, error and traceback.
            error = result[1] if isinstance(result, tuple) else future.exception()
            result = Finished(bad=[set_aside(task.name, error)])
        yield task, result


def _share(job: Job) -> Job:
    """Return the job: as the result of a task it is sent again if its worker is lost."""
    return job


def perform(job: Job, task: Task) -> Finished:
    """Compute the rows of a task, on a worker; what fails is returned with the reason."""
    found = Finished()
    for name, compute in job.parts(task):
        try:
            found.rows.append({"log": name, **compute()})
        except Exception as error:  # noqa: BLE001 - one log never stops the others
            found.bad.append(set_aside(name, error))
    return found


def set_aside(name: str, error: BaseException) -> dict[str, Any]:
    """Return the row of a log that failed.

    `kind` is field and problem of the reason, without what differs from log to log; `is_final`
    whether the reason lies in the log, so that another run would find it again.
    """
    if isinstance(error, InputError):
        parts = {"field": error.field, "cure": error.cure}
        reason = str(InputError(error.problem, source=name, value=error.value, **parts))
        kind = str(InputError(error.problem, field=error.field))
    else:
        text = f"{type(error).__name__}: {error}".splitlines()[0]
        reason = f"{name}: {text}"
        kind = f"{type(error).__name__} {getattr(error, 'strerror', None) or ''}".strip()
    is_final = isinstance(error, InputError)
    return {"log": name, "reason": reason, "kind": kind, "is_final": is_final}

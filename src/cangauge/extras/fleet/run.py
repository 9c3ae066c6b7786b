"""A job over all logs of a fleet on a Dask scheduler.

Each log is one task. Dask runs a task again where its worker is lost, and gives up a task that
loses several workers; such a log is set aside, and tried again by the next run. At most a few tasks
for each thread are in flight, so that the scheduler's memory does not grow with the fleet.

The client alone writes the results, at most `FLUSH_S` after they are done.
"""

from __future__ import annotations

import json
import logging
import os
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Final

from cangauge._files import file_sha256, text_sha256
from cangauge._version import __version__
from cangauge.errors import CangaugeError, InputError
from cangauge.extras.fleet.dataset import BAD, Dataset, keys_of, reason_of
from cangauge.extras.fleet.jobs import Job
from cangauge.extras.fleet.sources import FleetLog, local_file

_LOG = logging.getLogger(__name__)

LOST: Final = "the scheduler was lost; finished logs are kept: run the same command again"

LOCAL: Final = "local"
"""Scheduler and workers on this machine."""

FLUSH_S: Final = 10.0
"""Longest time that a finished row waits to be written [s]: what a killed run loses."""

FLUSH_ROWS: Final = 1000
TASKS_PER_THREAD: Final = 4
"""Tasks in flight for each thread of the workers: enough to hide the way to the scheduler."""

REPORT_S: Final = 30.0
"""Interval of the lines of progress in a log file [s]."""

ASK_S: Final = 1.0
"""Interval of questions to the scheduler for its workers, and of the progress shown [s]."""

POLL_S: Final = 0.01
"""Interval of looks at the finished tasks [s]: short against a task of 0.3 s."""

CONNECT_S: Final = 10.0
"""Time for the scheduler to answer [s]."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of one log."""

    log: FleetLog
    sha256: str = ""
    seconds: float = 0.0
    row: dict[str, Any] | None = None
    """Columns of the job; None for a log set aside, or the same as before."""
    reason: str = ""
    """Why it was set aside; "" if it was not."""
    kind: str = ""
    """Field and problem of the reason, without what differs from log to log."""
    is_final: bool = True
    """Whether the reason lies in the log, so that another run would find it again."""


@dataclass
class Summary:
    """Counts of a run.

    Parameters
    ----------
    logs : int
        All logs given.
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

    logs: int
    skipped: int = 0
    done: int = 0
    bad: int = 0
    bad_before: int = 0
    seconds: float = 0.0
    workers: int = 0
    reasons: dict[str, int] = field(default_factory=dict)
    of: str = "logs"

    def to_dict(self) -> dict[str, Any]:
        """Return the counts as JSON."""
        return dict(vars(self))

    def __str__(self) -> str:
        """Return the counts in a phrase."""
        finished = self.skipped + self.done + self.bad + self.bad_before
        aside = self.bad + self.bad_before
        return (
            f"{finished} of {self.logs} {self.of}: {self.done} computed, {self.skipped} known,"
            f" {aside} set aside"
        )


def run_id(job: Job) -> str:
    """Return what identifies a run: job, model, options and version."""
    identity = job.identity() | {"read": job.options.described}
    return text_sha256(json.dumps([job.kind, __version__, identity], sort_keys=True))[:32]


@contextmanager
def connected(scheduler: str, workers: int | None = None) -> Iterator[Any]:
    """Yield a Dask client; a local cluster ends with the block.

    Parameters
    ----------
    scheduler : str
        Address such as "tcp://10.0.0.5:8786", or "local".
    workers : int, optional
        Worker processes of a local cluster; by default the number of cores.

    Raises
    ------
    InputError
        If Dask is not installed, the scheduler does not answer, or a worker has another version.
    """
    try:
        from distributed import Client, LocalCluster  # noqa: PLC0415 - an extra, slow to import
    except ImportError as error:
        raise InputError(
            "dask.distributed is not installed", field="--scheduler", value=scheduler,
            cure="pip install 'cangauge[fleet]'",
        ) from error  # fmt: skip
    for name in ("distributed", "distributed.client"):
        # A lost worker or scheduler is reported here, without their tracebacks.
        logging.getLogger(name).setLevel(logging.CRITICAL)
    if scheduler == LOCAL:
        cluster = LocalCluster(
            n_workers=workers or os.cpu_count() or 1, threads_per_worker=1, processes=True,
            dashboard_address="127.0.0.1:0", silence_logs=logging.CRITICAL,
        )  # fmt: skip
        with cluster, Client(cluster, set_as_default=False) as client:
            yield _announced(client)
        return
    try:
        client = Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            "no Dask scheduler answers", field="--scheduler", value=scheduler,
            cure="start one with `dask scheduler`, or give --scheduler local",
        ) from error  # fmt: skip
    with client:
        _check_versions(client)
        yield _announced(client)


def _announced(client: Any) -> Any:
    _LOG.info("dashboard: %s", client.dashboard_link)
    return client


def worker_version() -> str:
    """Return the version of cangauge, on a worker."""
    return __version__


def _check_versions(client: Any) -> None:
    try:
        found = client.run(worker_version)
    except OSError as error:
        raise CangaugeError(LOST) from error
    except Exception as error:
        raise InputError(
            f"the workers cannot run cangauge: {error}", field="--scheduler",
            cure=f"install 'cangauge[fleet]' {__version__} where the workers run",
        ) from error  # fmt: skip
    for address, version in found.items():
        if version != __version__:
            raise InputError(
                f"worker {address} has cangauge {version}, not {__version__}",
                field="--scheduler",
                cure="install the same version everywhere",
            )


def run_job(job: Job, logs: Sequence[FleetLog], dataset: Dataset, client: Any) -> Summary:
    """Compute the rows of all logs that are not known yet.

    Parameters
    ----------
    job : Job
    logs : sequence of FleetLog
        By vehicle; those of a vehicle in order of time.
    dataset : Dataset
        Its rows of the same run are kept.
    client : distributed.Client

    Raises
    ------
    CangaugeError
        If the scheduler is lost, or the job cannot be prepared; finished rows are kept.
    """
    run = _Run(job, logs, dataset, client)
    try:
        run.compute()
    finally:
        run.flush()
    dataset.settle(run_id(job), run.touched)
    run.summary.seconds = time.monotonic() - run.began
    _LOG.info("%s: %s", job.kind, run.summary)
    return run.summary


class _Run:
    """State of a run: lanes of logs, tasks in flight, rows to be written.

    A lane is computed in order, one log after the other: a single log, or all logs of a vehicle if
    the job passes a state from each to the next.
    """

    def __init__(self, job: Job, logs: Sequence[FleetLog], dataset: Dataset, client: Any) -> None:
        self.summary = Summary(len(logs), of=job.of)
        self.began = time.monotonic()
        self.touched: list[FleetLog] = []
        self._job, self._dataset, self._client = job, dataset, client
        self._id = run_id(job)
        self._to_do = self._lanes_of(logs)
        self._lanes = iter(self._to_do)
        self._in_flight: dict[str, _Lane] = {}
        self._rows: list[dict[str, Any]] = []
        self._bad: list[dict[str, Any]] = []
        self._reasons: dict[str, str] = {}
        self._flushed = self._reported = self._asked = self.began
        self._threads = 0

    def _lanes_of(self, logs: Sequence[FleetLog]) -> list[_Lane]:
        known = self._dataset.known(self._id, *self._job.resumes_with)
        lanes: dict[str, _Lane] = {}
        for log in logs:
            lane = lanes.setdefault(log.vehicle if self._job.is_chained else log.url, _Lane())
            row = known.get(log.url)
            chained = replace(log, stamp=self._job.chained_stamp(lane.stamp, log))
            lane.stamp = chained.stamp
            # What follows a log that is computed begins with its state.
            if lane.waiting or row is None or row["stamp"] != chained.stamp:
                lane.waiting.append((chained, _valid_for(row, log)))
            elif "is_final" in row:
                self.summary.bad_before += 1
            else:
                self.summary.skipped += 1
                lane.state = row.get("state")
        return [lane for lane in lanes.values() if lane.waiting]

    def compute(self) -> None:
        from distributed import as_completed  # noqa: PLC0415 - an extra

        if not self._to_do:
            return
        # A task, not scattered data: it is computed again if its worker is lost.
        job = self._client.submit(_prepared, self._job, key=f"job-{self._id}")
        done = as_completed(loop=self._client.loop, with_results=True, raise_errors=False)
        if not self._ask_workers():
            _LOG.info("waiting for workers")
        self._fill(done, job)
        while self._in_flight:
            self._wait(done)
            future, result = next(done)
            self._take(future, result, done, job)
            self._fill(done, job)
            self._report()

    def _wait(self, done: Any) -> None:
        """Wait for a task, and write what is due meanwhile."""
        while not done.has_ready():
            if time.monotonic() - self._flushed >= FLUSH_S:
                self.flush()
            time.sleep(POLL_S)

    def _fill(self, done: Any, job: Any) -> None:
        wanted = max(2, TASKS_PER_THREAD * self._threads)
        while len(self._in_flight) < wanted and (lane := next(self._lanes, None)) is not None:
            self._submit(lane, done, job)

    def _ask_workers(self) -> int:
        """Return the number of workers now, and note their threads."""
        threads = self._client.nthreads()
        self.summary.workers = max(self.summary.workers, len(threads))
        self._threads = sum(threads.values())
        return len(threads)

    def _submit(self, lane: _Lane, done: Any, job: Any) -> None:
        log, sha256 = lane.waiting.popleft()
        lane.log = log
        key = text_sha256(f"{self._id}{log.url}{log.stamp}")
        future = self._client.submit(
            perform, job, log, sha256, lane.state, key=f"{self._job.kind}-{key[:24]}", pure=False
        )
        self._in_flight[future.key] = lane
        done.add(future)

    def _take(self, future: Any, result: Any, done: Any, job: Any) -> None:
        lane = self._in_flight.pop(future.key)
        if isinstance(result, Outcome):  # also where its worker is lost after it was fetched
            outcome = result
        elif future.status in {"cancelled", "lost"}:
            raise CangaugeError(LOST)
        elif job.status == "error":  # no log has a result
            raise _failure_of(job.exception())
        else:  # distributed gives type, error and traceback of a task that could not run
            error = result[1] if isinstance(result, tuple) else future.exception()
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            outcome = Outcome(lane.log, reason=reason, kind=_kind_of(error), is_final=False)
        self._keep(outcome)
        if outcome.row is not None:
            lane.state = outcome.row.get("state")
        if lane.waiting:
            self._submit(lane, done, job)

    def _keep(self, outcome: Outcome) -> None:
        keys = keys_of(outcome.log, self._id, outcome.sha256, outcome.seconds)
        if outcome.reason:
            self.summary.bad += 1
            columns = {name: getattr(outcome, name) for name in BAD}
            self._bad.append(keys | columns)
            reason = self._reasons.setdefault(outcome.kind, reason_of(self._bad[-1]))
            self.summary.reasons[reason] = self.summary.reasons.get(reason, 0) + 1
            _LOG.debug("set aside: %s", outcome.reason)
        elif outcome.row is None:
            self.summary.skipped += 1
            self.touched.append(outcome.log)
        else:
            self.summary.done += 1
            self._rows.append(keys | outcome.row)

    def _report(self) -> None:
        now = time.monotonic()
        if now - self._flushed >= FLUSH_S or len(self._rows) >= FLUSH_ROWS:
            self.flush()
        if now - self._asked < ASK_S:
            return
        self._asked, workers = now, self._ask_workers()
        _LOG.debug("%s: %s (%d workers)", self._job.kind, self.summary, workers)
        if now - self._reported >= REPORT_S:
            self._reported = now
            _LOG.info("%s: %s (%d workers)", self._job.kind, self.summary, workers)

    def flush(self) -> None:
        """Write the rows that are finished."""
        rows, bad = self._rows, self._bad
        self._rows, self._bad = [], []
        self._dataset.add(rows)
        self._dataset.add(bad, bad=True)
        self._flushed = time.monotonic()


@dataclass
class _Lane:
    waiting: deque[tuple[FleetLog, str]] = field(default_factory=deque)
    """Logs with the content hash that they had, if they were computed before."""
    state: str | None = None
    stamp: str = ""
    log: FleetLog = field(default_factory=lambda: FleetLog("", "", ""))
    """In flight."""


def _valid_for(row: dict[str, Any] | None, log: FleetLog) -> str:
    """Return the hash of the content for which the row of a log stays valid, or ""."""
    if row is None or "is_final" in row or row.get("stated") != log.stated:
        return ""
    return str(row["sha256"])


def _failure_of(error: BaseException) -> CangaugeError:
    """Return the error that keeps a job from being prepared, to be raised here."""
    if isinstance(error, CangaugeError):
        return error
    return CangaugeError(f"the job cannot be prepared: {type(error).__name__}: {error}")


def _prepared(job: Job) -> Job:
    return job.prepared()


def perform(job: Job, log: FleetLog, known_sha256: str, state: str | None) -> Outcome:
    """Compute the row of one log, on a worker; whatever fails is returned as a reason.

    Parameters
    ----------
    job : Job
    log : FleetLog
    known_sha256 : str
        Hash of the content that a row exists for; "" if there is none.
    state : str, optional
        Of the job after the log before.
    """
    began = time.monotonic()
    sha256, reason, kind, is_final = "", "", "", True
    row: dict[str, Any] | None = None
    try:
        with local_file(log.url) if job.reads_log else _nothing() as path:
            sha256 = (file_sha256(path) or "") if path is not None else log.stamp
            if path is not None and not sha256:
                raise InputError("no such file", source=log.url)  # noqa: TRY301 - as by a reader
            if job.is_chained or sha256 != known_sha256:
                row = job.row(log, path, state)
    except InputError as error:
        reason, kind = str(_about(error, log)), _kind_of(error)
    except Exception as error:  # noqa: BLE001 - one log never stops the others
        reason, kind = f"{log.url}: {type(error).__name__}: {error}", _kind_of(error)
        is_final = False
    return Outcome(log, sha256, time.monotonic() - began, row, reason, kind, is_final)


def _kind_of(error: BaseException) -> str:
    if isinstance(error, InputError):
        return str(InputError(error.problem, field=error.field))
    return f"{type(error).__name__} {getattr(error, 'strerror', None) or ''}".strip()


@contextmanager
def _nothing() -> Iterator[None]:
    yield None


def _about(error: InputError, log: FleetLog) -> InputError:
    """Return the error about the log's URL, not about the worker's copy."""
    return InputError(
        error.problem, source=log.url, field=error.field, value=error.value, cure=error.cure
    )

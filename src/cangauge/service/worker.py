"""Run jobs in a thread, so that a slow, full or broken disk never blocks the receive loop."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Final

from cangauge.errors import CangaugeError

Job = Callable[[], None]

CLOSE_WITHIN_S: Final = 0.7
"""Time limit of what is left to write when the service ends [s]."""


def start_thread(run: Callable[[], object], name: str) -> threading.Thread:
    """Start and return a daemon thread; raise CangaugeError where the system starts none."""
    thread = threading.Thread(target=run, name=name, daemon=True)
    try:
        thread.start()
    except RuntimeError as error:
        raise CangaugeError(
            f"{name}: {error}; raise the limit of threads (ulimit -u, TasksMax=) or memory"
            " (ulimit -v)"
        ) from error
    return thread


class Worker:
    """A daemon thread that runs jobs in order.

    Parameters
    ----------
    name : str
        Name of the thread.
    on_error : callable
        Takes the exception of a failed job, in the thread.
    jobs_at_most : int
        Jobs that may wait.
    """

    def __init__(self, name: str, on_error: Callable[[Exception], None], jobs_at_most: int) -> None:
        self._on_error = on_error
        self._jobs: queue.Queue[Job | None] = queue.Queue(jobs_at_most)
        self._thread = start_thread(self._run, name)

    def submit(self, job: Job) -> bool:
        """Add a job without waiting; return False if too many wait."""
        try:
            self._jobs.put_nowait(job)
        except queue.Full:
            return False
        return True

    def close(self, within_s: float) -> bool:
        """Run the jobs that wait and end the thread; return False if that takes longer [s]."""
        try:
            self._jobs.put(None, timeout=within_s)
        except queue.Full:
            return False
        self._thread.join(within_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                job()
            except Exception as error:  # noqa: BLE001 - reported; the thread must live on
                self._on_error(error)

"""Write in a thread, so that a slow, full or broken disk never blocks the receive loop."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Final

Job = Callable[[], None]

MAX_WAITING_BYTES: Final = 8 << 20
"""Default limit of the memory for waiting jobs [bytes]."""


class AsyncWriter:
    """Run jobs in order in a daemon thread; `submit` and `replace` never wait.

    Parameters
    ----------
    name : str
        Name of the thread.
    retry_s : float, optional
        Repeat a failed job after this time [s] until it succeeds. By default it is dropped.
    max_waiting_bytes : int
        Reject jobs while the waiting ones exceed this [bytes].
    on_error : callable, optional
        Takes the exception of a failed job; called in the thread.
    on_recovery : callable, optional
        Called in the thread after the first success that follows a failure.

    Attributes
    ----------
    problem : str or None
        Error of the latest job; None if it succeeded.
    """

    def __init__(
        self,
        name: str,
        *,
        retry_s: float | None = None,
        max_waiting_bytes: int = MAX_WAITING_BYTES,
        on_error: Callable[[Exception], None] | None = None,
        on_recovery: Callable[[], None] | None = None,
    ) -> None:
        self._name = name
        self._retry_s = retry_s
        self.max_waiting_bytes = max_waiting_bytes
        self._on_error = on_error
        self._on_recovery = on_recovery
        self._turn = threading.Condition()
        self._jobs: deque[tuple[Job, int]] = deque()
        self._running: tuple[Job, int] | None = None
        self._waiting_bytes = 0
        self._is_closing = False
        self._thread: threading.Thread | None = None
        self.problem: str | None = None

    def submit(self, job: Job, size: int = 0) -> bool:
        """Add a job.

        Parameters
        ----------
        job : callable
        size : int
            Memory that it holds [bytes]; 0 is always accepted.

        Returns
        -------
        bool
            False if it was rejected: the waiting jobs exceed the limit.
        """
        with self._turn:
            if size and self._waiting_bytes > self.max_waiting_bytes:
                return False
            self._jobs.append((job, size))
            self._waiting_bytes += size
            if self._thread is None:
                self._is_closing = False
                # A daemon: a disk that hangs must not keep the process from ending.
                self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
                self._thread.start()
            self._turn.notify_all()
        return True

    def replace(self, job: Job) -> None:
        """Add a job that supersedes all waiting ones."""
        with self._turn:
            self._jobs.clear()
            self._waiting_bytes = 0
        self.submit(job)

    def flush(self, within_s: float) -> bool:
        """Wait until all jobs are done; return False if that takes longer [s]."""
        with self._turn:
            return self._turn.wait_for(self._is_idle, timeout=within_s)

    def close(self, within_s: float) -> list[Job]:
        """Finish the waiting jobs and end the thread.

        Parameters
        ----------
        within_s : float
            Time limit [s].

        Returns
        -------
        list of callable
            Jobs that failed or were not done in time.
        """
        with self._turn:
            self._is_closing = True
            self._turn.notify_all()
            self._turn.wait_for(lambda: self._is_idle() or self._thread is None, timeout=within_s)
            left = [] if self._running is None else [self._running]
            return [job for job, _ in (*left, *self._jobs)]

    def _is_idle(self) -> bool:
        return self._running is None and not self._jobs

    def _run(self) -> None:
        while True:
            with self._turn:
                self._turn.wait_for(lambda: self._jobs or self._is_closing)
                if not self._jobs:
                    self._thread = None
                    self._turn.notify_all()
                    return
                self._running = self._jobs.popleft()
            error: Exception | None = None
            try:
                self._running[0]()
            except Exception as problem:  # noqa: BLE001 - reported; the thread must live on
                error = problem
            self._report(error)
            with self._turn:
                job, self._running = self._running, None
                if error is not None and self._retry_s is not None:
                    self._jobs.appendleft(job)
                    if self._is_closing:
                        self._thread = None
                        self._turn.notify_all()
                        return
                    self._turn.wait_for(lambda: self._is_closing, timeout=self._retry_s)
                else:
                    self._waiting_bytes = max(self._waiting_bytes - job[1], 0)
                self._turn.notify_all()

    def _report(self, error: Exception | None) -> None:
        if error is not None:
            self.problem = getattr(error, "strerror", None) or str(error)
            if self._on_error is not None:
                self._on_error(error)
        elif self.problem is not None:
            self.problem = None
            if self._on_recovery is not None:
                self._on_recovery()

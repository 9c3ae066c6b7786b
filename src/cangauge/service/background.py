"""Writing a file beside the work: a slow or stuck disk never holds the estimator up."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

Item = TypeVar("Item")


class BackgroundWriter(Generic[Item]):
    """Writes the latest item in a thread of its own; one that comes meanwhile replaces the last.

    Parameters
    ----------
    write : callable
        Writes an item; whatever it raises is kept for `take_error`.
    """

    def __init__(self, write: Callable[[Item], None]) -> None:
        self._write = write
        self._turn = threading.Condition()
        self._waiting: Item | None = None
        self._is_busy = False
        self._error: Exception | None = None
        self._thread: threading.Thread | None = None
        self.written = 0
        """Items written so far."""

    def submit(self, item: Item) -> None:
        """Take an item to write; returns at once."""
        with self._turn:
            self._waiting = item
            if self._thread is None:
                # A daemon: a disk that hangs does not keep the process from ending.
                self._thread = threading.Thread(target=self._run, name="state", daemon=True)
                self._thread.start()
            self._turn.notify_all()

    def flush(self, seconds: float) -> bool:
        """Wait until all is written; return False if that takes longer [s]."""
        with self._turn:
            return self._turn.wait_for(
                lambda: self._waiting is None and not self._is_busy, timeout=seconds
            )

    def take_error(self) -> Exception | None:
        """Return what went wrong since the last call, if anything."""
        with self._turn:
            error, self._error = self._error, None
            return error

    def _run(self) -> None:
        while True:
            with self._turn:
                self._turn.wait_for(lambda: self._waiting is not None)
                item, self._waiting = self._waiting, None
                self._is_busy = True
            error: Exception | None = None
            try:
                if item is not None:
                    self._write(item)
            except Exception as problem:  # noqa: BLE001 - told by `take_error`; the thread lives on
                error = problem
            with self._turn:
                self._is_busy = False
                self._error = error
                self.written += error is None
                self._turn.notify_all()

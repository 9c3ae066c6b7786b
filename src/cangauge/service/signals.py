"""Ending politely, and re-reading: signals ask, and whoever loops looks."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def stop_on_signals() -> Iterator[Callable[[], bool]]:
    """Yield a function that says whether SIGINT (Ctrl-C) or SIGTERM has come.

    A second one is treated as it always was, so that what hangs can still be ended. For the main
    thread only.
    """
    came: list[int] = []
    kinds = (signal.SIGINT, signal.SIGTERM)
    before = {kind: signal.getsignal(kind) for kind in kinds}

    def note(number: int, _frame: FrameType | None) -> None:
        came.append(number)
        for kind in kinds:
            signal.signal(kind, before[kind])

    for kind in kinds:
        signal.signal(kind, note)
    try:
        yield lambda: bool(came)
    finally:
        for kind in kinds:
            signal.signal(kind, before[kind])


@contextmanager
def note_hangups() -> Iterator[Callable[[], bool]]:
    """Yield a function that says once for each time whether SIGHUP has come.

    When the terminal that this program was started in is closed, that is a SIGHUP too, but means
    the end: it then becomes a SIGTERM. For the main thread only; where there is no SIGHUP
    (Windows), none comes.
    """
    if not hasattr(signal, "SIGHUP"):
        yield lambda: False
        return
    came: list[int] = []
    had_terminal = _has_terminal()

    def note(number: int, _frame: FrameType | None) -> None:
        if had_terminal and not _has_terminal():
            signal.raise_signal(signal.SIGTERM)
        else:
            came.append(number)

    def take() -> bool:
        if not came:
            return False
        came.clear()
        return True

    before = signal.signal(signal.SIGHUP, note)
    try:
        yield take
    finally:
        signal.signal(signal.SIGHUP, before)


def _has_terminal() -> bool:
    try:
        os.close(os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY))
    except OSError:
        return False
    return True

"""Names of `_files`, and what only the bus and the service still use; falls with their users."""

from __future__ import annotations

import os
import signal
import stat
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from types import FrameType
from typing import Final

from cangauge._files import (
    FOR_GROUP,
    FULL,
    MAX_LOG_BYTES,
    MIB,
    PRIVATE,
    atomic_path,
    check_writable,
    file_sha256,
    open_regular,
    read_beginning,
    read_bounded,
    require_suffix,
    sole_writer,
    text_sha256,
    write_text_atomic,
    write_texts_atomic,
)
from cangauge.errors import InputError

__all__ = [
    "FOR_GROUP",
    "FULL",
    "MAX_LOG_BYTES",
    "MIB",
    "PRIVATE",
    "atomic_path",
    "check_writable",
    "file_sha256",
    "open_regular",
    "read_beginning",
    "read_bounded",
    "require_suffix",
    "sole_writer",
    "text_sha256",
    "write_text_atomic",
    "write_texts_atomic",
]

READ_WITHIN_S: Final = 120.0
"""Time for reading a configuration with its model, map and DBC [s]: the largest DBC takes up to
24 s (see `MAX_DBC_BYTES`), on a machine five times slower 120 s."""
MAX_READING_MEMORY: Final = 2048 * MIB
"""Memory of the process that does so; the largest DBC takes 0.3 GB."""


class _OutOfTime(BaseException):
    """Not an Exception: parsers catch those."""


_limited: bool = False


@contextmanager
def time_limit(path: str | PathLike[str], seconds: float = READ_WITHIN_S) -> Iterator[None]:
    """Raise InputError if the block takes longer [s]; the outermost limit counts.

    For parsers in Python: a call into C is interrupted at its end. Without effect outside the main
    thread and on Windows, which have no signal to interrupt with.

    Parameters
    ----------
    path : path-like
        The file that is read, for the message.
    seconds : float
    """
    global _limited  # noqa: PLW0603 - there is one timer in a process
    is_main = threading.current_thread() is threading.main_thread()
    if _limited or not is_main or not hasattr(signal, "setitimer"):
        yield
        return

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise _OutOfTime

    before = signal.signal(signal.SIGALRM, interrupt)
    began_s = time.monotonic()
    # Repeated: a finalizer, in which Python ignores exceptions, may meet the first one.
    left_s, _ = signal.setitimer(signal.ITIMER_REAL, seconds, 1.0)
    _limited = True
    try:
        yield
    except _OutOfTime:
        raise InputError(
            f"takes more than {seconds:g} s to read",
            source=path,
            cure="remove the messages and values that you do not need, or read it on a faster"
            " machine",
        ) from None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        _limited = False
        signal.signal(signal.SIGALRM, before)
        if left_s:
            elapsed_s = time.monotonic() - began_s
            signal.setitimer(signal.ITIMER_REAL, max(left_s - elapsed_s, 1e-3))


def refuse_pipe(path: str | PathLike[str]) -> None:
    """Raise InputError for a pipe that a service would write: whoever reads it could stop it.

    A command may write one: Ctrl-C ends it.
    """
    if stat.S_ISFIFO(_mode(Path(path)) or 0):
        raise InputError(
            "this is a pipe (FIFO): whoever reads it could stop the service",
            source=path,
            cure="name a file",
        )


def refuse_foreign(path: str | PathLike[str]) -> None:
    """Raise InputError if writing `path` would write what somebody else chose.

    In a folder such as `/tmp` (sticky, writable by all) anybody can place a link or pipe under a
    name that is written later. As Linux does for opening a file (`fs.protected_symlinks`,
    `fs.protected_fifos`), a link is followed and a pipe written there only if it belongs to this
    user or to the folder's owner. A file that is renamed into place never meets those checks.
    Disks and sockets, which no file can replace, are refused everywhere.
    """
    if not hasattr(os, "geteuid"):  # Windows
        return
    rest = list(Path(path).parts)
    place = Path("/" if Path(path).is_absolute() else ".")
    for _ in range(_MOST_PARTS):
        if not rest:
            return
        name = rest.pop(0)
        if name == "..":
            place = place / ".." if place.name in {"", ".."} else place.parent
            continue
        found = place / name  # an absolute path begins with its root
        try:
            state, folder = found.lstat(), place.lstat()
            target = found.readlink() if stat.S_ISLNK(state.st_mode) else None
        except (OSError, ValueError):
            return  # absent, or impossible: creating it reports which
        if target is not None:
            _refuse_planted(state, folder, "a symbolic link", path)
            rest = [*target.parts, *rest]
            continue
        if not rest and stat.S_ISFIFO(state.st_mode):
            _refuse_planted(state, folder, "a pipe (FIFO)", path)
        if not rest and (stat.S_ISBLK(state.st_mode) or stat.S_ISSOCK(state.st_mode)):
            kind = "a disk" if stat.S_ISBLK(state.st_mode) else "a socket"
            raise InputError(f"this is {kind}, not a file", source=path, cure="name a file")
        place = found


_MOST_PARTS: Final = 4096
"""Most parts of a path, with those of the links in it: a circle of links ends here."""


def _refuse_planted(
    state: os.stat_result, folder: os.stat_result, kind: str, path: str | PathLike[str]
) -> None:
    shared = stat.S_ISVTX | stat.S_IWOTH
    if folder.st_mode & shared == shared and state.st_uid not in {os.geteuid(), folder.st_uid}:
        raise InputError(
            f"leads over {kind} that another user placed in a shared folder",
            source=path,
            cure="remove it, or name a file in a folder of your own",
        )


def _mode(path: Path) -> int | None:
    try:
        return path.stat().st_mode
    except OSError:
        return None

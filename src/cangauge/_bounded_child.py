"""A child process that reads a hostile file within bounds of memory and time.

Some readers follow the pointers of a damaged file in endless loops, into gigabytes of memory, or
into errors of any kind. The child sends blocks through a pipe, and is killed if it is silent for
too long.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import struct
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, Final, Self, cast

from cangauge._io import MAX_MF4_MEMORY, MF4_SILENCE_S, MF4_SILENCE_S_PER_MIB, MIB
from cangauge.errors import InputError

DATA: Final = b"F"
_END, _DAMAGED, _MISSING = b"E", b"D", b"M"
_BLOCK: Final = struct.Struct("<cQ")
"""Kind of block, and the number of bytes that follow."""

Send = Callable[[bytes], None]
"""Sends a block of data to the parent."""


class BoundedChild:
    """A module of this package in a child process; use it in a `with` block.

    Parameters
    ----------
    module : str
        Runs `serve` as its main program; its argument is the path of the unpacked file.
    content : binary file object
        Copied to a temporary file.
    source : path-like or None
        For messages.

    Raises
    ------
    InputError
        By `blocks`, if a package is not installed.
    ValueError
        By `blocks`, where the file is damaged, or cannot be read within bounds of time and memory.
    """

    def __init__(self, module: str, content: Any, source: Path | None) -> None:
        self._source = source
        self._stack = contextlib.ExitStack()
        folder = self._stack.enter_context(tempfile.TemporaryDirectory())
        plain = Path(folder) / "x.mf4"
        with plain.open("wb") as copy:
            shutil.copyfileobj(content, copy, MIB)
        self._patience_s = MF4_SILENCE_S + MF4_SILENCE_S_PER_MIB * plain.stat().st_size / MIB
        # The same interpreter and our own module: nothing in the file becomes a command.
        self._process = subprocess.Popen(  # noqa: S603
            [sys.executable, "-P", "-m", module, str(plain)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )
        self._stack.callback(self._end)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self._stack.close()

    def _end(self) -> None:
        self._process.kill()
        with contextlib.suppress(BrokenPipeError):
            cast("BinaryIO", self._process.stdin).close()
        cast("BinaryIO", self._process.stdout).close()
        self._process.wait()

    def ask(self, line: bytes) -> None:
        """Send a line to the child."""
        pipe = cast("BinaryIO", self._process.stdin)
        with contextlib.suppress(BrokenPipeError):  # it has ended; `blocks` tells why
            pipe.write(line + b"\n")
            pipe.flush()

    def blocks(self) -> Iterator[bytes]:
        """Yield the blocks of data until the child reports the end."""
        while True:
            what, data = self._next()
            if what == DATA:
                yield data
                continue
            if what == _END:
                return
            reason = data.decode("utf-8", errors="replace")
            if what == _MISSING:
                raise InputError(
                    f"reading ASAM MF4 needs another package: {reason}",
                    source=self._source,
                    cure="pip install 'cangauge[mf4]'",
                )
            raise ValueError(reason)

    def _next(self) -> tuple[bytes, bytes]:
        pipe = cast("BinaryIO", self._process.stdout)
        timer = threading.Timer(self._patience_s, self._process.kill)
        timer.start()
        try:
            head = pipe.read(_BLOCK.size)
            if len(head) < _BLOCK.size:
                return _DAMAGED, b"it cannot be read within bounds of time and memory"
            what, length = _BLOCK.unpack(head)
            return what, pipe.read(length)
        finally:
            timer.cancel()


def serve(work: Callable[[str, Send], None]) -> None:
    """Run the child's side: `work` gets the path and sends blocks; its end or error is reported."""
    _limit_memory()
    out = sys.stdout.buffer

    def send(what: bytes, data: bytes) -> None:
        out.write(_BLOCK.pack(what, len(data)) + data)
        out.flush()

    last = (_END, b"")
    try:
        work(sys.argv[1], lambda data: send(DATA, data))
    except (NotImplementedError, ImportError) as error:
        last = (_MISSING, str(error).encode())
    except Exception as error:  # noqa: BLE001 - asammdf raises any kind of error on damage
        reason = f"{type(error).__name__}: {error}".splitlines()[0][:200]
        last = (_DAMAGED, reason.encode("utf-8", errors="replace"))
    send(*last)
    # Skip the destructors of half-read files, which may take long or fail.
    os._exit(0)


def _limit_memory() -> None:
    if sys.platform == "win32":
        return
    import resource  # noqa: PLC0415 - not on Windows

    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_DATA, (MAX_MF4_MEMORY, MAX_MF4_MEMORY))

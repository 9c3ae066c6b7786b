"""How large an input may be: every bound that a reader of files keeps, in one place.

They stand far above what real files need and far below what hurts the machine. What exceeds one
is refused by an `InputError`, before the time or the memory is spent.

Opening what a user names as a file: regular files alone, and never more than a bound of them.

Writing files so that nothing half-written is ever left under the wanted name.
"""

from __future__ import annotations

import errno
import gzip
import io
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final, cast

from cangauge.errors import CangaugeError, InputError

# --- How large an input may be: every bound that a reader of files keeps, in one place

MIB: Final = 1 << 20

# --- all packed files (gzip, zip) ---------------------------------------------------------------
UNPACK_FREE_BYTES: Final = 16 * MIB
"""Whatever unpacks to no more than this may do so at any ratio."""
UNPACK_RATIO: Final = 250
"""Beyond it, a file may unpack to so many times its size (real recordings: up to 43 times)."""

# --- logs ---------------------------------------------------------------------------------------
MAX_LOG_BYTES: Final = 1024 * MIB
"""Of a log, packed or unpacked: it is read whole."""
MAX_LOG_ROWS: Final = 20_000_000
"""Rows of a log, samples of a capture: 23 days at 10 Hz, 0.8 GB of numbers."""
MAX_LOG_COLUMNS: Final = 10_000
MAX_LOG_SPAN_S: Final = 366 * 86400.0
"""From the first row to the last [s]: where a clock was set within a log, decades seem to pass."""
MAX_HEADING: Final = 200
"""A column's heading that is longer is none that is known [characters]."""
MAX_ODD_ROWS: Final = 100
"""Rows with a wrong number of cells that are kept for the message."""
MAX_PARQUET_NAMES: Final = 16 * MIB
"""Longest text, and longest list, in a Parquet file's footer [bytes, items]."""

# --- captures -----------------------------------------------------------------------------------
MAX_CAPTURE_BYTES: Final = 64 * 1024 * MIB
"""Of a capture, unpacked: it is read as a stream."""
MAX_LINE: Final = 16 * 1024
"""No capture has longer lines; what is longer is not text, or hostile [characters]."""
MAX_IDLE_LINES: Final = 1_000_000
"""So many lines in a row without a frame are no capture."""
MAX_BLF_OBJECT: Final = 16 * MIB
"""Of one object of a BLF file, packed or unpacked (its writers fill 128 KiB)."""
MAX_MF4_MEMORY: Final = 4096 * MIB
"""Of the process that reads an MF4 file."""
MF4_SILENCE_S: Final = 60.0
MF4_SILENCE_S_PER_MIB: Final = 0.5
"""It may give no frame for so long [s], longer with the file's size."""
MAX_BUSES: Final = 64
"""Buses in one capture: each is decoded for itself."""
MAX_STAMP_S: Final = 1e11
"""Largest time stamp of a frame or a row [s]: the year 5138, if it counts from 1970."""

# --- DBC ----------------------------------------------------------------------------------------
MAX_DBC_BYTES: Final = 4 * MIB
"""Reading takes 1–6 s a megabyte; the largest files in use are smaller than this."""

# --- configurations, maps, model files ----------------------------------------------------------
MAX_TOML_BYTES: Final = 64 * 1024
MAX_TOML_KEY: Final = 32
"""Parts of a dotted key: reading takes time and memory with their square."""
MAX_MODEL_BYTES: Final = 4 * MIB
"""A model of 64 delays has 0.2 MB."""
MAX_MODEL_COLUMNS: Final = 256
"""Columns that the information in a model file may have."""
MAX_MODEL_ITEMS: Final = 4096
"""Effects, source logs, coefficients in a model file, each."""
MAX_SPEED_TRACE_BYTES: Final = 64 * MIB


# --- Opening what a user names as a file: regular files alone, and never more than a bound o…

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

_PIECE: Final = 1 << 20
GZIP: Final = b"\x1f\x8b"

# Reading these would wait for ever, never end, or do something to a machine.
_NO_FILES: Final = (
    (stat.S_ISFIFO, "this is a pipe (FIFO), not a file"),
    (stat.S_ISCHR, "this is a device, not a file"),
    (stat.S_ISBLK, "this is a device, not a file"),
    (stat.S_ISSOCK, "this is a socket, not a file"),
)


def open_regular(path: str | PathLike[str]) -> BinaryIO:
    """Open a regular file for reading.

    Raises
    ------
    InputError
        If it is absent, a folder, a device, a pipe or a socket, or cannot be read.
    """
    try:
        _refuse_special(Path(path).stat().st_mode, path)
        # Should it be swapped for a pipe right now, opening does not wait for a writer.
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        file = cast("BinaryIO", os.fdopen(os.open(path, flags), "rb"))
    except (OSError, ValueError) as error:  # ValueError: a null byte in the path
        raise _unreadable(error, path) from error
    try:
        _refuse_special(os.fstat(file.fileno()).st_mode, path)
    except InputError:
        file.close()
        raise
    return file


def _read_at_most(file: BinaryIO, size: int) -> bytes:
    """Read in pieces: reading at once takes memory for all that there might be."""
    data = bytearray()
    while len(data) < size and (piece := file.read(min(_PIECE, size - len(data)))):
        data += piece
    return bytes(data)


def read_bounded(path: str | PathLike[str], limit: int, what: str) -> bytes:
    """Return the content of a regular file of at most `limit` bytes.

    Parameters
    ----------
    path : path-like
    limit : int
        [bytes]
    what : str
        What the file should be, for the message ("a model file").

    Raises
    ------
    InputError
        As `open_regular`, or if the file is larger.
    """
    try:
        with open_regular(path) as file:
            data = _read_at_most(file, limit + 1)
    except OSError as error:
        raise _unreadable(error, path) from error
    if len(data) > limit:
        raise too_large(path, limit, what)
    return data


def too_large(path: str | PathLike[str], limit: int, what: str) -> InputError:
    """Return the error that says that a file is larger than `limit` [bytes]."""
    return InputError(
        f"larger than the {_amount(limit)} that {what} may have",
        source=path,
        cure="check that this is the right file, or cut it into parts",
    )


def gunzip_bounded(packed: BinaryIO, path: str | PathLike[str], limit: int) -> io.BufferedReader:
    """Return a reader of an open gzip file's content that refuses to unpack without bounds.

    The content breaks off with `EOFError`, `OSError` or `zlib.error` where the file does.

    Parameters
    ----------
    packed : binary file
        From `open_regular`; closed with the reader.
    path : path-like
        For the message.
    limit : int
        Of the content [bytes].

    Raises
    ------
    InputError
        While reading: if the content has more than `limit` bytes, or more than `UNPACK_FREE_BYTES`
        and `UNPACK_RATIO` times the file's.
    """
    size = os.fstat(packed.fileno()).st_size
    unpacked = gzip.GzipFile(fileobj=packed, mode="rb")
    return io.BufferedReader(Bounded(unpacked, path, min(limit, unpacks_to(size)), packed))


def unpacks_to(packed_bytes: int) -> int:
    """Return how much a packed file of some size may unpack to [bytes]."""
    return max(UNPACK_FREE_BYTES, UNPACK_RATIO * packed_bytes)


class Bounded(io.RawIOBase):
    """A stream that ends in an InputError after so many bytes.

    Parameters
    ----------
    source : buffered reader
        Where the bytes come from; closed with this one.
    path : path-like
        For the message.
    limit : int
        [bytes]
    below : binary file, optional
        Another file to close with this one.
    """

    def __init__(
        self,
        source: io.BufferedIOBase,
        path: str | PathLike[str],
        limit: int,
        below: BinaryIO | None = None,
    ) -> None:
        self._source = source
        self._path = path
        self._limit = limit
        self._below = below
        self._given = 0

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: WriteableBuffer, /) -> int:
        """Read one part."""
        view = memoryview(buffer)
        # One part at a time: what stands before a break in the file is given out first.
        part = self._source.read1(view.nbytes)
        self._given += len(part)
        if self._given > self._limit:
            raise _bomb(self._path, self._limit)
        view[: len(part)] = part
        return len(part)

    def close(self) -> None:
        """Close the source too."""
        if not self.closed:
            self._source.close()
            if self._below is not None:
                self._below.close()
        super().close()


def _bomb(path: str | PathLike[str], limit: int) -> InputError:
    return InputError(
        f"unpacks to more than {_amount(limit)}, which no recording of its size does",
        source=path,
        cure="unpack it yourself and check what it holds",
    )


def _amount(limit: int) -> str:
    return f"{limit // 1024 // 1024} MB" if limit >= 1 << 20 else f"{limit // 1024} kB"


def _refuse_special(mode: int, path: str | PathLike[str]) -> None:
    if stat.S_ISDIR(mode):
        raise InputError("this is a folder, not a file", source=path, cure="name a file in it")
    for is_kind, problem in _NO_FILES:
        if is_kind(mode):
            raise InputError(problem, source=path, cure="save its content as a file, name that")


def _unreadable(error: OSError | ValueError, path: str | PathLike[str]) -> InputError:
    shown = Path(path)
    if isinstance(error, FileNotFoundError | NotADirectoryError):
        return InputError("no such file", source=shown, cure="check the path")
    reason = getattr(error, "strerror", None) or str(error)
    cure = "change its rights" if isinstance(error, PermissionError) else "check the path"
    return InputError(f"cannot be read: {reason}", source=shown, cure=cure)


# --- Writing files so that nothing half-written is ever left under the wanted name

FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}
"""Errors of a disk that is full or fails, which pass."""
_CURES: dict[int, tuple[str, str]] = {
    errno.ENOENT: ("the folder of this file does not exist", "create it or name another one"),
    errno.ENOTDIR: ("a part of this path is a file, not a folder", "name another path"),
    errno.EACCES: ("the folder of this file is not writable", "change its rights or name another"),
    errno.EPERM: ("the folder of this file is not writable", "change its rights or name another"),
    errno.EROFS: ("the file system is read-only", "name another folder"),
    errno.ENAMETOOLONG: ("the file name is too long", "name a shorter one"),
}


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path`; move it there if the block ends well.

    The temporary file exists (empty), is on the same file system and keeps the suffix. When the
    block raises, it is removed and whatever stood at `path` before is untouched. The contents are
    on the disk before the name changes, so that a power cut leaves the old file or the new one.
    A device or pipe (`/dev/stdout`) cannot be replaced and is yielded as it is.

    Parameters
    ----------
    path : path-like
        The file to write; a symbolic link is followed.

    Yields
    ------
    Path
        Where to write.

    Raises
    ------
    InputError
        If the folder does not exist or is not writable, or `path` is a folder.
    CangaugeError
        If the disk is full or fails while writing.
    """
    target = Path(path)
    if _is_device(target):
        yield target
        return
    target = Path(os.path.realpath(target))
    part = _new_beside(target, shown=path)
    try:
        yield part
        _to_disk(part)
        mode = _mode(target)
        if mode is not None:
            part.chmod(stat.S_IMODE(mode))
        part.replace(target)
    except OSError as error:
        if error.errno not in FULL:
            raise
        problem = f"{path}: writing failed: {error.strerror}; free some space"
        raise CangaugeError(problem) from error
    finally:
        with suppress(FileNotFoundError):
            part.unlink()


def write_text_atomic(path: str | os.PathLike[str], text: str) -> None:
    """Write `text` as UTF-8 at `path`, all or nothing (see `atomic_path`)."""
    with atomic_path(path) as part:
        part.write_text(text, encoding="utf-8", newline="\n")


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raise the InputError that writing `path` would raise, before any long work is done."""
    if not _is_device(Path(path)):
        _new_beside(Path(os.path.realpath(path)), shown=path).unlink()


def _is_device(path: Path) -> bool:
    mode = _mode(path)
    return mode is not None and not stat.S_ISREG(mode) and not stat.S_ISDIR(mode)


def _mode(path: Path) -> int | None:
    try:
        return path.stat().st_mode
    except OSError:  # absent, or a path that cannot be: creating it will say which
        return None


def _new_beside(target: Path, *, shown: str | os.PathLike[str]) -> Path:
    mode = _mode(target)
    if mode is not None and stat.S_ISDIR(mode):
        raise InputError("this is a folder", source=shown, cure="name a file in it")
    # The suffix stays last: writers such as pyarrow and bokeh choose by it.
    part = target.with_name(f".{target.stem[:200]}.{secrets.token_hex(4)}{target.suffix}")
    try:
        part.touch(exist_ok=False)
    except OSError as error:
        problem, cure = _CURES.get(
            error.errno or 0, (f"cannot be written: {error.strerror}", "name another path")
        )
        raise InputError(problem, source=shown, cure=cure) from error
    return part


def _to_disk(path: Path) -> None:
    with path.open("rb") as file:
        os.fsync(file.fileno())

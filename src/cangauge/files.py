"""Opening what a user names as a file: regular files alone, and never more than a bound of them."""

from __future__ import annotations

import gzip
import io
import os
import stat
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final, cast

from cangauge.errors import InputError
from cangauge.limits import UNPACK_FREE_BYTES, UNPACK_RATIO

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

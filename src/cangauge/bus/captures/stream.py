"""Files as streams of bytes or lines: unpacked, bounded in memory, ends that are cut off noted."""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

from cangauge.errors import InputError

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

MAX_LINE: Final = 16 * 1024
"""No capture has longer lines; what is longer is not text, or hostile [characters]."""
HEAD_BYTES: Final = 64 * 1024
_GZIP: Final = b"\x1f\x8b"


def open_bytes(path: Path) -> io.BufferedIOBase:
    """Open a file, unpacking gzip whatever its name.

    Raises
    ------
    InputError
        If it is absent or cannot be read.
    """
    try:
        with path.open("rb") as file:
            packed = file.read(2) == _GZIP
        return gzip.GzipFile(path, "rb") if packed else path.open("rb")
    except FileNotFoundError as error:
        raise InputError("no such file", source=path, cure="check the path") from error
    except IsADirectoryError as error:
        raise InputError("this is a folder", source=path, cure="name a file in it") from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"cannot be read: {reason}", source=path) from error


def read_head(path: Path) -> bytes:
    """Return the unpacked beginning of a file, as much as can be read of it.

    Raises
    ------
    InputError
        As `open_bytes`.
    """
    head = bytearray()
    with open_bytes(path) as file:
        while len(head) < HEAD_BYTES:
            try:
                # Step by step: what stands before a break in a gzip file is given out first.
                part = file.read1(HEAD_BYTES)
            except (EOFError, OSError, zlib.error):
                break
            if not part:
                break
            head += part
    return bytes(head)


class LineStream:
    """The lines of a text file.

    Attributes
    ----------
    number : int
        Of the latest line, from 1.
    cut_off : bool
        Whether the file broke off (a truncated or damaged gzip).
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.number = 0
        self.cut_off = False

    def __iter__(self) -> Iterator[str]:
        """Yield the lines with their line ends; an overlong line comes in pieces."""
        with open_bytes(self._path) as raw:
            salvage = _Salvage(raw, self)
            text = io.TextIOWrapper(io.BufferedReader(salvage), "latin-1", newline="\n")
            while line := text.readline(MAX_LINE):
                self.number += 1
                yield line


class _Salvage(io.RawIOBase):
    """Reads in small steps and ends quietly where the file below breaks off."""

    def __init__(self, raw: io.BufferedIOBase, owner: LineStream) -> None:
        self._raw = raw
        self._owner = owner

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: WriteableBuffer, /) -> int:
        view = memoryview(buffer)
        try:
            # One step at a time: what stands before the break is given out first.
            part = self._raw.read1(view.nbytes)
        except (EOFError, OSError, zlib.error):
            self._owner.cut_off = True
            return 0
        view[: len(part)] = part
        return len(part)

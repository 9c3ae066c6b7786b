"""Files as streams of bytes or lines: unpacked, bounded in memory, ends that are cut off noted."""

from __future__ import annotations

import io
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast

from cangauge.files import GZIP, gunzip_bounded, open_regular
from cangauge.limits import MAX_CAPTURE_BYTES, MAX_LINE

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

HEAD_BYTES: Final = 64 * 1024


def open_bytes(path: Path) -> io.BufferedReader:
    """Open a file, unpacking gzip whatever its name.

    Raises
    ------
    InputError
        If it is absent, not a regular file or cannot be read; while reading, if it unpacks
        without bounds (see `cangauge.limits`).
    """
    file = open_regular(path)
    packed = file.read(2) == GZIP
    file.seek(0)
    if packed:
        return gunzip_bounded(file, path, MAX_CAPTURE_BYTES)
    return cast("io.BufferedReader", file)


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

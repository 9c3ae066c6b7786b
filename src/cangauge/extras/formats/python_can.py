"""Captures in the formats that python-can reads: ASC, BLF, TRC, MF4, CSV."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Any, ClassVar, Final

import can
from can.io.blf import BLFParseError

from cangauge.bus.readers import MAX_LINE, BinaryReader
from cangauge.errors import InputError

_OBJECT: Final = struct.Struct("<8sI4x")
"""Header of an object in a BLF, with its size [bytes]."""


class LibraryReader(BinaryReader):
    """Reader of a format that python-can reads.

    Attributes
    ----------
    library : callable
        Class of python-can that takes a file object.
    is_text : bool
    marks : tuple of bytes
        One of these begins a file.
    """

    library: ClassVar[Callable[..., Any]]
    is_text: ClassVar[bool] = True
    marks: ClassVar[tuple[bytes, ...]]

    @classmethod
    def matches(cls, head: bytes) -> bool:
        """Return whether the file begins with the format's mark."""
        return head.startswith(cls.marks)

    def read(self) -> Iterator[can.Message]:
        """Yield the frames, without those whose length contradicts their DLC."""
        for message in type(self).library(_WholeLines(self.raw) if self.is_text else self.raw):
            is_whole = message.is_remote_frame or len(message.data) == message.dlc
            if is_whole or message.is_error_frame:
                yield message
            else:
                self.skip(None)


class _WholeLines:
    """The lines of a text for python-can's readers; a cut one is damage: it may read as a frame."""

    def __init__(self, raw: io.BufferedIOBase) -> None:
        self._text = io.TextIOWrapper(raw, "utf-8", errors="replace")  # type: ignore[type-var]
        self.close = self._text.close

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        line = self._text.readline(MAX_LINE)
        if line and not line.endswith("\n"):
            raise EOFError("it ends in a line")
        if not line:
            raise StopIteration
        return line


class AscReader(LibraryReader):
    """Vector ASC."""

    name, library = "Vector ASC", can.ASCReader

    @classmethod
    def matches(cls, head: bytes) -> bool:
        """Return whether it begins with a date and a base."""
        lines = head[:2000].lower().splitlines()[:10]
        bases = (b"base hex", b"base dec")
        return head[:5].lower() == b"date " and any(
            line.strip().startswith(bases) for line in lines
        )


class _EndingBlf(can.BLFReader):
    """python-can's reader; it would read an object whose size leads to no next one for ever."""

    def _parse_data(self, data: bytes) -> Iterator[can.Message]:
        place = data.find(b"LOBJ", 0, 8)
        while 0 <= place <= len(data) - _OBJECT.size:
            _, size = _OBJECT.unpack_from(data, place)
            if size < _OBJECT.size:
                raise BLFParseError(f"an object of {size} bytes")
            place = data.find(b"LOBJ", place + size, place + size + 8)
        yield from super()._parse_data(data)


class BlfReader(LibraryReader):
    """Vector BLF."""

    name, library, is_text, marks = "Vector BLF", _EndingBlf, False, (b"LOGG",)


class TrcReader(LibraryReader):
    """PEAK TRC."""

    name, library = "PEAK TRC", can.TRCReader

    @classmethod
    def matches(cls, head: bytes) -> bool:
        """Return whether it begins with PEAK's comments."""
        begin = head[:4000]
        return head.startswith(b";") and (b";$FILEVERSION=" in begin or b"PCAN" in begin)


class CsvReader(LibraryReader):
    """python-can's CSV."""

    name, library = "python-can CSV", can.CSVReader
    marks = (b"timestamp,arbitration_id,extended,remote,error,dlc,data",)


class Mf4Reader(LibraryReader):
    """ASAM MF4 with bus logging."""

    name, library, is_text = "ASAM MF4", can.MF4Reader, False
    marks = (b"MDF     ", b"UnFinMF ")

    def read(self) -> Iterator[can.Message]:
        """Yield the frames; raise InputError if asammdf is not installed."""
        if find_spec("asammdf") is None:
            raise InputError(
                "reading ASAM MF4 needs another package: No module named 'asammdf'",
                source=self.source,
                cure="pip install 'cangauge[mf4]'",
            )
        self.raw = io.BytesIO(self.raw.read())  # asammdf goes back and forth in it
        yield from super().read()


READERS: Final = (AscReader, BlfReader, TrcReader, Mf4Reader, CsvReader)

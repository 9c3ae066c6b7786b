"""Captures that python-can reads: Vector ASC and BLF, PEAK TRC, and its own CSV.

Sizes in a BLF file are checked before python-can uses them, and lines are of bounded length, so
that a hostile or damaged file neither hangs nor exhausts memory.
"""

from __future__ import annotations

import io
import logging
import struct
import zlib
from abc import abstractmethod
from collections.abc import Callable, Iterator
from typing import Any, ClassVar, Final, Self

import can

from cangauge._io import MAX_BLF_OBJECT, MAX_LINE
from cangauge.bus.captures.reader import BinaryReader, is_whole

# --- Vector BLF, checked before python-can reads it. A BLF file is a sequence of objects, most of
# them containers of further objects, compressed by zlib. python-can trusts every size in it: an
# object of length 0 makes it loop endlessly, and a container unpacks to any size.

_OBJECT: Final = struct.Struct("<4sHHLL")
"""Signature, length of the header, its version, length of the object, type."""
_CONTAINER: Final = struct.Struct("<H6xL4x")
"""Compression method, length unpacked."""
_FILE_HEADER: Final = struct.Struct("<4sL")
"""Signature, length of the file's header."""
_SIGNATURE: Final = b"LOBJ"
_CONTAINER_TYPE: Final = 10
_PLAIN, _ZLIB = 0, 2
_MAX_FILE_HEADER: Final = 64 * 1024
_WINDOW: Final = 8
"""The signature of an object ends at most this many bytes after the object before."""


class _CheckedBlf:
    """A BLF file for python-can's reader, with checked sizes and unpacked containers.

    Parameters
    ----------
    raw : buffered reader

    Raises
    ------
    ValueError, EOFError, zlib.error
        By `read`, where the file is damaged or cut off.
    """

    def __init__(self, raw: io.BufferedIOBase) -> None:
        self._raw = raw
        self._objects = bytearray()
        """Unpacked content from the first incomplete object on."""
        self._ready = memoryview(self._header())

    def read(self, size: int = -1, /) -> bytes:
        """Return the next bytes; fewer at the end of the file."""
        if size < 0:
            raise ValueError("a negative length")
        parts = []
        while size > 0:
            if not self._ready:
                self._ready = memoryview(self._next())
                if not self._ready:
                    break
            parts.append(bytes(self._ready[:size]))
            self._ready = self._ready[size:]
            size -= len(parts[-1])
        return b"".join(parts)

    def close(self) -> None:
        """Close the file."""
        self._raw.close()

    def _header(self) -> bytes:
        head = self._raw.read(_FILE_HEADER.size)
        if len(head) < _FILE_HEADER.size:
            raise EOFError("it ends in its header")
        _, length = _FILE_HEADER.unpack(head)
        if not _FILE_HEADER.size <= length <= _MAX_FILE_HEADER:
            raise ValueError(f"a header of {length} bytes")
        return head + self._raw.read(length - len(head))

    def _next(self) -> bytes:
        """Return an unpacked container of the next whole objects; b"" at the end of the file."""
        while True:
            content = self._container()
            if content is None:
                if len(self._objects) >= _OBJECT.size:
                    raise EOFError("it ends in an object")
                return b""
            self._objects += content
            end = self._end_of_whole_objects()
            if end:
                whole = bytes(self._objects[:end])
                del self._objects[:end]
                body = _CONTAINER.pack(_PLAIN, len(whole)) + whole
                length = _OBJECT.size + len(body)
                head = _OBJECT.pack(_SIGNATURE, _OBJECT.size, 1, length, _CONTAINER_TYPE)
                return head + body + bytes(length % 4)

    def _container(self) -> bytes | None:
        """Return the unpacked content of the next container; None at the end of the file."""
        while True:
            head = self._raw.read(_OBJECT.size)
            if not head:
                return None
            if len(head) < _OBJECT.size:
                raise EOFError("it ends in an object")
            kind, length = _kind_and_length(head, 0)
            body = self._raw.read(length - len(head))
            if len(body) < length - len(head):
                raise EOFError("it ends in an object")
            self._raw.read(length % 4)
            if kind == _CONTAINER_TYPE:
                return _unpacked(body)

    def _end_of_whole_objects(self) -> int:
        place, size = 0, len(self._objects)
        while True:
            found = self._objects.find(_SIGNATURE, place, place + _WINDOW)
            if found < 0:
                if place + _WINDOW <= size:
                    raise ValueError("data that are no object")
                return place
            if found + _OBJECT.size > size:
                return place
            _, length = _kind_and_length(self._objects, found)
            if found + length > size:
                return place
            place = found + length


def _kind_and_length(data: bytes | bytearray, place: int) -> tuple[int, int]:
    signature, _, _, length, kind = _OBJECT.unpack_from(data, place)
    if signature != _SIGNATURE:
        raise ValueError("data that are no object")
    if not _OBJECT.size <= length <= MAX_BLF_OBJECT:
        raise ValueError(f"an object of {length} bytes")
    return kind, length


def _unpacked(body: bytes) -> bytes:
    if len(body) < _CONTAINER.size:
        raise ValueError("an empty container")
    method, _ = _CONTAINER.unpack_from(body)
    content = body[_CONTAINER.size :]
    if method == _PLAIN:
        return content
    if method != _ZLIB:
        raise ValueError(f"an unknown compression ({method})")
    content = zlib.decompressobj().decompress(content, MAX_BLF_OBJECT + 1)
    if len(content) > MAX_BLF_OBJECT:
        raise ValueError(f"a container that unpacks to more than {MAX_BLF_OBJECT} bytes")
    return content


# --- Readers

# python-can's readers log a line for every unknown object; a hostile file can have millions.
logging.getLogger("can").addHandler(logging.NullHandler())


class LibraryReader(BinaryReader):
    """Reader of a format that python-can reads.

    Attributes
    ----------
    library : callable
        Class of python-can that takes a file object.
    """

    library: ClassVar[Callable[..., Any]]

    @classmethod
    def matches(cls, head: bytes) -> int:
        """Return 1 for a file of this format, else 0."""
        return int(cls.is_mine(head))

    @staticmethod
    @abstractmethod
    def is_mine(head: bytes) -> bool:
        """Return whether the beginning of a file is of this format."""

    def read(self) -> Iterator[can.Message]:
        """Yield the frames, without those whose length contradicts their DLC."""
        for message in type(self).library(self.content()):
            if is_whole(message):
                yield message
            else:
                self.skip(None)

    def content(self) -> Any:
        """Return the file object for python-can's reader."""
        return _Lines(self.raw)


class AscReader(LibraryReader):
    """Vector ASC."""

    name = "Vector ASC"
    library = can.ASCReader

    @staticmethod
    def is_mine(head: bytes) -> bool:
        """Return whether it begins with a date and a base."""
        lines = head[:2000].lower().splitlines()
        return (
            bool(lines)
            and lines[0].startswith(b"date ")
            and any(line.strip().startswith((b"base hex", b"base dec")) for line in lines[:10])
        )


class BlfReader(LibraryReader):
    """Vector BLF."""

    name = "Vector BLF"
    library = can.BLFReader

    @staticmethod
    def is_mine(head: bytes) -> bool:
        """Return whether it begins with the format's mark."""
        return head.startswith(b"LOGG")

    def content(self) -> Any:
        """Return the file with checked sizes."""
        return _CheckedBlf(self.raw)


class TrcReader(LibraryReader):
    """PEAK TRC."""

    name = "PEAK TRC"
    library = can.TRCReader

    @staticmethod
    def is_mine(head: bytes) -> bool:
        """Return whether it begins with PEAK's comments."""
        return head.startswith(b";") and (
            b";$FILEVERSION=" in head[:4000] or b"PCAN" in head[:4000]
        )


class CsvReader(LibraryReader):
    """python-can's CSV."""

    name = "python-can CSV"
    library = can.CSVReader

    @staticmethod
    def is_mine(head: bytes) -> bool:
        """Return whether it begins with python-can's headings."""
        return head.startswith(b"timestamp,arbitration_id,extended,remote,error,dlc,data")


class _Lines:
    """The lines of a text for python-can's readers, of bounded length."""

    def __init__(self, raw: io.BufferedIOBase) -> None:
        self._text = io.TextIOWrapper(raw, "utf-8", errors="replace")  # type: ignore[type-var]

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> str:
        line = self._text.readline(MAX_LINE)
        if not line:
            raise StopIteration
        if len(line) >= MAX_LINE:
            raise ValueError(f"a line of more than {MAX_LINE} characters")
        if not line.endswith("\n"):
            raise EOFError("it ends in a line")  # whose last byte may be short
        return line

    def close(self) -> None:
        self._text.close()

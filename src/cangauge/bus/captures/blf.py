"""Vector BLF, checked before python-can reads it.

A BLF file is a row of objects, most of them containers of more objects, packed by zlib. python-can
believes every size in it: an object of no length holds it for ever, and a container unpacks to
whatever it likes. Here containers are unpacked within bounds, sizes are checked, and what comes
out goes on as containers that are not packed.
"""

from __future__ import annotations

import io
import struct
import zlib
from typing import Final

from cangauge.limits import MAX_BLF_OBJECT

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
"""The signature of an object ends at most so many bytes after the object before."""


class CheckedBlf:
    """A BLF file as python-can reads it: `read` and `close` alone, and all sizes true.

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
        """Unpacked, from the first object that is not complete yet."""
        self._ready = memoryview(self._header())

    def read(self, size: int = -1, /) -> bytes:
        """Return the next bytes; fewer at the end of the file."""
        if size < 0:
            raise ValueError("something has a negative length")
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
        """Return a container of the next whole objects; b"" at the end of the file."""
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
        """Return what the next container holds, unpacked; None at the end of the file."""
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
                    raise ValueError("something that is no object")
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
        raise ValueError("something that is no object")
    if not _OBJECT.size <= length <= MAX_BLF_OBJECT:
        raise ValueError(f"an object of {length} bytes")
    return kind, length


def _unpacked(body: bytes) -> bytes:
    if len(body) < _CONTAINER.size:
        raise ValueError("a container of nothing")
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

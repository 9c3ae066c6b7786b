"""Captures in the formats that python-can reads: BLF, TRC, MF4, CSV."""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Callable, Generator, Iterator
from importlib.util import find_spec
from itertools import chain
from typing import Any, ClassVar, Final

import can
from can.io import blf
from can.io.blf import BLFParseError
from can.io.generic import BinaryIOMessageReader
from can.util import dlc2len

from cangauge._files import MIB
from cangauge._text import counted
from cangauge.bus.readers import MAX_LINE, CaptureReader
from cangauge.errors import InputError

_OBJECT: Final = struct.Struct("<8sI4x")
"""Header of an object in a BLF, with its size [bytes]."""
MAX_CONTAINER: Final = 64 * MIB
"""Largest container of a BLF, unpacked [bytes]; loggers write 128 kB."""


class LibraryReader(CaptureReader, BinaryIOMessageReader):
    """Reader of a format that python-can reads.

    Attributes
    ----------
    library : callable
        Class of python-can, or a function, that takes a file object or lines, and yields frames.
    mark : bytes
        Regular expression of the beginning of a file.
    comment : str
        Of a text: what begins a line that states no frame; "" for a binary format.
    given : int
        Other lines that python-can was given: it is silent about those that it leaves out.
    """

    library: ClassVar[Callable[..., Any]]
    mark: ClassVar[bytes]
    comment: ClassVar[str] = ""
    given = _unread = 0

    @classmethod
    def matches(cls, head: bytes) -> bool:
        """Return whether the file begins with the format's mark."""
        return re.match(cls.mark, head) is not None

    def lines(self) -> Iterator[str]:
        """Yield the lines of a text; a cut one is damage, because it may read as a frame."""
        raw: Any = self.raw
        text = io.TextIOWrapper(raw, "utf-8", errors="replace")
        while line := text.readline(MAX_LINE):
            if not line.endswith("\n"):
                raise EOFError("it ends in a line")
            self.given += not line.isspace() and not line.startswith(self.comment)
            yield line

    def _of_text(self) -> Iterator[can.Message]:
        """Yield the frames; python-can stops at a malformed line, and is begun again after it."""
        lines, head = self.bounded(self.lines()), list[str]()
        for line in lines:
            if not line.startswith(self.comment):
                lines = chain([line], lines)
                break
            head.append(line)
        is_whole = False
        while not is_whole:
            before = self.given
            try:
                yield from type(self).library(line for part in (head, lines) for line in part)
                is_whole = True
            except (ValueError, LookupError):
                if self.given == before:
                    raise
                self._unread += 1
                self.skip(None)

    def read(self) -> Iterator[can.Message]:
        """Yield the frames, without those whose length contradicts their DLC."""
        source = self._of_text() if self.comment else type(self).library(self.raw)
        taken = 0
        for message in source:
            taken += 1
            is_whole = message.is_remote_frame or len(message.data) == message.dlc
            if is_whole or message.is_error_frame:
                yield message
            else:
                self.skip(None)
        left_out = getattr(source, "objects", self.given) - taken - self._unread
        if left_out > 0:
            what = "line" if self.comment else "object"
            self.remarks.append(
                f"{counted(left_out, what)} left out, which python-can does not read"
            )


class _InPieces:
    """A file whose `read` takes memory as the data come, whatever length a damaged file states."""

    _PIECE: Final = 1 << 20

    def __init__(self, raw: Any) -> None:
        self._raw, self.close = raw, raw.close

    def read(self, size: int) -> bytes:
        if size < 0:
            raise BLFParseError("a length that is negative")
        data = bytearray()
        while piece := self._raw.read(min(size - len(data), self._PIECE)):
            data += piece
        return bytes(data)


class _EndingBlf(can.BLFReader):
    """python-can's reader with a limit on the size of a container.

    Without it a small file unpacks to gigabytes, and an object that states a wrong size is read
    again and again.
    """

    objects = 0

    def __init__(self, raw: Any) -> None:
        super().__init__(_InPieces(raw))  # type: ignore[arg-type]

    def __iter__(self) -> Generator[can.Message, None, None]:
        while head := self.file.read(blf.OBJ_HEADER_BASE_STRUCT.size):
            mark, _, _, size, kind = blf.OBJ_HEADER_BASE_STRUCT.unpack(head)
            if mark != b"LOBJ":
                raise BLFParseError("no object")
            data = self.file.read(size - len(head))
            self.file.read(size % 4)
            if kind != blf.LOG_CONTAINER:
                continue
            method, _ = blf.LOG_CONTAINER_STRUCT.unpack_from(data)
            data = data[blf.LOG_CONTAINER_STRUCT.size :]
            if method == blf.ZLIB_DEFLATE:
                unpacking = zlib.decompressobj()
                data = unpacking.decompress(data, MAX_CONTAINER)
                if unpacking.unconsumed_tail:
                    raise BLFParseError(f"a container of more than {MAX_CONTAINER // MIB} MB")
            yield from self._parse_container(data)
        self.stop()

    def _parse_data(self, data: bytes) -> Iterator[can.Message]:
        place = data.find(b"LOBJ", 0, 8)
        while 0 <= place <= len(data) - _OBJECT.size:
            _, size = _OBJECT.unpack_from(data, place)
            if size < _OBJECT.size:
                raise BLFParseError(f"an object of {size} bytes")
            self.objects += place + size <= len(data)  # else it is in the next container too
            place = data.find(b"LOBJ", place + size, place + size + 8)
        yield from super()._parse_data(data)


def _trc_frames(lines: Iterator[str]) -> Iterator[can.Message]:
    for message in can.TRCReader(_of_known_version(lines)):  # type: ignore[arg-type]
        if message.is_fd:  # python-can leaves the code of the length
            message.dlc = dlc2len(message.dlc)
        yield message


def _of_known_version(lines: Iterator[str]) -> Iterator[str]:
    """Yield the lines of a TRC as of version 1.3, which has a sixth column that 1.2 lacks."""
    is_1_2 = False
    for line in lines:
        cells = line.split()
        if line.startswith(";$FILEVERSION=1.2"):
            is_1_2 = True
            yield ";$FILEVERSION=1.3\n"
        elif line.startswith(";$STARTTIME="):
            yield line.rstrip("; \r\n")
        elif is_1_2 and len(cells) > 5 and cells[5] != "-":
            yield " ".join([*cells[:5], "-", *cells[5:]])
        else:
            yield line


def _mf4_frames(raw: Any) -> Any:
    if find_spec("asammdf") is None:
        raise InputError(
            "reading ASAM MF4 needs another package: No module named 'asammdf'",
            source=getattr(raw, "name", None),
            cure="pip install 'cangauge[mf4]'",
        )
    return can.MF4Reader(io.BytesIO(raw.read()))  # asammdf goes back and forth in it


READERS: Final = (
    LibraryReader.of("Vector BLF", library=_EndingBlf, mark=b"LOGG"),
    LibraryReader.of(
        "PEAK TRC",
        library=_trc_frames,
        mark=rb"(?s)(?=;).{0,3999}(;\$FILEVERSION=|PCAN)",
        comment=";",
    ),
    LibraryReader.of("ASAM MF4", library=_mf4_frames, mark=b"MDF     |UnFinMF "),
    LibraryReader.of(
        "python-can CSV",
        library=can.CSVReader,
        mark=b"timestamp,arbitration_id,extended,remote,error,dlc,data",
        comment="timestamp,arbitration_id",
    ),
)

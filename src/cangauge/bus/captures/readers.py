"""Readers of capture formats: text formats line by line, binary and vendor formats by python-can.

A hostile or damaged file must neither hang nor exhaust memory: sizes in a BLF file are checked
before python-can uses them, lines are of bounded length, MF4 is read in a child process.
"""

from __future__ import annotations

import io
import logging
import re
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import can
from can.io.blf import BLFParseError

from cangauge._io import MAX_BLF_OBJECT, MAX_LINE
from cangauge.bus.captures.files import Stamps, open_bytes
from cangauge.bus.captures.mf4 import mf4_messages

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


# --- Formats that python-can reads

# Its readers log a line for every unknown object, of which a hostile file can have millions.
logging.getLogger("can").addHandler(logging.NullHandler())

# Errors of python-can's readers on damaged files.
DAMAGE: Final = (
    ValueError,
    LookupError,
    TypeError,
    ArithmeticError,
    EOFError,
    OSError,
    struct.error,
    zlib.error,
    BLFParseError,
)


@dataclass(frozen=True, slots=True)
class LibraryFormat:
    """A format that python-can reads.

    Parameters
    ----------
    name : str
    reader : callable
        Class of python-can that takes a file object.
    is_text : bool
    matches : callable
        Returns whether the beginning of a file is of this format.
    """

    name: str
    reader: Callable[..., Any]
    is_text: bool
    matches: Callable[[bytes], bool]


def _is_asc(head: bytes) -> bool:
    lines = head[:2000].lower().splitlines()
    return (
        bool(lines)
        and lines[0].startswith(b"date ")
        and any(line.strip().startswith((b"base hex", b"base dec")) for line in lines[:10])
    )


def _is_trc(head: bytes) -> bool:
    return head.startswith(b";") and (b";$FILEVERSION=" in head[:4000] or b"PCAN" in head[:4000])


def _is_csv(head: bytes) -> bool:
    return head.startswith(b"timestamp,arbitration_id,extended,remote,error,dlc,data")


def _is_blf(head: bytes) -> bool:
    return head.startswith(b"LOGG")


def _is_mf4(head: bytes) -> bool:
    return head.startswith((b"MDF     ", b"UnFinMF "))


LIBRARY_FORMATS: Final = (
    LibraryFormat("Vector ASC", can.ASCReader, is_text=True, matches=_is_asc),
    LibraryFormat("Vector BLF", can.BLFReader, is_text=False, matches=_is_blf),
    LibraryFormat("PEAK TRC", can.TRCReader, is_text=True, matches=_is_trc),
    LibraryFormat("ASAM MF4", can.MF4Reader, is_text=False, matches=_is_mf4),
    LibraryFormat("python-can CSV", can.CSVReader, is_text=True, matches=_is_csv),
)


class _Lines:
    """The lines of a text for python-can's readers, of bounded length."""

    def __init__(self, raw: io.BufferedReader) -> None:
        self._text = io.TextIOWrapper(raw, "utf-8", errors="replace")

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> str:
        line = self._text.readline(MAX_LINE)
        if not line:
            raise StopIteration
        if len(line) >= MAX_LINE:
            raise ValueError(f"a line of more than {MAX_LINE} characters")
        return line

    def close(self) -> None:
        self._text.close()


def library_messages(kind: LibraryFormat, path: Path) -> Iterator[can.Message]:
    """Yield the frames of a file; raise one of `DAMAGE` where it breaks off.

    Raises
    ------
    InputError
        If the reader is not installed (MF4 without asammdf).
    """
    if kind.reader is can.MF4Reader:
        yield from mf4_messages(path)
        return
    with open_bytes(path) as raw:
        file: Any = _Lines(raw) if kind.is_text else _CheckedBlf(raw)
        yield from kind.reader(file)


# --- Text formats that are read line by line

Parser = Callable[[str], can.Message | None]
"""Returns the frame of a line, None for a line without one; raises ValueError if malformed."""

_MAX_STANDARD_ID: Final = 0x7FF
_ERROR_FLAG: Final = 0x20000000


@dataclass(frozen=True, slots=True)
class TextFormat:
    """A text format with one frame a line.

    Parameters
    ----------
    name : str
    stamps : {"us", "ms", "none"}
    states_length : bool
        Whether a line states its number of bytes, so that a cut line is recognised.
    parser : callable
        Takes the first lines of the file; returns the parser of lines, or None if they are not of
        this format (for formats with a header).
    """

    name: str
    stamps: Stamps
    states_length: bool
    parser: Callable[[Sequence[str]], Parser | None]


def _data(text: str, length: int) -> bytes:
    data = bytes.fromhex(text)
    if len(data) != length or length > 64:
        raise ValueError("length and bytes differ")
    return data


def _id(text: str) -> tuple[int, bool]:
    """Return id and whether it is extended, for formats that write all ids with 8 digits."""
    number = int(text, 16)
    if number > 0x1FFFFFFF:
        raise ValueError("no such id")
    return number, number > _MAX_STANDARD_ID


# 0000.004429 000001DB 8 FD A0 BA AA 00 00 01 A8
_SPACED = re.compile(r"(\d+\.\d+) ([0-9A-Fa-f]{8}) (\d{1,2})((?: [0-9A-Fa-f]{2})*)\s*$")


def _spaced(_head: Sequence[str]) -> Parser:
    def parse(line: str) -> can.Message | None:
        match = _SPACED.match(line)
        if match is None:
            return _blank(line)
        number, extended = _id(match[2])
        return can.Message(
            timestamp=float(match[1]),
            arbitration_id=number,
            is_extended_id=extended,
            data=_data(match[4], int(match[3])),
        )

    return parse


# ParserFlags <tab> Ch <tab> Counter <tab> T/R <tab> Time <tab> Flags <tab> CAN ID <tab> Len …
_TABLE_COLUMNS: Final = ("Ch", "T/R", "Time", "CAN ID", "Len", "Data")


def _table(head: Sequence[str]) -> Parser | None:
    """Tab-separated, columns by their headings, time in whole milliseconds."""
    headings = [cell.strip() for cell in head[0].rstrip("\r\n").split("\t")]
    if any(name not in headings for name in _TABLE_COLUMNS):
        return None
    channel, way, time, number, length, data = (headings.index(name) for name in _TABLE_COLUMNS)

    def parse(line: str) -> can.Message | None:
        cells = line.rstrip("\r\n").split("\t")
        if cells[0] == headings[0]:
            return None
        if len(cells) <= data:
            return _blank(line)
        arbitration_id, extended = _id(cells[number].strip().removeprefix("0x"))
        return can.Message(
            timestamp=int(cells[time]) / 1000.0,
            arbitration_id=arbitration_id,
            is_extended_id=extended,
            channel=int(cells[channel]),
            is_rx=cells[way] != "TX",
            data=_data(cells[data].strip().removeprefix("0x"), int(cells[length])),
        )

    return parse


# 1632509059.541604 2R11 174 00 00 00 aa 0f 00 00 00
_CRTD = re.compile(r"(\d+\.\d+) (\d*)([RT])(11|29) ([0-9A-Fa-f]{1,8})((?: [0-9A-Fa-f]{2})*)\s*$")
_CRTD_OTHER = re.compile(r"\d+\.\d+ \d*C[A-Z]{2}\b")


def _crtd(_head: Sequence[str]) -> Parser:
    def parse(line: str) -> can.Message | None:
        match = _CRTD.match(line)
        if match is None:
            return None if _CRTD_OTHER.match(line) else _blank(line)
        extended = match[4] == "29"
        number, is_large = _id(match[5])
        if is_large and not extended:
            raise ValueError("no such standard id")
        data = bytes.fromhex(match[6])
        return can.Message(
            timestamp=float(match[1]),
            arbitration_id=number,
            is_extended_id=extended,
            channel=int(match[2] or 1),
            is_rx=match[3] == "R",
            data=_data(match[6], len(data)),
        )

    return parse


#  (1436509052.249713)  can0  1DB   [8]  00 04 C2 62 00 00 03 B6
# Possessive (++): no backtracking over a line of 16,000 blanks.
_CANDUMP = re.compile(
    r"\s*+(?:\((\d++\.\d++)\)\s*+)?(\S++)\s++(?:[RT]X(?:\s++[-BE](?=\s))*+\s++)?"
    r"([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})"
    r"\s++\[(\d++)\]\s++(remote request|(?:[0-9A-Fa-f]{2}\b ?)*)"
)


def _candump(*, with_stamps: bool) -> Callable[[Sequence[str]], Parser | None]:
    def parser(_head: Sequence[str]) -> Parser:
        def parse(line: str) -> can.Message | None:
            match = _CANDUMP.match(line)
            if match is None:
                return _blank(line)
            if (match[1] is not None) is not with_stamps:
                raise ValueError("only some lines have stamps")
            number, length = int(match[3], 16), int(match[4])
            remote = match[5] == "remote request"
            is_error = len(match[3]) == 8 and bool(number & _ERROR_FLAG)
            return can.Message(
                timestamp=float(match[1] or 0.0),
                arbitration_id=number & 0x1FFFFFFF,
                is_extended_id=len(match[3]) == 8,
                channel=match[2],
                is_remote_frame=remote,
                is_error_frame=is_error,
                is_fd=length > 8,
                dlc=length if remote else None,
                data=None if remote else _data(match[5], length),
            )

        return parse

    return parser


# (1436509052.249713) vcan0 044#2A366C2BBA
_CANDUMP_LOG = re.compile(
    r"\((\d+\.\d+)\) (\S+) ([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#"
    r"(?:(#[0-9A-Fa-f])?((?:[0-9A-Fa-f]{2}\.?)*)|R(\d?))(?: ([RT]))?\s*$"
)


def _candump_log(_head: Sequence[str]) -> Parser:
    def parse(line: str) -> can.Message | None:
        match = _CANDUMP_LOG.match(line)
        if match is None:
            return _blank(line)
        number, extended = int(match[3], 16), len(match[3]) == 8
        remote = match[6] is not None
        data = b"" if remote else bytes.fromhex(match[5].replace(".", ""))
        return can.Message(
            timestamp=float(match[1]),
            arbitration_id=number & 0x1FFFFFFF,
            is_extended_id=extended,
            channel=match[2],
            is_remote_frame=remote,
            is_error_frame=extended and bool(number & _ERROR_FLAG),
            is_fd=match[4] is not None,
            is_rx=match[7] != "T",
            dlc=int(match[6] or 0) if remote else None,
            data=None if remote else _data(data.hex(), len(data)),
        )

    return parse


# Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8
# 22213513,00000111,false,Rx,0,8,00,00,00,00,00,00,00,00,
_GVRET_HEADINGS: Final = ("Time Stamp", "ID", "Extended", "Bus", "D1")
_BYTE_ORDER_MARK: Final = "\u00ef\u00bb\u00bf"
"""Of UTF-8, read as latin-1."""
_SHORTEST_FRAME_S: Final = 47e-6
"""A standard frame without data, with the pause after it: 47 bits at 1 Mbit/s, the fastest [s]."""
_FRAMES_FOR_UNIT: Final = 100
"""Frames of one bus from which stamps in milliseconds are told from stamps that came in bursts."""


def _gvret(head: Sequence[str]) -> Parser | None:
    """SavvyCAN's GVRET CSV, with and without direction; time in µs, in some exports in ms."""
    headings = [cell.strip() for cell in head[0].removeprefix(_BYTE_ORDER_MARK).split(",")]
    length_name = next((name for name in ("LEN", "DLC") if name in headings), "")
    if not length_name or any(name not in headings for name in _GVRET_HEADINGS):
        return None
    time, number, extended, bus, first = (headings.index(name) for name in _GVRET_HEADINGS)
    length = headings.index(length_name)
    way = headings.index("Dir") if "Dir" in headings else None
    per_s = 1e3 if _is_too_fast(head[1:], time, bus) else 1e6

    def parse(line: str) -> can.Message | None:
        cells = line.strip().split(",")
        if len(cells) <= length:
            return _blank(line)
        if cells[number] == "ID":
            return None
        arbitration_id, is_large = _id(cells[number])
        count = int(cells[length])
        data = bytes(int(cell, 16) for cell in cells[first : first + count])
        return can.Message(
            timestamp=int(cells[time]) / per_s,
            arbitration_id=arbitration_id,
            is_extended_id=is_large or cells[extended].lower() in {"true", "1"},
            channel=int(cells[bus]),
            is_rx=way is None or cells[way] != "Tx",
            is_fd=count > 8,
            data=_data(data.hex(), count),
        )

    return parse


def _is_too_fast(lines: Sequence[str], time: int, bus: int) -> bool:
    """Return whether a bus cannot carry so many frames if the stamps are microseconds."""
    stamps: dict[str, list[int]] = {}
    for line in lines:
        cells = line.split(",")
        if len(cells) > max(time, bus) and cells[time].isdecimal():
            stamps.setdefault(cells[bus], []).append(int(cells[time]))
    return any(
        len(each) >= _FRAMES_FOR_UNIT
        and max(each) - min(each) < (len(each) - 1) * _SHORTEST_FRAME_S * 1e6
        for each in stamps.values()
    )


# @ TEXT @ 3 @ 64 @ 0 @ 1149 @ 7459 @ 00:00:07.459 @
# 26,641405 <tab> 1 <tab> 00000004 <tab> 112 <tab> 8 <tab> 00 20 C1 0E 01 72 89 00 <tab> …
_CARBUS_HEADER = re.compile(r"@ TEXT @ (\d) @")


def _carbus(head: Sequence[str]) -> Parser | None:
    """CARBUS Analyzer (canhacker.ru): seconds and microseconds; before version 3 milliseconds."""
    match = _CARBUS_HEADER.match(head[0])
    if match is None:
        return None
    per_s = 1e6 if int(match[1]) >= 3 else 1e3

    def parse(line: str) -> can.Message | None:
        if line.startswith(("@", "#")):
            return None
        cells = line.split("\t")
        if len(cells) < 6:
            return _blank(line)
        seconds, fraction = cells[0].split(",")
        arbitration_id, is_large = _id(cells[3])
        return can.Message(
            timestamp=int(seconds) + int(fraction) / per_s,
            arbitration_id=arbitration_id,
            is_extended_id=is_large,
            channel=int(cells[1]),
            data=_data(cells[5], int(cells[4])),
        )

    return parse


# > <tab> 2 <tab>    17:18:39.355:2240.00 <tab> St <tab> 0x112 <tab> 0 <tab> 8 <tab> FF … <tab> p:2
# Minutes, seconds and milliseconds are not padded (17:19:9.69 is 9.069 s); after them stand the
# microseconds since the frame before.
_CAN_HACKER_TIME = re.compile(r"\s*(\d{1,2}):(\d{1,2}):(\d{1,2})\.(\d{1,3})(?::\d+(?:\.\d+)?)?$")
_HALF_A_DAY_S: Final = 43200.0


def _can_hacker(_head: Sequence[str]) -> Parser:
    day_s, latest_s = 0.0, 0.0

    def parse(line: str) -> can.Message | None:
        nonlocal day_s, latest_s
        cells = line.rstrip("\r\n").split("\t")
        if cells[0] != ">":
            return None if line.startswith("CAN speed") else _blank(line)
        match = _CAN_HACKER_TIME.match(cells[2]) if len(cells) > 7 else None
        if match is None or cells[3] not in {"St", "Ext"}:
            raise ValueError("not a frame")
        hours, minutes, seconds, milliseconds = map(int, match.groups())
        time_s = day_s + 3600 * hours + 60 * minutes + seconds + milliseconds / 1e3
        if time_s < latest_s - _HALF_A_DAY_S:  # past midnight
            day_s += 2 * _HALF_A_DAY_S
            time_s += 2 * _HALF_A_DAY_S
        latest_s = time_s
        length = int(cells[6])
        arbitration_id, is_large = _id(cells[4].removeprefix("0x"))
        return can.Message(
            timestamp=time_s,
            arbitration_id=arbitration_id,
            is_extended_id=is_large or cells[3] != "St",
            channel=int(cells[-1].removeprefix("p:")),
            data=_data("".join(cells[7 : 7 + length]), length),
        )

    return parse


def _blank(line: str) -> can.Message | None:
    """Return None for a blank line; raise ValueError for any other."""
    if line.strip():
        raise ValueError("not a frame")
    return None


TEXT_FORMATS: Final = (
    TextFormat("CRTD (OVMS)", "us", states_length=False, parser=_crtd),
    TextFormat("candump log", "us", states_length=False, parser=_candump_log),
    TextFormat("SavvyCAN GVRET CSV", "us", states_length=False, parser=_gvret),
    TextFormat("CARBUS Analyzer trace", "us", states_length=True, parser=_carbus),
    TextFormat("CAN Hacker log", "ms", states_length=True, parser=_can_hacker),
    TextFormat("tab-separated table", "ms", states_length=True, parser=_table),
    TextFormat("seconds, id, length, bytes", "us", states_length=True, parser=_spaced),
    TextFormat("candump with stamps", "us", True, parser=_candump(with_stamps=True)),
    TextFormat("candump without stamps", "none", True, parser=_candump(with_stamps=False)),
)
"""The format with most frames in the beginning of a file is chosen, the first of equals."""

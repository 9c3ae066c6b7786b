"""Text formats of captures that python-can does not read, one frame a line."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import ClassVar, Final

import can

from cangauge.bus.readers import ERROR_FLAG, MAX_ID, LineReader, Stamps, blank


def data_of(text: str, length: int) -> bytes:
    """Return the bytes of hex text; raise ValueError unless there are `length` of them."""
    data = bytes.fromhex(text)
    if len(data) != length or length > 64:
        raise ValueError("length and bytes differ")
    return data


def id_of(text: str) -> tuple[int, bool]:
    """Return id and whether it is extended, for formats that write all ids with 8 digits."""
    number = int(text, 16)
    if not 0 <= number <= MAX_ID:
        raise ValueError("no such id")
    return number, number > 0x7FF


# 0000.004429 000001DB 8 FD A0 BA AA 00 00 01 A8
_SPACED = re.compile(r"(\d+\.\d+) ++([0-9A-Fa-f]{8}) ++(\d{1,2})((?: [0-9A-Fa-f]{2})*)\s*$")
_SPACED_HEADER = re.compile(r"Time\s++ID\s++DLC\b")


class SpacedReader(LineReader):
    """Seconds, id, length, bytes: traces of older CAN Hackers, with or without their header."""

    name = "seconds, id, length, bytes"

    def parse(self, line: str) -> can.Message | None:
        """Return the frame of a line."""
        match = _SPACED.match(line)
        if match is None:
            return None if _SPACED_HEADER.match(line) else blank(line)
        number, extended = id_of(match[2])
        return can.Message(
            timestamp=float(match[1]),
            arbitration_id=number,
            is_extended_id=extended,
            data=data_of(match[4], int(match[3])),
        )


# ParserFlags <tab> Ch <tab> Counter <tab> T/R <tab> Time <tab> Flags <tab> CAN ID <tab> Len …
_TABLE_COLUMNS: Final = ("Ch", "T/R", "Time", "CAN ID", "Len", "Data")


class TableReader(LineReader):
    """Tab-separated, columns by their headings, time in whole milliseconds."""

    name = "tab-separated table"
    stamps: Stamps = "ms"

    def prepare(self, head: Sequence[str]) -> bool:
        """Find the columns."""
        headings = [cell.strip() for cell in head[0].rstrip("\r\n").split("\t")]
        if any(name not in headings for name in _TABLE_COLUMNS):
            return False
        self._first = headings[0]
        self._columns = [headings.index(name) for name in _TABLE_COLUMNS]
        return True

    def parse(self, line: str) -> can.Message | None:
        """Return the frame of a line."""
        cells = line.rstrip("\r\n").split("\t")
        if cells[0] == self._first:
            return None
        channel, way, time, number, length, data = self._columns
        if len(cells) <= data:
            return blank(line)
        arbitration_id, extended = id_of(cells[number].strip().removeprefix("0x"))
        return can.Message(
            timestamp=int(cells[time]) / 1000.0,
            arbitration_id=arbitration_id,
            is_extended_id=extended,
            channel=int(cells[channel]),
            is_rx=cells[way] != "TX",
            data=data_of(cells[data].strip().removeprefix("0x"), int(cells[length])),
        )


# 1632509059.541604 2R11 174 00 00 00 aa 0f 00 00 00
_CRTD = re.compile(r"(\d+\.\d+) (\d*)([RT])(11|29) ([0-9A-Fa-f]{1,8})((?: [0-9A-Fa-f]{2})*)\s*$")
_CRTD_OTHER = re.compile(r"\d+\.\d+ \d*C[A-Z]{2}\b")


class CrtdReader(LineReader):
    """CRTD of OVMS, also as SavvyCAN writes it."""

    name = "CRTD (OVMS)"
    states_length = False

    def parse(self, line: str) -> can.Message | None:
        """Return the frame of a line."""
        match = _CRTD.match(line)
        if match is None:
            return None if _CRTD_OTHER.match(line) else blank(line)
        extended = match[4] == "29"
        number, is_large = id_of(match[5])
        if is_large and not extended:
            raise ValueError("no such standard id")
        data = bytes.fromhex(match[6])
        return can.Message(
            timestamp=float(match[1]),
            arbitration_id=number,
            is_extended_id=extended,
            channel=int(match[2] or 1),
            is_rx=match[3] == "R",
            data=data_of(match[6], len(data)),
        )


#  (1436509052.249713)  can0  1DB   [8]  00 04 C2 62 00 00 03 B6
# Possessive (++): no backtracking over a line of 16,000 blanks.
_CANDUMP = re.compile(
    r"\s*+(?:\((\d++\.\d++)\)\s*+)?(\S++)\s++(?:[RT]X(?:\s++[-BE](?=\s))*+\s++)?"
    r"([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})"
    r"\s++\[(\d++)\]\s++(remote request|(?:[0-9A-Fa-f]{2}\b ?)*)"
)


class CandumpReader(LineReader):
    """Screen output of candump with stamps."""

    name = "candump with stamps"
    has_stamps: ClassVar[bool] = True

    def parse(self, line: str) -> can.Message | None:
        """Return the frame of a line."""
        match = _CANDUMP.match(line)
        if match is None:
            return blank(line)
        if (match[1] is not None) is not self.has_stamps:
            raise ValueError("only some lines have stamps")
        number, length = int(match[3], 16), int(match[4])
        remote = match[5] == "remote request"
        is_error = len(match[3]) == 8 and bool(number & ERROR_FLAG)
        return can.Message(
            timestamp=float(match[1] or 0.0),
            arbitration_id=number & MAX_ID,
            is_extended_id=len(match[3]) == 8,
            channel=match[2],
            is_remote_frame=remote,
            is_error_frame=is_error,
            is_fd=length > 8,
            dlc=length if remote else None,
            data=None if remote else data_of(match[5], length),
        )


class UnstampedCandumpReader(CandumpReader):
    """Screen output of candump without stamps."""

    name = "candump without stamps"
    stamps: Stamps = "none"
    has_stamps = False


# Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8
# 22213513,00000111,false,Rx,0,8,00,00,00,00,00,00,00,00,
_GVRET_HEADINGS: Final = ("Time Stamp", "ID", "Extended", "Bus", "D1")
_BYTE_ORDER_MARK: Final = "\u00ef\u00bb\u00bf"
"""Of UTF-8, read as latin-1."""
_SHORTEST_FRAME_S: Final = 47e-6
"""A standard frame without data, with the pause after it: 47 bits at 1 Mbit/s, the fastest [s]."""
_FRAMES_FOR_UNIT: Final = 100
"""Frames of one bus from which stamps in milliseconds are distinguished from bursts."""
_AS_NUMBER = re.compile(r"([1-9])\.00E\+0(\d)")
"""What a spreadsheet makes of an id such as 2E6; 0E6 is lost."""


class GvretReader(LineReader):
    """SavvyCAN's GVRET CSV, with and without direction; time in µs, in some exports in ms."""

    name = "SavvyCAN GVRET CSV"
    states_length = False

    def prepare(self, head: Sequence[str]) -> bool:
        """Find the columns, and the unit of the stamps."""
        headings = [cell.strip() for cell in head[0].removeprefix(_BYTE_ORDER_MARK).split(",")]
        length_name = next((name for name in ("LEN", "DLC") if name in headings), "")
        if not length_name or any(name not in headings for name in _GVRET_HEADINGS):
            return False
        self._columns = [headings.index(name) for name in (*_GVRET_HEADINGS, length_name)]
        self._way = headings.index("Dir") if "Dir" in headings else None
        self._per_s = 1e6
        if _is_too_fast(head[1:], self._columns[0], self._columns[3]):
            self._per_s = 1e3
            self.stamps = "ms"
            self.remarks.append(
                "too many frames per microsecond for any bus: time stamps are taken as milliseconds"
            )
        self._repaired = 0
        return True

    def parse(self, line: str) -> can.Message | None:
        """Return the frame of a line."""
        cells = line.strip().split(",")
        time, number, extended, bus, first, length = self._columns
        if len(cells) <= length:
            return blank(line)
        if cells[number] == "ID":
            return None
        arbitration_id, is_large = id_of(self._id(cells[number]))
        count = int(cells[length])
        data = bytes(int(cell, 16) for cell in cells[first : first + count])
        return can.Message(
            timestamp=int(cells[time]) / self._per_s,
            arbitration_id=arbitration_id,
            is_extended_id=is_large or cells[extended].lower() in {"true", "1"},
            channel=int(cells[bus]),
            is_rx=self._way is None or cells[self._way] != "Tx",
            is_fd=count > 8,
            data=data_of(data.hex(), count),
        )

    def _id(self, text: str) -> str:
        match = _AS_NUMBER.fullmatch(text)
        if match is None:
            return text
        if not self._repaired:
            self.remarks.append(
                f"a spreadsheet has changed ids into numbers; read back as ids ({text} is"
                f" {match[1]}E{match[2]}), but ids that begin with 0E are lost"
            )
        self._repaired += 1
        return f"{match[1]}E{match[2]}"


def _is_too_fast(lines: Sequence[str], time: int, bus: int) -> bool:
    """Return whether stamps in microseconds would exceed the capacity of a bus."""
    stamps: dict[str, list[int]] = {}
    for line in lines:
        cells = line.split(",")
        if len(cells) > max(time, bus) and cells[time].isdecimal() and len(cells[time]) < 20:
            stamps.setdefault(cells[bus], []).append(int(cells[time]))
    return any(
        len(each) >= _FRAMES_FOR_UNIT
        and max(each) - min(each) < (len(each) - 1) * _SHORTEST_FRAME_S * 1e6
        for each in stamps.values()
    )


# 4F5,FF 34 23 45 24 E4
_ID_AND_DATA = re.compile(r"([0-9A-Fa-f]{3,8}),((?:[0-9A-Fa-f]{2} ?){0,64})\s*$")


class IdDataReader(LineReader):
    """SavvyCAN's generic CSV of id and bytes, which has no time."""

    name = "SavvyCAN id and data CSV"
    stamps: Stamps = "none"
    states_length = False

    def prepare(self, head: Sequence[str]) -> bool:
        """Check the headings."""
        return head[0].strip().startswith("ID,Data")

    def parse(self, line: str) -> can.Message | None:
        """Return the frame of a line."""
        match = _ID_AND_DATA.match(line)
        if match is None:
            return None if line.startswith("ID,Data") else blank(line)
        number, extended = id_of(match[1])
        data = bytes.fromhex(match[2])
        return can.Message(
            arbitration_id=number,
            is_extended_id=extended,
            is_fd=len(data) > 8,
            data=data_of(match[2], len(data)),
        )


# @ TEXT @ 3 @ 64 @ 0 @ 1149 @ 7459 @ 00:00:07.459 @
# 26,641405 <tab> 1 <tab> 00000004 <tab> 112 <tab> 8 <tab> 00 20 C1 0E 01 72 89 00 <tab> …
_CARBUS_HEADER = re.compile(r"@ TEXT @ (\d) @")


class CarbusReader(LineReader):
    """CARBUS Analyzer (canhacker.ru): seconds and microseconds; before version 3 milliseconds."""

    name = "CARBUS Analyzer trace"

    def prepare(self, head: Sequence[str]) -> bool:
        """Find the version."""
        match = _CARBUS_HEADER.match(head[0])
        if match is None:
            return False
        self.stamps = "us" if int(match[1]) >= 3 else "ms"
        return True

    def parse(self, line: str) -> can.Message | None:
        """Return the frame of a line."""
        if line.startswith(("@", "#")):
            return None
        cells = line.split("\t")
        if len(cells) < 6:
            return blank(line)
        seconds, fraction = cells[0].split(",")
        arbitration_id, is_large = id_of(cells[3])
        return can.Message(
            timestamp=int(seconds) + int(fraction) / (1e6 if self.stamps == "us" else 1e3),
            arbitration_id=arbitration_id,
            is_extended_id=is_large,
            channel=int(cells[1]),
            data=data_of(cells[5], int(cells[4])),
        )


# > <tab> 2 <tab>    17:18:39.355:2240.00 <tab> St <tab> 0x112 <tab> 0 <tab> 8 <tab> FF … <tab> p:2
# Minutes, seconds and milliseconds are not padded (17:19:9.69 is 9.069 s); after them stand the
# microseconds since the frame before.
_CAN_HACKER_TIME = re.compile(r"\s*(\d{1,2}):(\d{1,2}):(\d{1,2})\.(\d{1,3})(?::\d+(?:\.\d+)?)?$")
_HALF_A_DAY_S: Final = 43200.0


class CanHackerReader(LineReader):
    """CAN Hacker log: time of day in milliseconds."""

    name = "CAN Hacker log"
    stamps: Stamps = "ms"

    def prepare(self, head: Sequence[str]) -> bool:
        """Begin at the first day."""
        self._day_s = self._latest_s = 0.0
        return bool(head)

    def parse(self, line: str) -> can.Message | None:
        """Return the frame of a line."""
        cells = line.rstrip("\r\n").split("\t")
        if cells[0] != ">":
            return None if line.startswith("CAN speed") else blank(line)
        match = _CAN_HACKER_TIME.match(cells[2]) if len(cells) > 7 else None
        if match is None or cells[3] not in {"St", "Ext"}:
            raise ValueError("not a frame")
        length = int(cells[6])
        arbitration_id, is_large = id_of(cells[4].removeprefix("0x"))
        return can.Message(
            timestamp=self._time_s(*map(int, match.groups())),
            arbitration_id=arbitration_id,
            is_extended_id=is_large or cells[3] != "St",
            channel=int(cells[-1].removeprefix("p:")),
            data=data_of("".join(cells[7 : 7 + length]), length),
        )

    def _time_s(self, hours: int, minutes: int, seconds: int, milliseconds: int) -> float:
        time_s = self._day_s + 3600 * hours + 60 * minutes + seconds + milliseconds / 1e3
        if time_s < self._latest_s - _HALF_A_DAY_S:  # past midnight
            self._day_s += 2 * _HALF_A_DAY_S
            time_s += 2 * _HALF_A_DAY_S
        self._latest_s = time_s
        return time_s

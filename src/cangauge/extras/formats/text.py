"""Text formats of captures that python-can does not read, one frame a line."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime
from itertools import pairwise
from typing import ClassVar, Final

import can

from cangauge.bus.readers import LineReader, candump_frame, frame

_X: Final = "[0-9A-Fa-f]"
_AT_ZERO: Final = dict.fromkeys(("clock", "time", "decimals", "us", "ms", "hex_ms"), "0")


class LineFormat(LineReader):
    """Text whose frames all match one pattern.

    Attributes
    ----------
    pattern : str
        Regular expression. Its groups: the parts of the time, which are added (`clock`, `h:m:s` or
        seconds; `time`, decimal seconds; `decimals` of a second; `us`, `ms`, `hex_ms`); `id` [hex]
        or `decimal`, and `long` or `short` where the line states its width; `data` [hex], `length`,
        `remote`; `bus` (a number, by default 1) or `channel` (its name); `way`, where T or S begins
        that of a sent frame.
    begins, other : str
        Regular expressions of the first line, and of lines that state no frame.
    """

    pattern: ClassVar[str]
    begins: ClassVar[str] = ""
    other: ClassVar[str] = "(?!)"

    def prepare(self, head: Sequence[str]) -> bool:
        """Check the first line."""
        return re.match(self.begins, head[0]) is not None

    def parse(self, line: str) -> can.Message | None:
        """Return the frame of a line."""
        match = re.match(self.pattern, line)
        if match is not None:
            return self.frame_of(match.groupdict(""))
        if re.match(self.other, line):
            return None
        raise ValueError("not a frame")

    def frame_of(self, groups: dict[str, str]) -> can.Message:
        """Return the frame of the groups of the pattern."""
        of = _AT_ZERO | groups
        time_s = float(of["time"]) + float(f"0.{of['decimals']}") + int(of["hex_ms"], 16) / 1e3
        time_s += float(of["ms"]) / 1e3 + float(of["us"]) / 1e6
        clock_s = 0
        for part in of["clock"].split(":"):
            clock_s = 60 * clock_s + int(part)
        is_wide = bool(groups.get("long"))
        return frame(
            clock_s + time_s,
            int(groups["decimal"]) if groups.get("decimal") else groups["id"],
            None if groups.get("remote") else groups["data"],
            groups.get("length"),
            is_extended=is_wide if is_wide or groups.get("short") else None,
            channel=int(groups["bus"] or 1) if "bus" in groups else groups.get("channel"),
            is_rx=groups.get("way", "R")[0].upper() not in "TS",
        )


class SpacedReader(LineFormat):
    """Traces of older CAN Hackers, and of loggers on microcontrollers; whole stamps are in ms."""

    name = "seconds, id, length, bytes"
    # 0000.004429 000001DB 8 FD A0 BA AA 00 00 01 A8
    # 1512293  5F1  8  A8 16 65 9 0 0 0 0
    pattern = (
        rf"(?P<time>\d++(?:\.\d++)?) ++(?P<id>{_X}{{1,8}}) ++(?P<length>\d{{1,2}})"
        rf"(?P<data>(?: ++(?:{_X}{{2}}|{_X}(?=\s)))*+)\s*$"  # a cut byte is none of one digit
    )
    other = r"Time\s++ID\s++DLC\b"

    def prepare(self, head: Sequence[str]) -> bool:
        """Find the unit of the stamps by the first frame."""
        found = (re.match(self.pattern, line) for line in head)
        first = next(filter(None, found), None)
        if first is not None and "." not in first["time"]:
            self.stamps = "ms"
        return first is not None

    def frame_of(self, groups: dict[str, str]) -> can.Message:
        """Return the frame of the groups of the pattern."""
        groups["data"] = "".join(f"{byte:0>2}" for byte in groups["data"].split())
        if self.stamps == "ms":
            groups["ms"] = groups.pop("time")
        return super().frame_of(groups)


class _CandumpFormat(LineFormat):
    """Screen output of candump: ids of eight digits are extended, and have flags."""

    def frame_of(self, groups: dict[str, str]) -> can.Message:
        """Return the frame of the groups of the pattern; a date is taken as UTC."""
        time, date = groups.get("time", "0"), groups.get("date")
        if date:
            time = f"{datetime.fromisoformat(f'{date}{time}+00:00').timestamp():.6f}"
        content = None if groups["remote"] else groups["data"]
        return candump_frame(time, groups["channel"], groups["id"], content, groups["length"])


# ParserFlags <tab> Ch <tab> Counter <tab> T/R <tab> Time <tab> Flags <tab> CAN ID <tab> Len …
# 1 <tab> 0 <tab> 14767 <tab> RX <tab> 1052620673 <tab> <tab> 0x000001da <tab> 8 <tab> 0xc8 …
TableReader = LineFormat.of(
    "tab-separated table",
    pattern=r"[^\t]*\t(?P<bus>\d+)\t[^\t]*\t(?P<way>\w+)\t(?P<ms>\d+)\t[^\t]*\t(?P<id>0x\w+)"
    rf"\t(?P<length>\d+)\t(?:0x)?(?P<data>(?:{_X}| )*)\s",
    stamps="ms",
    other="ParserFlags\t",
)
# Also as SavvyCAN writes it.
# 1632509059.541604 2R11 174 00 00 00 aa 0f 00 00 00
CrtdReader = LineFormat.of(
    "CRTD (OVMS)",
    pattern=r"(?P<time>\d+\.\d+) (?P<bus>\d*)(?P<way>[RT])(?:(?P<short>11)|(?P<long>29))"
    rf" (?P<id>{_X}{{1,8}})(?P<data>(?: {_X}{{2}})*)\s*$",
    states_length=False,
    other=r"\d+\.\d+ \d*C[A-Z]{2}\b",
)
# Of its web page; its ids are not padded, else it looks like candump's.
# (216.112) RX0 7A [8] 00 00 D2 B6 BC 5E 00 00
BatteryEmulatorReader = LineFormat.of(
    "Battery-Emulator log",
    pattern=r"\((?P<time>\d++\.\d++)\) (?P<channel>(?P<way>[RTrt])[Xx]\d++)"
    rf" (?P<id>{_X}{{1,8}}) \[(?P<length>\d++)\](?P<data>(?: {_X}{{2}}\b)*)",
)
# SavvyCAN's generic CSV.
# 4F5,FF 34 23 45 24 E4
IdDataReader = LineFormat.of(
    "SavvyCAN id and data CSV",
    pattern=rf"(?P<id>{_X}{{3,8}}),(?P<data>(?:{_X}{{2}} ?){{0,64}})\s*$",
    stamps="none",
    states_length=False,
    begins=r"\s*ID,Data",
    other="ID,Data",
)
# Of openpilot.
# 15.460,0x440,1,0x4000800000000000
CabanaReader = LineFormat.of(
    "cabana CSV",
    pattern=r"(?P<time>\d+(?:\.\d+)?),(?:(?P<id>0x[0-9A-Fa-f]{1,8})|(?P<decimal>0|[1-9]\d{0,8}))"
    r",(?P<bus>\d{1,9}),(?:0x)?(?P<data>(?:[0-9A-Fa-f]{2}){0,64})\s*$",
    states_length=False,
    begins="time,addr,bus,data",
    other="time,addr,bus,data",
)
# CARBUS Analyzer (canhacker.ru): seconds, and their microseconds, before version 3 milliseconds.
# @ TEXT @ 3 @ 64 @ 0 @ 1149 @ 7459 @ 00:00:07.459 @
# 26,641405 <tab> 1 <tab> 00000004 <tab> 112 <tab> 8 <tab> 00 20 C1 0E 01 72 89 00 <tab> …
_CARBUS: Final = r"\t(?P<bus>\d+)\t[^\t]*\t(?P<id>\w+)\t(?P<length>\d+)\t(?P<data>[^\t]*)"
CarbusReader = LineFormat.of(
    "CARBUS Analyzer trace",
    pattern=rf"(?P<clock>\d+),(?P<us>\d+){_CARBUS}",
    begins="@ TEXT @ [3-9] @",
    other="[@#]",
)
CarbusMsReader = LineFormat.of(
    "CARBUS Analyzer trace",
    pattern=rf"(?P<clock>\d+),(?P<ms>\d+){_CARBUS}",
    stamps="ms",
    begins="@ TEXT @ [0-2] @",
    other="[@#]",
)
# Time of day in milliseconds.
# > <tab> 2 <tab>  17:18:39.355:2240.00 <tab> St <tab> 0x112 <tab> 0 <tab> 8 <tab> … <tab> p:2
# Minutes, seconds and milliseconds are not padded (17:19:9.69 is 9.069 s); after them stand
# the microseconds since the frame before. Bytes that a frame lacks are blank.
CanHackerReader = LineFormat.of(
    "CAN Hacker log",
    pattern=r">\t[^\t]*\t\s*(?P<clock>\d{1,2}:\d{1,2}:\d{1,2})\.(?P<ms>\d{1,3})(?::\d+(?:\.\d+)?)?"
    r"\t(?:St|(?P<long>Ext))\t(?P<id>\w+)\t[^\t]*\t(?P<length>\d+)"
    rf"(?P<data>(?:\t{_X}{{2}})*)(?:\t *)*?\tp:(?P<bus>\d+)\s*$",
    stamps="ms",
    other="CAN speed",
)
# Of the tool of CANalyst-II and its kin: time of day in milliseconds.
# NO    Direction  Time Scale        Frame Type      Frame Format     Frame ID  Length  Data
# 0     Receive    18:00:00:125      Data frame      Standard frame   00000356  8       f2 0e …
UsbCanReader = LineFormat.of(
    "USB-CAN tool text",
    pattern=r"(?i)\s*+\d+[\s,]++(?P<way>Receive|Send|Transmit)[\s,]++(?P<clock>\d{1,2}:\d\d:\d\d)[:.]"
    r"(?P<decimals>\d{1,6})[\s,]++(?:Data|(?P<remote>Remote)) frame[\s,]++"
    r"(?:(?P<short>Standard)|(?P<long>Extended)) frame[\s,]++(?:0x)?(?P<id>[0-9A-F]{1,8})"
    r"[\s,]++(?:0x)?(?P<length>\d{1,2})[\s,]*+(?P<data>(?:[0-9A-F]{2} ?)*+)\s*$",
    stamps="ms",
    other=r"(?i)\s*(?:NO\b|Index\b)",
)
# Of slcan (Lawicel) adapters: milliseconds of a minute, in four digits.
# t35680EFA003EA000009AB0
SlcanReader = LineFormat.of(
    "slcan text with stamps",
    pattern=rf"(?:(?P<short>t)|(?P<long>T))(?P<id>(?<=t){_X}{{3}}|(?<=T){_X}{{8}})(?P<length>[0-8])"
    rf"(?P<data>(?:{_X}{{2}})*)(?P<hex_ms>{_X}{{4}})\s*$",
    stamps="ms",
    other=r"(?i)[rRzZFVNCOSMm][0-9A-F]*\s*$",
)
# Possessive (++): no backtracking over a line of 16,000 blanks.
_CANDUMP: Final = (
    r"(?P<channel>[^\s(]\S*+)\s++(?:[RT]X(?:\s++[-BE](?=\s))*+\s++)?"
    rf"(?P<id>{_X}{{3}}|{_X}{{8}})\s++\[(?P<length>\d++)\]\s++"
    rf"(?:(?P<remote>remote request)|(?P<data>(?:{_X}{{2}}\b ?)*))"
)
#  (1436509052.249713)  can0  1DB   [8]  00 04 C2 62 00 00 03 B6
#  (2015-07-09 06:17:32.249713)  can0  1DB   [8]  00 04 C2 62 00 00 03 B6
CandumpReader = _CandumpFormat.of(
    "candump with stamps",
    pattern=rf"\s*+\((?P<date>\d{{4}}-\d\d-\d\d \d\d:\d\d:)?(?P<time>\d++\.\d++)\)\s*+{_CANDUMP}",
)
UnstampedCandumpReader = _CandumpFormat.of(
    "candump without stamps", pattern=rf"\s*+{_CANDUMP}", stamps="none"
)

_FRAMES_FOR_UNIT: Final = 100
"""Frames of one bus from which stamps in milliseconds are distinguished from bursts."""
_FASTEST_MESSAGE_S: Final = 1e-3
"""Periodic messages are not sent more often; transfers in many frames are [s]."""


class GvretReader(LineReader):
    """SavvyCAN's GVRET CSV, with and without direction; time in µs, in some exports in ms."""

    name = "SavvyCAN GVRET CSV"
    states_length = False
    # Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8
    # 22213513,00000111,false,Rx,0,8,00,00,00,00,00,00,00,00,
    _COLUMNS: Final = ("Time Stamp", "ID", "Extended", "Bus", "D1")
    _BYTE_ORDER_MARK: Final = "\u00ef\u00bb\u00bf"  # of UTF-8, read as latin-1
    # What a spreadsheet makes of an id such as 2E6; 0E6 is lost.
    _AS_NUMBER: Final = re.compile(r"([1-9])\.00E\+0(\d)")

    def prepare(self, head: Sequence[str]) -> bool:
        """Find the columns, and the unit of the stamps."""
        headings = [cell.strip() for cell in head[0].removeprefix(self._BYTE_ORDER_MARK).split(",")]
        length_name = next((name for name in ("LEN", "DLC") if name in headings), "")
        if not length_name or any(name not in headings for name in self._COLUMNS):
            return False
        self._places = [headings.index(name) for name in (*self._COLUMNS, length_name)]
        self._way = headings.index("Dir") if "Dir" in headings else None
        self._per_s = 1e6
        frames: list[can.Message] = []
        for line in head[1:]:
            with suppress(ValueError, OverflowError):
                frames += filter(None, [self.parse(line)])
        self._find_unit(frames)
        return True

    def _find_unit(self, frames: Sequence[can.Message]) -> None:
        """Take stamps as milliseconds where microseconds would be too fast for a bus."""
        channels = {each.channel for each in frames}
        if any(_is_too_fast([each for each in frames if each.channel == one]) for one in channels):
            self._per_s = 1e3
            self.stamps = "ms"
            remark = "too many frames per microsecond for any bus: time stamps are taken as"
            self.remarks.insert(0, f"{remark} milliseconds")
            return
        for number, count in Counter(each.arbitration_id for each in frames).most_common(1):
            if _duration_s(frames) < _FASTEST_MESSAGE_S * (count - 1):
                period_ms = 1e3 * _duration_s(frames) / (count - 1)
                self.remarks.append(
                    f"time stamps are taken as microseconds, by which 0x{number:X} comes every"
                    f" {period_ms:.2g} ms; if they are milliseconds, multiply them by 1000"
                )

    def parse(self, line: str) -> can.Message | None:
        """Return the frame of a line."""
        cells = line.strip().split(",")
        time, number, extended, bus, first, length = self._places
        if len(cells) <= length:
            raise ValueError("not a frame")
        if cells[number] == "ID":
            return None
        count = int(cells[length])
        return frame(
            int(cells[time]) / self._per_s,
            self._id(cells[number]),
            bytes(int(cell, 16) for cell in cells[first : first + count]).hex(),
            count,
            is_extended=cells[extended].lower() in {"true", "1"} or None,
            channel=int(cells[bus]),
            is_rx=self._way is None or cells[self._way] != "Tx",
        )

    def _id(self, text: str) -> str:
        match = self._AS_NUMBER.fullmatch(text)
        if match is None:
            return text
        remark = "a spreadsheet has changed ids into numbers; read back as ids ("
        if not any(each.startswith(remark) for each in self.remarks):
            example = f"{text} is {match[1]}E{match[2]}"
            self.remarks.append(f"{remark}{example}), but ids that begin with 0E are lost")
        return f"{match[1]}E{match[2]}"


def _is_too_fast(frames: Sequence[can.Message]) -> bool:
    """Return whether a bus is too slow for these frames, at 1 Mbit/s and without stuff bits."""
    if len(frames) < _FRAMES_FOR_UNIT:
        return False
    # ISO 11898-1: a frame without data, with the pause after it, has 47 bits, with a long id 67. Of
    # CAN FD, 30 or 49 of them are not sent at the rate of the data, which may be higher.
    is_fd = any(frame.is_fd for frame in frames)
    bits = sum(
        (49 if frame.is_extended_id else 30)
        if is_fd
        else (67 if frame.is_extended_id else 47) + 8 * len(frame.data)
        for frame in frames[1:]
    )
    return _duration_s(frames) < bits * 1e-6


def _duration_s(frames: Sequence[can.Message]) -> float:
    times_s = [frame.timestamp for frame in frames]
    return max(times_s) - min(times_s)


class AscReader(LineReader):
    """Vector ASC, of other programs too.

    Under a header of relative time stamps, Vector writes the time since the event before, frame or
    not. Other programs write the time since the start, which does not fall.
    """

    name = "Vector ASC"
    # date Mon May 15 09:00:00.000 am 2026
    # base hex  timestamps absolute
    # -0.012000 1  1DBx  Rx   d 8 F2 0E FA 00 3E A0 00 00  Length = 124000 BitCount = 64 ID = 475
    # 0.016000 CANFD   1 Rx  1DB  Name  1 0 9 12 01 02 03 04 05 06 07 08 09 0A 0B 0C  130000 130 …
    _HEAD: Final = re.compile(r"(?im)^\s*base\s+(hex|dec)(?:\s+timestamps\s+(relative|absolute))?")
    _STAMP: Final = re.compile(r"\s*+(-?\d{1,12}\.\d+)\s++(.*)")
    _CLASSIC: Final = re.compile(
        r"(?P<channel>\d+)\s++(?P<id>\w+?)(?P<long>x?)\s++(?P<way>Rx|Tx|TxRq)\s++(?P<kind>[dr])"
        r"(?:\s++(?P<code>[0-9A-Fa-f]{1,2}))?(?=\s|$)(?P<rest>.*)"
    )
    _FD: Final = re.compile(
        r"CANFD\s++(?P<channel>\d+)\s++(?P<way>Rx|Tx|TxRq)\s++(?P<id>\w+?)(?P<long>x?)\s++"
        r"(?:[^\s\d]\S*+\s++)?(?P<switch>[01])\s++(?P<state>[01])\s++(?P<code>[0-9A-Fa-f]{1,2})"
        r"\s++(?P<length>\d{1,2})(?=\s|$)(?P<rest>.*)"
    )
    _ERROR: Final = re.compile(r"(?:CANFD\s++)?(\d+)\s++(?:(?:Rx|Tx)\s++)?ErrorFrame\b")
    _OF_FRAME: Final = re.compile(r"CANFD\b|\d+\s++\S++\s++(?:Rx|Tx|TxRq)\b")
    _OTHER: Final = re.compile(
        r"(?i)\s*(?:date\s|base\s|(?:no\s+)?internal\s+events|//|(?:begin|end)\s+trigger"
        r"|previous\s+log)"
    )
    _base = 16
    _is_added = False
    _time_s = 0.0

    @classmethod
    def matches(cls, head: bytes) -> bool:
        """Return whether it begins with a date and a base."""
        begin = head[:2000].decode("latin-1")
        return begin[:5].lower() == "date " and cls._HEAD.search(begin) is not None

    def prepare(self, head: Sequence[str]) -> bool:
        """Find the base of the numbers, and whether stamps count from the event before."""
        match = self._HEAD.search("".join(head))
        if match is None:
            return False
        self._base = 16 if match[1].lower() == "hex" else 10
        if (match[2] or "").lower() == "relative":
            stamps_s = [float(each[1]) for line in head if (each := self._STAMP.match(line))]
            steps_s = [two - one for one, two in pairwise(stamps_s)]
            # Differences fall as much as they rise; a clock does not, but for buses out of order.
            rise_s = sum(max(each, 0.0) for each in steps_s)
            self._is_added = 2.0 * (rise_s - sum(steps_s)) > rise_s
            remark = " rise: taken as time since the start"
            if self._is_added:
                remark = ": each is added to the one before"
            self.remarks.append(f"relative time stamps{remark}")
        return True

    def parse(self, line: str) -> can.Message | None:
        """Return the frame of a line."""
        stamp = self._STAMP.match(line)
        if stamp is None:
            if self._OTHER.match(line):
                return None
            raise ValueError("not a frame")
        event, time_s = stamp[2], float(stamp[1])
        if self._is_added:
            self._time_s += time_s
            time_s = self._time_s
        if error := self._ERROR.match(event):
            return frame(time_s, 0, "", channel=int(error[1]) - 1, is_error_frame=True)
        if match := self._CLASSIC.match(event) or self._FD.match(event):
            return self._frame(time_s, match.groupdict(), line)
        if self._OF_FRAME.match(event):
            raise ValueError("not a frame")
        return None

    def _frame(self, time_s: float, of: dict[str, str], line: str) -> can.Message:
        """Return the frame of the groups of a classic frame, or of one of CAN FD."""
        is_fd = "length" in of
        if is_fd:
            size = int(of["length"])
            is_remote = size == 0 and of["code"] != "0"
            size = int(of["code"], 16) if is_remote else size
        else:
            is_remote = of["kind"] == "r"
            if of["code"] is None and not is_remote:
                raise ValueError("its length is missing")
            size = min(int(of["code"] or "0", self._base), 8)
        return frame(
            time_s,
            int(of["id"], self._base),
            None if is_remote else self._data(of["rest"], size, line),
            size,
            is_extended=bool(of["long"]),
            channel=int(of["channel"]) - 1,
            is_rx=of["way"] == "Rx",
            is_fd=is_fd,
            bitrate_switch=of.get("switch") == "1",
            error_state_indicator=of.get("state") == "1",
        )

    def _data(self, rest: str, size: int, line: str) -> str:
        """Return the bytes of a frame in hexadecimal; raise ValueError for a byte that is cut."""
        cells = rest.split()[:size]
        if self._base == 16:
            if len(cells) < size or any(len(each) != 2 for each in cells):
                raise ValueError("a byte is missing or cut")
            return "".join(cells)
        if not line.endswith("\n"):
            raise ValueError("a byte may be cut")
        return bytes(int(each) for each in cells).hex()

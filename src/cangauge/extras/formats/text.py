"""Text formats of captures that python-can does not read, one frame a line."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime
from itertools import pairwise
from typing import Any, ClassVar, Final

import can

from cangauge.bus.readers import LineReader, PatternReader, Stamps, candump_frame, frame


class SpacedReader(PatternReader):
    """Time, id, length, bytes: traces of older CAN Hackers, and of loggers on microcontrollers."""

    name = "seconds, id, length, bytes"
    # 0000.004429 000001DB 8 FD A0 BA AA 00 00 01 A8
    # 1512293  5F1  8  A8 16 65 9 0 0 0 0
    pattern = re.compile(
        r"(\d++(?:\.\d++)?) ++([0-9A-Fa-f]{1,8}) ++(\d{1,2})"
        r"((?: ++(?:[0-9A-Fa-f]{2}|[0-9A-Fa-f](?=\s)))*+)\s*$"  # a cut byte is none of one digit
    )
    other = re.compile(r"Time\s++ID\s++DLC\b")

    def prepare(self, head: Sequence[str]) -> bool:
        """Find the unit of the stamps: whole ones are milliseconds."""
        first = next(filter(None, map(self.pattern.match, head)), None)
        if first is not None and "." not in first[1]:
            self.stamps = "ms"
        return first is not None

    def _frame(self, *groups: Any) -> can.Message:
        time, number, length, data = groups
        time_s = float(time) / (1e3 if self.stamps == "ms" else 1.0)
        return frame(time_s, number, "".join(f"{byte:0>2}" for byte in data.split()), length)


class TableReader(PatternReader):
    """Tab-separated table, time in whole milliseconds."""

    name = "tab-separated table"
    stamps: Stamps = "ms"
    # ParserFlags <tab> Ch <tab> Counter <tab> T/R <tab> Time <tab> Flags <tab> CAN ID <tab> Len …
    # 1 <tab> 0 <tab> 14767 <tab> RX <tab> 1052620673 <tab> <tab> 0x000001da <tab> 8 <tab> 0xc8 …
    pattern = re.compile(
        r"[^\t]*\t(\d+)\t[^\t]*\t(\w+)\t(\d+)\t[^\t]*\t(0x\w+)\t(\d+)\t(?:0x)?([0-9A-Fa-f ]*)\s"
    )
    other = re.compile("ParserFlags\t")

    def _frame(self, *groups: Any) -> can.Message:
        channel, way, time, number, length, data = groups
        is_rx = way != "TX"
        return frame(int(time) / 1e3, number, data, length, channel=int(channel), is_rx=is_rx)


class CrtdReader(PatternReader):
    """CRTD of OVMS, also as SavvyCAN writes it."""

    name = "CRTD (OVMS)"
    states_length = False
    # 1632509059.541604 2R11 174 00 00 00 aa 0f 00 00 00
    pattern = re.compile(
        r"(\d+\.\d+) (\d*)([RT])(11|29) ([0-9A-Fa-f]{1,8})((?: [0-9A-Fa-f]{2})*)\s*$"
    )
    other = re.compile(r"\d+\.\d+ \d*C[A-Z]{2}\b")

    def _frame(self, *groups: Any) -> can.Message:
        time, channel, way, bits, number, data = groups
        return frame(
            time,
            number,
            data,
            is_extended=bits == "29",
            channel=int(channel or 1),
            is_rx=way == "R",
        )


class BatteryEmulatorReader(PatternReader):
    """Log of Battery-Emulator's web page: its ids are not padded, else it looks like candump's."""

    name = "Battery-Emulator log"
    # (216.112) RX0 7A [8] 00 00 D2 B6 BC 5E 00 00
    pattern = re.compile(
        r"\((\d++\.\d++)\) ([RTrt][Xx]\d++) ([0-9A-Fa-f]{1,8}) \[(\d++)\]((?: [0-9A-Fa-f]{2}\b)*)"
    )

    def _frame(self, *groups: Any) -> can.Message:
        time, channel, number, length, data = groups
        return frame(time, number, data, length, channel=channel, is_rx=channel[0] in "Rr")


class CandumpReader(PatternReader):
    """Screen output of candump with stamps: absolute, or dates, which are taken as UTC."""

    name = "candump with stamps"
    has_stamps: ClassVar[bool] = True
    #  (1436509052.249713)  can0  1DB   [8]  00 04 C2 62 00 00 03 B6
    #  (2015-07-09 06:17:32.249713)  can0  1DB   [8]  00 04 C2 62 00 00 03 B6
    # Possessive (++): no backtracking over a line of 16,000 blanks.
    pattern = re.compile(
        r"\s*+(?:\(((\d{4}-\d\d-\d\d \d\d:\d\d:)?\d++\.\d++)\)\s*+)?"
        r"(\S++)\s++(?:[RT]X(?:\s++[-BE](?=\s))*+\s++)?"
        r"([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})"
        r"\s++\[(\d++)\]\s++(remote request|(?:[0-9A-Fa-f]{2}\b ?)*)"
    )

    def _frame(self, *groups: Any) -> can.Message:
        time, date, channel, number, length, data = groups
        if (time is not None) is not self.has_stamps:
            raise ValueError("only some lines have stamps")
        if date:
            time = f"{datetime.fromisoformat(f'{time}+00:00').timestamp():.6f}"
        content = None if data == "remote request" else data
        return candump_frame(time or "0", channel, number, content, length)


class UnstampedCandumpReader(CandumpReader):
    """Screen output of candump without stamps."""

    name = "candump without stamps"
    stamps: Stamps = "none"
    has_stamps = False


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


class IdDataReader(PatternReader):
    """SavvyCAN's generic CSV of id and bytes, which has no time."""

    name = "SavvyCAN id and data CSV"
    stamps: Stamps = "none"
    states_length = False
    # 4F5,FF 34 23 45 24 E4
    pattern = re.compile(r"([0-9A-Fa-f]{3,8}),((?:[0-9A-Fa-f]{2} ?){0,64})\s*$")
    other = re.compile("ID,Data")

    def prepare(self, head: Sequence[str]) -> bool:
        """Check the headings."""
        return head[0].strip().startswith("ID,Data")

    def _frame(self, *groups: Any) -> can.Message:
        return frame(0.0, *groups)


class CabanaReader(PatternReader):
    """CSV of openpilot's cabana: seconds, id (decimal without 0x), bus, bytes."""

    name = "cabana CSV"
    states_length = False
    # 15.460,0x440,1,0x4000800000000000
    pattern = re.compile(
        r"(\d+(?:\.\d+)?),(0x[0-9A-Fa-f]{1,8}|\d{1,9}),(\d{1,9}),(?:0x)?((?:[0-9A-Fa-f]{2}){0,64})\s*$"
    )
    other = re.compile("time,addr,bus,data")

    def prepare(self, head: Sequence[str]) -> bool:
        """Check the headings."""
        return self.other.match(head[0]) is not None

    def _frame(self, *groups: Any) -> can.Message:
        time, number, bus, data = groups
        return frame(time, int(number, 0), data, channel=int(bus))


class CarbusReader(PatternReader):
    """CARBUS Analyzer (canhacker.ru): seconds and microseconds; before version 3 milliseconds."""

    name = "CARBUS Analyzer trace"
    # @ TEXT @ 3 @ 64 @ 0 @ 1149 @ 7459 @ 00:00:07.459 @
    # 26,641405 <tab> 1 <tab> 00000004 <tab> 112 <tab> 8 <tab> 00 20 C1 0E 01 72 89 00 <tab> …
    pattern = re.compile(r"(\d+),(\d+)\t(\d+)\t[^\t]*\t(\w+)\t(\d+)\t([^\t]*)")
    other = re.compile("[@#]")
    _HEADER: Final = re.compile(r"@ TEXT @ (\d) @")

    def prepare(self, head: Sequence[str]) -> bool:
        """Find the version."""
        match = self._HEADER.match(head[0])
        if match is not None and int(match[1]) < 3:
            self.stamps = "ms"
        return match is not None

    def _frame(self, *groups: Any) -> can.Message:
        seconds, fraction, channel, number, length, data = groups
        time_s = int(seconds) + int(fraction) / (1e6 if self.stamps == "us" else 1e3)
        return frame(time_s, number, data, length, channel=int(channel))


class CanHackerReader(PatternReader):
    """CAN Hacker log: time of day in milliseconds."""

    name = "CAN Hacker log"
    stamps: Stamps = "ms"
    # > <tab> 2 <tab>  17:18:39.355:2240.00 <tab> St <tab> 0x112 <tab> 0 <tab> 8 <tab> … <tab> p:2
    # Minutes, seconds and milliseconds are not padded (17:19:9.69 is 9.069 s); after them stand
    # the microseconds since the frame before. Bytes that a frame lacks are blank.
    pattern = re.compile(
        r">\t[^\t]*\t\s*(\d{1,2}):(\d{1,2}):(\d{1,2})\.(\d{1,3})(?::\d+(?:\.\d+)?)?\t(St|Ext)"
        r"\t(\w+)\t[^\t]*\t(\d+)((?:\t[0-9A-Fa-f]{2})*)(?:\t *)*?\tp:(\d+)\s*$"
    )
    other = re.compile("CAN speed")

    def _frame(self, *groups: Any) -> can.Message:
        hours, minutes, seconds, milliseconds, kind, number, length, data, channel = groups
        time_s = 3600 * int(hours) + 60 * int(minutes) + int(seconds) + int(milliseconds) / 1e3
        is_extended = kind == "Ext" or None
        return frame(time_s, number, data, length, is_extended=is_extended, channel=int(channel))


class UsbCanReader(PatternReader):
    """Text of the tool of CANalyst-II and its kin: time of day in milliseconds."""

    name = "USB-CAN tool text"
    stamps: Stamps = "ms"
    # NO    Direction  Time Scale        Frame Type      Frame Format     Frame ID  Length  Data
    # 0     Receive    18:00:00:125      Data frame      Standard frame   00000356  8       f2 0e …
    pattern = re.compile(
        r"\s*+\d+[\s,]++(Receive|Send|Transmit)[\s,]++(\d{1,2}):(\d\d):(\d\d)[:.](\d{1,6})[\s,]++"
        r"(Data|Remote) frame[\s,]++(Standard|Extended) frame[\s,]++(?:0x)?([0-9A-Fa-f]{1,8})"
        r"[\s,]++(?:0x)?(\d{1,2})[\s,]*+((?:[0-9A-Fa-f]{2} ?)*+)\s*$",
        re.IGNORECASE,
    )
    other = re.compile(r"\s*(?:NO\b|Index\b)", re.IGNORECASE)

    def _frame(self, *groups: Any) -> can.Message:
        way, hours, minutes, seconds, fraction, kind, form, number, length, data = groups
        time_s = 3600 * int(hours) + 60 * int(minutes) + int(seconds) + float(f"0.{fraction}")
        content = data if kind.lower() == "data" else None
        is_extended = form.lower() == "extended"
        is_rx = way.lower() == "receive"
        return frame(time_s, number, content, length, is_extended=is_extended, is_rx=is_rx)


class SlcanReader(PatternReader):
    """Text of slcan (Lawicel) adapters with stamps: milliseconds of a minute, in four digits."""

    name = "slcan text with stamps"
    stamps: Stamps = "ms"
    # t35680EFA003EA000009AB0
    pattern = re.compile(
        r"(?:t([0-9A-F]{3})|T([0-9A-F]{8}))([0-8])((?:[0-9A-F]{2})*)([0-9A-F]{4})\s*$",
        re.IGNORECASE,
    )
    other = re.compile(r"[rRzZFVNCOSMm][0-9A-F]*\s*$")

    def _frame(self, *groups: Any) -> can.Message:
        standard, extended, length, data, stamp = groups
        is_extended = standard is None
        return frame(
            int(stamp, 16) / 1e3, extended or standard, data, length, is_extended=is_extended
        )


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
        r"(\d+)\s++(\w+?)(x?)\s++(Rx|Tx|TxRq)\s++([dr])(?:\s++([0-9A-Fa-f]{1,2}))?(?=\s|$)(.*)"
    )
    _FD: Final = re.compile(
        r"CANFD\s++(\d+)\s++(Rx|Tx|TxRq)\s++(\w+?)(x?)\s++(?:[^\s\d]\S*+\s++)?([01])\s++([01])"
        r"\s++([0-9A-Fa-f]{1,2})\s++(\d{1,2})(?=\s|$)(.*)"
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
        time_s, event = float(stamp[1]), stamp[2]
        more: dict[str, bool] = {}
        if self._is_added:
            self._time_s += time_s
            time_s = self._time_s
        if match := self._ERROR.match(event):
            return frame(time_s, 0, "", channel=int(match[1]) - 1, is_error_frame=True)
        if match := self._CLASSIC.match(event):
            channel, number, extended, way, kind, length, rest = match.groups()
            if kind == "d" and length is None:
                raise ValueError("its length is missing")
            size = min(int(length or "0", self._base), 8)
            data = self._data(rest, size, line) if kind == "d" else None
        elif match := self._FD.match(event):
            channel, way, number, extended, switch, state, code, length, rest = match.groups()
            size = int(length)
            is_remote = size == 0 and code != "0"
            data = None if is_remote else self._data(rest, size, line)
            size = int(code, 16) if is_remote else size
            more = {
                "is_fd": True,
                "bitrate_switch": switch == "1",
                "error_state_indicator": state == "1",
            }
        elif self._OF_FRAME.match(event):
            raise ValueError("not a frame")
        else:
            return None
        return frame(
            time_s,
            int(number, self._base),
            data,
            size,
            is_extended=bool(extended),
            channel=int(channel) - 1,
            is_rx=way == "Rx",
            **more,
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

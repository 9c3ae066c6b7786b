"""The text formats that are read line by line: what a line looks like, what a frame is in it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import can

from cangauge.bus.captures.info import Stamps

Parser = Callable[[str], can.Message | None]
"""Takes a line; returns its frame, or None for a line that holds none; ValueError: malformed."""

_MAX_STANDARD_ID: Final = 0x7FF
_ERROR_FLAG: Final = 0x20000000


@dataclass(frozen=True, slots=True)
class TextFormat:
    """One way of writing frames as text.

    Parameters
    ----------
    name : str
    stamps : {"us", "ms", "none"}
    states_length : bool
        Whether a line says how many bytes it holds, so that a cut one shows.
    parser : callable
        Takes the first line of the file and returns the parser of lines, or None if the first
        line is not of this format (for formats with a header).
    """

    name: str
    stamps: Stamps
    states_length: bool
    parser: Callable[[str], Parser | None]


def _data(text: str, length: int) -> bytes:
    data = bytes.fromhex(text)
    if len(data) != length or length > 64:
        raise ValueError("length and bytes differ")
    return data


def _id(text: str) -> tuple[int, bool]:
    """Return id and whether it is extended, where every id is written with 8 digits."""
    number = int(text, 16)
    if number > 0x1FFFFFFF:
        raise ValueError("no such id")
    return number, number > _MAX_STANDARD_ID


# 0000.004429 000001DB 8 FD A0 BA AA 00 00 01 A8
_SPACED = re.compile(r"(\d+\.\d+) ([0-9A-Fa-f]{8}) (\d{1,2})((?: [0-9A-Fa-f]{2})*)\s*$")


def _spaced(_first: str) -> Parser:
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


def _table(first: str) -> Parser | None:
    """Tab-separated, columns by their headings, time in whole milliseconds."""
    headings = [cell.strip() for cell in first.rstrip("\r\n").split("\t")]
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


def _crtd(_first: str) -> Parser:
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
# Possessive (++): a line of 16,000 blanks must not be tried in every way to part them.
_CANDUMP = re.compile(
    r"\s*+(?:\((\d++\.\d++)\)\s*+)?(\S++)\s++(?:[RT]X(?:\s++[-BE](?=\s))*+\s++)?"
    r"([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})"
    r"\s++\[(\d++)\]\s++(remote request|(?:[0-9A-Fa-f]{2}\b ?)*)"
)


def _candump(*, with_stamps: bool) -> Callable[[str], Parser | None]:
    def parser(_first: str) -> Parser:
        def parse(line: str) -> can.Message | None:
            match = _CANDUMP.match(line)
            if match is None:
                return _blank(line)
            if (match[1] is not None) is not with_stamps:
                raise ValueError("some lines have stamps and some have not")
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


def _candump_log(_first: str) -> Parser:
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


def _blank(line: str) -> can.Message | None:
    """Return None for a line without content.

    Raises
    ------
    ValueError
        For any other line.
    """
    if line.strip():
        raise ValueError("not a frame")
    return None


TEXT_FORMATS: Final = (
    TextFormat("CRTD (OVMS)", "us", states_length=False, parser=_crtd),
    TextFormat("candump log", "us", states_length=False, parser=_candump_log),
    TextFormat("tab-separated table", "ms", states_length=True, parser=_table),
    TextFormat("seconds, id, length, bytes", "us", states_length=True, parser=_spaced),
    TextFormat("candump with stamps", "us", True, parser=_candump(with_stamps=True)),
    TextFormat("candump without stamps", "none", True, parser=_candump(with_stamps=False)),
)
"""Tried in this order; the one that makes most sense of the beginning of a file is taken."""

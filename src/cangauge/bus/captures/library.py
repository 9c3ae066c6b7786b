"""Captures that python-can reads: Vector ASC and BLF, PEAK TRC, ASAM MF4, python-can's CSV."""

from __future__ import annotations

import io
import logging
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import can
from can.io.blf import BLFParseError

from cangauge.bus.captures.blf import CheckedBlf
from cangauge.bus.captures.mf4 import mf4_messages
from cangauge.bus.captures.stream import open_bytes
from cangauge.limits import MAX_LINE

# Its readers log a line for every object that they do not know: a hostile file has millions.
logging.getLogger("can").addHandler(logging.NullHandler())

# What python-can's readers raise on damaged files.
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
        Whether the beginning of a file looks like it.
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
    """The lines of a text, as python-can iterates over them, of bounded length."""

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
    """Yield the frames of a file; raises one of `DAMAGE` where it breaks off.

    Raises
    ------
    InputError
        If the reader is not installed (MF4 without asammdf).
    """
    if kind.reader is can.MF4Reader:
        yield from mf4_messages(path)
        return
    with open_bytes(path) as raw:
        file: Any = _Lines(raw) if kind.is_text else CheckedBlf(raw)
        yield from kind.reader(file)

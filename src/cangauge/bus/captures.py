"""Captures: recorded frames, read as a stream of messages with stamps in seconds.

A format is a `CaptureReader`, recognised by the beginning of a file, not by its suffix. Here are
candump's log and the formats that python-can reads; others join by the entry point group
`cangauge.capture_readers` (`cangauge.extras.formats`, other packages).
"""

from __future__ import annotations

import io
import os
import re
import struct
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from itertools import chain, islice
from os import PathLike
from pathlib import Path
from typing import IO, Any, ClassVar, Final, Literal, NamedTuple, cast

import can
from can.io.blf import BLFParseError
from can.io.generic import BinaryIOMessageReader, MessageReader, TextIOMessageReader
from can.typechecking import StringPathLike

from cangauge._files import open_unpacked, read_beginning
from cangauge.errors import InputError

MAX_LINE: Final = 16 * 1024
"""Longest line of a text capture [characters]."""
MAX_STAMP_S: Final = 1e11
"""Largest time stamp of a frame [s]: the year 5138, counted from 1970."""

GROUP: Final = "cangauge.capture_readers"
"""Entry points: classes derived from `CaptureReader`."""

CLOCK_ID: Final = 0x1DB
"""Without time stamps, frames of this id (Nissan Leaf) count time, …"""
CLOCK_PERIOD_S: Final = 0.010
"""… one each period [s]."""

KNOWN_CAPTURES: Final = (
    "candump (log, and screen output), CRTD, SavvyCAN's GVRET CSV, CAN Hacker and CARBUS traces,"
    " Vector ASC and BLF, PEAK TRC, PCAP and PCAPNG, ASAM MF4, MCAP, python-can's CSV,"
    " tab-separated tables, and text of seconds, id, length, bytes; each may be gzipped"
)
_CURE: Final = f"known are: {KNOWN_CAPTURES}"

Stamps = Literal["us", "ms", "none"]
"""Resolution of time stamps: microseconds or finer, whole milliseconds, or no stamps."""

_HEAD_BYTES: Final = 64 * 1024
HEAD_LINES: Final = 400
"""Beginning of a file by which its format is recognised [bytes, lines]."""
FEW_MALFORMED: Final = 100
"""A file with more malformed lines than this, and than frames, is refused."""
MAX_ID: Final = 0x1FFFFFFF
ERROR_FLAG: Final = 0x20000000

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
"""Errors of readers on damaged files."""


@dataclass(frozen=True, slots=True)
class CaptureInfo:
    """Findings of reading a capture.

    Parameters
    ----------
    format : str
        Name of the format.
    stamps : {"us", "ms", "none"}
    frames : int
        Frames read, error and remote frames included.
    malformed : int
        Lines or frames skipped as malformed.
    first_malformed : int or None
        Number of the first such line, from 1.
    cut_off : bool
        Whether the file ends within a line or frame.
    remarks : tuple of str
        For the user.
    """

    format: str
    stamps: Stamps
    frames: int = 0
    malformed: int = 0
    first_malformed: int | None = None
    cut_off: bool = False
    remarks: tuple[str, ...] = ()


# --- Readers


class CaptureReader(MessageReader, ABC):
    """Reader of one capture format, in the shape of python-can's readers.

    It survives damage: malformed lines or frames are skipped and counted, and a file that breaks
    off gives the frames before. Subclasses state `name`, recognise their files in `matches`, and
    yield the frames of one in `read`, which may raise any of `DAMAGE` where the file breaks off.

    Parameters
    ----------
    file : path-like or file object
        A path may be gzipped.
    **_options : object
        Ignored; python-can passes options of other readers too.

    Attributes
    ----------
    name : str
        Name of the format.
    stamps : {"us", "ms", "none"}
        Resolution of the time stamps.
    frames, malformed : int
        Frames read, and lines or frames skipped as malformed, so far.
    first_malformed : int or None
        Number of the first such line, from 1.
    cut_off : bool
        Whether the file broke off within a line or frame.
    damage : str or None
        The error where it broke off.
    remarks : list of str
        For the user.
    raw : binary file object
        The unpacked content.
    """

    name: ClassVar[str]
    stamps: Stamps = "us"
    unit: ClassVar[str] = "frames"
    """Of what is malformed, for messages."""

    def __init__(self, file: StringPathLike | IO[Any], **_options: object) -> None:
        self.source = Path(file) if isinstance(file, str | os.PathLike) else None
        opened = file if self.source is None else open_unpacked(self.source)
        self.raw = cast("io.BufferedIOBase", opened)
        self.frames = 0
        self.malformed = 0
        self.first_malformed: int | None = None
        self.cut_off = False
        self.damage: str | None = None
        self.remarks: list[str] = []

    def stop(self) -> None:
        """Close the file."""
        self.raw.close()

    @classmethod
    @abstractmethod
    def matches(cls, head: bytes) -> bool:
        """Return whether the unpacked beginning of a file, up to 64 KiB, is of this format."""

    @abstractmethod
    def read(self) -> Iterator[can.Message]:
        """Yield the frames; raise one of `DAMAGE` where the file breaks off."""

    def messages(self) -> Iterator[can.Message]:
        """Yield the frames with usable stamps, as far as the file can be read.

        Raises
        ------
        InputError
            If most lines are malformed; names the first.
        """
        try:
            for message in self.read():
                if abs(message.timestamp) <= MAX_STAMP_S:  # false for NaN
                    self.frames += 1
                    yield message
                else:
                    self.skip(None)
        except DAMAGE as error:
            self.cut_off = True
            self.damage = f"{type(error).__name__}: {error}"

    def __iter__(self) -> Iterator[can.Message]:
        """Yield the frames; see `messages`.

        Raises
        ------
        InputError
            If the file is damaged before its first frame, or mostly malformed.
        """
        yield from self.messages()
        if self.damage is not None and not self.frames:
            raise self.damaged()

    def damaged(self) -> InputError:
        """Return the error for a file that gives no frame."""
        return InputError(
            f"the {self.name} file is damaged ({self.damage})",
            source=self.source,
            cure="record or fetch it again",
        )

    def skip(self, line: int | None) -> None:
        """Count a malformed line or frame.

        Raises
        ------
        InputError
            If there are many, and more than frames.
        """
        self.malformed += 1
        if self.first_malformed is None:
            self.first_malformed = line
        if self.malformed > FEW_MALFORMED and self.malformed > self.frames:
            raise self.junk()

    def junk(self) -> InputError:
        """Return the error for a file of mostly malformed lines."""
        where = "" if self.first_malformed is None else f", the first is {self.first_malformed}"
        return InputError(
            f"{self.malformed} {self.unit} are no frames of {self.name}{where},"
            f" and only {self.frames} are",
            source=self.source,
            cure="record or export it again",
        )


class BinaryReader(CaptureReader, BinaryIOMessageReader):
    """Reader of a binary format."""


class LineReader(CaptureReader, TextIOMessageReader):
    """Reader of a text format with one frame a line.

    Subclasses set up `parse` from the first lines in `prepare`.

    Attributes
    ----------
    states_length : bool
        Whether a line states its number of bytes, so that a cut line is recognised.
    """

    states_length: ClassVar[bool] = True
    unit: ClassVar[str] = "lines"

    @classmethod
    def matches(cls, head: bytes) -> bool:
        """Return whether most lines are frames."""
        reader = cls(io.BytesIO(head))
        lines = list(islice(_lines(reader), HEAD_LINES))
        if len(lines) > 1:
            lines.pop()  # may be cut
        if not lines or not reader.prepare(lines):
            return False
        frames = malformed = 0
        for line in lines:
            try:
                frames += reader.parse(line) is not None
            except (ValueError, OverflowError):
                malformed += 1
        return frames > malformed

    def prepare(self, head: Sequence[str]) -> bool:
        """Set up parsing by the first lines; return whether they are of this format."""
        return bool(head)

    @abstractmethod
    def parse(self, line: str) -> can.Message | None:
        """Return the frame of a line; None for a line without one.

        Raises
        ------
        ValueError, OverflowError
            If the line is malformed.
        """

    def read(self) -> Iterator[can.Message]:
        """Yield the frames of the lines."""
        lines = _lines(self)
        head = list(islice(lines, HEAD_LINES))
        if head and not self.prepare(head):
            raise InputError(f"the file is not a {self.name}", source=self.source)
        for number, line in enumerate(chain(head, lines), start=1):
            if not line.endswith("\n") and not self.states_length and line.strip():
                # The last line may have lost bytes, and its format does not show it.
                self.cut_off = True
                self.skip(number)
                continue
            try:
                message = self.parse(line)
            except (ValueError, OverflowError):
                self.skip(number)
                continue
            if message is not None:
                yield message


def _lines(reader: CaptureReader) -> Iterator[str]:
    """Yield the lines of a text as far as it can be read; a line beyond `MAX_LINE` in pieces."""
    if isinstance(reader.raw, io.TextIOBase):
        text: IO[str] = cast("IO[str]", reader.raw)
    else:
        salvage = io.BufferedReader(_Salvage(reader))
        text = io.TextIOWrapper(salvage, "latin-1", newline=None)
    while line := text.readline(MAX_LINE):
        yield line


class _Salvage(io.RawIOBase):
    """The content of a reader's file; it ends, instead of raising, where the file breaks off."""

    def __init__(self, reader: CaptureReader) -> None:
        self._reader = reader

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any, /) -> int:
        view = memoryview(buffer)
        try:
            # `read1`: the content before the break is delivered before the error.
            part = self._reader.raw.read1(view.nbytes)
        except (EOFError, OSError, zlib.error):
            self._reader.cut_off = True
            return 0
        view[: len(part)] = part
        return len(part)


# --- Fields that several formats share


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


def blank(line: str) -> can.Message | None:
    """Return None for a blank line; raise ValueError for any other."""
    if line.strip():
        raise ValueError("not a frame")
    return None


# (1436509052.249713) vcan0 044#2A366C2BBA
_CANDUMP_LOG = re.compile(
    r"\((\d+\.\d+)\) (\S+) ([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#"
    r"(?:(#[0-9A-Fa-f])?((?:[0-9A-Fa-f]{2}\.?)*)|R(\d?))(?: ([RT]))?\s*$"
)


class CandumpLogReader(LineReader):
    """Log file of candump -l; python-can's reader stops at a malformed line."""

    name = "candump log"
    states_length = False

    def parse(self, line: str) -> can.Message | None:
        """Return the frame of a line."""
        match = _CANDUMP_LOG.match(line)
        if match is None:
            return blank(line)
        number, extended = int(match[3], 16), len(match[3]) == 8
        remote = match[6] is not None
        data = b"" if remote else bytes.fromhex(match[5].replace(".", ""))
        fd_flags = int(match[4][1], 16) if match[4] else 0
        return can.Message(
            timestamp=float(match[1]),
            arbitration_id=number & MAX_ID,
            is_extended_id=extended,
            channel=match[2],
            is_remote_frame=remote,
            is_error_frame=extended and bool(number & ERROR_FLAG),
            is_fd=match[4] is not None,
            bitrate_switch=bool(fd_flags & 1),
            error_state_indicator=bool(fd_flags & 2),
            is_rx=match[7] != "T",
            dlc=int(match[6] or 0) if remote else None,
            data=None if remote else data_of(data.hex(), len(data)),
        )


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

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        line = self._text.readline(MAX_LINE)
        if not line:
            raise StopIteration
        if not line.endswith("\n"):
            raise EOFError("it ends in a line")
        return line

    def close(self) -> None:
        self._text.close()


class AscReader(LibraryReader):
    """Vector ASC."""

    name, library = "Vector ASC", can.ASCReader

    @classmethod
    def matches(cls, head: bytes) -> bool:
        """Return whether it begins with a date and a base."""
        lines = head[:2000].lower().splitlines()[:10]
        return head[:5].lower() == b"date " and any(
            line.strip().startswith((b"base hex", b"base dec")) for line in lines
        )


class BlfReader(LibraryReader):
    """Vector BLF."""

    name, library, is_text, marks = "Vector BLF", can.BLFReader, False, (b"LOGG",)


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
        """Yield the frames.

        Raises
        ------
        InputError
            If asammdf is not installed.
        """
        if find_spec("asammdf") is None:
            raise InputError(
                "reading ASAM MF4 needs another package: No module named 'asammdf'",
                source=self.source,
                cure="pip install 'cangauge[mf4]'",
            )
        self.raw = io.BytesIO(self.raw.read())  # asammdf goes back and forth in it
        yield from super().read()


@cache
def capture_readers() -> tuple[type[CaptureReader], ...]:
    """Return all readers of captures, in the order of their trial."""
    marked = (AscReader, BlfReader, TrcReader, Mf4Reader, CsvReader, CandumpLogReader)
    return (*marked, *(each.load() for each in entry_points(group=GROUP)))


# --- Recordings in parts. `cangauge run` numbers its runs, so that no recording is overwritten, and
# can split a run into parts. `drive-0003-000001.log`, `drive-0003-000002.log`, … are the parts of
# run 3 of `drive.log`; `drive-0003.log` names all of them as one capture.


class Part(NamedTuple):
    """One file of a recording."""

    run: int
    part: int
    path: Path


def part_path(path: Path, run: int, part: int) -> Path:
    """Return the name of a part of the recording `path`."""
    stem, suffix = _split(path)
    return path.with_name(f"{stem}-{run:04d}-{part:06d}{suffix}")


def run_path(path: Path, run: int) -> Path:
    """Return the name for all parts of a run."""
    stem, suffix = _split(path)
    return path.with_name(f"{stem}-{run:04d}{suffix}")


def all_parts(path: Path) -> list[Part]:
    """Return the parts of all runs of the recording `path`, in order."""
    stem, suffix = _split(path)
    pattern = re.compile(rf"{re.escape(stem)}-(\d{{4,9}})-(\d{{6,9}}){re.escape(suffix)}")
    try:
        files = list(path.parent.iterdir())
    except (OSError, ValueError):  # ValueError: a null byte in the path
        return []
    matches = ((pattern.fullmatch(file.name), file) for file in files)
    return sorted(Part(int(match[1]), int(match[2]), file) for match, file in matches if match)


def parts_of_run(path: Path) -> list[Path]:
    """Return the parts of a run, by its name (see `run_path`).

    Empty if a file has that name, or if it is not the name of a run.
    """
    stem, suffix = _split(path)
    match = re.fullmatch(r"(.*)-(\d{4,9})", stem)
    try:
        if match is None or path.exists():
            return []
    except OSError:  # a name that is too long
        return []
    base = path.with_name(match[1] + suffix)
    return [each.path for each in all_parts(base) if each.run == int(match[2])]


def _split(path: Path) -> tuple[str, str]:
    """Return name and suffix, the latter with .gz's ("drive.log.gz": "drive", ".log.gz")."""
    suffix = path.suffix
    if suffix.lower() == ".gz":
        suffix = Path(path.name.removesuffix(suffix)).suffix + suffix
    return path.name.removesuffix(suffix) if suffix else path.name, suffix


# --- Captures


class Capture:
    """A capture file: iterable over its messages, any number of times.

    Time stamps are in seconds, as recorded: from 1970, from the start of the capture or of the
    logger. In a capture without stamps, time is counted from 0 in frames of the clock's id;
    frames between two of them have the earlier one's time.

    Parameters
    ----------
    path : Path
    kind : type of CaptureReader
    clock : tuple of int and float
        Id of the frames that count time where there are no stamps, and their period [s].
    parts : sequence of Path
        The files for which `path` stands; by default itself.
    """

    def __init__(
        self,
        path: Path,
        kind: type[CaptureReader],
        clock: tuple[int, float],
        parts: Sequence[Path] = (),
    ) -> None:
        self.path = path
        self._parts = parts or (path,)
        self._kind = kind
        self._clock = clock
        self._readers: list[CaptureReader] = []

    @property
    def stamps(self) -> Stamps:
        """Resolution of the time stamps."""
        return self._readers[0].stamps if self._readers else self._kind.stamps

    @property
    def info(self) -> CaptureInfo:
        """Findings of the latest iteration; complete after its end."""
        readers = self._readers
        firsts = (each.first_malformed for each in readers)
        return CaptureInfo(
            format=self._kind.name,
            stamps=self.stamps,
            frames=sum(each.frames for each in readers),
            malformed=sum(each.malformed for each in readers),
            first_malformed=next((first for first in firsts if first is not None), None),
            cut_off=any(each.cut_off for each in readers),
            remarks=tuple(self._remarks()),
        )

    def _remarks(self) -> Iterator[str]:
        if self.stamps == "ms":
            yield "time stamps are whole milliseconds"
        elif self.stamps == "none":
            number, period_s = self._clock
            yield (
                "no time stamps: time is counted from 0 by frames of"
                f" 0x{number:X}, one every {1000.0 * period_s:g} ms"
            )
        yield from dict.fromkeys(chain.from_iterable(each.remarks for each in self._readers))
        for reader in self._readers:
            if reader.malformed:
                number = reader.first_malformed or 0
                first = f" (first: {number})" if number else ""
                yield f"{reader.malformed} malformed {reader.unit} skipped{first}"
        if any(each.cut_off for each in self._readers):
            frames = sum(each.frames for each in self._readers)
            yield f"the file is cut off after {frames} frames"

    def __iter__(self) -> Iterator[can.Message]:
        """Yield the messages in the file's order.

        Raises
        ------
        InputError
            If the file cannot be read, holds no frames or mostly malformed lines (names the
            first), or has neither stamps nor frames of the clock's id.
        """
        self._readers = []
        messages: Iterator[can.Message] = chain.from_iterable(map(self._read, self._parts))
        yield from self._count_time(messages) if self._kind.stamps == "none" else messages
        # An empty last part, begun just before a power cut, does not invalidate the others.
        if not any(each.frames for each in self._readers):
            last = self._readers[-1]
            if last.damage is not None:
                raise last.damaged()
            raise InputError("the capture holds no frames", source=self.path, cure=_CURE)
        for reader in self._readers:
            if reader.malformed > reader.frames:
                raise reader.junk()

    def _read(self, path: Path) -> Iterator[can.Message]:
        with self._kind(path) as reader:
            self._readers.append(reader)
            yield from reader.messages()

    def _count_time(self, messages: Iterator[can.Message]) -> Iterator[can.Message]:
        number, period_s = self._clock
        ticks = 0
        for message in messages:
            ticks += message.arbitration_id == number and not message.is_extended_id
            message.timestamp = max(ticks - 1, 0) * period_s
            yield message
        if not ticks and any(each.frames for each in self._readers):
            raise InputError(
                f"no time stamps, and no frames of 0x{number:X} to count time by",
                source=self.path,
                cure="record it with stamps, for instance by candump -l",
            )


def find_capture(
    path: str | PathLike[str], *, clock: tuple[int, float] = (CLOCK_ID, CLOCK_PERIOD_S)
) -> Capture | None:
    """Return the capture of a file or of the parts of a recording; None if it is no capture.

    Parameters
    ----------
    path : path-like
        A file, or the name of a run (see `run_path`).
    clock : tuple of int and float
        Id of the frames that count time where there are no stamps, and their period [s].

    Raises
    ------
    InputError
        If it cannot be read.
    """
    path = Path(path)
    parts = parts_of_run(path)
    for part in parts or [path]:
        with open_unpacked(part) as file:
            head = read_beginning(file, _HEAD_BYTES)
        for kind in capture_readers():
            if kind.matches(head):
                return Capture(path, kind, clock, parts)
    return None


def open_capture(
    path: str | PathLike[str], *, clock: tuple[int, float] = (CLOCK_ID, CLOCK_PERIOD_S)
) -> Capture:
    """Return the capture of a file or of the parts of a recording.

    Parameters as of `find_capture`.

    Raises
    ------
    InputError
        If it cannot be read, or is no known kind of capture.
    """
    capture = find_capture(path, clock=clock)
    if capture is None:
        raise InputError("the file is not a known kind of capture", source=path, cure=_CURE)
    return capture


def is_capture(path: str | PathLike[str]) -> bool:
    """Return whether a file is a readable capture of a known kind."""
    try:
        return find_capture(path) is not None
    except InputError:
        return False

"""Readers of captures: their contract, text formats, and candump's log.

A format is a `CaptureReader`, recognised by the beginning of a file, not by its suffix. Others are
in `cangauge.extras.formats`; those of other packages join by the entry point group
`cangauge.capture_readers`.
"""

from __future__ import annotations

import io
import math
import os
import re
import struct
import zlib
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from itertools import chain, islice, pairwise
from pathlib import Path
from typing import IO, Any, ClassVar, Final, Literal, Self, cast

import can
from can.interfaces.socketcan.constants import CAN_ERR_FLAG, MSK_ARBID
from can.io.blf import BLFParseError
from can.io.generic import MessageReader, TextIOMessageReader
from can.typechecking import StringPathLike

from cangauge._files import open_unpacked
from cangauge.bus.time_source import OUT_OF_ORDER_S
from cangauge.errors import InputError
from cangauge.estimation.counting import LATEST_S

PYTHON_CAN: Final = "cangauge.extras.formats.python_can"
"""Module of the formats that python-can reads; loaded when a capture is opened."""
MAX_LINE: Final = 16 * 1024
"""Longest line of a text capture [characters]."""
HEAD_LINES: Final = 400
"""First lines, by which a text format is recognised."""
IDLE_LINES: Final = 1_000_000
"""A text with more lines than this in a row that state no frame is refused: reading them takes a
second."""
FEW_MALFORMED: Final = 100
"""A file with more malformed lines than this, and than frames, is refused at once."""
PERIODS_S: Final = (1.0, 60.0, 3600.0, 2.0**32 / 1e6, 86400.0)
"""Times after which clocks of loggers start again [s]: fractions of a second, seconds of a minute
(slcan, CARBUS), minutes of an hour, 32 bits of microseconds, and times of day."""
STALE_FRAMES: Final = 100
"""First frames whose first half may be left of an earlier recording in a logger's buffer: their
stamps lie more than a day before the others, or after them."""
PAUSE_S: Final = 100.0
"""Pause that is put between sessions in one file [s]: no charge is counted over it."""
FIRST_DATE_S: Final = 1e9
"""Stamps from here on are dates [s since 1970]: the year 2001."""
MOST_BUSES: Final = 64
"""Most buses in a file, each of which has its own decoder; frames of further ones are malformed."""

Stamps = Literal["us", "ms", "none"]
"""Resolution of time stamps: microseconds or finer, whole milliseconds, or no stamps."""

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


class CaptureReader(MessageReader, ABC):
    """Reader of one capture format, in the shape of python-can's readers; a path may be gzipped.

    Malformed lines or frames are skipped and counted, and a file that breaks off gives the frames
    before. Subclasses state `name`, recognise their files in `matches`, and yield the frames in
    `read`, which may raise any of `DAMAGE` where the file breaks off.

    Attributes
    ----------
    name, unit : str
        Of the format, and of what is malformed, for messages.
    keeps_dates : bool
        Stamps that are dates are those of the bus, also where its clock was set: the service's own
        recordings give its numbers again.
    stamps : {"us", "ms", "none"}
    frames, malformed, first_malformed : int
        Frames read, and lines or frames skipped as malformed, so far; number of the first, from 1.
    cut_off, damage : bool, str or None
        Whether the file broke off within a line or frame, and the error there.
    remarks : list of str
        For the user.
    raw : binary file object
        The unpacked content.
    """

    name: ClassVar[str]
    unit: ClassVar[str] = "frames"
    keeps_dates: ClassVar[bool] = False
    stamps: Stamps = "us"

    def __init__(self, file: StringPathLike | IO[Any], **_options: object) -> None:
        self.source = Path(file) if isinstance(file, str | os.PathLike) else None
        opened = file if self.source is None else open_unpacked(self.source)
        self.raw = cast("io.BufferedIOBase", opened)
        self.frames = self.malformed = 0
        self.first_malformed: int | None = None
        self.cut_off = False
        self.damage: str | None = None
        self.remarks: list[str] = []
        self._is_bus_time = False

    @classmethod
    def of(cls, name: str, **attributes: object) -> type[Self]:
        """Return the reader of a format that differs from others in its attributes alone."""
        return cast("type[Self]", type(name, (cls,), {"name": name, **attributes}))

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
        """Yield the frames of known buses with usable stamps, as far as the file can be read.

        Of each bus, time goes on where its clock starts again, and stale frames at the head are
        left out. Raises InputError if most lines are malformed; it names the first.
        """
        buses, clock = set[Any](), _Clock()
        for message in self._frames():
            is_known = message.channel in buses or len(buses) < MOST_BUSES
            if is_known and abs(message.timestamp) <= LATEST_S:  # false for NaN
                buses.add(message.channel)
                if not self._is_bus_time:
                    message.timestamp = clock.running_s(message.channel, message.timestamp)
                self.frames += 1
                yield message
            else:
                self.skip(None)
        self.remarks += clock.remarks()

    def _undamaged(self) -> Iterator[can.Message]:
        """Yield the frames as far as the file can be read."""
        try:
            yield from self.read()
        except DAMAGE as error:
            self.cut_off = True
            self.damage = f"{type(error).__name__}: {error}"

    def _frames(self) -> Iterator[can.Message]:
        """Return the frames that are read, without stale ones where the clock is the logger's."""
        frames = self._undamaged()
        if self.keeps_dates and (first := next(frames, None)) is not None:
            self._is_bus_time = first.timestamp >= FIRST_DATE_S
            frames = chain([first], frames)
        return frames if self._is_bus_time else self._current(frames)

    def _current(self, frames: Iterator[can.Message]) -> Iterator[can.Message]:
        """Yield frames without those at the head that a logger's buffer has kept from before."""
        head, stale = list(islice(frames, STALE_FRAMES)), 0
        for place, (one, two) in enumerate(pairwise(head[: len(head) // 2]), start=1):
            step_s = two.timestamp - one.timestamp
            is_jump = step_s < -OUT_OF_ORDER_S or step_s > max(PERIODS_S)
            is_turn = _Clock.turn_s(one.timestamp, two.timestamp, OUT_OF_ORDER_S) > 0.0
            is_usable = abs(two.timestamp) <= LATEST_S and one.channel == two.channel
            if is_usable and is_jump and not is_turn:
                stale = place
        if stale:
            others = "1 frame" if stale == 1 else f"{stale} frames"
            self.remarks.append(f"{others} at the head left out, with stamps of another time")
        yield from head[stale:]
        yield from frames

    def __iter__(self) -> Iterator[can.Message]:
        """Yield the frames as `messages`; raise InputError for damage before the first one."""
        yield from self.messages()
        self.refuse_damage()

    def refuse_damage(self) -> None:
        """Raise InputError for a file that broke off before its first frame."""
        if self.damage is not None and not self.frames:
            problem = f"the {self.name} file is damaged ({self.damage})"
            raise InputError(problem, source=self.source, cure="record or fetch it again")

    def bounded(self, lines: Iterator[str]) -> Iterator[str]:
        """Yield lines; raise InputError where `IDLE_LINES` in a row state no frame."""
        frames = idle = 0
        for line in lines:
            idle = idle + 1 if frames == self.frames else 0
            frames = self.frames
            if idle > IDLE_LINES:
                problem = f"{IDLE_LINES} lines in a row state no frame of {self.name}"
                raise InputError(problem, source=self.source, cure="record or export it again")
            yield line

    def skip(self, line: int | None) -> None:
        """Count a malformed line or frame; raise InputError if there are many."""
        self.malformed += 1
        if self.first_malformed is None:
            self.first_malformed = line
        if self.malformed > FEW_MALFORMED and self.malformed > self.frames:
            where = "" if self.first_malformed is None else f", the first is {self.first_malformed}"
            problem = f"{self.malformed} {self.unit} are no frames of {self.name}{where}"
            problem += f", and only {self.frames} are"
            raise InputError(problem, source=self.source, cure="record or export it again")


class _Clock:
    """Stamps of a file as one running time."""

    def __init__(self) -> None:
        self._shift_s = self._longest_s = self._turn_s = 0.0
        self._last_s = self._latest_s = -math.inf
        """Latest stamp, and largest running time."""
        self._buses: dict[Any, tuple[float, float]] = {}
        """Latest stamp of each bus, and its shift: two adapters may have two clocks."""
        self._turns: Counter[float] = Counter()
        self._sessions = 1

    @staticmethod
    def turn_s(last_s: float, stamp_s: float, longest_s: float) -> float:
        """Return the period after which the clock has started again; 0 where it has not.

        The step is then about as long as others, of which `longest_s` is the longest [s].
        """
        for period_s in PERIODS_S:
            if 0.0 <= stamp_s < last_s < period_s:
                step_s = stamp_s + period_s - last_s
                if step_s <= max(3.0 * longest_s, 0.01 * period_s):
                    return period_s
        return 0.0

    def running_s(self, bus: Any, stamp_s: float) -> float:
        """Return a stamp as time that goes on where the clock starts again [s]."""
        time_s = stamp_s + self._shift_s
        if self._turn_s and time_s > self._latest_s + 0.5 * self._turn_s:
            return time_s - self._turn_s  # late, of before the turn
        if turn_s := self.turn_s(self._last_s, stamp_s, self._longest_s):
            self._shift_s += turn_s
            self._turn_s = turn_s
            self._turns[turn_s] += 1
            self._buses.clear()
        before_s, shift_s = self._buses.get(bus, (stamp_s, self._shift_s))
        if stamp_s < before_s - OUT_OF_ORDER_S:
            if shift_s == self._shift_s:
                self._shift_s = self._latest_s + PAUSE_S - stamp_s
                self._sessions += 1
            shift_s = self._shift_s
        self._longest_s = max(self._longest_s, stamp_s - before_s)
        self._buses[bus] = stamp_s, shift_s
        self._last_s = stamp_s
        self._latest_s = max(self._latest_s, stamp_s + shift_s)
        return stamp_s + shift_s

    def remarks(self) -> Iterator[str]:
        """Yield what was found, for the user."""
        for period_s, count in self._turns.items():
            yield f"the clock starts again every {period_s:.6g} s ({count} times): time goes on"
        if self._sessions > 1:
            yield (
                f"time starts again: {self._sessions} sessions in one file, which follow each other"
                f" after {PAUSE_S:g} s"
            )


class LineReader(CaptureReader, TextIOMessageReader):
    """Reader of a text format with one frame a line.

    `states_length`: a line states its number of bytes, so that a cut line is recognised.
    """

    states_length: ClassVar[bool] = True
    unit: ClassVar[str] = "lines"

    @classmethod
    def matches(cls, head: bytes) -> bool:
        """Return whether most lines are frames."""
        reader = cls(io.BytesIO(head))
        lines = list(islice(reader.lines(), HEAD_LINES))
        if len(lines) > 1:
            lines.pop()  # may be cut
        if not lines or not reader.prepare(lines):
            return False
        frames = malformed = 0
        for line in lines:
            try:
                frames += not line.isspace() and reader.parse(line) is not None
            except (ValueError, OverflowError):
                malformed += 1
        return frames > malformed

    def prepare(self, head: Sequence[str]) -> bool:
        """Set up parsing by the first lines; return whether they are of this format."""
        del head
        return True

    @abstractmethod
    def parse(self, line: str) -> can.Message | None:
        """Return the frame of a line that is not blank; None for one that states no frame.

        Raises ValueError or OverflowError if the line is malformed.
        """

    def lines(self) -> Iterator[str]:
        """Yield the lines before the file breaks off; one beyond `MAX_LINE` in pieces."""
        text: Any = self.raw
        if not isinstance(text, io.TextIOBase):
            text = io.TextIOWrapper(self.raw, "latin-1", newline=None)
        try:
            while line := text.readline(MAX_LINE):
                yield line
        except (EOFError, OSError, zlib.error):
            self.cut_off = True

    def read(self) -> Iterator[can.Message]:
        """Yield the frames of the lines."""
        lines = self.bounded(self.lines())
        head = list(islice(lines, HEAD_LINES))
        if head and not self.prepare(head):
            raise InputError(f"the file is not a {self.name}", source=self.source)
        for number, line in enumerate(chain(head, lines), start=1):
            if line.isspace():
                continue
            is_cut = not (line.endswith("\n") or self.states_length)
            self.cut_off |= is_cut
            try:
                message = None if is_cut else self.parse(line)
            except (ValueError, OverflowError):
                is_cut = True
            if is_cut:
                self.skip(number)
            elif message is not None:
                yield message


def frame(
    time: str | float,
    number: str | int,
    data: str | None,
    length: str | int | None = None,
    *,
    is_extended: bool | None = None,
    **more: Any,
) -> can.Message:
    """Return a frame; id and bytes are hex text, `more` is as `can.Message`.

    `data` is None for a remote frame; `length` is the stated number of bytes. By default an id is
    extended where it has more than 11 bits. Raises ValueError for no such id or another number of
    bytes.
    """
    arbitration_id = int(number, 16) if isinstance(number, str) else number
    is_large = arbitration_id > 0x7FF
    if not 0 <= arbitration_id <= MSK_ARBID or (is_large and is_extended is False):
        raise ValueError("no such id")
    content = bytes.fromhex(data or "")
    size = len(content) if length is None else int(length or 0)
    if len(content) > 64 or (data is not None and size != len(content)):
        raise ValueError("length and bytes differ")
    more.setdefault("is_fd", len(content) > 8)
    return can.Message(
        timestamp=float(time),
        arbitration_id=arbitration_id,
        is_extended_id=is_large if is_extended is None else is_extended,
        is_remote_frame=data is None,
        dlc=size if data is None else None,
        data=content,
        **more,
    )


def candump_frame(
    time: str, channel: str, number: str, data: str | None, length: str | None = None, **more: Any
) -> can.Message:
    """Return a frame as candump writes it: ids of eight digits are extended, and have flags."""
    bits, is_extended = int(number, 16), len(number) == 8
    is_error = is_extended and bool(bits & CAN_ERR_FLAG)
    return frame(
        time,
        bits & MSK_ARBID,
        data,
        length,
        is_extended=is_extended,
        is_error_frame=is_error,
        channel=channel,
        **more,
    )


class CandumpLogReader(LineReader):
    """Log file of candump -l; python-can's reader stops at a malformed line."""

    name = "candump log"
    states_length = False
    keeps_dates = True
    # (1436509052.249713) vcan0 044#2A366C2BBA
    _PATTERN: Final = re.compile(
        r"\((\d+\.\d+)\) (\S+) ([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#"
        r"(?:(#[0-9A-Fa-f])?((?:[0-9A-Fa-f]{2}\.?)*)|R(\d?))(?: ([RT]))?\s*$"
    )

    def parse(self, line: str) -> can.Message | None:
        """Return the frame of a line."""
        match = self._PATTERN.match(line)
        if match is None:
            raise ValueError("not a frame")
        time, channel, number, fd_flags, data, remote, way = match.groups()
        flags = int(fd_flags[1], 16) if fd_flags else 0
        return candump_frame(
            time,
            channel,
            number,
            data and data.replace(".", ""),
            remote,
            is_fd=fd_flags is not None,
            bitrate_switch=bool(flags & 1),
            error_state_indicator=bool(flags & 2),
            is_rx=way != "T",
        )


@cache
def capture_readers() -> tuple[type[CaptureReader], ...]:
    """Return all readers of captures, in the order of their trial."""
    library: tuple[type[CaptureReader], ...] = import_module(PYTHON_CAN).READERS
    others = (each.load() for each in entry_points(group="cangauge.capture_readers"))
    return (*library, CandumpLogReader, *others)

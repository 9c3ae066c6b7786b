"""Base of the readers of captures, in the shape of `can.io.generic.MessageReader`.

A reader yields messages and survives damage: it skips and counts malformed lines, notes where a
file breaks off, and bounds what a hostile file may cost. Other packages add formats by a subclass
in the entry point group `cangauge.capture_readers`.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import IO, Any, ClassVar, Final, cast

import can
from can.io.blf import BLFParseError
from can.io.generic import BinaryIOMessageReader, MessageReader, TextIOMessageReader
from can.typechecking import StringPathLike

from cangauge._io import MAX_IDLE_LINES, MAX_STAMP_S
from cangauge.bus.captures.files import LineStream, Stamps, head_lines, open_bytes
from cangauge.errors import InputError

FEW_MALFORMED: Final = 100
"""A file with more malformed lines than this, and than frames, is refused."""

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
    """Reader of one capture format.

    Subclasses state `name`, recognise their files in `matches`, and yield the frames of one in
    `read`, which may raise any of `DAMAGE` where the file breaks off.

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
    """

    name: ClassVar[str]
    stamps: Stamps = "us"
    unit: ClassVar[str] = "frames"
    """Of what is malformed, for messages."""

    def __init__(self, file: StringPathLike | IO[Any], **_options: object) -> None:
        self.source = Path(file) if isinstance(file, str | os.PathLike) else None
        self.frames = 0
        self.malformed = 0
        self.first_malformed: int | None = None
        self.cut_off = False
        self.damage: str | None = None
        self.remarks: list[str] = []

    @classmethod
    @abstractmethod
    def matches(cls, head: bytes) -> int:
        """Return how many frames the beginning of a file shows in this format; 0 if it is another.

        Parameters
        ----------
        head : bytes
            The unpacked beginning, up to 64 KiB.
        """

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
                if not abs(message.timestamp) <= MAX_STAMP_S:
                    self.skip(None)
                    continue
                self.frames += 1
                yield message
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
    """Reader of a binary format.

    Attributes
    ----------
    raw : buffered reader
        The unpacked content.
    """

    def __init__(self, file: StringPathLike | IO[Any], **options: object) -> None:
        CaptureReader.__init__(self, file, **options)
        opened = open_bytes(self.source) if self.source is not None else file
        self.raw = cast("io.BufferedIOBase", opened)

    def stop(self) -> None:
        """Close the file."""
        self.raw.close()


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

    def __init__(self, file: StringPathLike | IO[Any], **options: object) -> None:
        CaptureReader.__init__(self, file, **options)
        opened = open_bytes(self.source) if self.source is not None else file
        self._lines = LineStream(cast("IO[Any]", opened))
        self._head = list(islice(self._lines, HEAD_LINES))
        self._is_mine = bool(self._head) and self.prepare(self._head)

    def stop(self) -> None:
        """Close the file."""
        self._lines.close()

    @classmethod
    def matches(cls, head: bytes) -> int:
        """Return the number of lines that are frames; 0 if most are malformed."""
        lines = head_lines(head)[:HEAD_LINES]
        reader = cls(io.StringIO("\n".join(lines)))
        if not reader._is_mine:
            return 0
        frames = malformed = 0
        for line in lines:
            try:
                frames += reader.parse(line) is not None
            except (ValueError, OverflowError):
                malformed += 1
        return frames if frames > malformed else 0

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
        if self._head and not self._is_mine:
            raise InputError(f"the file is not a {self.name}", source=self.source)
        idle = 0
        for number, line in enumerate(chain(self._head, self._lines), start=1):
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
            if message is None:
                idle += 1
                if idle > MAX_IDLE_LINES:
                    raise idle_error(self, "lines", f"up to line {number}")
                continue
            idle = 0
            yield message
        self.cut_off |= self._lines.cut_off


HEAD_LINES: Final = 400


def idle_error(reader: CaptureReader, what: str, where: str) -> InputError:
    """Return the error for a long stretch without a frame."""
    return InputError(
        f"{MAX_IDLE_LINES} {what} in a row hold no frame",
        source=reader.source,
        value=where,
        cure="remove them",
    )


# --- Fields that several formats share

MAX_STANDARD_ID: Final = 0x7FF
MAX_ID: Final = 0x1FFFFFFF
ERROR_FLAG: Final = 0x20000000


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
    return number, number > MAX_STANDARD_ID


def is_whole(message: can.Message) -> bool:
    """Return whether the data of a message are as long as its DLC states."""
    if message.is_remote_frame or message.is_error_frame:
        return True
    return len(message.data) == message.dlc


def blank(line: str) -> can.Message | None:
    """Return None for a blank line; raise ValueError for any other."""
    if line.strip():
        raise ValueError("not a frame")
    return None

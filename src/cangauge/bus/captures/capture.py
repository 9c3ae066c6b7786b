"""Read a capture of any known format as messages; recognised by content, not by suffix."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from os import PathLike
from pathlib import Path
from typing import Final

import can
from can.typechecking import Channel

from cangauge._io import MAX_BUSES, MAX_IDLE_LINES, MAX_STAMP_S
from cangauge.bus.captures.files import CaptureInfo, LineStream, Stamps, parts_of_run, read_head
from cangauge.bus.captures.readers import (
    DAMAGE,
    LIBRARY_FORMATS,
    TEXT_FORMATS,
    LibraryFormat,
    TextFormat,
    library_messages,
)
from cangauge.errors import InputError

CLOCK_ID: Final = 0x1DB
"""Without time stamps, frames of this id (Nissan Leaf) count time, …"""
CLOCK_PERIOD_S: Final = 0.010
"""… one each period [s]."""

FEW_MALFORMED: Final = 100
"""A file with more malformed lines than this, and than frames, is refused."""
_HEAD_LINES: Final = 400

KNOWN_CAPTURES: Final = (
    "candump (log, and screen output), CRTD, SavvyCAN's GVRET CSV, CAN Hacker and CARBUS traces,"
    " Vector ASC and BLF, PEAK TRC, ASAM MF4, python-can's CSV, tab-separated tables, and text of"
    " seconds, id, length, bytes; each may be gzipped"
)
_CURE: Final = f"known are: {KNOWN_CAPTURES}"


class Capture:
    """A capture file: iterable over its messages, any number of times.

    Time stamps are in seconds, as recorded: from 1970, from the start of the capture or of the
    logger. In a capture without stamps, time is counted from 0 in frames of the clock's id;
    frames between two of them have the earlier one's time.

    Parameters
    ----------
    path : Path
    kind : TextFormat or LibraryFormat
    clock : tuple of int and float
        Id of the frames that count time where there are no stamps, and their period [s].
    parts : sequence of Path
        The files for which `path` stands; by default itself.
    """

    def __init__(
        self,
        path: Path,
        kind: TextFormat | LibraryFormat,
        clock: tuple[int, float],
        parts: Sequence[Path] = (),
    ) -> None:
        self.path = path
        self._parts = parts or (path,)
        self._kind = kind
        self._clock = clock
        self._reset()

    def _reset(self) -> None:
        self._frames = 0
        self._malformed = 0
        self._first_malformed: int | None = None
        self._cut_off = False
        self._remarks: list[str] = []

    @property
    def stamps(self) -> Stamps:
        """Resolution of the time stamps."""
        return self._kind.stamps if isinstance(self._kind, TextFormat) else "us"

    @property
    def info(self) -> CaptureInfo:
        """Findings of the latest iteration; complete after its end."""
        return CaptureInfo(
            format=self._kind.name,
            stamps=self.stamps,
            frames=self._frames,
            malformed=self._malformed,
            first_malformed=self._first_malformed,
            cut_off=self._cut_off,
            remarks=(*self._stamp_remarks(), *self._remarks),
        )

    def _stamp_remarks(self) -> list[str]:
        if self.stamps == "ms":
            return ["time stamps are whole milliseconds"]
        if self.stamps == "none":
            number, period_s = self._clock
            return [
                "no time stamps: time is counted from 0 by frames of"
                f" 0x{number:X}, one every {1000.0 * period_s:g} ms"
            ]
        return []

    def __iter__(self) -> Iterator[can.Message]:
        """Yield the messages in the file's order.

        Raises
        ------
        InputError
            If the file cannot be read, holds no frames or mostly malformed lines (names the
            first), or has neither stamps nor frames of the clock's id.
        """
        self._reset()
        if isinstance(self._kind, TextFormat):
            kind = self._kind
            messages: Iterator[can.Message] = chain.from_iterable(
                self._text(kind, part) for part in self._parts
            )
            if kind.stamps == "none":
                messages = self._count_time(messages)
        else:
            library = self._kind
            messages = chain.from_iterable(self._library(library, part) for part in self._parts)
        channels: set[Channel | None] = set()
        for message in messages:
            if message.channel not in channels:
                channels.add(message.channel)
                if len(channels) > MAX_BUSES:
                    raise InputError(
                        f"frames of more than {MAX_BUSES} buses", source=self.path, cure=_CURE
                    )
            yield message
        self._finish()

    def _text(self, kind: TextFormat, path: Path) -> Iterator[can.Message]:
        parse = kind.parser(_head_lines(read_head(path)))
        if parse is None:
            raise _unknown(path)
        lines = LineStream(path)
        idle = 0
        for line in lines:
            if not line.endswith("\n") and not kind.states_length and line.strip():
                # The last line may have lost bytes, and its format does not show it.
                self._cut_off = True
                self._skip(lines.number)
                continue
            try:
                message = parse(line)
            except (ValueError, OverflowError):
                self._skip(lines.number)
                continue
            if message is None:
                idle += 1
                if idle > MAX_IDLE_LINES:
                    raise InputError(
                        f"{MAX_IDLE_LINES} lines in a row hold no frame",
                        source=self.path,
                        value=f"up to line {lines.number}",
                        cure="remove them",
                    )
                continue
            idle = 0
            if not abs(message.timestamp) <= MAX_STAMP_S:
                self._skip(lines.number)
                continue
            self._frames += 1
            yield message
        if lines.cut_off:
            self._cut_off = True

    def _library(self, kind: LibraryFormat, path: Path) -> Iterator[can.Message]:
        try:
            for message in library_messages(kind, path):
                if not (message.is_fd or message.is_remote_frame or message.is_error_frame) and (
                    len(message.data) != message.dlc
                ):
                    self._skip(None)
                    continue
                if not abs(message.timestamp) <= MAX_STAMP_S:
                    self._skip(None)
                    continue
                self._frames += 1
                yield message
        except DAMAGE as error:
            self._cut_off = True
            # An empty last part, begun just before a power cut, does not invalidate the others.
            if not self._frames and path == self._parts[-1]:
                raise InputError(
                    f"the {kind.name} file is damaged ({type(error).__name__}: {error})",
                    source=path,
                    cure="record or fetch it again",
                ) from error

    def _count_time(self, messages: Iterator[can.Message]) -> Iterator[can.Message]:
        number, period_s = self._clock
        ticks = 0
        for message in messages:
            if message.arbitration_id == number and not message.is_extended_id:
                ticks += 1
            message.timestamp = max(ticks - 1, 0) * period_s
            yield message
        if self._frames and not ticks:
            raise InputError(
                f"no time stamps, and no frames of 0x{number:X} to count time by",
                source=self.path,
                cure="record it with stamps, for instance by candump -l",
            )

    def _skip(self, line: int | None) -> None:
        self._malformed += 1
        if self._first_malformed is None:
            self._first_malformed = line
        if self._malformed > FEW_MALFORMED and self._malformed > self._frames:
            raise self._junk()

    def _junk(self) -> InputError:
        where = "" if self._first_malformed is None else f", the first is {self._first_malformed}"
        return InputError(
            f"{self._malformed} lines are no frames of {self._kind.name}{where},"
            f" and only {self._frames} are",
            source=self.path,
            cure="record or export it again",
        )

    def _finish(self) -> None:
        if not self._frames:
            raise InputError("the capture holds no frames", source=self.path, cure=_CURE)
        if self._malformed > self._frames:
            raise self._junk()
        if self._malformed:
            first = "" if self._first_malformed is None else f" (first: {self._first_malformed})"
            self._remarks.append(f"{self._malformed} malformed lines skipped{first}")
        if self._cut_off:
            self._remarks.append(f"the file is cut off after {self._frames} frames")


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
    kinds = (_recognise(read_head(part)) for part in parts or [path])
    kind = next((each for each in kinds if each is not None), None)
    return None if kind is None else Capture(path, kind, clock, parts)


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
        raise _unknown(Path(path))
    return capture


def read_capture(path: str | PathLike[str]) -> Iterator[can.Message]:
    """Yield the messages of a capture; see `open_capture` and `Capture`."""
    return iter(open_capture(path))


def is_capture(path: str | PathLike[str]) -> bool:
    """Return whether a file is a readable capture of a known kind."""
    try:
        return find_capture(path) is not None
    except InputError:
        return False


def _recognise(head: bytes) -> TextFormat | LibraryFormat | None:
    for kind in LIBRARY_FORMATS:
        if kind.matches(head):
            return kind
    lines = _head_lines(head)
    scores = {text.name: _score(text, lines) for text in TEXT_FORMATS}
    best = max(TEXT_FORMATS, key=lambda text: scores[text.name])
    return best if scores[best.name] > 0 else None


def _head_lines(head: bytes) -> list[str]:
    text = head.decode("latin-1").replace("\r\n", "\n").replace("\r", "\n")
    lines = text.split("\n")[:_HEAD_LINES]
    return lines[:-1] if len(lines) > 1 else lines  # the last one may be cut


def _score(kind: TextFormat, lines: list[str]) -> int:
    """Return the number of lines that are frames; 0 if most are malformed."""
    parse = kind.parser(lines)
    if parse is None:
        return 0
    frames = malformed = 0
    for line in lines:
        try:
            frames += parse(line) is not None
        except (ValueError, OverflowError):
            malformed += 1
    return frames if frames > malformed else 0


def _unknown(path: Path) -> InputError:
    return InputError("the file is not a known kind of capture", source=path, cure=_CURE)

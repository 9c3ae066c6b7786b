"""Captures: files of recorded frames, and the numbered parts of a recording."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Final

import can
from can.typechecking import StringPathLike

from cangauge._files import HEAD_BYTES, open_unpacked, read_beginning
from cangauge.bus.readers import CaptureReader, capture_readers
from cangauge.errors import InputError

CLOCK: Final = (0x1DB, 0.010)
"""Without time stamps, frames of this id (Nissan Leaf) count time; their period [s]."""

KNOWN_CAPTURES: Final = (
    "candump (log, and screen output), CRTD, SavvyCAN's GVRET CSV, cabana's CSV, Battery-Emulator's"
    " log, CAN Hacker and CARBUS traces, text of CANalyst-II's tool and of slcan, Vector ASC and"
    " BLF, PEAK TRC, PCAP and PCAPNG, ASAM MF4, python-can's CSV, tab-separated tables,"
    " and text of seconds, id, length, bytes; each may be gzipped"
)
_CURE: Final = f"known are: {KNOWN_CAPTURES}"

# --- Recordings in parts. `cangauge run` numbers its runs and can split them: files
# `drive-0003-000001.log`, `drive-0003-000002.log` are run 3 of `drive.log`; `drive-0003.log` names
# both.


def part_path(path: Path, run: int, part: int) -> Path:
    """Return the name of a part of the recording `path`."""
    stem, suffix = _split(path)
    return path.with_name(f"{stem}-{run:04d}-{part:06d}{suffix}")


def run_path(path: Path, run: int) -> Path:
    """Return the name for all parts of a run."""
    stem, suffix = _split(path)
    return path.with_name(f"{stem}-{run:04d}{suffix}")


def all_parts(path: Path) -> list[tuple[int, int, Path]]:
    """Return run, part and file of all parts of the recording `path`, in order."""
    stem, suffix = _split(path)
    pattern = re.compile(rf"{re.escape(stem)}-(\d{{4,9}})-(\d{{6,9}}){re.escape(suffix)}")
    try:
        files = list(path.parent.iterdir())
    except (OSError, ValueError):  # ValueError: a null byte in the path
        return []
    matches = ((pattern.fullmatch(file.name), file) for file in files)
    return sorted((int(match[1]), int(match[2]), file) for match, file in matches if match)


def parts_of_run(path: Path) -> list[Path]:
    """Return the parts of a run by its name; empty if a file has that name, or it is no run."""
    stem, suffix = _split(path)
    match = re.fullmatch(r"(.*)-(\d{4,9})", stem)
    try:
        if match is None or path.exists():
            return []
    except OSError:  # a name that is too long
        return []
    parts = all_parts(path.with_name(match[1] + suffix))
    return [part for run, _, part in parts if run == int(match[2])]


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
    logger. In a capture without stamps, time is counted from 0 in frames of an id and with a period
    [s] (`clock`); frames between two of them have the earlier one's time. `parts` are the files for
    which `path` stands; by default itself.
    """

    def __init__(
        self,
        path: Path,
        kind: type[CaptureReader],
        clock: tuple[int, float] = CLOCK,
        parts: Sequence[Path] = (),
    ) -> None:
        self.path = path
        self._parts = parts or (path,)
        self._kind = kind
        self._clock = clock
        self._readers: list[CaptureReader] = []

    @property
    def info(self) -> dict[str, Any]:
        """Findings of the latest iteration, complete after its end: attributes of `CaptureReader`.

        `format` is its name.
        """
        readers = self._readers
        firsts = (each.first_malformed for each in readers)
        return {
            "format": self._kind.name,
            "stamps": self._stamps,
            "frames": sum(each.frames for each in readers),
            "malformed": sum(each.malformed for each in readers),
            "first_malformed": next((first for first in firsts if first is not None), None),
            "cut_off": any(each.cut_off for each in readers),
            "remarks": tuple(self._remarks()),
        }

    @property
    def _stamps(self) -> str:
        return self._readers[0].stamps if self._readers else self._kind.stamps

    def _remarks(self) -> Iterator[str]:
        readers = self._readers
        if self._stamps == "ms":
            yield "time stamps are whole milliseconds"
        elif self._stamps == "none":
            number, period_s = self._clock
            yield (
                "no time stamps: time is counted from 0 by frames of"
                f" 0x{number:X}, one every {1000.0 * period_s:g} ms"
            )
        yield from dict.fromkeys(chain.from_iterable(each.remarks for each in readers))
        for reader in readers:
            if reader.malformed:
                number = reader.first_malformed or 0
                first = f" (first: {number})" if number else ""
                yield f"{reader.malformed} malformed {reader.unit} skipped{first}"
        if any(each.cut_off for each in readers):
            yield f"the file is cut off after {sum(each.frames for each in readers)} frames"

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
            self._readers[-1].refuse_damage()
            raise InputError("the capture holds no frames", source=self.path, cure=_CURE)

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
            problem = f"no time stamps, and no frames of 0x{number:X} to count time by"
            cure = "record it with stamps, for instance by candump -l"
            raise InputError(problem, source=self.path, cure=cure)


def find_capture(path: StringPathLike, *, clock: tuple[int, float] = CLOCK) -> Capture | None:
    """Return the capture of a file or of the parts of a run (see `run_path`); None if it is none.

    Raises InputError if it cannot be read. `clock` as of `Capture`.
    """
    path = Path(path)
    parts = parts_of_run(path)
    for part in parts or [path]:
        with open_unpacked(part) as file:
            head = read_beginning(file, HEAD_BYTES)
        for kind in capture_readers():
            if kind.matches(head):
                return Capture(path, kind, clock, parts)
    return None


def open_capture(path: StringPathLike, *, clock: tuple[int, float] = CLOCK) -> Capture:
    """Return the capture of a file; as `find_capture`, but InputError if it is none."""
    capture = find_capture(path, clock=clock)
    if capture is None:
        raise InputError("the file is not a known kind of capture", source=path, cure=_CURE)
    return capture

"""What a capture file is and what reading it noticed.

Recordings in parts: `drive-0003-000001.log`, `drive-0003-000002.log`, … are `drive-0003.log`.

`cangauge run` begins a new file now and then, and numbers its runs, so that nothing recorded
before is overwritten. The parts of one run are one capture.

Files as streams of bytes or lines: unpacked, bounded in memory, ends that are cut off noted.
"""

from __future__ import annotations

import io
import re
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, cast

from cangauge._io import GZIP, MAX_CAPTURE_BYTES, MAX_LINE, gunzip_bounded, open_regular

# --- What a capture file is and what reading it noticed

Stamps = Literal["us", "ms", "none"]
"""Resolution of time stamps: microseconds or finer, whole milliseconds, or no stamps at all."""


@dataclass(frozen=True, slots=True)
class CaptureInfo:
    """What reading a capture showed, so far.

    Parameters
    ----------
    format : str
        Name of the format.
    stamps : {"us", "ms", "none"}
    frames : int
        Frames read, error and remote frames included.
    malformed : int
        Lines or frames that were skipped because they make no sense.
    first_malformed : int or None
        Number of the first such line, from 1.
    cut_off : bool
        Whether the file ends in the middle of something.
    remarks : tuple of str
        What a user should know, in words.
    """

    format: str
    stamps: Stamps
    frames: int = 0
    malformed: int = 0
    first_malformed: int | None = None
    cut_off: bool = False
    remarks: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            "format": self.format,
            "stamps": self.stamps,
            "frames": self.frames,
            "malformed": self.malformed,
            "first_malformed": self.first_malformed,
            "cut_off": self.cut_off,
            "remarks": list(self.remarks),
        }


# --- Recordings in parts: `drive-0003-000001.log`, `drive-0003-000002.log`, … are `drive-000…

_RUN: Final = r"(?P<run>\d{4,9})"
_PART: Final = r"(?P<part>\d{6,9})"


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
    """Return the name that stands for all parts of a run."""
    stem, suffix = _split(path)
    return path.with_name(f"{stem}-{run:04d}{suffix}")


def all_parts(path: Path) -> list[Part]:
    """Return the parts of all runs of the recording `path`, in order; none if it has none."""
    stem, suffix = _split(path)
    pattern = re.compile(f"{re.escape(stem)}-{_RUN}-{_PART}{re.escape(suffix)}")
    try:
        names = list(path.parent.iterdir())
    except (OSError, ValueError):  # ValueError: a null byte in the path
        return []
    found = []
    for name in names:
        match = pattern.fullmatch(name.name)
        if match:
            found.append(Part(int(match["run"]), int(match["part"]), name))
    return sorted(found)


def parts_of_run(path: Path) -> list[Path]:
    """Return the files that a run's name, as `run_path` returns it, stands for.

    There are none where there is a file of that name, or where it is no run's name.
    """
    stem, suffix = _split(path)
    match = re.fullmatch(f"(?P<stem>.*)-{_RUN}", stem)
    try:
        is_run = match is not None and not path.exists()
    except OSError:  # a name that is too long
        return []
    if match is None or not is_run:
        return []
    base = path.with_name(match["stem"] + suffix)
    return [each.path for each in all_parts(base) if each.run == int(match["run"])]


def _split(path: Path) -> tuple[str, str]:
    """Return name and suffix, the latter with .gz's ("drive.log.gz": "drive", ".log.gz")."""
    name = path.name
    suffix = path.suffix
    if suffix.lower() == ".gz":
        suffix = Path(name.removesuffix(suffix)).suffix + suffix
    return name.removesuffix(suffix) if suffix else name, suffix


# --- Files as streams of bytes or lines: unpacked, bounded in memory, ends that are cut off …

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

HEAD_BYTES: Final = 64 * 1024


def open_bytes(path: Path) -> io.BufferedReader:
    """Open a file, unpacking gzip whatever its name.

    Raises
    ------
    InputError
        If it is absent, not a regular file or cannot be read; while reading, if it unpacks
        without bounds (see `cangauge._io`).
    """
    file = open_regular(path)
    packed = file.read(2) == GZIP
    file.seek(0)
    if packed:
        return gunzip_bounded(file, path, MAX_CAPTURE_BYTES)
    return cast("io.BufferedReader", file)


def read_head(path: Path) -> bytes:
    """Return the unpacked beginning of a file, as much as can be read of it.

    Raises
    ------
    InputError
        As `open_bytes`.
    """
    head = bytearray()
    with open_bytes(path) as file:
        while len(head) < HEAD_BYTES:
            try:
                # Step by step: what stands before a break in a gzip file is given out first.
                part = file.read1(HEAD_BYTES)
            except (EOFError, OSError, zlib.error):
                break
            if not part:
                break
            head += part
    return bytes(head)


class LineStream:
    """The lines of a text file.

    Attributes
    ----------
    number : int
        Of the latest line, from 1.
    cut_off : bool
        Whether the file broke off (a truncated or damaged gzip).
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.number = 0
        self.cut_off = False

    def __iter__(self) -> Iterator[str]:
        """Yield the lines with their line ends; an overlong line comes in pieces."""
        with open_bytes(self._path) as raw:
            salvage = _Salvage(raw, self)
            text = io.TextIOWrapper(io.BufferedReader(salvage), "latin-1", newline="\n")
            while line := text.readline(MAX_LINE):
                self.number += 1
                yield line


class _Salvage(io.RawIOBase):
    """Reads in small steps and ends quietly where the file below breaks off."""

    def __init__(self, raw: io.BufferedIOBase, owner: LineStream) -> None:
        self._raw = raw
        self._owner = owner

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: WriteableBuffer, /) -> int:
        view = memoryview(buffer)
        try:
            # One step at a time: what stands before the break is given out first.
            part = self._raw.read1(view.nbytes)
        except (EOFError, OSError, zlib.error):
            self._owner.cut_off = True
            return 0
        view[: len(part)] = part
        return len(part)

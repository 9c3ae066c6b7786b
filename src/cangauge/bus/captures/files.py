"""Capture files: findings of reading, recordings in parts, lines of damaged files."""

from __future__ import annotations

import io
import re
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final, Literal, NamedTuple, cast

from cangauge._io import MAX_CAPTURE_BYTES, MAX_LINE, open_unpacked, read_beginning

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

Stamps = Literal["us", "ms", "none"]
"""Resolution of time stamps: microseconds or finer, whole milliseconds, or no stamps."""

_HEAD_BYTES: Final = 64 * 1024


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


# --- Recordings in parts. `cangauge run` numbers its runs, so that no recording is overwritten, and
# can split a run into parts. `drive-0003-000001.log`, `drive-0003-000002.log`, … are the parts of
# run 3 of `drive.log`; `drive-0003.log` names all of them as one capture.

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
    """Return the name for all parts of a run."""
    stem, suffix = _split(path)
    return path.with_name(f"{stem}-{run:04d}{suffix}")


def all_parts(path: Path) -> list[Part]:
    """Return the parts of all runs of the recording `path`, in order."""
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
    """Return the parts of a run, by its name (see `run_path`).

    Empty if a file has that name, or if it is not the name of a run.
    """
    stem, suffix = _split(path)
    match = re.fullmatch(f"(?P<stem>.*)-{_RUN}", stem)
    try:
        if match is None or path.exists():
            return []
    except OSError:  # a name that is too long
        return []
    base = path.with_name(match["stem"] + suffix)
    return [each.path for each in all_parts(base) if each.run == int(match["run"])]


def _split(path: Path) -> tuple[str, str]:
    """Return name and suffix, the latter with .gz's ("drive.log.gz": "drive", ".log.gz")."""
    suffix = path.suffix
    if suffix.lower() == ".gz":
        suffix = Path(path.name.removesuffix(suffix)).suffix + suffix
    return path.name.removesuffix(suffix) if suffix else path.name, suffix


# --- Content


def open_bytes(path: Path) -> io.BufferedReader:
    """Open a capture file, unpacking gzip, recognised by content; see `open_unpacked`."""
    return open_unpacked(path, MAX_CAPTURE_BYTES)


def read_head(path: Path) -> bytes:
    """Return the unpacked beginning of a file, as much of it as can be read."""
    with open_bytes(path) as file:
        return read_beginning(file, _HEAD_BYTES)


def head_lines(head: bytes) -> list[str]:
    """Return the whole lines of the beginning of a text, without line ends."""
    text = head.decode("latin-1").replace("\r\n", "\n").replace("\r", "\n")
    lines = text.split("\n")
    return lines[:-1] if len(lines) > 1 else lines  # the last one may be cut


class LineStream:
    """The lines of a text, with line feeds as line ends; a line beyond `MAX_LINE` in pieces.

    Parameters
    ----------
    file : file object
        Binary or text.

    Attributes
    ----------
    cut_off : bool
        Whether the file broke off (a truncated or damaged gzip).
    """

    def __init__(self, file: IO[Any]) -> None:
        self.cut_off = False
        self._text: IO[str]
        if isinstance(file, io.TextIOBase):
            self._text = cast("IO[str]", file)
            return
        salvage = _Salvage(cast("io.BufferedIOBase", file), self)
        self._text = io.TextIOWrapper(io.BufferedReader(salvage), "latin-1", newline=None)

    def __iter__(self) -> Iterator[str]:
        while line := self._text.readline(MAX_LINE):
            yield line

    def close(self) -> None:
        """Close the file."""
        self._text.close()


class _Salvage(io.RawIOBase):
    """A stream that ends, instead of raising, where the underlying file breaks off."""

    def __init__(self, raw: io.BufferedIOBase, owner: LineStream) -> None:
        self._raw = raw
        self._owner = owner

    def readable(self) -> bool:
        return True

    def close(self) -> None:
        self._raw.close()
        super().close()

    def readinto(self, buffer: WriteableBuffer, /) -> int:
        view = memoryview(buffer)
        try:
            # `read1`: the content before the break is delivered before the error.
            part = self._raw.read1(view.nbytes)
        except (EOFError, OSError, zlib.error):
            self._owner.cut_off = True
            return 0
        view[: len(part)] = part
        return len(part)

"""The formats that a recording can have: python-can's writers, so that stamps keep their µs.

Recording what was received, so that `estimate` on the recording gives the live numbers.

Only formats that keep whole microseconds: candump's text (.log) and python-can's CSV, either also
gzipped, Vector BLF and ASAM MF4. ASC and TRC shift or round stamps.

The loop only formats; a thread writes (see `record_file`). Lost when the service is killed: what
was received in the last `HAND_OVER_S`; of an .mf4 the whole part, which is written at its end. A
power cut may take what was received in the last `record_file.SYNC_EVERY_S` besides.
"""

from __future__ import annotations

import gzip
import io
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Final, Protocol, Self, cast

import can

from cangauge._io import FULL, check_writable
from cangauge._logging import emit
from cangauge.bus.captures.files import all_parts, part_path, run_path
from cangauge.bus.time_source import whole_us
from cangauge.errors import InputError
from cangauge.service.async_writer import DiskWriter, RecordFile
from cangauge.service.status import RecordState

# --- The formats that a recording can have: python-can's writers, so that stamps keep their µs

EXACT_FORMATS: Final = (".log", ".csv", ".blf", ".mf4")
PACKED: Final = ".gz"
_EARLIEST_S: Final = 631_152_000.0
"""1990: python-can writes no earlier start into a BLF header [s since 1970]."""
IN_PARTS_ONLY: Final = (".blf", ".mf4")
"""Formats whose stamps count from the file's start, so that a clock set back needs a new file."""


class FrameWriter(Protocol):
    """Puts frames into a `RecordFile`."""

    def write(self, message: can.Message) -> None:
        """Write one frame."""

    def flush(self) -> None:
        """Put all frames written so far into the file, as far as the format can."""

    def stop(self) -> None:
        """Complete the file."""


def record_format(path: Path) -> str:
    """Return the format of a recording by its name, such as ".log", ".log.gz", ".blf".

    Raises
    ------
    InputError
        If it is unknown, does not keep time to the microsecond, or another package is missing.
    """
    suffixes = [suffix.lower() for suffix in path.suffixes]
    packed = suffixes[-1:] == [PACKED]
    kind = "".join(suffixes[-2:-1] if packed else suffixes[-1:])
    if kind not in EXACT_FORMATS or (packed and kind in IN_PARTS_ONLY):
        raise InputError(
            "this format does not keep time stamps to the microsecond, or is not known",
            source=path,
            field="--record",
            value="".join(suffixes),
            cure="name a .log (candump), .csv, .blf or .mf4 file",
        )
    if kind == ".mf4":
        _need_asammdf(path)
    return kind + PACKED if packed else kind


def frame_writer(kind: str, file: RecordFile, start_s: float) -> FrameWriter:
    """Return a writer of a format.

    Parameters
    ----------
    kind : str
        As `record_format` returns it.
    file : RecordFile
    start_s : float
        Stamp of the first frame [s].
    """
    if kind == ".blf":
        return _Blf(file, start_s)
    if kind == ".mf4":
        return _Mf4(file)
    return _Text(kind, file)


class _Text:
    """candump or CSV, perhaps gzipped: whole lines, each readable as soon as it is there."""

    def __init__(self, kind: str, file: RecordFile) -> None:
        self._packed = (
            gzip.GzipFile(fileobj=file, mode="wb", compresslevel=6)
            if kind.endswith(PACKED)
            else None
        )
        below = cast("BinaryIO", self._packed or file)
        text = io.TextIOWrapper(below, "utf-8", newline="\n")
        self._text = text
        self._writer: can.CanutilsLogWriter | can.CSVWriter
        if kind.startswith(".log"):
            self._writer = can.CanutilsLogWriter(text)
            # It would raise stamps below the first one, and so hide a clock that was set back.
            self._writer.last_timestamp = 0.0
        else:
            self._writer = can.CSVWriter(text)
        self.write: Callable[[can.Message], None] = self._writer.on_message_received

    def flush(self) -> None:
        self._text.flush()

    def stop(self) -> None:
        self._writer.stop()


class _Blf(can.BLFWriter):
    """BLF whose header is right from the beginning and after every flush: a kill leaves it whole.

    python-can completes the header, which holds the start that all stamps count from, only when
    the file is closed.
    """

    def __init__(self, file: RecordFile, start_s: float) -> None:
        super().__init__(cast("BinaryIO", file))
        # As the writer itself takes it from the first frame; a start that its header cannot tell
        # (of a clock that was never set) counts from 1970.
        whole_s = int(start_s * 1000.0) / 1000.0
        self.start_timestamp = self.stop_timestamp = 0.0 if whole_s < _EARLIEST_S else whole_s
        self._update_header()

    def write(self, message: can.Message) -> None:
        self.on_message_received(message)

    def flush(self) -> None:
        self._flush()
        self._update_header()

    def _update_header(self) -> None:
        end = self.file.seek(0, io.SEEK_END)
        self.file.seek(0)
        self._write_header(end)
        self.file.seek(end)


class _Mf4:
    """ASAM MF4: python-can holds the whole part in memory until it is complete."""

    def __init__(self, file: RecordFile) -> None:
        self._file = file
        self._content = _KeptBytes()
        self._writer = can.MF4Writer(self._content)
        self.write: Callable[[can.Message], None] = self._writer.on_message_received

    def flush(self) -> None:
        """Do nothing: the format is written as a whole."""

    def stop(self) -> None:
        self._writer.stop()
        self._file.write(self._content.getvalue())


class _KeptBytes(io.BytesIO):
    def close(self) -> None:
        """Keep the content, which is taken after the writer has closed it."""


def _need_asammdf(path: Path) -> None:
    try:
        import asammdf  # noqa: F401, PLC0415 - heavy, and only asked whether it is there
    except ImportError as error:
        raise InputError(
            "writing MF4 needs the package asammdf, which is not installed",
            source=path,
            field="--record",
            cure="pip install 'cangauge[mf4]', or record .blf or .log",
        ) from error


# --- Recording what was received, so that `estimate` on the recording gives the live numbers

HAND_OVER_S: Final = 0.5
"""How often what was received is given to the disk [s]."""
HAND_OVER_BYTES: Final = 64 * 1024
MF4_PART_S: Final = 300.0
"""An .mf4 is safe only when it is complete: a new one after so long, if not told otherwise [s]."""
CLOSE_WITHIN_S: Final = 0.6
"""At the end the disk has so long to take the rest [s]."""

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class RecordLimits:
    """When a recording begins a new file, and how much of it is kept.

    Without any, it is one file, unless that is there already: a service that was killed and started
    again must not replace what the one before it recorded. Then, and with any limit, runs and parts
    are numbered.

    Parameters
    ----------
    part_bytes : int, optional
        A new file is begun after so many bytes.
    part_s : float, optional
        A new file is begun after so long [s].
    keep_bytes : int, optional
        When a new file is begun, the oldest are removed until the rest is no larger.

    Raises
    ------
    InputError
        If files are to be removed, but all goes into one.
    """

    part_bytes: int | None = None
    part_s: float | None = None
    keep_bytes: int | None = None

    def __post_init__(self) -> None:
        if self.keep_bytes is not None and self.part_bytes is None and self.part_s is None:
            raise InputError(
                "there is but one file, which is never removed",
                field="record_keep_mb",
                cure="give record_part_mb or record_part_s, too",
            )

    @property
    def any(self) -> bool:
        """Whether the recording is in parts."""
        return self.part_bytes is not None or self.part_s is not None


class Recorder:
    """Writes frames to a capture, stamps in whole microseconds; use it in a `with` block.

    A disk that is full or fails never raises here: frames that it does not take are counted.

    Parameters
    ----------
    path : path-like
        `.log` or `.csv`, or either with `.gz`; `.blf` and `.mf4`, which are always in parts.
    limits : RecordLimits, optional
        By default one file, if it is not there yet or empty.
    clock : callable
        Monotonic time [s].

    Attributes
    ----------
    path : Path
        What `estimate` and `replay` read: the file, or the name of this run.
    frames : int
        Frames taken so far.

    Raises
    ------
    InputError
        If the suffix is another one, or the folder is absent or not writable.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        limits: RecordLimits | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        path = Path(path)
        self._kind = record_format(path)
        self._limits = limits or RecordLimits()
        if self._kind == ".mf4" and not self._limits.any:
            self._limits = RecordLimits(part_s=MF4_PART_S)
        _check_writable(path)
        self._clock = clock
        self._base = path
        self._in_parts = self._limits.any or self._kind in IN_PARTS_ONLY or _holds_something(path)
        self._run = max((each.run for each in all_parts(path)), default=0) + 1
        self._part = 0
        self.path = run_path(path, self._run) if self._in_parts else path
        self.frames = 0
        self._new_frames = 0
        self._handed_s = clock()
        self._part_until_s = float("inf")
        self._start_s = 0.0
        self._file: RecordFile | None = None
        self._writer: FrameWriter | None = None
        self._current = path
        self._disk = DiskWriter()
        if self._kind not in IN_PARTS_ONLY:
            self._begin(0.0)  # so that a file that was asked for is there, even without a frame

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Complete the file; what the disk does not take in time is counted as lost."""
        self._end()
        if not self._disk.close(CLOSE_WITHIN_S):
            emit(
                _LOG,
                logging.ERROR,
                "record.incomplete",
                f"{self._current}: the end of the recording is missing",
                lost_frames=self._disk.lost_frames,
            )

    def write(self, message: can.Message) -> None:
        """Write a frame as received; its stamp becomes the one that is written."""
        message.timestamp = time_s = whole_us(message.timestamp) / 1e6
        if self._writer is None or self._is_over(time_s):
            self._end()
            self._begin(time_s)
        if self._writer is not None:
            self._writer.write(message)
        self.frames += 1
        self._new_frames += 1
        if self._file is not None and self._file.waiting >= HAND_OVER_BYTES:
            self._hand_over(self._clock())

    def tick(self, now_s: float) -> None:
        """Give what was written to the disk, if it is time to (monotonic clock [s])."""
        if self._new_frames and now_s - self._handed_s >= HAND_OVER_S:
            self._hand_over(now_s)

    @property
    def state(self) -> RecordState:
        """How the recording fares."""
        return RecordState(
            path=str(self._current),
            frames=self.frames,
            lost_frames=self._disk.lost_frames,
            written_bytes=self._disk.written_bytes,
            problem=self._disk.problem,
        )

    def _is_over(self, time_s: float) -> bool:
        if not self._in_parts or self._file is None:
            return False
        if self._kind in IN_PARTS_ONLY and time_s < self._start_s:
            return True
        part_bytes = self._limits.part_bytes
        if part_bytes is not None and self._file.tell() >= part_bytes:
            return True
        return self._clock() >= self._part_until_s

    def _begin(self, start_s: float) -> None:
        self._part += 1
        self._start_s = start_s
        if self._in_parts:
            self._current = part_path(self._base, self._run, self._part)
            self._disk.call(self._remove_oldest)
        self._disk.begin(self._current)
        self._file = RecordFile(self._disk)
        self._writer = frame_writer(self._kind, self._file, start_s)
        self._file.hand_over(0)
        if self._limits.part_s is not None:
            self._part_until_s = self._clock() + self._limits.part_s

    def _end(self) -> None:
        if self._writer is None or self._file is None:
            return
        self._writer.stop()
        self._file.hand_over(self._new_frames)
        self._new_frames = 0
        self._writer = self._file = None

    def _hand_over(self, now_s: float) -> None:
        self._handed_s = now_s
        if self._writer is None or self._file is None:
            return
        self._writer.flush()
        if self._file.waiting:
            self._file.hand_over(self._new_frames)
            self._new_frames = 0

    def _remove_oldest(self) -> None:
        """Make room; in the disk's thread, before a new part is begun."""
        keep_bytes = self._limits.keep_bytes
        if keep_bytes is None:
            return
        parts = [(each.path, each.path.stat().st_size) for each in all_parts(self._base)]
        total = sum(size for _, size in parts)
        for path, size in parts:
            if total <= keep_bytes:
                return
            path.unlink(missing_ok=True)
            total -= size
            emit(_LOG, logging.INFO, "record.removed", f"{path}: removed to make room")


def _holds_something(path: Path) -> bool:
    return path.is_file() and path.stat().st_size > 0


def _check_writable(path: Path) -> None:
    """Refuse what no disk space would cure; a full disk is tried again while the service runs."""
    try:
        check_writable(path)
    except InputError as error:
        cause = error.__cause__
        if not (isinstance(cause, OSError) and cause.errno in FULL):
            raise

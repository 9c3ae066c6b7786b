"""Record the received frames, so that `estimate` on the recording reproduces the live numbers.

Formats are those that keep whole microseconds: candump text (.log) and python-can's CSV, either
also gzipped, Vector BLF, ASAM MF4 and MCAP, which holds samples and estimates too. ASC and TRC
shift or round time stamps.

The receive loop only formats frames into memory; a thread writes. A killed service loses the
frames of the last `HAND_OVER_S`, the last `MCAP_CHUNK_BYTES` of an .mcap, or the whole part of an
.mf4, which is written at its end. A power cut can also lose the data written in the last
`SYNC_EVERY_S`.
"""

from __future__ import annotations

import errno
import gzip
import io
import logging
import os
import stat
import time
from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, BinaryIO, Final, Protocol, Self, cast

import can

from cangauge._io import FOR_GROUP, FULL, check_writable, refuse_foreign
from cangauge._logging import emit
from cangauge.bus.captures import all_parts, part_path, run_path
from cangauge.bus.time_source import whole_us
from cangauge.errors import InputError
from cangauge.extras.formats.mcap import frame_content, frame_topic
from cangauge.extras.formats.mcap_messages import FRAME, McapTopics
from cangauge.service.async_writer import AsyncWriter
from cangauge.service.estimate_mcap import write_estimate
from cangauge.types import Estimate, Sample

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

HAND_OVER_S: Final = 0.5
"""Interval at which received frames are handed to the writing thread [s] …"""
HAND_OVER_BYTES: Final = 64 * 1024
"""… or as soon as this much is formatted [bytes]."""
WAITING_BYTES: Final = 8 << 20
"""Memory for frames that wait for the disk [bytes]: over a minute at 2,000 frames/s. Beyond it the
newest are dropped and counted, so that the file stays readable and continues after a full disk."""
RETRY_S: Final = 1.0
SYNC_EVERY_S: Final = 30.0
"""Interval of fsync, against power cuts [s]."""
CLOSE_WITHIN_S: Final = 0.6
"""Time limit for writing the rest at the end [s]."""
MF4_PART_S: Final = 300.0
"""Default duration of an .mf4 part [s]: the format is safe on disk only when it is complete."""

MCAP_CHUNK_BYTES: Final = 64 * 1024
"""Content of a chunk before compression [bytes]: 350 frames, or 0.2 s of a busy bus."""

_NOT_SYNCED: Final = frozenset({errno.EINVAL, errno.ENOTSUP, errno.EROFS})
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RecordState:
    """Progress of a recording.

    Parameters
    ----------
    path : str
        The current file.
    frames, lost_frames, written_bytes : int
        Frames recorded; frames that could not be written; bytes written.
    problem : str or None
        Why the disk rejects data at present, or why the recording could not begin.
    is_active : bool
        False once it has ended.
    """

    path: str
    frames: int
    lost_frames: int
    written_bytes: int
    problem: str | None
    is_active: bool = True


@dataclass(frozen=True)
class RecordLimits:
    """Limits of a recording: size and duration of its parts, and its total size.

    Without limits it is one file. If that exists already (a restarted service must not overwrite
    its predecessor's recording), or with any limit, runs and parts are numbered.

    Parameters
    ----------
    part_bytes : int, optional
        Size at which a new part begins [bytes].
    part_s : float, optional
        Duration after which a new part begins [s].
    keep_bytes : int, optional
        Total size above which the oldest parts are removed when a new one begins [bytes].

    Raises
    ------
    InputError
        If `keep_bytes` is given without parts.
    """

    part_bytes: int | None = None
    part_s: float | None = None
    keep_bytes: int | None = None

    def __post_init__(self) -> None:
        if self.keep_bytes is not None and self.part_bytes is None and self.part_s is None:
            raise InputError(
                "the recording is one file, which is never removed",
                field="record_keep_mb",
                cure="give record_part_mb or record_part_s as well",
            )

    @property
    def in_parts(self) -> bool:
        """Whether the recording is in parts."""
        return self.part_bytes is not None or self.part_s is not None


class Recorder:
    """Write frames to a capture with stamps in whole microseconds; use it in a `with` block.

    A full or failing disk never raises: frames that cannot be written are counted.

    Parameters
    ----------
    path : path-like
        `.log` or `.csv`, or either with `.gz`; `.mcap`; `.blf` and `.mf4`, which are always in
        parts.
    limits : RecordLimits, optional
        By default one file, unless it exists and is not empty.
    clock : callable
        Monotonic time [s].

    Attributes
    ----------
    path : Path
        Name for `estimate` and `replay`: the file, or this run.
    frames : int
        Frames recorded so far.

    Raises
    ------
    InputError
        If the suffix is unknown, or the folder is missing or not writable.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        limits: RecordLimits | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        path = Path(path)
        self._kind = _record_format(path)
        self._limits = limits or RecordLimits()
        if self._kind == ".mf4" and not self._limits.in_parts:
            self._limits = RecordLimits(part_s=MF4_PART_S)
        _check_writable(path)
        self._clock = clock
        self._base = path
        self._in_parts = self._limits.in_parts or self._kind in IN_PARTS_ONLY or _is_not_empty(path)
        self._run = max((each.run for each in all_parts(path)), default=0) + 1
        self._part = 0
        self.path = run_path(path, self._run) if self._in_parts else path
        self.frames = 0
        self._new_frames = 0
        self._handed_s = self._synced_s = clock()
        self._part_until_s = float("inf")
        self._start_s = 0.0
        self._file: RecordBuffer | None = None
        self._writer: _FrameWriter | None = None
        self._current = path
        self._disk = _Disk()
        if self._kind not in IN_PARTS_ONLY:
            self._begin(0.0)  # the file exists even without a frame

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
        """Complete the file; frames that are not written in time are counted as lost."""
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
        """Record a received frame; round its stamp to the one that is written."""
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

    @property
    def keeps_estimates(self) -> bool:
        """Whether the format has a place for samples and estimates."""
        return self._kind == ".mcap"

    def write_estimate(self, sample: Sample, soc_pct: float, estimate: Estimate) -> None:
        """Record a sample and the estimate after it, at the stamp of the latest frame.

        Parameters
        ----------
        sample : Sample
        soc_pct : float
            The vehicle's own SoC [%]; NaN if unknown.
        estimate : Estimate
        """
        if isinstance(self._writer, _Mcap):
            self._writer.write_estimate(sample, soc_pct, estimate)

    def tick(self, now_s: float) -> None:
        """Hand frames to the writing thread, and sync the file, when due (monotonic time [s])."""
        if self._new_frames and now_s - self._handed_s >= HAND_OVER_S:
            self._hand_over(now_s)
        if now_s - self._synced_s >= SYNC_EVERY_S:
            self._synced_s = now_s
            self._disk.sync()

    @property
    def state(self) -> RecordState:
        """Progress of the recording."""
        return RecordState(
            path=str(self._current),
            frames=self.frames,
            lost_frames=self._disk.lost_frames,
            written_bytes=self._disk.written_bytes,
            problem=self._disk.writer.problem,
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
            self._disk.writer.submit(self._remove_oldest)
        self._disk.begin(self._current)
        self._file = RecordBuffer(self._disk.append)
        self._writer = _frame_writer(self._kind, self._file, start_s)
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
        """Remove the oldest parts; runs in the writing thread before a new part begins."""
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
            emit(_LOG, logging.INFO, "record.removed", f"removed the oldest part: {path}")


def _is_not_empty(path: Path) -> bool:
    return path.is_file() and path.stat().st_size > 0


def _check_writable(path: Path) -> None:
    """Reject a path that cannot be written; a full disk is retried while the service runs."""
    try:
        check_writable(path)
    except InputError as error:
        cause = error.__cause__
        if not (isinstance(cause, OSError) and cause.errno in FULL):
            raise


class _Disk:
    """The file on disk, written by a thread, one part after the other."""

    def __init__(self) -> None:
        self.writer = AsyncWriter(
            "cangauge-record",
            retry_s=RETRY_S,
            max_waiting_bytes=WAITING_BYTES,
            on_error=self._failed,
            on_recovery=self._resumed,
        )
        self._file: io.FileIO | None = None
        self._end = self._at = 0
        self.written_bytes = 0
        self.lost_frames = 0

    def begin(self, path: Path) -> None:
        """Begin a new file; only an empty one is replaced."""

        def begin() -> None:
            self._close_file()
            refuse_foreign(path)  # the names of parts are known before they begin
            self._file = io.FileIO(_created(path), "w")
            self._end = self._at = 0

        self.writer.submit(begin)

    def append(self, data: bytes, frames: int, place: int | None = None) -> None:
        """Write data at the end, or at a place; count its frames as lost if too much waits."""
        piece = _Piece(self, data, frames, place)
        # The header of a file is never dropped: nothing after it could be read.
        is_header = not frames and place is None
        if not self.writer.submit(piece, 0 if is_header else len(data)):
            self.lost_frames += frames

    def sync(self) -> None:
        """Flush written data to the disk."""
        self.writer.submit(lambda: _fsync(self._file))

    def close(self, within_s: float) -> bool:
        """Write the rest; return whether all was written in time [s]."""
        is_done = self.writer.flush(within_s)
        # Written data survive the end of the process; fsync, against power cuts, may hang.
        self.writer.submit(self._close_file)
        left = self.writer.close(0.0)
        self.lost_frames += sum(job.frames for job in left if isinstance(job, _Piece))
        return is_done

    def write(self, piece: _Piece) -> None:
        """Write a piece, in the thread; written bytes are removed from it, for a retry."""
        while piece.data and self._file is not None:
            place = self._end if piece.place is None else piece.place
            if place != self._at:  # not for a pipe, which cannot seek
                self._at = self._file.seek(place)
            done = self._file.write(piece.data) or 0
            self._at += done
            self.written_bytes += done
            piece.data = piece.data[done:]
            if piece.place is None:
                self._end += done
            else:
                piece.place += done

    def _close_file(self) -> None:
        if self._file is not None:
            file, self._file = self._file, None
            with file:
                _fsync(file)

    def _failed(self, error: Exception) -> None:
        emit(
            _LOG,
            logging.ERROR,
            "record.failed",
            f"recording: {getattr(error, 'strerror', None) or error}; the estimate continues,"
            " writing is retried",
            limit="record.state",
            lost_frames=self.lost_frames,
        )

    def _resumed(self) -> None:
        emit(
            _LOG,
            logging.WARNING,
            "record.resumed",
            f"recording resumed; {self.lost_frames} frames were lost",
            limit="record.state",
            lost_frames=self.lost_frames,
        )


def _created(path: Path) -> int:
    """Return the descriptor of a new or empty file or a device; never of another recording."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC
    file = os.open(path, flags, FOR_GROUP)
    found = os.fstat(file)
    if stat.S_ISFIFO(found.st_mode) or found.st_size:
        os.close(file)
        raise FileExistsError(errno.EEXIST, "exists already, and is not replaced", str(path))
    return file


@dataclass(slots=True)
class _Piece:
    """A job of the writing thread: bytes and the number of frames in them."""

    disk: _Disk
    data: bytes
    frames: int
    place: int | None

    def __call__(self) -> None:
        self.disk.write(self)


def _fsync(file: io.FileIO | None) -> None:
    if file is None:
        return
    try:
        os.fsync(file.fileno())
    except OSError as error:
        # Pipes and devices cannot be synced.
        if error.errno not in _NOT_SYNCED:
            raise


class RecordBuffer(io.RawIOBase):
    """File object for python-can's writers: keeps bytes in memory until they are handed over.

    Parameters
    ----------
    write : callable
        Takes bytes, the number of frames in them, and a place in the file or None for its end.
    """

    def __init__(self, write: Callable[[bytes, int, int | None], None]) -> None:
        self._write = write
        self._handed = 0
        self._new = bytearray()
        self._changes: list[tuple[int, bytes]] = []
        self._position = 0

    def writable(self) -> bool:
        """Return True."""
        return True

    def readable(self) -> bool:
        """Return False."""
        return False

    def seekable(self) -> bool:
        """Return True: the header of a BLF file is updated in place."""
        return True

    def write(self, data: ReadableBuffer, /) -> int:
        """Keep bytes until they are handed over."""
        content = bytes(data)
        if self._position < self._handed:
            self._changes.append((self._position, content))
        else:
            begin = self._position - self._handed
            self._new[begin : begin + len(content)] = content
        self._position += len(content)
        return len(content)

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        """Set the position; return it."""
        end = self._handed + len(self._new)
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: end}[whence]
        self._position = start + offset
        return self._position

    def tell(self) -> int:
        """Return the position."""
        return self._position

    @property
    def waiting(self) -> int:
        """Number of bytes not handed over yet."""
        return len(self._new)

    def hand_over(self, frames: int) -> None:
        """Write all new bytes, which hold this number of frames."""
        if self._new:
            self._write(bytes(self._new), frames, None)
            self._handed += len(self._new)
            self._new.clear()
        for place, content in self._changes:
            self._write(content, 0, place)
        self._changes.clear()


# --- Formats

EXACT_FORMATS: Final = (".log", ".csv", ".blf", ".mf4", ".mcap")
_PACKABLE: Final = (".log", ".csv")
PACKED: Final = ".gz"
_EARLIEST_S: Final = 631_152_000.0
"""1990: earliest start that python-can writes into a BLF header [s since 1970]."""
IN_PARTS_ONLY: Final = (".blf", ".mf4")
"""Formats with stamps relative to the file's start: a clock that is set back needs a new part."""


class _FrameWriter(Protocol):
    """Format frames into a `RecordBuffer`."""

    def write(self, message: can.Message) -> None:
        """Write one frame."""

    def flush(self) -> None:
        """Put the frames written so far into the file, if the format allows it."""

    def stop(self) -> None:
        """Complete the file."""


def _record_format(path: Path) -> str:
    """Return the format of a recording by its name, such as ".log", ".log.gz", ".blf".

    Raises
    ------
    InputError
        If it is unknown or inexact, or needs a package that is not installed.
    """
    suffixes = [suffix.lower() for suffix in path.suffixes]
    packed = suffixes[-1:] == [PACKED]
    kind = "".join(suffixes[-2:-1] if packed else suffixes[-1:])
    if kind not in EXACT_FORMATS or (packed and kind not in _PACKABLE):
        raise InputError(
            "this format is unknown, or does not keep time stamps to the microsecond",
            source=path,
            field="--record",
            value="".join(suffixes),
            cure="name a .log (candump), .csv, .blf, .mf4 or .mcap file",
        )
    if kind == ".mf4":
        _need_asammdf(path)
    if kind == ".mcap":
        McapTopics(io.BytesIO(), path)  # raises if the package is not installed
    return kind + PACKED if packed else kind


def _frame_writer(kind: str, file: RecordBuffer, start_s: float) -> _FrameWriter:
    """Return a writer of a format.

    Parameters
    ----------
    kind : str
        As `_record_format` returns it.
    file : RecordBuffer
    start_s : float
        Stamp of the first frame [s].
    """
    if kind == ".blf":
        return _Blf(file, start_s)
    if kind == ".mf4":
        return _Mf4(file)
    if kind == ".mcap":
        return _Mcap(file)
    return _Text(kind, file)


class _Text:
    """candump or CSV, optionally gzipped."""

    def __init__(self, kind: str, file: RecordBuffer) -> None:
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
            # Otherwise it raises stamps below the first one, and hides a clock that was set back.
            self._writer.last_timestamp = 0.0
        else:
            self._writer = can.CSVWriter(text)
        self.write: Callable[[can.Message], None] = self._writer.on_message_received

    def flush(self) -> None:
        self._text.flush()

    def stop(self) -> None:
        self._writer.stop()


class _Blf(can.BLFWriter):
    """BLF whose header is valid from the first frame on, so that a kill leaves a readable file.

    python-can writes the start time, which all stamps are relative to, only when it closes.
    """

    def __init__(self, file: RecordBuffer, start_s: float) -> None:
        super().__init__(cast("BinaryIO", file))
        # As the writer derives it from the first frame. A start that the header cannot express
        # (a clock that was never set) counts from 1970.
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


class _Mcap:
    """MCAP with frames, samples and estimates."""

    def __init__(self, file: RecordBuffer) -> None:
        self._topics = McapTopics(file, None, MCAP_CHUNK_BYTES)
        self._latest_s = 0.0

    def write(self, message: can.Message) -> None:
        self._latest_s = message.timestamp
        self._topics.write(frame_topic(message), FRAME, message.timestamp, frame_content(message))

    def write_estimate(self, sample: Sample, soc_pct: float, estimate: Estimate) -> None:
        write_estimate(self._topics, self._latest_s, sample, soc_pct, estimate)

    def flush(self) -> None:
        """Do nothing: a chunk is written when it is full."""

    def stop(self) -> None:
        self._topics.finish()


class _Mf4:
    """ASAM MF4: python-can keeps a whole part in memory until it is complete."""

    def __init__(self, file: RecordBuffer) -> None:
        self._file = file
        self._content = _KeptBytes()
        self._writer = can.MF4Writer(self._content)
        self.write: Callable[[can.Message], None] = self._writer.on_message_received

    def flush(self) -> None:
        """Do nothing: the format is written at its end."""

    def stop(self) -> None:
        self._writer.stop()
        self._file.write(self._content.getvalue())


class _KeptBytes(io.BytesIO):
    def close(self) -> None:
        """Keep the content, which is read after the writer has closed it."""


def _need_asammdf(path: Path) -> None:
    try:
        import asammdf  # noqa: F401, PLC0415 - heavy; only checked for presence
    except ImportError as error:
        raise InputError(
            "writing MF4 needs the package asammdf, which is not installed",
            source=path,
            field="--record",
            cure="pip install 'cangauge[mf4]', or record .blf or .log",
        ) from error

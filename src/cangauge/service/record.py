"""Recording what was received, so that `estimate` on the recording gives the live numbers.

Only formats that keep whole microseconds: candump's text (.log) and python-can's CSV, either also
gzipped, Vector BLF and ASAM MF4. ASC and TRC shift or round stamps.

The loop only formats; a thread writes (see `record_file`). Lost when the service is killed: what
was received in the last `HAND_OVER_S`; of an .mf4 the whole part, which is written at its end. A
power cut may take what was received in the last `record_file.SYNC_EVERY_S` besides.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import can

from cangauge.atomic import FULL, check_writable
from cangauge.bus.captures.parts import all_parts, part_path, run_path
from cangauge.bus.time_source import whole_us
from cangauge.errors import InputError
from cangauge.events import emit
from cangauge.service.record_file import DiskWriter, RecordFile
from cangauge.service.record_formats import (
    IN_PARTS_ONLY,
    FrameWriter,
    frame_writer,
    record_format,
)
from cangauge.service.snapshot import RecordState

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

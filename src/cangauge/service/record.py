"""Record the received frames, so that `estimate` on the recording reproduces the live numbers.

The format is candump's text (.log), which keeps whole microseconds, also gzipped, by python-can's
writer. The receive loop only collects frames; a thread formats and writes them in batches, so a
kill loses at most the frames since the last snapshot (0.25 s), and a power cut those of the last
`SYNC_EVERY_S`. A batch that the disk refuses is cut off the file and counted: the file stays whole
lines, and continues once there is space. (python-can's `SizedRotatingLogger` writes through a
buffer, which leaves half a line on a full disk.)
"""

from __future__ import annotations

import copy
import gzip
import io
import logging
import os
import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Final

import can

from cangauge._files import FULL, check_writable, is_device, written_name
from cangauge._logging import emit
from cangauge.bus.captures import all_parts, part_path, run_path
from cangauge.bus.time_source import whole_us
from cangauge.errors import InputError
from cangauge.service.output import Output
from cangauge.service.status_client import Snapshot
from cangauge.service.worker import CLOSE_WITHIN_S, Worker

BATCH_FRAMES: Final = 256
"""Frames formatted at once: the thread holds the interpreter for 1 ms."""
BATCHES_WAITING: Final = 600
"""Batches that wait for a slow disk: over a minute at 2,000 frames/s, 30 MB."""
SYNC_EVERY_S: Final = 30.0
"""Interval of fsync, against power cuts [s]."""
_LOG = logging.getLogger(__name__)
_emit_state = partial(emit, limit="record.state")


class Recorder(Output):
    """The recording of a service: one file, or parts.

    If the file exists already (a restarted service must not overwrite its predecessor's recording),
    or with `part_mb`, runs and parts are numbered. No method waits for the disk but the
    constructor, and `close` for a limited time.

    Parameters
    ----------
    path : path-like
    part_mb : float, optional
        Size at which a new part begins [MB].
    keep_mb : float, optional
        Total size above which the oldest parts are removed when a new one begins [MB].

    Attributes
    ----------
    written : Path
        The recording, for `estimate`.

    See Also
    --------
    check_recording : Checks the arguments; a service calls it before anything is opened.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        part_mb: float | None = None,
        keep_mb: float | None = None,
    ) -> None:
        self._batch: list[can.Message] = []
        self._frames = self._refused_frames = self._unwritten_frames = 0
        self._problem: str | None = None
        base = Path(path)
        base = written_name(base) if base.is_symlink() else base
        self._base = base
        self._part_mb = part_mb
        self._keep_mb = keep_mb
        self._in_parts = part_mb is not None or os.path.lexists(base)
        self._run = max((run for run, _, _ in all_parts(base)), default=0) + 1
        self.written = run_path(base, self._run) if self._in_parts else base
        self._part = self._bytes = self._written_bytes = 0
        self._synced_s = time.monotonic()
        self._descriptor = -1
        with suppress(OSError):  # tried again with each batch
            self._next_part()
        self._worker = Worker("cangauge-record", _failed, BATCHES_WAITING)

    @property
    def state(self) -> dict[str, Any]:
        """Current file; frames so far, and those lost; `problem`: why the disk rejects data now."""
        return {
            "path": str(self._current),
            "frames": self._frames,
            "lost_frames": self._refused_frames + self._unwritten_frames,
            "written_bytes": self._written_bytes,
            "problem": self._problem,
        }

    def on_frame(self, message: can.Message) -> None:
        """Record a frame, and round its stamp to the one that is written."""
        message.timestamp = whole_us(message.timestamp) / 1e6
        self._batch.append(copy.copy(message))
        if len(self._batch) >= BATCH_FRAMES:
            self._hand_over()

    def on_snapshot(self, _snapshot: Snapshot) -> None:
        """Hand the new frames to the thread."""
        self._hand_over()

    def close(self) -> None:
        """Complete the file; frames that are not written in time are lost."""
        self._hand_over()
        self._worker.submit(self._close_file)
        if not self._worker.close(CLOSE_WITHIN_S):
            emit(
                _LOG.error,
                "record.incomplete",
                f"{self._current}: the end of the recording is missing",
            )

    def _hand_over(self) -> None:
        batch = self._batch
        self._batch = []
        if batch and not self._worker.submit(partial(self._write, batch)):
            self._refused_frames += len(batch)

    # --- In the thread

    def _write(self, batch: list[can.Message]) -> None:
        before = self._problem
        problem = None
        try:
            self._append(batch)
        except OSError as error:
            problem = error.strerror or str(error)
            self._unwritten_frames += len(batch)
        self._problem = problem
        self._frames += len(batch)
        lost = self.state["lost_frames"]
        if problem is not None:
            _emit_state(
                _LOG.error,
                "record.failed",
                f"recording: {problem}; the estimate continues, writing is retried",
                lost_frames=lost,
            )
        elif before is not None:
            _emit_state(
                _LOG.warning,
                "record.resumed",
                f"recording resumed; {lost} frames were lost",
                lost_frames=lost,
            )

    def _append(self, batch: list[can.Message]) -> None:
        """Append frames as whole lines, or nothing of them; may raise OSError."""
        is_full = self._part_mb is not None and self._bytes >= 1e6 * self._part_mb
        if self._descriptor < 0 or is_full:
            self._next_part()
        if time.monotonic() - self._synced_s >= SYNC_EVERY_S:
            self._synced_s = time.monotonic()
            os.fsync(self._descriptor)
        for message in batch:
            self._writer.on_message_received(message)
        data = self._text.getvalue().encode()
        self._text.seek(0)
        self._text.truncate()
        if self._base.suffix.lower() == ".gz":
            data = gzip.compress(data, 6)  # members of one file: gzip reads them as one
        left = memoryview(data)
        try:
            while left:
                left = left[os.write(self._descriptor, left) :]
        except OSError:
            with suppress(OSError):
                os.ftruncate(self._descriptor, self._bytes)
                os.lseek(self._descriptor, self._bytes, os.SEEK_SET)
            raise
        self._bytes += len(data)
        self._written_bytes += len(data)

    def _close_file(self) -> None:
        if self._descriptor >= 0:
            descriptor = self._descriptor
            self._descriptor = -1
            os.close(descriptor)

    def _next_part(self) -> None:
        part = self._part + 1
        self._current = part_path(self._base, self._run, part) if self._in_parts else self._base
        self._remove_oldest()
        self._close_file()
        # Made anew: another user may have made a file or a link of this name.
        flags = os.O_WRONLY | os.O_CLOEXEC | os.O_CREAT | os.O_EXCL
        # The group may read where and how the car was driven, others not.
        self._descriptor = os.open(self._current, flags, 0o640)
        self._part = part
        self._bytes = 0
        self._text = io.StringIO(newline="")
        self._writer = can.CanutilsLogWriter(self._text)
        # Otherwise it raises stamps below the first one, and hides a clock that was set back.
        self._writer.last_timestamp = 0.0

    def _remove_oldest(self) -> None:
        if self._keep_mb is None:
            return
        sizes = {path: path.stat().st_size for _, _, path in all_parts(self._base)}
        total = sum(sizes.values())
        for path, size in sizes.items():
            if total <= 1e6 * self._keep_mb:
                return
            path.unlink(missing_ok=True)
            total -= size
            emit(_LOG.info, "record.removed", f"removed the oldest part: {path}")


def _failed(error: Exception) -> None:
    _emit_state(_LOG.error, "record.failed", f"recording: {error}")


def check_recording(path: Path, part_mb: float | None, keep_mb: float | None) -> None:
    """Raise InputError for a recording that cannot be written, or not be limited."""
    if not path.name.lower().removesuffix(".gz").endswith(".log"):
        raise InputError(
            "a recording is a candump log",
            source=path,
            field="--record",
            cure="name a .log or .log.gz file; `python -m can.logconvert` turns it into others",
        )
    if is_device(path):  # otherwise the next run of this name: a file in /dev, in memory
        raise InputError(
            "a recording is a file, and this is a device or a pipe",
            source=path,
            field="--record",
            cure="name a file",
        )
    if keep_mb is not None and part_mb is None:
        raise InputError(
            "the recording is one file, which is never removed",
            field="record_keep_mb",
            cure="give record_part_mb as well",
        )
    try:
        check_writable(path)
    except InputError as error:
        cause = error.__cause__  # a full disk is retried while the service runs
        if not (isinstance(cause, OSError) and cause.errno in FULL):
            raise

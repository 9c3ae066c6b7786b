"""Begin and end the recording of a service while it runs, as the live page asks for."""

from __future__ import annotations

import logging
import shutil
import time
from collections import deque
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import can

from cangauge._logging import emit
from cangauge.errors import InputError
from cangauge.service.async_writer import AsyncWriter
from cangauge.service.recording import CLOSE_WITHIN_S, Recorder, RecordLimits, RecordState
from cangauge.types import Estimate, Sample

REQUESTED_BYTES: Final = 4 << 30
"""Largest recording begun by a request [bytes]: half a day of a busy bus (2,000 frames/s of candump
text), and what one file of FAT32 can hold."""
FREE_BYTES: Final = 1 << 30
"""Space on the disk that such a recording leaves free [bytes]: for state, table and logs there."""
CHECK_S: Final = 10.0
"""Interval of looks at both [s]: a busy bus writes 1 MB meanwhile."""

_LOG = logging.getLogger(__name__)


class RecordControl:
    """The recording of a service; use it in a `with` block.

    `request` is for any thread, everything else for the loop's. A thread opens and completes the
    files, so that a slow disk does not hold the loop.

    Parameters
    ----------
    path : Path, optional
        Recorded to from the start, and again after each request. Without it a request begins a
        candump file in the working folder, named by its UTC time.
    limits : RecordLimits
        Without `keep_bytes` a recording begun by a request ends at `REQUESTED_BYTES`, or when less
        than `FREE_BYTES` are free.

    Attributes
    ----------
    keeps_estimates : bool
        Whether the format of `path` has a place for samples and estimates.

    Raises
    ------
    InputError
        If `path` cannot be recorded to.
    """

    def __init__(self, path: Path | None, limits: RecordLimits) -> None:
        self._path = path
        self._limits = limits
        self._recorder = None if path is None else Recorder(path, limits)
        self._before: list[tuple[Path, int]] = []  # recordings that ended, with their frames
        self.keeps_estimates = self._recorder is not None and self._recorder.keeps_estimates
        self._requested: bool | None = None
        self._is_changing = False
        self._files = AsyncWriter("cangauge-record-files")
        self._done: deque[Recorder | RecordState] = deque()
        self._ended: RecordState | None = None
        self._full: str | None = None
        self._check_due_s = float("inf")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._files.close(CLOSE_WITHIN_S)
        self._take_change()
        if self._recorder is not None:
            self._recorder.close()

    def request(self, *, active: bool) -> None:
        """Ask for a recording, or for its end; it follows with the next `tick`."""
        self._requested = active

    def write(self, message: can.Message) -> None:
        """Record a received frame, and round its stamp; does nothing without a recording."""
        if self._recorder is not None:
            self._recorder.write(message)

    def write_estimate(self, sample: Sample, soc_pct: float, estimate: Estimate) -> None:
        """Record a sample, the vehicle's own SoC [%] and the estimate, if a recording runs."""
        if self._recorder is not None:
            self._recorder.write_estimate(sample, soc_pct, estimate)

    def tick(self, now_s: float) -> None:
        """Do what is due at a monotonic time [s]."""
        self._take_change()
        recorder = self._recorder
        requested = None if self._is_changing else self._requested
        if requested is not None:
            self._requested = None
        if recorder is None:
            if requested:
                self._is_changing = True
                self._files.submit(self._begin)
        elif requested is False or self._full:
            self._is_changing = True
            self._recorder = None
            self._before.append((recorder.path, recorder.frames))
            state, self._check_due_s = recorder.state, float("inf")
            self._ended = replace(state, is_active=False, problem=self._full or state.problem)
            self._files.submit(partial(self._end, recorder, self._full))
        else:
            recorder.tick(now_s)
            if now_s >= self._check_due_s:
                self._check_due_s = float("inf")  # until the thread has looked
                self._files.submit(partial(self._check, recorder))

    @property
    def state(self) -> RecordState | None:
        """Progress of the recording, or the result of the latest one; None before the first."""
        return self._ended if self._recorder is None else self._recorder.state

    @property
    def written(self) -> tuple[Path, ...]:
        """Paths of all recordings, for `estimate`, in order."""
        now = self._recorder
        runs = [*self._before, *([(now.path, now.frames)] if now else ())]
        # BLF and MF4 files begin with the first frame: without one there is no file.
        return tuple(path for path, frames in runs if frames or path.exists())

    def _take_change(self) -> None:
        """Take over what the thread has opened or completed."""
        if not self._done:
            return
        self._is_changing = False
        done = self._done.popleft()
        if isinstance(done, Recorder):
            self._recorder, self._full = done, None
            if self._limits.keep_bytes is None:
                self._check_due_s = 0.0
        else:
            self._ended = done

    def _begin(self) -> None:
        path = self._path or Path.cwd() / f"cangauge-{datetime.now(UTC):%Y%m%dT%H%M%SZ}.log"
        try:
            if self._limits.keep_bytes is None and (problem := _full(path, 0)):
                raise InputError(problem)  # noqa: TRY301 - reported as any other
            recorder = Recorder(path, self._limits)
        except Exception as error:  # noqa: BLE001 - or no later request would be answered
            emit(_LOG, logging.WARNING, "record.refused", f"no recording: {error}")
            self._done.append(RecordState(str(path), 0, 0, 0, str(error), is_active=False))
            return
        emit(_LOG, logging.INFO, "record.began", f"recording to {recorder.path}")
        self._done.append(recorder)

    def _check(self, recorder: Recorder) -> None:
        problem = _full(recorder.path, recorder.state.written_bytes)
        if recorder is self._recorder:
            self._full = problem
            self._check_due_s = time.monotonic() + CHECK_S

    def _end(self, recorder: Recorder, problem: str | None) -> None:
        if problem is not None:
            emit(_LOG, logging.WARNING, "record.full", f"{recorder.path}: {problem}")
        try:
            recorder.close()
            emit(_LOG, logging.INFO, "record.ended", f"recorded: {recorder.path}")
        except Exception as error:  # noqa: BLE001 - as above
            problem = str(error)
            emit(_LOG, logging.WARNING, "record.incomplete", f"{recorder.path}: {error}")
        state = recorder.state
        self._done.append(replace(state, is_active=False, problem=problem or state.problem))


def _full(path: Path, written_bytes: int) -> str | None:
    """Return the reason to end a recording that a viewer began: size or free space; else None."""
    if written_bytes >= REQUESTED_BYTES:
        return f"ended at {REQUESTED_BYTES / 1e9:.1f} GB; record_keep_mb sets another limit"
    try:
        free_bytes = shutil.disk_usage(path.parent).free
    except OSError:  # reported by the recording itself
        return None
    if free_bytes < FREE_BYTES:
        return f"less than {FREE_BYTES / 1e9:.1f} GB free on its disk; free some space"
    return None

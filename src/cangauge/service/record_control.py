"""Begin and end the recording of a service while it runs, as the live page asks for."""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self

import can

from cangauge._logging import emit
from cangauge.estimation.validity import Estimate, Sample
from cangauge.service.async_writer import AsyncWriter
from cangauge.service.recording import CLOSE_WITHIN_S, Recorder, RecordLimits, RecordState

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
        self._latest = self._recorder
        self.keeps_estimates = self._recorder is not None and self._recorder.keeps_estimates
        self._requested: bool | None = None
        self._is_changing = False
        self._files = AsyncWriter("cangauge-record-files")
        self._done: deque[Recorder | RecordState] = deque()
        self._ended: RecordState | None = None

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
        if requested is (recorder is None):
            self._is_changing = True
            if recorder is None:
                self._files.submit(self._begin)
            else:
                self._recorder = None
                self._ended = replace(recorder.state, is_active=False)
                self._files.submit(partial(self._end, recorder))
        elif recorder is not None:
            recorder.tick(now_s)

    @property
    def state(self) -> RecordState | None:
        """Progress of the recording, or the result of the latest one; None before the first."""
        return self._ended if self._recorder is None else self._recorder.state

    @property
    def written(self) -> Path | None:
        """Path of the latest recording, for `estimate`; None if there is none."""
        latest = self._latest
        # BLF and MF4 files begin with the first frame: without one there is no file.
        return latest.path if latest and (latest.frames or latest.path.exists()) else None

    def _take_change(self) -> None:
        """Take over what the thread has opened or completed."""
        if not self._done:
            return
        self._is_changing = False
        done = self._done.popleft()
        if isinstance(done, Recorder):
            self._recorder = self._latest = done
        else:
            self._ended = done

    def _begin(self) -> None:
        path = self._path or Path.cwd() / f"cangauge-{datetime.now(UTC):%Y%m%dT%H%M%SZ}.log"
        try:
            recorder = Recorder(path, self._limits)
        except Exception as error:  # noqa: BLE001 - or no later request would be answered
            emit(_LOG, logging.WARNING, "record.refused", f"no recording: {error}")
            self._done.append(RecordState(str(path), 0, 0, 0, str(error), is_active=False))
            return
        emit(_LOG, logging.INFO, "record.began", f"recording to {recorder.path}")
        self._done.append(recorder)

    def _end(self, recorder: Recorder) -> None:
        problem = None
        try:
            recorder.close()
            emit(_LOG, logging.INFO, "record.ended", f"recorded: {recorder.path}")
        except Exception as error:  # noqa: BLE001 - as above
            problem = str(error)
            emit(_LOG, logging.WARNING, "record.incomplete", f"{recorder.path}: {error}")
        state = recorder.state
        self._done.append(replace(state, is_active=False, problem=problem or state.problem))

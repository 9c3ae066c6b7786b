"""Follow the status of a service: poll it from a thread, and keep a bounded history."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, NamedTuple, Self

from cangauge.errors import CangaugeError
from cangauge.service.status_client import fetch_status, find_socket

POLL_EVERY_S: Final = 0.25
"""As often as the service makes a snapshot [s]."""
LATE_S: Final = 0.75
"""Age of the latest answer above which the service counts as silent [s]; three polls."""
LONGEST_HISTORY: Final = 14_400
"""Points kept: an hour of polls; then the older half is thinned."""
RATE_OVER_S: Final = 2.0
"""Averaging time of the frame rates [s]."""
SILENT_INTERVALS: Final = 3.0
"""A bus is silent after this many intervals of its samples."""


STATUSES: Final = ("valid", "degraded", "initialising", "invalid")


class Point(NamedTuple):
    """One answer in the history; NaN where not known, status "" where nothing answered."""

    time_s: float
    soc_pct: float
    current_a: float
    status: str


@dataclass(frozen=True, slots=True)
class View:
    """What is known of a service at one moment.

    Parameters
    ----------
    status : dict or None
        The latest answer; None before the first.
    age_s : float
        Its age [s]; infinite before the first.
    problem : str
        Why there is no newer one; "" if the latest request was answered.
    frames_per_s, rejects_per_s : float
        NaN until known.
    points : tuple of Point
        The oldest first.
    now_s : float
        Monotonic time [s], as in the points.
    place : str
        Endpoint asked.
    """

    status: dict[str, Any] | None
    age_s: float
    problem: str
    frames_per_s: float
    rejects_per_s: float
    points: tuple[Point, ...]
    now_s: float
    place: str

    @property
    def is_answered(self) -> bool:
        """Whether the service answers."""
        return self.status is not None and self.age_s <= LATE_S

    @property
    def sample_age_s(self) -> float:
        """Age of the latest sample [s]; infinite before the first."""
        sample = (self.status or {}).get("sample")
        age_s = None if sample is None else sample["age_s"]
        return math.inf if age_s is None else age_s + self.age_s


class StatusFeed:
    """Poll a service's status; use it in a `with` block.

    Parameters
    ----------
    endpoint : str, optional
        Path of a unix socket, or "http://host:port"; by default the service of this machine.
    token_file : Path, optional
        File with the token for HTTP.
    clock : callable
        Monotonic time [s].

    Raises
    ------
    InputError
        From `poll`, if the endpoint or the token is wrong.
    """

    def __init__(
        self,
        endpoint: str | None,
        token_file: Path | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._endpoint = endpoint
        self._token_file = token_file
        self._clock = clock
        self._lock = threading.Lock()
        self._status: dict[str, Any] | None = None
        self._answered_s = -math.inf
        self._problem = ""
        self._place = endpoint or "this machine"
        self._points: list[Point] = []
        self._counts: deque[tuple[float, int, int]] = deque()
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run, name="cangauge-feed", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._done.set()

    def poll(self) -> None:
        """Ask once; a service that does not answer becomes the view's `problem`."""
        place = self._endpoint or str(find_socket())
        status = fetch_status(place, self._token_file)
        with self._lock:
            now_s = self._clock()
            self._place, self._status = place, status
            self._answered_s, self._problem = now_s, ""
            self._count(now_s, status)
            sample = status["sample"] or {}
            self._add(
                Point(
                    now_s,
                    _or_nan(status["estimate"]["soc_pct"]),
                    _or_nan(sample.get("current_a")),
                    status["status"] if status["status"] in STATUSES else "invalid",
                )
            )

    def try_poll(self) -> None:
        """Ask once; keep any error as the view's `problem`."""
        try:
            self.poll()
        except CangaugeError as error:
            with self._lock:
                self._problem = str(error)
                self._counts.clear()
                self._add(Point(self._clock(), math.nan, math.nan, ""))

    def view(self) -> View:
        """Return what is known now; from any thread."""
        with self._lock:
            now_s = self._clock()
            frames, rejects = self._rates()
            return View(
                self._status,
                now_s - self._answered_s,
                self._problem,
                frames,
                rejects,
                tuple(self._points),
                now_s,
                self._place,
            )

    def _run(self) -> None:
        while not self._done.wait(POLL_EVERY_S):
            self.try_poll()

    def _add(self, point: Point) -> None:
        self._points.append(point)
        if len(self._points) > LONGEST_HISTORY:
            half = LONGEST_HISTORY // 2
            self._points[:half] = self._points[:half:2]

    def _count(self, now_s: float, status: dict[str, Any]) -> None:
        frames, rejects = status["frames"]["received"], sum(status["rejects"].values())
        counts = self._counts
        if counts and frames < counts[-1][1]:  # the service has been restarted
            counts.clear()
        counts.append((now_s, frames, rejects))
        while now_s - counts[0][0] > RATE_OVER_S:
            counts.popleft()

    def _rates(self) -> tuple[float, float]:
        if len(self._counts) < 2:
            return math.nan, math.nan
        (first_s, *first), (last_s, *last) = self._counts[0], self._counts[-1]
        frames, rejects = (
            (new - old) / (last_s - first_s) for old, new in zip(first, last, strict=True)
        )
        return frames, rejects


def alarm(view: View) -> str:
    """Return what keeps the SoC from being known now, in one line; "" if nothing does."""
    status = view.status
    if status is None:
        return f"NO ANSWER: {view.problem or 'asking'}"
    if not view.is_answered:
        return f"NO ANSWER for {view.age_s:.1f} s: {view.problem or view.place}"
    if status["loop_stuck"]:
        return "LOOP STUCK: the receive loop hangs; restart the service"
    if not status["bus_up"]:
        return f"BUS LOST: {status['bus_trouble'] or status['bus']}"
    return _silence(view.sample_age_s, status["samples_per_s"] or 0.0)


def _silence(age_s: float, samples_per_s: float) -> str:
    if math.isinf(age_s):
        return "BUS SILENT: no sample yet; check channel, bit rate and vehicle"
    usual_s = SILENT_INTERVALS / samples_per_s if samples_per_s > 0.0 else 0.0
    return f"BUS SILENT: no sample for {age_s:.1f} s" if age_s > max(LATE_S, usual_s) else ""


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else float(value)

"""The loop's side of watching: counts durations, shows snapshots, tells systemd, logs changes."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from typing import Final, Protocol

from cangauge.bus.counters import Counters, MessageCounters
from cangauge.bus.receive import BusPort
from cangauge.estimate.types import Status
from cangauge.events import Pace, emit
from cangauge.report.words import number, reason_names
from cangauge.service.gauge import Gauge
from cangauge.service.histogram import Histogram
from cangauge.service.notify import Notifier
from cangauge.service.snapshot import Identity, RecordState, Snapshot, reason_ids

SHOW_EVERY_S: Final = 0.25
"""How often a snapshot is made [s]."""
TELL_EVERY_S: Final = 1.0
"""How often systemd is told the status line [s]."""
RATE_OVER_S: Final = 2.0
"""Over so long the rate of samples is taken [s]."""
CLOCKS_APART_S: Final = 60.0
"""A receive stamp further than this from the wall clock is of another clock: no latency [s]."""

BUS_COUNTS: Final = ("garbled", "error_frames", "unsent", "queue_drops", "losses")
"""Counts of a port that are shown, as far as the port has them."""

_NO_REJECTS: Final = frozenset({"wanted", "counter_jumps", "frames_lost"})
_OF_VALUES: Final = frozenset({"not_available", "implausible", "stuck", "held_back"})
"""Counters of values that were refused, while their frame was not."""
_REJECTS: Final = tuple(
    each.name for each in fields(MessageCounters) if each.name not in _NO_REJECTS
)

_LOG = logging.getLogger(__name__)


class Recording(Protocol):
    """A recording that can say how it fares."""

    @property
    def state(self) -> RecordState:
        """How it fares."""


class Monitor:
    """Watches the loop from within; its methods are for the loop's thread.

    Parameters
    ----------
    gauge : Gauge
    port : BusPort
    identity : Identity
    notifier : Notifier
    record : Recording, optional
    clock : callable
        Monotonic time [s].

    Attributes
    ----------
    identity : Identity
        As given; what is told from then on, if it is replaced.
    latest : Snapshot
        For any thread: it is replaced, never changed.
    """

    def __init__(
        self,
        gauge: Gauge,
        port: BusPort,
        *,
        identity: Identity,
        notifier: Notifier,
        record: Recording | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._gauge = gauge
        self._port = port
        self.identity = identity
        self._notifier = notifier
        self._record = record
        self._began_s = now_s = clock()
        self._latency = Histogram()
        self._step = Histogram()
        self._due_s = self._tell_s = now_s
        self._ping_s = now_s
        self._sample_s = -math.inf
        self._untold_stamp_s: float | None = None
        self._rate = 0.0
        self._rate_from = (now_s, 0)
        self._status: Status | None = None
        self._pace = Pace()
        self.latest = self._snapshot(now_s)

    def stepped(self, stamp_s: float, step_s: float, came_s: float) -> None:
        """Count a step of the estimator.

        Parameters
        ----------
        stamp_s : float
            Receive stamp of the frame that completed the sample, seconds since 1970.
        step_s : float
            From receiving that frame to having taken the sample in [s].
        came_s : float
            When that frame came in, by the monotonic clock [s].
        """
        self._sample_s = came_s
        self._untold_stamp_s = stamp_s
        self._step.add(step_s)

    def sent(self) -> None:
        """Count the latency of the latest sample: an estimate that knows it was just sent."""
        stamp_s, self._untold_stamp_s = self._untold_stamp_s, None
        if stamp_s is None:
            return
        latency_s = time.time() - stamp_s
        # Stamps of another clock, and a clock that was set in between, tell nothing.
        if 0.0 <= latency_s < CLOCKS_APART_S:
            self._latency.add(latency_s)

    @contextmanager
    def reloading(self) -> Iterator[None]:
        """Tell systemd that the configuration is read again while the block runs."""
        self._notifier.reloading()
        try:
            yield
        finally:
            self._notifier.ready(status_line(self.latest))

    def turn(self, now_s: float) -> None:
        """Take notice that the loop has turned (monotonic clock [s])."""
        if now_s < self._due_s:
            return
        self._due_s = now_s + SHOW_EVERY_S
        self.latest = snapshot = self._snapshot(now_s)
        self._log_status(snapshot)
        ping_every_s = self._notifier.ping_every_s
        if ping_every_s is not None and now_s >= self._ping_s:
            self._ping_s = now_s + ping_every_s - SHOW_EVERY_S
            self._notifier.ping()
        if self._notifier.active and now_s >= self._tell_s:
            self._tell_s = now_s + TELL_EVERY_S
            self._notifier.status(status_line(snapshot))

    def _snapshot(self, now_s: float) -> Snapshot:
        gauge = self._gauge
        samples = gauge.samples
        since_s, before = self._rate_from
        if now_s - since_s >= RATE_OVER_S:
            self._rate = (samples - before) / (now_s - since_s)
            self._rate_from = (now_s, samples)
        counters = gauge.counters
        rejects = _rejects(counters)
        return Snapshot(
            identity=self.identity,
            made_s=now_s,
            uptime_s=now_s - self._began_s,
            estimate=gauge.published,
            sample=gauge.latest_sample,
            sample_age_s=now_s - self._sample_s,
            samples=samples,
            samples_per_s=self._rate,
            frames=counters.frames,
            wanted=counters.wanted,
            rejected=sum(count for name, count in rejects.items() if name not in _OF_VALUES),
            lost=counters.frames_lost,
            rejects=rejects,
            bus=_bus_counts(self._port),
            bus_up=not any(getattr(self._port, name, False) for name in ("is_away", "is_off")),
            bus_trouble=str(getattr(self._port, "trouble", "")),
            latency=self._latency.copy(),
            step=self._step.copy(),
            record=None if self._record is None else self._record.state,
        )

    def _log_status(self, snapshot: Snapshot) -> None:
        estimate = snapshot.estimate
        # A change that may not be told yet is told later, if it has not gone by then.
        if estimate.status is self._status or not self._pace.allows(snapshot.made_s):
            return
        before, self._status = self._status, estimate.status
        is_worse = estimate.status is Status.INVALID
        emit(
            _LOG,
            logging.WARNING if is_worse else logging.INFO,
            "status.changed",
            status_line(snapshot),
            always=True,
            status=estimate.status.name.lower(),
            before=None if before is None else before.name.lower(),
            reasons=reason_ids(estimate.reasons),
            soc_pct=estimate.soc_pct,
            soc_std_pct=estimate.soc_std_pct,
        )


def status_line(snapshot: Snapshot) -> str:
    """Return the state in one line, such as "SoC 71.2 ± 0.8 %, valid, 10.0 samples/s"."""
    estimate = snapshot.estimate
    soc = f"SoC {number(estimate.soc_pct, 1)} ± {number(estimate.soc_std_pct, 1, '%')}"
    why = reason_names(int(estimate.reasons))
    status = estimate.status.name.lower() + (f" ({why})" if why else "")
    return f"{soc}, {status}, {snapshot.samples_per_s:.1f} samples/s"


def _rejects(counters: Counters) -> dict[str, int]:
    return {
        name: sum(int(getattr(each, name)) for each in counters.messages.values())
        for name in _REJECTS
    }


def _bus_counts(port: BusPort) -> dict[str, int]:
    found = {name: getattr(port, name, None) for name in BUS_COUNTS}
    return {name: int(value) for name, value in found.items() if value is not None}

"""Counts in fixed buckets: what the loop fills in a fraction of a microsecond, and others read.

What a running service shows of itself: an unchanging copy, made by the loop, read by others.

The loop puts a new one in the place of the old one several times a second; whoever reads takes the
reference and has all the time in the world. No locks.

The loop's side of watching: counts durations, shows snapshots, tells systemd, logs changes.
"""

from __future__ import annotations

import logging
import math
import time
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import Any, Final, Protocol

from cangauge import __version__
from cangauge._formatting import number
from cangauge._logging import Pace, emit
from cangauge.bus.connection import BusConnection
from cangauge.bus.decoder import FrameStatistics, MessageStatistics
from cangauge.estimate.validity import Estimate, Reason, Sample, Status, reason_name, reason_names
from cangauge.service.pipeline import Pipeline
from cangauge.service.systemd import Notifier

# --- Counts in fixed buckets: what the loop fills in a fraction of a microsecond, and others…

BOUNDS_S: Final = (
    5e-6, 1e-5, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4,
    1e-3, 2e-3, 5e-3, 1e-2, 2e-2, 5e-2, 0.1, 0.2, 0.5, 1.0,
)  # fmt: skip
"""Upper bounds of the buckets [s]; one more holds what is larger."""


@dataclass(frozen=True, slots=True)
class HistogramCounts:
    """An unchanging copy.

    Parameters
    ----------
    counts : tuple of int
        Per bucket of `BOUNDS_S`, and one for what is larger.
    total_s : float
        Sum of all values [s].
    """

    counts: tuple[int, ...]
    total_s: float

    @property
    def count(self) -> int:
        """Number of values."""
        return sum(self.counts)

    def at_most_s(self, share: float) -> float | None:
        """Return a bound that this share of the values keeps [s].

        It is a bucket's upper end: the quantile lies at it or below, by no more than the bucket.
        None without values, infinite where the quantile is above all bounds.
        """
        count = self.count
        if not count:
            return None
        wanted, seen = share * count, 0
        for bound, observed in zip((*BOUNDS_S, float("inf")), self.counts, strict=True):
            seen += observed
            if seen >= wanted:
                return bound
        return float("inf")


class Histogram:
    """Counts durations in seconds; for one thread."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS_S) + 1)
        self._total_s = 0.0

    def add(self, value_s: float) -> None:
        """Count one duration [s]."""
        self._counts[bisect_left(BOUNDS_S, value_s)] += 1
        self._total_s += value_s

    def copy(self) -> HistogramCounts:
        """Return what was counted so far."""
        return HistogramCounts(tuple(self._counts), self._total_s)


# --- What a running service shows of itself: an unchanging copy, made by the loop, read by o…

SCHEMA: Final = 1
STUCK_S: Final = 2.0
"""A loop that shows nothing for so long [s] is taken to be stuck, and its SoC to be old."""


@dataclass(frozen=True, slots=True)
class Identity:
    """What does not change while the service runs.

    Parameters
    ----------
    bus, vehicle, model, method, time_source : str
    began_s : float
        Start, seconds since 1970.
    """

    bus: str
    vehicle: str
    model: str
    method: str
    time_source: str
    began_s: float


@dataclass(frozen=True, slots=True)
class RecordState:
    """How the recording fares.

    Parameters
    ----------
    path : str
        The file that is written.
    frames, lost_frames, written_bytes : int
        Frames taken so far; those that the disk did not take; bytes on the disk.
    problem : str or None
        Why nothing can be written at present.
    """

    path: str
    frames: int
    lost_frames: int
    written_bytes: int
    problem: str | None


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The state of the service at one moment.

    Parameters
    ----------
    identity : Identity
    made_s : float
        When, by the monotonic clock [s].
    uptime_s : float
    estimate : Estimate
        As it was last published.
    sample : Sample or None
        The latest.
    sample_age_s : float
        Since the latest sample, at `made_s` [s]; infinite before the first.
    samples : int
    samples_per_s : float
    frames, wanted, rejected, lost : int
        Frames received; of a wanted id; of those refused; missing by their counters.
    rejects : mapping
        Refused frames and values by reason.
    bus : mapping
        What the bus counts: error frames, frames unsent, …
    bus_up : bool
        False while the bus is away or its controller off.
    bus_trouble : str
        What is or went wrong with the bus, in words; empty if nothing is known to.
    latency, step : HistogramCounts
        From receive stamp to SoC sent; from receiving the frame that completes a sample to having
        taken it in.
    record : RecordState or None
    """

    identity: Identity
    made_s: float
    uptime_s: float
    estimate: Estimate
    sample: Sample | None
    sample_age_s: float
    samples: int
    samples_per_s: float
    frames: int
    wanted: int
    rejected: int
    lost: int
    rejects: Mapping[str, int]
    bus: Mapping[str, int]
    bus_up: bool
    bus_trouble: str
    latency: HistogramCounts
    step: HistogramCounts
    record: RecordState | None

    def is_stuck(self, now_s: float) -> bool:
        """Return whether the loop has shown nothing for too long, at a monotonic time [s]."""
        return now_s - self.made_s > STUCK_S

    def age_s(self, now_s: float) -> float:
        """Return the age of the latest sample [s], at a monotonic time [s]."""
        return self.sample_age_s + max(now_s - self.made_s, 0.0)

    def estimate_at(self, now_s: float) -> Estimate:
        """Return the estimate as it may be believed at a monotonic time [s].

        The loop judges whether its input is stale. Where the loop itself shows nothing any more,
        nobody does, and the estimate is invalid.
        """
        estimate = self.estimate
        if not self.is_stuck(now_s):
            return estimate
        return estimate._replace(
            status=Status.INVALID, reasons=estimate.reasons | Reason.INPUT_STALE
        )


def reason_ids(reasons: Reason) -> list[str]:
    """Return the names of the reasons that are set, such as "delay_line_filling"."""
    return [reason_name(each).replace(" ", "_") for each in Reason if each and reasons & each]


def as_json(snapshot: Snapshot, now_s: float) -> dict[str, Any]:
    """Return what `/status` and `cangauge status --json` tell.

    Parameters
    ----------
    snapshot : Snapshot
    now_s : float
        Monotonic time [s].

    Returns
    -------
    dict
        Finite numbers, strings and None only.
    """
    identity, estimate, sample = snapshot.identity, snapshot.estimate_at(now_s), snapshot.sample
    record = snapshot.record
    return {
        "schema": SCHEMA,
        "running": True,
        "version": __version__,
        "bus": identity.bus,
        "vehicle": identity.vehicle,
        "model": identity.model,
        "method": identity.method,
        "time_source": identity.time_source,
        "uptime_s": _finite(snapshot.uptime_s + max(now_s - snapshot.made_s, 0.0)),
        "loop_stuck": snapshot.is_stuck(now_s),
        "status": estimate.status.name.lower(),
        "reasons": reason_ids(estimate.reasons),
        "estimate": {
            "time_s": _finite(estimate.time_s),
            "soc_pct": _finite(estimate.soc_pct),
            "soc_std_pct": _finite(estimate.soc_std_pct),
            "soc_newton_pct": _finite(estimate.soc_newton_pct),
            "soc_coulomb_pct": _finite(estimate.soc_coulomb_pct),
            "voltage_model_v": _finite(estimate.voltage_model_v),
            "residual_v": _finite(estimate.residual_v),
        },
        "sample": None
        if sample is None
        else {
            "age_s": _finite(snapshot.age_s(now_s)),
            "current_a": _finite(sample.current_a),
            "voltage_v": _finite(sample.voltage_v),
            "temperature_c": _finite(sample.temperature_c),
        },
        "samples": snapshot.samples,
        "samples_per_s": _finite(snapshot.samples_per_s),
        "frames": {
            "received": snapshot.frames,
            "wanted": snapshot.wanted,
            "used": snapshot.wanted - snapshot.rejected,
            "lost": snapshot.lost,
        },
        "rejects": dict(snapshot.rejects),
        "bus_up": snapshot.bus_up,
        "bus_counts": dict(snapshot.bus),
        "bus_trouble": snapshot.bus_trouble or None,
        "latency": _durations(snapshot.latency),
        "step": _durations(snapshot.step),
        "record": None
        if record is None
        else {
            "path": record.path,
            "frames": record.frames,
            "lost_frames": record.lost_frames,
            "written_bytes": record.written_bytes,
            "problem": record.problem,
        },
    }


def _durations(histogram: HistogramCounts) -> dict[str, Any]:
    count = histogram.count
    p50_s, p99_s = histogram.at_most_s(0.5), histogram.at_most_s(0.99)
    return {
        "count": count,
        "mean_s": histogram.total_s / count if count else None,
        "p50_at_most_s": _finite(p50_s),
        "p99_at_most_s": _finite(p99_s),
    }


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else value


# --- The loop's side of watching: counts durations, shows snapshots, tells systemd, logs cha…

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
    each.name for each in fields(MessageStatistics) if each.name not in _NO_REJECTS
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
    gauge : Pipeline
    port : BusConnection
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
        gauge: Pipeline,
        port: BusConnection,
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
        counters = gauge.decoder.counters
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


def _rejects(counters: FrameStatistics) -> dict[str, int]:
    return {
        name: sum(int(getattr(each, name)) for each in counters.messages.values())
        for name in _REJECTS
    }


def _bus_counts(port: BusConnection) -> dict[str, int]:
    found = {name: getattr(port, name, None) for name in BUS_COUNTS}
    return {name: int(value) for name, value in found.items() if value is not None}

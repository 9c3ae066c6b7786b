"""Status of a running service: counts of the receive loop as snapshots for other threads.

`Monitor` replaces its `Snapshot` a few times a second; readers take the reference, without locks.
It also notifies systemd and logs changes of the status.
"""

from __future__ import annotations

import logging
import math
import time
from bisect import bisect_left
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Final

from cangauge._logging import emit
from cangauge._text import number
from cangauge._version import __version__
from cangauge.bus.connection import BusConnection
from cangauge.bus.decoder import FrameStatistics
from cangauge.bus.plausibility import MessageStatistics
from cangauge.bus.publish import NO_REPORT, PackReport
from cangauge.service.lifecycle import Notifier
from cangauge.service.pipeline import Pipeline
from cangauge.service.record_control import RecordControl
from cangauge.service.recording import RecordState
from cangauge.service.status_client import SCHEMA
from cangauge.types import Estimate, Reason, Sample, Status, reason_name, reason_names

_LOG = logging.getLogger(__name__)

STUCK_S: Final = 2.0
"""Age of a snapshot above which the receive loop counts as stuck, and its SoC as stale [s]."""
SHOW_EVERY_S: Final = 0.25
"""Interval of the snapshots [s]."""
PAGE_EVERY_S: Final = 0.1
"""The same while the live page is served [s]: that of SOC_ESTIMATE."""
NOTIFY_EVERY_S: Final = 1.0
"""Interval of status lines to systemd [s]."""
RATE_OVER_S: Final = 2.0
"""Averaging time of the sample rate [s]."""
CLOCKS_APART_S: Final = 60.0
"""A receive stamp further than this from the wall clock belongs to another clock [s]."""

REPORT_EVERY_S: Final = 1.0
"""Interval of health, power and cells in the snapshots [s]."""

BUS_COUNTS: Final = ("garbled", "error_frames", "unsent", "queue_drops", "losses", "foreign")
"""Counts of a bus to report, where it has them."""

_NO_REJECTS: Final = frozenset({"wanted", "counter_jumps", "frames_lost"})
_OF_VALUES: Final = frozenset({"not_available", "implausible", "stuck", "held_back"})
"""Reasons that concern values, not whole frames."""
_REJECTS: Final = tuple(
    each.name for each in fields(MessageStatistics) if each.name not in _NO_REJECTS
)


BOUNDS_S: Final = (
    5e-6, 1e-5, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4,
    1e-3, 2e-3, 5e-3, 1e-2, 2e-2, 5e-2, 0.1, 0.2, 0.5, 1.0,
)  # fmt: skip
"""Upper bounds of the buckets [s]; one more bucket holds larger values."""


@dataclass(frozen=True, slots=True)
class HistogramCounts:
    """Immutable copy of a histogram.

    Parameters
    ----------
    counts : tuple of int
        Per bucket of `BOUNDS_S`, and one for larger values.
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
        """Return the upper bound of the bucket that holds the quantile of this share [s].

        None without values; infinite if the quantile is above all bounds.
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
    """Histogram of durations, filled by one thread."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS_S) + 1)
        self._total_s = 0.0

    def add(self, value_s: float) -> None:
        """Count one duration [s]."""
        self._counts[bisect_left(BOUNDS_S, value_s)] += 1
        self._total_s += value_s

    def copy(self) -> HistogramCounts:
        """Return the counts so far."""
        return HistogramCounts(tuple(self._counts), self._total_s)


@dataclass(frozen=True, slots=True)
class Identity:
    """Constant properties of a running service.

    Parameters
    ----------
    bus, vehicle, model, method, time_source : str
    began_s : float
        Start, seconds since 1970.
    core : {"python", "compiled"}
        Which implementation of the estimator's step is used; both give the same numbers.
    """

    bus: str
    vehicle: str
    model: str
    method: str
    time_source: str
    began_s: float
    core: str = "python"


@dataclass(frozen=True, slots=True)
class ConfigState:
    """Result of the latest reload of the configuration.

    Parameters
    ----------
    reloading : bool
        A new one is being read; the old one is in use meanwhile.
    problem : str
        Why the latest one was refused; "" if it is in use.
    """

    reloading: bool = False
    problem: str = ""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The state of the service at one moment.

    Parameters
    ----------
    identity : Identity
    made_s : float
        Monotonic time [s].
    uptime_s : float
    estimate : Estimate
        As last published.
    sample : Sample or None
        The latest.
    sample_age_s : float
        Age of the latest sample at `made_s` [s]; infinite before the first.
    samples : int
    samples_per_s : float
    frames, wanted, rejected, lost : int
        Frames received; those with an expected id; those of them rejected; those missing by
        their alive counters.
    rejects : mapping
        Rejected frames and values by reason.
    bus : mapping
        Counts of the bus: error frames, unsent frames, …
    bus_up : bool
        False while the bus is lost or its controller is bus-off.
    bus_trouble : str
        Problem of the bus as a phrase; "" without one.
    latency, step : HistogramCounts
        Time from receive stamp to published SoC; processing time of the frame that completes a
        sample.
    record : RecordState or None
        Of the recording that runs or has ended.
    config : ConfigState
    report : PackReport or None
        Health, power and cells, of the last second; None before the first sample.
    polls : mapping, optional
        Requests over ISO-TP and what came of them; None if none are sent.
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
    config: ConfigState
    report: PackReport | None = None
    polls: Mapping[str, int] | None = None

    def is_stuck(self, now_s: float) -> bool:
        """Return whether the receive loop is stuck at a monotonic time [s]."""
        return now_s - self.made_s > STUCK_S

    def age_s(self, now_s: float) -> float:
        """Return the age of the latest sample [s] at a monotonic time [s]."""
        return self.sample_age_s + max(now_s - self.made_s, 0.0)

    def estimate_at(self, now_s: float) -> Estimate:
        """Return the estimate at a monotonic time [s]: invalid once the loop is stuck.

        Stale input is detected by the loop itself, while it runs.
        """
        estimate = self.estimate
        if not self.is_stuck(now_s):
            return estimate
        return estimate._replace(
            status=Status.INVALID, reasons=estimate.reasons | Reason.INPUT_STALE
        )


def reason_ids(reasons: Reason) -> list[str]:
    """Return the names of the reasons, such as "delay_line_filling"."""
    return [reason_name(each).replace(" ", "_") for each in Reason if each and reasons & each]


def as_json(snapshot: Snapshot, now_s: float) -> dict[str, Any]:
    """Return the object of `/status` and `cangauge status --json`.

    Parameters
    ----------
    snapshot : Snapshot
    now_s : float
        Monotonic time [s].

    Returns
    -------
    dict
        Values are finite numbers, strings and None.
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
        "core": identity.core,
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
        **NO_REPORT,
        **({} if snapshot.report is None else snapshot.report.to_dict()),
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
        "polls": None if snapshot.polls is None else dict(snapshot.polls),
        "config": {
            "reloading": snapshot.config.reloading,
            "problem": snapshot.config.problem or None,
        },
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
            "active": record.is_active,
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


class Monitor:
    """Collect counts in the receive loop; its methods are for the loop's thread.

    Parameters
    ----------
    pipeline : Pipeline
    port : BusConnection
    identity : Identity
    notifier : Notifier
    record : RecordControl, optional
    clock : callable
        Monotonic time [s].
    show_every_s : float
        Interval of the snapshots [s].

    Attributes
    ----------
    identity : Identity
        Replaced when the configuration changes.
    latest : Snapshot
        Immutable, hence readable from any thread.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        port: BusConnection,
        *,
        identity: Identity,
        notifier: Notifier,
        record: RecordControl | None = None,
        clock: Callable[[], float] = time.monotonic,
        show_every_s: float = SHOW_EVERY_S,
    ) -> None:
        self._show_every_s = show_every_s
        self._pipeline = pipeline
        self._port = port
        self.identity = identity
        self._notifier = notifier
        self._record = record
        self._began_s = now_s = clock()
        self._latency = Histogram()
        self._step = Histogram()
        self._due_s = self._notify_s = now_s
        self._ping_s = now_s
        self._sample_s = -math.inf
        self._unsent_stamp_s: float | None = None
        self._rate = 0.0
        self._rate_from = (now_s, 0)
        self._status: Status | None = None
        self._config = ConfigState()
        self._report: PackReport | None = None
        self._report_due_s = now_s
        self._had_notices = False
        self.latest = self._snapshot(now_s)

    def stepped(self, stamp_s: float, step_s: float, came_s: float) -> None:
        """Count a step of the estimator.

        Parameters
        ----------
        stamp_s : float
            Receive stamp of the frame that completed the sample, seconds since 1970.
        step_s : float
            Processing time of the sample [s].
        came_s : float
            Monotonic time at which that frame was received [s].
        """
        self._sample_s = came_s
        self._unsent_stamp_s = stamp_s
        self._step.add(step_s)

    def sent(self) -> None:
        """Count the latency of the latest sample, whose estimate was just sent."""
        stamp_s, self._unsent_stamp_s = self._unsent_stamp_s, None
        if stamp_s is None:
            return
        latency_s = time.time() - stamp_s
        # Skip stamps of another clock, and those before the clock was set.
        if 0.0 <= latency_s < CLOCKS_APART_S:
            self._latency.add(latency_s)

    def reload_begins(self, within_s: float) -> None:
        """Report a reload that may take this time [s]; `reload_ends` ends it."""
        self._config = replace(self._config, reloading=True)
        self._notifier.reloading(within_s)

    def reload_ends(self, problem: str) -> None:
        """Report the end of a reload; `problem` is why it was refused, "" if it was not."""
        self._config = ConfigState(problem=problem)
        refused = f"; new configuration REFUSED: {problem}" if problem else ""
        self._notifier.ready(_status_line(self.latest) + refused)

    def turn(self, now_s: float) -> bool:
        """Record a turn of the loop (monotonic time [s]); return whether `latest` is new."""
        if now_s < self._due_s:
            return False
        self._due_s = now_s + self._show_every_s
        self.latest = snapshot = self._snapshot(now_s)
        self._log_status(snapshot)
        self._log_notices(snapshot)
        ping_every_s = self._notifier.ping_every_s
        if ping_every_s is not None and now_s >= self._ping_s:
            self._ping_s = now_s + ping_every_s - self._show_every_s
            self._notifier.ping()
        if self._notifier.active and now_s >= self._notify_s:
            self._notify_s = now_s + NOTIFY_EVERY_S
            self._notifier.status(_status_line(snapshot))
        return True

    def _snapshot(self, now_s: float) -> Snapshot:
        pipeline = self._pipeline
        samples = pipeline.samples
        since_s, before = self._rate_from
        if now_s - since_s >= RATE_OVER_S:
            self._rate = (samples - before) / (now_s - since_s)
            self._rate_from = (now_s, samples)
        if samples and now_s >= self._report_due_s:
            self._report_due_s = now_s + REPORT_EVERY_S
            self._report = pipeline.report()
        statistics = pipeline.decoder.statistics
        rejects = _rejects(statistics)
        return Snapshot(
            identity=self.identity,
            made_s=now_s,
            uptime_s=now_s - self._began_s,
            estimate=pipeline.published,
            sample=pipeline.latest_sample,
            sample_age_s=now_s - self._sample_s,
            samples=samples,
            samples_per_s=self._rate,
            frames=statistics.frames,
            wanted=statistics.wanted,
            rejected=sum(count for name, count in rejects.items() if name not in _OF_VALUES),
            lost=statistics.frames_lost,
            rejects=rejects,
            bus=_bus_counts(self._port),
            bus_up=not any(getattr(self._port, name, False) for name in ("is_away", "is_off")),
            bus_trouble=str(getattr(self._port, "trouble", "")),
            latency=self._latency.copy(),
            step=self._step.copy(),
            record=None if self._record is None else self._record.state,
            config=self._config,
            report=self._report,
            polls=_poll_counts(self._port),
        )

    def _log_notices(self, snapshot: Snapshot) -> None:
        """Log the notices once when they appear."""
        notices = [] if snapshot.report is None else snapshot.report.notices
        if notices and not self._had_notices:
            for notice in notices:
                emit(_LOG, logging.WARNING, "cells.sum_differs", notice)
        self._had_notices = bool(notices)

    def _log_status(self, snapshot: Snapshot) -> None:
        estimate = snapshot.estimate
        if estimate.status is self._status:
            return
        before, self._status = self._status, estimate.status
        is_worse = estimate.status is Status.INVALID
        emit(
            _LOG,
            logging.WARNING if is_worse else logging.INFO,
            "status.changed",
            _status_line(snapshot),
            status=estimate.status.name.lower(),
            before=None if before is None else before.name.lower(),
            reasons=reason_ids(estimate.reasons),
            soc_pct=estimate.soc_pct,
            soc_std_pct=estimate.soc_std_pct,
        )


def _status_line(snapshot: Snapshot) -> str:
    """Return a snapshot in one line, such as "SoC 71.2 ± 0.8 %, valid, 10.0 samples/s"."""
    estimate = snapshot.estimate
    soc = f"SoC {number(estimate.soc_pct, 1)} ± {number(estimate.soc_std_pct, 1, '%')}"
    why = reason_names(int(estimate.reasons))
    status = estimate.status.name.lower() + (f" ({why})" if why else "")
    return f"{soc}, {status}, {snapshot.samples_per_s:.1f} samples/s"


def _rejects(statistics: FrameStatistics) -> dict[str, int]:
    return {
        name: sum(int(getattr(each, name)) for each in statistics.messages.values())
        for name in _REJECTS
    }


def _poll_counts(port: BusConnection) -> dict[str, int] | None:
    counts = getattr(port, "polls", None)
    return None if counts is None else counts.to_dict()


def _bus_counts(port: BusConnection) -> dict[str, int]:
    found = {name: getattr(port, name, None) for name in BUS_COUNTS}
    return {name: int(value) for name, value in found.items() if value is not None}

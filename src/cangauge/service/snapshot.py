"""What a running service shows of itself: an unchanging copy, made by the loop, read by others.

The loop puts a new one in the place of the old one several times a second; whoever reads takes the
reference and has all the time in the world. No locks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from cangauge import __version__
from cangauge.estimate.types import Estimate, Reason, Sample, Status
from cangauge.report.words import reason_name
from cangauge.service.histogram import HistogramCounts

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

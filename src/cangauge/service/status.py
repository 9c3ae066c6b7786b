"""Status of a running service: the object of `/status`, made by the receive loop.

`Monitor` replaces its `Snapshot` a few times a second; other threads take the reference, without
locks. It also notifies systemd and logs changes of the status.
"""

from __future__ import annotations

import logging
import math
import time
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from itertools import accumulate
from typing import TYPE_CHECKING, Any, Final, get_args

from cangauge._logging import emit
from cangauge._text import known_soc, plain
from cangauge._version import __version__
from cangauge.bus.connection import BusConnection
from cangauge.bus.plausibility import Count
from cangauge.bus.publish import DETAIL_EVERY, ESTIMATE_EVERY_S, NO_REPORT
from cangauge.service.events import release_held
from cangauge.service.lifecycle import Notifier
from cangauge.service.pipeline import Pipeline
from cangauge.service.status_client import BOUNDS_S, SCHEMA, SHOW_EVERY_S, Snapshot, reason_ids
from cangauge.types import REASON_WORDS, Estimate, Reason, Status, reason_sentences

if TYPE_CHECKING:
    from cangauge.service.output import Output
    from cangauge.service.record import Recorder

_LOG = logging.getLogger(__name__)

NOTIFY_EVERY_S: Final = DETAIL_EVERY * ESTIMATE_EVERY_S
"""Interval of status lines to systemd, and of health, power and cells in the snapshots, as on the
bus [s]."""
RATE_OVER_S: Final = 2.0
"""Averaging time of the sample rate [s]."""
CLOCKS_APART_S: Final = 60.0
"""Stamps, or ages, further than this from the wall clock belong to another clock [s]."""
BUS_COUNTS: Final = ("garbled", "error_frames", "unsent", "queue_drops", "losses")
"""Counts of a bus to report, where it has them."""

_OF_VALUES: Final = {"not_available", "implausible", "stuck", "held_back"}
"""Reasons that concern values, not whole frames."""
_VALUES: Final = Estimate._fields[: Estimate._fields.index("status")]
_REJECTS: Final = tuple(
    name for name in get_args(Count) if name not in {"wanted", "counter_jumps", "frames_lost"}
)


class Histogram:
    """Histogram of durations, filled by one thread."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS_S) + 1)
        self._total_s = 0.0

    def add(self, value_s: float) -> None:
        """Count one duration [s]."""
        self._counts[bisect_left(BOUNDS_S, value_s)] += 1
        self._total_s += value_s

    def to_dict(self) -> dict[str, Any]:
        """Return count, mean, bounds of the quantiles, and the counts of the buckets."""
        count = sum(self._counts)
        return {
            "count": count,
            "mean_s": self._total_s / count if count else None,
            "p50_at_most_s": self._at_most_s(0.5, count),
            "p99_at_most_s": self._at_most_s(0.99, count),
            "total_s": self._total_s,
            "buckets": list(self._counts),
        }

    def _at_most_s(self, share: float, count: int) -> float | None:
        """Return the upper bound of the bucket with this quantile [s]; None above all bounds."""
        place = bisect_left(list(accumulate(self._counts)), share * count)
        return BOUNDS_S[place] if count and place < len(BOUNDS_S) else None


def _as_utf8(name: str) -> str:
    r"""Return a name with its bytes that are no UTF-8 written out ("\udce9")."""
    return name.encode(errors="backslashreplace").decode()


@dataclass(eq=False)
class Monitor:
    """Collect counts in the receive loop; its methods are for the loop's thread.

    `latest` is immutable, hence readable from any thread. `model` (name of the file) and
    `sign_cure` (what to change if the current has the wrong sign) follow the configuration.
    `foreign` (frames of others with the service's ids) and `polls` (outcomes of its requests) are
    set by the loop. `recorder` is the recording, `outputs` have what is wrong with them, `clock`
    gives monotonic time [s].
    """

    pipeline: Pipeline
    port: BusConnection
    model: str = ""
    _: KW_ONLY
    notifier: Notifier = field(default_factory=Notifier)
    recorder: Recorder | None = None
    outputs: Sequence[Output] = ()
    clock: Callable[[], float] = time.monotonic
    sign_cure: str = "set the other sign under [current] of the map file"

    def __post_init__(self) -> None:
        self.foreign = 0
        self.polls: dict[str, int] | None = None
        self._began_s = now_s = self.clock()
        self._latency = Histogram()
        self._step = Histogram()
        self._due_s = self._notify_s = self._report_due_s = now_s
        self._sample_s = -math.inf
        self._unsent_stamp_s: float | None = None
        self._rate = 0.0
        self._rate_from = (now_s, 0)
        self._status: Status | None = None
        self._config: dict[str, Any] = {"reloading": False, "problem": None}
        self._report: Mapping[str, Any] = NO_REPORT
        self._notices: dict[str, str] = {}
        self.latest = Snapshot(now_s, self._object(now_s))

    def now(self) -> dict[str, Any]:
        """Return the latest object with the ages of this moment; from any thread."""
        return self.latest.at(self.clock())

    def stepped(self, stamp_s: float, step_s: float, came_s: float) -> None:
        """Count a step of the estimator, of `step_s` [s].

        The frame that completed the sample has the stamp `stamp_s` (seconds since 1970), and was
        received at the monotonic time `came_s` [s].
        """
        self._sample_s = came_s
        self._unsent_stamp_s = stamp_s
        self._step.add(step_s)

    def sent(self) -> None:
        """Count the latency of the latest sample, whose estimate was just sent."""
        stamp_s = self._unsent_stamp_s
        self._unsent_stamp_s = None
        # Skip stamps of another clock, and those before the clock was set.
        if stamp_s is not None and 0.0 <= (latency_s := time.time() - stamp_s) < CLOCKS_APART_S:
            self._latency.add(latency_s)

    def reload_begins(self) -> None:
        """Report a reload; `reload_ends` ends it."""
        self._config = self._config | {"reloading": True}
        self.notifier.send(RELOADING=1, MONOTONIC_USEC=time.monotonic_ns() // 1000)

    def reload_ends(self, problem: str | None) -> None:
        """Report the end of a reload, and why it was refused; None if it was not."""
        self._config = {"reloading": False, "problem": problem}
        refused = "" if problem is None else f"; new configuration REFUSED: {problem}"
        self.notifier.send(READY=1, STATUS=self._line() + refused)

    def update(self, now_s: float) -> bool:
        """Record an iteration of the loop (monotonic time [s]); return whether `latest` is new."""
        if now_s < self._due_s:
            return False
        self._due_s = now_s + SHOW_EVERY_S
        self.latest = Snapshot(now_s, self._object(now_s))
        self._log_changes(self.pipeline.published)
        release_held()
        self.notifier.send(WATCHDOG=1)  # ignored where the unit has no watchdog
        if self.notifier.active and now_s >= self._notify_s:
            self._notify_s = now_s + NOTIFY_EVERY_S
            self.notifier.send(STATUS=self._line())
        return True

    def final(self) -> dict[str, Any]:
        """Return the object of `/status` after the run, with the estimate published last."""
        self._report_due_s = -math.inf
        return self._object(self.clock()) | {"running": False}

    def _object(self, now_s: float) -> dict[str, Any]:
        """Return the object of `/status`."""
        pipeline = self.pipeline
        port = self.port
        estimate = pipeline.published
        sample = pipeline.latest_sample
        samples = pipeline.samples
        since_s, before = self._rate_from
        if now_s - since_s >= RATE_OVER_S:
            self._rate = (samples - before) / (now_s - since_s)
            self._rate_from = (now_s, samples)
        if samples and now_s >= self._report_due_s:
            self._report_due_s = now_s + NOTIFY_EVERY_S
            self._report = pipeline.report().to_dict()
        statistics = pipeline.decoder.statistics
        settings = pipeline.settings
        rejects = {name: getattr(statistics, name) for name in _REJECTS}
        rejected = sum(count for name, count in rejects.items() if name not in _OF_VALUES)
        counts = {name: getattr(port, name, None) for name in BUS_COUNTS}
        counts["foreign"] = self.foreign
        record = None if self.recorder is None else self.recorder.state
        troubles = [text for each in self.outputs if (text := each.trouble)]
        return {
            "schema": SCHEMA,
            "running": True,
            "version": __version__,
            "bus": _as_utf8(port.name),
            "vehicle": pipeline.vehicle.name,
            "model": _as_utf8(self.model),
            "method": settings.estimator.method,
            "time_source": settings.time_source,
            "core": pipeline.estimator.core,
            "uptime_s": now_s - self._began_s,
            "loop_stuck": False,
            "loop_age_s": 0.0,
            "status": estimate.status.name.lower(),
            "reasons": reason_ids(estimate.reasons),
            "estimate": plain(dict(zip(_VALUES, estimate, strict=False))),
            "sample": None
            if sample is None
            else {"age_s": now_s - self._sample_s if self._sample_s > -math.inf else None}
            | plain({name: value for name, value in sample._asdict().items() if name != "time_s"}),
            **self._report,
            "notices": [*self._find_notices().values(), *troubles],
            "samples": samples,
            "samples_per_s": self._rate,
            "frames": {
                "received": statistics.frames,
                "wanted": statistics.wanted,
                "used": statistics.wanted - rejected,
                "lost": pipeline.counts["lost"],
            },
            "rejects": rejects,
            "stamps": port.address.stamps,
            "bus_up": not any(getattr(port, name, False) for name in ("is_away", "is_off")),
            "bus_counts": {name: n for name, n in counts.items() if n is not None},
            "bus_trouble": getattr(port, "trouble", "") or None,
            "polls": None if self.polls is None else dict(self.polls),
            "config": self._config,
            "latency": self._latency.to_dict(),
            "step": self._step.to_dict(),
            "record": record and record | {"path": _as_utf8(record["path"])},
        }

    def _line(self) -> str:
        """Return the status in one line, such as "SoC 71.2 ± 0.8 %, valid, 10.0 samples/s"."""
        estimate = self.pipeline.published
        why = reason_sentences(int(estimate.reasons))
        status = estimate.status.name.lower() + (f" ({why})" if why else "")
        soc = known_soc(estimate.soc_pct, estimate.soc_std_pct, 1)
        return f"SoC {soc}, {status}, {self._rate:.1f} samples/s"

    def _find_notices(self) -> dict[str, str]:
        """Return what the user should look after, by event: one sentence each."""
        found = {"cells.sum_differs": " ".join(self._report["notices"])}
        if self.pipeline.latest.reasons & Reason.SIGN_SUSPECT:
            found["sign.suspect"] = (
                f"{REASON_WORDS[Reason.SIGN_SUSPECT]}; the SoC is wrong. Positive current must"
                f" discharge: {self.sign_cure}"
            )
        return {event: text for event, text in found.items() if text}

    def _log_changes(self, estimate: Estimate) -> None:
        """Log a change of the status, and notices once when they appear."""
        notices = self._find_notices()
        for event in notices.keys() - self._notices.keys():
            emit(_LOG.warning, event, notices[event])
        self._notices = notices
        if estimate.status is self._status:
            return
        before = self._status
        self._status = estimate.status
        emit(
            _LOG.warning if estimate.status is Status.INVALID else _LOG.info,
            "status.changed",
            self._line(),
            status=estimate.status.name.lower(),
            before=None if before is None else before.name.lower(),
            reasons=reason_ids(estimate.reasons),
            soc_pct=estimate.soc_pct,
            soc_std_pct=estimate.soc_std_pct,
        )

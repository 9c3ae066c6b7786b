"""The receive loop: receives, hands to the gauge, sends.

It alone knows the wall clock, and only to notice silence.
"""

from __future__ import annotations

import statistics
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

import can

from cangauge.bus.publish import ESTIMATE_EVERY_S, standard_filter
from cangauge.bus.receive import BusPort
from cangauge.bus.time_source import is_clock
from cangauge.estimate.types import Estimate
from cangauge.service.gauge import Gauge

LATE_S: Final = 0.01
"""So much later than due an estimate may come before the latest is repeated in its place [s]."""

LOOK_EVERY_S: Final = 0.1
"""How long receiving may block before signals and heartbeats are looked at again [s]."""

SEND_WITHIN_S: Final = 0.02
"""How long sending may wait for room [s]: a full queue (nobody else on the bus) costs frames, never
the estimate."""

STEPS_KEPT: Final = 4096
"""Over so many of the latest steps is the median of their times taken."""


class FrameSink(Protocol):
    """Takes the frames that were received."""

    def write(self, message: can.Message) -> None:
        """Take one frame."""


@dataclass(frozen=True)
class LoopSettings:
    """When the service calls its input stale, and when it ends by itself.

    Parameters
    ----------
    timeout_s : float
        Without a sample for so long, the estimate is published as stale [s].
    duration_s, until_idle_s : float, optional
        End after this time; end when samples came and then none for so long [s].
    """

    timeout_s: float = 2.0
    duration_s: float | None = None
    until_idle_s: float | None = None


@dataclass(frozen=True)
class Outputs:
    """Where frames and estimates go besides the bus.

    Parameters
    ----------
    record : FrameSink, optional
        Takes every frame that was received.
    table : callable, optional
        Takes the time [s] of every sample and the estimate after it.
    show : callable, optional
        Called with the monotonic time [s] after every frame and at every heartbeat.
    warn : callable, optional
        Takes a line of text.
    stepped : callable, optional
        Takes, after every sample, the receive stamp [s] of the frame that completed it, and the
        time that the estimate took [ns].
    sent : callable, optional
        Called after frames were sent.
    """

    record: FrameSink | None = None
    table: Callable[[float, Estimate], None] | None = None
    show: Callable[[float], None] | None = None
    warn: Callable[[str], None] | None = None
    stepped: Callable[[float, int], None] | None = None
    sent: Callable[[], None] | None = None


@dataclass(frozen=True)
class RunSummary:
    """What a run amounted to."""

    seconds: float
    cpu_seconds: float
    step_p50_us: float | None
    """Median time from a frame that completes a sample to its estimate [µs]."""


def serve(
    port: BusPort,
    gauge: Gauge,
    settings: LoopSettings,
    outputs: Outputs,
    stop: Callable[[], bool],
) -> RunSummary:
    """Receive, estimate and publish until told to stop.

    Parameters
    ----------
    port : BusPort
    gauge : Gauge
    settings : LoopSettings
    outputs : Outputs
    stop : callable
        Asked at least every `LOOK_EVERY_S`; True ends the loop.

    Returns
    -------
    RunSummary

    Raises
    ------
    BusError
        If the bus is gone.
    """
    loop = _Loop(port, gauge, settings, outputs)
    cpu = time.process_time()
    while not (stop() or loop.is_over()):
        loop.turn()
    loop.finish()
    return RunSummary(
        seconds=time.monotonic() - loop.began_s,
        cpu_seconds=time.process_time() - cpu,
        step_p50_us=statistics.median(loop.step_ns) / 1e3 if loop.step_ns else None,
    )


class _Loop:
    def __init__(
        self, port: BusPort, gauge: Gauge, settings: LoopSettings, outputs: Outputs
    ) -> None:
        self._port = port
        self._gauge = gauge
        self._settings = settings
        self._outputs = outputs
        self._ignores_clock = gauge.settings.time_source == "receive"
        if self._ignores_clock:
            # Listened for, to warn, until the first one.
            port.set_filters([*gauge.filters, standard_filter(gauge.settings.ids.replay_clock)])
        self.began_s = time.monotonic()
        self.step_ns: deque[int] = deque(maxlen=STEPS_KEPT)
        self._now_s = self.began_s
        self._beat_s = self.began_s
        self._sample_s = self.began_s

    def is_over(self) -> bool:
        settings = self._settings
        if settings.duration_s is not None and self._now_s - self.began_s >= settings.duration_s:
            return True
        return (
            settings.until_idle_s is not None
            and self._gauge.samples > 0
            and self._now_s - self._sample_s >= settings.until_idle_s
        )

    def turn(self) -> None:
        message = self._port.receive(min(max(self._beat_s - self._now_s, 0.0), LOOK_EVERY_S))
        if message is not None:
            self._take(message)
        self._now_s = time.monotonic()
        if self._now_s >= self._beat_s:
            is_stale = self._now_s - self._sample_s > self._settings.timeout_s
            self._send(self._gauge.heartbeat(is_stale=is_stale))
            self._beat_s = self._now_s + ESTIMATE_EVERY_S
        if self._outputs.show is not None:
            self._outputs.show(self._now_s)

    def finish(self) -> None:
        before = self._gauge.samples
        frames = self._gauge.finish()
        if self._gauge.samples != before:
            self._tell()
            self._send(frames)

    def _take(self, message: can.Message) -> None:
        gauge = self._gauge
        if self._ignores_clock and is_clock(message, gauge.settings.ids.replay_clock):
            self._warn_of_clock()
            return
        if self._outputs.record is not None:
            self._outputs.record.write(message)
        before, stamp_s = gauge.samples, message.timestamp
        began_ns = time.perf_counter_ns()
        frames = gauge.handle(message)
        if gauge.samples == before:
            return
        step_ns = time.perf_counter_ns() - began_ns
        self.step_ns.append(step_ns)
        if self._outputs.stepped is not None:
            self._outputs.stepped(stamp_s, step_ns)
        self._sample_s = time.monotonic()
        self._tell()
        if frames:
            self._send(frames)
            self._beat_s = self._sample_s + ESTIMATE_EVERY_S + LATE_S

    def _tell(self) -> None:
        sample = self._gauge.latest_sample
        if self._outputs.table is not None and sample is not None:
            self._outputs.table(sample.time_s, self._gauge.latest)

    def _send(self, frames: list[can.Message]) -> None:
        for frame in frames:
            self._port.send(frame, SEND_WITHIN_S)
        if frames and self._outputs.sent is not None:
            self._outputs.sent()

    def _warn_of_clock(self) -> None:
        self._ignores_clock = False
        self._port.set_filters(self._gauge.filters)
        if self._outputs.warn is not None:
            self._outputs.warn(
                "warning: a replay tells its own time on this bus (REPLAY_CLOCK), but frames are"
                " taken by their receive stamps; for the log's time run with"
                " --time-source replay-clock"
            )

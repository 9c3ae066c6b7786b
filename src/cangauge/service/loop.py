"""The service's loop: receive frames, hand them to the pipeline, send its frames.

Only the loop reads a clock, a monotonic one: to publish periodically, to detect stale input, and
to replace time stamps that cannot be true. It also saves checkpoints, reloads the configuration,
reports frames lost in the receive queue, and detects another sender of the same ids, which would
make the published SoC jump between two values.
"""

from __future__ import annotations

import logging
import math
import statistics
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

import can
from can.typechecking import CanFilter

from cangauge._logging import emit
from cangauge.bus.connection import BusConnection
from cangauge.bus.decoder import SUSPECTED_FOR_S
from cangauge.bus.polling import Poller
from cangauge.bus.publish import ESTIMATE_EVERY_S, FrameIds, standard_filter
from cangauge.bus.time_source import (
    DRIVER_TOLERANCE_S,
    KERNEL_TOLERANCE_S,
    StampLimiter,
    is_clock,
    steady_s,
)
from cangauge.errors import CangaugeError
from cangauge.service.pipeline import Pipeline
from cangauge.types import Estimate, Reason

_LOG = logging.getLogger(__name__)

LATE_S: Final = 0.01
"""Longest delay of a heartbeat for a sample that is due [s]."""

HOUSEKEEPING_EVERY_S: Final = 0.01
"""Shortest interval of housekeeping, under continuous traffic [s]."""

LONGEST_WAIT_S: Final = 0.1
"""Longest wait for frames, and longest interval of housekeeping [s]."""

SEND_WITHIN_S: Final = 0.1
"""Longest time that a frame waits for room in the transmit queue [s]: until the next one is due.
The loop itself never waits: a full queue (no other node on the bus) costs frames, not the
estimate."""

SAID_FROM_S: Final = 1.0
"""Smallest step of the stamps' clock that is logged [s]; smaller ones are its drift."""

STEPS_KEPT: Final = 4096
"""Latest steps whose durations enter the median."""

CHECKPOINT_EVERY_S: Final = 10.0
"""Interval of checkpoints [s]. A service that is killed and restarts within three seconds misses
less than half a minute of charge; 20 kB per checkpoint make 0.2 GB a day."""

FIRST_CHECKPOINT_S: Final = 1.0
"""Time of the first checkpoint [s]: early, for a service that is killed repeatedly."""

DUPLICATE_FRAMES: Final = 3
DUPLICATE_WITHIN_S: Final = 5.0
"""Foreign frames with own ids within this time [s] that prove another sender."""

DUPLICATE_WARN_EVERY_S: Final = 600.0
"""Shortest interval of warnings about it [s]."""

_SENT_KEPT: Final = 64


class FrameSink(Protocol):
    """Consumer of received frames."""

    def write(self, message: can.Message) -> None:
        """Take one frame."""


@dataclass(frozen=True)
class LoopSettings:
    """Time-outs of the loop.

    Parameters
    ----------
    timeout_s : float
        Time without a sample after which the estimate is published as stale [s].
    duration_s, until_idle_s : float, optional
        End after this time; end after a silence of this length that follows samples [s].
    checkpoint_every_s : float
        Interval of checkpoints [s].
    poll_every_s : float, optional
        Ask for the vehicle's replies over ISO-TP every so often [s].
    """

    timeout_s: float = 2.0
    duration_s: float | None = None
    until_idle_s: float | None = None
    checkpoint_every_s: float = CHECKPOINT_EVERY_S
    poll_every_s: float | None = None


@dataclass(frozen=True)
class Outputs:
    """Consumers of the loop's results besides the bus; all optional.

    Parameters
    ----------
    record : FrameSink
        Takes every received frame that is input.
    table : callable
        Takes the time [s] of every sample and the estimate after it.
    stepped : callable
        Takes, after the last sample of each batch of frames: the receive stamp [s] of the frame
        that completed it, the mean processing time of the batch's samples [s], and the monotonic
        time at which that frame came in [s].
    sent : callable
        Called after frames were sent.
    show : callable
        Called with the monotonic time [s] at least every `LONGEST_WAIT_S`.
    checkpoint : callable
        Saves the state, every `checkpoint_every_s` and at the end after the last estimate. Its
        OSError and CangaugeError are logged.
    reload : callable
        Called at least every `LONGEST_WAIT_S`; returns the loop's new settings once the pipeline
        has another configuration.
    """

    record: FrameSink | None = None
    table: Callable[[float, Estimate], None] | None = None
    stepped: Callable[[float, float, float], None] | None = None
    sent: Callable[[], None] | None = None
    show: Callable[[float], None] | None = None
    checkpoint: Callable[[], None] | None = None
    reload: Callable[[], LoopSettings | None] | None = None


@dataclass(frozen=True)
class RunSummary:
    """Result of a run."""

    seconds: float
    cpu_seconds: float
    step_p50_us: float | None
    """Median time from receiving a frame that completes a sample to having processed it [µs]; the
    mean counts for frames received together."""
    foreign_frames: int = 0
    """Frames with this service's ids from another sender."""


def serve(
    port: BusConnection,
    pipeline: Pipeline,
    settings: LoopSettings,
    outputs: Outputs,
    stop: Callable[[], bool],
) -> RunSummary:
    """Receive, estimate and publish until stopped.

    Parameters
    ----------
    port : BusConnection
    pipeline : Pipeline
    settings : LoopSettings
    outputs : Outputs
    stop : callable
        Called at least every `LONGEST_WAIT_S`; True ends the loop.

    Returns
    -------
    RunSummary

    Raises
    ------
    BusError
        If the bus is lost. A `ReconnectingBus` waits until it is back instead.
    """
    loop = _Loop(port, pipeline, settings, outputs)
    cpu = time.process_time()
    try:
        while not (stop() or loop.is_over()):
            loop.turn()
        loop.finish()
    finally:
        loop.housekeeping.save()
    return RunSummary(
        seconds=time.monotonic() - loop.began_s,
        cpu_seconds=time.process_time() - cpu,
        step_p50_us=1e6 * statistics.median(loop.step_s) if loop.step_s else None,
        foreign_frames=loop.duplicates.frames,
    )


class _Loop:
    def __init__(
        self, port: BusConnection, pipeline: Pipeline, settings: LoopSettings, outputs: Outputs
    ) -> None:
        self._port = port
        self._pipeline = pipeline
        self._settings = settings
        self._outputs = outputs
        self.duplicates = DuplicateSenderDetector(
            pipeline.settings.ids, echoes=port.capabilities.echoes
        )
        self._asked = OwnEchoes(echoes=port.capabilities.echoes)
        self._poller = self._make_poller()
        self.housekeeping = Housekeeping(port, outputs.checkpoint, settings.checkpoint_every_s)
        # With receive stamps REPLAY_CLOCK is no input; it is received once, for a warning.
        self._ignores_clock = pipeline.settings.time_source == "receive"
        self._expects_clock = self._ignores_clock
        self._stamps = _limiter(port)
        self._stamps_are_arrival = port.capabilities.stamps != "driver"
        # The receive queue was empty at some time after the first; the latest turn received at the
        # second.
        self._drained_s = self._received_s = steady_s()
        self._shift_s = 0.0
        self._reported: set[str] = set()
        self._foreign_ids: frozenset[int] = frozenset()
        self._set_filters()
        self.began_s = time.monotonic()
        self.step_s: deque[float] = deque(maxlen=STEPS_KEPT)
        self._now_s = self.began_s
        self._beat_s = self.began_s
        self._housekeeping_s = self.began_s
        # Times at which the latest sample was processed and received. They differ while frames wait
        # in the socket, after the process was suspended or under load.
        self._sample_s = self.began_s
        self._came_s = self.began_s

    def is_over(self) -> bool:
        settings = self._settings
        if settings.duration_s is not None and self._now_s - self.began_s >= settings.duration_s:
            return True
        return (
            settings.until_idle_s is not None
            and self._pipeline.samples > 0
            and self._now_s - self._sample_s >= settings.until_idle_s
        )

    def turn(self) -> None:
        """Receive once, process the frames, and do what is due."""
        left_s = self._beat_s + LATE_S - self._now_s
        messages = self._port.receive_pending(min(max(left_s, 0.0), LONGEST_WAIT_S))
        # Reading the clock may be a system call: once per turn, and again after samples.
        self._now_s = time.monotonic()
        before = self._pipeline.samples
        received_s = steady_s()
        if messages:
            self._process(messages, received_s)
        if self._port.is_drained:
            self._drained_s = self._received_s
        self._received_s = received_s
        late_s = 0.0 if self._pipeline.samples != before else LATE_S
        if self._now_s >= self._beat_s + late_s:
            self._beat()
        if self._poller is not None:
            self._ask(self._poller.due(self._now_s))
        if self._now_s >= self._housekeeping_s:
            self._housekeeping_s = self._now_s + HOUSEKEEPING_EVERY_S
            self._run_housekeeping()

    def finish(self) -> None:
        """Flush the pipeline and publish the last estimate."""
        before = self._pipeline.samples
        frames = self._pipeline.finish()
        if self._pipeline.samples != before:
            self._write_row()
            self._send(frames)

    def _process(self, messages: list[can.Message], now_s: float) -> None:
        pipeline, record, table = self._pipeline, self._outputs.record, self._outputs.table
        before, taken, stamp_s = pipeline.samples, pipeline.taken, math.nan
        stamps = [message.timestamp for message in messages]
        lag_s = now_s - self._stamps.limit(messages, self._drained_s, now_s)
        for message, received_s in zip(messages, stamps, strict=True):
            if message.arbitration_id in self._foreign_ids and self._is_foreign(message):
                continue
            if record is not None:
                record.write(message)
            if self._poller is not None and message.arbitration_id in self._poller.reply_ids:
                self._ask(self._poller.take(message, self._now_s))
            if not pipeline.handle(message):
                continue
            stamp_s = received_s
            if table is not None:
                self._write_row()
            if frames := pipeline.acknowledgement():
                self._send(frames)
                self._beat_s = self._now_s + ESTIMATE_EVERY_S
        if pipeline.samples != before:
            self._sample_s = self._now_s
        if pipeline.taken != taken:
            self._note_samples(pipeline.taken - taken, stamp_s, lag_s)

    def _is_foreign(self, message: can.Message) -> bool:
        """Handle a frame with an id that is not the vehicle's; return False if it is input."""
        if self.duplicates.handle(message, self._now_s):
            self._port.foreign = self.duplicates.frames
            return True
        poller = self._poller
        if poller is not None and message.arbitration_id in poller.request_ids:
            if message.is_extended_id:
                return False
            if not self._asked.take(message):
                poller.note_other_tester(self._now_s)
            return True
        if self._ignores_clock and is_clock(message, self._pipeline.settings.ids.replay_clock):
            if self._expects_clock:
                self._expects_clock = False
                self._set_filters()
                emit(
                    _LOG,
                    logging.WARNING,
                    "bus.replay_clock_ignored",
                    "a replay sends its log's time on this bus (REPLAY_CLOCK), but this service"
                    " uses receive stamps; to use the log's time, run with"
                    " --time-source replay-clock",
                )
            return True
        return False

    def _note_samples(self, samples: int, stamp_s: float, lag_s: float) -> None:
        before_s, self._now_s = self._now_s, time.monotonic()
        step_s = (self._now_s - before_s) / samples
        self._came_s = before_s - lag_s if self._stamps_are_arrival else before_s
        self.step_s.append(step_s)
        if self._outputs.stepped is not None:
            self._outputs.stepped(stamp_s, step_s, self._came_s)

    def _write_row(self) -> None:
        sample = self._pipeline.latest_sample
        if self._outputs.table is not None and sample is not None:
            self._outputs.table(sample.time_s, self._pipeline.latest)

    def _beat(self) -> None:
        silent_s = self._now_s - self._came_s
        is_stale = silent_s > max(self._settings.timeout_s, self._pipeline.least_timeout_s)
        reasons = self._report_findings()
        self._send(self._pipeline.heartbeat(is_stale=is_stale, silent_s=silent_s, reasons=reasons))
        # Stay on the clock's grid; skip beats missed while the process was suspended.
        missed = max(math.floor((self._now_s - self._beat_s) / ESTIMATE_EVERY_S), 0)
        self._beat_s += (missed + 1) * ESTIMATE_EVERY_S

    def _report_findings(self) -> Reason:
        """Log what is new about time and other senders; return the reasons to publish."""
        stamps, reasons, found = self._stamps, Reason.NONE, {}
        if stamps.shift_s != self._shift_s:
            step_s, self._shift_s = self._shift_s - stamps.shift_s, stamps.shift_s
            self._pipeline.stamp_shift_s = stamps.shift_s
            if abs(step_s) >= SAID_FROM_S:
                emit(
                    _LOG,
                    logging.WARNING,
                    "bus.clock_set",
                    f"the clock of the time stamps was set by {step_s:+.1f} s; bus time follows"
                    " the monotonic clock",
                    step_s=step_s,
                )
        if stamps.is_uncertain(steady_s()):
            reasons |= Reason.TIME_UNCERTAIN
            found["bus.time_uncertain"] = (
                "the time stamps of the frames contradict the monotonic clock; the time of"
                " receiving is used instead"
            )
        if self.duplicates.is_active(self._now_s):
            reasons |= Reason.DUPLICATE_SENDER
        for name in self._pipeline.decoder.two_sender_messages:
            found[f"bus.two_senders {name}"] = (
                f"two senders use the id of {name}: its frames are refused until one of them"
                " stops; is somebody else on the bus? (If one sender sends it more often than"
                " the DBC states, give its shortest period_s in the map file)"
            )
        for event in found.keys() - self._reported:
            emit(_LOG, logging.WARNING, event.split()[0], found[event], limit=event)
        self._reported = set(found)
        return reasons

    def _send(self, frames: list[can.Message]) -> None:
        for frame in frames:
            self.duplicates.note_sent(frame)
            self._port.post(frame, SEND_WITHIN_S)
        if frames and self._outputs.sent is not None:
            self._outputs.sent()

    def _make_poller(self) -> Poller | None:
        every_s, targets = self._settings.poll_every_s, self._pipeline.vehicle.poll_targets
        poller = None if every_s is None or not targets else Poller(targets, every_s)
        self._port.polls = None if poller is None else poller.counts
        return poller

    def _ask(self, frame: can.Message | None) -> None:
        """Send a request or a flow control, if there is one."""
        if frame is not None:
            self._asked.note_sent(frame)
            self._port.post(frame, SEND_WITHIN_S)

    def _run_housekeeping(self) -> None:
        self.housekeeping.run(self._now_s)
        if self._outputs.reload is not None and (settings := self._outputs.reload()) is not None:
            self._settings = settings
            self._poller = self._make_poller()
            self.housekeeping.every_s = settings.checkpoint_every_s
            self.duplicates.watch(self._pipeline.settings.ids)
            self._set_filters()
        if self._outputs.show is not None:
            self._outputs.show(self._now_s)

    def _set_filters(self) -> None:
        clock_id = self._pipeline.settings.ids.replay_clock
        wanted = [*self._pipeline.filters, *self.duplicates.filters]
        if self._expects_clock:
            wanted.append(standard_filter(clock_id))
        self._foreign_ids = self.duplicates.ids | ({clock_id} if self._ignores_clock else set())
        if self._poller is not None:
            self._foreign_ids |= self._poller.request_ids
            wanted += map(standard_filter, sorted(self._poller.request_ids))
        self._port.set_filters(wanted)


def _limiter(port: BusConnection) -> StampLimiter:
    """Return the limiter for the stamps of a bus."""
    if port.capabilities.stamps == "driver":
        return StampLimiter(DRIVER_TOLERANCE_S)
    return StampLimiter(KERNEL_TOLERANCE_S, time.time() - steady_s())


class Housekeeping:
    """Save checkpoints and report frames lost in the receive queue.

    Parameters
    ----------
    port : BusConnection
    checkpoint : callable, optional
        Saves the state; called after `FIRST_CHECKPOINT_S`, then every `every_s`.
    every_s : float
        Interval of checkpoints [s]; may be changed.
    """

    def __init__(
        self,
        port: BusConnection,
        checkpoint: Callable[[], None] | None = None,
        every_s: float = CHECKPOINT_EVERY_S,
    ) -> None:
        self._port = port
        self._checkpoint = checkpoint
        self.every_s = every_s
        self._look_s = 0.0
        self._save_s: float | None = None
        self._drops = 0

    def run(self, now_s: float) -> None:
        """Do the tasks due at a monotonic time [s]."""
        if now_s < self._look_s:
            return
        self._look_s = now_s + LONGEST_WAIT_S
        drops = self._port.queue_drops or 0
        if drops > self._drops:
            lost, self._drops = drops - self._drops, drops
            emit(
                _LOG,
                logging.WARNING,
                "bus.queue_overflow",
                f"{self._port.name}: the receive queue overflowed: {lost} frames lost"
                f" ({drops} so far)",
            )
        if self._save_s is None:
            self._save_s = now_s + min(FIRST_CHECKPOINT_S, self.every_s)
        elif now_s >= self._save_s:
            self._save_s = now_s + self.every_s
            self.save()

    def save(self) -> None:
        """Save a checkpoint; a failure (a full disk) is logged and does not stop the service."""
        if self._checkpoint is None:
            return
        try:
            self._checkpoint()
        except (OSError, CangaugeError) as error:
            emit(_LOG, logging.WARNING, "state.not_saved", f"the state could not be saved: {error}")


class OwnEchoes:
    """Distinguish own frames that a bus returns from those of others.

    Parameters
    ----------
    echoes : bool
        Whether the bus returns own frames (see `BackendCapabilities`).
    """

    def __init__(self, *, echoes: bool) -> None:
        self._echoes = echoes
        self._sent: deque[tuple[int, bytes]] = deque(maxlen=_SENT_KEPT)

    def note_sent(self, message: can.Message) -> None:
        """Record an own frame, whose echo may be received."""
        if self._echoes:
            self._sent.append((message.arbitration_id, bytes(message.data)))

    def take(self, message: can.Message) -> bool:
        """Return whether a received frame is the echo of an own one, which is then forgotten."""
        frame = (message.arbitration_id, bytes(message.data))
        if frame not in self._sent:
            return False
        # Each echo comes once and in order; skipped ones are lost. So identical frames of another
        # sender are detected as well: as surplus echoes.
        while self._sent.popleft() != frame:
            pass
        return True


class DuplicateSenderDetector:
    """Detect frames with this service's ids from another sender.

    Parameters
    ----------
    ids : FrameIds
        Ids that this service publishes.
    echoes : bool
        Whether the bus returns own frames (see `BackendCapabilities`).

    Attributes
    ----------
    frames : int
        Number of such frames.
    ids : frozenset of int
        The ids watched.
    """

    def __init__(self, ids: FrameIds, *, echoes: bool) -> None:
        self.frames = 0
        self._echoes = OwnEchoes(echoes=echoes)
        self._seen_s: deque[float] = deque(maxlen=DUPLICATE_FRAMES)
        self._quiet_until_s = self._active_until_s = -math.inf
        self.watch(ids)

    def watch(self, ids: FrameIds) -> None:
        """Watch for these ids from now on."""
        self.ids = frozenset(ids.published)

    @property
    def filters(self) -> list[CanFilter]:
        """Filters for the frames to be received."""
        return [standard_filter(each) for each in sorted(self.ids)]

    def is_active(self, now_s: float) -> bool:
        """Return whether another sender was proven lately, at a monotonic time [s]."""
        return now_s < self._active_until_s

    def note_sent(self, message: can.Message) -> None:
        """Record an own frame, whose echo may be received."""
        self._echoes.note_sent(message)

    def handle(self, message: can.Message, now_s: float) -> bool:
        """Return whether a received frame has an own id, and hence is not input.

        Parameters
        ----------
        message : can.Message
        now_s : float
            Monotonic time [s].
        """
        if message.arbitration_id not in self.ids or message.is_extended_id:
            return False
        if not self._echoes.take(message):
            self._count(message.arbitration_id, now_s)
        return True

    def _count(self, frame_id: int, now_s: float) -> None:
        self.frames += 1
        self._seen_s.append(now_s)
        is_proven = (
            len(self._seen_s) == DUPLICATE_FRAMES and now_s - self._seen_s[0] <= DUPLICATE_WITHIN_S
        )
        if is_proven:
            self._active_until_s = now_s + SUSPECTED_FOR_S
        if is_proven and now_s >= self._quiet_until_s:
            self._quiet_until_s = now_s + DUPLICATE_WARN_EVERY_S
            emit(
                _LOG,
                logging.WARNING,
                "bus.duplicate_sender",
                f"another node on this bus sends 0x{frame_id:X}, which this service publishes:"
                " is a second service running? Give one of them other ids ([ids], or"
                " --soc-estimate-id, --soc-detail-id, --soc-health-id, --soc-power-id,"
                " --soc-cells-id)",
                always=True,
            )

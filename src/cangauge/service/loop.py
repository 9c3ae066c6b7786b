"""Noticing that somebody else sends the frames that this service publishes.

Two services with the same ids leave whoever reads them with a SoC that jumps between two values.

What the loop does now and then beside its frames: saves, re-reads, tells of losses.

The receive loop: receives, hands to the gauge, sends.

It alone knows a clock, a monotonic one: for the rate of publishing, and to notice silence.
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
from cangauge.bus.publish import ESTIMATE_EVERY_S, FrameIds, standard_filter
from cangauge.bus.time_source import is_clock
from cangauge.errors import CangaugeError
from cangauge.estimate.validity import Estimate
from cangauge.service.pipeline import Gauge

_LOG = logging.getLogger(__name__)

# --- Noticing that somebody else sends the frames that this service publishes

SEEN: Final = 3
"""So many frames within `WITHIN_S` are no accident."""

WITHIN_S: Final = 5.0
AGAIN_S: Final = 600.0
"""While it lasts, it is warned of so often [s]."""

_REMEMBERED: Final = 64


class DuplicateSenderDetector:
    """Tells one's own frames that come back from those of others.

    Parameters
    ----------
    ids : FrameIds
        What this service publishes.
    echoes : bool
        Whether the bus hands one's own frames back (see `BackendCapabilities`).
    warn : callable, optional
        Takes a line of text.

    Attributes
    ----------
    frames : int
        Frames with own ids that others sent.
    ids : frozenset of int
        What it looks out for.
    """

    def __init__(self, ids: FrameIds, *, echoes: bool) -> None:
        self.frames = 0
        self._echoes = echoes
        self._sent: deque[tuple[int, bytes]] = deque(maxlen=_REMEMBERED)
        self._seen_s: deque[float] = deque(maxlen=SEEN)
        self._quiet_until_s = -math.inf
        self.use(ids)

    def use(self, ids: FrameIds) -> None:
        """Look out for these ids from now on."""
        self.ids = frozenset({ids.soc_estimate, ids.soc_detail})

    @property
    def filters(self) -> list[CanFilter]:
        """What must be received to notice them."""
        return [standard_filter(each) for each in sorted(self.ids)]

    def sent(self, message: can.Message) -> None:
        """Note a frame of one's own."""
        if self._echoes:
            self._sent.append((message.arbitration_id, bytes(message.data)))

    def takes(self, message: can.Message, now_s: float) -> bool:
        """Return whether a received frame has an own id: it is then no input.

        Parameters
        ----------
        message : can.Message
        now_s : float
            Monotonic time [s].
        """
        if message.arbitration_id not in self.ids or message.is_extended_id:
            return False
        if not self._is_echo(message):
            self._note(message.arbitration_id, now_s)
        return True

    def _is_echo(self, message: can.Message) -> bool:
        frame = (message.arbitration_id, bytes(message.data))
        if frame not in self._sent:
            return False
        # Each comes back once, in the order sent; those before it were lost. So a rival who sends
        # the very same frames is noticed as well: by then one's own are one too many.
        while self._sent.popleft() != frame:
            pass
        return True

    def _note(self, frame_id: int, now_s: float) -> None:
        self.frames += 1
        self._seen_s.append(now_s)
        is_many = len(self._seen_s) == SEEN and now_s - self._seen_s[0] <= WITHIN_S
        if is_many and now_s >= self._quiet_until_s:
            self._quiet_until_s = now_s + AGAIN_S
            emit(
                _LOG,
                logging.WARNING,
                "bus.duplicate_sender",
                f"somebody else sends 0x{frame_id:X} on this bus, which this service"
                " publishes: is another one running? Give one of them other ids"
                " (--soc-estimate-id, --soc-detail-id)",
            )


# --- What the loop does now and then beside its frames: saves, re-reads, tells of losses

LOOK_EVERY_S: Final = 0.1

CHECKPOINT_EVERY_S: Final = 10.0
"""How often the state is saved [s]: a service that is killed, writes for a while and takes three
seconds to start again then has missed less than half a minute of charge, however it flowed. A
state of 20 kB makes 0.2 GB of writing a day."""

FIRST_CHECKPOINT_S: Final = 1.0
"""The first checkpoint comes so soon, lest a service that is killed again and again keeps nothing
[s]."""


class Housekeeping:
    """Looks after what needs no more than a glance every `LOOK_EVERY_S`.

    Parameters
    ----------
    port : BusConnection
        Whose receive queue is watched.
    checkpoint : callable, optional
        Saves the state; called after `FIRST_CHECKPOINT_S`, every `every_s`, and at the end.
    every_s : float
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

    def look(self, now_s: float) -> None:
        """Do what is due (monotonic time [s])."""
        if now_s < self._look_s:
            return
        self._look_s = now_s + LOOK_EVERY_S
        self._watch_queue()
        if self._save_s is None:
            self._save_s = now_s + min(FIRST_CHECKPOINT_S, self.every_s)
        elif now_s >= self._save_s:
            self._save_s = now_s + self.every_s
            self._save()

    def finish(self) -> None:
        """Save for the last time."""
        self._save()

    def _watch_queue(self) -> None:
        drops = self._port.queue_drops or 0
        if drops > self._drops:
            emit(
                _LOG,
                logging.WARNING,
                "bus.queue_overflow",
                f"{self._port.name}: the receive queue overflowed:"
                f" {drops - self._drops} frames lost ({drops} so far)",
            )
            self._drops = drops

    def _save(self) -> None:
        if self._checkpoint is None:
            return
        try:
            self._checkpoint()
        except (OSError, CangaugeError) as error:
            # A full disk must not stop the estimate.
            emit(_LOG, logging.WARNING, "state.failed", f"the state could not be saved: {error}")


# --- The receive loop: receives, hands to the gauge, sends

LATE_S: Final = 0.01
"""So much later than due a beat may come, so that it tells of a sample that is about to [s]."""

GLANCE_EVERY_S: Final = 0.01
"""While frames come, whatever else there is to do is looked after so often [s], not each time."""


SEND_WITHIN_S: Final = 0.1
"""How long a frame may wait for room in the transmit queue [s]: by then the next one is due.
Nothing waits for it: a full queue (nobody else on the bus) costs frames, never the estimate."""

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
    checkpoint_every_s : float
        How often the state is saved [s].
    """

    timeout_s: float = 2.0
    duration_s: float | None = None
    until_idle_s: float | None = None
    checkpoint_every_s: float = CHECKPOINT_EVERY_S


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
        Called with the monotonic time [s] every `LOOK_EVERY_S` at least.
    checkpoint : callable, optional
        Saves the state: called every `checkpoint_every_s`, and at the end after the last estimate.
        What it raises as OSError or CangaugeError is a warning.
    reload : callable, optional
        Asked like `stop`; if the gauge has been given another configuration, it returns the
        loop's.
    stepped : callable, optional
        Takes, after every sample, or where several frames waited after the last of theirs, the
        receive stamp [s] of the frame that completed it, the time from receiving to having taken
        it in [s] (the mean of them), and the monotonic time at which that frame came in [s].
    sent : callable, optional
        Called after frames were sent.
    """

    record: FrameSink | None = None
    table: Callable[[float, Estimate], None] | None = None
    show: Callable[[float], None] | None = None
    checkpoint: Callable[[], None] | None = None
    reload: Callable[[], LoopSettings | None] | None = None
    stepped: Callable[[float, float, float], None] | None = None
    sent: Callable[[], None] | None = None


@dataclass(frozen=True)
class RunSummary:
    """What a run amounted to."""

    seconds: float
    cpu_seconds: float
    step_p50_us: float | None
    """Median time from receiving a frame that completes a sample to having taken that in [µs]; of
    frames that waited together the mean counts."""
    rival_frames: int = 0
    """Frames with this service's ids that somebody else sent."""


def serve(
    port: BusConnection,
    gauge: Gauge,
    settings: LoopSettings,
    outputs: Outputs,
    stop: Callable[[], bool],
) -> RunSummary:
    """Receive, estimate and publish until told to stop.

    Parameters
    ----------
    port : BusConnection
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
        If the bus is gone (never with a `ReconnectingBus`, which waits until it is back).
    """
    loop = _Loop(port, gauge, settings, outputs)
    cpu = time.process_time()
    try:
        while not (stop() or loop.is_over()):
            loop.turn()
        loop.finish()
    finally:
        loop.save()
    return RunSummary(
        seconds=time.monotonic() - loop.began_s,
        cpu_seconds=time.process_time() - cpu,
        step_p50_us=1e6 * statistics.median(loop.step_s) if loop.step_s else None,
        rival_frames=loop.rivals.frames,
    )


class _Loop:
    def __init__(
        self, port: BusConnection, gauge: Gauge, settings: LoopSettings, outputs: Outputs
    ) -> None:
        self._port = port
        self._gauge = gauge
        self._settings = settings
        self._outputs = outputs
        self.rivals = DuplicateSenderDetector(gauge.settings.ids, echoes=port.capabilities.echoes)
        self._upkeep = Housekeeping(port, outputs.checkpoint, settings.checkpoint_every_s)
        self._ignores_clock = self._awaits_clock = gauge.settings.time_source == "receive"
        self._stamps_are_wall_time = port.capabilities.stamps == "kernel"
        self._no_input: frozenset[int] = frozenset()
        self._set_filters()
        self.began_s = time.monotonic()
        self.step_s: deque[float] = deque(maxlen=STEPS_KEPT)
        self._now_s = self.began_s
        self._beat_s = self.began_s
        self._glance_s = self.began_s
        # When the latest sample was taken, and when it had come in: while the service lags behind
        # (after a pause, under load) frames wait in the socket, and are old when they are read.
        self._sample_s = self.began_s
        self._came_s = self.began_s

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
        left_s = self._beat_s + LATE_S - self._now_s
        messages = self._port.receive_pending(min(max(left_s, 0.0), LOOK_EVERY_S))
        # The clock is asked once a turn and once more if there was a sample: where it takes a
        # system call that is not little.
        self._now_s = time.monotonic()
        before = self._gauge.samples
        if messages:
            self._take(messages)
        late_s = 0.0 if self._gauge.samples != before else LATE_S
        if self._now_s >= self._beat_s + late_s:
            self._beat()
        if self._now_s >= self._glance_s:
            self._glance_s = self._now_s + GLANCE_EVERY_S
            self._look_after_others()

    def _look_after_others(self) -> None:
        self._upkeep.look(self._now_s)
        if self._outputs.reload is not None and (settings := self._outputs.reload()) is not None:
            self._settings = settings
            self._upkeep.every_s = settings.checkpoint_every_s
            self.rivals.use(self._gauge.settings.ids)
            self._set_filters()
        if self._outputs.show is not None:
            self._outputs.show(self._now_s)

    def _beat(self) -> None:
        gauge, silent_s = self._gauge, self._now_s - self._came_s
        is_stale = silent_s > max(self._settings.timeout_s, gauge.patience_s)
        self._send(gauge.heartbeat(is_stale=is_stale, silent_s=silent_s))
        # On the grid of the clock, whatever came when; beats that were slept through are left out.
        missed = max(math.floor((self._now_s - self._beat_s) / ESTIMATE_EVERY_S), 0)
        self._beat_s += (missed + 1) * ESTIMATE_EVERY_S

    def finish(self) -> None:
        before = self._gauge.samples
        frames = self._gauge.finish()
        if self._gauge.samples != before:
            self._tell()
            self._send(frames)

    def save(self) -> None:
        self._upkeep.finish()

    def _take(self, messages: list[can.Message]) -> None:
        gauge, record, table = self._gauge, self._outputs.record, self._outputs.table
        before, stamp_s = gauge.samples, math.nan
        for message in messages:
            if message.arbitration_id in self._no_input and self._is_no_input(message):
                continue
            if record is not None:
                record.write(message)
            received_s = message.timestamp
            if not gauge.take(message):
                continue
            stamp_s = received_s
            if table is not None:
                self._tell()
            if frames := gauge.acknowledgement():
                self._send(frames)
                self._beat_s = self._now_s + ESTIMATE_EVERY_S
        if gauge.samples != before:
            self._note_samples(gauge.samples - before, stamp_s)

    def _is_no_input(self, message: can.Message) -> bool:
        """Whether a frame with an id that is not a vehicle's is to be left out; then see to it."""
        if self.rivals.takes(message, self._now_s):
            return True
        if self._ignores_clock and is_clock(message, self._gauge.settings.ids.replay_clock):
            if self._awaits_clock:
                self._warn_of_clock()
            return True
        return False

    def _note_samples(self, samples: int, stamp_s: float) -> None:
        before_s, self._now_s = self._now_s, time.monotonic()
        self._sample_s, step_s = self._now_s, (self._now_s - before_s) / samples
        lag_s = max(time.time() - stamp_s, 0.0) if self._stamps_are_wall_time else 0.0
        self._came_s = self._now_s - lag_s
        self.step_s.append(step_s)
        if self._outputs.stepped is not None:
            self._outputs.stepped(stamp_s, step_s, self._came_s)

    def _tell(self) -> None:
        sample = self._gauge.latest_sample
        if self._outputs.table is not None and sample is not None:
            self._outputs.table(sample.time_s, self._gauge.latest)

    def _send(self, frames: list[can.Message]) -> None:
        for frame in frames:
            self.rivals.sent(frame)
            self._port.post(frame, SEND_WITHIN_S)
        if frames and self._outputs.sent is not None:
            self._outputs.sent()

    def _set_filters(self) -> None:
        clock_id = self._gauge.settings.ids.replay_clock
        wanted = [*self._gauge.filters, *self.rivals.filters]
        if self._awaits_clock:
            # Listened for, to warn, until the first one.
            wanted.append(standard_filter(clock_id))
        self._no_input = self.rivals.ids | ({clock_id} if self._ignores_clock else set())
        self._port.set_filters(wanted)

    def _warn_of_clock(self) -> None:
        self._awaits_clock = False
        self._set_filters()
        emit(
            _LOG,
            logging.WARNING,
            "bus.replay_clock",
            "a replay sends its own time on this bus (REPLAY_CLOCK), but frames are"
            " taken by their receive stamps; for the log's time run with"
            " --time-source replay-clock",
        )

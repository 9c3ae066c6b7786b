"""The service's loop: receive frames, hand them to the pipeline, send its frames.

Only the loop reads a clock, a monotonic one: to publish periodically, to detect stale input, and
to replace time stamps that cannot be true.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import partial
from typing import Final

import can

from cangauge._logging import emit
from cangauge.bus.connection import BusConnection
from cangauge.bus.publish import ESTIMATE_EVERY_S, standard_filter
from cangauge.bus.time_source import TOLERANCE_S, StampLimiter, log_time_us, steady_s
from cangauge.service.config import RunConfig
from cangauge.service.output import Output
from cangauge.service.own_frames import OwnFrames
from cangauge.service.pipeline import Pipeline
from cangauge.service.polling import SLOWEST_S, Poller
from cangauge.service.status import Monitor
from cangauge.types import Reason

_LOG = logging.getLogger(__name__)
_warn = partial(emit, _LOG.warning)

LATE_S: Final = 0.01
"""Longest time that due frames wait for a sample to arrive [s]."""
FIRST_CHECKPOINT_S: Final = 1.0
"""Time of the first checkpoint [s]: early, for a service that is killed repeatedly."""

_REASONS: Final = {
    "bus.time_uncertain": Reason.TIME_UNCERTAIN,
    "bus.unsigned_current": Reason.IMPLAUSIBLE_INPUT,
}
"""Reasons in the frames while something is wrong, by event."""


@dataclass(eq=False)
class Loop:
    """The receive loop.

    Parameters
    ----------
    port : BusConnection
    pipeline : Pipeline
    config : RunConfig
        Its time-outs, and the intervals of checkpoints and of requests over ISO-TP.
    outputs : sequence of Output
    monitor : Monitor, optional
    checkpoint : callable, optional
        Starts to save the state: every `state_every_s`, and at the end.
    reload : callable, optional
        Called every `ESTIMATE_EVERY_S` or sooner; returns the new configuration once the pipeline
        uses it.

    Notes
    -----
    Times are monotonic ones [s]: `last` means when it was, `due` when it is next. Those of
    receiving are steady ones (`steady_s`), which count a suspended machine too, as stamps do.
    """

    port: BusConnection
    pipeline: Pipeline
    config: RunConfig
    _: KW_ONLY
    outputs: Sequence[Output] = ()
    monitor: Monitor | None = None
    checkpoint: Callable[[], None] | None = None
    reload: Callable[[], RunConfig | None] | None = None

    def __post_init__(self) -> None:
        port = self.port
        # The outputs that do something with the news, by the method that takes it.
        self._takers = {
            method: [each for each in self.outputs if _overrides(each, method)]
            for method in ("on_frame", "on_sample", "on_snapshot")
        }
        self._monitor = self.monitor or Monitor(self.pipeline, port)
        self._published = OwnFrames(echoes=port.address.echoes)
        self._requested = OwnFrames(echoes=port.address.echoes)
        self._stamps_are_arrival = port.address.stamps != "driver"
        offset_s = time.time() - steady_s() if self._stamps_are_arrival else math.nan
        self._stamps = StampLimiter(TOLERANCE_S[port.address.stamps], offset_s)
        # Steady times: of the latest receiving, and of the latest that emptied the receive queue.
        # Frames received later arrived after that.
        self._last_received_s = self._last_drained_s = steady_s()
        self._reported: set[str] = set()
        self._replay_was_seen = False
        self._drops = 0
        self._poller: Poller | None = None
        self._configure()
        self._began_s = self._now_s = time.monotonic()
        self._publish_due_s = self._housekeep_due_s = self._began_s
        self._save_due_s = self._began_s + min(FIRST_CHECKPOINT_S, self.config.state_every_s)
        # When the latest sample was processed, and when the frames of the latest one that the
        # estimator took arrived: they may have waited in the socket, under load or suspended.
        self._last_sample_s = self._last_arrival_s = self._began_s

    def _configure(self) -> None:
        """Set up polling and the receive filters for the pipeline's present vehicle.

        The filters also pass ids that show other senders: published frames, requests and
        REPLAY_CLOCK. `_others` has what to do with each.
        """
        pipeline = self.pipeline
        poll = self.config.poll
        poller = self._poller
        targets = pipeline.vehicle.poll_targets
        ids = pipeline.settings.ids
        self._poller = self._monitor.polls = None
        self._others: dict[int, Callable[[can.Message], None]] = {}
        if not pipeline.is_replay:
            self._others[ids.replay_clock] = self._note_replay
        if poll is not None and targets:
            asked_s = None if poller is None else poller.asked_s
            self._poller = poller = Poller(targets, poll.every_s, asked_s)
            self._monitor.polls = poller.counts
            self._others |= dict.fromkeys(poller.request_ids, self._note_request)
        self._others |= dict.fromkeys(ids.published, self._note_published)
        self.port.set_filters([*pipeline.filters, *map(standard_filter, sorted(self._others))])

    def run(self, stop: Callable[[], bool]) -> None:
        """Receive, estimate and publish until `stop()`, called every `ESTIMATE_EVERY_S` or sooner.

        Raises
        ------
        BusError
            If the bus is lost. A `ReconnectingBus` waits until it is back instead.
        """
        try:
            while not (stop() or self._is_over()):
                self._iterate()
            if self.pipeline.finish():
                self._give("on_sample", self.pipeline.latest_sample, self.pipeline.latest)
            if self.pipeline.published_samples != self.pipeline.samples:
                self._now_s = time.monotonic()
                self._publish_periodic()  # a sample that waited counts as silence
        finally:
            self._save()

    def _is_over(self) -> bool:
        """Return whether the run's duration has passed, or no sample came for too long."""
        duration_s = self.config.duration_s
        idle_s = self.config.until_idle_s
        if duration_s is not None and self._now_s - self._began_s >= duration_s:
            return True
        is_idle = idle_s is not None and self._now_s - self._last_sample_s >= idle_s
        return is_idle and self.pipeline.samples > 0

    def _iterate(self) -> None:
        """Receive once, process the frames, and do what is due."""
        left_s = self._publish_due_s + LATE_S - self._now_s
        messages = self.port.receive_pending(min(max(left_s, 0.0), ESTIMATE_EVERY_S))
        # Reading the clock may be a system call: once per step, and again after samples.
        self._now_s, before, received_s = time.monotonic(), self.pipeline.samples, steady_s()
        if messages:
            self._process(messages, received_s)
        if self.port.is_drained:
            self._last_drained_s = self._last_received_s
            for sent in (self._published, self._requested):
                sent.forget(self._last_received_s)
        self._last_received_s = received_s
        late_s = 0.0 if self.pipeline.samples != before else LATE_S
        if self._now_s >= self._publish_due_s + late_s:
            self._publish_periodic()
        if self._poller is not None:
            self._ask(self._poller.due(self._now_s))
        if self._now_s >= self._housekeep_due_s:
            self._housekeep_due_s = self._now_s + LATE_S  # seldom enough under continuous traffic
            self._housekeep()

    # --- frames → estimates

    def _process(self, messages: list[can.Message], received_s: float) -> None:
        """Estimate from frames that were received together at a steady time [s]."""
        pipeline = self.pipeline
        began_s = self._now_s
        samples = pipeline.samples
        taken = pipeline.taken
        stamp_s = math.nan
        stamps = [message.timestamp for message in messages]
        waited_s = received_s - self._stamps.limit(messages, self._last_drained_s, received_s)
        for message, original_s in zip(messages, stamps, strict=True):
            if self._handle(message):
                stamp_s = original_s
        if pipeline.samples != samples:
            self._last_sample_s = began_s
        if taken := pipeline.taken - taken:
            self._now_s = time.monotonic()
            self._last_arrival_s = began_s - waited_s if self._stamps_are_arrival else began_s
            step_s = (self._now_s - began_s) / taken
            self._monitor.stepped(stamp_s, step_s, self._last_arrival_s)

    def _handle(self, message: can.Message) -> bool:
        """Handle one frame; return whether it completed a sample."""
        note = self._others.get(message.arbitration_id)
        if note is not None and not message.is_extended_id:
            note(message)
            return False
        self._give("on_frame", message)
        if self._poller is not None and message.arbitration_id in self._poller.reply_ids:
            self._ask(self._poller.take(message, self._now_s))
        if not self.pipeline.handle(message):
            return False
        if self._takers["on_sample"] or self.pipeline.is_replay:
            estimate = self.pipeline.latest
            self._give("on_sample", self.pipeline.latest_sample, estimate)
            if frames := self.pipeline.replay_frames(estimate):
                self._send(frames)
                self._publish_due_s = self._now_s + ESTIMATE_EVERY_S
        return True

    def _note_published(self, message: can.Message) -> None:
        """Note a frame with an id that this service publishes: its echo, or another sender."""
        own = self._published
        if not own.is_echo(message) and own.proves_another(self._now_s):
            _warn(
                "bus.duplicate_sender",
                f"another node on this bus sends 0x{message.arbitration_id:X}, which this service"
                " publishes: is a second service running? Give one of them other ids ([ids] of the"
                " configuration)",
            )
        self._monitor.foreign = own.foreign

    def _note_request(self, message: can.Message) -> None:
        """Note a request to the battery: the own one's echo, or another tester."""
        if self._poller is not None and not self._requested.is_echo(message):
            self._poller.note_other_tester(self._now_s)

    def _note_replay(self, message: can.Message) -> None:
        """Note REPLAY_CLOCK, which this service does not use."""
        if not self._replay_was_seen and log_time_us(message.data) is not None:
            self._replay_was_seen = True
            _warn(
                "bus.replay_clock_ignored",
                "a replay sends its log's time on this bus (REPLAY_CLOCK), but this service uses"
                " receive stamps; to use the log's time, run with --time-source replay-clock",
            )

    def _give(self, method: str, *news: object) -> None:
        """Give some news to the outputs that take it.

        One that raises is called no more, and the estimate continues.
        """
        for output in self._takers[method]:
            try:
                getattr(output, method)(*news)
            except Exception as error:  # noqa: BLE001 - whatever it is, the SoC frames continue
                name = type(output).__name__
                emit(_LOG.error, "output.failed", f"{name} has ended: {error!r}", limit=name)
                for each, takers in self._takers.items():
                    self._takers[each] = [taker for taker in takers if taker is not output]

    # --- estimates → frames

    def _publish_periodic(self) -> None:
        self._follow_clock()
        found = self._find()
        for event in found.keys() - self._reported:
            _warn(event.split()[0], found[event], limit=event)
        self._reported = set(found)
        reasons = {reason for event, reason in _REASONS.items() if event in found}
        if self._published.is_shared(self._now_s):
            reasons.add(Reason.DUPLICATE_SENDER)
        self._send(
            self.pipeline.heartbeat(
                self._now_s - self._last_arrival_s, self.config.timeout_s, Reason(sum(reasons))
            )
        )
        # Stay on the clock's grid; skip those missed while the process was suspended.
        missed = max(math.floor((self._now_s - self._publish_due_s) / ESTIMATE_EVERY_S), 0)
        self._publish_due_s += (missed + 1) * ESTIMATE_EVERY_S

    def _follow_clock(self) -> None:
        """Let the pipeline follow a step of the stamps' clock, and log it."""
        step_s = self.pipeline.stamp_shift_s - self._stamps.shift_s
        self.pipeline.stamp_shift_s = self._stamps.shift_s
        if abs(step_s) >= 1.0:  # smaller ones are the clock's drift
            _warn(
                "bus.clock_set",
                f"the clock of the time stamps was set by {step_s:+.1f} s; bus time follows the"
                " monotonic clock",
                step_s=step_s,
            )

    def _find(self) -> dict[str, str]:
        """Return what is wrong with time and signals at present: a sentence by event."""
        decoder = self.pipeline.decoder
        found = dict[str, str]()
        if self._stamps.is_uncertain(steady_s()):
            found["bus.time_uncertain"] = (
                "the time stamps of the frames contradict the monotonic clock; the time of"
                " receiving is used instead"
            )
        for name in decoder.two_sender_messages:
            found[f"bus.two_senders {name}"] = (
                f"two senders use the id of {name}: its frames are refused until one of them"
                " stops; is somebody else on the bus? (If one sender sends it more often than"
                " the DBC states, give its shortest period_s in the map file; with j1939 = true,"
                " number it in the DBC with the pack's source address, and remove that line)"
            )
        if self.pipeline.is_unpaired:
            found["bus.unpaired"] = (
                f"voltages come, but not within {self.pipeline.vehicle.pair_within_s:g} s of a"
                " current: they are not used; give a longer pair_within_s in the map file"
            )
        if decoder.unsigned_current is not None:
            found["bus.unsigned_current"] = decoder.unsigned_current
        found |= {f"bus.wrong_period {name}": text for name, text in decoder.wrong_periods.items()}
        if self._now_s - self._began_s > SLOWEST_S:  # each reply was asked for
            for role, text in decoder.never_decoded.items():
                found[f"bus.never_seen {role}"] = text
        return found

    def _send(self, frames: list[can.Message]) -> None:
        """Send estimates."""
        for frame in frames:
            self._post(frame, self._published)
        if frames:
            self._monitor.sent()

    def _ask(self, frame: can.Message | None) -> None:
        """Send a request or a flow control, if there is one."""
        if frame is not None:
            self._post(frame, self._requested)

    def _post(self, frame: can.Message, sent: OwnFrames) -> None:
        """Send a frame, which waits for room in the transmit queue until the next is due.

        The loop never waits: a full queue (no other node on the bus) costs frames, not the
        estimate.
        """
        sent.note_sent(frame, steady_s())
        self.port.post(frame, ESTIMATE_EVERY_S)

    # --- housekeeping

    def _save(self) -> None:
        if self.checkpoint is not None:
            self.checkpoint()

    def _housekeep(self) -> None:
        """Report lost frames, save, reload and show."""
        now_s = self._now_s
        drops = self.port.queue_drops or 0
        if drops > self._drops:
            _warn(
                "bus.queue_overflow",
                f"{self.port.name}: the receive queue overflowed: {drops - self._drops} frames"
                f" lost ({drops} so far)",
            )
            self._drops = drops
        if now_s >= self._save_due_s:
            self._save_due_s = now_s + self.config.state_every_s
            self._save()
        if self.reload is not None and (config := self.reload()) is not None:
            self.config = config
            self._save_due_s = min(self._save_due_s, now_s + config.state_every_s)
            self._configure()
        if self._monitor.update(now_s):
            self._give("on_snapshot", self._monitor.latest)


def _overrides(output: Output, method: str) -> bool:
    """Return whether an output does anything with what a method would give it."""
    return getattr(type(output), method) is not getattr(Output, method)

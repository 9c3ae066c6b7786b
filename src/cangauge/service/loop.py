"""The service's loop: receive frames, hand them to the pipeline, send its frames.

Only the loop reads a clock, a monotonic one: to publish periodically, to detect stale input, and
to replace time stamps that cannot be true.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

import can

from cangauge._logging import emit
from cangauge.bus.connection import BusConnection
from cangauge.bus.publish import ESTIMATE_EVERY_S, standard_filter
from cangauge.bus.time_source import (
    TOLERANCE_S,
    StampLimiter,
    is_clock,
    log_time_us,
    steady_s,
)
from cangauge.service.config import RunConfig
from cangauge.service.output import Output
from cangauge.service.own_frames import OwnFrames
from cangauge.service.pipeline import Pipeline
from cangauge.service.polling import Poller
from cangauge.service.status import Monitor
from cangauge.types import Estimate, Reason

_LOG = logging.getLogger(__name__)
_warn = partial(emit, _LOG, logging.WARNING)

LATE_S: Final = 0.01
"""Longest time that due frames wait for a sample to arrive [s]. Also the shortest interval of
housekeeping under continuous traffic."""
LOGGED_FROM_S: Final = 1.0
"""Smallest step of the stamps' clock that is logged [s]; smaller ones are its drift."""
NEVER_SEEN_S: Final = 60.0
"""Time after which a signal that never came is logged [s]: replies are asked for once a minute."""
FIRST_CHECKPOINT_S: Final = 1.0
"""Time of the first checkpoint [s]: early, for a service that is killed repeatedly."""


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
    """

    def __init__(
        self,
        port: BusConnection,
        pipeline: Pipeline,
        config: RunConfig,
        *,
        outputs: Sequence[Output] = (),
        monitor: Monitor | None = None,
        checkpoint: Callable[[], None] | None = None,
        reload: Callable[[], RunConfig | None] | None = None,
    ) -> None:
        self._port, self._pipeline, self._config = port, pipeline, config
        self._outputs = list(outputs)
        self._sort_outputs()
        self._monitor = monitor or Monitor(pipeline, port)
        self._checkpoint, self._reload = checkpoint, reload
        self._own = OwnFrames(echoes=port.address.echoes)
        self._asked = OwnFrames(echoes=port.address.echoes)
        self._stamps_are_arrival = port.address.stamps != "driver"
        offset_s = time.time() - steady_s() if self._stamps_are_arrival else math.nan
        self._stamps = StampLimiter(TOLERANCE_S[port.address.stamps], offset_s)
        self._shift_s = 0.0
        # Start of the last iteration that drained the receive queue: later frames arrived after it.
        # Time at which the latest iteration received.
        self._drained_s = self._received_s = steady_s()
        self._reported: set[str] = set()
        self._clock_was_seen = False
        self._drops = 0
        self._poller: Poller | None = None
        self._configure()
        self._began_s = self._now_s = self._publish_s = self._keep_s = time.monotonic()
        self._save_s = self._began_s + min(FIRST_CHECKPOINT_S, config.state_every_s)
        # Time at which the latest sample was processed, and time at which the frames with the
        # latest sample that the estimator took arrived. Frames may wait in the socket between the
        # two: under load, or while the process is suspended.
        self._sample_s = self._came_s = self._began_s

    def _configure(self) -> None:
        """Set up polling and the receive filters for the pipeline's present vehicle.

        The filters also pass the ids that show other senders: published frames, requests and
        REPLAY_CLOCK.
        """
        pipeline, poll = self._pipeline, self._config.poll
        targets, ids = pipeline.vehicle.poll_targets, pipeline.settings.ids
        asked_s = {} if self._poller is None else self._poller.asked_s
        self._poller = None
        not_input = set(ids.published)
        if poll is not None and targets:
            self._poller = Poller(targets, poll.every_s, asked_s)
            not_input |= self._poller.request_ids
        self._monitor.polls = None if self._poller is None else self._poller.counts
        if not pipeline.is_replay:
            not_input.add(ids.replay_clock)
        self._not_input = frozenset(not_input)
        self._port.set_filters([*pipeline.filters, *map(standard_filter, sorted(not_input))])

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
            if self._pipeline.finish():
                self._give_sample(self._pipeline.latest)
            if self._pipeline.published_samples != self._pipeline.samples:
                self._now_s = time.monotonic()
                self._publish_periodic()  # a sample that waited counts as silence
        finally:
            self._save()

    def _is_over(self) -> bool:
        duration_s, idle_s = self._config.duration_s, self._config.until_idle_s
        is_complete = duration_s is not None and self._now_s - self._began_s >= duration_s
        is_idle = idle_s is not None and self._now_s - self._sample_s >= idle_s
        return is_complete or (is_idle and self._pipeline.samples > 0)

    def _iterate(self) -> None:
        """Receive once, process the frames, and do what is due."""
        left_s = self._publish_s + LATE_S - self._now_s
        messages = self._port.receive_pending(min(max(left_s, 0.0), ESTIMATE_EVERY_S))
        # Reading the clock may be a system call: once per step, and again after samples.
        self._now_s, before, received_s = time.monotonic(), self._pipeline.samples, steady_s()
        if messages:
            self._process(messages, received_s)
        if self._port.is_drained:
            self._drained_s = self._received_s
            self._own.forget(self._received_s)
            self._asked.forget(self._received_s)
        self._received_s = received_s
        late_s = 0.0 if self._pipeline.samples != before else LATE_S
        if self._now_s >= self._publish_s + late_s:
            self._publish_periodic()
        if self._poller is not None:
            self._ask(self._poller.due(self._now_s))
        if self._now_s >= self._keep_s:
            self._keep_s = self._now_s + LATE_S
            self._housekeep()

    # --- frames → estimates

    def _process(self, messages: list[can.Message], received_s: float) -> None:
        """Estimate from frames that were received together at a time by `steady_s` [s]."""
        pipeline, poller = self._pipeline, self._poller
        samples_before, taken_before, stamp_s = pipeline.samples, pipeline.taken, math.nan
        stamps = [message.timestamp for message in messages]
        lag_s = received_s - self._stamps.limit(messages, self._drained_s, received_s)
        for message, original_s in zip(messages, stamps, strict=True):
            if message.arbitration_id in self._not_input and self._handle_not_input(message):
                continue
            for output in self._frame_outputs:
                self._give(output, "on_frame", message)
            if poller is not None and message.arbitration_id in poller.reply_ids:
                self._ask(poller.take(message, self._now_s))
            if not pipeline.handle(message):
                continue
            stamp_s = original_s
            if self._sample_outputs or pipeline.is_replay:
                estimate = pipeline.latest
                self._give_sample(estimate)
                if frames := pipeline.acknowledgement(estimate):
                    self._send(frames)
                    self._publish_s = self._now_s + ESTIMATE_EVERY_S
        if pipeline.samples != samples_before:
            self._sample_s = self._now_s
        if taken := pipeline.taken - taken_before:
            began_s, self._now_s = self._now_s, time.monotonic()
            self._came_s = began_s - lag_s if self._stamps_are_arrival else began_s
            self._monitor.stepped(stamp_s, (self._now_s - began_s) / taken, self._came_s)

    def _handle_not_input(self, message: can.Message) -> bool:
        """Note what a frame shows of other senders; return False for a frame of the vehicle."""
        frame_id, ids = message.arbitration_id, self._pipeline.settings.ids
        if message.is_extended_id:
            return False
        if frame_id in ids.published:
            if not self._own.is_echo(message) and self._own.proves_another(self._now_s):
                text = f"another node on this bus sends 0x{frame_id:X}, which this service"
                text += " publishes: is a second service running? Give one of them other ids"
                _warn("bus.duplicate_sender", f"{text} ([ids] of the configuration)")
            self._monitor.foreign = self._own.foreign
        elif self._poller is not None and frame_id in self._poller.request_ids:
            if not self._asked.is_echo(message):
                self._poller.note_other_tester(self._now_s)
        elif not is_clock(message, ids.replay_clock):
            return False
        elif not self._clock_was_seen and log_time_us(message.data) is not None:
            self._clock_was_seen = True
            text = "a replay sends its log's time on this bus (REPLAY_CLOCK), but this service"
            text += " uses receive stamps; to use the log's time, run with"
            _warn("bus.replay_clock_ignored", f"{text} --time-source replay-clock")
        return True

    def _sort_outputs(self) -> None:
        """Note the outputs that take frames, and those that take samples."""
        self._frame_outputs = [each for each in self._outputs if overrides(each, "on_frame")]
        self._sample_outputs = [each for each in self._outputs if overrides(each, "on_sample")]

    def _give_sample(self, estimate: Estimate) -> None:
        for output in self._sample_outputs:
            self._give(output, "on_sample", self._pipeline.latest_sample, estimate)

    def _give(self, output: Output, method: str, *news: object) -> None:
        """Call an output; one that raises is called no more, and the estimate continues."""
        try:
            getattr(output, method)(*news)
        except Exception as error:  # noqa: BLE001 - whatever it is, the SoC frames continue
            name = type(output).__name__
            emit(_LOG, logging.ERROR, "output.failed", f"{name} has ended: {error!r}", limit=name)
            self._outputs = [each for each in self._outputs if each is not output]
            self._sort_outputs()

    # --- estimates → frames

    def _publish_periodic(self) -> None:
        silent_s, reasons = self._now_s - self._came_s, self._report_findings()
        self._send(self._pipeline.heartbeat(silent_s, self._config.timeout_s, reasons))
        # Stay on the clock's grid; skip those missed while the process was suspended.
        missed = max(math.floor((self._now_s - self._publish_s) / ESTIMATE_EVERY_S), 0)
        self._publish_s += (missed + 1) * ESTIMATE_EVERY_S

    def _report_findings(self) -> Reason:
        """Log what is new about time, senders and signals; return the reasons to publish."""
        self._follow_clock()
        reasons, found = Reason.NONE, self._find_in_signals()
        if self._stamps.is_uncertain(steady_s()):
            reasons |= Reason.TIME_UNCERTAIN
            text = "the time stamps of the frames contradict the monotonic clock; the time of"
            found["bus.time_uncertain"] = f"{text} receiving is used instead"
        if self._own.is_shared(self._now_s):
            reasons |= Reason.DUPLICATE_SENDER
        if self._pipeline.decoder.unsigned_current is not None:
            reasons |= Reason.IMPLAUSIBLE_INPUT
        for event in found.keys() - self._reported:
            _warn(event.split()[0], found[event], limit=event)
        self._reported = set(found)
        return reasons

    def _follow_clock(self) -> None:
        """Let the pipeline follow a step of the stamps' clock, and log it."""
        if self._stamps.shift_s == self._shift_s:
            return
        step_s, self._shift_s = self._shift_s - self._stamps.shift_s, self._stamps.shift_s
        self._pipeline.stamp_shift_s = self._shift_s
        if abs(step_s) >= LOGGED_FROM_S:
            text = f"the clock of the time stamps was set by {step_s:+.1f} s; bus time follows"
            _warn("bus.clock_set", f"{text} the monotonic clock", step_s=step_s)

    def _find_in_signals(self) -> dict[str, str]:
        """Return what is wrong with the vehicle's signals: a sentence by event."""
        decoder, found = self._pipeline.decoder, dict[str, str]()
        for name in decoder.two_sender_messages:
            found[f"bus.two_senders {name}"] = (
                f"two senders use the id of {name}: its frames are refused until one of them"
                " stops; is somebody else on the bus? (If one sender sends it more often than"
                " the DBC states, give its shortest period_s in the map file; with j1939 = true,"
                " number it in the DBC with the pack's source address, and remove that line)"
            )
        if self._pipeline.is_unpaired:
            within_s = self._pipeline.vehicle.pair_within_s
            found["bus.unpaired"] = (
                f"voltages come, but not within {within_s:g} s of a current: they are not used;"
                " give a longer pair_within_s in the map file"
            )
        if decoder.unsigned_current is not None:
            found["bus.unsigned_current"] = decoder.unsigned_current
        for name, text in decoder.wrong_periods.items():
            found[f"bus.wrong_period {name}"] = text
        if self._now_s - self._began_s > NEVER_SEEN_S:
            for role, text in decoder.never_decoded.items():
                found[f"bus.never_seen {role}"] = text
        return found

    def _send(self, frames: list[can.Message]) -> None:
        """Send estimates; a frame waits for room in the transmit queue until the next is due.

        The loop never waits: a full queue (no other node on the bus) costs frames, not the
        estimate.
        """
        for frame in frames:
            self._own.note_sent(frame, steady_s())
            self._port.post(frame, ESTIMATE_EVERY_S)
        if frames:
            self._monitor.sent()

    def _ask(self, frame: can.Message | None) -> None:
        """Send a request or a flow control, if there is one."""
        if frame is not None:
            self._asked.note_sent(frame, steady_s())
            self._port.post(frame, ESTIMATE_EVERY_S)

    # --- housekeeping

    def _save(self) -> None:
        if self._checkpoint is not None:
            self._checkpoint()

    def _housekeep(self) -> None:
        """Report lost frames, save, reload and show."""
        now_s, drops = self._now_s, self._port.queue_drops or 0
        if drops > self._drops:
            lost, self._drops = drops - self._drops, drops
            text = f"{self._port.name}: the receive queue overflowed: {lost} frames lost"
            _warn("bus.queue_overflow", f"{text} ({drops} so far)")
        if now_s >= self._save_s:
            self._save_s = now_s + self._config.state_every_s
            self._save()
        if self._reload is not None and (config := self._reload()) is not None:
            self._config = config
            self._save_s = min(self._save_s, now_s + config.state_every_s)
            self._configure()
        if self._monitor.update(now_s):
            for output in self._outputs:
                self._give(output, "on_snapshot", self._monitor.latest)


def overrides(output: Output, method: str) -> bool:
    """Return whether an output does anything with what a method would give it."""
    return getattr(type(output), method) is not getattr(Output, method)

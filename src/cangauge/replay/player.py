"""Play steps on a bus: at a given speed, or as fast as the receiver acknowledges.

At full speed nothing may be lost, although socket buffers drop excess frames silently. The receiver
(`cangauge run --time-source replay-clock`) reports its sample count in SOC_DETAIL every few
samples, and again in the silence after them; the player limits the frames in flight.
Samples that are lost all the same are counted, and the replay goes on.
"""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

import can

from cangauge._logging import emit
from cangauge.bus.connection import BusConnection
from cangauge.bus.publish import ACKNOWLEDGE_EVERY, SAMPLES_MODULO, SocReader
from cangauge.bus.time_source import COUNT_EVERY, MICROSECONDS, clock_frame, count_frame
from cangauge.errors import CangaugeError, InputError
from cangauge.replay.steps import Source, Step
from cangauge.settings import FrameIds

_LOG = logging.getLogger(__name__)

WINDOW_FRAMES: Final = 160
"""Most frames in flight: a default socket buffer of Linux holds about 270."""
LOST_AFTER_S: Final = 1.0
"""Time for which the receiver reports the same count in the silence after which the samples in
flight are lost [s]: a socket buffer has dropped their frames."""
POLL_S: Final = 0.05
"""Longest uninterrupted wait, so that a stop is noticed [s]."""
SHOW_EVERY_S: Final = 0.2
LISTEN_S: Final = 0.001
"""Time to listen at each display update, for replays without pauses [s]."""
LISTEN_AT_END_S: Final = 0.15
"""Time to listen for the estimate after the last frame [s]."""
_HINT: Final = (
    "is `cangauge run --time-source replay-clock` listening on this bus, for the same --vehicle?"
)


@dataclass
class ReplayState:
    """Progress of a replay.

    `samples` are those that a receiver makes of the frames, where known; `acknowledged` those that
    it has processed, `lost` those that never reached it (both None below full speed, where only the
    receiver knows); `soc` the values of its latest SOC_ESTIMATE.
    """

    frames: int = 0
    clock_frames: int = 0
    samples: int = 0
    acknowledged: int | None = None
    lost: int | None = None
    log_seconds: float = 0.0
    seconds: float = 0.0
    soc: dict[str, Any] = field(default_factory=dict)

    @property
    def speed(self) -> float | None:
        """Log seconds per second so far."""
        return self.log_seconds / self.seconds if self.seconds > 0.0 else None


def _show_nothing(_state: ReplayState) -> None:
    """Show nothing."""


def play(
    bus: BusConnection,
    source: Source,
    *,
    stop: Callable[[], bool],
    show: Callable[[ReplayState], None] = _show_nothing,
    speed: float = 1.0,
    loop: bool = False,
    acknowledge_s: float = 10.0,
    ids: FrameIds | None = None,
) -> ReplayState:
    """Play a source on a bus.

    Parameters
    ----------
    bus : BusConnection
        Needs to receive SOC_ESTIMATE and SOC_DETAIL only.
    source : Source
    stop : callable
        Called between frames; True ends the replay.
    show : callable, optional
        Called a few times a second, and at the end.
    speed : float
        Log seconds per second; infinite: as fast as the receiver acknowledges.
    loop : bool
        Repeat until stopped.
    acknowledge_s : float
        Longest wait for a receiver, and for its acknowledgement, at full speed [s].
    ids : FrameIds, optional
        Of the receiver's frames, and of the clock.

    Raises
    ------
    InputError
        If a capture without a vehicle is to be played at full speed, or the bus is not open for
        the capture's CAN FD frames.
    CangaugeError
        If the bus fails, or no receiver acknowledges in time.
    """
    player = _Player(bus, ids or FrameIds(), speed, acknowledge_s, stop)
    if player.is_max:
        if not source.counts_samples:
            raise InputError(
                "full speed needs the vehicle of a capture, to count the samples acknowledged",
                source=source.name,
                field="--speed",
                value="max",
                cure="give --vehicle or --map, or another speed",
            )
        player.wait_until(player.is_ready)
    show_s = -math.inf
    for step in source.steps(loop=loop):
        if stop():
            break
        player.send(step)
        if time.monotonic() >= show_s:
            show_s = time.monotonic() + SHOW_EVERY_S
            show(player.update(LISTEN_S))
    player.send_count()
    if player.is_max:
        player.wait_until(player.is_acknowledged)
    show(player.update(LISTEN_AT_END_S))
    return player.state


class Pacer:
    """Wait for moments of log time, `speed` log seconds per second.

    All moments are counted from the first, on the monotonic clock: errors do not accumulate, and a
    late frame does not delay the rest. `stop` ends a wait, `rest` waits for at most a time [s].
    """

    def __init__(
        self,
        speed: float,
        stop: Callable[[], bool],
        rest: Callable[[float], object] = time.sleep,
    ) -> None:
        self._us_per_s = MICROSECONDS * speed
        self._stop, self._rest = stop, rest
        self._origin: tuple[int, float] | None = None

    def wait(self, time_us: int) -> None:
        """Return when a log time [µs] is due, or at once when it has passed."""
        if self._origin is None:
            self._origin = (time_us, time.monotonic())
        first_us, first_s = self._origin
        due_s = first_s + (time_us - first_us) / self._us_per_s
        while (ahead_s := due_s - time.monotonic()) > 0.0 and not self._stop():
            self._rest(min(ahead_s, POLL_S))


class _Player:
    """Sends steps when they are due, or when the receiver has room; keeps the state."""

    def __init__(
        self,
        bus: BusConnection,
        ids: FrameIds,
        speed: float,
        acknowledge_s: float,
        stop: Callable[[], bool],
    ) -> None:
        self._bus, self._within_s, self._stop = bus, acknowledge_s, stop
        self.is_max = math.isinf(speed)
        self._pacer = Pacer(speed, stop, self._listen_once)
        self._sends_clock, self._clock_id = speed != 1.0, ids.replay_clock
        self._reader = SocReader(ids)
        self._first_us: int | None = None
        self._began_s, self._clock_us = 0.0, -1
        self._count: int | None = None  # in the latest SOC_DETAIL
        self._reported_s = -math.inf
        self.in_flight: deque[int] = deque()
        """Frames of each sample sent that is neither acknowledged nor lost."""
        self._incomplete = 0  # frames sent since the latest sample
        known = 0 if self.is_max else None
        self.state = ReplayState(acknowledged=known, lost=known)

    def send(self, step: Step) -> None:
        """Send a step when it is due, or when the receiver has room."""
        state = self.state
        if not self.is_max:
            self._pacer.wait(step.time_us)
        elif self._frames_in_flight >= WINDOW_FRAMES:
            # Drain to half, so that both sides work in batches.
            self.wait_until(self._has_room)
        if self._first_us is None:
            self._first_us, self._began_s = step.time_us, time.monotonic()
        if self._sends_clock and step.is_wanted and step.time_us != self._clock_us:
            self._clock_us = step.time_us
            if state.clock_frames % COUNT_EVERY == 0:
                self.send_count()
            self._send(clock_frame(step.time_us, self._clock_id))
            state.clock_frames += 1
        for frame in step.frames:
            self._send(frame)
        state.frames += len(step.frames)
        if self.is_max and step.samples != state.samples:
            self.in_flight.append(self._incomplete)
            self._incomplete = 0
        state.samples = step.samples
        state.log_seconds = (step.time_us - self._first_us) / MICROSECONDS

    def send_count(self) -> None:
        """State how many log times were sent, so that the receiver finds what it has lost."""
        if self._sends_clock:
            self._send(count_frame(self.state.clock_frames, self._clock_id))

    def update(self, listen_s: float) -> ReplayState:
        """Listen until the bus is quiet, for at most `listen_s` [s]; return the state.

        Not with a timeout of 0: where Python filters, own frames must be skipped first.
        """
        if self._first_us is not None:
            self.state.seconds = time.monotonic() - self._began_s
        until_s = time.monotonic() + listen_s
        while (left_s := until_s - time.monotonic()) > 0.0 and self._listen_once(left_s):
            pass
        return self.state

    def _send(self, frame: can.Message) -> None:
        self._incomplete += 1
        if frame.is_fd and not self._bus.carries_fd:
            raise InputError(
                "holds CAN FD frames, and the bus is not open for them",
                field="--bus-option",
                cure="give --bus-option fd=true",
            )
        if not self._bus.send(frame) and self.is_max:
            raise self._error(
                "the transmit queue stays full; is the bus up, with another node that"
                " acknowledges frames?"
            )

    def is_ready(self) -> bool:
        """Return whether a SOC_DETAIL has come, from which samples are counted."""
        return self._count is not None

    def is_acknowledged(self) -> bool:
        """Return whether no sample is in flight."""
        return not self.in_flight

    def _has_room(self) -> bool:
        return self._frames_in_flight <= WINDOW_FRAMES // 2

    @property
    def _frames_in_flight(self) -> int:
        """Frames that may wait at the receiver; 0 with too few samples for an acknowledgement."""
        has_enough = len(self.in_flight) >= 2 * ACKNOWLEDGE_EVERY
        return sum(self.in_flight) + self._incomplete if has_enough else 0

    def wait_until(self, is_enough: Callable[[], bool]) -> None:
        """Listen until a condition holds; raise CangaugeError if no acknowledgement comes."""
        state, before, last_s = self.state, self.state.acknowledged, time.monotonic()
        while not is_enough() and not self._stop():
            self._listen_once(POLL_S)
            now_s = time.monotonic()
            if state.acknowledged != before:
                before, last_s = state.acknowledged, now_s
            elif state.acknowledged and self._reported_s - last_s > LOST_AFTER_S:
                state.lost = (state.lost or 0) + len(self.in_flight)
                self.in_flight.clear()
                self._incomplete = 0
                text = f"{state.lost} samples lost so far; the replay continues"
                emit(_LOG.warning, "replay.lost", text)
            elif now_s - last_s > self._within_s:
                problem = "no receiver: no SOC_DETAIL"
                if self.is_ready():
                    problem = f"{state.acknowledged} of {state.samples} samples sent have been"
                    problem += " processed: no acknowledgement"
                raise self._error(f"{problem} in {self._within_s:g} s; {_HINT}")

    def _listen_once(self, timeout_s: float) -> bool:
        """Receive one frame; return whether one came in time [s]."""
        message = self._bus.receive(timeout_s)
        if message is None:
            return False
        name, values = self._reader.read(message)
        if name == "soc_estimate" and math.isfinite(values["soc_pct"]):
            self.state.soc = values
        elif name == "soc_detail" and self.is_max:
            self._acknowledge(values["samples"])
        return True

    def _acknowledge(self, count: int) -> None:
        self._reported_s = time.monotonic()
        before, self._count = self._count, count
        if before is None or not self.state.samples:
            return
        more, state, sent = (count - before) % SAMPLES_MODULO, self.state, len(self.in_flight)
        late, lost = max(more - sent, 0), state.lost or 0  # late: counted as lost, but only slow
        if late > lost:
            raise self._error(
                f"the receiver has processed {more} samples where {sent + lost} were in flight: it"
                " was restarted, or another program sends or acknowledges on this bus too"
            )
        state.lost = lost - late
        state.acknowledged = (state.acknowledged or 0) + more
        for _ in range(more - late):
            self.in_flight.popleft()

    def _error(self, problem: str) -> CangaugeError:
        return CangaugeError(f"{self._bus.name}: {problem}")

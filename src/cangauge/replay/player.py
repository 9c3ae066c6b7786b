"""Keeping the recorded timing, at any speed.

Full speed without loss: sending no further ahead than the receiver has acknowledged.

The receiver (`cangauge run --time-source replay-clock`) tells in SOC_DETAIL how many samples it
has processed, every few samples, and again when nothing comes any more. Frames that wait in its
socket are bounded by a window, because the system's buffers drop what is too much without a word.

Playing steps on a bus: in time, or as fast as the receiver acknowledges.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import can

from cangauge.bus.connection import BusConnection
from cangauge.bus.publish import SAMPLES_MODULO, FrameIds, SocDetail, SocEstimate, SocReader
from cangauge.bus.time_source import ClockFrames
from cangauge.errors import CangaugeError, InputError
from cangauge.replay.steps import Source, Step
from cangauge.service.pipeline import ACKNOWLEDGE_EVERY

# --- Keeping the recorded timing, at any speed

AHEAD_S: Final = 0.0002
"""Frames so near to their time are sent at once: sleeping would cost more than it mends [s]."""

REST_AT_MOST_S: Final = 0.2
"""Longer pauses are passed in parts, so that a signal is noticed."""


class Pacer:
    """Waits for the moments of log time.

    Every moment is counted from the first, by the monotonic clock, so that errors do not add up:
    what is late does not make the rest later.

    Parameters
    ----------
    speed : float
        Log seconds per second.
    stop : callable
        Asked while waiting; True ends it.
    rest : callable
        Passes at most so many seconds; may return earlier.
    """

    def __init__(
        self,
        speed: float,
        stop: Callable[[], bool],
        rest: Callable[[float], object] = time.sleep,
    ) -> None:
        self._us_per_s = 1e6 * speed
        self._stop = stop
        self._rest = rest
        self._origin: tuple[int, float] | None = None

    def wait(self, time_us: int) -> None:
        """Return when it is time for a log time [µs], or at once when it has passed."""
        if self._origin is None:
            self._origin = (time_us, time.monotonic())
        first_us, first_s = self._origin
        due_s = first_s + (time_us - first_us) / self._us_per_s
        while (ahead_s := due_s - time.monotonic()) > AHEAD_S and not self._stop():
            self._rest(min(ahead_s, REST_AT_MOST_S))


# --- Full speed without loss: sending no further ahead than the receiver has acknowledged

WINDOW_SAMPLES: Final = 40
"""Samples under way at most."""

WINDOW_FRAMES: Final = 160
"""Frames under way at most: a socket's default buffer holds about 270, on Linux …"""

SAMPLES_AT_LEAST: Final = 2 * ACKNOWLEDGE_EVERY
"""… but so many samples always may be, or an acknowledgement would never become due."""

SLOW_S: Final = 0.5
"""Waiting this long for an acknowledgement is worth a hint [s]."""

_LOOK_S: Final = 0.05

_HINT = (
    "is `cangauge run --time-source replay-clock` listening on this bus, for the same --vehicle?"
)


class Receiver:
    """What is known of the receiver: its acknowledgements, and the SoC that it publishes.

    Parameters
    ----------
    port : BusConnection
        Receives SOC_ESTIMATE and SOC_DETAIL only.
    reader : SocReader
    stop : callable
        Asked while waiting; True ends it.
    warn : callable, optional
        Takes a line of text.

    Attributes
    ----------
    soc : SocEstimate or None
        The latest that was published.
    acknowledged : int
        Samples processed since `wait_until_ready`.
    """

    def __init__(
        self,
        port: BusConnection,
        reader: SocReader,
        stop: Callable[[], bool],
        warn: Callable[[str], None] | None = None,
    ) -> None:
        self._port = port
        self._reader = reader
        self._stop = stop
        self._warn = warn
        self.soc: SocEstimate | None = None
        self.acknowledged = 0
        self._told: int | None = None
        self._sent = 0
        self._frames_sent = 0
        # Frames that had been sent when a sample was complete: (sample, frames).
        self._marks: deque[tuple[int, int]] = deque()
        self._frames_acknowledged = 0

    def listen(self, within_s: float) -> None:
        """Take in what arrives, for so long at most [s]; return when the bus is quiet.

        Not without any time: where Python filters, one's own frames must be passed over first.
        """
        until_s = time.monotonic() + within_s
        while (left_s := until_s - time.monotonic()) > 0.0 and self.take(left_s):
            pass

    def wait_until_ready(self, within_s: float) -> None:
        """Wait for the receiver to show itself; its count so far is where counting begins.

        Raises
        ------
        CangaugeError
            If it does not within that time [s].
        """
        give_up_s = time.monotonic() + within_s
        while self._told is None and not self._stop():
            if time.monotonic() > give_up_s:
                raise CangaugeError(
                    f"{self._port.name}: nobody acknowledges: no SOC_DETAIL in {within_s:g} s;"
                    f" {_HINT}"
                )
            self.take(_LOOK_S)

    def sent(self, samples: int, frames: int) -> None:
        """Note how many samples and frames have been sent so far."""
        if samples != self._sent:
            self._marks.append((samples, frames))
        self._sent, self._frames_sent = samples, frames

    def wait_for_room(self, within_s: float) -> None:
        """Wait until the window has room.

        Raises
        ------
        CangaugeError
            If no acknowledgement comes within that time [s].
        """
        if not self._is_full():
            return
        # Once full it is emptied to a half, so that both sides work in strides.
        self._wait(within_s, lambda: self._under_way <= WINDOW_SAMPLES // 2 and not self._is_full())

    def wait_for_all(self, within_s: float) -> None:
        """Wait until everything is acknowledged.

        Raises
        ------
        CangaugeError
            If no acknowledgement comes within that time [s].
        """
        self._wait(within_s, lambda: self._under_way == 0)

    @property
    def _under_way(self) -> int:
        return self._sent - self.acknowledged

    def _is_full(self) -> bool:
        if self._under_way < SAMPLES_AT_LEAST:
            return False
        frames = self._frames_sent - self._frames_acknowledged
        return self._under_way >= WINDOW_SAMPLES or frames >= WINDOW_FRAMES

    def _wait(self, within_s: float, is_enough: Callable[[], bool]) -> None:
        began_s = last_s = time.monotonic()
        before = self.acknowledged
        while not is_enough() and not self._stop():
            self.take(_LOOK_S)
            now_s = time.monotonic()
            if self.acknowledged != before:
                before, last_s = self.acknowledged, now_s
            elif now_s - last_s > within_s:
                raise CangaugeError(
                    f"{self._port.name}: no acknowledgement in {within_s:g} s:"
                    f" {self.acknowledged} of {self._sent} samples sent have been processed;"
                    f" {_HINT}"
                )
            if now_s - began_s > SLOW_S and self._warn is not None:
                self._warn(f"the receiver acknowledges slowly; {_HINT}")
                self._warn = None

    def take(self, timeout_s: float) -> bool:
        """Take in one frame; return whether one came in time [s]."""
        message = self._port.receive(timeout_s)
        if message is None:
            return False
        content = self._reader.read(message)
        if isinstance(content, SocEstimate):
            if math.isfinite(content.soc_pct):
                self.soc = content
        elif isinstance(content, SocDetail):
            self._count(content.samples)
        return True

    def _count(self, told: int) -> None:
        if self._told is None or not self._sent:
            self._told = told
            return
        more = (told - self._told) % SAMPLES_MODULO
        if more == 0:
            return
        if more > self._under_way:
            raise CangaugeError(
                f"{self._port.name}: the receiver has processed {more} samples where"
                f" {self._under_way} were under way: it was started again, or somebody else sends"
                " or answers on this bus too"
            )
        self._told = told
        self.acknowledged += more
        while self._marks and self._marks[0][0] <= self.acknowledged:
            self._frames_acknowledged = self._marks.popleft()[1]


# --- Playing steps on a bus: in time, or as fast as the receiver acknowledges

SHOW_EVERY_S: Final = 0.2

LISTEN_S: Final = 0.001
"""How long to listen then, where there was no pause to do it in [s]."""

LAST_WORDS_S: Final = 0.15
"""How long to listen for what the receiver publishes after the last frame [s]."""


@dataclass(frozen=True)
class ReplaySettings:
    """How to play.

    Parameters
    ----------
    speed : float
        Log seconds per second; infinite: as fast as the receiver acknowledges.
    loop : bool
        Again and again, until stopped.
    wait_s : float, optional
        How long to wait for a receiver to show itself before beginning [s]; by default as long as
        an acknowledgement at full speed, where there must be one, and else not at all.
    acknowledge_s : float
        How long an acknowledgement may take at full speed [s].
    ids : FrameIds
    """

    speed: float = 1.0
    loop: bool = False
    wait_s: float | None = None
    acknowledge_s: float = 10.0
    ids: FrameIds = field(default_factory=FrameIds)

    @property
    def is_max(self) -> bool:
        """Whether the receiver sets the pace."""
        return math.isinf(self.speed)


@dataclass
class ReplayState:
    """How far a replay is; handed to whoever shows it."""

    frames: int = 0
    """Frames sent, REPLAY_CLOCK left out."""
    clocks: int = 0
    """REPLAY_CLOCK frames sent."""
    samples: int = 0
    """Samples that a receiver makes of them, where that is known."""
    acknowledged: int | None = None
    """Samples that the receiver says it has processed; None where that is not asked."""
    log_seconds: float = 0.0
    seconds: float = 0.0
    """Since the first frame [s]."""
    soc: SocEstimate | None = None
    """The latest that the receiver published."""

    @property
    def speed(self) -> float | None:
        """Log seconds per second so far."""
        return self.log_seconds / self.seconds if self.seconds > 0.0 else None


def play(
    port: BusConnection,
    source: Source,
    settings: ReplaySettings,
    *,
    stop: Callable[[], bool],
    show: Callable[[ReplayState], None] | None = None,
    warn: Callable[[str], None] | None = None,
) -> ReplayState:
    """Play a source on a bus.

    Parameters
    ----------
    port : BusConnection
        Needs to receive SOC_ESTIMATE and SOC_DETAIL only.
    source : Source
    settings : ReplaySettings
    stop : callable
        Asked between frames; True ends the replay.
    show : callable, optional
        Called a few times a second, and at the end.
    warn : callable, optional
        Takes a line of text.

    Returns
    -------
    ReplayState

    Raises
    ------
    InputError
        If full speed is asked of a capture without a vehicle.
    CangaugeError
        If the bus fails, no receiver shows itself, or one stops acknowledging.
    """
    if settings.is_max and not source.counts_samples:
        raise InputError(
            "at full speed the receiver's samples are counted, and this capture's vehicle is not"
            " known",
            source=source.name,
            field="--speed",
            value="max",
            cure="give --vehicle, or --dbc and --map, or another speed",
        )
    player = _Player(port, settings, stop, show, warn)
    player.begin()
    for step in source.steps(loop=settings.loop):
        if stop():
            break
        player.send(step)
    player.end()
    return player.state


class _Player:
    def __init__(
        self,
        port: BusConnection,
        settings: ReplaySettings,
        stop: Callable[[], bool],
        show: Callable[[ReplayState], None] | None,
        warn: Callable[[str], None] | None,
    ) -> None:
        self._port = port
        self._settings = settings
        self._stop = stop
        self._show = show
        self._receiver = Receiver(port, SocReader(settings.ids), stop, warn)
        # Pauses are passed with listening.
        self._pacer = None if settings.is_max else Pacer(settings.speed, stop, self._receiver.take)
        self._clock = None if settings.speed == 1.0 else ClockFrames(settings.ids.replay_clock)
        self._clock_us: int | None = None
        self._first_us: int | None = None
        self._began_s = 0.0
        self._show_s = 0.0
        self.state = ReplayState(acknowledged=0 if settings.is_max else None)

    def begin(self) -> None:
        settings = self._settings
        wait_s = settings.wait_s
        if wait_s is None and settings.is_max:
            wait_s = settings.acknowledge_s
        if wait_s is not None:
            self._receiver.wait_until_ready(wait_s)

    def send(self, step: Step) -> None:
        state = self.state
        if self._pacer is None:
            self._receiver.wait_for_room(self._settings.acknowledge_s)
        else:
            self._pacer.wait(step.time_us)
        if self._first_us is None:
            self._first_us = step.time_us
            self._began_s = time.monotonic()
        if self._clock is not None and step.is_wanted and step.time_us != self._clock_us:
            self._clock_us = step.time_us
            self._send_one(self._clock.at(step.time_us))
            state.clocks += 1
        for frame in step.frames:
            if frame.is_fd and not self._port.carries_fd:
                raise InputError(
                    "holds CAN FD frames, and the bus is not open for them",
                    field="--bus-option",
                    cure="give --bus-option fd=true",
                )
            self._send_one(frame)
        state.frames += len(step.frames)
        state.samples = step.samples
        state.log_seconds = (step.time_us - self._first_us) / 1e6
        if self._pacer is None:
            self._receiver.sent(step.samples, state.frames + state.clocks)
        self._show_if_due()

    def end(self) -> None:
        if self._pacer is None and not self._stop():
            self._receiver.wait_for_all(self._settings.acknowledge_s)
        self._look(LAST_WORDS_S)
        if self._show is not None:
            self._show(self.state)

    def _send_one(self, frame: can.Message) -> None:
        if not self._port.send(frame) and self._pacer is None:
            raise CangaugeError(
                f"{self._port.name}: the transmit queue stays full; is the bus up, with somebody"
                " to acknowledge frames?"
            )

    def _show_if_due(self) -> None:
        now_s = time.monotonic()
        if now_s >= self._show_s:
            self._show_s = now_s + SHOW_EVERY_S
            self._look(LISTEN_S)
            if self._show is not None:
                self._show(self.state)

    def _look(self, within_s: float) -> None:
        state = self.state
        if self._first_us is not None:
            state.seconds = time.monotonic() - self._began_s
        self._receiver.listen(within_s)
        state.soc = self._receiver.soc
        if state.acknowledged is not None:
            state.acknowledged = self._receiver.acknowledged

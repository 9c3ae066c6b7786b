"""Playing steps on a bus: in time, or as fast as the receiver acknowledges."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import can

from cangauge.bus.publish import FrameIds, SocEstimate, SocReader
from cangauge.bus.receive import BusPort
from cangauge.bus.time_source import ClockFrames
from cangauge.errors import CangaugeError, InputError
from cangauge.replay.acknowledge import Receiver
from cangauge.replay.pace import Pacer
from cangauge.replay.steps import Source, Step

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
    port: BusPort,
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
    port : BusPort
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
        port: BusPort,
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

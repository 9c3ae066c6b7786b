"""What the loop does now and then beside its frames: saves, re-reads, tells of losses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from cangauge.bus.receive import BusPort
from cangauge.bus.voice import Voice
from cangauge.errors import CangaugeError

LOOK_EVERY_S: Final = 0.1

CHECKPOINT_EVERY_S: Final = 10.0
"""How often the state is saved [s]: a service that is killed, writes for a while and takes three
seconds to start again then has missed less than half a minute of charge, however it flowed. A
state of 20 kB makes 0.2 GB of writing a day."""

FIRST_CHECKPOINT_S: Final = 1.0
"""The first checkpoint comes so soon, lest a service that is killed again and again keeps nothing
[s]."""


class Upkeep:
    """Looks after what needs no more than a glance every `LOOK_EVERY_S`.

    Parameters
    ----------
    port : BusPort
        Whose receive queue is watched.
    checkpoint : callable, optional
        Saves the state; called after `FIRST_CHECKPOINT_S`, every `every_s`, and at the end.
    every_s : float
    warn : callable, optional
        Takes a line of text.
    """

    def __init__(
        self,
        port: BusPort,
        checkpoint: Callable[[], None] | None = None,
        every_s: float = CHECKPOINT_EVERY_S,
        warn: Callable[[str], None] | None = None,
    ) -> None:
        self._port = port
        self._checkpoint = checkpoint
        self.every_s = every_s
        self._voice = Voice(warn) if warn is not None else None
        self._look_s = 0.0
        self._save_s: float | None = None
        self._drops = 0

    def look(self, now_s: float) -> None:
        """Do what is due (monotonic time [s])."""
        if now_s < self._look_s:
            return
        self._look_s = now_s + LOOK_EVERY_S
        self._watch_queue()
        if self._voice is not None:
            self._voice.look()
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
            self._say(
                f"warning: {self._port.name}: the receive queue overflowed:"
                f" {drops - self._drops} frames lost ({drops} so far)"
            )
            self._drops = drops

    def _save(self) -> None:
        if self._checkpoint is None:
            return
        try:
            self._checkpoint()
        except (OSError, CangaugeError) as error:
            # A full disk must not stop the estimate.
            self._say(f"warning: the state could not be saved: {error}")

    def _say(self, text: str) -> None:
        if self._voice is not None:
            self._voice.say(text)

"""Saying what happens to a bus without flooding anybody: a line a second at most."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Final

EVERY_S: Final = 1.0


class Voice:
    """Says lines, at most one in `EVERY_S`; of those that come sooner the last is said later.

    Parameters
    ----------
    say : callable
        Takes a line of text.
    clock : callable, optional
        Returns monotonic time [s].
    """

    def __init__(
        self, say: Callable[[str], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._say = say
        self._clock = clock
        self._last_s = -math.inf
        self._held: str | None = None
        self._left_out = 0

    def say(self, text: str) -> None:
        """Say a line now, or when it is time (see `look`)."""
        if self._held is not None:
            self._left_out += 1
        self._held = text
        self.look()

    def look(self) -> None:
        """Say what was held back, if it is time."""
        if self._held is None:
            return
        now_s = self._clock()
        if now_s - self._last_s < EVERY_S:
            return
        text = self._held
        if self._left_out:
            text += f" (lines left out: {self._left_out})"
        self._held, self._left_out, self._last_s = None, 0, now_s
        self._say(text)

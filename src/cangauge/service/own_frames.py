"""Detect another sender of the service's own ids, which would make the SoC jump between two values.

A bus may return the frames that were sent on it: those echoes prove nothing.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

import can

from cangauge.bus.decoder import SUSPECTED_FOR_S

FOREIGN_FRAMES: Final = 3
FOREIGN_WITHIN_S: Final = 5.0
"""Foreign frames with own ids within this time [s] that prove another sender."""
ECHOES_KEPT: Final = 1024
"""Latest own frames whose echoes are always awaited: they wait on a bus without a receiver."""
ECHO_WITHIN_S: Final = 1.0
"""Time after which the echo of a sent frame has arrived [s], transmit queue included. It may wait
longer in the receive queue."""


class OwnFrames:
    """Distinguish the echoes of own frames from frames of another sender with the same ids.

    Parameters
    ----------
    echoes : bool
        Whether the bus returns own frames (see `BusAddress`).

    Attributes
    ----------
    foreign : int
        Number of frames from another sender.
    """

    def __init__(self, *, echoes: bool) -> None:
        self.foreign = 0
        self._echoes = echoes
        self._sent: deque[tuple[int, bytes]] = deque()
        self._sent_s: deque[float] = deque()
        self._foreign_s: deque[float] = deque(maxlen=FOREIGN_FRAMES)
        self._shared_until_s = -math.inf

    def note_sent(self, message: can.Message, now_s: float) -> None:
        """Record an own frame, whose echo may be received, and the steady time [s]."""
        if self._echoes:
            self._sent.append((message.arbitration_id, bytes(message.data)))
            self._sent_s.append(now_s)

    def forget(self, drained_s: float) -> None:
        """Await no echo that would have been received before a steady time [s].

        Those of the latest frames are always awaited.
        """
        while len(self._sent) > ECHOES_KEPT and self._sent_s[0] < drained_s - ECHO_WITHIN_S:
            self._sent_s.popleft()
            self._sent.popleft()

    def is_echo(self, message: can.Message) -> bool:
        """Return whether a received frame is the echo of an own one, which is then forgotten."""
        frame = (message.arbitration_id, bytes(message.data))
        if frame not in self._sent:
            return False
        # Each echo comes once and in order; skipped ones are lost. So identical frames of another
        # sender are detected as well: as surplus echoes.
        is_found = False
        while not is_found:
            self._sent_s.popleft()
            is_found = self._sent.popleft() == frame
        return True

    def proves_another(self, now_s: float) -> bool:
        """Count a foreign frame; return whether there are enough, at a monotonic time [s]."""
        self.foreign += 1
        self._foreign_s.append(now_s)
        is_recent = now_s - self._foreign_s[0] <= FOREIGN_WITHIN_S
        is_proven = is_recent and len(self._foreign_s) == FOREIGN_FRAMES
        if is_proven:
            self._shared_until_s = now_s + SUSPECTED_FOR_S
        return is_proven

    def is_shared(self, now_s: float) -> bool:
        """Return whether another sender was proven lately, at a monotonic time [s]."""
        return now_s < self._shared_until_s

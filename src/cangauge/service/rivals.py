"""Noticing that somebody else sends the frames that this service publishes.

Two services with the same ids leave whoever reads them with a SoC that jumps between two values.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Final

import can
from can.typechecking import CanFilter

from cangauge.bus.publish import FrameIds, standard_filter

SEEN: Final = 3
"""So many frames within `WITHIN_S` are no accident."""

WITHIN_S: Final = 5.0
AGAIN_S: Final = 600.0
"""While it lasts, it is warned of so often [s]."""

_REMEMBERED: Final = 64


class Rivals:
    """Tells one's own frames that come back from those of others.

    Parameters
    ----------
    ids : FrameIds
        What this service publishes.
    echoes : bool
        Whether the bus hands one's own frames back (see `InterfaceFacts`).
    warn : callable, optional
        Takes a line of text.

    Attributes
    ----------
    frames : int
        Frames with own ids that others sent.
    ids : frozenset of int
        What it looks out for.
    """

    def __init__(
        self, ids: FrameIds, *, echoes: bool, warn: Callable[[str], None] | None = None
    ) -> None:
        self.frames = 0
        self._echoes = echoes
        self._warn = warn
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
        if is_many and now_s >= self._quiet_until_s and self._warn is not None:
            self._quiet_until_s = now_s + AGAIN_S
            self._warn(
                f"warning: somebody else sends 0x{frame_id:X} on this bus, which this service"
                " publishes: is another one running? Give one of them other ids"
                " (--soc-estimate-id, --soc-detail-id)"
            )

"""Ask a battery controller for its replies over ISO-TP: requests and flow control, one at a time.

A state machine without a bus or a clock: `due` returns the request to send, `take` what a reply's
first frame must be answered with. The replies themselves become signals as those that others poll
(`isotp`). Requests stop while another tester asks: two of them spoil each other's replies.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Final

import can

from cangauge.bus.isotp import Reassembler

REPLY_WITHIN_S: Final = 1.0
"""Longest wait for a reply's next frame [s]: N_Cr of ISO 15765-2; a request without one failed."""

PENDING_WITHIN_S: Final = 5.0
"""Longest wait after "response pending" [s]: P2* of ISO 14229-2."""

SLOWEST_S: Final = 60.0
"""Longest interval between requests for a reply that does not come [s]."""

OTHER_TESTER_S: Final = 30.0
"""Silence of another tester after which requests are sent again [s]: applications of drivers ask
every few seconds."""

BETWEEN_S: Final = 0.05
"""Shortest time from the end of one exchange to the next request [s]."""

_NEGATIVE, _RESPONSE_PENDING = 0x7F, 0x78
_REPLY_OFFSET: Final = 0x40
_PADDING: Final = 0x00
_CONTINUE: Final = bytes([0x30, 0x00, 0x00])
"""Flow control: continue to send, all frames, without a pause."""


@dataclass(frozen=True, slots=True)
class PollTarget:
    """A reply to ask for.

    Parameters
    ----------
    request_id, reply_id : int
        Standard ids of the frames.
    reply : tuple of int
        First two bytes of the reply, such as (0x61, 0x04); the request is `21 04`.
    """

    request_id: int
    reply_id: int
    reply: tuple[int, int]

    @property
    def request(self) -> bytes:
        """Payload of the request."""
        return bytes([self.reply[0] - _REPLY_OFFSET, self.reply[1]])


@dataclass(slots=True)
class PollCounts:
    """What came of the requests.

    Parameters
    ----------
    requests, answers, negative, unanswered : int
        Requests sent; their replies; negative ones among these; requests without a reply.
    other_tester : int
        Frames of another tester.
    """

    requests: int = 0
    answers: int = 0
    negative: int = 0
    unanswered: int = 0
    other_tester: int = 0

    def to_dict(self) -> dict[str, int]:
        """Return the counts by name."""
        return asdict(self)


@dataclass(slots=True)
class _Turn:
    target: PollTarget
    due_s: float = -math.inf
    failures: int = 0


class Poller:
    """Requests for replies in turn, one at a time.

    Parameters
    ----------
    targets : iterable of PollTarget
    every_s : float
        Interval between requests for the same reply [s]; doubled after each failure, up to
        `SLOWEST_S`.

    Attributes
    ----------
    counts : PollCounts
    request_ids, reply_ids : frozenset of int
    """

    def __init__(self, targets: Iterable[PollTarget], every_s: float) -> None:
        self._turns = [_Turn(target) for target in targets]
        self._every_s = every_s
        self._waiting: _Turn | None = None
        self._give_up_s = math.inf
        self._quiet_until_s = -math.inf
        self._reassembler = Reassembler()
        self.counts = PollCounts()
        self.request_ids = frozenset(turn.target.request_id for turn in self._turns)
        self.reply_ids = frozenset(turn.target.reply_id for turn in self._turns)

    def is_paused(self, now_s: float) -> bool:
        """Return whether another tester asked lately, at a monotonic time [s]."""
        return now_s < self._quiet_until_s

    def due(self, now_s: float) -> can.Message | None:
        """Return the request to send at a monotonic time [s], if one is due."""
        if self._waiting is not None:
            if now_s < self._give_up_s:
                return None
            self.counts.unanswered += 1
            self._end(now_s, failed=True)
        if now_s < self._quiet_until_s:
            return None
        turn = min(self._turns, key=lambda each: each.due_s)
        if now_s < turn.due_s:
            return None
        self._waiting, self._give_up_s = turn, now_s + REPLY_WITHIN_S
        self._reassembler = Reassembler()
        self.counts.requests += 1
        request = turn.target.request
        return _frame(turn.target.request_id, bytes([len(request)]) + request)

    def take(self, message: can.Message, now_s: float) -> can.Message | None:
        """Take a frame of a reply at a monotonic time [s]; return the flow control to send."""
        turn = self._waiting
        if turn is None or message.arbitration_id != turn.target.reply_id or not message.data:
            return None
        reply = self._reassembler.take(message.data, now_s)
        if reply is not None:
            self._answered(turn, reply, now_s)
            return None
        kind = message.data[0] >> 4
        if kind in {1, 2}:
            self._give_up_s = now_s + REPLY_WITHIN_S
        if kind == 1 and tuple(message.data[2:4]) == turn.target.reply:
            return _frame(turn.target.request_id, _CONTINUE)
        return None

    def note_other_tester(self, now_s: float) -> None:
        """Pause, since a request came from somebody else."""
        self.counts.other_tester += 1
        self._quiet_until_s = now_s + OTHER_TESTER_S
        if self._waiting is not None:
            self._end(now_s, failed=False)

    def _answered(self, turn: _Turn, reply: bytes, now_s: float) -> None:
        if reply[:2] == bytes(turn.target.reply):
            self.counts.answers += 1
            self._end(now_s, failed=False)
        elif reply[:2] == bytes([_NEGATIVE, turn.target.request[0]]):
            if reply[2:3] == bytes([_RESPONSE_PENDING]):
                self._give_up_s = now_s + PENDING_WITHIN_S
                return
            self.counts.negative += 1
            self._end(now_s, failed=True)

    def _end(self, now_s: float, *, failed: bool) -> None:
        turn = self._waiting
        self._waiting = None
        if turn is None:
            return
        turn.failures = turn.failures + 1 if failed else 0
        # The exponent is bounded: 2 to the number of failures of a week is no float.
        wait_s = self._every_s * 2.0 ** min(turn.failures, 16)
        turn.due_s = now_s + min(wait_s, max(SLOWEST_S, self._every_s))
        for each in self._turns:
            each.due_s = max(each.due_s, now_s + BETWEEN_S)


def _frame(request_id: int, payload: bytes) -> can.Message:
    data = payload + bytes([_PADDING] * (8 - len(payload)))
    return can.Message(arbitration_id=request_id, is_extended_id=False, data=data)

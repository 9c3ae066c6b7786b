"""Requests for replies over ISO-TP, one at a time: a state machine without a bus or a clock.

`due` returns the request to send, `take` the answer to a reply's first frame. Requests stop while
another tester asks: two of them spoil each other's replies.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final

import can

from cangauge.bus.isotp import CONSECUTIVE, FIRST, LONGEST_GAP_S, PollTarget, Reassembler

EXCHANGE_WITHIN_S: Final = 5.0
"""Longest time from a request to its whole reply, also after "response pending" [s]: P2* of
ISO 14229-2."""
PER_NODE_S: Final = 1.0
"""Shortest interval of the requests to one node, whatever it answers [s], as of drivers' apps."""
SLOWEST_S: Final = 60.0
"""Longest interval of the requests for a reply that does not come [s]."""
OTHER_TESTER_S: Final = 30.0
"""Silence of another tester after which requests are sent again [s]: drivers' apps ask often."""


class Poller:
    """Requests for replies in turn, one at a time; all times are monotonic [s].

    Parameters
    ----------
    targets : iterable of PollTarget
    every_s : float
        Interval between requests for the same reply [s]; doubled after each failure, up to
        `SLOWEST_S`.
    asked_s : dict of int to float, optional
        When each node was asked last, of an earlier poller on the same bus.

    Attributes
    ----------
    counts : dict of str to int
        Requests by outcome: negative ones are no answers. Frames of another tester.
    request_ids, reply_ids : frozenset of int
    """

    def __init__(
        self, targets: Iterable[PollTarget], every_s: float, asked_s: dict[int, float] | None = None
    ) -> None:
        self._due_s = dict.fromkeys(targets, -math.inf)
        self._failures = dict.fromkeys(self._due_s, 0)  # in a row
        self._every_s = every_s
        self.asked_s = asked_s or {}
        self._awaited: PollTarget | None = None
        self._give_up_s = self._exchange_ends_s = math.inf
        self._quiet_until_s = -math.inf
        self._may_continue = False
        self._reassembler = Reassembler()
        outcomes = ("requests", "answers", "negative", "unanswered", "other_tester")
        self.counts = dict.fromkeys(outcomes, 0)
        self.request_ids = frozenset(target.request_id for target in self._due_s)
        self.reply_ids = frozenset(target.reply_id for target in self._due_s)

    def due(self, now_s: float) -> can.Message | None:
        """Return the request to send, if one is due."""
        if self._awaited is not None:
            if now_s < self._give_up_s:
                return None
            self.counts["unanswered"] += 1
            self._end(self._awaited, now_s, failed=True)
        # Of several that are due, the one that has waited longest since it was due.
        target = min(self._due_s, key=lambda each: (self._next_s(each), self._due_s[each]))
        if now_s < max(self._next_s(target), self._quiet_until_s):
            return None
        self.asked_s[target.request_id] = now_s
        self._awaited = target
        self._give_up_s = now_s + LONGEST_GAP_S
        self._exchange_ends_s = now_s + EXCHANGE_WITHIN_S
        self._may_continue = True
        self._reassembler = Reassembler()
        self.counts["requests"] += 1
        return _frame(target.request_id, bytes([len(target.request)]) + target.request)

    def _next_s(self, target: PollTarget) -> float:
        last_s = self.asked_s.get(target.request_id, -math.inf)
        return max(self._due_s[target], last_s + PER_NODE_S)

    def take(self, message: can.Message, now_s: float) -> can.Message | None:
        """Take a frame of a reply; return the flow control to send."""
        target = self._awaited
        if target is None or message.arbitration_id != target.reply_id or not message.data:
            return None
        reply = self._reassembler.take(message.data, now_s)
        if reply is None:
            kind = message.data[0] >> 4
            if kind in {FIRST, CONSECUTIVE}:
                self._give_up_s = min(now_s + LONGEST_GAP_S, self._exchange_ends_s)
            is_ours = kind == FIRST and message.data[2:].startswith(target.reply)
            if is_ours and self._may_continue:  # once: a node may repeat its first frame for ever
                self._may_continue = False
                # Flow control: continue to send, all frames, without a pause.
                return _frame(target.request_id, bytes([0x30, 0x00, 0x00]))
        elif reply.startswith(target.reply):
            self.counts["answers"] += 1
            self._end(target, now_s, failed=False)
        elif reply[:2] == bytes([0x7F, target.request[0]]):
            if reply[2:3] == b"\x78":  # response pending
                self._give_up_s = self._exchange_ends_s
            else:
                self.counts["negative"] += 1
                self._end(target, now_s, failed=True)
        return None

    def note_other_tester(self, now_s: float) -> None:
        """Pause, since a request came from somebody else."""
        self.counts["other_tester"] += 1
        self._quiet_until_s = now_s + OTHER_TESTER_S
        if self._awaited is not None:
            self._end(self._awaited, now_s, failed=False)

    def _end(self, target: PollTarget, now_s: float, *, failed: bool) -> None:
        self._awaited = None
        self._failures[target] = self._failures[target] + 1 if failed else 0
        # The exponent is bounded: 2 to the number of failures of a week is no float.
        wait_s = self._every_s * 2.0 ** min(self._failures[target], 16)
        self._due_s[target] = now_s + min(wait_s, max(SLOWEST_S, self._every_s))


def _frame(request_id: int, payload: bytes) -> can.Message:
    return can.Message(
        arbitration_id=request_id, is_extended_id=False, data=payload.ljust(8, b"\0")
    )

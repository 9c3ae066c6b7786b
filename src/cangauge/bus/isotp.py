"""Replies over ISO-TP (ISO 15765-2) in frames that others exchange: reassembly, nothing is sent.

Bus time drives it, not a clock: a recorded exchange gives the same replies as a live one. The
stacks of libraries answer with flow control and time out by the clock, so they do not serve here.
"""

from __future__ import annotations

from typing import Final

LONGEST_GAP_S: Final = 1.0
"""Longest time between frames of one reply [s]: N_Cr of ISO 15765-2."""
_SINGLE, _FIRST, _CONSECUTIVE = range(3)


def reply_key(reply_id: int, payload: bytes | bytearray) -> int:
    """Return the id of a reply's message in a DBC: the frames' id, then two bytes of the payload.

    A reply `61 04 …` on 0x7BB is the message 0x7BB6104.
    """
    return reply_id << 16 | payload[0] << 8 | payload[1]


def reply_id(key: int) -> int:
    """Return the id of the frames that carry a reply; see `reply_key`."""
    return key >> 16 & 0x7FF


class Reassembler:
    """Replies of one sender, from its frames.

    Attributes
    ----------
    lost : int
        Replies given up: a frame missing, out of order or late.
    """

    def __init__(self) -> None:
        self.lost = 0
        self._payload = bytearray()
        self._length = 0
        self._sequence = 0
        self._last_s = 0.0

    def take(self, data: bytes | bytearray, time_s: float) -> bytes | None:
        """Take a frame at bus time `time_s` [s]; return the reply that it completes, if any."""
        if not data:
            return None
        kind, low = data[0] >> 4, data[0] & 0x0F
        if kind == _SINGLE:
            self._give_up()
            # CAN FD: the length is in the second byte.
            start, length = (2, data[1]) if low == 0 and len(data) > 8 else (1, low)
            return bytes(data[start : start + length]) if 0 < length <= len(data) - start else None
        if kind == _FIRST and len(data) >= 2:
            self._give_up()
            self._length = low << 8 | data[1]
            self._payload = bytearray(data[2:])
            self._sequence, self._last_s = 1, time_s
            if self._length <= len(self._payload):
                self._length = 0
            return None
        if kind == _CONSECUTIVE and self._length:
            if low != self._sequence & 0x0F or not 0.0 <= time_s - self._last_s <= LONGEST_GAP_S:
                self._give_up()
                return None
            self._sequence, self._last_s = self._sequence + 1, time_s
            self._payload += data[1:]
            if len(self._payload) >= self._length:
                reply, self._length = bytes(self._payload[: self._length]), 0
                return reply
        return None

    def _give_up(self) -> None:
        self.lost += self._length > 0
        self._length = 0

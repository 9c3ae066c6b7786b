"""Replies over ISO-TP (ISO 15765-2): their keys in a DBC, and reassembly from frames.

Replies become signals as any frame. Bus time drives the `Reassembler`, not a clock, so that a
recorded exchange gives the same replies as a live one; the stacks of libraries answer with flow
control and time out by the clock. `service.polling` asks for them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

LONGEST_GAP_S: Final = 1.0
"""Longest time between frames of one reply [s]: N_Cr of ISO 15765-2."""

SINGLE, FIRST, CONSECUTIVE = range(3)
"""Kinds of frames, in the upper half of their first byte."""
REPLY_BIT: Final = 0x40
"""Added to the first byte of a request in the reply to it."""
READ_BY_IDENTIFIER: Final = 0x62
"""First byte of a reply to ReadDataByIdentifier (22), before two bytes of the data identifier."""


def reply_start(key: int, is_uds: bool) -> bytes:
    """Return the first bytes of the reply that a message of the DBC is.

    Its id is the frames' id, then two bytes of the reply: 0x7BB6104 is a reply `61 04 …` on 0x7BB.
    Where `is_uds`, they are a data identifier: 0x7EC0101 is a reply `62 01 01 …` on 0x7EC.
    """
    low = (key & 0xFFFF).to_bytes(2, "big")
    return bytes([READ_BY_IDENTIFIER]) + low if is_uds else low


def reply_id(key: int) -> int:
    """Return the id of the frames that carry a reply; see `reply_start`."""
    return key >> 16 & 0x7FF


class Reassembler:
    """Replies of one sender, from its frames; lost are those with one missing, late or swapped.

    A first byte that is no kind of frame is the receiver's address (extended addressing, such as
    BMW's 0x607 to the tester 0xF1): the frame begins after it. `frames` counts them.
    """

    def __init__(self) -> None:
        self.frames = 0
        self._payload = bytearray()
        self._length = self._sequence = 0
        self._last_s = 0.0

    def take(self, data: bytes | bytearray, time_s: float) -> bytes | None:
        """Take a frame at bus time `time_s` [s]; return the reply that it completes, if any."""
        self.frames += 1
        if data and data[0] > 0x3F:  # the largest first byte of a frame, of flow control
            data = data[1:]
        if not data:
            return None
        kind, low = data[0] >> 4, data[0] & 0x0F
        if kind == SINGLE:
            # CAN FD: the length is in the second byte.
            start, length = (2, data[1]) if low == 0 and len(data) > 8 else (1, low)
            self._length = 0
            return bytes(data[start : start + length]) if 0 < length <= len(data) - start else None
        if kind == FIRST and len(data) >= 2:
            self._payload, length = bytearray(data[2:]), low << 8 | data[1]
            self._length = length if length > len(self._payload) else 0
            self._sequence, self._last_s = 1, time_s
        elif kind == CONSECUTIVE and self._length:
            length, is_late = self._length, not 0.0 <= time_s - self._last_s <= LONGEST_GAP_S
            if low != self._sequence & 0x0F or is_late:
                self._length = 0
                return None
            self._sequence, self._last_s = self._sequence + 1, time_s
            self._payload += data[1:]
            if len(self._payload) >= length:
                self._length = 0
                return bytes(self._payload[:length])
        return None


@dataclass(frozen=True, slots=True)
class PollTarget:
    """A reply to ask for: standard ids of the frames, and the first bytes of the reply.

    The request for a reply `61 04` is `21 04`.
    """

    request_id: int
    reply_id: int
    reply: bytes

    @property
    def request(self) -> bytes:
        """Payload of the request."""
        return bytes([self.reply[0] - REPLY_BIT]) + self.reply[1:]

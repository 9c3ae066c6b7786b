"""Bus time of frames: the receive stamp, or the log time of a replay (REPLAY_CLOCK).

A live service first limits the stamps by its monotonic clock (`StampLimiter`), which no time server
sets. It records the limited stamps, so that a recording gives the same numbers.

`replay` sends REPLAY_CLOCK ahead of the frames of each log time, so that a replay at any speed
gives the same charge and the same delays. Times are whole microseconds, the resolution of most
capture formats, so that a live run and its recording see equal numbers.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Final, TypeVar

import can
from can.typechecking import Channel

from cangauge.bus.open import Stamps
from cangauge.bus.protection import RULES
from cangauge.estimation.counting import LATEST_S
from cangauge.settings import REPLAY_CLOCK_ID, TimeSourceName

_T = TypeVar("_T")

MICROSECONDS: Final = 1e6
"""Unit of REPLAY_CLOCK [1/s]."""

COUNT_EVERY: Final = 64
"""Log times between two REPLAY_COUNT: less than 1 % more frames."""
OUT_OF_ORDER_S: Final = 1.0
"""A larger step back in time [s] means a clock that was set, or a new log; a smaller one is a
matter of the order of writing."""


def whole_us(time_s: float) -> int:
    """Return a time [s] in whole microseconds."""
    return round(time_s * MICROSECONDS)


class ReceiveTime:
    """Receive stamps.

    After a step back of more than `OUT_OF_ORDER_S` time continues from the latest stamp, so that
    setting the clock does not stop the estimate. A step forward is a gap.
    """

    def __init__(self) -> None:
        self.beginnings = self.lost = self.steps_back = 0
        self._latest_us: int | None = None
        self._shift_us = 0

    def time_of(self, message: can.Message) -> float | None:
        """Return the bus time of a frame [s]."""
        latest_us = self._latest_us
        stamp_s = message.timestamp
        if not abs(stamp_s) <= LATEST_S:  # NaN too
            return (latest_us or 0) / MICROSECONDS
        now_us = round(stamp_s * MICROSECONDS) + self._shift_us
        if latest_us is None or now_us >= latest_us:
            self._latest_us = now_us
        elif latest_us - now_us > OUT_OF_ORDER_S * MICROSECONDS:
            self._shift_us += latest_us - now_us
            now_us = latest_us
            self.steps_back += 1
        return now_us / MICROSECONDS


TOLERANCE_S: Final[dict[Stamps, float]] = {"kernel": 0.02, "sender": 0.02, "driver": 0.25}
"""Difference of a stamp from the monotonic clock that is no error [s], by the stamps' origin. Of
this machine's clocks it is scheduling between two readings; an adapter delivers the time of its own
clock with its latency."""
STEP_AFTER_S: Final = 1.0
"""Time over which stamps must be off by the same amount to prove a set clock [s]."""
UNCERTAIN_AFTER_S: Final = 2.0
CERTAIN_AFTER_S: Final = 10.0
"""Time over which stamps were unusable, from which time is uncertain [s]: longer than it takes to
recognise a set clock; time without an unusable stamp after which it is certain again [s]."""


class StampLimiter:
    """Limit stamps to the interval in which the frames can have arrived by the monotonic clock.

    A frame received now arrived after the receive queue was last seen empty. A stamp outside this
    interval, by more than `tolerance_s`, is replaced by the time of reading; so bus time keeps the
    right rate whatever the stamps do. Stamps that are off by a constant amount come from a clock
    that was set: they are shifted from then on, and exact again.

    Attributes
    ----------
    offset_s : float
        Stamps, and so bus time, minus monotonic time [s]; NaN: known from the first frame.
    shift_s : float
        Added to the stamps at present [s].
    """

    def __init__(self, tolerance_s: float, offset_s: float = math.nan) -> None:
        self._tolerance_s, self.offset_s = tolerance_s, offset_s
        self.shift_s = 0.0
        # Of the first of replaced stamps in a row that are off by the same amount.
        self._off_s = self._off_since_s = math.nan
        self._unusable_since_s = self._unusable_s = -math.inf

    def limit(self, messages: Iterable[can.Message], since_s: float, now_s: float) -> float:
        """Set the stamps of frames that were received together.

        `since_s` and `now_s` are monotonic times [s]: the receive queue was last seen empty; the
        frames were read. Returns the one at which the last of them arrived.
        """
        stamp_s = math.nan
        for message in messages:
            stamp_s = message.timestamp + self.shift_s
            early_s = since_s + self.offset_s - self._tolerance_s
            if early_s <= stamp_s <= now_s + self.offset_s + self._tolerance_s:
                self._off_s = math.nan
            else:
                stamp_s = self._replaced(stamp_s, now_s)
            message.timestamp = stamp_s
        return min(stamp_s - self.offset_s, now_s)

    def is_uncertain(self, now_s: float) -> bool:
        """Return whether the stamps are unusable at a monotonic time [s]."""
        lasting_s = self._unusable_s - self._unusable_since_s
        return now_s - self._unusable_s < CERTAIN_AFTER_S and lasting_s >= UNCERTAIN_AFTER_S

    def _replaced(self, stamp_s: float, now_s: float) -> float:
        """Return the time that replaces a stamp outside the interval [s]."""
        if math.isnan(self.offset_s):
            self.offset_s = (stamp_s if abs(stamp_s) <= LATEST_S else 0.0) - now_s
            return now_s + self.offset_s
        if now_s - self._unusable_s >= CERTAIN_AFTER_S:
            self._unusable_since_s = now_s
        self._unusable_s = now_s
        off_s = stamp_s - now_s - self.offset_s
        if not abs(off_s - self._off_s) <= self._tolerance_s:  # NaN too
            self._off_s, self._off_since_s = off_s, now_s
        elif now_s - self._off_since_s >= STEP_AFTER_S:
            self.shift_s -= max(off_s, self._off_s)  # the larger one was delayed less on its way
        return now_s + self.offset_s


_STEADY: Final[int | None] = getattr(time, "CLOCK_BOOTTIME", None)


def steady_s() -> float:
    """Return a monotonic time that counts a suspended machine too, where the system has one [s]."""
    return time.clock_gettime(_STEADY) if _STEADY is not None else time.monotonic()


class ReplayClock:
    """Log time of a replay; a step back of more than `OUT_OF_ORDER_S` begins a new log.

    `refused` counts clock frames with a wrong CRC or length; `lost` those that did not come, by the
    counts that the replay sends among them.
    """

    def __init__(self, frame_id: int = REPLAY_CLOCK_ID) -> None:
        self.beginnings = self.refused = self.lost = self.steps_back = 0
        self._received = 0
        self._sent: int | None = None  # by the latest count
        self._id = frame_id
        self._now_us: int | None = None

    def time_of(self, message: can.Message) -> float | None:
        """Return the log time of the latest REPLAY_CLOCK [s]; None before, and for the clock."""
        if not is_clock(message, self._id):
            if is_count(message, self._id):
                self._compare(int.from_bytes(message.data[:-1], "little"))
                return None
            return None if self._now_us is None else self._now_us / MICROSECONDS
        now_us = log_time_us(message.data)
        if now_us is None:
            self.refused += 1
            return None
        self._received += 1
        if self._now_us is not None and now_us < self._now_us - OUT_OF_ORDER_S * MICROSECONDS:
            self.beginnings += 1
        self._now_us = now_us
        return None

    def _compare(self, sent: int) -> None:
        """Count the clock frames that have not come since the count before."""
        if self._sent is not None and sent >= self._sent:  # else another replay has begun
            self.lost += max(sent - self._sent - self._received, 0)
        self._sent, self._received = sent, 0

    def resume(self, time_s: float) -> None:
        """Continue from a log time [s] after a restart: an earlier one begins a new log."""
        self._now_us = whole_us(time_s)


TimeSource = ReceiveTime | ReplayClock
"""Source of the bus time of each frame: `time_of`, `beginnings`, the number of new logs after the
first, `steps_back` of receive stamps, and `lost`, the frames of a replay's clock that did not
come."""


def time_source(name: TimeSourceName, clock_id: int = REPLAY_CLOCK_ID) -> TimeSource:
    """Return a new time source by its name."""
    return ReceiveTime() if name == "receive" else ReplayClock(clock_id)


def is_clock(message: can.Message, clock_id: int = REPLAY_CLOCK_ID) -> bool:
    """Return whether a frame is a REPLAY_CLOCK."""
    return message.arbitration_id == clock_id and not (
        message.is_extended_id or message.is_error_frame or message.is_remote_frame
    )


def is_count(message: can.Message, clock_id: int = REPLAY_CLOCK_ID) -> bool:
    """Return whether a frame is a REPLAY_COUNT: how many REPLAY_CLOCK came before it."""
    is_candidate = message.arbitration_id == clock_id - 1 and not message.is_extended_id
    return is_candidate and len(message.data) == 5 and RULES["crc_only"].is_whole(message.data)


def log_time_us(data: bytes | bytearray) -> int | None:
    """Return the time in the payload of a REPLAY_CLOCK [µs]; None for a wrong CRC or length."""
    is_whole = len(data) == 8 and RULES["crc_only"].is_whole(data)
    return int.from_bytes(data[:-1], "little", signed=True) if is_whole else None


def clock_frame(time_us: int, clock_id: int = REPLAY_CLOCK_ID) -> can.Message:
    """Return the REPLAY_CLOCK of a log time [µs]."""
    return _with_crc(clock_id, time_us.to_bytes(7, "little", signed=True))


def count_frame(sent: int, clock_id: int = REPLAY_CLOCK_ID) -> can.Message:
    """Return the REPLAY_COUNT after `sent` frames with log times."""
    return _with_crc(clock_id - 1, (sent % (1 << 32)).to_bytes(4, "little"))


def _with_crc(frame_id: int, content: bytes) -> can.Message:
    data = RULES["crc_only"].protect(content + bytes(1), 0)
    return can.Message(arbitration_id=frame_id, is_extended_id=False, data=data)


# --- Captures


def recorded_time_source(
    messages: Iterable[can.Message], clock_id: int = REPLAY_CLOCK_ID
) -> TimeSourceName:
    """Return which bus time a capture has: log time, if its first frame with the id is a clock.

    A car's own message of that id has another CRC.
    """
    first = next((each for each in messages if is_clock(each, clock_id)), None)
    return "receive" if first is None or log_time_us(first.data) is None else "replay-clock"


def frames_of_buses(
    messages: Iterable[can.Message],
    buses: dict[Channel | None, _T],
    open_bus: Callable[[TimeSourceName], _T],
    clock_id: int = REPLAY_CLOCK_ID,
) -> Iterator[tuple[_T, can.Message]]:
    """Yield the frames of a capture, each with its bus, from the beginning of a replay if any.

    Each bus has its own time: stamps of two buses can be of two adapters. `open_bus` makes one by
    its time source; `buses` holds them by channel, and is emptied where a replay begins.
    """
    source: TimeSourceName | None = None
    for message in messages:
        if source is None and is_clock(message, clock_id):
            source = recorded_time_source([message], clock_id)
            if source == "replay-clock":
                buses.clear()
        if message.channel not in buses:
            buses[message.channel] = open_bus(source or "receive")
        yield buses[message.channel], message

"""Bus time: what a frame's time is, live and in a capture, to the microsecond.

Two sources. `receive` is the frame's receive stamp. `replay-clock` is the log time that `replay`
tells in REPLAY_CLOCK ahead of the frames that it belongs to, so that a replay at any speed gives
the same charge and the same delays.

Time is counted in whole microseconds: captures hold no more in most formats, so that a live run
and its own recording see the same numbers, to the last bit.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final, Literal, Protocol, get_args

import can

from cangauge._resources import shared_file
from cangauge.bus.database import SignalCodec, load_dbc, signal_codec
from cangauge.bus.protection import CRC_ONLY_RULE

TimeSourceName = Literal["receive", "replay-clock"]
TIME_SOURCES: Final[tuple[str, ...]] = get_args(TimeSourceName)

REPLAY_CLOCK_ID: Final = 0x5AF

STEP_BACK_S: Final = 1.0
"""Time that runs backwards by more than this was set, or is that of a new log [s]."""


def whole_us(time_s: float) -> int:
    """Return a time [s] in microseconds, rounded to a whole number."""
    return round(time_s * 1e6)


class TimeSource(Protocol):
    """Says what the time of a frame is."""

    beginnings: int
    """How often time began anew so far (a new log is replayed)."""

    def time_of(self, message: can.Message) -> float | None:
        """Return the frame's bus time [s]; None for one that has none or is itself the clock."""


class ReceiveTime:
    """The receive stamp.

    A clock that is set back by more than `STEP_BACK_S` does not stop the estimate until it has
    caught up: time then runs on from where it was. (A clock that is set forward looks like a gap.)

    Attributes
    ----------
    steps_back : int
        How often the clock was set back.
    """

    def __init__(self) -> None:
        self.beginnings = 0
        self.steps_back = 0
        self._last_us: int | None = None
        self._shift_us = 0

    def time_of(self, message: can.Message) -> float | None:
        """Return the frame's bus time [s]."""
        now_us = round(message.timestamp * 1e6) + self._shift_us  # `whole_us`, of every frame
        last_us = self._last_us
        if last_us is not None and now_us < last_us - STEP_BACK_S * 1e6:
            self.steps_back += 1
            self._shift_us += last_us - now_us
            now_us = last_us
        self._last_us = now_us
        return now_us / 1e6


class ReplayClock:
    """The log time that REPLAY_CLOCK tells; when it jumps back, a new log has begun.

    Parameters
    ----------
    frame_id : int
        REPLAY_CLOCK's id.

    Attributes
    ----------
    refused : int
        Clock frames with a wrong CRC or length.
    """

    def __init__(self, frame_id: int = REPLAY_CLOCK_ID) -> None:
        self.beginnings = 0
        self.refused = 0
        self._id = frame_id
        self._codec = _clock_codec()
        self._now_us: int | None = None

    def time_of(self, message: can.Message) -> float | None:
        """Return the log time [s] that the latest REPLAY_CLOCK told."""
        if is_clock(message, self._id):
            self._take(message)
            return None
        return None if self._now_us is None else self._now_us / 1e6

    def resume(self, time_s: float) -> None:
        """Go on after an interruption from a log time [s]: an earlier one is that of a new log."""
        self._now_us = whole_us(time_s)

    def _take(self, message: can.Message) -> None:
        data = message.data
        if len(data) != 8 or CRC_ONLY_RULE.crc(data) != data[CRC_ONLY_RULE.crc_byte]:
            self.refused += 1
            return
        now_us = int(self._codec.decode(data))
        if self._now_us is not None and now_us < self._now_us - STEP_BACK_S * 1e6:
            self.beginnings += 1
        self._now_us = now_us


def time_source(name: TimeSourceName, clock_id: int = REPLAY_CLOCK_ID) -> TimeSource:
    """Return a new time source by its name."""
    return ReceiveTime() if name == "receive" else ReplayClock(clock_id)


def is_clock(message: can.Message, clock_id: int = REPLAY_CLOCK_ID) -> bool:
    """Return whether a frame is a REPLAY_CLOCK."""
    return (
        message.arbitration_id == clock_id
        and not message.is_extended_id
        and not message.is_error_frame
        and not message.is_remote_frame
    )


class ClockFrames:
    """Makes REPLAY_CLOCK frames.

    Parameters
    ----------
    frame_id : int
    """

    def __init__(self, frame_id: int = REPLAY_CLOCK_ID) -> None:
        self._id = frame_id
        self._codec = _clock_codec()

    def at(self, time_us: int) -> can.Message:
        """Return the frame that tells a log time [µs]."""
        payload = bytearray(8)
        self._codec.encode_into(payload, float(time_us))
        return can.Message(
            arbitration_id=self._id,
            is_extended_id=False,
            data=CRC_ONLY_RULE.protect(payload, 0),
        )


@lru_cache(maxsize=1)
def _clock_codec() -> SignalCodec:
    path = shared_file("dbc", "soc_estimate.dbc")
    message = load_dbc(path).get_message_by_name("REPLAY_CLOCK")
    signal = message.get_signal_by_name("log_time_us")
    return signal_codec(message, signal, source=path, field="REPLAY_CLOCK")

"""Bus time of frames: the receive stamp, or the log time of a replay (REPLAY_CLOCK).

`replay` sends REPLAY_CLOCK ahead of the frames of each log time, so that a replay at any speed
gives the same charge and the same delays. Times are whole microseconds, the resolution of most
capture formats, so that a live run and its recording see equal numbers.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final, Literal, Protocol

import can

from cangauge._resources import shared_file
from cangauge.bus.database import SignalCodec, load_dbc, signal_codec
from cangauge.bus.protection import CRC_ONLY_RULE

TimeSourceName = Literal["receive", "replay-clock"]

REPLAY_CLOCK_ID: Final = 0x5AF

MICROSECONDS: Final = 1e6
"""Unit of REPLAY_CLOCK [1/s]."""

STEP_BACK_S: Final = 1.0
"""A larger step back in time [s] means a clock that was set, or a new log."""


def whole_us(time_s: float) -> int:
    """Return a time [s] in whole microseconds."""
    return round(time_s * MICROSECONDS)


class TimeSource(Protocol):
    """Source of the bus time of each frame."""

    beginnings: int
    """Number of new logs so far, after the first."""

    def time_of(self, message: can.Message) -> float | None:
        """Return the bus time of a frame [s]; None for a clock frame, or while not known."""


class ReceiveTime:
    """Receive stamps.

    After a step back of more than `STEP_BACK_S` time continues from the latest stamp, so that
    setting the clock does not stop the estimate. A step forward is a gap.

    Attributes
    ----------
    steps_back : int
        Number of such steps.
    """

    def __init__(self) -> None:
        self.beginnings = 0
        self.steps_back = 0
        self._last_us: int | None = None
        self._shift_us = 0

    def time_of(self, message: can.Message) -> float | None:
        """Return the bus time of a frame [s]."""
        now_us = round(message.timestamp * MICROSECONDS) + self._shift_us
        last_us = self._last_us
        if last_us is not None and now_us < last_us - STEP_BACK_S * MICROSECONDS:
            self.steps_back += 1
            self._shift_us += last_us - now_us
            now_us = last_us
        self._last_us = now_us
        return now_us / MICROSECONDS


class ReplayClock:
    """Log time of a replay; a step back of more than `STEP_BACK_S` begins a new log.

    Parameters
    ----------
    frame_id : int
        Id of REPLAY_CLOCK.

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
        """Return the log time of the latest REPLAY_CLOCK [s]; None before, and for the clock."""
        if is_clock(message, self._id):
            self._take(message)
            return None
        return None if self._now_us is None else self._now_us / MICROSECONDS

    def resume(self, time_s: float) -> None:
        """Continue from a log time [s] after a restart: an earlier one begins a new log."""
        self._now_us = whole_us(time_s)

    def _take(self, message: can.Message) -> None:
        data = message.data
        if len(data) != 8 or not CRC_ONLY_RULE.is_whole(data):
            self.refused += 1
            return
        now_us = int(self._codec.decode(data))
        if self._now_us is not None and now_us < self._now_us - STEP_BACK_S * MICROSECONDS:
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
    """Encode log times as REPLAY_CLOCK frames.

    Parameters
    ----------
    frame_id : int
    """

    def __init__(self, frame_id: int = REPLAY_CLOCK_ID) -> None:
        self._id = frame_id
        self._codec = _clock_codec()

    def at(self, time_us: int) -> can.Message:
        """Return the frame of a log time [µs]."""
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

"""Frames of a capture as streams: one id, one length, one value of its multiplexer."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any, Final

import can
import numpy as np
from numpy.typing import NDArray

from cangauge._typing import BoolArray, FloatArray, IntArray

MIN_FRAMES: Final = 12
"""Fewest frames of an id that can show how its bits move."""


@dataclass(frozen=True)
class Place:
    """Bits of a field: reading order, first and last position, sign.

    `constant` is what constant bits among them add to the number of those that toggle, `nature` the
    log prior that all are a measured number [nats].
    """

    is_motorola: bool
    first: int
    last: int
    is_signed: bool = False
    constant: int = 0
    nature: float = 0.0

    @property
    def width(self) -> int:
        """Number of bits."""
        return self.last - self.first + 1

    def start(self, length: int) -> int:
        """Return the start bit as in a DBC, for a frame of `length` bytes."""
        if self.is_motorola:
            return 8 * (self.first // 8) + 7 - self.first % 8
        return 8 * length - 1 - self.last

    def text(self, length: int) -> str:
        """Return its bits as in a DBC, such as "7|11@0-"."""
        order, sign = int(not self.is_motorola), "-" if self.is_signed else "+"
        return f"{self.start(length)}|{self.width}@{order}{sign}"

    def bits(self, length: int) -> frozenset[int]:
        """Return its bits in Motorola's reading order."""
        places = range(self.first, self.last + 1)
        return frozenset(places if self.is_motorola else (turned(each, length) for each in places))


@dataclass(eq=False)
class Stream:
    """Frames of one id on one bus, all of one length and one multiplexer value.

    Parameters
    ----------
    bus : str
    arbitration_id : int
    is_extended : bool
    time_s : array (n,)
    payload : array (n, length) of uint8
    selector : Place, optional
        The multiplexer.
    selected : int, optional
        Its value in these frames.
    """

    bus: str
    arbitration_id: int
    is_extended: bool
    time_s: FloatArray
    payload: NDArray[np.uint8]
    selector: Place | None = None
    selected: int | None = None

    @property
    def length(self) -> int:
        """Bytes of a frame."""
        return int(self.payload.shape[1])

    @property
    def period_s(self) -> float:
        """Median interval [s]."""
        return float(np.median(np.diff(self.time_s)))

    @property
    def name(self) -> str:
        """Id in hexadecimal."""
        return f"0x{self.arbitration_id:X}"

    def bits(self, place: Place) -> frozenset[tuple[int, bool, int]]:
        """Return the bits of a field, each with its id: a gateway repeats frames on other buses."""
        bits = place.bits(self.length)
        return frozenset((self.arbitration_id, self.is_extended, each) for each in bits)


def turned(place: int, length: int) -> int:
    """Return the position of a bit in the other reading order."""
    return 8 * (length - 1 - place // 8) + place % 8


def number_of(bits: NDArray[np.uint8], first: int, width: int) -> IntArray:
    """Return the unsigned number of `width` bits from `first` on, by frame."""
    return bits[:, first : first + width].astype(np.int64) @ (1 << np.arange(width - 1, -1, -1))


def collect(messages: Iterable[can.Message]) -> list[Stream]:
    """Return the streams of a capture; ids with too few frames are left out."""
    frames: dict[tuple[Any, int, bool], list[tuple[float, bytes]]] = defaultdict(list)
    for message in messages:
        if message.data and not message.is_error_frame and not message.is_remote_frame:
            key = (message.channel, message.arbitration_id, message.is_extended_id)
            frames[key].append((message.timestamp, bytes(message.data)))
    streams = []
    for (channel, number, is_extended), all_of_id in frames.items():
        length = int(np.bincount([len(data) for _, data in all_of_id]).argmax())
        own = sorted((each for each in all_of_id if len(each[1]) == length), key=itemgetter(0))
        if len(own) >= MIN_FRAMES:
            time_s = np.array([stamp for stamp, _ in own])
            payload = np.frombuffer(b"".join(data for _, data in own), np.uint8)
            bus = "" if channel is None else str(channel)
            whole = Stream(bus, number, is_extended, time_s, payload.reshape(-1, length))
            streams += _demultiplexed(whole)
    return streams


# --- Multiplexers


def _demultiplexed(stream: Stream) -> list[Stream]:
    """Return a stream by value of its multiplexer; itself where it has none.

    Data follow a multiplexer, and other data follow those: of the codes that (nearly) most bits
    follow, the multiplexer is the one with the fewest values.
    """
    bits = np.unpackbits(stream.payload, axis=1)
    codes = {
        Place(True, first, first + width - 1): number_of(bits, first, width)
        for first in range(0, 8 * stream.length, 2)
        for width in (8, 4, 2, 1)
        if first % width == 0
    }
    followers = {place: _followers(bits, place, code) for place, code in codes.items()}
    most = max(followers.values())
    if most == 0:
        return [stream]
    # Data that follow a multiplexer and noise have some further followers by chance.
    likely = [place for place in codes if followers[place] >= 0.9 * most]
    selector = min(likely, key=lambda place: len(np.unique(codes[place])))
    return [
        replace(
            stream,
            time_s=stream.time_s[codes[selector] == value],
            payload=stream.payload[codes[selector] == value],
            selector=selector,
            selected=value,
        )
        for value in np.unique(codes[selector]).tolist()
    ]


def _followers(bits: NDArray[np.uint8], place: Place, code: IntArray) -> int:
    """Return how many other bits follow a code of the frames; 0 where it is no multiplexer.

    A bit that follows changes often from one frame to the next, and seldom among frames of one
    value. They lie in two other bytes at least: a CRC, of one byte, follows an alive counter.
    """
    counts = np.bincount(code)
    values = np.flatnonzero(counts)
    if not 2 <= len(values) <= 32 or counts[values].min() < MIN_FRAMES or not _is_cycle(code):
        return 0
    overall = _changes(bits)
    among = [_changes(bits[code == value]) for value in values]
    within = np.average(among, axis=0, weights=counts[values])
    # A bit of noise changes in half the frames, with or without the code.
    follows = (overall > 0.2) & (within < 0.25 * overall)
    follows[place.first : place.last + 1] = False
    others = {*(np.flatnonzero(follows) // 8).tolist()} - {place.first // 8}
    return int(follows.sum()) if len(others) > 1 else 0


def _is_cycle(code: IntArray) -> bool:
    """Whether a code runs through its values in one order, frames lost in between or not."""
    size = int(code.max()) + 1
    steps = np.bincount(code[:-1] * size + code[1:], minlength=size * size).reshape(size, size)
    np.fill_diagonal(steps, 0)
    # Loggers lose some per cent of the frames; the code of a measurement takes no one way.
    return bool(steps.max(1).sum() > 0.8 * len(code))


def _changes(bits: NDArray[np.uint8]) -> FloatArray:
    """Return by bit the share of frames in which it changes."""
    return np.asarray((bits[1:] != bits[:-1]).mean(0))


# --- Alive counters and CRCs


def counters_and_crcs(payload: NDArray[np.uint8]) -> BoolArray:
    """Return which bits, in Motorola's reading order, are an alive counter or a CRC."""
    count, length = payload.shape
    bits = np.unpackbits(payload, axis=1)
    changed = bits[1:] != bits[:-1]
    dead: BoolArray = np.asarray(changed.mean(0) > 0.9)
    for byte in np.flatnonzero(changed.reshape(count - 1, length, 8).any((0, 2))).tolist():
        for width in (8, 4, 2):
            for first in range(8 * byte, 8 * byte + 8, width):
                if _counts(number_of(bits, first, width), 1 << width):
                    dead[first : first + width] = True
        if _is_crc(changed, byte):
            dead[8 * byte : 8 * byte + 8] = True
    return dead


def _counts(codes: IntArray, modulus: int) -> bool:
    """Whether codes step by the same number mostly, through all values equally often."""
    # Of a capture that loses a quarter of its frames, 0.75 of the steps are equal.
    steps = np.bincount(np.diff(codes) % modulus, minlength=modulus)
    if steps[1:].max() <= 0.55 * steps.sum():
        return False
    if modulus > 16:
        # A nibble of something else above a counter does not step as the counter wraps.
        wraps = np.flatnonzero(np.diff(codes % 16) < 0)
        carries = np.diff(codes)[wraps] % modulus == int(steps[1:].argmax()) + 1
        if not len(wraps) or carries.mean() < 0.55:
            return False
    uses = np.bincount(codes, minlength=modulus)
    return bool((uses > 0).sum() >= modulus - 1 and uses.max() < 2.5 * len(codes) / modulus)


def _is_crc(changed: BoolArray, byte: int) -> bool:
    """Whether a byte changes in half its bits when, and only when, the other bytes change."""
    own = changed[:, 8 * byte : 8 * byte + 8]
    other: BoolArray = np.asarray(np.delete(changed, np.s_[8 * byte : 8 * byte + 8], axis=1).any(1))
    moves: BoolArray = np.asarray(own.any(1))
    if other.sum() < 8 or moves[~other].any() or moves[other].mean() < 0.93:
        return False
    distance = own[other].sum(1).mean()
    often = np.count_nonzero(own.mean(0) > 0.15)
    return bool(3.0 < distance < 5.0 and often >= 7)

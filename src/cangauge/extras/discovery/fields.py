"""Fields of frames: streams of one id, their alive counters and CRCs, and the numbers in them.

A field is a run of 8–16 bits in reading order: Motorola reads the payload from its first byte,
Intel from its last. Bits that toggle together as one number are separated from neighbours by
carries: when the part above a cut steps by one, the part below wraps.
"""

from __future__ import annotations

import logging
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter, itemgetter
from typing import Any, Final

import can
import numpy as np
from numpy.typing import NDArray

from cangauge._typing import BoolArray, FloatArray

_LOG = logging.getLogger(__name__)

LEAST_BITS: Final = 8
MOST_BITS: Final = 16
MIN_FRAMES: Final = 12
"""Fewest frames of an id that can show how its bits move."""
MULTIPLEXED: Final = 0.4
"""Largest ratio of the changes among frames of one multiplexer value to those of all frames."""
NATURAL: Final = -2.0
"""Least log prior of a field whose numbers are looked at [nats]."""

Ints = NDArray[np.int32]


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
        return frozenset(places if self.is_motorola else (_turned(each, length) for each in places))


@dataclass(eq=False)
class Field:
    """A number in the frames of a stream.

    Parameters
    ----------
    stream : Stream
    raw : array (n,)
        By frame, of the bits that toggle.
    missing : array (n,) of bool
        Frames with a code for "not available".
    places : list of Place
        It together with constant bits above it.
    """

    stream: Stream
    raw: Ints
    missing: BoolArray
    places: list[Place]

    @property
    def best(self) -> Place:
        """The likeliest reading."""
        return max(self.places, key=attrgetter("nature"))

    @cached_property
    def values(self) -> Ints:
        """Its numbers where they are available."""
        return self.raw[~self.missing]

    @cached_property
    def prior(self) -> float:
        """Log prior that a measurement moves so [nats]."""
        values, change = np.unique(self.values), np.diff(self.values)
        count = len(values)
        filled = count / min(float(np.ptp(values)) + 1.0, len(self.values) / 4.0 + 1.0)
        rises, falls = np.count_nonzero(change > 0), np.count_nonzero(change < 0)
        # A measurement moves up and down through neighbouring values; states jump between few.
        is_moving = rises + falls >= 8 and min(rises, falls) > 2
        prior = 1.5 if is_moving and count >= 3 and filled > 0.5 else 0.0
        return prior - (2.0 if count < 3 else 1.5 if filled < 0.2 else 0.0)


def most_common(values: Ints) -> float:
    """Return the most common value, to a fiftieth of the range."""
    counts, edges = np.histogram(values, bins=50)
    most = int(counts.argmax())
    return float(edges[most] + edges[most + 1]) / 2.0


# --- Streams


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


def _demultiplexed(stream: Stream) -> list[Stream]:
    """Return a stream by value of its multiplexer; itself where it has none.

    A multiplexer is a short code in whose absence the other bits change wildly from frame to frame,
    and among frames of one value little.
    """
    bits = np.unpackbits(stream.payload, axis=1)
    moving = (bits[1:] != bits[:-1]).any(0)
    moved = (stream.payload[1:] != stream.payload[:-1]).mean(0)
    best: tuple[float, int, int] | None = None
    for first in range(0, min(8 * stream.length, 64), 2):
        for width in (8, 4, 2, 1):
            if first % width or not moving[first : first + width].any():
                continue
            codes = _codes(bits, first, width)
            values, counts = np.unique(codes, return_counts=True)
            if not 2 <= len(values) <= 32 or counts.min() < MIN_FRAMES:
                continue
            if np.count_nonzero(np.diff(codes)) < 0.5 * len(codes):
                continue
            parts = [stream.payload[codes == value] for value in values]
            among = [(part[1:] != part[:-1]).mean(0) for part in parts]
            within = np.average(among, axis=0, weights=counts)
            others = np.arange(stream.length) != first // 8
            selected = others & (moved > 0.3) & (within < MULTIPLEXED * moved)
            if selected.sum() < 2:
                continue  # a CRC, which follows an alive counter, is one byte
            ratio = float(within[others].sum() / moved[others].sum())
            if ratio < MULTIPLEXED and (best is None or ratio < best[0]):
                best = (ratio, first, width)
    if best is None:
        return [stream]
    _, first, width = best
    codes = _codes(bits, first, width)
    return [
        replace(
            stream,
            time_s=stream.time_s[codes == value],
            payload=stream.payload[codes == value],
            selector=Place(True, first, first + width - 1),
            selected=value,
        )
        for value in np.unique(codes).tolist()
    ]


def _codes(bits: NDArray[np.uint8], first: int, width: int) -> NDArray[np.int64]:
    return bits[:, first : first + width].astype(np.int64) @ (1 << np.arange(width - 1, -1, -1))


# --- Bits in reading order


@dataclass
class _Order:
    """Bits of a stream in one reading order, most significant first."""

    is_motorola: bool
    payload: NDArray[np.uint8]
    flips: NDArray[np.int64]
    set_mostly: BoolArray
    dead: BoolArray
    """Bits of alive counters and CRCs."""
    linked: BoolArray
    """By cut below each bit: whether the bits on both sides surely belong to one number."""
    cut: BoolArray
    """By cut: whether the bits on both sides surely belong to different numbers."""

    @classmethod
    def of(cls, payload: NDArray[np.uint8], dead: BoolArray, *, is_motorola: bool) -> _Order:
        ordered = payload if is_motorola else payload[:, ::-1]
        bits = np.unpackbits(ordered, axis=1)
        # The end of a byte of ones (not available, at wake-up) is no sign of how its bits move.
        ones = ordered == 0xFF
        few = (ones[1:] != ones[:-1]).sum(0) <= 2
        steady = ~((ones[1:] | ones[:-1]) & few)
        moved = (bits[1:] != bits[:-1]) & np.repeat(steady, 8, axis=1)
        flips = moved.sum(0)
        if not is_motorola:
            dead = dead[[_turned(place, payload.shape[1]) for place in range(len(dead))]]
        padded = np.pad(ordered, ((0, 0), (0, 2)))
        linked, cut = _links(bits, flips)
        linked |= _together(moved)
        return cls(is_motorola, padded, flips, bits.mean(0) > 0.5, dead, linked, cut)

    def codes(self, first: int, last: int) -> Ints:
        """Return the unsigned number from `first` to `last` of at most 16 bits, by frame."""
        one, two, three = self.payload[:, first // 8 : first // 8 + 3].astype(np.int32).T
        words = one << 16 | two << 8 | three
        return np.asarray(words >> 23 - last + first // 8 * 8 & (1 << last - first + 1) - 1)


def _turned(place: int, length: int) -> int:
    """Return the position of a bit in the other reading order."""
    return 8 * (length - 1 - place // 8) + place % 8


def _links(bits: NDArray[np.uint8], flips: NDArray[np.int64]) -> tuple[BoolArray, BoolArray]:
    """Return by cut whether carries cross it, and whether they surely do not; see `_Order`."""
    linked, apart = np.zeros((2, bits.shape[1]), np.bool_)
    for cut in np.flatnonzero((flips[:-1] > 0) & (flips[1:] > 0)).tolist():
        # Only bits that move: a lone sign bit steps up where its number falls.
        top = cut
        while top > 0 and flips[top - 1] > 0 and cut - top < 3:
            top -= 1
        if top == cut:
            continue
        above, below = 1 << cut + 1 - top, bits[:, cut + 1 : cut + 7]
        step = np.diff(_codes(bits, top, cut + 1 - top)) % above
        change = np.diff(_codes(bits, cut + 1, below.shape[1])) / float(1 << below.shape[1])
        carries = np.concatenate([-change[step == 1], change[step == above - 1]])
        if len(carries) >= 4:
            still = change[(step == 0) & (change != 0.0)]
            error = 2.0 * (carries.std() / np.sqrt(len(carries)) + 0.3 / len(carries))
            movement = float(np.abs(still).mean()) if len(still) else 1.0
            linked[cut] = carries.mean() - error > 0.3
            apart[cut] = carries.mean() + error < 0.3 and movement < 0.15
    return linked, apart


def _together(moved: BoolArray) -> BoolArray:
    """Return by cut whether the upper bit flips only with the lower one, itself often still."""
    flips = moved.sum(0)
    shared = (moved[:, :-1] & moved[:, 1:]).sum(0)
    often = flips[1:] > 0.5 * len(moved)
    found = (flips[:-1] >= 3) & (shared >= 0.9 * flips[:-1]) & ~often
    return np.append(found, False)


def _counters_and_crcs(payload: NDArray[np.uint8]) -> BoolArray:
    """Return which bits, in Motorola's reading order, are an alive counter or a CRC."""
    count, length = payload.shape
    bits = np.unpackbits(payload, axis=1)
    changed = bits[1:] != bits[:-1]
    dead: BoolArray = np.asarray(changed.mean(0) > 0.9)
    for byte in np.flatnonzero(changed.reshape(count - 1, length, 8).any((0, 2))).tolist():
        for width, offsets in ((8, (0,)), (4, range(5)), (3, (0, 1, 5)), (2, (0, 2, 4, 6))):
            for offset in offsets:
                codes = (payload[:, byte] >> (8 - offset - width)) & ((1 << width) - 1)
                if _counts(codes.astype(np.int64), 1 << width):
                    dead[8 * byte + offset : 8 * byte + offset + width] = True
        if _is_crc(changed, byte):
            dead[8 * byte : 8 * byte + 8] = True
    return dead


def _counts(codes: NDArray[np.int64], modulus: int) -> bool:
    """Whether codes step by the same number nearly always, through all values."""
    steady = 0.55  # of a capture that loses a quarter of its frames, 0.75 of the steps are equal
    steps = np.bincount(np.diff(codes) % modulus, minlength=modulus)
    if steps[1:].max(initial=0) <= steady * steps.sum():
        return False
    uses = np.bincount(codes, minlength=modulus)
    if modulus > 16:
        # A nibble of something else above a counter does not step as the counter wraps.
        wraps = np.flatnonzero(np.diff(codes % 16) < 0)
        carries = np.diff(codes)[wraps] % modulus == int(steps[1:].argmax()) + 1
        if not len(wraps) or carries.mean() < steady:
            return False
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


# --- Numbers


def fields_of(streams: Sequence[Stream]) -> list[Field]:
    """Return the numbers that the bits of streams make plausible, each of a stream once."""
    orders = []
    for stream in streams:
        dead = _counters_and_crcs(stream.payload)
        orders.append([_Order.of(stream.payload, dead, is_motorola=each) for each in (True, False)])
    odds = _byte_order(orders)
    fields: list[Field] = []
    for number, (stream, pair) in enumerate(zip(streams, orders, strict=True), 1):
        _LOG.debug("id %d of %d: %s", number, len(streams), stream.name)
        found: dict[bytes, Field] = {}
        for order, other in (pair, pair[::-1]):
            for places in _places(order, other, min(odds if order.is_motorola else -odds, 0.0)):
                for is_signed in (False, True):
                    made = _number(stream, order, places, is_signed=is_signed)
                    if made is not None:
                        kept = found.setdefault(made.raw.tobytes(), made)
                        if kept is not made:
                            if made.best.nature > kept.best.nature:
                                kept.missing = made.missing
                            kept.places += made.places
        fields += found.values()
    return fields


def _byte_order(orders: Iterable[Sequence[_Order]]) -> float:
    """Return the log odds that a car's numbers are in Motorola order [nats].

    A maker uses one order nearly throughout. Carries between bytes show it: ids vote.
    """
    votes = [0, 0]
    for pair in orders:
        motorola, intel = (int(order.linked[7:-1:8].sum()) for order in pair)
        if motorola != intel:
            votes[intel > motorola] += 1
    odds = math.log((votes[0] + 1.0) / (votes[1] + 1.0))
    return max(-3.0, min(3.0, odds))  # modules of several suppliers share a bus


def _places(order: _Order, other: _Order, odds: float) -> Iterator[tuple[int, list[Place]]]:
    """Yield the first toggling bit of plausible fields, with what may stand above them."""
    toggles = np.flatnonzero((order.flips > 0) & ~order.dead)
    dead_before = np.concatenate([[0], np.cumsum(order.dead)])
    for last in toggles.tolist():
        for first in toggles[(toggles <= last) & (toggles > last - MOST_BITS)].tolist():
            body = _body(order, first, last)
            if dead_before[last + 1] > dead_before[first] or body < NATURAL - 3.0:
                continue
            found = []
            top, constant = first, 0
            while last - top < MOST_BITS:
                if top < first:
                    if top < 0 or order.flips[top] > 0 or order.dead[top]:
                        break
                    constant += int(order.set_mostly[top]) << last - top
                if last - top + 1 >= LEAST_BITS:
                    nature = body + _ends(order, other, top, last)
                    nature += odds if top // 8 != last // 8 else 0.0
                    if nature > NATURAL:
                        found.append(Place(order.is_motorola, top, last, False, constant, nature))
                top -= 1
            if found:
                yield first, found


def _body(order: _Order, first: int, last: int) -> float:
    """Return the log prior of the toggling bits as one number: no cuts, lower bits toggle more."""
    cuts = int(order.cut[first:last].sum())
    flips = order.flips[first : last + 1].astype(np.float64)
    rises = flips[1:] < flips[:-1] - 2.0 * np.sqrt(flips[1:] + flips[:-1] + 1.0)
    return -min(2.0 * cuts, 8.0) - min(float(rises.sum()), 4.0)


_WIDTHS: Final = {16: 0.6, 12: 0.4, 10: 0.2, 11: 0.0, 13: 0.0, 14: 0.0, 15: -0.2, 9: -0.2, 8: -0.4}
"""Log prior of a width [nats]: how often public DBC files of cars use it for pack quantities."""


def _ends(  # noqa: C901 - one rule after the other
    order: _Order, other: _Order, first: int, last: int
) -> float:
    """Return the log prior of a field's ends: on bytes, and not where its number continues."""
    count, flips = len(order.flips), order.flips
    score = _WIDTHS[last - first + 1]
    main, minor = (first % 8, (last + 1) % 8) if order.is_motorola else ((last + 1) % 8, first % 8)
    # A field that begins anywhere is packed tightly: its end on a byte is weaker evidence.
    aligned = 0.8 if main in {0, 4} else 0.4
    score += {0: 1.2, 4: 0.4}.get(main, -0.3) + {0: aligned, 4: 0.4}.get(minor, -0.3)
    if first % 8 and flips[first - 1] == 0 and order.set_mostly[first - 1]:
        # Constant ones above, inside a byte: why should the field end there?
        score -= 0.5 if first % 4 == 0 else 3.0
    elif first % 4 and flips[first] == 0 and order.set_mostly[first]:
        score -= 5.0  # a constant one of another byte
    if order.linked[last]:
        score -= 2.5
    elif last + 1 < count and not order.dead[last + 1] and flips[last + 1] > 0:
        if flips[last + 1] < 0.6 * flips[last]:
            score += 0.5
        elif (last + 1) % 8:
            score -= 1.0  # the noise of a measurement may extend below
    if first > 0 and order.linked[first - 1]:
        score -= 2.5
    elif first > 0 and flips[first - 1] > 0:
        score += 0.3
    # At the end of a byte the number may continue in the other order.
    turned = _turned(last, count // 8)
    if last % 8 == 7 and other.linked[turned]:
        score -= 2.5
    turned = _turned(first, count // 8) - 1
    if first % 8 == 0 and turned >= 0 and other.linked[turned]:
        score -= 2.5
    return score


def _number(
    stream: Stream, order: _Order, found: tuple[int, list[Place]], *, is_signed: bool
) -> Field | None:
    """Return the numbers of a field; None for noise over its whole range."""
    first, places = found
    narrowest, widest = places[0], places[-1]
    last = widest.last
    raw = order.codes(first, last)
    if is_signed:
        if narrowest.first != first:
            return None
        half = 1 << last - first
        raw = np.where(raw >= half, raw - 2 * half, raw).astype(np.int32)
        missing = (raw == half - 1) | (raw == -half)
        places = [replace(narrowest, is_signed=True)]
    else:
        missing = order.codes(widest.first, last) == (1 << widest.width) - 1
    if missing.mean() > 0.5:
        return None
    good = raw[~missing].astype(np.float64)
    reach = good.max() - good.min()
    if reach == 0.0:
        return None
    made = Field(stream, raw, missing, places)
    roughness = float((np.diff(good) ** 2).mean() / (2.0 * good.var()))
    return None if roughness > 0.35 and 2.0 * reach > (1 << made.best.width) - 1 else made

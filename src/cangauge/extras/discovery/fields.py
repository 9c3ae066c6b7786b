"""Fields of frames: streams of one id, their alive counters and CRCs, and the numbers in them.

A field is a run of 8–16 bits in reading order: Motorola reads the payload from its first byte,
Intel from its last. Bits that toggle together as one number are separated from neighbours by
carries: when the part above a cut steps by one, the part below wraps.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final

import can
import numpy as np
from can.typechecking import Channel
from numpy.typing import NDArray

from cangauge._typing import FloatArray

LEAST_BITS: Final = 8
MOST_BITS: Final = 16
MIN_FRAMES: Final = 12
"""Fewest frames of an id that can show how its bits move."""
MAX_IDS: Final = 1024
STEADY: Final = 0.55
"""Least share of equal steps of an alive counter. A capture that loses a quarter of its frames
still has 0.75."""
MOST_VALUES: Final = 32
"""Most values of a multiplexer."""
MULTIPLEXED: Final = 0.4
"""Largest ratio of the changes among frames of one multiplexer value to those of all frames."""
LARGEST_ODDS: Final = 3.0
"""Largest log odds of a byte order [nats]: modules of several suppliers share a bus."""
LINK_EVENTS: Final = 4
"""Fewest carries from which a cut is judged."""
NATURAL: Final = -2.0
"""Least log prior of a field whose numbers are looked at [nats]."""

Bits = NDArray[np.bool_]
Ints = NDArray[np.int32]


@dataclass(frozen=True)
class Selector:
    """A multiplexer in Motorola's reading order, and its value in the frames of a stream."""

    first: int
    width: int
    value: int


@dataclass
class Stream:
    """Frames of one id on one bus, all of one length and one multiplexer value.

    Parameters
    ----------
    bus : str
    arbitration_id : int
    is_extended : bool
    time_s : array (n,)
    payload : array (n, length) of uint8
    selector : Selector, optional
    """

    bus: str
    arbitration_id: int
    is_extended: bool
    time_s: FloatArray
    payload: NDArray[np.uint8]
    selector: Selector | None = None

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


def collect(messages: Iterable[can.Message]) -> list[Stream]:
    """Return the streams of a capture; ids with too few frames are left out."""
    times: dict[tuple[Channel | None, int, bool], list[float]] = {}
    data: dict[tuple[Channel | None, int, bool], list[bytes]] = {}
    for message in messages:
        if message.is_error_frame or message.is_remote_frame or not message.data:
            continue
        key = (message.channel, message.arbitration_id, message.is_extended_id)
        if key not in times:
            if len(times) >= MAX_IDS:
                continue
            times[key], data[key] = [], []
        times[key].append(message.timestamp)
        data[key].append(bytes(message.data))
    streams = []
    for key, stamps in times.items():
        lengths = np.array([len(each) for each in data[key]])
        length = int(np.bincount(lengths).argmax())
        keep = np.flatnonzero(lengths == length)
        if len(keep) < MIN_FRAMES:
            continue
        joined = b"".join(data[key][index] for index in keep)
        payload = np.frombuffer(joined, np.uint8).reshape(-1, length)
        time_s = np.array(stamps)[keep]
        order = np.argsort(time_s, kind="stable")
        bus = "" if key[0] is None else str(key[0])
        whole = Stream(bus, key[1], key[2], time_s[order], payload[order])
        streams += _demultiplexed(whole)
    return streams


def _demultiplexed(stream: Stream) -> list[Stream]:
    """Return a stream by value of its multiplexer; itself where it has none.

    A multiplexer is a short code in whose absence the other bits change wildly from frame to frame,
    and among frames of one value little.
    """
    if len(stream.payload) < 2 * MIN_FRAMES:
        return [stream]
    bits = np.unpackbits(stream.payload, axis=1)
    moves = bits[1:] != bits[:-1]
    best: tuple[float, int, int] | None = None
    for first in range(0, min(8 * stream.length, 64), 2):
        for width in (8, 4, 2, 1):
            if first % width or not moves[:, first : first + width].any():
                continue
            codes = _codes(bits, first, width)
            values, counts = np.unique(codes, return_counts=True)
            if not 2 <= len(values) <= MOST_VALUES or counts.min() < MIN_FRAMES:
                continue
            if np.count_nonzero(np.diff(codes)) < 0.5 * len(codes):
                continue
            bytes_moved = (stream.payload[1:] != stream.payload[:-1]).mean(0)
            parts = [stream.payload[codes == value] for value in values]
            among = [(part[1:] != part[:-1]).mean(0) for part in parts]
            within = np.average(among, axis=0, weights=counts)
            others = np.arange(stream.length) != first // 8
            selected = others & (bytes_moved > 0.3) & (within < MULTIPLEXED * bytes_moved)
            if selected.sum() < 2:
                continue  # a CRC, which follows an alive counter, is one byte
            ratio = float(within[others].sum() / bytes_moved[others].sum())
            if ratio < MULTIPLEXED and (best is None or ratio < best[0]):
                best = (ratio, first, width)
    if best is None:
        return [stream]
    _, first, width = best
    codes = _codes(bits, first, width)
    return [
        Stream(
            stream.bus, stream.arbitration_id, stream.is_extended, stream.time_s[codes == value],
            stream.payload[codes == value], Selector(first, width, int(value)),
        )
        for value in np.unique(codes)
    ]  # fmt: skip


def _codes(bits: NDArray[np.uint8], first: int, width: int) -> NDArray[np.int64]:
    return bits[:, first : first + width].astype(np.int64) @ (1 << np.arange(width - 1, -1, -1))


@dataclass
class _Order:
    """Bits of a stream in one reading order, most significant first."""

    is_motorola: bool
    windows: NDArray[np.uint16]
    """The 16 bits from each position on."""
    set_mostly: Bits
    flips: NDArray[np.int64]
    links: FloatArray
    """By cut below each bit: mean of the carries, its standard error, their number, movement of the
    lower part between them."""
    together: Bits
    """By cut: whether the upper bit flips only with the lower one, which itself is often still."""
    dead: Bits
    """Bits of alive counters and CRCs."""

    def is_linked(self, cut: int) -> bool:
        """Whether the bits on both sides of a cut surely belong to one number."""
        if not 0 <= cut < len(self.flips) - 1:
            return False
        if self.together[cut]:
            return True
        mean, error, events, _ = self.links[cut]
        return bool(events >= LINK_EVENTS and mean - 2.0 * error > 0.3)

    def is_cut(self, cut: int) -> bool:
        """Whether the bits on both sides of a cut surely belong to different numbers."""
        mean, error, events, movement = self.links[cut]
        return bool(events >= LINK_EVENTS and mean + 2.0 * error < 0.3 and movement < 0.15)


@dataclass
class Place:
    """Bits of a field: reading order, first and last position, sign."""

    is_motorola: bool
    first: int
    last: int
    is_signed: bool

    @property
    def width(self) -> int:
        """Number of bits."""
        return self.last - self.first + 1

    def start(self, length: int) -> int:
        """Return the start bit as in a DBC, for a frame of `length` bytes."""
        if self.is_motorola:
            return 8 * (self.first // 8) + 7 - self.first % 8
        return 8 * length - 1 - self.last

    def bits(self, length: int) -> frozenset[int]:
        """Return its bits in Motorola's reading order."""
        places = range(self.first, self.last + 1)
        if self.is_motorola:
            return frozenset(places)
        return frozenset(8 * (length - 1 - place // 8) + place % 8 for place in places)


@dataclass
class Field:
    """A number in the frames of a stream.

    Parameters
    ----------
    stream : int
        Index of its stream.
    place : Place
    raw : array (n,)
        By frame.
    missing : array (n,) of bool
        Frames with a code for "not available".
    nature : float
        Log prior that these bits are a measured number [nats].
    constant : int
        What constant bits above `raw` add to it.
    """

    stream: int
    place: Place
    raw: Ints
    missing: Bits
    nature: float
    constant: int = 0
    extensions: list[tuple[Place, float, int]] = field(default_factory=list)
    """The same with constant bits above: place, nature, what they add."""


def fields_of(index: int, stream: Stream, byte_order: float = 0.0) -> list[Field]:
    """Return the numbers in a stream that its bits make plausible, each once.

    Parameters
    ----------
    index : int
        Index of the stream, for the fields.
    stream : Stream
    byte_order : float
        Log odds that a car's numbers are in Motorola order; see `byte_order`.
    """
    orders = read_orders(stream)
    odds = {True: min(byte_order, 0.0), False: min(-byte_order, 0.0)}
    found: dict[bytes, Field] = {}
    for order, other in (orders, orders[::-1]):
        for first, last, extensions in _candidates(order, other, odds[order.is_motorola]):
            for is_signed in (False, True):
                made = _number(index, order, first, last, extensions, is_signed=is_signed)
                if made is None:
                    continue
                key = made.raw.tobytes()
                kept = found.get(key)
                if kept is None:
                    found[key] = made
                else:
                    kept.extensions += made.extensions
                    if made.nature > kept.nature:
                        made.extensions = kept.extensions
                        found[key] = made
    return list(found.values())


def read_orders(stream: Stream) -> list[_Order]:
    """Return how the bits of a stream move, read in Motorola and in Intel order."""
    dead = _counters_and_crcs(stream.payload)
    return [_read(stream.payload, dead, is_motorola=each) for each in (True, False)]


def byte_order(streams: Iterable[Stream]) -> float:
    """Return the log odds that a car's numbers are in Motorola order [nats].

    A maker uses one order nearly throughout. Carries between bytes show it: ids vote.
    """
    votes = [0, 0]
    for stream in streams:
        linked = [
            sum(order.is_linked(cut) for cut in range(7, 8 * stream.length - 1, 8))
            for order in read_orders(stream)
        ]
        if linked[0] != linked[1]:
            votes[linked[1] > linked[0]] += 1
    odds = math.log((votes[0] + 1.0) / (votes[1] + 1.0))
    return max(-LARGEST_ODDS, min(LARGEST_ODDS, odds))


def _read(payload: NDArray[np.uint8], dead: Bits, *, is_motorola: bool) -> _Order:
    count, length = payload.shape
    ordered = payload if is_motorola else payload[:, ::-1]
    bits = np.unpackbits(ordered, axis=1)
    padded = np.pad(ordered, ((0, 0), (0, 2))).astype(np.uint32)
    words = padded[:, :-2] << 16 | padded[:, 1:-1] << 8 | padded[:, 2:]
    shifts = 8 - np.arange(8)
    windows = (words[:, :, None] >> shifts).astype(np.uint16).reshape(count, 8 * length)
    # The end of a byte of ones (not available, at wake-up) is no sign of how its bits move.
    ones = ordered == 0xFF
    few = (ones[1:] != ones[:-1]).sum(0) <= 2
    steady = ~((ones[1:] | ones[:-1]) & few)
    moved = (bits[1:] != bits[:-1]) & np.repeat(steady, 8, axis=1)
    flips = moved.sum(0)
    places = np.arange(8 * length)
    turned = places if is_motorola else 8 * (length - 1 - places // 8) + places % 8
    return _Order(
        is_motorola, windows, bits.mean(0) > 0.5, flips, _links(bits, flips), _together(moved),
        dead[turned],
    )  # fmt: skip


def _links(bits: NDArray[np.uint8], flips: NDArray[np.int64]) -> FloatArray:
    """Return how each cut behaves at carries; see `_Order.links`."""
    count = bits.shape[1]
    out = np.zeros((count, 4))
    wide = bits.astype(np.int16)
    for cut in np.flatnonzero((flips[:-1] > 0) & (flips[1:] > 0)):
        # Only bits that move: a lone sign bit steps up where its number falls.
        top = int(cut)
        while top > 0 and flips[top - 1] > 0 and cut - top < 3:
            top -= 1
        above = wide[:, top : cut + 1]
        below = wide[:, cut + 1 : cut + 7]
        high = above @ (1 << np.arange(above.shape[1] - 1, -1, -1, dtype=np.int16))
        low = below @ (1 << np.arange(below.shape[1] - 1, -1, -1, dtype=np.int16))
        modulus = 1 << above.shape[1]
        if modulus == 2:
            continue
        step = np.diff(high) % modulus
        change = np.diff(low) / float(1 << below.shape[1])
        carries = np.concatenate([-change[step == 1], change[step == modulus - 1]])
        if len(carries):
            still = change[(step == 0) & (change != 0.0)]
            error = carries.std() / np.sqrt(len(carries)) + 0.3 / len(carries)
            movement = float(np.abs(still).mean()) if len(still) else 1.0
            out[cut] = carries.mean(), error, len(carries), movement
    return out


def _together(moved: Bits) -> Bits:
    """Return by cut whether the upper bit flips only with the lower one; see `_Order.together`."""
    flips = moved.sum(0)
    shared = (moved[:, :-1] & moved[:, 1:]).sum(0)
    often = flips[1:] > 0.5 * len(moved)
    found = (flips[:-1] >= LINK_EVENTS - 1) & (shared >= 0.9 * flips[:-1]) & ~often
    return np.append(found, False)


def _counters_and_crcs(payload: NDArray[np.uint8]) -> Bits:
    """Return which bits, in Motorola's reading order, are an alive counter or a CRC."""
    count, length = payload.shape
    bits = np.unpackbits(payload, axis=1)
    changed = bits[1:] != bits[:-1]
    dead: Bits = np.asarray(changed.mean(0) > 0.9)
    for byte in np.flatnonzero(changed.reshape(count - 1, length, 8).any((0, 2))).tolist():
        for width, offsets in ((8, (0,)), (4, range(5)), (3, (0, 1, 5)), (2, (0, 2, 4, 6))):
            for offset in offsets:
                codes = (payload[:, byte] >> (8 - offset - width)) & ((1 << width) - 1)
                if _counts(codes.astype(np.int64), 1 << width):
                    dead[8 * byte + offset : 8 * byte + offset + width] = True
    for byte in range(length):
        if _is_crc(changed, byte):
            dead[8 * byte : 8 * byte + 8] = True
    return dead


def _counts(codes: NDArray[np.int64], modulus: int) -> bool:
    """Whether codes step by the same number nearly always, through all values."""
    steps = np.bincount(np.diff(codes) % modulus, minlength=modulus)
    if steps[1:].max(initial=0) <= STEADY * steps.sum():
        return False
    uses = np.bincount(codes, minlength=modulus)
    if modulus > 16:
        # A nibble of something else above a counter does not step as the counter wraps.
        wraps = np.flatnonzero(np.diff(codes % 16) < 0)
        carries = np.diff(codes)[wraps] % modulus == int(steps[1:].argmax()) + 1
        if not len(wraps) or carries.mean() < STEADY:
            return False
    return bool((uses > 0).sum() >= modulus - 1 and uses.max() < 2.5 * len(codes) / modulus)


def _is_crc(changed: Bits, byte: int) -> bool:
    """Whether a byte changes in half its bits when, and only when, the other bytes change."""
    own = changed[:, 8 * byte : 8 * byte + 8]
    other: Bits = np.asarray(np.delete(changed, np.s_[8 * byte : 8 * byte + 8], axis=1).any(1))
    moves: Bits = np.asarray(own.any(1))
    if other.sum() < 8 or moves[~other].any() or moves[other].mean() < 0.93:
        return False
    distance = own[other].sum(1).mean()
    often = np.count_nonzero(own.mean(0) > 0.15)
    return bool(3.0 < distance < 5.0 and often >= 7)


def _candidates(  # noqa: C901 - one walk over the bits
    order: _Order, other: _Order, odds: float
) -> Iterator[tuple[int, int, list[tuple[int, float, int]]]]:
    """Yield first and last toggling bit of plausible fields, with what may stand above them."""
    toggles = np.flatnonzero((order.flips > 0) & ~order.dead)
    dead_before = np.concatenate([[0], np.cumsum(order.dead)])
    for last in toggles:
        for first in toggles[(toggles <= last) & (toggles > last - MOST_BITS)]:
            if dead_before[last + 1] > dead_before[first]:
                continue
            body = _body(order, int(first), int(last))
            if body < NATURAL - 3.0:
                continue
            found = []
            top, constant = int(first), 0
            while True:
                if last - top + 1 >= LEAST_BITS:
                    nature = body + _ends(order, other, top, int(last))
                    nature += odds if top // 8 != int(last) // 8 else 0.0
                    if nature > NATURAL:
                        found.append((top, nature, constant))
                above = top - 1
                if above < 0 or order.flips[above] > 0 or order.dead[above]:
                    break
                if last - above + 1 > MOST_BITS:
                    break
                constant += int(order.set_mostly[above]) << int(last - above)
                top = above
            if found:
                yield int(first), int(last), found


def _body(order: _Order, first: int, last: int) -> float:
    """Return the log prior of the toggling bits as one number: no cuts, lower bits toggle more."""
    cuts = sum(order.is_cut(cut) for cut in range(first, last))
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
    length = count // 8

    def turned(place: int) -> int:
        return 8 * (length - 1 - place // 8) + place % 8

    if order.is_linked(last):
        score -= 2.5
    elif last + 1 < count and not order.dead[last + 1] and flips[last + 1] > 0:
        if flips[last + 1] < 0.6 * flips[last]:
            score += 0.5
        elif (last + 1) % 8:
            score -= 1.0  # the noise of a measurement may extend below
    if last % 8 == 7 and other.is_linked(turned(last)):
        score -= 2.5
    if order.is_linked(first - 1):
        score -= 2.5
    elif first > 0 and flips[first - 1] > 0:
        score += 0.3
    if first % 8 == 0 and other.is_linked(turned(first) - 1):
        score -= 2.5
    return score


def _number(
    index: int,
    order: _Order,
    first: int,
    last: int,
    extensions: list[tuple[int, float, int]],
    *,
    is_signed: bool,
) -> Field | None:
    """Return the numbers of a field; None for noise over its whole range."""
    width = last - first + 1
    if is_signed and width < LEAST_BITS:
        return None
    code = (order.windows[:, first] >> (MOST_BITS - width)).astype(np.int32)
    if is_signed:
        raw = np.where(code >> (width - 1), code - (1 << width), code).astype(np.int32)
        missing = (raw == (1 << (width - 1)) - 1) | (raw == -(1 << (width - 1)))
        extensions = [each for each in extensions if each[0] == first]
    else:
        raw = code
        top = extensions[-1][0]
        wide = last - top + 1
        missing = (order.windows[:, top] >> (MOST_BITS - wide)) == (1 << wide) - 1
    if not extensions or missing.mean() > 0.5:
        return None
    good = raw[~missing].astype(np.float64)
    low, high = good.min(), good.max()
    if low == high:
        return None
    change = np.diff(good)
    roughness = float((change**2).mean() / (2.0 * good.var()))
    best = max(extensions, key=lambda each: each[1])
    full = (1 << (last - best[0] + 1)) - 1
    if roughness > 0.35 and high - low > 0.5 * full:
        return None
    made = [
        (Place(order.is_motorola, top, last, is_signed), nature, constant)
        for top, nature, constant in extensions
    ]
    place = Place(order.is_motorola, best[0], last, is_signed)
    return Field(index, place, raw, missing, best[1], best[2], made)

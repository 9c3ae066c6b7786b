"""Numbers in the frames of a stream.

A field is a run of 8–16 bits in reading order: Motorola reads the payload from its first byte,
Intel from its last. Bits that toggle together as one number are separated from neighbours by
carries: when the part above a cut steps by one, the part below wraps.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import BoolArray, IntArray
from cangauge.extras.discovery.streams import Place, Stream, counters_and_crcs, number_of, turned

_LOG = logging.getLogger(__name__)

LEAST_BITS: Final = 8
MOST_BITS: Final = 16
NATURAL: Final = -2.0
"""Least log prior of a field whose numbers are looked at [nats]."""
_WIDTHS: Final = {16: 0.6, 12: 0.4, 10: 0.2, 11: 0.0, 13: 0.0, 14: 0.0, 15: -0.2, 9: -0.2, 8: -0.4}
"""Log prior of a width [nats]: how often public DBC files of cars use it for pack quantities."""

Ints = NDArray[np.int32]


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
    def step(self) -> float:
        """Most common change: of bits in a wrong order it is more than 1."""
        changes, counts = np.unique(np.abs(np.diff(self.values)), return_counts=True)
        counts[changes == 0] = 0
        return float(max(changes[counts.argmax()], 1))

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


# --- Bits in reading order


class _Order:
    """Bits of a stream in one reading order, most significant first.

    Attributes
    ----------
    flips : array
        How often each bit changes.
    set_mostly : array of bool
    dead : array of bool
        Bits of alive counters and CRCs.
    linked : array of bool
        By cut below each bit: whether the bits on both sides surely belong to one number.
    cut : array of bool
        By cut: whether the bits on both sides surely belong to different numbers.
    """

    def __init__(self, payload: NDArray[np.uint8], dead: BoolArray, *, is_motorola: bool) -> None:
        self.is_motorola, self.dead = is_motorola, dead
        ordered = payload if is_motorola else payload[:, ::-1]
        bits = np.unpackbits(ordered, axis=1)
        # The end of a byte of ones (not available, at wake-up) is no sign of how its bits move.
        ones = ordered == 0xFF
        few = (ones[1:] != ones[:-1]).sum(0) <= 2
        steady = ~((ones[1:] | ones[:-1]) & few)
        moved = (bits[1:] != bits[:-1]) & np.repeat(steady, 8, axis=1)
        self.flips = moved.sum(0)
        if not is_motorola:
            self.dead = dead[[turned(place, payload.shape[1]) for place in range(len(dead))]]
        self.payload = np.pad(ordered, ((0, 0), (0, 2)))
        self.set_mostly = bits.mean(0) > 0.5
        self.linked, self.cut = _carries(bits, self.flips)
        self.linked |= _together(moved)

    def codes(self, first: int, last: int) -> Ints:
        """Return the unsigned number from `first` to `last` of at most 16 bits, by frame."""
        one, two, three = self.payload[:, first // 8 : first // 8 + 3].astype(np.int32).T
        words = one << 16 | two << 8 | three
        return np.asarray(words >> 23 - last + first // 8 * 8 & (1 << last - first + 1) - 1)


def _carries(bits: NDArray[np.uint8], flips: IntArray) -> tuple[BoolArray, BoolArray]:
    """Return by cut whether the bits below wrap as those above step by one, and whether not."""
    linked, apart = np.zeros((2, bits.shape[1]), np.bool_)
    for cut in np.flatnonzero((flips[:-1] > 0) & (flips[1:] > 0)).tolist():
        # Only bits that move: a lone sign bit steps up where its number falls.
        top = cut
        while top > 0 and flips[top - 1] > 0 and cut - top < 3:
            top -= 1
        if top == cut:
            continue
        above, width = 1 << cut + 1 - top, min(6, bits.shape[1] - cut - 1)
        step = np.diff(number_of(bits, top, cut + 1 - top)) % above
        change = np.diff(number_of(bits, cut + 1, width)) / float(1 << width)
        falls = np.concatenate([-change[step == 1], change[step == above - 1]])
        if len(falls) >= 4:
            still = change[(step == 0) & (change != 0.0)]
            error = 2.0 * (falls.std() / np.sqrt(len(falls)) + 0.3 / len(falls))
            movement = float(np.abs(still).mean()) if len(still) else 1.0
            linked[cut] = falls.mean() - error > 0.3
            apart[cut] = falls.mean() + error < 0.3 and movement < 0.15
    return linked, apart


def _together(moved: BoolArray) -> BoolArray:
    """Return by cut whether the upper bit flips only with the lower one, itself often still."""
    flips = moved.sum(0)
    shared = (moved[:, :-1] & moved[:, 1:]).sum(0)
    often = flips[1:] > 0.5 * len(moved)
    found = (flips[:-1] >= 3) & (shared >= 0.9 * flips[:-1]) & ~often
    return np.append(found, False)


# --- Numbers


def fields_of(streams: Sequence[Stream]) -> list[Field]:
    """Return the numbers that the bits of streams make plausible, each of a stream once."""
    orders = []
    for stream in streams:
        dead = counters_and_crcs(stream.payload)
        orders.append([_Order(stream.payload, dead, is_motorola=each) for each in (True, False)])
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


def _ends(order: _Order, other: _Order, first: int, last: int) -> float:
    """Return the log prior of a field's ends: usual width, on bytes, where no number continues."""
    score = _WIDTHS[last - first + 1]
    main, minor = (first % 8, (last + 1) % 8) if order.is_motorola else ((last + 1) % 8, first % 8)
    # A field that begins anywhere is packed tightly: its end on a byte is weaker evidence.
    aligned = 0.8 if main in {0, 4} else 0.4
    score += {0: 1.2, 4: 0.4}.get(main, -0.3) + {0: aligned, 4: 0.4}.get(minor, -0.3)
    flips = order.flips
    if first % 8 and flips[first - 1] == 0 and order.set_mostly[first - 1]:
        # Constant ones above, inside a byte: why should the field end there?
        score -= 0.5 if first % 4 == 0 else 3.0
    elif first % 4 and flips[first] == 0 and order.set_mostly[first]:
        score -= 5.0  # a constant one of another byte
    if first > 0 and flips[first - 1] > 0 and not order.linked[first - 1]:
        score += 0.3
    is_followed = last + 1 < len(flips) and not order.dead[last + 1] and flips[last + 1] > 0
    if is_followed and not order.linked[last]:
        if flips[last + 1] < 0.6 * flips[last]:
            score += 0.5
        elif (last + 1) % 8:
            score -= 1.0  # the noise of a measurement may extend below
    # At the end of a byte the number may continue in the other order.
    length = len(flips) // 8
    below, above = turned(last, length), turned(first, length) - 1
    cuts = (
        order.linked[last],
        first > 0 and order.linked[first - 1],
        last % 8 == 7 and other.linked[below],
        first % 8 == 0 and above >= 0 and other.linked[above],
    )
    return score - 2.5 * sum(map(bool, cuts))


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

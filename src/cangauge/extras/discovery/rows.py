"""Fields as current, voltage or SoC: their numbers on one grid of time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from cangauge._typing import BoolArray, FloatArray
from cangauge.extras.discovery.candidate import ROLES, Candidate, Level
from cangauge.extras.discovery.fields import Field, Ints, most_common
from cangauge.extras.discovery.streams import Place, Stream


class Grid:
    """Slots of time over all streams.

    Parameters
    ----------
    streams : sequence of Stream
        Pack messages come every 10–100 ms: a slot has 0.1 s, or more beyond 4000 slots.
    """

    def __init__(self, streams: Sequence[Stream]) -> None:
        start_s = min(float(each.time_s[0]) for each in streams)
        self.duration_s = max(float(each.time_s[-1]) for each in streams) - start_s
        self.step_s = max(0.1, self.duration_s / 4000)
        self._rows = max(int(self.duration_s / self.step_s), 4)
        edges = start_s + self.step_s * np.arange(self._rows + 1)
        self._slots = {
            each: np.clip(np.searchsorted(edges, each.time_s, "right") - 1, 0, self._rows - 1)
            for each in streams
        }

    def means(self, stream: Stream, values: Ints, missing: BoolArray) -> FloatArray:
        """Return the means of a stream's values by slot; empty slots keep the last one."""
        slots, good = self._slots[stream][~missing], values[~missing]
        counts = np.bincount(slots, minlength=self._rows)
        filled = np.flatnonzero(counts)
        last = np.maximum(np.searchsorted(filled, np.arange(self._rows), "right") - 1, 0)
        sums = np.bincount(slots, weights=good, minlength=self._rows)
        return np.asarray((sums[filled] / counts[filled])[last])

    def longest(self, pause_s: float) -> slice:
        """Return the slots of the longest part without a pause: there the SoC may jump."""
        filled = np.unique(np.concatenate(list(self._slots.values())))
        parts = np.split(filled, np.flatnonzero(np.diff(filled) * self.step_s > pause_s) + 1)
        longest = max(parts, key=np.ptp)
        return slice(int(longest[0]), int(longest[-1]) + 1)


@dataclass(eq=False)
class Row:
    """A field as a current, as a voltage or as a SoC.

    Parameters
    ----------
    field : Field
    place : Place
        Which of its bits it has.
    missing : array (n,) of bool
    prior : float
        Log prior of the field in its role [nats].
    levels : tuple of Level
        What it means by the likeliest scale, and by others that fit as well. The scale of a
        current is found with its voltage.
    """

    field: Field
    place: Place
    missing: BoolArray
    prior: float
    levels: tuple[Level, ...] = ()

    @cached_property
    def values(self) -> Ints:
        """Raw numbers by frame."""
        return self.field.raw[~self.missing] + self.place.constant

    def means_on(self, grid: Grid) -> FloatArray:
        """Return the means of the raw numbers by slot of time."""
        return grid.means(self.field.stream, self.field.raw + self.place.constant, self.missing)

    @cached_property
    def away(self) -> float:
        """Largest distance from the most common number."""
        return float(np.abs(self.values - most_common(self.values)).max())

    @property
    def steps(self) -> int:
        """Number of changes."""
        return int(np.count_nonzero(np.diff(self.values)))

    @property
    def moves(self) -> int:
        """Number of changes by a tenth of the range, at once or little by little."""
        least = 0.1 * float(np.ptp(self.values))
        count, from_ = 0, self.values[0]
        for value in self.values[1:].tolist():
            if abs(value - from_) >= least:
                count, from_ = count + 1, value
        return count

    @cached_property
    def bits(self) -> frozenset[tuple[int, bool, int]]:
        """Its bits, each with its id: a gateway repeats frames on other buses."""
        return self.field.stream.bits(self.place)

    @property
    def name(self) -> str:
        """Id and bits as in a DBC, such as "0x1DB 7|11@0-"."""
        of = self.field.stream
        name = f"{of.name} {self.place.text(of.length)}"
        return name if of.selector is None else f"{name} m{of.selected}"

    def candidate(self, role: str, scale: float, offset: float, **more: Any) -> Candidate:
        """Return the field as the signal of a role."""
        stream, place = self.field.stream, self.place
        ends = scale * np.array([self.values.min(), self.values.max()], np.float64) + offset
        gone = self.field.raw[self.field.missing & (self.field.raw != 0)]
        codes, counts = np.unique(gone, return_counts=True)
        code = codes[counts == counts.max(initial=0)][:1].tolist()
        if code and not place.is_signed:
            code = [(1 << place.width) - 1]
        return Candidate(
            role=role,
            name=self.name,
            message=f"FRAME_{stream.arbitration_id:X}",
            signal=ROLES[role].column,
            unit=ROLES[role].unit,
            low=float(ends.min()),
            high=float(ends.max()),
            period_s=stream.period_s,
            stream=stream,
            place=place,
            bits=self.bits,
            scale=scale,
            offset=offset,
            steps=self.steps,
            moves=self.moves,
            not_available=tuple(code),
            levels=self.levels if len(self.levels) > 1 else (),
            **more,
        )


def zero_of(current: Row) -> float:
    """Return the raw number of a current that means none: the round one where it rests."""
    values, place = current.values, current.place
    if place.is_signed:
        return 0.0
    zeros = np.array(round_zeros(float(values.min()), float(values.max()), place.width) or [0.0])
    return float(zeros[np.abs(zeros - most_common(values)).argmin()])


def round_zeros(low: float, high: float, width: int) -> list[float]:
    """Return the round raw numbers within a range that may mean no current."""
    found = [0.0] if low <= 0.05 * (high - low) else []
    found += [float(1 << bit) for bit in range(max(width - 3, 7), width)]
    if width > 10:
        found += [float(each) for each in range(500, 5000, 500)]
        found += [float(each) for each in range(5000, 65_000, 1000)]
    return [each for each in found if each == 0.0 or low - 1.0 <= each <= high + 1.0]

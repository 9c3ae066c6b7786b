"""Pairs of a voltage and a current, ΔU = −R·ΔI, among the fields of a capture.

For each pair the evidence is the likelihood ratio of a common variation against none, with as many
independent samples as the pair has independent moves; a copy of one quantity (an exact or
proportional one) is no evidence. To it come log priors of what such fields look like: bits, level,
usual scales, resistance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from scipy.signal import lfilter

from cangauge._typing import BoolArray, FloatArray
from cangauge.extras.discovery.candidate import (
    MOST_A,
    ROLES,
    SHOWN,
    Candidate,
    Level,
)
from cangauge.extras.discovery.fields import Field, Ints, Place, Stream, most_common

CURRENT_SCALES: Final = {
    0.1: 0.0,
    0.5: -0.3,
    0.25: -0.5,
    0.01: -0.5,
    0.05: -0.5,
    1.0: -1.0,
    0.025: -1.0,
    0.125: -1.2,
    0.02: -1.5,
}
"""Usual scales [A] and their log priors [nats], by their frequency in public DBC files."""
MOVE_S: Final = 0.5
"""Time of one move [s]: the load of a car changes no faster."""
LARGEST_R2: Final = 0.97
"""Polarisation within seconds leaves some of a voltage's variance without the current: a closer
relation is no further evidence of a pack."""
FEW_MOVES: Final = 4.0
"""Fewer independent moves than this may be one coincidence, such as the wake-up of all nodes."""
ALIKE: Final = 3.5
"""Largest ratio of the steps of two copies: one has at most a bit or two more."""
SIBLING: Final = 0.02
"""Largest relative difference of two voltages of one frame that are those of two cells."""
POLARISATION_S: Final = 3.0
"""Time constant with which a sustained current is seen [s]: the diffusion of lithium-ion cells
shows from seconds on, and slower parts are taken away as a trend."""
IMPOSSIBLE: Final = -99.0


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
        ends = np.flatnonzero(np.diff(filled) * self.step_s > pause_s)
        firsts, lasts = np.append(0, ends + 1), np.append(ends, len(filled) - 1)
        longest = int((filled[lasts] - filled[firsts]).argmax())
        return slice(int(filled[firsts[longest]]), int(filled[lasts[longest]]) + 1)


NO_LEVEL: Final = Level(1.0, math.nan, "")


@dataclass(eq=False)
class Row:
    """A field as a current or as a voltage.

    Parameters
    ----------
    field : Field
    place : Place
    constant : int
        What constant bits above the field add to `raw`.
    missing : array (n,) of bool
    prior : float
        Log prior of the field in its role [nats].
    level : Level
        Scale and value that make it a voltage or a SoC; of a current none is known yet.
    levels : tuple of Level
        Its own, and those of others that fit as well.
    """

    field: Field
    place: Place
    constant: int
    missing: BoolArray
    prior: float = 0.0
    level: Level = NO_LEVEL
    levels: tuple[Level, ...] = ()

    @cached_property
    def values(self) -> Ints:
        """Raw numbers by frame."""
        return self.field.raw[~self.missing] + self.constant

    def means_on(self, grid: Grid) -> FloatArray:
        """Return the means of the raw numbers by slot of time."""
        return grid.means(self.field.stream, self.field.raw + self.constant, self.missing)

    @property
    def steps(self) -> int:
        """Number of changes."""
        return int(np.count_nonzero(np.diff(self.values)))

    @cached_property
    def away(self) -> float:
        """Largest distance from the most common number."""
        values = self.values.astype(np.float64)
        return float(np.abs(values - most_common(self.values)).max())

    @property
    def moves(self) -> int:
        """Number of changes by a tenth of the range, at once or little by little."""
        least = 0.1 * float(np.ptp(self.values))
        count, from_ = 0, self.values[0]
        for value in self.values[1:].tolist():
            if abs(value - from_) >= least:
                count, from_ = count + 1, value
        return count

    @property
    def step(self) -> float:
        """Most common change: of bits in a wrong order it is more than 1."""
        changes, counts = np.unique(np.abs(np.diff(self.values)), return_counts=True)
        counts[changes == 0] = 0
        return float(max(changes[counts.argmax()], 1))

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
            scale=scale,
            offset=offset,
            steps=self.steps,
            moves=self.moves,
            not_available=tuple(code),
            levels=self.levels,
            **more,
        )


@dataclass(frozen=True)
class _Moves:
    """Grids freed of their slow part, in units of their standard deviation."""

    values: FloatArray
    std: FloatArray
    independent: FloatArray
    """Number of independent moves."""
    memory: FloatArray
    """Autocorrelation over one move."""

    @classmethod
    def of(cls, grid: FloatArray, step_s: float) -> _Moves:
        # The trend over 10 s: SoC and temperature move more slowly.
        width = max(3, min(int(10.0 / step_s), grid.shape[1] // 2))
        padded = np.pad(grid, ((0, 0), (width // 2 + 1, width - width // 2 - 1)), mode="edge")
        sums = np.cumsum(padded, axis=1)
        free = grid - (sums[:, width:] - sums[:, :-width]) / width
        bound = 5.0 * np.sqrt((free**2).mean(1, keepdims=True))
        free = np.clip(free, -bound, bound)
        free -= free.mean(1, keepdims=True)
        std = free.std(1)
        group = max(1, round(MOVE_S / step_s))
        steps = _participation(np.diff(_grouped(grid, group), axis=1))
        # One lone step moves the mean of many slots, and is still one.
        both = np.sqrt(steps * _participation(_grouped(free, group)))
        values = (free / np.maximum(std, 1e-12)[:, None]).astype(np.float32)
        memory = (values[:, group:] * values[:, :-group]).mean(1, dtype=np.float64)
        # From 60 on a chance is excluded: two minutes of driving have as many, and the noise of a
        # sensor that is sent twice has more.
        return cls(values, std, np.minimum(np.where(steps < 3.0, steps, both), 60.0), memory)


def _grouped(rows: FloatArray, group: int) -> FloatArray:
    count = rows.shape[1] // group
    return np.asarray(rows[:, : count * group].reshape(len(rows), count, group).mean(2))


def _participation(rows: FloatArray) -> FloatArray:
    """Return the number of entries that carry the squares of each row."""
    return np.asarray((rows**2).sum(1) ** 2 / np.maximum((rows**4).sum(1), 1e-12))


class Pairs:
    """All pairs of a voltage (rows) and a current (columns), with their log posterior.

    Parameters
    ----------
    voltages, currents : sequence of Row
    grid : Grid
    """

    def __init__(self, voltages: Sequence[Row], currents: Sequence[Row], grid: Grid) -> None:
        self._voltages, self._currents, self._step_s = voltages, currents, grid.step_s
        level = [np.array([row.means_on(grid) for row in rows]) for rows in (voltages, currents)]
        self._u, self._i = (_Moves.of(each, grid.step_s) for each in level)
        self._rows = level[0].shape[1]
        self.r = _product(self._u.values, self._i.values)
        self.slope = np.abs(self.r) * self._u.std[:, None] / np.maximum(self._i.std[None, :], 1e-9)
        evidence = self._likelihood()
        scale = np.array([row.level.scale for row in voltages])[:, None]
        widths = np.array([row.place.width for row in currents])
        away = np.array([row.away for row in currents])
        likely = np.full(self.r.shape, IMPOSSIBLE)
        self.current_scale = np.ones(self.r.shape)
        for amps, usual in CURRENT_SCALES.items():
            prior = _resistance_prior(self.slope * scale / amps) + usual
            prior = prior - _narrow(amps * 2.0 ** (widths - 1))
            prior = np.where(amps * away > MOST_A, IMPOSSIBLE, prior)
            self.current_scale = np.where(prior > likely, amps, self.current_scale)
            likely = np.maximum(prior, likely)
        evidence = np.where(likely <= IMPOSSIBLE + 5.0, 0.0, evidence)
        # Without evidence the slope is chance and constrains neither scale nor resistance.
        unknown = evidence < 1.0
        likely = np.where(unknown, -1.0, np.maximum(likely, -3.0))
        self.current_scale = np.where(unknown, _guess(widths, away), self.current_scale)
        middle = [np.median(each, axis=1) for each in level]
        # Inverters switch off a pack that sags by more than a fifth.
        sags = self.slope * away > 0.2 * middle[0][:, None]
        is_copy = (np.abs(self.slope * middle[1] / middle[0][:, None] - 1.0) < 0.25) & (
            self.r > 0.5
        )
        ids = [np.array([id(row.field.stream) for row in each]) for each in (voltages, currents)]
        # Loads are correlated (torque, power): from 20 nats on further samples count half.
        self.evidence = 20.0 * np.log1p(evidence / 20.0)
        self.score = (
            self.evidence
            + self._polarisation(level[1])
            + np.array([row.prior for row in voltages])[:, None]
            + np.array([row.prior for row in currents])
            + likely
            # One frame holds both in 5 of 7 public layouts, against one of a car's dozens of ids.
            + 4.0 * (ids[0][:, None] == ids[1])
            + np.where(is_copy | (sags & ~unknown), IMPOSSIBLE, 0.0)
            - 1.5 * self._has_sibling(middle[0])[:, None]
        )

    def _likelihood(self) -> FloatArray:
        """Return the log likelihood ratio of a common variation against none."""
        u, i = self._u, self._i
        # A measured quantity dithers: several changes make one independent move.
        moves = [
            np.minimum(free.independent, np.array([row.steps / 4.0 for row in rows]))
            for free, rows in ((u, self._voltages), (i, self._currents))
        ]
        count = np.minimum(moves[0][:, None], moves[1])
        # Bartlett (1946): what moves slowly, such as speeds, has few independent samples.
        memory = np.clip(u.memory[:, None] * i.memory, 0.0, 0.99)
        slots = self._rows * self._step_s / MOVE_S
        count = np.minimum(count, np.maximum(slots * (1.0 - memory) / (1.0 + memory), 1.0))
        evidence = _ratio(self.r, count) - 0.5 * np.log(np.maximum(count, 1.0))
        half = self._rows // 2
        first = _correlation(u.values[:, :half], i.values[:, :half])
        second = _correlation(u.values[:, half:], i.values[:, half:])
        agree = (np.sign(first) == np.sign(self.r)) & (np.sign(second) == np.sign(self.r))
        both = np.sqrt(_ratio(first, count / 2.0) * _ratio(second, count / 2.0))
        # A relation that only one half shows may be one coincidence, such as the wake-up.
        capped = np.minimum(evidence, 2.0 + 3.0 * np.where(agree, both, 0.0))
        evidence = np.where(count < FEW_MOVES, capped, evidence)
        evidence = np.where(self._are_copies(count), 0.0, np.maximum(evidence, 0.0))
        few = np.array([len(np.unique(row.values)) < 4 for row in self._voltages])
        return np.where(few[:, None], np.minimum(evidence, 2.0), evidence)

    def _are_copies(self, count: FloatArray) -> BoolArray:
        """Return which pairs are one quantity twice: no residual but quantization."""
        lost = (1.0 - np.minimum(self.r**2, 1.0)) * self._u.std[:, None] ** 2
        u_step = np.array([row.step for row in self._voltages])[:, None]
        i_step = self.slope * np.array([row.step for row in self._currents])
        alike = (i_step > u_step / ALIKE) & (i_step < u_step * ALIKE)
        # Two roundings of one number differ by a sixth of a step squared on average, by a quarter
        # where they are half a step apart.
        rounded = alike & (lost < 0.15 * (u_step**2 + i_step**2))
        # In many moves a voltage shows its polarisation: what follows closer is the same quantity.
        return np.asarray(rounded | ((self.r**2 > 0.9985) & (count > 20.0)))

    def _polarisation(self, current: FloatArray) -> FloatArray:
        """Return the evidence that the voltage sags on under a sustained current.

        U = a − R·(I + ρ·⟨I⟩), ⟨I⟩ the current through a low pass. Polarisation makes ρ > 0; torque,
        power and speed follow each other with ρ = 0. The evidence is the likelihood ratio of the
        two, where the relation is close enough to show it.
        """
        keep = math.exp(-self._step_s / POLARISATION_S)
        past = lfilter([1.0 - keep], [1.0, -keep], current - current[:, :1], axis=1)
        low = _Moves.of(np.asarray(past), self._step_s)
        with_past = _product(self._u.values, low.values)
        own = (self._i.values * low.values).mean(1, dtype=np.float64)
        spread = low.std / np.maximum(self._i.std, 1e-9)
        best = np.full(self.r.shape, -np.inf)
        # A cell's 10-s resistance is 1.2 to 2 times that of the first 0.1 s.
        for ratio in (0.1, 0.2, 0.4, 0.8):
            share = ratio * spread
            r = (self.r + share * with_past) / np.sqrt(1.0 + 2.0 * share * own + share**2)
            best = np.maximum(best, r**2)
        count = self._rows * self._step_s / POLARISATION_S
        left = np.maximum(1.0 - best, 1e-6) / np.maximum(1.0 - self.r**2, 1e-6)
        # Bounded: the model is not exact, and cells sag as the pack does, in finer numbers.
        return np.asarray(np.clip(-0.5 * count * np.log(left), -10.0, 5.0))

    def _has_sibling(self, level: FloatArray) -> BoolArray:
        """Return which voltages are one of two in a frame: lowest and highest cell."""
        stream = np.array([id(row.field.stream) for row in self._voltages])
        found = np.zeros(len(level), dtype=np.bool_)
        for number, row in enumerate(self._voltages):
            near = (stream == stream[number]) & (np.abs(level / level[number] - 1.0) < SIBLING)
            for other in np.flatnonzero(near).tolist():
                if not row.bits & self._voltages[other].bits:
                    both = self._u.values[number] @ self._u.values[other] / self._rows
                    found[number] |= bool(both > 0.95)
        return found

    def best(self) -> tuple[list[Candidate], list[Candidate], Row | None]:
        """Return the best candidates for current and voltage, and the row of the first current."""
        currents: list[Candidate] = []
        voltages: list[Candidate] = []
        chosen: Row | None = None
        bits: tuple[set[Any], set[Any]] = (set(), set())
        for place in np.argsort(-self.score, axis=None)[: 200 * 200].tolist():
            a, b = divmod(place, self.score.shape[1])
            u, i = self._voltages[a], self._currents[b]
            if self.score[a, b] < IMPOSSIBLE / 2.0 or min(len(currents), len(voltages)) >= SHOWN:
                break
            # A field of a better pair keeps its role.
            if u.bits & i.bits or u.bits & bits[0] or i.bits & bits[1]:
                continue
            bits[0].update(i.bits)
            bits[1].update(u.bits)
            chosen = chosen or i
            one, two = self._candidates(a, b)
            for found, each in ((currents, one), (voltages, two)):
                if not any(each.bits & kept.bits or _are_siblings(each, kept) for kept in found):
                    found.append(each)
        return currents[:SHOWN], voltages[:SHOWN], chosen

    def _candidates(self, a: int, b: int) -> tuple[Candidate, Candidate]:
        """Return the current and the voltage of a pair."""
        u, i, r = self._voltages[a], self._currents[b], float(self.r[a, b])
        amps = float(self.current_scale[a, b])
        facts = {
            "score": float(self.score[a, b]),
            "evidence": float(self.evidence[a, b]),
            "correlation": r,
            "resistance_ohm": float(self.slope[a, b]) * u.level.scale / amps,
            "halves_ohm": tuple(half * u.level.scale / amps for half in self._halves(a, b)),
        }
        zero = 0.0
        if not i.place.is_signed:
            ends = float(i.values.min()), float(i.values.max())
            zeros = np.array(round_zeros(*ends, i.place.width) or [0.0])
            zero = float(zeros[np.abs(zeros - most_common(i.values)).argmin()])
        sign = 1 if r < 0.0 else -1
        current = i.candidate("current", amps, -amps * zero, sign=sign, partner=u.name, **facts)
        return current, u.candidate("voltage", u.level.scale, 0.0, partner=i.name, **facts)

    def _halves(self, a: int, b: int) -> list[float]:
        """Return dU/dI by each half of the capture, in raw numbers; discharge gives R > 0."""
        half, found = self._rows // 2, []
        scale = float(self._u.std[a] / self._i.std[b])
        for part in (slice(0, half), slice(half, None)):
            moves = self._u.values[a, part], self._i.values[b, part]
            (_, both), (_, power) = np.cov(*moves, dtype=np.float64)
            ratio = float(both / power) * scale if power else math.nan
            found.append(-ratio if self.r[a, b] < 0.0 else ratio)
        return found


def round_zeros(low: float, high: float, width: int) -> list[float]:
    """Return the round raw numbers within a range that may mean no current."""
    found = [0.0] if low <= 0.05 * (high - low) else []
    found += [float(1 << bit) for bit in range(max(width - 3, 7), width)]
    if width > 10:
        found += [float(each) for each in range(500, 5000, 500)]
        found += [float(each) for each in range(5000, 65_000, 1000)]
    return [each for each in found if each == 0.0 or low - 1.0 <= each <= high + 1.0]


def _narrow(full_a: FloatArray) -> FloatArray:
    """Return the log penalty of a current's full scale [A]: cars reach 100–1000 A."""
    return np.where(full_a < 60.0, 3.0, np.where(full_a < 150.0, 1.0, 0.0))


def _guess(widths: Ints, away: FloatArray) -> FloatArray:
    """Return the likeliest scales [A] of fields of some widths and reaches, without evidence."""
    scales, usual = np.array([*CURRENT_SCALES.items()]).T[:, :, None]
    full_a = scales * 2.0 ** (widths - 1)
    prior = usual - _narrow(full_a) - (full_a > 2000.0)
    prior = np.where(scales * away > MOST_A, prior + IMPOSSIBLE, prior)
    return np.asarray(scales[prior.argmax(0), 0])


def _are_siblings(one: Candidate, two: Candidate) -> bool:
    """Whether two candidates are cells in one message: raw numbers alike, but for cut bits."""
    middles = [(each.low + each.high) / 2.0 / each.scale for each in (one, two)]
    if one.message != two.message or min(one.low, two.low) <= 0.0:
        return False
    octaves = math.log2(middles[0] / middles[1])
    return abs(octaves - round(octaves)) < SIBLING


def _product(one: FloatArray, two: FloatArray) -> FloatArray:
    """Return the mean products of rows."""
    return np.asarray(one @ two.T / one.shape[1], dtype=np.float64)


def _ratio(r: FloatArray, count: FloatArray) -> FloatArray:
    """Return the log likelihood ratio of a correlation against none."""
    return np.asarray(-0.5 * count * np.log(1.0 - np.minimum(r**2, LARGEST_R2)))


def _correlation(one: FloatArray, two: FloatArray) -> FloatArray:
    """Return the correlations within a part; 0 for rows that hardly move in it."""
    parts = []
    for each in (one, two):
        free = each - each.mean(1, keepdims=True)
        std = free.std(1)
        parts.append(np.where(std > 0.02, 1.0 / np.maximum(std, 1e-9), 0.0)[:, None] * free)
    return _product(parts[0], parts[1])


def _resistance_prior(ohm: FloatArray) -> FloatArray:
    """Return the log prior of a pack's resistance [Ω]: of 12 V starter packs to old car packs."""
    distance = np.log(np.maximum(ohm, 1e-12) / 0.12) / 1.2
    return np.asarray(np.where((ohm < 0.008) | (ohm > 1.2), IMPOSSIBLE, -0.5 * distance**2))

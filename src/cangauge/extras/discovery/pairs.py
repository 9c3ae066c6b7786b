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
from cangauge.extras.discovery.candidate import MOST_A, ROLES, SHOWN, Candidate, Level
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
            levels=self.levels if len(self.levels) > 1 else (),
            **more,
        )


@dataclass(frozen=True, eq=False)
class _Moves:
    """Rows on a grid, freed of their slow part, in units of their standard deviation.

    Parameters
    ----------
    rows : sequence of Row
    level, values : array (m, n)
        Raw numbers on the grid, as they are and freed of their slow part.
    std : array (m,)
    independent : array (m,)
        Number of independent moves.
    memory : array (m,)
        Autocorrelation over one move.
    """

    rows: Sequence[Row]
    level: FloatArray
    values: FloatArray
    std: FloatArray
    independent: FloatArray
    memory: FloatArray

    @classmethod
    def of(cls, rows: Sequence[Row], level: FloatArray, step_s: float) -> _Moves:
        # The trend over 10 s: SoC and temperature move more slowly.
        width = max(3, min(int(10.0 / step_s), level.shape[1] // 2))
        padded = np.pad(level, ((0, 0), (width // 2 + 1, width - width // 2 - 1)), mode="edge")
        sums = np.cumsum(padded, axis=1)
        free = level - (sums[:, width:] - sums[:, :-width]) / width
        bound = 5.0 * np.sqrt((free**2).mean(1, keepdims=True))
        free = np.clip(free, -bound, bound)
        free -= free.mean(1, keepdims=True)
        std = free.std(1)
        group = max(1, round(MOVE_S / step_s))
        # One lone step moves the mean of many slots, and is still one.
        moves = np.sqrt(
            _participation(np.diff(_grouped(level, group), axis=1))
            * _participation(_grouped(free, group))
        )
        values = (free / np.maximum(std, 1e-12)[:, None]).astype(np.float32)
        memory = (values[:, group:] * values[:, :-group]).mean(1, dtype=np.float64)
        # A measured quantity dithers: several changes make one independent move. From 60 on a
        # chance is excluded: two minutes of driving have as many, and the noise of a sensor that
        # is sent twice has more.
        most = np.minimum(60.0, [row.steps / 4.0 for row in rows])
        return cls(rows, level, values, std, np.minimum(moves, most), memory)


def _grouped(rows: FloatArray, group: int) -> FloatArray:
    count = rows.shape[1] // group
    return np.asarray(rows[:, : count * group].reshape(len(rows), count, group).mean(2))


def _participation(rows: FloatArray) -> FloatArray:
    """Return the number of entries that carry the squares of each row."""
    return np.asarray((rows**2).sum(1) ** 2 / np.maximum((rows**4).sum(1), 1e-12))


def best_pairs(
    voltages: Sequence[Row], currents: Sequence[Row], grid: Grid
) -> tuple[list[Candidate], list[Candidate], Row | None]:
    """Return the best candidates for current and voltage, and the row of the first current.

    Pairs are ranked by their log posterior.
    """
    u, i = (
        _Moves.of(rows, np.array([row.means_on(grid) for row in rows]), grid.step_s)
        for rows in (voltages, currents)
    )
    r = _product(u.values, i.values)
    slope = np.abs(r) * u.std[:, None] / np.maximum(i.std, 1e-9)
    evidence = _evidence(u, i, r, slope, grid.step_s)
    likely, amps = _scales(u, i, slope, evidence >= 1.0)
    evidence = np.where(likely > IMPOSSIBLE / 2.0, evidence, 0.0)
    score = (
        evidence
        + _polarisation(u, i, r, grid.step_s)
        + np.array([row.prior for row in voltages])[:, None]
        + np.array([row.prior for row in currents])
        + np.maximum(likely, -3.0)
        # One frame holds both in 5 of 7 public layouts, against one of a car's dozens of ids.
        + 4.0 * (_streams(u)[:, None] == _streams(i))
        - 1.5 * _has_sibling(u)[:, None]
    )
    middle_u, middle_i = (np.median(each.level, axis=1) for each in (u, i))
    is_copy = (np.abs(slope * middle_i / middle_u[:, None] - 1.0) < 0.25) & (r > 0.5)
    # Inverters switch off a pack that sags by more than a fifth.
    away = np.array([row.away for row in currents])
    sags = (slope * away > 0.2 * middle_u[:, None]) & (evidence >= 1.0)
    score[is_copy | sags] = IMPOSSIBLE
    found: tuple[list[Candidate], list[Candidate]] = ([], [])
    chosen: Row | None = None
    bits: tuple[set[Any], set[Any]] = (set(), set())
    for place in np.argsort(-score, axis=None)[: 200 * 200].tolist():
        a, b = divmod(place, len(currents))
        voltage, current = voltages[a], currents[b]
        if score[a, b] < IMPOSSIBLE / 2.0 or min(map(len, found)) >= SHOWN:
            break
        # A field of a better pair keeps its role.
        if voltage.bits & (current.bits | bits[0]) or current.bits & bits[1]:
            continue
        bits[0].update(current.bits)
        bits[1].update(voltage.bits)
        chosen = chosen or current
        scale_a, scale_v = float(amps[a, b]), voltage.levels[0].scale
        facts = {
            "score": float(score[a, b]),
            "evidence": float(evidence[a, b]),
            "correlation": float(r[a, b]),
            "resistance_ohm": float(slope[a, b]) * scale_v / scale_a,
            "halves_ohm": tuple(half * scale_v / scale_a for half in _halves(u, i, a, b)),
        }
        zero = _zero(current)
        way = {"sign": 1 if r[a, b] < 0.0 else -1, "partner": voltage.name}
        pair = (
            current.candidate("current", scale_a, -scale_a * zero, **way, **facts),
            voltage.candidate("voltage", scale_v, 0.0, partner=current.name, **facts),
        )
        for kept, new in zip(found, pair, strict=True):
            if not any(new.bits & each.bits or _are_siblings(new, each) for each in kept):
                kept.append(new)
    return found[0][:SHOWN], found[1][:SHOWN], chosen


def _streams(of: _Moves) -> Ints:
    return np.array([id(row.field.stream) for row in of.rows])


def _scales(
    u: _Moves, i: _Moves, slope: FloatArray, is_known: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return the log prior of each pair's resistance, and the current's scale [A] that gives it.

    Where the slope is not known it is chance, and constrains neither.
    """
    volts = np.array([row.levels[0].scale for row in u.rows])[:, None]
    full = 2.0 ** (np.array([row.place.width for row in i.rows]) - 1)
    away = np.array([row.away for row in i.rows])
    likely, best = np.full(slope.shape, IMPOSSIBLE), np.ones(slope.shape)
    for amps, usual in CURRENT_SCALES.items():
        ohm = np.where(is_known, slope * volts / amps, 0.12)
        # From 12 V starter packs to old car packs.
        prior = usual - 0.5 * (np.log(np.maximum(ohm, 1e-12) / 0.12) / 1.2) ** 2
        # Cars reach 100–1000 A.
        prior = prior - np.select([amps * full < 60.0, amps * full < 150.0], [3.0, 1.0])
        prior = np.where((ohm < 0.008) | (ohm > 1.2) | (amps * away > MOST_A), IMPOSSIBLE, prior)
        best = np.where(prior > likely, amps, best)
        likely = np.maximum(prior, likely)
    return likely, best


def _evidence(u: _Moves, i: _Moves, r: FloatArray, slope: FloatArray, step_s: float) -> FloatArray:
    """Return the log likelihood ratio of a common variation against none."""
    count = np.minimum(u.independent[:, None], i.independent)
    # Bartlett (1946): what moves slowly, such as speeds, has few independent samples.
    memory = np.clip(u.memory[:, None] * i.memory, 0.0, 0.99)
    slots = u.level.shape[1] * step_s / MOVE_S
    count = np.minimum(count, np.maximum(slots * (1.0 - memory) / (1.0 + memory), 1.0))
    evidence = -0.5 * count * np.log(1.0 - np.minimum(r**2, LARGEST_R2))
    evidence = np.maximum(evidence - 0.5 * np.log(np.maximum(count, 1.0)), 0.0)
    # Few levels of a voltage that rests are crossed by chance.
    few = np.array([len(np.unique(row.values)) < 4 for row in u.rows])
    evidence[few] = np.minimum(evidence[few], 2.0)
    # One quantity twice has no residual but quantization. Two roundings of one number differ by a
    # sixth of a step squared on average, by a quarter where they are half a step apart; one has at
    # most a bit or two more.
    lost = (1.0 - np.minimum(r**2, 1.0)) * u.std[:, None] ** 2
    u_step = np.array([row.step for row in u.rows])[:, None]
    i_step = slope * np.array([row.step for row in i.rows])
    alike = (i_step > u_step / 3.5) & (i_step < u_step * 3.5)
    is_rounded = alike & (lost < 0.15 * (u_step**2 + i_step**2))
    # In many moves a voltage shows its polarisation: what follows closer is the same quantity.
    evidence[is_rounded | ((r**2 > 0.9985) & (count > 20.0))] = 0.0
    # Loads are correlated (torque, power): from 20 nats on further samples count half.
    return np.asarray(20.0 * np.log1p(evidence / 20.0))


def _polarisation(u: _Moves, i: _Moves, r: FloatArray, step_s: float) -> FloatArray:
    """Return the evidence that the voltage sags on under a sustained current.

    U = a − R·(I + ρ·⟨I⟩), ⟨I⟩ the current through a low pass. Polarisation makes ρ > 0; torque,
    power and speed follow each other with ρ = 0. The evidence is the likelihood ratio of the
    two, where the relation is close enough to show it.
    """
    keep = math.exp(-step_s / POLARISATION_S)
    past = lfilter([1.0 - keep], [1.0, -keep], i.level - i.level[:, :1], axis=1)
    low = _Moves.of(i.rows, np.asarray(past), step_s)
    with_past = _product(u.values, low.values)
    own = (i.values * low.values).mean(1, dtype=np.float64)
    spread = low.std / np.maximum(i.std, 1e-9)
    best = np.zeros(r.shape)
    # A cell's 10-s resistance is 1.2 to 2 times that of the first 0.1 s.
    for ratio in (0.1, 0.2, 0.4, 0.8):
        share = ratio * spread
        both = (r + share * with_past) ** 2 / (1.0 + 2.0 * share * own + share**2)
        best = np.maximum(best, both)
    count = u.level.shape[1] * step_s / POLARISATION_S
    left = np.maximum(1.0 - best, 1e-6) / np.maximum(1.0 - r**2, 1e-6)
    # Bounded: the model is not exact, and cells sag as the pack does, in finer numbers.
    return np.asarray(np.clip(-0.5 * count * np.log(left), -10.0, 5.0))


def _has_sibling(u: _Moves) -> BoolArray:
    """Return which voltages are one of two in a frame: lowest and highest cell."""
    stream, level = _streams(u), np.median(u.level, axis=1)
    found = np.zeros(len(level), dtype=np.bool_)
    for number, row in enumerate(u.rows):
        near = (stream == stream[number]) & (np.abs(level / level[number] - 1.0) < 0.02)
        for other in np.flatnonzero(near).tolist():
            if not row.bits & u.rows[other].bits:
                found[number] |= bool((u.values[number] * u.values[other]).mean() > 0.95)
    return found


def _are_siblings(one: Candidate, two: Candidate) -> bool:
    """Return whether two candidates are cells in one message: alike, but for cut bits."""
    middles = [(each.low + each.high) / 2.0 / each.scale for each in (one, two)]
    if one.message != two.message or min(one.low, two.low) <= 0.0:
        return False
    octaves = math.log2(middles[0] / middles[1])
    return abs(octaves - round(octaves)) < 0.02


def _halves(u: _Moves, i: _Moves, a: int, b: int) -> list[float]:
    """Return −dU/dI by each half of the capture, in raw numbers, positive as in the whole."""
    found = []
    for volts, amps in zip(
        np.array_split(u.values[a], 2), np.array_split(i.values[b], 2), strict=True
    ):
        (_, both), (_, power) = np.cov(volts, amps, dtype=np.float64)
        found.append(float(both / power) if power else math.nan)
    whole = math.copysign(float(u.std[a] / i.std[b]), float(u.values[a] @ i.values[b]))
    return [whole * half for half in found]


def _zero(current: Row) -> float:
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


def _product(one: FloatArray, two: FloatArray) -> FloatArray:
    """Return the mean products of rows."""
    return np.asarray(one @ two.T / one.shape[1], dtype=np.float64)

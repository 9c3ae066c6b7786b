"""Logs of a pack as blocks of samples: what its voltage and its gauge show.

With h the hours and Q the charge drawn [% of C] since the start of a stretch of samples, S the true
and y the published SoC,

    S = s − Q + effects,    v = U(S) + load + level + slow + fast + functions,    y = S + error

s is free: what happened between two stretches is not known, unless one continues the other. The
errors of the voltage are those of the model's filter (`estimation.ekf`), and what a sensor or a
capacity does to S and v is that of the effects of the model library.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np

from cangauge._typing import BoolArray, FloatArray, IntArray
from cangauge.errors import InputError
from cangauge.extras.judge.gauge import GaugeRecord, is_limit, read_published, resolution_pct
from cangauge.logs.log import Log
from cangauge.model.effects.base import Signals
from cangauge.model.effects.library import LIBRARY, candidates
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model
from cangauge.model.prior import CHEMISTRIES
from cangauge.model.voltage_model import KNOTS_PCT, hermite_basis, resistance_factor

BLOCK_S: Final = 30.0
"""Length of a block of samples whose means are used [s], as in the filter."""
BLOCKS_AT_MOST: Final = 240
"""Most blocks used of a stretch. The voltage error is correlated over 300 s, so denser blocks would
add little information."""
LONGEST_S: Final = 86400.0
"""A longer stretch is cut, and continued [s]: as long as the voltage's error keeps its level."""
PARTED_S: Final = 600.0
"""Interval without samples that ends a stretch [s]: the car may have been charged or driven."""
SHORTEST_S: Final = 240.0
"""A shorter stretch is left out [s]: the polarization of its start has not settled."""
SETTLING_H: Final = 0.025
"""Voltages of this time after the start of a stretch are not used [h]: the delay line fills."""
WANDER_S: Final = 1200.0
"""Time over which the level of the voltage also wanders [s]: the curve's features pass by, and the
pack warms up."""
SECANT_PCT: Final = 1.0
"""Half width over which the curve's slope is taken [%]: about the σ of the SoC."""

FULL_H: Final = 1.0 / 12.0
"""Least time for which a full charge holds its voltage [h], …"""
FULL_C_RATE: Final = 0.05
"""… with less current than this at its end [1/h], of either sign since the sensor may be off, …"""
FULL_TAPER: Final = 0.5
"""… or with one that fell by this factor, …"""
FULL_VOLTAGE: Final = 0.998
"""… within this of the highest voltage, and above the curve at `KNEE_PCT`: the model's and the
typical cell's, since a fit whose logs never reached the top has no knee."""
KNEE_PCT: Final = 99.5
"""Where the curve has turned up towards full [%]."""
SAME_CHARGE_PCT: Final = 2.0
"""Charge drawn after which a charge is another one [%]: clouds interrupt one."""

SENSORS: Final = ("current_offset", "voltage_gain", "capacity")
"""Effects of the model library that the log, or the pack, may have."""


class Samples(NamedTuple):
    """Samples, or means over blocks of them; arrays of shape (n,) unless stated."""

    stretch: IntArray
    time_s: FloatArray
    hours: FloatArray
    drawn_pct: FloatArray
    """Q [%]."""
    current_a: FloatArray
    voltage_v: FloatArray
    temperature_c: FloatArray
    load: FloatArray
    """Load columns of the voltage model, shape (n, k), …"""
    load_v: FloatArray
    """… and what they add to the voltage [V]."""
    drives: FloatArray
    """Drives of the model's effects that depend on the SoC [V], shape (n, effects)."""
    sensor_pct: FloatArray
    """What a unit of each of `SENSORS` adds to the SoC [%], shape (n, sensors), …"""
    sensor_v: FloatArray
    """… and to the voltage beside it [V]."""


class Stretch(NamedTuple):
    """Uninterrupted samples."""

    log: int
    rows: slice
    """Of the log, …"""
    samples: slice
    """… of all samples, …"""
    blocks: slice
    """… and of all blocks."""
    continues: bool
    """Whether it continues the stretch before without a pause."""


class Chain:
    """The samples of the logs of a pack, in order, as blocks.

    Parameters
    ----------
    logs : sequence of Log
    model : Model

    Attributes
    ----------
    stretches : list of Stretch
    samples, blocks : Samples
    published : GaugeRecord
        At each sample.
    row_piece : array of shape (samples,)
        Number of the piece of a count, in order of time; −1 where there is none.
    piece, count_pct, is_full : array of shape (blocks,)
        Piece; y + Q, NaN where y is no count; and whether a charge has ended full.
    """

    def __init__(self, logs: Sequence[Log], model: Model) -> None:
        self.model, self.extended = model, model.extended_model()
        self.functions = model.principal_functions()
        cuts, parts, published = (
            list[tuple[int, slice, bool]](),
            list[Samples](),
            list[GaugeRecord](),
        )
        for number, log in enumerate(logs):
            step_pct = resolution_pct(log)
            for rows, continues in _uninterrupted(log):
                part = log.rows(rows)
                parts.append(_samples(len(parts), part, self.extended))
                published.append(read_published(part, parts[-1].drawn_pct, step_pct))
                cuts.append((number, rows, continues))
        if not any(np.isfinite(each.shown_pct).any() for each in published):
            raise InputError(
                "no stretch of samples is long enough",
                cure=f"give logs of at least {SHORTEST_S / 60.0:.0f} minutes, better half an hour"
                " with changing load",
            )
        for before, after in pairwise(published):
            known = [each.shown_pct[np.isfinite(each.shown_pct)] for each in (before, after)]
            if all(each.size for each in known):  # a limit ends a piece also where it ends a log
                after.is_cut[0] |= is_limit(known[0][-1]) | is_limit(known[1][0])
        self.samples = samples = Samples(*_joined(parts))
        self.published = GaugeRecord(*_joined(published))
        is_count = np.isfinite(self.published.count_pct)
        self.row_piece = np.where(is_count, np.cumsum(self.published.is_cut), -1)
        block = np.floor(3600.0 * samples.hours / BLOCK_S)
        is_first = np.diff(block, prepend=-1.0) != 0.0
        first = np.flatnonzero(is_first | (np.diff(samples.stretch, prepend=-1) > 0))
        whole = _means(samples, first)
        used, is_full = _used(whole, len(cuts), model)
        of_used: list[Any] = [each[used] for each in whole]
        self.blocks = blocks = Samples(*of_used)
        blocks.voltage_v[blocks.hours < SETTLING_H] = np.nan
        self.is_full = is_full[used]
        self.piece, self.count_pct = self._counts([*first[used], samples.hours.size])
        self.stretches = [
            Stretch(log, rows, _places(samples.stretch, k), _places(blocks.stretch, k), continues)
            for k, (log, rows, continues) in enumerate(cuts)
        ]

    def _counts(self, edges: Sequence[int]) -> tuple[IntArray, FloatArray]:
        """Return piece and mean count of the rows from each edge to the next.

        Of two pieces in a window it is the one with more rows.
        """
        piece, count = np.full(len(edges) - 1, -1), np.full(len(edges) - 1, np.nan)
        for k, (low, high) in enumerate(pairwise(edges)):
            known = low + np.flatnonzero(self.row_piece[low:high] >= 0)
            if known.size:
                piece[k] = self.row_piece[known[known.size // 2]]
                count[k] = self.published.count_pct[known[self.row_piece[known] == piece[k]]].mean()
        return piece, count

    def sensor(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Return the change of SoC [%] and of voltage [V] by a unit of one of `SENSORS`."""
        number = SENSORS.index(name)
        return self.blocks.sensor_pct[:, number], self.blocks.sensor_v[:, number]

    def voltage_v(self, soc_pct: FloatArray) -> FloatArray:
        """Return the voltage of the model at a SoC of each block [V]."""
        volts = self.extended.model.pseudo_ocv(soc_pct) + self.blocks.load_v
        over_soc = [each for each in self.extended.effects if each[0].uses_soc]
        for (effect, values), drive in zip(over_soc, self.blocks.drives.T, strict=True):
            volts = volts + drive * effect.over_soc(soc_pct, values, self.extended.model)
        return np.asarray(volts)

    def slope(self, soc_pct: FloatArray) -> FloatArray:
        """Return the slope of the voltage over the SoC at each block [V/%]."""
        high_v, low_v = (self.voltage_v(soc_pct + step) for step in (SECANT_PCT, -SECANT_PCT))
        return np.asarray((high_v - low_v) / (2.0 * SECANT_PCT))

    def function_columns(self, soc_pct: FloatArray) -> FloatArray:
        """Return what the principal functions add to the voltage [V], shape (blocks, functions)."""
        curve = hermite_basis(soc_pct, self.functions.soc_pct) @ self.functions.value
        return np.asarray(curve + self.blocks.load @ self.functions.load)

    @cached_property
    def fitting_pct(self) -> FloatArray:
        """SoC with the start of each stretch at which the voltage fits best [%]."""
        starts = np.arange(1.0, 100.0)
        firsts = [each.blocks.start for each in self.stretches]
        squares = []
        for start in starts:
            error_v = self.blocks.voltage_v - self.voltage_v(start - self.blocks.drawn_pct)
            squares.append(np.add.reduceat(np.nan_to_num(error_v) ** 2, firsts))
        best = starts[np.argmin(squares, axis=0)]
        return np.asarray(best[self.blocks.stretch] - self.blocks.drawn_pct)

    @cached_property
    def _axis_v(self) -> FloatArray:
        return np.asarray(self.model.noise.soc_std_pct * self.slope(self.fitting_pct))

    @cached_property
    def _cold(self) -> FloatArray:
        growth = np.maximum(1.0, resistance_factor(self.blocks.temperature_c))
        return np.asarray(growth**self.model.noise.cold_exponent)

    @cached_property
    def level_v(self) -> FloatArray:
        """Standard deviation of the level of the voltage's error at each block [V]."""
        return np.hypot(self._cold * self.model.noise.level_std_v, self._axis_v)

    def voltage_noise(self, part: float) -> list[tuple[IntArray, FloatArray]]:
        """Return the blocks of each stretch with a voltage, and a root of the errors' covariance.

        Of the model's errors a part varies within the stretch; the level that lasts it is left out.
        """
        found, noise = [], self.model.noise
        for stretch in self.stretches:
            places = stretch.blocks
            at = np.flatnonzero(np.isfinite(self.blocks.voltage_v[places])) + places.start
            cold, level_v = self._cold[at], self.level_v[at]
            apart_s = 3600.0 * np.abs(self.blocks.hours[at, None] - self.blocks.hours[at])
            slow = np.outer(cold, cold) * noise.slow_std_v**2 * np.exp(-apart_s / noise.slow_time_s)
            wander = np.outer(level_v, level_v) * np.exp(-apart_s / WANDER_S)
            fast_v2 = (part * cold * noise.fast_std_v) ** 2
            least_v = 1e-6 * float(self.blocks.voltage_v[at].mean())
            own = np.diag(fast_v2 + self._axis_v[at] ** 2 + least_v**2)
            root = np.linalg.cholesky(part**2 * (slow + wander) + own)
            found.append((at, np.asarray(root, dtype=np.float64)))
        return found

    def published_or(self, other_pct: FloatArray) -> FloatArray:
        """Return the published SoC at each block, as it would count on; else another [%]."""
        shown = self.at_blocks(self.published.shown_pct + self.samples.drawn_pct)
        known = np.where(np.isnan(shown), other_pct, shown - self.blocks.drawn_pct)
        return np.clip(known, 0.0, 100.0)

    def at_blocks(self, values: FloatArray, before_s: float = 0.0) -> FloatArray:
        """Return the latest known value at each block, or `before_s` earlier."""
        hours, found = self.blocks.hours - before_s / 3600.0, np.full(self.piece.size, np.nan)
        for each in self.stretches:
            known = np.flatnonzero(np.isfinite(values[each.samples])) + each.samples.start
            if known.size:
                found[each.blocks] = np.interp(
                    hours[each.blocks], self.samples.hours[known], values[known]
                )
        return found

    def at_samples(self, values: FloatArray) -> FloatArray:
        """Return values of the blocks at the samples."""
        found = [
            np.interp(
                self.samples.hours[each.samples],
                self.blocks.hours[each.blocks],
                values[each.blocks],
            )
            for each in self.stretches
        ]
        return np.concatenate(found)


def _joined(parts: Sequence[tuple[Any, ...]]) -> Iterator[Any]:
    """Yield each array of records as one."""
    return map(np.concatenate, zip(*parts, strict=True))


def _places(stretch: IntArray, k: int) -> slice:
    """Return where a stretch is among the samples or blocks of all."""
    low, high = np.searchsorted(stretch, [k, k + 1]).tolist()
    return slice(low, high)


def _uninterrupted(log: Log) -> Iterator[tuple[slice, bool]]:
    """Yield the rows of a log between its pauses, and whether they continue those before."""
    step_s = np.diff(log.time_s)
    pauses = np.flatnonzero(step_s > max(PARTED_S, 10.0 * float(np.median(step_s)))) + 1
    for first, last in pairwise([0, *pauses, len(log)]):
        duration_s = float(log.time_s[last - 1] - log.time_s[first])
        if last - first < 5 or duration_s < SHORTEST_S:
            continue
        parts = max(1, int(np.ceil(duration_s / LONGEST_S - 0.01)))
        ends = log.time_s[first] + duration_s * np.arange(1, parts) / parts
        edges = [first, *np.searchsorted(log.time_s, ends).tolist(), last]
        for number, (low, high) in enumerate(pairwise(edges)):
            yield slice(int(low), int(high)), number > 0


def _samples(number: int, log: Log, extended: ExtendedModel) -> Samples:
    """Return the samples of a stretch, and what the effects of `SENSORS` do to them.

    The effects undo an error of a sensor; the columns are the error's.
    """
    measured, every = Signals.of(log), np.arange(len(log))
    base = extended.predict(measured, 50.0, every)
    sensor_pct, sensor_v = [], []
    for one in candidates([LIBRARY[name] for name in SENSORS], extended.pack):
        changed = extended.with_effect(one.effect, one.values(one.steps))
        moved = changed.predict(measured, 50.0, every)
        sensor_pct.append((moved.soc_pct - base.soc_pct) / one.steps)
        apart_v = base.signals.voltage_v - moved.signals.voltage_v
        sensor_v.append((apart_v + moved.beside_v - base.beside_v) / one.steps)
    return Samples(
        stretch=np.full(len(log), number),
        time_s=log.time_s,
        hours=(log.time_s - log.time_s[0]) / 3600.0,
        drawn_pct=50.0 - base.soc_pct,
        current_a=base.signals.current_a,
        voltage_v=base.signals.voltage_v,
        temperature_c=base.signals.temperature_c,
        load=extended.model.load_columns(base.signals.temperature_c, base.currents_a),
        load_v=base.beside_v,
        drives=np.array([drive for *_, drive in base.over_soc]).reshape(-1, len(log)).T,
        sensor_pct=np.array(sensor_pct).T,
        sensor_v=np.array(sensor_v).T,
    )


def _means(samples: Samples, first: IntArray) -> Samples:
    """Return the means over blocks, given the first row of each."""
    size = np.diff([*first, samples.hours.size])
    means = [(np.add.reduceat(each, first, axis=0).T / size).T for each in samples[1:]]
    return Samples(samples.stretch[first], *means)


def _used(blocks: Samples, stretches: int, model: Model) -> tuple[IntArray, BoolArray]:
    """Return the blocks that are used, and whether a charge has ended full at each of all.

    It has where a high voltage was held until the current was gone.
    """
    knee_v = float(model.voltage_model().pseudo_ocv([KNEE_PCT])[0])
    if model.cells is not None:
        typical = CHEMISTRIES[model.chemistry].curve_v
        knee_v = max(knee_v, model.cells * float(np.interp(KNEE_PCT, KNOTS_PCT, typical)))
    used, is_full = [], np.zeros(blocks.hours.size, dtype=bool)
    for k in range(stretches):
        inside = np.flatnonzero(blocks.stretch == k)
        voltage_v, ends = blocks.voltage_v[inside], list[int]()
        held = voltage_v >= max(FULL_VOLTAGE * float(voltage_v.max()), knee_v)
        edges = inside[0] + np.flatnonzero(np.diff(held, prepend=False, append=False))
        for first, end in edges.reshape(-1, 2):
            charge = -blocks.current_a[first:end]
            is_small = abs(charge[-1]) < FULL_C_RATE * model.capacity_ah
            has_fallen = charge[-1] < FULL_TAPER * charge.max()
            is_long = blocks.hours[end - 1] - blocks.hours[first] >= FULL_H
            if is_long and (is_small or has_fallen):
                ends.append(end - 1)
        drawn_pct = np.diff(blocks.drawn_pct[ends], append=np.inf)
        is_full[np.array(ends, dtype=np.intp)[drawn_pct >= SAME_CHARGE_PCT]] = True
        stride = max(1, -(-inside.size // BLOCKS_AT_MOST))
        used += [*inside[::stride], inside[-1]]
    return np.unique([*used, *np.flatnonzero(is_full)]), is_full

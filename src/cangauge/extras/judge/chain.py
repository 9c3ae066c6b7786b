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
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.ndimage import find_objects

from cangauge._typing import BoolArray, FloatArray, IntArray
from cangauge.errors import InputError
from cangauge.extras.judge.gauge import is_limit, read_published, resolution_pct
from cangauge.logs.log import Log
from cangauge.model.curve import KNOTS_PCT, hermite_basis
from cangauge.model.effects.base import Signals
from cangauge.model.effects.library import LIBRARY, candidates
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model
from cangauge.model.prior import CHEMISTRIES
from cangauge.model.voltage_model import resistance_factor

BLOCKS_AT_MOST: Final = 240
"""Most blocks used of a stretch. The voltage error is correlated over 300 s, so denser blocks would
add little information."""
LONGEST_S: Final = 86400.0
"""A longer stretch is cut, and continued [s]: as long as the voltage's error keeps its level."""
PARTED_S: Final = 600.0
"""Interval without samples that ends a stretch [s]: the car may have been charged or driven."""
SHORTEST_S: Final = 240.0
"""A shorter stretch is left out [s]: the polarization of its start has not settled."""
WANDER_S: Final = 1200.0
"""Time over which the level of the voltage also wanders [s]: the curve's features pass by, and the
pack warms up."""

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
    shown_pct: FloatArray
    """y [%]; NaN where there is none."""
    count_pct: FloatArray
    """y + Q where y is a count [%]; NaN elsewhere."""
    is_cut: BoolArray
    """Whether another piece of the count begins."""
    held_pct: FloatArray
    """Charge that moves while y is held [%]; at a limit, away from it."""
    step_pct: FloatArray
    """Resolution of y [%]."""

    @property
    def clock_h(self) -> FloatArray:
        """Hours in which the stretches lie so far apart that interpolation never joins two."""
        return self.hours + 1e6 * self.stretch


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
    row_piece, piece : array of shape (samples,), (blocks,)
        Number of the piece of a count, in order of time; −1 where there is none.
    is_full : array of shape (blocks,)
        Whether a charge has ended full.
    fitting_pct : array of shape (blocks,)
        SoC with the start of each stretch at which the voltage fits best [%].
    level_v : array of shape (blocks,)
        Standard deviation of the level of the voltage's error [V].
    """

    def __init__(self, logs: Sequence[Log], model: Model) -> None:
        self.model, self.extended = model, model.extended_model()
        self.functions, noise = model.functions, model.noise
        cuts, parts = list[tuple[int, slice, bool]](), list[Samples]()
        for number, log in enumerate(logs):
            step_pct = resolution_pct(log)
            for rows, continues in _uninterrupted(log):
                parts.append(_samples(len(parts), log.rows(rows), self.extended, step_pct))
                cuts.append((number, rows, continues))
        known = [part.shown_pct[np.isfinite(part.shown_pct)] for part in parts]
        if not any(shown.size for shown in known):
            raise InputError(
                "no stretch of samples is long enough",
                cure=f"give logs of at least {SHORTEST_S / 60.0:.0f} minutes, better half an hour"
                " with changing load",
            )
        for part, before, after in zip(parts[1:], known, known[1:], strict=False):
            # A limit ends a piece also where it ends a log.
            part.is_cut[0] |= bool(is_limit(np.append(before[-1:], after[:1])).any())
        self.samples = samples = Samples(*map(np.concatenate, zip(*parts, strict=True)))
        piece = np.cumsum(samples.is_cut)
        self.row_piece = np.where(np.isfinite(samples.count_pct), piece, -1)
        block_h = noise.block_s / 3600.0
        parted = np.diff([samples.stretch, np.floor(samples.hours / block_h), piece], prepend=-1.0)
        first = np.flatnonzero(parted.any(axis=0))
        every = _means(samples, first)
        used, is_full = _used(every, model)
        of_used: list[Any] = [each[used] for each in every]
        self.blocks = blocks = Samples(*of_used)
        # The delay line fills.
        blocks.voltage_v[blocks.hours < 3.0 * block_h] = np.nan
        self.is_full = is_full[used]
        self.piece = np.where(np.isfinite(blocks.count_pct), piece[first[used]], -1)
        places = [find_objects(each.stretch + 1) for each in (samples, blocks)]
        self.stretches = [
            Stretch(log, rows, of_samples, of_blocks, continues)
            for (log, rows, continues), (of_samples,), (of_blocks,) in zip(
                cuts, *places, strict=True
            )
        ]
        self.fitting_pct = self._fitting()
        growth = np.maximum(1.0, resistance_factor(blocks.temperature_c))
        self._cold = np.asarray(growth**noise.cold_exponent)
        self._axis_v = noise.soc_std_pct * self.slope(self.fitting_pct)
        self.level_v = np.hypot(self._cold * noise.level_std_v, self._axis_v)

    def sensor(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Return the change of SoC [%] and of voltage [V] by a unit of one of `SENSORS`."""
        number = SENSORS.index(name)
        return self.blocks.sensor_pct[:, number], self.blocks.sensor_v[:, number]

    def voltage_v(self, soc_pct: FloatArray) -> FloatArray:
        """Return the voltage of the model at a SoC of each block [V]."""
        volts = self.extended.model.pseudo_ocv(soc_pct) + self.blocks.load_v
        return self.extended.add_over_soc(volts, soc_pct, self.blocks.drives.T)

    def slope(self, soc_pct: FloatArray) -> FloatArray:
        """Return the slope of the voltage over the SoC at each block, over 2 % of it [V/%]."""
        return 0.5 * (self.voltage_v(soc_pct + 1.0) - self.voltage_v(soc_pct - 1.0))

    def tangent(self, soc_pct: FloatArray, of_functions: FloatArray) -> FloatArray:
        """Return the derivative of the voltage, with a multiple of each function [V/%]."""
        low, high = (
            self.voltage_v(at) + self.function_columns(at) @ of_functions
            for at in (soc_pct - 0.1, soc_pct + 0.1)
        )
        return (high - low) / 0.2

    def function_columns(self, soc_pct: FloatArray) -> FloatArray:
        """Return what the principal functions add to the voltage [V], shape (blocks, functions)."""
        curve = hermite_basis(soc_pct, np.array(self.functions.soc_pct)) @ self.functions.value
        return np.asarray(
            curve + self.blocks.load @ self.functions.load_parts(self.blocks.load.shape[1])
        )

    def _fitting(self) -> FloatArray:
        """Return the SoC with the start of each stretch at which the voltage fits best [%]."""
        starts = np.arange(1.0, 100.0)
        firsts = [each.blocks.start for each in self.stretches]
        squares = []
        for start in starts:
            error_v = self.blocks.voltage_v - self.voltage_v(start - self.blocks.drawn_pct)
            squares.append(np.add.reduceat(np.nan_to_num(error_v) ** 2, firsts))
        best = starts[np.argmin(squares, axis=0)]
        return np.asarray(best[self.blocks.stretch] - self.blocks.drawn_pct)

    def voltages(self, varies: float) -> list[tuple[IntArray, FloatArray]]:
        """Return the blocks of each stretch with a voltage, and a root of the errors' covariance.

        `varies` is the part of the model's errors that varies within the stretch.
        """
        found, noise = [], self.model.noise
        for stretch in self.stretches:
            at = np.arange(stretch.blocks.start, stretch.blocks.stop)
            at = at[np.isfinite(self.blocks.voltage_v[at])]
            cold, axis_v, level_v = self._cold[at], self._axis_v[at], self.level_v[at]
            apart_s = 3600.0 * np.abs(self.blocks.hours[at, None] - self.blocks.hours[at])
            slow = np.outer(cold, cold) * noise.slow_std_v**2 * np.exp(-apart_s / noise.slow_time_s)
            lasting = np.outer(level_v, level_v)
            wander = lasting * np.exp(-apart_s / WANDER_S)
            least_v = 1e-6 * float(self.blocks.voltage_v[at].mean())
            own = np.diag((varies * cold * noise.fast_std_v) ** 2 + axis_v**2 + least_v**2)
            covariance = lasting + varies**2 * (slow + wander) + own
            found.append((at, np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)))
        return found

    def drawn_before(self, late_s: float) -> FloatArray:
        """Return the charge drawn since the stretch began, `late_s` before each block [%]."""
        late_h = np.minimum(late_s / 3600.0, self.blocks.hours)
        at = self.blocks.clock_h - late_h
        return np.interp(at, self.samples.clock_h, self.samples.drawn_pct)

    def at_samples(self, values: FloatArray) -> FloatArray:
        """Return values of the blocks at the samples."""
        return np.interp(self.samples.clock_h, self.blocks.clock_h, values)


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


def _samples(number: int, log: Log, extended: ExtendedModel, step_pct: float) -> Samples:
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
    drawn_pct = 50.0 - base.soc_pct
    return Samples(
        np.full(len(log), number),
        log.time_s,
        (log.time_s - log.time_s[0]) / 3600.0,
        drawn_pct,
        base.signals.current_a,
        base.signals.voltage_v,
        base.signals.temperature_c,
        extended.model.load_columns(base.signals.temperature_c, base.currents_a),
        base.beside_v,
        np.array(base.drives).reshape(-1, len(log)).T,
        np.array(sensor_pct).T,
        np.array(sensor_v).T,
        *read_published(log, drawn_pct, step_pct),
    )


def _means(samples: Samples, first: IntArray) -> Samples:
    """Return the means over blocks of what is known, given the first row of each."""
    means = list[Any]()
    for each in samples[1:]:
        known = np.isfinite(each)
        total = np.add.reduceat(np.where(known, each, 0.0), first, axis=0)
        with np.errstate(invalid="ignore"):
            means.append(total / np.add.reduceat(known.astype(np.float64), first, axis=0))
    return Samples(samples.stretch[first], *means)


def _used(blocks: Samples, model: Model) -> tuple[IntArray, BoolArray]:
    """Return the blocks that are used, and whether a charge has ended full at each of all.

    It has where a high voltage was held for five minutes, until the current was below C/20, of
    either sign since the sensor may be off, or half of what it was. High is above the curve at
    99.5 %, where it has turned up towards full: the model's and the typical cell's, since a fit
    whose logs never reached the top has no knee.
    """
    knee_v = float(model.voltage_model().pseudo_ocv([99.5])[0])
    if model.cells is not None:
        typical = CHEMISTRIES[model.chemistry].curve_v
        knee_v = max(knee_v, model.cells * float(np.interp(99.5, KNOTS_PCT, typical)))
    used, is_full = [], np.zeros(blocks.hours.size, dtype=bool)
    for (inside,) in find_objects(blocks.stretch + 1):
        voltage_v, ends = blocks.voltage_v[inside], list[int]()
        held = voltage_v >= max(0.998 * float(voltage_v.max()), knee_v)
        edges = inside.start + np.flatnonzero(np.diff(held, prepend=False, append=False))
        for first, end in edges.reshape(-1, 2):
            charge = -blocks.current_a[first:end]
            is_small = abs(charge[-1]) < model.capacity_ah / 20.0 or charge[-1] < 0.5 * charge.max()
            if is_small and blocks.hours[end - 1] - blocks.hours[first] >= 1.0 / 12.0:
                ends.append(end - 1)
        # Clouds interrupt a charge: after 2 % drawn it is another one.
        drawn_pct = np.diff(blocks.drawn_pct[ends], append=np.inf)
        is_full[np.array(ends, dtype=np.intp)[drawn_pct >= 2.0]] = True
        stride = -(-(inside.stop - inside.start) // BLOCKS_AT_MOST)
        used += [*range(inside.start, inside.stop, stride), inside.stop - 1]
    return np.unique([*used, *np.flatnonzero(is_full)]), is_full

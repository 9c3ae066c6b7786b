"""A chain of logs as stretches of blocks: what a pack's voltage and its gauge show.

With h the hours and Q the charge drawn [% of C] since the start of a stretch, S the true and y the
published SoC,

    S = s − Q + effects,    v = U(S) + load + level + slow + fast + functions,    y = S + error

s is free: what happened between two stretches is not known, unless one continues the other. The
errors of the voltage are those of the model's filter (`estimation.ekf`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np

from cangauge._typing import FloatArray, IntArray
from cangauge.extras.judge.gauge import (
    GaugeRecord,
    is_limit,
    published_pct,
    read_published,
    resolution_pct,
)
from cangauge.logs.log import Log
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model
from cangauge.model.prior import CHEMISTRIES
from cangauge.model.voltage_model import KNOTS_PCT, Functions, hermite_basis, resistance_factor

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
SETTLING_S: Final = 90.0
"""Voltages of this time after the start of a stretch are not used [s]: the delay line fills."""
WANDER_S: Final = 1200.0
"""Time over which the level of the voltage also wanders [s]: the curve's features pass by, and the
pack warms up."""
SECANT_PCT: Final = 1.0
"""Half width over which the curve's slope is taken [%]: about the σ of the SoC."""

FULL_S: Final = 300.0
"""A charge has ended full where the voltage was held so long, …"""
FULL_C_RATE: Final = 0.05
"""… with less current than this at its end [1/h], of either sign since the sensor may be off, …"""
SAME_CHARGE_PCT: Final = 2.0
"""Charge drawn after which a charge is another one [%]: clouds interrupt one."""
FULL_TAPER: Final = 0.5
"""… or with one that fell by this factor, …"""
FULL_VOLTAGE: Final = 0.998
"""… within this of the highest voltage, and above the curve at `KNEE_PCT`: the model's and the
typical cell's, since a fit whose logs never reached the top has no knee."""
KNEE_PCT: Final = 99.5
"""Where the curve has turned up towards full [%]."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """Blocks of uninterrupted samples; arrays of shape (n,) unless stated.

    Attributes
    ----------
    log : int
        Number of its log.
    rows : slice
        Its rows in the log.
    continues : bool
        Whether it continues the stretch before without a pause.
    time_s : array
        Stamp of each block [s].
    hours, drawn_pct : array
        h [h] and Q [%].
    voltage_v : array
        Means; NaN where not used.
    count_pct, piece : array
        y + Q at the blocks where y is a count [%], NaN elsewhere, and the number of its piece.
    published : GaugeRecord
        Of each row, whose stamps, hours and Q are `row_time_s`, `row_hours` and `row_drawn_pct`.
    full_hours, full_drawn_pct : array of shape (charges,)
        h and Q where a charge ended full.
    load, load_v : array of shape (n, k), (n,)
        Load columns of the voltage model, and what they add to the voltage [V].
    prediction : Prediction
        The model's, with means over blocks, for `ExtendedModel.voltage_at`.
    fitting_pct : array
        SoC with the start at which the model's voltage fits best [%], …
    misfit_v : float
        … and the mean error of the voltage that this start leaves [V].
    level_v : array
        Standard deviation of the level of the voltage's error [V].
    scaled_v2, axis_v2 : array of shape (m, m)
        Covariance of the voltage's other errors at the m blocks with a voltage [V²]: what grows
        where a pack follows its model worse, and what does not.
    """

    log: int
    rows: slice
    continues: bool
    time_s: FloatArray
    hours: FloatArray
    drawn_pct: FloatArray
    voltage_v: FloatArray
    count_pct: FloatArray
    piece: IntArray
    published: GaugeRecord
    row_time_s: FloatArray
    row_hours: FloatArray
    row_drawn_pct: FloatArray
    full_hours: FloatArray
    full_drawn_pct: FloatArray
    load: FloatArray
    load_v: FloatArray
    prediction: Any
    fitting_pct: FloatArray
    misfit_v: float
    level_v: FloatArray
    scaled_v2: FloatArray
    axis_v2: FloatArray

    def published_or(self, other_pct: FloatArray) -> FloatArray:
        """Return the published SoC at each block, as it would count on; else another [%]."""
        count = self.published.shown_pct + self.row_drawn_pct
        known = np.isfinite(count)
        if not known.any():
            return other_pct
        shown = np.interp(self.hours, self.row_hours[known], count[known]) - self.drawn_pct
        return np.clip(shown, 0.0, 100.0)

    def drawn_before_pct(self, seconds: float) -> FloatArray:
        """Return Q at each block so long before [%]."""
        hours = self.hours - seconds / 3600.0
        return np.interp(hours, self.row_hours, self.row_drawn_pct)


@dataclass(frozen=True, eq=False)
class Chain:
    """The stretches of the logs of a pack, in order, and its model."""

    stretches: list[Stretch]
    extended: ExtendedModel
    functions: Functions

    @classmethod
    def of(cls, logs: Sequence[Log], model: Model) -> Chain:
        """Cut logs into stretches."""
        extended = model.extended_model()
        stretches = list[Stretch]()
        for number, log in enumerate(logs):
            step_pct = resolution_pct(log)
            for rows, continues in _uninterrupted(log):
                part = _stretch(number, log, rows, model, step_pct)
                if stretches:
                    part = _joined(stretches[-1], part)
                stretches.append(replace(part, continues=continues))
        return cls(stretches, extended, model.principal_functions())

    def slope(self, part: Stretch, soc_pct: FloatArray) -> FloatArray:
        """Return the slope of the voltage of a stretch over its SoC [V/%]."""
        return _slope(self.extended, part.prediction, soc_pct)

    def error_v(self, part: Stretch, soc_pct: FloatArray) -> FloatArray:
        """Return measured minus modelled voltage of a stretch at a SoC [V]."""
        return part.voltage_v - self.extended.voltage_at(soc_pct, part.prediction)

    def function_columns(self, part: Stretch, soc_pct: FloatArray) -> FloatArray:
        """Return what the principal functions add to the voltage [V], shape (n, functions)."""
        curve = hermite_basis(soc_pct, self.functions.soc_pct) @ self.functions.value
        return np.asarray(curve + part.load @ self.functions.load)


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


def _joined(before: Stretch, part: Stretch) -> Stretch:
    """Return a stretch whose pieces are numbered on from those of the stretch before."""
    limits = [
        is_limit(shown[np.isfinite(shown)])
        for shown in (before.published.shown_pct, part.published.shown_pct)
    ]
    number = max(0, int(before.published.piece.max()))
    if all(each.size for each in limits):  # a limit ends a piece also where it ends a log
        number += bool(limits[0][-1] or limits[1][0])
    piece = np.where(part.piece >= 0, part.piece + number, -1)
    rows = part.published.piece
    published = part.published._replace(piece=np.where(rows >= 0, rows + number, -1))
    return replace(part, piece=piece, published=published)


def _stretch(number: int, whole: Log, rows: slice, model: Model, step_pct: float) -> Stretch:
    """Return the blocks of rows without a pause."""
    log, extended = whole.rows(rows), model.extended_model()
    prediction = model.predict(log, initial_soc_pct=50.0)
    signals, elapsed_s = prediction.signals, log.time_s - log.time_s[0]
    block = np.floor(elapsed_s / BLOCK_S).astype(np.intp)
    stride = max(1, -(-int(block[-1] + 1) // BLOCKS_AT_MOST))
    first = np.flatnonzero(np.diff(block, prepend=-1) > 0)
    size = np.diff([*first, len(log)])
    used = np.unique([*range(0, len(first), stride), len(first) - 1])

    def means(values: FloatArray) -> FloatArray:
        return np.asarray((np.add.reduceat(values, first, axis=0).T / size).T)

    drawn = 50.0 - prediction.soc_pct
    published = read_published(log.time_s, published_pct(log), drawn, step_pct)
    drawn_pct, hours = means(drawn)[used], means(elapsed_s)[used] / 3600.0
    count, piece = _of_windows(published, [*first[used], len(log)])
    all_v, all_a = means(signals.voltage_v), means(signals.current_a)
    voltage_v = np.where(hours * 3600.0 < SETTLING_S, np.nan, all_v[used])
    full = first[_full_charges(elapsed_s[first], all_a, all_v, model)]
    full = full[np.diff(drawn[full], append=np.inf) >= SAME_CHARGE_PCT]
    load = model.voltage_model().load_columns(
        signals.temperature_c[prediction.rows], prediction.currents_a
    )
    over_soc = [
        (effect, values, means(drive)[used]) for effect, values, drive in prediction.over_soc
    ]
    beside_v = means(prediction.beside_v)[used]
    of_blocks = replace(prediction, beside_v=beside_v, over_soc=over_soc)
    fitting_pct = _start_pct(extended, of_blocks, voltage_v, drawn_pct) - drawn_pct

    noise, temperature_c = model.noise, means(signals.temperature_c)[used]
    cold = np.maximum(1.0, resistance_factor(temperature_c)) ** noise.cold_exponent
    axis_v = noise.soc_std_pct * _slope(extended, of_blocks, fitting_pct)
    level_v = np.hypot(cold * noise.level_std_v, axis_v)
    has = np.isfinite(voltage_v)
    gap_s = 3600.0 * np.abs(hours[has, None] - hours[has])
    scaled = np.outer(cold[has], cold[has]) * noise.slow_std_v**2
    scaled *= np.exp(-gap_s / noise.slow_time_s)
    scaled += np.outer(level_v[has], level_v[has]) * np.exp(-gap_s / WANDER_S)
    scaled += np.diag((cold[has] * noise.fast_std_v) ** 2)
    return Stretch(
        log=number,
        rows=rows,
        continues=False,
        time_s=means(log.time_s)[used],
        hours=hours,
        drawn_pct=drawn_pct,
        voltage_v=voltage_v,
        count_pct=count,
        piece=piece,
        published=published,
        row_time_s=log.time_s,
        row_hours=elapsed_s / 3600.0,
        row_drawn_pct=drawn,
        full_hours=elapsed_s[full] / 3600.0,
        full_drawn_pct=drawn[full],
        load=means(np.asarray(load))[used],
        load_v=beside_v,
        prediction=of_blocks,
        fitting_pct=fitting_pct,
        misfit_v=float(np.nanmean(voltage_v - extended.voltage_at(fitting_pct, of_blocks))),
        level_v=level_v,
        scaled_v2=scaled,
        axis_v2=np.diag(axis_v[has] ** 2 + (1e-6 * np.nanmean(voltage_v)) ** 2),
    )


def _of_windows(published: GaugeRecord, edges: Sequence[int]) -> tuple[FloatArray, IntArray]:
    """Return mean count and piece of the rows from each edge to the next.

    Of two pieces in a window it is the one with more rows.
    """
    count = np.full(len(edges) - 1, np.nan)
    piece = np.full(len(count), -1, dtype=np.intp)
    for k, (low, high) in enumerate(pairwise(edges)):
        numbers = published.piece[low:high]
        known = numbers[numbers >= 0]
        if known.size:
            piece[k] = np.bincount(known).argmax()
            count[k] = np.mean(published.count_pct[low:high][numbers == piece[k]])
    return count, piece


def _full_charges(
    elapsed_s: FloatArray, current_a: FloatArray, voltage_v: FloatArray, model: Model
) -> IntArray:
    """Return the blocks at which a charge had ended full: high voltage held, current gone."""
    knee_v = float(model.voltage_model().pseudo_ocv([KNEE_PCT])[0])
    if model.cells is not None:
        typical = CHEMISTRIES[model.chemistry].curve_v
        knee_v = max(knee_v, model.cells * float(np.interp(KNEE_PCT, KNOTS_PCT, typical)))
    held = voltage_v >= max(FULL_VOLTAGE * float(voltage_v.max()), knee_v)
    edges = np.flatnonzero(np.diff(held, prepend=False, append=False)).reshape(-1, 2)
    ends = []
    for first, last in edges:
        charge = -current_a[first:last]
        is_small = abs(charge[-1]) < FULL_C_RATE * model.capacity_ah
        has_fallen = charge[-1] < FULL_TAPER * charge.max()
        if elapsed_s[last - 1] - elapsed_s[first] >= FULL_S and (is_small or has_fallen):
            ends.append(last - 1)
    return np.array(ends, dtype=np.intp)


def _slope(extended: ExtendedModel, prediction: Any, soc_pct: FloatArray) -> FloatArray:
    high_v = extended.voltage_at(soc_pct + SECANT_PCT, prediction)
    low_v = extended.voltage_at(soc_pct - SECANT_PCT, prediction)
    return np.asarray((high_v - low_v) / (2.0 * SECANT_PCT))


def _start_pct(
    extended: ExtendedModel, prediction: Any, voltage_v: FloatArray, drawn_pct: FloatArray
) -> float:
    """Return the start at which the model's voltage fits best [%]."""
    starts = np.arange(1.0, 100.0, 1.0)
    errors = [
        np.nanmean((voltage_v - extended.voltage_at(start - drawn_pct, prediction)) ** 2)
        for start in starts
    ]
    return float(starts[int(np.argmin(errors))])

"""A chain of logs as one linear Gaussian model of voltage and published SoC.

With h the hours and Q the charge drawn [% of C] since the start of a stretch of samples, C the
capacity, S the true and y the published SoC, each stretch has

    S = s − (1 − γ)·Q + 100·o·h/C
    v = U(S) + load + level + slow + fast + row(S)·c + v·β
    y = s + e − (1 + κ)·Q − 100·a·h/C + v·β′/U′(S) + step + noise

s is free: what happened between two stretches is not known. o is the offset of the current sensor
and γ the pack's surplus of capacity; the gauge counts with neither, so both part y from S. The
errors of the voltage are those of the model's filter (`estimation.ekf`), and c, the errors of the
curve, are the same in every stretch: what repeats from day to day is not counted twice.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from cangauge._typing import BoolArray, FloatArray, IntArray
from cangauge.logs.log import Log
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model
from cangauge.model.prior import CHEMISTRIES
from cangauge.model.voltage_model import KNOTS_PCT, Functions, hermite_basis, resistance_factor

(START, LEVEL, ERROR, COUNT_OFFSET, COUNT_SCALE, OFFSET, CAPACITY, VOLTAGE, BY_VOLTAGE, STEP,
 FUNCTIONS) = range(11)  # fmt: skip
"""Columns: s [%], level [-], e [%], a [A], κ [%], o [A], γ [%], β [%], β′ [%], step [%], then the
principal functions c [-]; the residual stands last."""

BLOCK_S: Final = 30.0
"""Length of a block of samples whose means are used [s], as in the filter."""
BLOCKS_AT_MOST: Final = 240
"""Most blocks used of a stretch; a longer one is thinned to every k-th block and its last. The
voltage error is correlated over 300 s, so denser blocks would add little information."""
PARTED_S: Final = 600.0
"""Interval without samples that ends a stretch [s]: the car may have been charged or driven."""
SHORTEST_S: Final = 240.0
"""A shorter stretch is left out [s]: the polarization of its start has not settled."""
SETTLING_S: Final = 90.0
"""Voltages of this time after the start of a stretch are not used [s]: the delay line fills."""
SOC_NOISE_PCT: Final = 0.05
"""Noise of the published SoC beside its steps [%]: rounding in the gauge and time of sending."""
COARSE_PCT: Final = 0.2
"""Resolution from which the published SoC is used only at the rows that `_observed` selects [%]."""
PEGGED_PCT: Final = 0.05
"""A published SoC as close to 0 or 100 % is a limit, not a count [%]."""
FULL_STD_PCT: Final = 1.5
"""Standard deviation of the SoC at the end of a full charge [%]: cut-off current and balancing."""
FULL_TAPER: Final = 0.5
"""A charge has ended full where the current fell by this factor at constant voltage, …"""
FULL_C_RATE: Final = 0.1
"""… to less than this [1/h], …"""
FULL_VOLTAGE: Final = 0.998
"""… the voltage within this of its highest, and above the curve at `KNEE_PCT`: the model's and the
typical cell's, since a fit whose logs never reached the top has no knee."""
KNEE_PCT: Final = 98.0
"""Where the curve turns up towards full [%]."""
HELD_PCT: Final = 1.0
"""A published SoC stands still that is held while this charge, and that of two of its steps, flows
[%]: a dashboard shows it."""
WANDER_S: Final = 1200.0
"""Time over which the level of the voltage also wanders [s]: the curve's features pass by, and the
pack warms up."""
SECANT_PCT: Final = 1.0
"""Half width over which the curve's slope is taken [%]: about the σ of the SoC."""
LEAST_SLOPE: Final = 0.1
"""Least slope of the curve, relative to its mean, for a SoC read from a voltage [-]."""

VOLTAGE_SCALES: Final = (0.5, 1.0, 2.0, 4.0)
"""Factors on the model's errors of the voltage: a pack on other days may follow its model worse
than left-out logs did."""


class GaugeNoise(NamedTuple):
    """Errors of a healthy gauge relative to counted charge, as standard deviations."""

    walk_pct: float
    """Random walk in an hour [%]."""
    drift_pct: float
    """Steady drift over an hour [%]."""
    scale_pct: float
    """Error of the charge that a stretch counts [%]."""
    error_pct: float
    """Difference of its error between stretches [% SoC]."""


GAUGES: Final = (
    GaugeNoise(0.05, 0.1, 0.5, 0.3),
    GaugeNoise(0.15, 0.3, 2.0, 0.6),
    GaugeNoise(0.5, 1.0, 10.0, 1.5),
    GaugeNoise(1.5, 3.0, 30.0, 3.0),
)
"""From a pure counter (a BMW i3's) to a gauge that follows the voltage (`batic_car1`'s). The
logs select one, so that a gauge that follows the voltage is not expected to match the charge."""


class Whitening(NamedTuple):
    """Inverse root of the covariance of some blocks' noise."""

    has: BoolArray
    """Blocks with a value."""
    root: FloatArray
    log_norm: float
    """Logarithm of the normalisation."""

    @classmethod
    def of(cls, has: BoolArray, covariance: FloatArray) -> Whitening:
        """Factorise a covariance."""
        root = np.linalg.cholesky(covariance)
        inverse = solve_triangular(root, np.eye(len(root)), lower=True) if root.size else root
        return cls(has, np.asarray(inverse), -float(np.log(np.diag(root)).sum()))

    def gram(self, rows: FloatArray) -> FloatArray:
        """Return XᵀX of the whitened rows of all blocks, shape (n, columns)."""
        white = self.root @ rows[self.has]
        return np.asarray(white.T @ white)


@dataclass(frozen=True, eq=False)
class Stand:
    """A published SoC that is held while charge flows.

    Attributes
    ----------
    since_s, until_s : float
        Stamps of its first and last row [s].
    shown_pct, flowed_pct : float
        The SoC, and the charge that flowed [%].
    """

    since_s: float
    until_s: float
    shown_pct: float
    flowed_pct: float


@dataclass(frozen=True, eq=False)
class Stretch:
    """Blocks of uninterrupted samples; arrays of shape (n,) unless stated.

    Attributes
    ----------
    log : int
        Number of its log.
    time_s : array
        Stamp of each block [s].
    hours, drawn_pct : array
        Since the start of the stretch: h [h] and Q [%].
    voltage_v : array
        Means; NaN where not used.
    shown_pct : array
        Published SoC; NaN where there is none.
    published_pct : array
        The same at the rows that are used; NaN elsewhere.
    soc_step_pct : float
        Resolution of the published SoC [%].
    step_at : int
        Block before which the published SoC departs most from the count.
    held_since_s, held_pct : float
        Stamp since which the last published SoC is held [s], and the charge that flowed since [%];
        0 if it flowed towards the limit that is shown.
    stood : list of Stand
        Within the stretch, each followed by a jump of the charge that flowed.
    full : array of int
        Blocks at which a full charge has ended.
    load : array of shape (n, k)
        Load columns of the voltage model.
    prediction : Prediction
        The model's, with means over blocks, for `ExtendedModel.voltage_at`.
    fitting_pct : array
        SoC with the start at which the model's voltage fits best [%], …
    misfit_v : float
        … and the mean error of the voltage that this start leaves [V].
    level_v : array
        Standard deviation of the level of the voltage's error [V].
    whiten_voltage, whiten_gauge : list of Whitening
        For each of `VOLTAGE_SCALES` and `GAUGES`.
    """

    log: int
    time_s: FloatArray
    hours: FloatArray
    drawn_pct: FloatArray
    voltage_v: FloatArray
    shown_pct: FloatArray
    published_pct: FloatArray
    soc_step_pct: float
    step_at: int
    held_since_s: float
    held_pct: float
    stood: list[Stand]
    full: IntArray
    load: FloatArray
    prediction: Any
    fitting_pct: FloatArray
    misfit_v: float
    level_v: FloatArray
    whiten_voltage: list[Whitening]
    whiten_gauge: list[Whitening]

    @property
    def end(self) -> int | None:
        """Last block with a published SoC; None without any."""
        shown = np.flatnonzero(np.isfinite(self.shown_pct))
        return int(shown[-1]) if shown.size else None


class Design(NamedTuple):
    """Whitened sums XᵀX of a stretch at a linearisation, shape (columns + 1, columns + 1)."""

    voltage: list[FloatArray]
    """Of the voltage, for each of `VOLTAGE_SCALES`."""
    gauge: list[FloatArray]
    """Of the published SoC, for each of `GAUGES`."""
    start_pct: float
    """s at the linearisation [%]: columns and residual are relative to it."""


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
        stretches = [
            _stretch(number, part, _soc_step(log), model, extended)
            for number, log in enumerate(logs)
            for part in _uninterrupted(log)
        ]
        return cls(stretches, extended, model.principal_functions())

    def design(self, part: Stretch, linear_pct: FloatArray) -> Design:
        """Return the sums of a stretch whose voltage is linearised at a SoC [%], shape (n,)."""
        model, functions = self.extended.model, self.functions
        slope = _slope(self.extended, part.prediction, linear_pct)
        start = float(linear_pct[0] + part.drawn_pct[0])
        per_a = 100.0 * part.hours / self.extended.capacity_ah
        columns = FUNCTIONS + functions.number
        V = np.zeros((linear_pct.size, columns + 1))
        V[:, START], V[:, LEVEL] = slope, part.level_v
        V[:, OFFSET] = slope * per_a
        V[:, CAPACITY] = slope * part.drawn_pct / 100.0
        V[:, VOLTAGE] = part.voltage_v / 100.0
        V[:, FUNCTIONS:-1] = hermite_basis(linear_pct, functions.soc_pct) @ functions.value
        V[:, FUNCTIONS:-1] += part.load @ functions.load
        U = self.extended.voltage_at(linear_pct, part.prediction)
        V[:, -1] = part.voltage_v - U + slope * (linear_pct + part.drawn_pct - start)
        Y = np.zeros_like(V)
        Y[:, START] = Y[:, ERROR] = 1.0
        Y[:, COUNT_OFFSET], Y[:, COUNT_SCALE] = -per_a, -part.drawn_pct / 100.0
        mean_slope = float(np.ptp(model.pseudo_ocv([5.0, 95.0]))) / 90.0
        Y[:, BY_VOLTAGE] = model.nominal_v / 100.0 / np.maximum(slope, LEAST_SLOPE * mean_slope)
        Y[part.step_at :, STEP] = 1.0
        Y[:, -1] = part.published_pct + part.drawn_pct - start
        F = np.zeros((part.full.size, columns + 1))
        F[:, START], F[:, OFFSET] = 1.0, per_a[part.full]
        F[:, CAPACITY] = part.drawn_pct[part.full] / 100.0
        F[:, -1] = 100.0 + part.drawn_pct[part.full] - start
        of_full = F.T @ F / FULL_STD_PCT**2
        return Design(
            [whitening.gram(V) + of_full for whitening in part.whiten_voltage],
            [whitening.gram(Y) for whitening in part.whiten_gauge],
            start,
        )


def published_pct(log: Log) -> FloatArray:
    """Return the SoC that the gauge published at each row [%]; NaN where it did not."""
    return np.full(len(log), np.nan) if log.soc_pct is None else log.soc_pct


def _soc_step(log: Log) -> float:
    """Return the resolution of the published SoC [%]."""
    values = np.unique(np.round(published_pct(log), 4))
    values = values[np.isfinite(values)]
    return float(np.quantile(np.diff(values), 0.1)) if values.size > 1 else 1.0


def _uninterrupted(log: Log) -> Iterator[Log]:
    """Yield the parts of a log between its pauses that are long enough."""
    step_s = np.diff(log.time_s)
    pauses = np.flatnonzero(step_s > max(PARTED_S, 10.0 * float(np.median(step_s))))
    for first, last in pairwise([0, *(pauses + 1), len(log)]):
        if last - first > 4 and log.time_s[last - 1] - log.time_s[first] >= SHORTEST_S:
            yield log.rows(slice(first, last))


def _stretch(
    number: int, log: Log, step_pct: float, model: Model, extended: ExtendedModel
) -> Stretch:
    """Return the blocks of a log without a pause."""
    prediction = model.predict(log, initial_soc_pct=50.0)
    signals, elapsed_s = prediction.signals, log.time_s - log.time_s[0]
    block = np.floor(elapsed_s / BLOCK_S).astype(np.intp)
    stride = max(1, -(-int(block[-1] + 1) // BLOCKS_AT_MOST))
    first = np.flatnonzero(np.diff(block, prepend=-1) > 0)
    rows = np.diff([*first, len(log)])
    used = np.unique([*range(0, len(first), stride), len(first) - 1])

    def mean(values: FloatArray) -> FloatArray:
        sums = np.add.reduceat(values, first, axis=0)
        return np.asarray((sums.T / rows).T[used])

    drawn = 50.0 - prediction.soc_pct
    drawn_pct = mean(drawn)

    def median(published: FloatArray) -> FloatArray:
        # Of the count, not its mean: a jump within a block stays one jump.
        counts = np.split(published + drawn, first[1:])
        return np.array([_median(counts[block]) for block in used]) - drawn_pct

    shown = published_pct(log)
    stood = _stands(log.time_s, shown, drawn, step_pct)
    moving = shown.copy()
    for stand in stood:  # a jump back is no reset: the count went on
        moving[(log.time_s > stand.since_s) & (log.time_s <= stand.until_s)] = np.nan
    published = median(_observed(moving, drawn, step_pct))
    at, change = count_changes(published, drawn_pct)
    held_since_s, held_pct = _held(log.time_s, shown, drawn)
    hours, voltage = mean(elapsed_s) / 3600.0, mean(signals.voltage_v)
    settled_v = np.where(hours * 3600.0 < SETTLING_S, np.nan, voltage)
    load = model.voltage_model().load_columns(
        signals.temperature_c[prediction.rows], prediction.currents_a
    )
    over_soc = [(effect, values, mean(drive)) for effect, values, drive in prediction.over_soc]
    of_blocks = replace(prediction, beside_v=mean(prediction.beside_v), over_soc=over_soc)
    fitting_pct = _start_pct(extended, of_blocks, settled_v, drawn_pct) - drawn_pct

    noise = model.noise
    cold = np.maximum(1.0, resistance_factor(mean(signals.temperature_c))) ** noise.cold_exponent
    # The slope is the same under all causes, or they would differ by the size of their noise.
    axis_v = noise.soc_std_pct * _slope(extended, of_blocks, fitting_pct)
    level_v = np.hypot(cold * noise.level_std_v, axis_v)
    has = np.isfinite(settled_v)
    gap_s = 3600.0 * np.abs(hours[has, None] - hours[has])
    scaled = np.outer(cold[has], cold[has]) * noise.slow_std_v**2
    scaled *= np.exp(-gap_s / noise.slow_time_s)
    scaled += np.outer(level_v[has], level_v[has]) * np.exp(-gap_s / WANDER_S)
    scaled += np.diag((cold[has] * noise.fast_std_v) ** 2)
    axis = np.diag(axis_v[has] ** 2 + (1e-6 * np.nanmean(settled_v)) ** 2)
    counted = np.isfinite(published)
    walk = np.minimum(hours[counted, None], hours[counted])
    white = np.eye(len(walk)) * (SOC_NOISE_PCT**2 + step_pct**2 / 12.0)
    return Stretch(
        log=number,
        time_s=mean(log.time_s),
        hours=hours,
        drawn_pct=drawn_pct,
        voltage_v=settled_v,
        shown_pct=median(shown),
        published_pct=published,
        soc_step_pct=step_pct,
        step_at=int(at[np.argmax(np.abs(change))]) if at.size else 0,
        held_since_s=held_since_s,
        held_pct=held_pct,
        stood=stood,
        full=_full_charges(mean(signals.current_a), voltage, model),
        load=mean(np.asarray(load)),
        prediction=of_blocks,
        fitting_pct=fitting_pct,
        misfit_v=float(np.nanmean(settled_v - extended.voltage_at(fitting_pct, of_blocks))),
        level_v=level_v,
        whiten_voltage=[Whitening.of(has, k**2 * scaled + axis) for k in VOLTAGE_SCALES],
        whiten_gauge=[Whitening.of(counted, of.walk_pct**2 * walk + white) for of in GAUGES],
    )


def count_changes(published: FloatArray, drawn_pct: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the blocks with a published SoC after another one, and the change of the count [%]."""
    known = np.flatnonzero(np.isfinite(published))
    return known[1:], np.diff((published + drawn_pct)[known])


def _observed(shown: FloatArray, drawn_pct: FloatArray, step_pct: float) -> FloatArray:
    """Return the published SoC at the rows that are used, NaN elsewhere [%].

    A coarse SoC that changes by one step is half-way between two. It is known to half a step where
    it changes by more, at its first and last row, and whenever charge of two further steps has
    flowed without a change. A limit is not a count, unless nothing else is shown.
    """
    used_pct, known = shown, np.flatnonzero(np.isfinite(shown))
    if step_pct >= COARSE_PCT and known.size:
        value, drawn = shown[known], drawn_pct[known]
        change = np.diff(value, prepend=value[0])
        is_change = change != 0.0
        held = np.cumsum(is_change)  # number of the value that is held
        since = np.flatnonzero(np.diff(held, prepend=-1))[held]
        steps = np.floor(np.abs(drawn - drawn[since]) / (2.0 * step_pct))
        most = np.maximum.accumulate(held * (1.0 + steps.max()) + steps)
        is_used = np.diff(most, prepend=-1.0) > 0.0
        is_used[-1] = True
        is_crossing = np.round(np.abs(change) / step_pct) == 1.0
        used_pct = np.full_like(shown, np.nan)
        used_pct[known[is_used]] = (value - np.where(is_crossing, 0.5 * change, 0.0))[is_used]
    is_count = (used_pct > PEGGED_PCT) & (used_pct < 100.0 - PEGGED_PCT)
    return np.where(is_count, used_pct, np.nan) if is_count.any() else used_pct


def _stands(
    time_s: FloatArray, shown: FloatArray, drawn_pct: FloatArray, step_pct: float
) -> list[Stand]:
    """Return where the published SoC stood still, and then jumped to what it would have been."""
    known = np.flatnonzero(np.isfinite(shown))
    first = known[np.flatnonzero(np.diff(shown[known], prepend=np.nan) != 0.0)]
    last = known[np.searchsorted(known, first[1:]) - 1]
    flowed, held = np.diff(drawn_pct[first]), drawn_pct[last] - drawn_pct[first[:-1]]
    missed = np.abs(np.diff(shown[first]) + flowed)
    least = max(HELD_PCT, 2.0 * step_pct)
    is_stand = (np.abs(held) >= least) & (missed < 0.5 * np.abs(flowed))
    return [
        Stand(float(time_s[a]), float(time_s[b]), float(shown[a]), float(abs(charge)))
        for a, b, charge in zip(first[:-1][is_stand], last[is_stand], flowed[is_stand], strict=True)
    ]


def _held(time_s: FloatArray, shown: FloatArray, drawn_pct: FloatArray) -> tuple[float, float]:
    """Return since when the last published SoC is held [s], and what charge flowed since [%]."""
    known = np.flatnonzero(np.isfinite(shown))
    if not known.size:
        return float(time_s[-1]), 0.0
    changes = np.flatnonzero(np.diff(shown[known]))
    first, last = known[changes[-1] + 1 if changes.size else 0], known[-1]
    flowed = float(drawn_pct[last] - drawn_pct[first])
    limit = PEGGED_PCT if flowed > 0.0 else 100.0 - PEGGED_PCT
    is_limited = (shown[last] - limit) * flowed <= 0.0
    return float(time_s[first]), 0.0 if is_limited else abs(flowed)


def _median(values: FloatArray) -> float:
    """Return the median of the known values, of two the later; NaN without any."""
    known = values[np.isfinite(values)]
    return float(np.median(known[-1:] if known.size == 2 else known)) if known.size else np.nan


def _full_charges(current_a: FloatArray, voltage_v: FloatArray, model: Model) -> IntArray:
    """Return the blocks at which a charge ended full: tapered at constant, high voltage."""
    knee_v = float(model.voltage_model().pseudo_ocv([KNEE_PCT])[0])
    if model.cells is not None:
        typical = CHEMISTRIES[model.chemistry].curve_v
        knee_v = max(knee_v, model.cells * float(np.interp(KNEE_PCT, KNOTS_PCT, typical)))
    high_v = max(FULL_VOLTAGE * float(voltage_v.max()), knee_v)
    held = (voltage_v >= high_v) & (current_a < 0.0)
    edges = np.flatnonzero(np.diff(held, prepend=False, append=False)).reshape(-1, 2)
    ends = []
    for first, last in edges:
        charge = -current_a[first:last]
        if charge[-1] < min(FULL_C_RATE * model.capacity_ah, FULL_TAPER * charge.max()):
            ends.append(last - 1)
    return np.array(ends, dtype=np.intp)


def _slope(extended: ExtendedModel, prediction: Any, soc_pct: FloatArray) -> FloatArray:
    """Return the slope of the voltage over SoC [V/%]."""
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

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
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from cangauge._typing import BoolArray, FloatArray
from cangauge.logs.log import Log
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model, Noise
from cangauge.model.voltage_model import Functions, hermite_basis, resistance_factor

(START, LEVEL, ERROR, COUNT_OFFSET, COUNT_SCALE, OFFSET, CAPACITY, VOLTAGE, BY_VOLTAGE, STEP,
 FUNCTIONS) = range(11)  # fmt: skip
"""Columns: s [%], level [-], e [%], a [A], κ [%], o [A], γ [%], β [%], β′ [%], step [%], then the
principal functions c [-]; the residual stands last."""

BLOCK_S: Final = 30.0
"""Length of a block of samples whose means are used [s], as in the filter."""
BLOCKS_AT_MOST: Final = 240
"""Blocks of a stretch; of a longer one every k-th is used: over minutes the slow error of the
voltage (300 s) hides what more blocks could tell."""
PARTED_S: Final = 600.0
"""Interval without samples that ends a stretch [s]: the car may have been charged or driven."""
SHORTEST_S: Final = 240.0
"""A shorter stretch is left out [s]: the polarization of its start has not settled."""
SETTLING_S: Final = 90.0
"""Voltages of this time after the start of a stretch are not used [s]: the delay line fills."""
SOC_NOISE_PCT: Final = 0.05
"""Noise of the published SoC beside its steps [%]: rounding in the gauge and time of sending."""
COARSE_PCT: Final = 0.2
"""From this step on only the moments are used at which the published SoC changes [%]."""
PEGGED_PCT: Final = 0.05
"""A published SoC as close to 0 or 100 % is a limit, not a count [%]."""
FULL_STD_PCT: Final = 1.5
"""Standard deviation of the SoC at the end of a full charge [%]: cut-off current and balancing."""
FULL_TAPER: Final = 0.5
"""A charge has ended full where the current fell by this factor at constant voltage, …"""
FULL_C_RATE: Final = 0.1
"""… to less than this [1/h], …"""
FULL_VOLTAGE: Final = 0.998
"""… the voltage within this of its highest, and of the curve at 98 %."""
WANDER_S: Final = 1200.0
"""Time over which the level of the voltage also wanders [s]: the curve's features pass by, and the
pack warms up."""
SECANT_PCT: Final = 1.0
"""Half width over which the curve's slope is taken [%]: about the σ of the SoC."""
LEAST_SLOPE: Final = 0.1
"""Least slope of the curve, relative to its mean, for a SoC read from a voltage [-]."""


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


@dataclass(eq=False)
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
    voltage_v, published_pct, temperature_c : array
        Means; NaN where not used.
    full : array of int
        Blocks at which a full charge has ended.
    counted_h : float
        Time counted in earlier stretches [h].
    linear_pct : array
        SoC at which the voltage is linearised [%].
    axis_slope : array
        Slope of the curve by which an error of SoC against voltage counts [V/%]. It is the same
        under all causes, or they would differ by the size of their noise.
    """

    log: int
    time_s: FloatArray
    hours: FloatArray
    drawn_pct: FloatArray
    voltage_v: FloatArray
    published_pct: FloatArray
    temperature_c: FloatArray
    load: FloatArray
    """Load columns, shape (n, k)."""
    prediction: Any
    """The model's prediction with means over blocks, for `ExtendedModel.voltage_at`."""
    soc_step_pct: float
    full: FloatArray
    step_at: int = 0
    """Block before which the published SoC departs most from the count."""
    counted_h: float = 0.0
    linear_pct: FloatArray = field(default_factory=lambda: np.empty(0))
    axis_slope: FloatArray = field(default_factory=lambda: np.empty(0))
    whiten_voltage: list[Whitening] = field(default_factory=list)
    whiten_gauge: list[Whitening] = field(default_factory=list)

    @property
    def hours_long(self) -> float:
        """Duration [h]."""
        return float(self.hours[-1])


def stretches_of(logs: Sequence[Log], model: Model) -> list[Stretch]:
    """Return the stretches of a chain of logs, in order."""
    chain = [part for number, log in enumerate(logs) for part in _parts(number, log, model)]
    counted_h, extended = 0.0, model.extended_model()
    for part in chain:
        part.counted_h = counted_h
        counted_h += part.hours_long
        part.linear_pct = _start_pct(part, extended) - part.drawn_pct
        part.axis_slope = _slope(part, extended)
        _set_noise(part, model.noise)
    return chain


def _parts(number: int, log: Log, model: Model) -> Iterator[Stretch]:
    gap_s = max(PARTED_S, 10.0 * float(np.median(np.diff(log.time_s))))
    edges = [0, *(np.flatnonzero(np.diff(log.time_s) > gap_s) + 1), len(log)]
    step = _soc_step(log)
    for first, last in pairwise(edges):
        rows = slice(first, last)
        if last - first > 4 and log.time_s[last - 1] - log.time_s[first] >= SHORTEST_S:
            yield _stretch(number, log.rows(rows), model, step)


def _soc_step(log: Log) -> float:
    """Return the resolution of the published SoC [%]."""
    known = np.unique(np.round(_published(log), 4))
    known = known[np.isfinite(known)]
    return float(np.quantile(np.diff(known), 0.1)) if known.size > 1 else 1.0


def _published(log: Log) -> FloatArray:
    return np.full(len(log), np.nan) if log.soc_pct is None else log.soc_pct


def _stretch(number: int, log: Log, model: Model, step: float) -> Stretch:
    prediction = model.predict(log, initial_soc_pct=50.0)
    elapsed = log.time_s - log.time_s[0]
    block = np.floor(elapsed / BLOCK_S).astype(np.intp)
    stride = max(1, -(-int(block[-1] + 1) // BLOCKS_AT_MOST))
    first = np.flatnonzero(np.diff(block, prepend=-1) > 0)
    counts = np.diff([*first, len(log)])

    def mean(values: FloatArray) -> FloatArray:
        sums = np.add.reduceat(values, first, axis=0)
        return np.asarray((sums.T / counts).T[::stride])

    published = _published(log)
    drawn = 50.0 - prediction.soc_pct
    if step >= COARSE_PCT:
        published = _at_changes(published)
    published = np.where(
        (published > PEGGED_PCT) & (published < 100.0 - PEGGED_PCT), published, np.nan
    )
    known = np.isfinite(published)
    seen = np.add.reduceat(known, first)
    with np.errstate(invalid="ignore"):
        # The count at the same rows: the mean of y + Q less the block's mean Q.
        both = np.add.reduceat(np.where(known, published + drawn, 0.0), first) / seen
    drawn_mean = mean(drawn)
    voltage = mean(prediction.signals.voltage_v)
    hours = mean(elapsed) / 3600.0
    part = Stretch(
        number,
        mean(log.time_s),
        hours,
        drawn_mean,
        np.where(hours * 3600.0 < SETTLING_S, np.nan, voltage),
        both[::stride] - drawn_mean,
        mean(prediction.signals.temperature_c),
        mean(_load(model, prediction)),
        replace(
            prediction,
            beside_v=mean(prediction.beside_v),
            over_soc=[
                (effect, values, mean(drive)) for effect, values, drive in prediction.over_soc
            ],
        ),
        step,
        _full_charges(mean(prediction.signals.current_a), voltage, model),
    )
    count = part.published_pct + part.drawn_pct
    change = np.abs(np.diff(count, prepend=count[:1]))
    part.step_at = int(np.nanargmax(change)) if np.isfinite(change).any() else 0
    return part


def _load(model: Model, prediction: Any) -> FloatArray:
    columns = model.voltage_model().load_columns(
        prediction.signals.temperature_c[prediction.rows], prediction.currents_a
    )
    return np.asarray(columns)


def _at_changes(published: FloatArray) -> FloatArray:
    """Return a coarse SoC half-way at its changes, else NaN; its first if there are none."""
    result = np.full_like(published, np.nan)
    known = np.flatnonzero(np.isfinite(published))
    value = published[known]
    change = np.flatnonzero(np.diff(value) != 0.0)
    result[known[change + 1]] = 0.5 * (value[change] + value[change + 1])
    if not change.size and known.size:
        result[known[0]] = value[0]
    return result


def _full_charges(current_a: FloatArray, voltage_v: FloatArray, model: Model) -> FloatArray:
    """Return the blocks at which a charge ended full: tapered at constant, high voltage."""
    high_v = max(
        FULL_VOLTAGE * float(voltage_v.max()), float(model.voltage_model().pseudo_ocv([98.0])[0])
    )
    charge = -current_a
    held = (voltage_v >= high_v) & (charge > 0.0)
    ends = []
    for k in np.flatnonzero(held & ~np.append(held[1:], False)):
        begin = k
        while begin > 0 and held[begin - 1]:
            begin -= 1
        low = FULL_C_RATE * model.capacity_ah
        if charge[k] < low and charge[k] < FULL_TAPER * charge[begin : k + 1].max():
            ends.append(k)
    return np.array(ends, dtype=np.intp)


def _set_noise(part: Stretch, noise: Noise) -> None:
    """Set the noise of voltage and gauge, for each size."""
    has = np.isfinite(part.voltage_v)
    cold = _cold(part, noise)[has]
    axis_v = noise.soc_std_pct * part.axis_slope[has]
    level_v = np.hypot(cold * noise.level_std_v, axis_v)
    gap_s = 3600.0 * np.abs(part.hours[has, None] - part.hours[has])
    scaled = np.outer(cold, cold) * noise.slow_std_v**2 * np.exp(-gap_s / noise.slow_time_s)
    scaled += np.outer(level_v, level_v) * np.exp(-gap_s / WANDER_S)
    scaled += np.diag((cold * noise.fast_std_v) ** 2)
    axis = np.diag(axis_v**2 + (1e-6 * np.nanmean(part.voltage_v)) ** 2)
    part.whiten_voltage = [Whitening.of(has, size**2 * scaled + axis) for size in VOLTAGE_SCALES]
    has = np.isfinite(part.published_pct)
    walk = np.minimum(part.hours[has, None], part.hours[has])
    white = np.eye(len(walk)) * (SOC_NOISE_PCT**2 + part.soc_step_pct**2 / 12.0)
    part.whiten_gauge = [Whitening.of(has, each.walk_pct**2 * walk + white) for each in GAUGES]


def _cold(part: Stretch, noise: Noise) -> FloatArray:
    """Return the growth of the voltage's errors in the cold [-]."""
    factor = np.maximum(1.0, resistance_factor(part.temperature_c))
    return np.asarray(factor**noise.cold_exponent)


def _slope(part: Stretch, extended: ExtendedModel) -> FloatArray:
    """Return the slope of the voltage over SoC at the linearisation [V/%]."""
    low, high = part.linear_pct - SECANT_PCT, part.linear_pct + SECANT_PCT
    volts = extended.voltage_at(high, part.prediction) - extended.voltage_at(low, part.prediction)
    return np.asarray(volts / (2.0 * SECANT_PCT))


def _start_pct(part: Stretch, extended: ExtendedModel) -> float:
    """Return the start at which the model's voltage fits best [%]."""
    starts = np.arange(1.0, 100.0, 1.0)
    errors = [
        np.nanmean(
            (part.voltage_v - extended.voltage_at(start - part.drawn_pct, part.prediction)) ** 2
        )
        for start in starts
    ]
    return float(starts[int(np.argmin(errors))])


@dataclass(frozen=True, eq=False)
class Design:
    """Whitened sums of a stretch, for sizes of the voltage's and the gauge's noise."""

    voltage: list[FloatArray]
    """XᵀX of the voltage for each `VOLTAGE_SCALES`, shape (columns + 1, columns + 1)."""
    gauge: list[FloatArray]
    """XᵀX of the published SoC for each `GAUGES`."""
    start_pct: float
    """s at the linearisation [%]: columns and residual are relative to it."""


VOLTAGE_SCALES: Final = (0.5, 1.0, 2.0, 4.0)
"""Factors on the model's errors of the voltage: a pack on other days may follow its model worse
than left-out logs did."""


class GaugeNoise(NamedTuple):
    """How far a healthy gauge strays from the charge, as standard deviations."""

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
"""From a pure counter (a BMW i3's) to a gauge that follows the voltage (`batic_car1`'s). Which one
it is, the logs tell; a gauge that does not count is not held to the count."""


class Voltage(NamedTuple):
    """The parts of a model that a design needs."""

    extended: ExtendedModel
    functions: Functions
    noise: Noise
    capacity_ah: float

    @classmethod
    def of(cls, model: Model) -> Voltage:
        """Build them once."""
        functions = model.principal_functions()
        return cls(model.extended_model(), functions, model.noise, model.capacity_ah)


def design_of(part: Stretch, voltage: Voltage) -> Design:
    """Return the whitened sums of a stretch at its present linearisation."""
    extended, functions, noise, capacity_ah = voltage
    S, n = part.linear_pct, part.hours.size
    U = extended.voltage_at(S, part.prediction)
    slope = _slope(part, extended)
    columns = FUNCTIONS + functions.number
    start = float(S[0] + part.drawn_pct[0])
    per_a = 100.0 * part.hours / capacity_ah
    cold = _cold(part, noise)
    V = np.zeros((n, columns + 1))
    V[:, START] = slope
    axis_v = noise.soc_std_pct * part.axis_slope
    V[:, LEVEL] = np.hypot(cold * noise.level_std_v, axis_v)
    V[:, OFFSET] = slope * per_a
    V[:, CAPACITY] = slope * part.drawn_pct / 100.0
    V[:, VOLTAGE] = part.voltage_v / 100.0
    V[:, FUNCTIONS:-1] = hermite_basis(S, functions.soc_pct) @ functions.value
    V[:, FUNCTIONS:-1] += part.load @ functions.load
    V[:, -1] = part.voltage_v - U + slope * (S + part.drawn_pct - start)
    Y = np.zeros((n, columns + 1))
    Y[:, START] = Y[:, ERROR] = 1.0
    Y[:, COUNT_OFFSET], Y[:, COUNT_SCALE] = -per_a, -part.drawn_pct / 100.0
    typical = extended.model.nominal_v
    mean_slope = float(np.ptp(extended.model.pseudo_ocv([5.0, 95.0]))) / 90.0
    Y[:, BY_VOLTAGE] = typical / 100.0 / np.maximum(slope, LEAST_SLOPE * mean_slope)
    Y[part.step_at :, STEP] = 1.0
    Y[:, -1] = part.published_pct + part.drawn_pct - start
    F = np.zeros((part.full.size, columns + 1))
    F[:, START], F[:, OFFSET] = 1.0, per_a[part.full]
    F[:, CAPACITY] = part.drawn_pct[part.full] / 100.0
    F[:, -1] = 100.0 + part.drawn_pct[part.full] - start
    of_full = F.T @ F / FULL_STD_PCT**2

    return Design(
        [_whitened(V, each) + of_full for each in part.whiten_voltage],
        [_whitened(Y, each) for each in part.whiten_gauge],
        start,
    )


def _whitened(rows: FloatArray, whitening: Whitening) -> FloatArray:
    white = whitening.root @ rows[whitening.has]
    return np.asarray(white.T @ white)

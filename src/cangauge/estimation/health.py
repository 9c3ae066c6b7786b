"""Health of the pack: capacity and resistance as slow states with their uncertainty.

*Capacity* is the charge per 100 % of the model's SoC scale. It is learned from pairs of charge
moved and change of SoC by voltage, in a Kalman filter of its own with the state

    (S, g, o, r, b, l, v, ξ₀ … ξ₁₀)

SoC S [%], charge gain g = reference capacity / capacity, offset of the current sensor o [A],
relative deviation of the resistance r, the model's slow bias b and lasting bias l [V] as in the
filter, the voltage sensor's error v [V], and the error ξ of the curve at 0, 10 … 100 % SoC, in
standard deviations:

    S ← S − g·a·(i − o)·Δt,   a = 100/(3600·reference capacity)
    U = OCV(S) + kt·(T − T_r) + (1 + r)·Σ Rj·I(t − dj) − R·o + b + l + v + c(S)·ξ(S) + fast error

The curve's standard deviation c is that of the lasting error in volts, that of the identified curve
where few logs have been, and, where the curve is steep, `AXIS_STD_PCT` of SoC times its slope: the
knees of a curve are placed by the SoC of its logs, and move with temperature and current.

The curve's error belongs to the SoC, not to the drive, so it is the same each time that the SoC
passes: no number of charges averages it out, and the standard deviation of the capacity stops
falling where curve error and capacity are not separable. The identification judges whole logs,
which do not separate an error of the curve from one of the day: each is taken at its full size. An
offset moves charge in proportion to time, a capacity in proportion to charge: they separate once
the pack is charged and discharged. After an interval without observed charge the SoC is unknown;
the other states stay.

*Resistance*, relative to the model, is the slope of the model's residual over its predicted drop,
in Haar details of 4 to 32 s: errors of the OCV and slow polarisation lie on longer scales. Each
scale has its own slope; where they differ, polarisation leaks in, and the spread is part of the
standard deviation.

Neither changes the SoC: they are published, for the user to set `capacity_ah`. A learned
capacity far from the model's marks a model mismatch.

References
----------
Plett, Recursive approximate weighted total least squares estimation of battery cell total
capacity, J. Power Sources 196 (2011) 2319: capacity from pairs of charge and SoC change. Haar
transform: see `inference.time_scales`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from cangauge._arithmetic import total
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.estimation.counting import moved_std_pct
from cangauge.estimation.ekf import (
    LASTING_TIME_S,
    OFFSET_STD_PER_AH,
    OFFSET_WALK_PER_SQRT_H,
    OUTLIER_SIGMAS,
    UNKNOWN_SOC_STD_PCT,
)
from cangauge.estimation.measurement_noise import CurveFunctions
from cangauge.estimation.state import ChargeSinceUpdate, HealthState, ResistanceState
from cangauge.model.model_file import ModelNoise
from cangauge.model.voltage_model import Curve, soc_from_ocv

CAPACITY_STD: Final = 0.1
"""Prior relative standard deviation of the capacity: a pack in service holds 80 % (the usual end
of life in a car, IEC 62660) to somewhat above 100 % of its rated charge."""

GAIN_WITHIN: Final = (0.2, 5.0)
"""Plausible ratio of the reference capacity to the pack's: beyond, one of them is another's."""

CAPACITY_WALK_PER_SQRT_DAY: Final = 1e-3
"""Random walk of the relative capacity: 2 % in a year, as cells age."""

RESISTANCE_STD: Final = 0.3
"""Prior relative standard deviation of the resistance: it doubles over a life and with cold, and
the model may come from another season."""

RESISTANCE_TIME_S: Final = 3600.0
"""Memory of the resistance [s]: the pack's temperature changes within an hour of driving."""

VOLTAGE_GAIN_STD: Final = 0.0025
"""Prior standard deviation of the voltage sensor, relative to the voltage: data sheets of pack
sensors state ±0.5 %, taken as two standard deviations."""

SLOW_SPAN_PCT: Final = 3.0
CURVE_SPAN_PCT: Final = 8.0
"""SoC travel over which the slow bias, and the lasting bias and the curve's error, decorrelate [%]:
spacing of the features of a pseudo-OCV (phases of graphite)."""

AXIS_STD_PCT: Final = 1.0
"""Standard deviation of the SoC at which a feature of the curve lies [%]: the reference SoC of the
logs that it was identified on, a car's or one counted from full, is seldom better."""

FAR_PCT: Final = 1.0
"""Distance between SoC and voltage's SoC from which the curve's slope is the secant's [%]."""

WINDOW_S: Final = 60.0
"""Time over which voltages are averaged for one update of the capacity [s]."""

SHORTEST_PCT: Final = 0.01
"""Least travel of a window [% SoC]; keeps the noise finite."""

BEYOND_PCT: Final = 10.0
"""How far the filter's SoC may lie outside 0–100 % [%]: its errors are Gaussian."""

NODE_PCT: Final = 10.0
NODES: Final = 11
"""Spacing [% SoC] and number of the nodes of the curve's error."""

SCALES: Final = 4
SHORTEST_BLOCK_S: Final = 4.0
"""Haar details for the resistance: blocks of 4, 8, 16 and 32 s."""

DETAILS_AT_LEAST: Final = 8.0
"""Details of one scale from which its slope has a known noise."""

_S, _G, _O, _R, _B, _L, _V, _C = range(8)
STATES: Final = _C + NODES
_HOUR_S: Final = 3600.0
_DAY_S: Final = 86400.0


class Health(NamedTuple):
    """Health of the pack, with standard deviations."""

    capacity_ah: float
    """Charge from 100 to 0 % SoC [Ah]."""
    capacity_std_ah: float
    resistance_ratio: float
    """Resistance relative to the model's [-]; 1 where nothing is known."""
    resistance_std: float
    offset_a: float
    """Offset of the current sensor, measured minus true [A]."""
    offset_std_a: float = math.nan


class VoltageTick(NamedTuple):
    """One measured voltage with the terms of its prediction."""

    voltage_v: float
    without_ocv_v: float
    """Predicted voltage less the pseudo-OCV [V]."""
    drop_v: float
    """Part of it that is proportional to the resistances [V]; negative while discharging."""
    soc_newton_pct: float
    """SoC by inverse of the model [%]; NaN where the voltage lies outside its range."""
    soc_counted_pct: float
    """SoC by counting [%]: without the filter's corrections."""
    is_filled: bool
    """Whether the delay line is full: else the drop is not known."""
    is_inside: bool
    """Whether the temperature lies within the identified range: else the level is not known."""


class HealthEstimator:
    """Learn capacity and resistance from the voltages at the model's rate.

    Call `count` at each tick, then `use` where there is a voltage.

    Parameters
    ----------
    curve : Curve
        Pseudo-OCV, effects included.
    steady_ohm : float
        Change of the voltage with a lasting current, negative [V/A].
    noise : ModelNoise
        Error of the model: the slow part gives the bias, the lasting part the curve's error.
    fast_std_v : float
        Standard deviation of one voltage's fast error, as white noise at the model's rate [V].
    nominal_v : float
        Voltage at half charge [V].
    capacity_ah : float
        Reference capacity [Ah], which the charge is counted in.

    Attributes
    ----------
    state : HealthState
        Without filter and resistance.
    resistance : ResistanceEstimator
    pct_per_as : float
        SoC of a charge [%/(A s)].
    """

    def __init__(
        self,
        curve: Curve,
        *,
        steady_ohm: float,
        noise: ModelNoise,
        fast_std_v: float,
        nominal_v: float,
        capacity_ah: float,
    ) -> None:
        self._curve = curve
        self._steady_ohm = steady_ohm
        self._fast_var = fast_std_v**2
        self._slow_var = noise.slow_std_v**2
        self._slow_time_s = noise.slow_time_s
        self._lasting_var = noise.lasting_std_v**2
        self._functions = CurveFunctions(noise)
        self._reference_ah = capacity_ah
        self.pct_per_as = 100.0 / (3600.0 * capacity_ah)
        self._offset_std_a = OFFSET_STD_PER_AH * capacity_ah
        self._prior = self._prior_covariance(VOLTAGE_GAIN_STD * nominal_v)
        self.state = HealthState(capacity_ah=capacity_ah)
        self._forget()
        self.resistance = ResistanceEstimator()

    def count(self, since: ChargeSinceUpdate) -> None:
        """Take the charge counted since the last call."""
        state = self.state
        if since.away_s:
            # Charged or driven unobserved: the voltage finds the SoC again.
            self._advance()
            self._p[_S, _S] += moved_std_pct(since.away_s) ** 2
            state.is_started = state.is_started and bool(self._p[_S, _S] < UNKNOWN_SOC_STD_PCT**2)
        state.seconds += since.seconds
        state.away_s += since.away_s
        state.discharged_pct += since.discharged_pct
        state.moved_pct += since.moved_pct
        state.gap_var_pct2 += since.gap_var_pct2

    def use(self, tick: VoltageTick, seconds: float) -> None:
        """Take one voltage, `seconds` after the last one [s]."""
        if not tick.is_filled:
            self.resistance.restart()
            return
        counted_v = self._curve.pseudo_ocv_at(tick.soc_counted_pct)[0]
        residual_v = tick.voltage_v - tick.without_ocv_v - counted_v
        self.resistance.add(residual_v, tick.drop_v, seconds)
        if not tick.is_inside:
            return
        state = self.state
        if not state.is_started:
            if math.isnan(tick.soc_newton_pct):
                return
            self._advance()
            self._start(tick.soc_newton_pct)
        soc_pct = self._soc_pct()
        state.sum_v += tick.voltage_v - tick.without_ocv_v - self._curve.pseudo_ocv_at(soc_pct)[0]
        state.sum_drop_v += tick.drop_v
        state.ticks += 1
        state.window_s += seconds
        if state.window_s >= WINDOW_S:
            moved_pct = state.moved_pct
            self._advance()
            means = state.sum_v / state.ticks, state.sum_drop_v / state.ticks
            self._update(*means, state.ticks, moved_pct)
            state.sum_v = state.sum_drop_v = state.window_s = 0.0
            state.ticks = 0

    def correct(self, soc_pct: float, std_pct: float) -> None:
        """Take a SoC that is known other than by voltage, with its standard deviation [%]."""
        self._advance()
        row = np.zeros(STATES)
        row[_S] = 1.0
        if not self.state.is_started:
            self._start(soc_pct)
        self._fuse(row, soc_pct - float(self._x[_S]), std_pct**2)

    @property
    def propagated(self) -> tuple[float, float, float]:
        """SoC [%], gain [-] and offset [A] before the charge counted since the last update."""
        return float(self._x[_S]), float(self._x[_G]), float(self._x[_O])

    @property
    def capacity(self) -> tuple[float, float]:
        """Capacity and its standard deviation as known now [Ah]."""
        gain = float(self._x[_G])
        capacity_ah = self._reference_ah / gain
        return capacity_ah, capacity_ah / gain * math.sqrt(float(self._p[_G, _G]))

    @property
    def health(self) -> Health:
        """Capacity, resistance and offset as known now."""
        return Health(
            *self.capacity,
            *self.resistance.ratio(),
            float(self._x[_O]),
            math.sqrt(float(self._p[_O, _O])),
        )

    def snapshot(self) -> HealthState:
        """Return a copy of the state."""
        return replace(
            self.state,
            capacity_ah=self._reference_ah,
            x=self._x.tolist(),
            p=self._p[np.tril_indices(STATES)].tolist(),
            resistance=self.resistance.snapshot(),
        )

    def restore(self, state: HealthState) -> None:
        """Continue from a state.

        A state with another reference capacity keeps its learned capacity.

        Raises
        ------
        InputError
            If it is of another size, or its covariance is not positive semidefinite.
        """
        rows, columns = np.tril_indices(STATES)
        if len(state.x) != STATES or len(state.p) != rows.size:
            raise InputError(f"not a filter of {STATES} states", field="health.p")
        covariance = np.zeros((STATES, STATES))
        covariance[rows, columns] = covariance[columns, rows] = state.p
        low, high = GAIN_WITHIN
        if not _is_semidefinite(covariance) or not low < state.x[_G] < high:
            raise InputError(
                "not a positive semidefinite covariance, or a capacity out of range",
                field="health.p",
            )
        self._x, self._p = np.array(state.x), covariance
        self.state = replace(state, x=[], p=[], resistance=ResistanceState())
        self.resistance.restore(state.resistance)
        if state.capacity_ah != self._reference_ah:
            self._rescale(self._reference_ah / state.capacity_ah)

    def take_over(self, before: HealthEstimator) -> None:
        """Continue from the estimator of another model: keep capacity and offset.

        The curve's error and the resistance belong to the other model.
        """
        ratio = self._reference_ah / before._reference_ah
        self._x[_G] = before._x[_G] * ratio
        self._x[_O] = before._x[_O]
        kept = np.ix_([_G, _O], [_G, _O])
        self._p[kept] = before._p[kept]
        self._p[_G, :] *= ratio
        self._p[:, _G] *= ratio

    def _rescale(self, ratio: float) -> None:
        """Express the gain and the charge not used yet in another reference capacity."""
        self._x[_G] *= ratio
        self._p[_G, :] *= ratio
        self._p[:, _G] *= ratio
        state = self.state
        state.capacity_ah *= ratio
        state.discharged_pct /= ratio
        state.moved_pct /= ratio
        state.gap_var_pct2 /= ratio**2

    def _prior_covariance(self, sensor_std_v: float) -> FloatArray:
        p = np.zeros((STATES, STATES))
        p[_S, _S] = UNKNOWN_SOC_STD_PCT**2
        p[_G, _G] = CAPACITY_STD**2
        p[_O, _O] = self._offset_std_a**2
        p[_R, _R] = RESISTANCE_STD**2
        p[_B, _B] = self._slow_var
        p[_L, _L] = self._lasting_var
        p[_V, _V] = sensor_std_v**2
        nodes = NODE_PCT * np.arange(NODES)
        like = np.exp(-np.abs(nodes[:, None] - nodes) / CURVE_SPAN_PCT)
        p[_C:, _C:] = like
        return p

    def _start(self, soc_pct: float) -> None:
        """Begin with an unknown SoC."""
        self._x[_S] = soc_pct
        self._p[_S, :] = self._p[:, _S] = 0.0
        self._p[_S, _S] = UNKNOWN_SOC_STD_PCT**2
        state = self.state
        state.is_started = True
        state.sum_v = state.sum_drop_v = state.window_s = 0.0
        state.ticks = 0

    def _soc_pct(self) -> float:
        """Return the SoC after the charge counted since the last update [%]."""
        state = self.state
        offset_pct = self.pct_per_as * (state.seconds - state.away_s) * float(self._x[_O])
        return float(self._x[_S]) - float(self._x[_G]) * (state.discharged_pct - offset_pct)

    def _advance(self) -> None:
        """Propagate the state over the charge counted since the last update."""
        state = self.state
        seconds, moved_pct = state.seconds, state.moved_pct
        if seconds <= 0.0:
            return
        per_a = self.pct_per_as * (seconds - state.away_s)
        gain = float(self._x[_G])
        charge_pct = state.discharged_pct - per_a * float(self._x[_O])
        slow_kept = math.exp(-seconds / self._slow_time_s - moved_pct / SLOW_SPAN_PCT)
        lasting_kept = math.exp(-seconds / LASTING_TIME_S - moved_pct / CURVE_SPAN_PCT)
        resistance_kept = math.exp(-seconds / RESISTANCE_TIME_S)
        change = np.eye(STATES)
        change[_S, _G], change[_S, _O] = -charge_pct, gain * per_a
        change[_B, _B], change[_L, _L], change[_R, _R] = slow_kept, lasting_kept, resistance_kept
        self._x[_S] -= gain * charge_pct
        self._x[_B] *= slow_kept
        self._x[_L] *= lasting_kept
        self._x[_R] *= resistance_kept
        p = change @ self._p @ change.T
        p[_S, _S] += state.gap_var_pct2
        p[_G, _G] += CAPACITY_WALK_PER_SQRT_DAY**2 * seconds / _DAY_S
        p[_O, _O] += (OFFSET_WALK_PER_SQRT_H * self._offset_std_a) ** 2 * seconds / _HOUR_S
        p[_R, _R] += RESISTANCE_STD**2 * (1.0 - resistance_kept**2)
        p[_B, _B] += self._slow_var * (1.0 - slow_kept**2)
        p[_L, _L] += self._lasting_var * (1.0 - lasting_kept**2)
        # No state is known worse than before anything was measured.
        p[_G, _G] = min(p[_G, _G], CAPACITY_STD**2)
        p[_O, _O] = min(p[_O, _O], self._offset_std_a**2)
        self._p = 0.5 * (p + p.T)
        state.seconds = state.away_s = state.discharged_pct = state.moved_pct = 0.0
        state.gap_var_pct2 = 0.0

    def _update(self, mean_v: float, drop_v: float, ticks: int, moved_pct: float) -> None:
        """Update with the mean of the voltages of a window, less OCV and drop [V].

        What the curve's error does between two nodes is not in the state: it is noise, the same
        for as many windows as the SoC takes to the next node.
        """
        soc_pct = float(self._x[_S])
        at = self._curve.pseudo_ocv_at
        ocv_v, slope = at(soc_pct)
        row = np.zeros(STATES)
        row[_O] = -self._steady_ohm
        row[_R] = drop_v
        row[_B] = row[_L] = row[_V] = 1.0
        # Where the voltage's own SoC lies elsewhere, the curve between both counts, and its error
        # there: on a flat part the local slope would send the SoC far beyond a knee.
        bias_v = float(row[_O:_C] @ self._x[_O:_C])
        there = soc_from_ocv(self._curve, ocv_v + mean_v - bias_v, min(max(soc_pct, 0.0), 100.0))
        there_v, there_slope = at(there.soc_pct)
        if not there.inside:
            mean_v = there_v - ocv_v + bias_v
        if abs(there.soc_pct - soc_pct) > FAR_PCT:
            slope = (there_v - ocv_v) / (there.soc_pct - soc_pct)
        row[_S] = slope
        axis_v, curve_v = AXIS_STD_PCT * there_slope, self._functions.std_v(there.soc_pct)
        std_v = math.sqrt(self._lasting_var + axis_v * axis_v + curve_v * curve_v)
        below, weights, between_var = _between_nodes(there.soc_pct)
        row[_C + below], row[_C + below + 1] = std_v * weights[0], std_v * weights[1]
        shared_by = max(0.5 * NODE_PCT / max(moved_pct, SHORTEST_PCT), 1.0)
        variance = self._fast_var / ticks + between_var * std_v**2 * shared_by
        expected_v = float(row[_O:] @ self._x[_O:])
        self._fuse(row, mean_v - expected_v, variance)
        self._x[_S] = min(max(float(self._x[_S]), -BEYOND_PCT), 100.0 + BEYOND_PCT)

    def _fuse(self, row: FloatArray, innovation: float, variance: float) -> None:
        """Update with one measurement; an outlier's variance is raised to its size."""
        towards = self._p @ row
        spread = float(row @ towards)
        if innovation**2 > OUTLIER_SIGMAS**2 * (spread + variance):
            variance = max(variance, innovation**2 - spread)
        gain = towards / (spread + variance)
        self._x = self._x + gain * innovation
        p = self._p - np.outer(gain, towards)
        self._p = 0.5 * (p + p.T)
        low, high = GAIN_WITHIN
        if not (low < self._x[_G] < high and (np.diag(self._p) >= 0.0).all()):
            self._forget()

    def _forget(self) -> None:
        """Begin again: arithmetic failed, or the voltages are those of another pack."""
        self._x = np.zeros(STATES)
        self._x[_G] = 1.0
        self._p = self._prior.copy()
        self.state.is_started = False


class ResistanceEstimator:
    """Resistance relative to the model's, from Haar details of residual and predicted drop.

    Attributes
    ----------
    state : ResistanceState
    """

    def __init__(self) -> None:
        self.state = ResistanceState()

    def restart(self) -> None:
        """Drop blocks that are not complete: a voltage is missing."""
        state = self.state
        state.block = [0.0, 0.0, 0.0, 0.0]
        state.waiting = [[math.nan, math.nan] for _ in range(SCALES)]

    def add(self, residual_v: float, drop_v: float, seconds: float) -> None:
        """Take a residual and the predicted drop [V], `seconds` after the last ones [s]."""
        state = self.state
        if seconds > SHORTEST_BLOCK_S:
            self.restart()
            return
        block = state.block
        block[0] += residual_v
        block[1] += drop_v
        block[2] += 1.0
        block[3] += seconds
        if block[3] < SHORTEST_BLOCK_S:
            return
        kept = math.exp(-block[3] / RESISTANCE_TIME_S)
        for sums in state.sums:
            for place, value in enumerate(sums):
                sums[place] = kept * value
        residual_v, drop_v = block[0] / block[2], block[1] / block[2]
        state.block = [0.0, 0.0, 0.0, 0.0]
        for waiting, sums in zip(state.waiting, state.sums, strict=True):
            if math.isnan(waiting[0] + waiting[1]):
                waiting[:] = residual_v, drop_v
                return
            y, x = residual_v - waiting[0], drop_v - waiting[1]
            sums[0] += x * x
            sums[1] += x * y
            sums[2] += y * y
            sums[3] += 1.0
            residual_v, drop_v = 0.5 * (residual_v + waiting[0]), 0.5 * (drop_v + waiting[1])
            waiting[:] = math.nan, math.nan

    def ratio(self) -> tuple[float, float]:
        """Return the resistance relative to the model's, and its standard deviation."""
        prior = 1.0 / RESISTANCE_STD**2
        found = []
        for xx, xy, yy, count in self.state.sums:
            if count < DETAILS_AT_LEAST or xx <= 0.0:
                continue
            slope = xy / xx
            noise = max(yy - slope * xy, 0.0) / (count - 1.0)
            if noise > 0.0:
                found.append((slope, xx / noise))
        weight = total(each for _, each in found)
        change = total(slope * each for slope, each in found) / (weight + prior)
        spread = total(each * (slope - change) ** 2 for slope, each in found) / (weight + prior)
        return 1.0 + change, math.sqrt(1.0 / (weight + prior) + spread)

    def snapshot(self) -> ResistanceState:
        """Return a copy of the state."""
        state = self.state
        return ResistanceState(
            list(state.block), [list(each) for each in state.waiting],
            [list(each) for each in state.sums],
        )  # fmt: skip

    def restore(self, state: ResistanceState) -> None:
        """Continue from a state."""
        self.state = state
        self.state = self.snapshot()


def _between_nodes(soc_pct: float) -> tuple[int, tuple[float, float], float]:
    """Return the node below, both nodes' weights, and the variance that they leave open.

    The best linear prediction of a first-order Gauss–Markov process of unit variance over SoC.
    """
    place = soc_pct / NODE_PCT
    below = min(int(place), NODES - 2)
    step = math.exp(-NODE_PCT / CURVE_SPAN_PCT)
    one = math.exp(-(place - below) * NODE_PCT / CURVE_SPAN_PCT)
    other = step / one
    scale = 1.0 / (1.0 - step * step)
    weights = scale * (one - step * other), scale * (other - step * one)
    return below, weights, max(1.0 - weights[0] * one - weights[1] * other, 0.0)


def _is_semidefinite(covariance: FloatArray) -> bool:
    variance = np.diag(covariance)
    if not np.isfinite(covariance).all() or (variance < 0.0).any():
        return False
    scale = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    smallest = np.linalg.eigvalsh(covariance / np.outer(scale, scale))[0]
    return bool(smallest > -1e-6)

"""Voltage model: a curve over SoC, temperature, and resistances on the history of the current.

    U = g(S) + kt·(T − T_r) + Σm Rm·Im + b·(a(T)/a(T̄) − 1)·Σm R⁰m·Im

g is the pseudo-OCV. Im are the current at several delays, followed by the current low-passed with
several time constants. Positive current discharges, so the resistances Rm are negative. The last
term, of factor b, scales the resistances R⁰ by Arrhenius' law a(T); without it R is constant. All
terms beside g are linear, U = g(S) + L·θ: a *load row* L, which holds T − T_r, the currents and
Arrhenius' change, times the *load coefficients* θ = (kt, R1 … RM, b).

Two curves have the same interface. `HermiteCurve` interpolates values at knots. `PublishedCurve`
is the published equation,

    g = k0 + k1/s + k2/s² + k3/s³ + k4/s⁴ + k5·s + k6·ln s + k7·ln(1 − s),   s = S/100·(1 − 2ε) + ε.

Both are straight lines beyond the SoC that they are defined on, and rise with SoC.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import model_validator

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.gaps import BRIDGE_S
from cangauge.model.delay_line import delayed_currents
from cangauge.model.fields import (
    Ampere,
    Celsius,
    Delays,
    Fields,
    Knots,
    Seconds,
    Soc,
    Value,
    Volts,
    check_shape,
)
from cangauge.model.first_order import low_passed

KNOTS_PCT: FloatArray = np.array(
    [0, 1, 2.5, 5, 7.5, 10, 12.5, *range(15, 91, 5), 92.5, 95, 97.5, 99, 100], dtype=np.float64
)
"""Knots of a fitted curve [% SoC]: every 5 %, closer where the curves of all chemistries bend."""

DELAYS_S = (0.0, 10.0, 30.0, 70.0)
"""The published delays of the current [s]."""

BASIS_NAMES = ("k0", "k1", "k2", "k3", "k4", "k5", "k6", "k7")
"""Coefficients of the published pseudo-OCV, in the order of the columns of `ocv_basis`."""

ACTIVATION_K = 3000.0
"""Activation temperature of the resistance [K]: 25 kJ/mol, that of charge transfer and electrolyte
in lithium cells; Waldmann et al., J. Power Sources 262 (2014) 129."""

REFERENCE_C = 20.0
"""Reference temperature of the curve, at which a(T) = 1 too [°C]."""

PLAUSIBLE_C = (-60.0, 120.0)
"""Pack temperatures beyond which every law of temperature is constant [°C]."""

SLOPE_AT_LEAST = 2e-5
"""Lower limit of the curve's slope per % SoC, relative to the pack voltage: it must rise for a
unique inverse, yet allow a flat (LFP) plateau. 7 mV per % for a Leaf, 1/50 of its flattest
slope."""

EDGE = 0.25
"""Fraction of the identified SoC range at each end whose mean slope extrapolates the published
curve: at the very edge the fitted slope is mostly noise."""

STEEPEST_SECANT, FLATTEST_SECANT = 2.0, 0.1
"""Limits of a knot's slope relative to the flatter secant beside it, where the curve would fall
otherwise. Below 3 a cubic Hermite curve rises: Fritsch, Carlson, SIAM J. Numer. Anal. 17 (1980)
238."""


def inverse_k(temperature_c: ArrayLike) -> FloatArray:
    """Return 1/T [1/K], constant beyond `PLAUSIBLE_C`."""
    celsius = np.clip(np.asarray(temperature_c, dtype=np.float64), *PLAUSIBLE_C)
    return np.asarray(1.0 / (celsius + 273.15))


def resistance_factor(temperature_c: ArrayLike) -> FloatArray:
    """Return a(T), the resistance relative to that at 20 °C by Arrhenius' law."""
    colder = inverse_k(temperature_c) - inverse_k(REFERENCE_C)
    return np.asarray(np.exp(ACTIVATION_K * colder))


def hermite_slopes(soc_pct: FloatArray, values: FloatArray) -> FloatArray:
    """Return the slopes at knots, by three points, of values of shape (knots,) or (knots, n)."""
    return np.asarray(np.gradient(values, soc_pct, axis=0))


class _Cubic(NamedTuple):
    """Hermite's cubic between two knots: weights of value and slope at the left, then the right.

    Of one SoC or of many: members are numbers, or arrays of shape (n,).
    """

    left: Any
    """Index of the left knot."""
    value: tuple[Any, Any, Any, Any]
    """h00, h10, h01, h11: give the curve."""
    slope: tuple[Any, Any, Any, Any]
    """Their derivatives: give its slope."""

    def sum(self, weights: tuple[Any, Any, Any, Any], value: Any, slope: Any) -> Any:
        """Return the weighted sum of values and slopes at the knots."""
        h00, h10, h01, h11 = weights
        at_left = h00 * value[self.left] + h10 * slope[self.left]
        return at_left + h01 * value[self.left + 1] + h11 * slope[self.left + 1]


def _cubic(left: Any, h: Any, t: Any, below: Any = 0.0, above: Any = 0.0) -> _Cubic:
    """Return the cubic at a fraction t of an interval h, or beyond the first and last knot [%]."""
    back = 1.0 - t
    h00, h10 = (1.0 + 2.0 * t) * back * back, h * t * back * back
    h01, h11 = t * t * (3.0 - 2.0 * t), h * t * t * back
    by_h = 6.0 * t * back / h
    return _Cubic(
        left,
        (h00, h10 + below, h01, above - h11),
        (-by_h, back * (1.0 - 3.0 * t), by_h, t * (3.0 * t - 2.0)),
    )


def _cubics(knots: FloatArray, soc_pct: FloatArray) -> _Cubic:
    left = np.clip(np.searchsorted(knots, soc_pct, side="right") - 1, 0, knots.size - 2)
    inside = np.clip(soc_pct, knots[0], knots[-1])
    h, beyond = knots[left + 1] - knots[left], soc_pct - inside
    t = (inside - knots[left]) / h
    return _cubic(left, h, t, np.minimum(beyond, 0.0), np.maximum(beyond, 0.0))


def _cubic_at(knots: Sequence[float], soc_pct: float) -> _Cubic:
    """Return `_cubics` of one SoC, without arrays: the estimator needs it at each step."""
    inside = min(max(soc_pct, knots[0]), knots[-1])
    left = min(bisect_right(knots, inside) - 1, len(knots) - 2)
    h, beyond = knots[left + 1] - knots[left], soc_pct - inside
    return _cubic(left, h, (inside - knots[left]) / h, min(beyond, 0.0), max(beyond, 0.0))


def hermite_basis(soc_pct: FloatArray, knots_pct: FloatArray = KNOTS_PCT) -> FloatArray:
    """Return the derivatives of the curve by its values at the knots [-], shape (n, knots).

    `soc_pct` is the SoC [%] of shape (n,).
    """
    bend = hermite_slopes(knots_pct, np.eye(knots_pct.size))
    left, (h00, h10, h01, h11), _ = _cubics(knots_pct, soc_pct)
    basis = h10[:, None] * bend[left] + h11[:, None] * bend[left + 1]
    row = np.arange(left.size)
    basis[row, left] += h00
    basis[row, left + 1] += h01
    return np.asarray(basis)


@dataclass(frozen=True, eq=False)
class HermiteCurve:
    """Cubic Hermite curve through values at knots; a straight line beyond them.

    Parameters
    ----------
    soc_pct, value, slope : array of shape (n,)
        Increasing knots [%], voltages [V] and slopes [V per %] there.
    """

    soc_pct: FloatArray
    value: FloatArray
    slope: FloatArray

    @classmethod
    def rising(cls, soc_pct: FloatArray, value: FloatArray) -> HermiteCurve:
        """Return the curve through values at knots, changed only where it would not rise."""
        at_half_v = float(np.interp(50.0, soc_pct, value))
        least = SLOPE_AT_LEAST * abs(at_half_v)
        value = np.maximum.accumulate(value - least * soc_pct) + least * soc_pct
        slope = hermite_slopes(soc_pct, value)
        secant = np.diff(value) / np.diff(soc_pct)
        flatter = np.minimum(np.r_[secant[0], secant], np.r_[secant, secant[-1]])
        limited = np.clip(slope, FLATTEST_SECANT * flatter, STEEPEST_SECANT * flatter)
        inner = _cubic(np.arange(secant.size), np.diff(soc_pct), np.array([0.0, 0.5, 1.0])[:, None])
        for _ in soc_pct:  # a changed slope can make the next interval fall
            # The slope between knots is a parabola in t: d0 + b t + a t², lowest at −b / 2a.
            d0, d_half, d1 = inner.sum(inner.slope, value, slope)
            a, b = 2.0 * (d0 - 2.0 * d_half + d1), 4.0 * d_half - 3.0 * d0 - d1
            t = np.clip(np.divide(-b, 2.0 * a, out=np.zeros_like(a), where=a > 0.0), 0.0, 1.0)
            falls = np.minimum(np.minimum(d0, d1), d0 + (b + a * t) * t) <= 0.0
            if not falls.any():
                break
            slope = np.where(np.r_[falls, False] | np.r_[False, falls], limited, slope)
        return cls(soc_pct, value, slope)

    @cached_property
    def _lists(self) -> tuple[list[float], list[float], list[float]]:
        return self.soc_pct.tolist(), self.value.tolist(), self.slope.tolist()

    def at(self, soc_pct: float) -> tuple[float, float]:
        """Return voltage [V] and slope [V per %] at one SoC [%]."""
        knots, value, slope = self._lists
        cubic = _cubic_at(knots, soc_pct)
        return cubic.sum(cubic.value, value, slope), cubic.sum(cubic.slope, value, slope)

    def values(self, soc_pct: FloatArray) -> FloatArray:
        """Return voltages [V] at SoC [%] of shape (n,)."""
        cubics = _cubics(self.soc_pct, soc_pct)
        return np.asarray(cubics.sum(cubics.value, self.value, self.slope))

    def slopes(self, soc_pct: FloatArray) -> FloatArray:
        """Return slopes [V per %] at SoC [%] of shape (n,)."""
        cubics = _cubics(self.soc_pct, soc_pct)
        return np.asarray(cubics.sum(cubics.slope, self.value, self.slope))


class Functions(Fields):
    """Principal components of the covariance of the curve's and the load's coefficients together.

    A function is the part of a component in the voltage, at an amplitude of one standard deviation.
    """

    soc_pct: Knots
    curve_v: list[list[Value]]
    """Part of each function in the curve at `soc_pct` [V]."""
    load: list[list[Value]]
    """Part of each function in the coefficients of the load columns."""

    @property
    def number(self) -> int:
        """Number n of functions."""
        return len(self.curve_v)

    @cached_property
    def value(self) -> FloatArray:
        """Parts in the curve [V], shape (knots, n)."""
        return np.reshape(self.curve_v, (self.number, len(self.soc_pct))).T

    @cached_property
    def slope(self) -> FloatArray:
        """Slopes of the parts in the curve [V per %], shape (knots, n)."""
        return hermite_slopes(np.array(self.soc_pct), self.value)

    @cached_property
    def _load(self) -> FloatArray:
        return np.array(self.load)

    def load_parts(self, columns: int) -> FloatArray:
        """Return the parts in the coefficients of k load columns, shape (k, n)."""
        return self._load.reshape(self.number, columns).T

    def row(self, soc_pct: float, load: FloatArray) -> FloatArray:
        """Return the change of voltage by each function [V], shape (n,).

        Parameters
        ----------
        soc_pct : float
        load : array of shape (k,)
            A row of `VoltageModel.load_columns`.
        """
        cubic = _cubic_at(self.soc_pct, soc_pct)
        return np.asarray(
            cubic.sum(cubic.value, self.value, self.slope) + load @ self.load_parts(load.size)
        )


def _scaled_soc(soc_pct: ArrayLike, epsilon: float) -> FloatArray:
    """Return s, the SoC scaled into [ε, 1 − ε] so that ln s and ln(1 − s) are finite."""
    return np.asarray(soc_pct, dtype=np.float64) / 100.0 * (1.0 - 2.0 * epsilon) + epsilon


def ocv_basis(soc_pct: ArrayLike, epsilon: float) -> FloatArray:
    """Return the published pseudo-OCV's columns, shape (n, 8), for SoC [%] of shape (n,)."""
    s = _scaled_soc(soc_pct, epsilon)
    r = 1.0 / s
    return np.column_stack([np.ones_like(s), r, r**2, r**3, r**4, s, np.log(s), np.log1p(-s)])


@dataclass(frozen=True, eq=False)
class PublishedCurve:
    """The published pseudo-OCV; a straight line beyond the identified SoC.

    Parameters
    ----------
    ocv_v : sequence of 8 floats
        k0 … k7 [V].
    epsilon : float
        Margin ε of the scaled SoC, in (0, 0.5).
    soc_range_pct : pair of floats
        Identified SoC [%]: outside, the powers of 1/s diverge.

    Raises
    ------
    InputError
        If the range is impossible, or the curve does not rise over it.
    """

    ocv_v: tuple[float, ...]
    epsilon: float = 0.05
    soc_range_pct: tuple[float, float] = (0.0, 100.0)

    def __post_init__(self) -> None:
        low, high = self.soc_range_pct
        if not high - low >= 0.01:  # below, slopes are quotients of rounding errors
            raise InputError("the range is empty", field="soc_range_pct", value=(low, high))
        ends = _scaled_soc([low, high], self.epsilon)
        if not np.all((ends > 0.0) & (ends < 1.0)):
            raise InputError(
                "the logarithms of the pseudo-OCV diverge within this range",
                field="soc_range_pct",
                value=(low, high),
                cure="identify the model with a larger epsilon",
            )
        points = np.linspace(low, high, 401)
        slope = self.slopes(points)
        if not np.all(slope > 0.0):
            worst = int(np.argmin(slope))
            raise InputError(
                f"the pseudo-OCV falls with SoC at {points[worst]:.1f} %, so it has no inverse",
                field="coefficients",
                value=float(slope[worst]),
                cure="fit with --equation knots, whose curve rises",
            )

    @cached_property
    def beyond(self) -> tuple[float, float]:
        """Slopes of the straight lines below and above the identified SoC [V per %]."""
        low, high = self.soc_range_pct
        part = EDGE * (high - low)
        volts = ocv_basis([low, low + part, high - part, high], self.epsilon) @ self.ocv_v
        return float(volts[1] - volts[0]) / part, float(volts[3] - volts[2]) / part

    def at(self, soc_pct: float) -> tuple[float, float]:
        """Return voltage [V] and slope [V per %] at one SoC [%]."""
        lo, hi = self.soc_range_pct
        at = min(max(soc_pct, lo), hi)
        k0, k1, k2, k3, k4, k5, k6, k7 = self.ocv_v
        gain = (1.0 - 2.0 * self.epsilon) / 100.0
        s = at * gain + self.epsilon
        r = 1.0 / s
        volts = k0 + r * (k1 + r * (k2 + r * (k3 + r * k4))) + k5 * s
        volts += k6 * math.log(s) + k7 * math.log1p(-s)
        if soc_pct == at:
            by_s = k5 + k6 * r - k7 / (1.0 - s)
            by_s -= r * r * (k1 + r * (2.0 * k2 + r * (3.0 * k3 + r * 4.0 * k4)))
            return volts, by_s * gain
        slope = self.beyond[0] if soc_pct < at else self.beyond[1]
        return volts + slope * (soc_pct - at), slope

    def values(self, soc_pct: FloatArray) -> FloatArray:
        """Return voltages [V] at SoC [%] of shape (n,)."""
        inside = np.clip(soc_pct, *self.soc_range_pct)
        low, high = self.beyond
        straight = np.where(soc_pct < inside, low, high) * (soc_pct - inside)
        return np.asarray(ocv_basis(inside, self.epsilon) @ self.ocv_v + straight)

    def slopes(self, soc_pct: FloatArray) -> FloatArray:
        """Return slopes [V per %] at SoC [%] of shape (n,)."""
        lo, hi = self.soc_range_pct
        s = _scaled_soc(np.clip(soc_pct, lo, hi), self.epsilon)
        r = 1.0 / s
        powers = [-order * r ** (order + 1) for order in (1, 2, 3, 4)]
        zero, one = np.zeros_like(s), np.ones_like(s)
        by_s = np.column_stack([zero, *powers, one, r, -1.0 / (1.0 - s)])
        inside = by_s * ((1.0 - 2.0 * self.epsilon) / 100.0) @ self.ocv_v
        low, high = self.beyond
        return np.asarray(np.where(soc_pct < lo, low, np.where(soc_pct > hi, high, inside)))


Curve = HermiteCurve | PublishedCurve
"""A pseudo-OCV that rises with SoC: `at` one SoC, `values` and `slopes` at many."""


def past_currents(
    time_s: FloatArray,
    current_a: FloatArray,
    rows: NDArray[np.intp] | slice,
    delay_s: Sequence[float],
    low_pass_s: Sequence[float],
) -> FloatArray:
    """Return the delayed, then the low-passed currents of a log at some rows [A], shape (m, M).

    Parameters
    ----------
    time_s, current_a : array of shape (n,)
        The whole log. Before it, delayed currents hold the first sample, and low-passed ones start
        from rest.
    rows : array of int or slice
    delay_s, low_pass_s : sequence of float
        Delays and time constants [s].
    """
    delayed = delayed_currents(time_s, current_a, delay_s, time_s[rows])
    smooth = [low_passed(time_s, current_a, tau, 0.0, rest_s=BRIDGE_S)[rows] for tau in low_pass_s]
    return np.column_stack([delayed, *smooth])


class Arrhenius(Fields):
    """Change of the resistances with temperature."""

    factor: Value
    """b [-]; 1 where all of the resistance follows a(T)."""
    resistance_ohm: tuple[Value, ...]
    """R⁰ of each current [Ω]; negative."""
    mean_c: Celsius
    """Temperature T̄ at which the resistances hold [°C]."""

    @cached_property
    def warm(self) -> float:
        """Factor a(T̄)."""
        return float(resistance_factor(self.mean_c))


class Loads(Fields):
    """Temperature coefficient and resistances of a voltage model, as its file states them."""

    t_ref_c: Celsius
    """Reference temperature T_r [°C]."""
    kt_v_per_k: Value
    """Temperature coefficient [V/K]."""
    delays_s: Delays
    """Delays of the current [s]."""
    low_pass_s: tuple[Seconds, ...]
    """Time constants of the low-passed currents [s]."""
    resistance_ohm: tuple[Value, ...]
    """Rm on the current at each delay, then on each low-passed current [Ω]; negative."""
    arrhenius: Arrhenius | None
    """None for constant resistances."""

    @model_validator(mode="after")
    def _a_resistance_for_each_current(self) -> Self:
        M = len(self.delays_s) + len(self.low_pass_s)
        check_shape("loads.resistance_ohm", self.resistance_ohm, M)
        if self.arrhenius is not None:
            check_shape("loads.arrhenius.resistance_ohm", self.arrhenius.resistance_ohm, M)
        return self


class Ranges(Fields):
    """Identified ranges; an estimate outside is flagged."""

    soc_pct: tuple[Soc, Soc]
    temperature_c: tuple[Celsius, Celsius]
    current_a: tuple[Ampere, Ampere]
    voltage_v: tuple[Volts, Volts] | None = None
    """Lowest and highest voltage of the logs, under their currents."""

    @model_validator(mode="after")
    def _not_empty(self) -> Self:
        for name, span in self:
            if span is not None and span[1] < span[0]:
                raise InputError("the range is empty", field=f"range.{name}", value=span)
        return self


@dataclass(frozen=True, eq=False)
class VoltageModel:
    """Pack voltage as a function of SoC, temperature and the history of the current.

    Parameters
    ----------
    curve : Curve
        Pseudo-OCV at `loads.t_ref_c`.
    loads : Loads
    range : Ranges
        Of the logs.
    """

    curve: Curve
    loads: Loads
    range: Ranges

    @cached_property
    def nominal_v(self) -> float:
        """Pseudo-OCV at 50 % [V]."""
        return self.curve.at(50.0)[0]

    @property
    def usual_c(self) -> float:
        """Temperature assumed where none is known [°C]: the mean of the logs, or else T_r."""
        loads = self.loads
        return loads.t_ref_c if loads.arrhenius is None else loads.arrhenius.mean_c

    @cached_property
    def temperature_limits_c(self) -> tuple[float, float]:
        """Temperatures beyond which the load columns are constant [°C]."""
        if self.loads.arrhenius is not None:
            return PLAUSIBLE_C
        low, high = self.range.temperature_c  # the published term is extrapolated by 5 K
        return low - 5.0, high + 5.0

    @cached_property
    def load_coefficients(self) -> FloatArray:
        """Coefficients kt [V/K], R1 … RM [Ω] and, with `arrhenius`, b: shape (k,)."""
        loads = self.loads
        factor = () if loads.arrhenius is None else (loads.arrhenius.factor,)
        return np.array([loads.kt_v_per_k, *loads.resistance_ohm, *factor])

    def currents(
        self, time_s: FloatArray, current_a: FloatArray, rows: NDArray[np.intp] | slice
    ) -> FloatArray:
        """Return `past_currents` with the model's delays and time constants [A], shape (m, M)."""
        return past_currents(time_s, current_a, rows, self.loads.delays_s, self.loads.low_pass_s)

    def load_columns(self, temperature_c: ArrayLike, currents_a: FloatArray) -> FloatArray:
        """Return the columns of `load_coefficients`, shape (n, k).

        Parameters
        ----------
        temperature_c : array_like of shape (n,)
        currents_a : array of shape (n, M)
            As of `currents`.
        """
        bounded = np.clip(np.asarray(temperature_c, dtype=np.float64), *self.temperature_limits_c)
        columns = [np.atleast_1d(bounded)[:, None] - self.loads.t_ref_c, currents_a]
        if (arrhenius := self.loads.arrhenius) is not None:
            colder = resistance_factor(bounded) / arrhenius.warm - 1.0
            drop = currents_a @ np.array(arrhenius.resistance_ohm)
            columns.append((colder * drop)[:, None])
        return np.concatenate(columns, axis=1)

    def pseudo_ocv(self, soc_pct: ArrayLike, temperature_c: ArrayLike | None = None) -> FloatArray:
        """Return the voltage without current [V], shape (n,).

        Parameters
        ----------
        soc_pct : array_like of shape (n,)
            State of charge [%].
        temperature_c : array_like of shape (n,), optional
            Temperature [°C]; `loads.t_ref_c` if left out.
        """
        volts = self.curve.values(np.atleast_1d(np.asarray(soc_pct, dtype=np.float64)))
        if temperature_c is None:
            return volts
        bounded = np.clip(np.asarray(temperature_c, dtype=np.float64), *self.temperature_limits_c)
        return np.asarray(volts + self.loads.kt_v_per_k * (bounded - self.loads.t_ref_c))

    def pseudo_ocv_slope(self, soc_pct: ArrayLike) -> FloatArray:
        """Return dU/dS of the pseudo-OCV [V per % SoC], shape (n,)."""
        return self.curve.slopes(np.atleast_1d(np.asarray(soc_pct, dtype=np.float64)))

    def pseudo_ocv_at(self, soc_pct: float) -> tuple[float, float]:
        """Return pseudo-OCV at `loads.t_ref_c` [V] and its slope [V per %] at one SoC [%]."""
        return self.curve.at(soc_pct)

    def voltage(
        self, soc_pct: ArrayLike, temperature_c: ArrayLike, currents_a: ArrayLike
    ) -> FloatArray:
        """Return the voltage [V], shape (n,).

        Parameters
        ----------
        soc_pct, temperature_c : array_like of shape (n,)
            State of charge [%] and temperature [°C].
        currents_a : array_like of shape (n, M)
            Delayed and low-passed currents [A], positive = discharge; see `currents`.
        """
        columns = self.load_columns(temperature_c, np.asarray(currents_a, dtype=np.float64))
        return np.asarray(self.pseudo_ocv(soc_pct) + columns @ self.load_coefficients)

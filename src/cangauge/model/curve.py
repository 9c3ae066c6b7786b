"""Pseudo-OCV g(S): a curve over SoC that rises, and a straight line beyond its ends.

Two curves have the same interface. `HermiteCurve` interpolates values at knots. `PublishedCurve`
is the published equation,

    g = k0 + k1/s + k2/s² + k3/s³ + k4/s⁴ + k5·s + k6·ln s + k7·ln(1 − s),   s = S/100·(1 − 2ε) + ε.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from cangauge._typing import FloatArray
from cangauge.errors import InputError

KNOTS_PCT: FloatArray = np.array(
    [0, 1, 2.5, 5, 7.5, 10, 12.5, *range(15, 91, 5), 92.5, 95, 97.5, 99, 100], dtype=np.float64
)
"""Knots of a fitted curve [% SoC]: every 5 %, closer where the curves of all chemistries bend."""

BASIS_NAMES = ("k0", "k1", "k2", "k3", "k4", "k5", "k6", "k7")
"""Coefficients of the published pseudo-OCV, in the order of the columns of `ocv_basis`."""

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


def hermite_slopes(soc_pct: FloatArray, values: FloatArray) -> FloatArray:
    """Return the slopes at knots, by three points, of values of shape (knots,) or (knots, n)."""
    return np.asarray(np.gradient(values, soc_pct, axis=0))


class _Cubic(NamedTuple):
    """Hermite's cubic between two knots, at one SoC or at many.

    It is h00·value + h10·slope of the left knot, plus h01·value + h11·slope of the right one. The
    members are numbers, or arrays of shape (n,).
    """

    left: Any
    """Index of the left knot."""
    h: tuple[Any, Any, Any, Any]
    """h00, h10, h01, h11."""
    derivative: tuple[Any, Any, Any, Any]
    """Of these by the SoC [1/%]."""

    def values(self, value: Any, slope: Any) -> Any:
        """Return the curve, given values and slopes at the knots."""
        return self._sum(self.h, value, slope)

    def slopes(self, value: Any, slope: Any) -> Any:
        """Return the slope of the curve, given values and slopes at the knots."""
        return self._sum(self.derivative, value, slope)

    def _sum(self, weights: tuple[Any, Any, Any, Any], value: Any, slope: Any) -> Any:
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


def cubic_at(knots: Sequence[float], soc_pct: float) -> _Cubic:
    """Return `_cubics` of one SoC, without arrays: the estimator needs it at each step."""
    inside = min(max(soc_pct, knots[0]), knots[-1])
    left = min(bisect_right(knots, inside) - 1, len(knots) - 2)
    h, beyond = knots[left + 1] - knots[left], soc_pct - inside
    return _cubic(left, h, (inside - knots[left]) / h, min(beyond, 0.0), max(beyond, 0.0))


def hermite_basis(soc_pct: FloatArray, knots_pct: FloatArray = KNOTS_PCT) -> FloatArray:
    """Return the derivatives of the curve by its values at the knots [-], shape (n, knots).

    `soc_pct` is the SoC [%] of shape (n,).
    """
    slopes = hermite_slopes(knots_pct, np.eye(knots_pct.size))
    left, (h00, h10, h01, h11), _ = _cubics(knots_pct, soc_pct)
    basis = h10[:, None] * slopes[left] + h11[:, None] * slopes[left + 1]
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
        for _ in soc_pct:  # a changed slope can make the next interval fall
            falls = _lowest_slopes(soc_pct, value, slope) <= 0.0
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
        cubic = cubic_at(knots, soc_pct)
        return cubic.values(value, slope), cubic.slopes(value, slope)

    def values(self, soc_pct: FloatArray) -> FloatArray:
        """Return voltages [V] at SoC [%] of shape (n,)."""
        return np.asarray(_cubics(self.soc_pct, soc_pct).values(self.value, self.slope))

    def slopes(self, soc_pct: FloatArray) -> FloatArray:
        """Return slopes [V per %] at SoC [%] of shape (n,)."""
        return np.asarray(_cubics(self.soc_pct, soc_pct).slopes(self.value, self.slope))


def _lowest_slopes(soc_pct: FloatArray, value: FloatArray, slope: FloatArray) -> FloatArray:
    """Return the lowest slope between each two knots [V per %], shape (n − 1,).

    The slope is a parabola in the fraction t of the interval, d = d0 + b·t + a·t².
    """
    places = np.arange(soc_pct.size - 1)
    ends_and_middle = _cubic(places, np.diff(soc_pct), np.array([0.0, 0.5, 1.0])[:, None])
    d0, d_half, d1 = ends_and_middle.slopes(value, slope)
    a, b = 2.0 * (d0 - 2.0 * d_half + d1), 4.0 * d_half - 3.0 * d0 - d1
    t = np.clip(np.divide(-b, 2.0 * a, out=np.zeros_like(a), where=a > 0.0), 0.0, 1.0)
    return np.asarray(np.minimum(np.minimum(d0, d1), d0 + (b + a * t) * t))


def ocv_basis(soc_pct: ArrayLike, epsilon: float) -> FloatArray:
    """Return the published pseudo-OCV's columns, shape (n, 8), for SoC [%] of shape (n,).

    s is the SoC scaled into [ε, 1 − ε], so that ln s and ln(1 − s) are finite.
    """
    s = np.asarray(soc_pct, dtype=np.float64) / 100.0 * (1.0 - 2.0 * epsilon) + epsilon
    r = 1.0 / s
    return np.column_stack([np.ones_like(s), r, r**2, r**3, r**4, s, np.log(s), np.log1p(-s)])


def extended_basis(
    soc_pct: FloatArray, epsilon: float, soc_range_pct: tuple[float, float]
) -> FloatArray:
    """Return `ocv_basis`, continued in straight lines beyond the identified SoC, shape (n, 8)."""
    low, high = soc_range_pct
    part = EDGE * (high - low)
    ends = ocv_basis([low, low + part, high - part, high], epsilon)
    inside = np.clip(soc_pct, low, high)
    beyond = (soc_pct - inside)[:, None]
    slope = np.where(beyond < 0.0, ends[1] - ends[0], ends[3] - ends[2]) / part
    return np.asarray(ocv_basis(inside, epsilon) + beyond * slope)


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
        ends = [low * self._gain + self.epsilon, high * self._gain + self.epsilon]
        # Below 0.01 %, slopes are quotients of rounding errors.
        if not (high - low >= 0.01 and ends[0] > 0.0 and ends[1] < 1.0):
            raise InputError(
                "the range is empty, or the logarithms of the pseudo-OCV diverge within it",
                field="soc_range_pct",
                value=(low, high),
                cure="identify the model on more SoC, or with a larger epsilon",
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

    @property
    def _gain(self) -> float:
        """ds/dS [1/%]."""
        return (1.0 - 2.0 * self.epsilon) / 100.0

    @cached_property
    def beyond(self) -> tuple[float, float]:
        """Slopes of the straight lines below and above the identified SoC [V per %]."""
        low, high = self.soc_range_pct
        volts = self.values(np.array([low - 1.0, low, high, high + 1.0]))
        return float(volts[1] - volts[0]), float(volts[3] - volts[2])

    def _slope(self, s: Any) -> Any:
        """Return the slope at scaled SoC [V per %]: a number, or an array of shape (n,)."""
        _, k1, k2, k3, k4, k5, k6, k7 = self.ocv_v
        r = 1.0 / s
        by_s = k5 + k6 * r - k7 / (1.0 - s)
        by_s = by_s - r * r * (k1 + r * (2.0 * k2 + r * (3.0 * k3 + r * 4.0 * k4)))
        return by_s * self._gain

    def at(self, soc_pct: float) -> tuple[float, float]:
        """Return voltage [V] and slope [V per %] at one SoC [%]."""
        lo, hi = self.soc_range_pct
        at = min(max(soc_pct, lo), hi)
        k0, k1, k2, k3, k4, k5, k6, k7 = self.ocv_v
        s = at * self._gain + self.epsilon
        r = 1.0 / s
        volts = k0 + r * (k1 + r * (k2 + r * (k3 + r * k4))) + k5 * s
        volts += k6 * math.log(s) + k7 * math.log1p(-s)
        if soc_pct == at:
            return volts, self._slope(s)
        slope = self.beyond[0] if soc_pct < at else self.beyond[1]
        return volts + slope * (soc_pct - at), slope

    def values(self, soc_pct: FloatArray) -> FloatArray:
        """Return voltages [V] at SoC [%] of shape (n,)."""
        return np.asarray(extended_basis(soc_pct, self.epsilon, self.soc_range_pct) @ self.ocv_v)

    def slopes(self, soc_pct: FloatArray) -> FloatArray:
        """Return slopes [V per %] at SoC [%] of shape (n,)."""
        lo, hi = self.soc_range_pct
        inside = self._slope(np.clip(soc_pct, lo, hi) * self._gain + self.epsilon)
        low, high = self.beyond
        return np.asarray(np.where(soc_pct < lo, low, np.where(soc_pct > hi, high, inside)))


Curve = HermiteCurve | PublishedCurve
"""A pseudo-OCV that rises with SoC: `at` one SoC, `values` and `slopes` at many."""

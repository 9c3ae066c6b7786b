"""Voltage model: pseudo open-circuit voltage plus resistances on delayed currents.

    U = k0 + k1/s + k2/s² + k3/s³ + k4/s⁴ + k5·s + k6·ln s + k7·ln(1 − s)
        + kt·(T − T_r) + Σj Rj·I(t − dj),      s = (S/100)·(1 − 2ε) + ε

Published for a 2012 Nissan Leaf on a chassis dynamometer with delays of 0, 10, 30 and 70 s,
ε = 0.05 and T_r = 20 °C. Positive current discharges, so the resistances Rj are negative.

Outside the identified SoC the powers of 1/s diverge, so the pseudo-OCV is extrapolated linearly;
the temperature is limited to the identified range ± `TEMPERATURE_MARGIN_K`.

`soc_from_ocv` inverts the pseudo-OCV by Newton's method inside a bracket. It rises with SoC, so
there is one root; a step that leaves the bracket is replaced by bisection, so it cannot diverge.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from cangauge._typing import FloatArray
from cangauge.errors import InputError

BASIS_NAMES = ("k0", "k1", "k2", "k3", "k4", "k5", "k6", "k7")
"""Coefficients of the pseudo-OCV, in the order of the columns of `ocv_basis`."""

TEMPERATURE_MARGIN_K = 5.0
"""Extrapolation of the linear temperature term beyond the identified range [K]."""

SLOPE_AT_LEAST = 2e-5
"""Lower limit of the pseudo-OCV's slope per % SoC, relative to the pack voltage: it must rise for a
unique inverse, yet allow a flat (LFP) plateau. 7 mV per % for a Leaf, 1/50 of its flattest
slope."""

SLOPE_POINTS = 401
"""Points over the identified SoC at which the slope of the pseudo-OCV is checked."""

NARROWEST_SOC_PCT = 0.01
"""Least width of the identified SoC range [%]: below, slopes are quotients of rounding errors."""

EDGE = 0.25
"""Fraction of the identified SoC range at each end whose mean slope extrapolates the pseudo-OCV: at
the very edge the fitted slope is mostly noise."""


def _scaled_soc(soc_pct: ArrayLike, epsilon: float) -> FloatArray:
    """Return s, the SoC scaled into [ε, 1 − ε] so that ln s and ln(1 − s) are finite."""
    return np.asarray(soc_pct, dtype=np.float64) / 100.0 * (1.0 - 2.0 * epsilon) + epsilon


def ocv_basis(soc_pct: ArrayLike, epsilon: float) -> FloatArray:
    """Return the pseudo-OCV's columns, shape (n, 8), for SoC [%] of shape (n,)."""
    s = np.atleast_1d(_scaled_soc(soc_pct, epsilon))
    # Contiguous columns are several times as fast as contiguous rows.
    basis = np.empty((8, s.size))
    one, r, r2, r3, r4, linear, of_empty, of_full = basis
    one[:], linear[:] = 1.0, s
    np.divide(1.0, s, out=r)
    np.multiply(r, r, out=r2)
    np.multiply(r2, r, out=r3)
    np.multiply(r2, r2, out=r4)
    np.log(s, out=of_empty)
    np.log1p(-s, out=of_full)
    return basis.T


def ocv_basis_slope(soc_pct: ArrayLike, epsilon: float) -> FloatArray:
    """Return the derivative of `ocv_basis` by SoC [1/%], shape (n, 8)."""
    s = np.atleast_1d(_scaled_soc(soc_pct, epsilon))
    gain = (1.0 - 2.0 * epsilon) / 100.0
    slope = np.empty((8, s.size))
    constant, r, r2, r3, r4, linear, of_empty, of_full = slope
    constant[:], linear[:] = 0.0, gain
    np.divide(gain, s, out=of_empty)
    np.divide(-gain, 1.0 - s, out=of_full)
    power = 1.0 / s
    for order, column in enumerate((r, r2, r3, r4), start=1):
        power /= s
        np.multiply(-order * gain, power, out=column)
    return slope.T


@dataclass(frozen=True)
class VoltageModel:
    """Pack voltage as a function of SoC, temperature and the currents at several delays.

    Parameters
    ----------
    ocv_v : sequence of 8 floats
        k0 … k7 of the pseudo-OCV [V].
    kt_v_per_k : float
        Temperature coefficient [V/K].
    resistance_ohm : sequence of floats
        Rj on the current `delay_s[j]` ago [Ω]; negative, since positive current discharges.
    delay_s : sequence of floats
        Delays [s], increasing from 0.
    epsilon : float
        Margin ε of the scaled SoC [-], in (0, 0.5).
    t_ref_c : float
        Reference temperature T_r [°C].
    soc_range_pct, temperature_range_c, current_range_a : pairs of floats
        Identified ranges.

    Raises
    ------
    InputError
        If a value is not finite, a range is empty, or the pseudo-OCV does not rise with SoC over
        the identified range.
    """

    ocv_v: tuple[float, ...]
    kt_v_per_k: float
    resistance_ohm: tuple[float, ...]
    delay_s: tuple[float, ...] = (0.0, 10.0, 30.0, 70.0)
    epsilon: float = 0.05
    t_ref_c: float = 20.0
    soc_range_pct: tuple[float, float] = (0.0, 100.0)
    temperature_range_c: tuple[float, float] = (-40.0, 80.0)
    current_range_a: tuple[float, float] = (-math.inf, math.inf)

    def __post_init__(self) -> None:
        _check_shape(self)
        points = np.linspace(*self.soc_range_pct, SLOPE_POINTS)
        slope = self.pseudo_ocv_slope(points)
        if not np.all(slope > 0.0):
            worst = int(np.argmin(slope))
            at = float(points[worst])
            raise InputError(
                f"the pseudo-OCV falls with SoC at {at:.1f} %, so it has no inverse",
                field="coefficients",
                value=float(slope[worst]),
                cure="identify the model with `cangauge fit`, which keeps it rising",
            )

    def pseudo_ocv(self, soc_pct: ArrayLike, temperature_c: ArrayLike | None = None) -> FloatArray:
        """Return the voltage without current [V].

        Parameters
        ----------
        soc_pct : array_like of shape (n,)
            State of charge [%]; linear extrapolation outside the identified range.
        temperature_c : array_like of shape (n,), optional
            Temperature [°C]; `t_ref_c` if left out.
        """
        soc = np.atleast_1d(np.asarray(soc_pct, dtype=np.float64))
        inside = np.clip(soc, *self.soc_range_pct)
        volts = ocv_basis(inside, self.epsilon) @ np.array(self.ocv_v)
        low, high = self.slope_beyond
        volts = volts + np.where(soc < inside, low, high) * (soc - inside)
        if temperature_c is not None:
            lo, hi = self._temperature_limits_c
            bounded = np.clip(np.asarray(temperature_c, dtype=np.float64), lo, hi)
            volts = volts + self.kt_v_per_k * (bounded - self.t_ref_c)
        return np.asarray(volts)

    def pseudo_ocv_columns(self, soc_pct: ArrayLike) -> FloatArray:
        """Return dU/dk of the pseudo-OCV for k0 … k7 [-], shape (n, 8), extrapolation included.

        Parameters
        ----------
        soc_pct : array_like of shape (n,)
            State of charge [%].
        """
        soc = np.atleast_1d(np.asarray(soc_pct, dtype=np.float64))
        inside = np.clip(soc, *self.soc_range_pct)
        low, high = self._columns_beyond
        beyond = (soc - inside)[:, None]
        return ocv_basis(inside, self.epsilon) + beyond * np.where(beyond < 0.0, low, high)

    def pseudo_ocv_slope(self, soc_pct: ArrayLike) -> FloatArray:
        """Return dU/dS of the pseudo-OCV [V per % SoC], shape (n,)."""
        soc = np.atleast_1d(np.asarray(soc_pct, dtype=np.float64))
        lo, hi = self.soc_range_pct
        inside: FloatArray = ocv_basis_slope(np.clip(soc, lo, hi), self.epsilon) @ np.array(
            self.ocv_v
        )
        low, high = self.slope_beyond
        return np.asarray(np.where(soc < lo, low, np.where(soc > hi, high, inside)))

    def voltage(
        self, soc_pct: ArrayLike, temperature_c: ArrayLike, delayed_current_a: ArrayLike
    ) -> FloatArray:
        """Return the voltage [V].

        Parameters
        ----------
        soc_pct, temperature_c : array_like of shape (n,)
            State of charge [%] and temperature [°C].
        delayed_current_a : array_like of shape (n, number of delays)
            Current [A] at each delay, positive = discharge; see `delay_line.delayed_currents`.
        """
        drop = np.asarray(delayed_current_a, dtype=np.float64) @ np.array(self.resistance_ohm)
        return np.asarray(self.pseudo_ocv(soc_pct, temperature_c) + drop)

    def pseudo_ocv_at(self, soc_pct: float) -> tuple[float, float]:
        """Return pseudo-OCV at `t_ref_c` [V] and its slope [V per %] at one SoC [%].

        Scalar form for the estimator: 0.5 µs against 30 µs of the array form.
        """
        lo, hi = self.soc_range_pct
        at = min(max(soc_pct, lo), hi)
        k0, k1, k2, k3, k4, k5, k6, k7 = self.ocv_v
        gain = (1.0 - 2.0 * self.epsilon) / 100.0
        s = at * gain + self.epsilon
        r = 1.0 / s
        volts = (
            k0
            + r * (k1 + r * (k2 + r * (k3 + r * k4)))
            + k5 * s
            + k6 * math.log(s)
            + k7 * math.log1p(-s)
        )
        if soc_pct == at:
            by_s = k5 + k6 * r - k7 / (1.0 - s)
            by_s -= r * r * (k1 + r * (2.0 * k2 + r * (3.0 * k3 + r * 4.0 * k4)))
            return volts, by_s * gain
        slope = self.slope_beyond[0] if soc_pct < at else self.slope_beyond[1]
        return volts + slope * (soc_pct - at), slope

    def offset_at(self, temperature_c: float, delayed_current_a: Sequence[float]) -> float:
        """Return the SoC-independent part of the voltage of one sample [V]."""
        lo, hi = self._temperature_limits_c
        volts = self.kt_v_per_k * (min(max(temperature_c, lo), hi) - self.t_ref_c)
        for resistance, current in zip(self.resistance_ohm, delayed_current_a, strict=True):
            volts += resistance * current
        return volts

    @property
    def coefficients(self) -> FloatArray:
        """All coefficients, shape (9 + delays,): k0 … k7 [V], kt [V/K], R1 … Rn [Ω]."""
        return np.array([*self.ocv_v, self.kt_v_per_k, *self.resistance_ohm])

    def with_coefficients(self, coefficients: FloatArray) -> VoltageModel:
        """Return the model with other coefficients, in the order of `coefficients`.

        Raises
        ------
        InputError
            If the pseudo-OCV would not rise.
        """
        values = coefficients.tolist()
        n = len(BASIS_NAMES)
        return replace(
            self,
            ocv_v=tuple(values[:n]),
            kt_v_per_k=values[n],
            resistance_ohm=tuple(values[n + 1 :]),
        )

    @cached_property
    def slope_beyond(self) -> tuple[float, float]:
        """Slopes of the extrapolation below and above the identified SoC [V per %]."""
        low, high = self._columns_beyond
        volts = np.array(self.ocv_v)
        return float(low @ volts), float(high @ volts)

    @cached_property
    def _columns_beyond(self) -> tuple[FloatArray, FloatArray]:
        """Derivatives of those slopes by k0 … k7 [1/%], shape (8,) each."""
        lo, hi = self.soc_range_pct
        part = EDGE * (hi - lo)
        columns = ocv_basis([lo, lo + part, hi - part, hi], self.epsilon)
        return (columns[1] - columns[0]) / part, (columns[3] - columns[2]) / part

    @cached_property
    def _temperature_limits_c(self) -> tuple[float, float]:
        lo, hi = self.temperature_range_c
        return lo - TEMPERATURE_MARGIN_K, hi + TEMPERATURE_MARGIN_K


def _check_shape(model: VoltageModel) -> None:
    if len(model.ocv_v) != len(BASIS_NAMES):
        raise InputError(
            f"the pseudo-OCV has {len(BASIS_NAMES)} coefficients",
            field="coefficients",
            value=len(model.ocv_v),
        )
    if not 0.0 < model.epsilon < 0.5:
        raise InputError(
            "must lie between 0 and 0.5, or the logarithms diverge",
            field="epsilon",
            value=model.epsilon,
            cure="the published value is 0.05",
        )
    delays = np.array(model.delay_s)
    if len(model.resistance_ohm) != len(delays):
        raise InputError(
            f"{len(delays)} delays need as many resistances",
            field="resistance_ohm",
            value=len(model.resistance_ohm),
        )
    if delays.size == 0 or delays[0] < 0.0 or np.any(np.diff(delays) <= 0.0):
        raise InputError(
            "delays must increase from 0 or more",
            field="delays",
            value=list(model.delay_s),
            cure="give them as 0,10,30,70",
        )
    numbers = [*model.ocv_v, model.kt_v_per_k, *model.resistance_ohm, *model.delay_s, model.t_ref_c]
    if not all(math.isfinite(number) for number in numbers):
        raise InputError("a coefficient is not finite", field="coefficients", value=numbers)
    for name in ("soc_range_pct", "temperature_range_c", "current_range_a"):
        lo, hi = getattr(model, name)
        if name == "soc_range_pct" and not _defined(lo, hi, model.epsilon):
            raise InputError(
                "the logarithms of the pseudo-OCV diverge within this range",
                field=name,
                value=(lo, hi),
                cure="identify the model with a larger epsilon",
            )
        least = NARROWEST_SOC_PCT if name == "soc_range_pct" else 0.0
        if not hi - lo >= least:
            raise InputError("the range is empty", field=name, value=(lo, hi))


def _defined(low_pct: float, high_pct: float, epsilon: float) -> bool:
    """Return whether ln s and ln(1 − s) exist from one SoC to another."""
    ends = _scaled_soc([low_pct, high_pct], epsilon)
    return bool(np.all((ends > 0.0) & (ends < 1.0)))


TOLERANCE_PCT = 1e-9
"""Step size at which the iteration stops [% SoC]."""

STEPS_AT_MOST = 80
"""Bisection alone needs 37 steps from 100 % to the tolerance."""


class Curve(Protocol):
    """An invertible pseudo-OCV: that of a voltage model or of an online extended model."""

    def pseudo_ocv_at(self, soc_pct: float) -> tuple[float, float]:
        """Return voltage [V] and its slope [V per %], positive, at one SoC [%]."""


class Inverse(NamedTuple):
    """A root of U(S) = U."""

    soc_pct: float
    """State of charge [%], within 0–100."""
    inside: bool
    """False if the voltage lies outside the model's range and the SoC was clipped."""


def soc_from_ocv(model: Curve, ocv_v: float, guess_pct: float = 50.0) -> Inverse:
    """Return the SoC at which the pseudo-OCV at reference temperature equals a voltage.

    Parameters
    ----------
    model : VoltageModel or OnlineExtendedModel
    ocv_v : float
        Voltage [V] less the parts that do not depend on SoC (`VoltageModel.offset_at`).
    guess_pct : float
        Start of the iteration [%]; the previous SoC saves steps.
    """
    low, high = 0.0, 100.0
    if ocv_v <= model.pseudo_ocv_at(low)[0]:
        return Inverse(low, inside=ocv_v == model.pseudo_ocv_at(low)[0])
    if ocv_v >= model.pseudo_ocv_at(high)[0]:
        return Inverse(high, inside=ocv_v == model.pseudo_ocv_at(high)[0])
    soc = min(max(guess_pct, low), high)
    for _ in range(STEPS_AT_MOST):
        volts, slope = model.pseudo_ocv_at(soc)
        error = volts - ocv_v
        if error > 0.0:
            high = soc
        else:
            low = soc
        following = soc - error / slope
        if not low < following < high:
            following = 0.5 * (low + high)
        if abs(following - soc) < TOLERANCE_PCT:
            return Inverse(following, inside=True)
        soc = following
    return Inverse(soc, inside=True)


INVERTED_AT_ONCE = 1 << 14
"""Voltages inverted together: bounds the memory of `socs_from_ocv`."""

INVERSE_POINTS = 4001
"""Points of the curve between which the first guess is interpolated: two steps follow, not four."""


def socs_from_ocv(model: VoltageModel, ocv_v: FloatArray) -> FloatArray:
    """Return `soc_from_ocv` of many voltages [%], shape (n,): the same root to `TOLERANCE_PCT`.

    Parameters
    ----------
    model : VoltageModel
    ocv_v : array of shape (n,)
        Voltages [V] less the parts that do not depend on SoC.
    """
    parts = range(0, ocv_v.size, INVERTED_AT_ONCE)
    found = [_roots(model, ocv_v[start : start + INVERTED_AT_ONCE]) for start in parts]
    return np.concatenate(found) if found else np.empty(0)


def _roots(model: VoltageModel, ocv_v: FloatArray) -> FloatArray:
    grid = np.linspace(0.0, 100.0, INVERSE_POINTS)
    curve_v = model.pseudo_ocv(grid)
    found = np.where(ocv_v <= curve_v[0], 0.0, np.where(ocv_v >= curve_v[-1], 100.0, np.nan))
    at = np.flatnonzero((ocv_v > curve_v[0]) & (ocv_v < curve_v[-1]))
    target = ocv_v[at]
    soc = np.interp(target, curve_v, grid)
    low, high = np.zeros_like(soc), np.full_like(soc, 100.0)
    for _ in range(STEPS_AT_MOST):
        error = model.pseudo_ocv(soc) - target
        high, low = np.where(error > 0.0, soc, high), np.where(error > 0.0, low, soc)
        following = soc - error / model.pseudo_ocv_slope(soc)
        is_bracketed = (low < following) & (following < high)
        following = np.where(is_bracketed, following, 0.5 * (low + high))
        moves = np.abs(following - soc) >= TOLERANCE_PCT
        found[at] = following
        if not moves.any():
            break
        at, target, soc = at[moves], target[moves], following[moves]
        low, high = low[moves], high[moves]
    return found

"""Voltage model: a curve over SoC, temperature, and resistances on the history of the current.

    U = g(S) + kt·(T − T_r) + Σm Rm·Im + b·(a(T)/a(T̄) − 1)·Σm R⁰m·Im

g is the pseudo-OCV. Im are the current at several delays, followed by the current low-passed with
several time constants. Positive current discharges, so the resistances Rm are negative. The last
term, of factor b, scales the resistances R⁰ by Arrhenius' law a(T); without it R is constant. All
terms beside g are linear, U = g(S) + L·θ: a *load row* L, which holds T − T_r, the currents and
Arrhenius' change, times the *load coefficients* θ = (kt, R1 … RM, b).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import model_validator

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.gaps import BRIDGE_S
from cangauge.model.curve import Curve, cubic_at, hermite_slopes
from cangauge.model.delay_line import delayed_currents
from cangauge.model.fields import (
    CURE,
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

DELAYS_S = (0.0, 10.0, 30.0, 70.0)
"""The published delays of the current [s]."""

ACTIVATION_K = 3000.0
"""Activation temperature of the resistance [K]: 25 kJ/mol, that of charge transfer and electrolyte
in lithium cells; Waldmann et al., J. Power Sources 262 (2014) 129."""

REFERENCE_C = 20.0
"""Reference temperature of the curve, at which a(T) = 1 too [°C]."""

PLAUSIBLE_C = (-60.0, 120.0)
"""Pack temperatures beyond which every law of temperature is constant [°C]."""


def inverse_k(temperature_c: ArrayLike) -> FloatArray:
    """Return 1/T [1/K], constant beyond `PLAUSIBLE_C`."""
    celsius = np.clip(np.asarray(temperature_c, dtype=np.float64), *PLAUSIBLE_C)
    return np.asarray(1.0 / (celsius + 273.15))


def resistance_factor(temperature_c: ArrayLike) -> FloatArray:
    """Return a(T), the resistance relative to that at 20 °C by Arrhenius' law."""
    colder_per_k = inverse_k(temperature_c) - inverse_k(REFERENCE_C)
    return np.asarray(np.exp(ACTIVATION_K * colder_per_k))


class Functions(Fields):
    """Principal components of the uncertainty of curve and load coefficients together.

    Each is scaled so that its amplitude has a standard deviation of 1.
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
        cubic = cubic_at(self.soc_pct, soc_pct)
        return np.asarray(cubic.values(self.value, self.slope) + load @ self.load_parts(load.size))


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
                field = f"range.{name}"
                raise InputError("the range is empty", field=field, value=span, cure=CURE)
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
            change = resistance_factor(bounded) / arrhenius.warm - 1.0
            drop_v = currents_a @ np.array(arrhenius.resistance_ohm)
            columns.append((change * drop_v)[:, None])
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

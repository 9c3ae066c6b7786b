"""Power and energy: the current possible for 10 s within limits, and the energy left.

The voltage after h seconds of a constant current I from now on is that of the filter's measurement
equation, with the currents of the delay line for what lies before now, at S − 100·I·h/(3600 C). It
is solved for the current that meets a limit of the voltage; the smallest one within the horizon is
the possible one. Its standard deviation is that of the voltage, H P Hᵀ + R, over |dU/dI|. State and
covariance include what is learned of capacity and resistance.

The energy is that of a discharge at a third of the capacity per hour, as in the standard energy
test of traction cells (IEC 62660-1), to a SoC or to the lowest voltage, whichever comes first.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.estimation.ekf import FUNCTIONS, LEAST_SLOPE, LEVEL, SLOW, SocFilter
from cangauge.estimation.health import health_of
from cangauge.model.curve import HermiteCurve
from cangauge.model.extended import OnlineModel
from cangauge.settings import PackLimits
from cangauge.types import Health, Power

HORIZON_S: Final = 10.0
"""Time for which the current is possible [s]: that of the usual power test (IEC 62660-1)."""

STEPS: Final = 5
"""Moments within the horizon at which the voltage must lie within the limits: every 2 s, the delays
of the model being 10 s apart."""

ENERGY_C_RATE: Final = 1.0 / 3.0
"""Discharge for the energy [1/h] (IEC 62660-1)."""

UNKNOWN: Final = (math.nan, math.nan)


class PowerModel:
    """Predict the voltage of a constant current, and find the possible one.

    Parameters
    ----------
    model : OnlineModel
    limits : PackLimits
        Where none is stated, that of the model holds.

    Attributes
    ----------
    min_v, max_v, max_discharge_a, max_charge_a, cutoff_pct : float
        Limits [V, A, %].

    Raises
    ------
    InputError
        If a stated voltage contradicts the model's other end.
    """

    def __init__(self, model: OnlineModel, limits: PackLimits) -> None:
        known, self._model = model.model.range, model
        (low_pct, high_pct), (low_a, high_a) = known.soc_pct, known.current_a
        low_v, high_v = known.voltage_v or (math.inf, -math.inf)
        low_v = min(low_v, model.model.pseudo_ocv_at(low_pct)[0])
        high_v = max(high_v, model.model.pseudo_ocv_at(high_pct)[0])
        self.min_v = _or(limits.min_voltage_v, low_v)
        self.max_v = _or(limits.max_voltage_v, high_v)
        self.max_discharge_a = _or(limits.max_discharge_a, max(high_a, 0.0))
        self.max_charge_a = _or(limits.max_charge_a, max(-low_a, 0.0))
        self.cutoff_pct = _or(limits.cutoff_soc_pct, max(low_pct, 0.0))
        if self.min_v >= self.max_v:
            raise InputError(
                "the lowest voltage is not below the highest",
                field="limits",
                value=f"{self.min_v:.1f} … {self.max_v:.1f} V",
                cure="state both min_voltage_v and max_voltage_v",
            )

    def at(
        self, filter_: SocFilter, soc_pct: float, soc_std_pct: float, temperature_c: float
    ) -> Power:
        """Return the possible currents and the energy left.

        Parameters
        ----------
        filter_ : SocFilter
        soc_pct, soc_std_pct : float
            The estimate now [%].
        temperature_c : float
        """
        ahead = _Ahead(self._model, filter_, soc_pct, temperature_c)
        if 1.0 + ahead.resistance <= 0.0:  # learned of the wrong sign: not the pack's
            return Power()
        out, into = [], []
        for step in range(1, STEPS + 1):
            moment = ahead.moment(HORIZON_S * step / STEPS)
            out += ahead.possible(self.min_v, *moment)
            into += ahead.possible(self.max_v, *moment)
        discharge_a, discharge_std_a = min(out, default=UNKNOWN)
        charge_a, charge_std_a = max(into, default=UNKNOWN)
        return Power(
            *_within(discharge_a, discharge_std_a, self.max_discharge_a),
            *_within(-charge_a, charge_std_a, self.max_charge_a),
            *self._energy(ahead, soc_std_pct),
        )

    def _energy(self, ahead: _Ahead, soc_std_pct: float) -> tuple[float, float, float]:
        """Return the energy left, its standard deviation [Wh] and the SoC at which it ends [%]."""
        capacity_ah = ahead.health.capacity_ah
        to_pct = min(self.cutoff_pct, ahead.soc_pct)
        soc_pct = np.linspace(ahead.soc_pct, to_pct, 41)  # half a distance of two knots
        volts = ahead.lasting_v(soc_pct, ENERGY_C_RATE * capacity_ah)
        first_v, unknown_pct = float(volts[0]), 0.0
        if np.any(volts <= self.min_v):
            last = int(np.argmax(volts <= self.min_v))
            unknown_pct = ahead.std_v / ahead.slope_at(float(soc_pct[last]))
            around = slice(max(last - 1, 0), last + 1)
            to_pct = float(np.interp(self.min_v, volts[around][::-1], soc_pct[around][::-1]))
            soc_pct = np.append(soc_pct[:last], to_pct)
            volts = np.append(volts[:last], self.min_v)
        mean_v = 0.5 * (volts[1:] + volts[:-1])
        energy_wh = float(mean_v @ -np.diff(soc_pct)) / 100.0 * capacity_ah
        std_wh = math.hypot(
            first_v * math.hypot(soc_std_pct, unknown_pct) / 100.0 * capacity_ah,
            energy_wh * ahead.health.capacity_std_ah / capacity_ah,
        )
        return energy_wh, std_wh, to_pct


class _Ahead:
    """The filter's prediction from one moment on."""

    def __init__(
        self, model: OnlineModel, filter_: SocFilter, soc_pct: float, temperature_c: float
    ) -> None:
        self.soc_pct = soc_pct
        self.health: Health = health_of(filter_, temperature_c)
        x, self._P = filter_.joint()
        self.resistance = float(x[-1])
        self._model, self._temperature_c = model, temperature_c
        noise, self._A = model.noise, model.noise.cold(temperature_c)
        self._level_v = math.hypot(
            self._A * noise.level_std_v, noise.soc_std_pct * self.slope_at(soc_pct)
        )
        self.std_v = math.hypot(self._level_v, self._A * noise.slow_std_v)
        self._fixed_v = self._level_v * float(x[LEVEL]) + self._A * float(x[SLOW])
        functions, learned = model.functions, x[FUNCTIONS:-2]
        self._learned = HermiteCurve(
            np.array(functions.soc_pct), functions.value @ learned, functions.slope @ learned
        )
        theta = model.load_coefficients
        self._theta = (
            theta
            + self.resistance * np.r_[0.0, theta[1:]]
            + functions.load_parts(theta.size) @ learned
        )

    def slope_at(self, soc_pct: float) -> float:
        """Return the curve's slope [V per %], not less than the least."""
        return max(self._model.pseudo_ocv_at(soc_pct)[1], LEAST_SLOPE)

    def moment(self, seconds: float) -> tuple[float, FloatArray, FloatArray, float]:
        """Return the effect of a constant current from now on after a time [s].

        Returns
        -------
        float
            Charge that it takes [% per A].
        array of shape (k,)
            Load row without it.
        array of shape (k,)
            Change of the load row by it [1/A].
        float
            Drop of currents that were not observed [V].
        """
        model, line = self._model, self._model.delay_line
        loads, capacity_ah = model.model.loads, self.health.capacity_ah
        past, share, unknown_v = [], [], 0.0
        for delay_s, ohm in zip(loads.delays_s, loads.resistance_ohm, strict=False):
            is_ahead = delay_s <= seconds
            past.append(0.0 if is_ahead else line.current_at(delay_s - seconds))
            share.append(1.0 if is_ahead else 0.0)
            if delay_s - seconds > line.filled_s:
                unknown_v += abs(ohm) * ENERGY_C_RATE * capacity_ah
        for tau_s, lag in zip(loads.low_pass_s, model.lags, strict=True):
            keep = math.exp(-seconds / tau_s)
            past.append(keep * lag.value)
            share.append(1.0 - keep)
        base = model.load_at(self._temperature_c, past)
        ones = model.load_at(self._temperature_c, np.add(past, share))
        return seconds / (36.0 * capacity_ah), base, ones - base, unknown_v

    def possible(
        self,
        limit_v: float,
        pct_per_a: float,
        base: FloatArray,
        per_a: FloatArray,
        unknown_v: float,
    ) -> list[tuple[float, float]]:
        """Return the current that meets a voltage at a `moment`, and its standard deviation [A].

        Empty: the voltage rises with the current, so it is no limit.
        """
        model = self._model
        learned_v = self._learned.at(self.soc_pct)[0]
        fixed_v = self._fixed_v + learned_v + float(base @ self._theta) - limit_v
        ohm = float(per_a @ self._theta)
        current_a = volt_per_a = 0.0
        for _ in range(6):  # Newton's method
            volts, slope = model.pseudo_ocv_at(self.soc_pct - pct_per_a * current_a)
            volt_per_a = slope * pct_per_a - ohm
            step_a = (volts + fixed_v + ohm * current_a) / volt_per_a
            current_a += step_a
            if abs(step_a) < 1e-3:
                break
        if volt_per_a <= 0.0:
            return []
        load = base + current_a * per_a
        after_pct = self.soc_pct - pct_per_a * current_a
        slope = model.pseudo_ocv_at(after_pct)[1]
        drop_v = float(load[1:] @ model.load_coefficients[1:])
        functions = model.functions.row(after_pct, load)
        H = np.r_[slope, 0.0, self._A, self._level_v, functions, 0.0, drop_v]
        residual_v = self._A * model.noise.residual_std_v
        std_v = math.sqrt(H @ self._P @ H + residual_v**2 + unknown_v**2)
        return [(current_a, std_v / volt_per_a)]

    def lasting_v(self, soc_pct: FloatArray, current_a: float) -> FloatArray:
        """Return the voltages [V] of a lasting current at SoC [%] of shape (n,)."""
        lasting = np.full(len(self._model.model.loads.resistance_ohm), current_a)
        load_v = float(self._model.load_at(self._temperature_c, lasting) @ self._theta)
        curve_v = self._model.curve_values(soc_pct) + self._learned.values(soc_pct)
        return curve_v + (load_v + self._fixed_v)


def _within(current_a: float, std_a: float, most_a: float) -> tuple[float, float]:
    """Return current and std within 0 … `most_a`: of the 2σ band, what lies between them [A]."""

    def clip(value: float) -> float:
        return min(max(value, 0.0), most_a)

    return clip(current_a), 0.25 * (clip(current_a + 2.0 * std_a) - clip(current_a - 2.0 * std_a))


def _or(stated: float | None, default: float) -> float:
    return default if stated is None else stated

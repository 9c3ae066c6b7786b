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
from typing import Final, NamedTuple, Self

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.estimation.ekf import FUNCTIONS, LEAST_SLOPE, LEVEL, SLOW, SocFilter
from cangauge.estimation.health import health_of
from cangauge.model.extended import OnlineModel
from cangauge.model.voltage_model import HermiteCurve, VoltageModel
from cangauge.settings import PackLimits
from cangauge.types import Health, Power

HORIZON_S: Final = 10.0
"""Time for which the current is possible [s]."""

STEPS: Final = 5
"""Moments within the horizon at which the voltage must lie within the limits."""

ENERGY_C_RATE: Final = 1.0 / 3.0
"""Discharge for the energy [1/h] (IEC 62660-1)."""

ENERGY_STEPS: Final = 40
"""Steps of the discharge for the energy."""

_ITERATIONS: Final = 6
_CLOSE_A: Final = 1e-3


class KnownLimits(NamedTuple):
    """`PackLimits`, all known."""

    min_voltage_v: float
    max_voltage_v: float
    max_discharge_a: float
    max_charge_a: float
    cutoff_soc_pct: float

    @classmethod
    def of(cls, stated: PackLimits, model: VoltageModel) -> Self:
        """Return the stated limits, and those of the model where none are stated.

        Raises
        ------
        InputError
            If a stated voltage contradicts the model's other end.
        """
        ranges = model.range
        low_pct, high_pct = ranges.soc_pct
        low_a, high_a = ranges.current_a
        low_v, high_v = model.pseudo_ocv_at(low_pct)[0], model.pseudo_ocv_at(high_pct)[0]
        if ranges.voltage_v is not None:
            low_v = min(low_v, ranges.voltage_v[0])
            high_v = max(high_v, ranges.voltage_v[1])
        known = cls(
            _or(stated.min_voltage_v, low_v),
            _or(stated.max_voltage_v, high_v),
            _or(stated.max_discharge_a, max(high_a, 0.0)),
            _or(stated.max_charge_a, max(-low_a, 0.0)),
            _or(stated.cutoff_soc_pct, max(low_pct, 0.0)),
        )
        if known.min_voltage_v >= known.max_voltage_v:
            raise InputError(
                "the lowest voltage is not below the highest",
                field="limits",
                value=f"{known.min_voltage_v:.1f} … {known.max_voltage_v:.1f} V",
                cure="state both min_voltage_v and max_voltage_v",
            )
        return known


class PowerModel:
    """Predict the voltage of a constant current, and find the possible one.

    Parameters
    ----------
    model : OnlineModel
    limits : PackLimits
    """

    def __init__(self, model: OnlineModel, limits: PackLimits) -> None:
        self.limits = KnownLimits.of(limits, model.model)
        self._model = model

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
        limits = self.limits
        moments = [ahead.moment(HORIZON_S * step / STEPS) for step in range(1, STEPS + 1)]
        out = [ahead.possible(limits.min_voltage_v, moment) for moment in moments]
        into = [ahead.possible(limits.max_voltage_v, moment) for moment in moments]
        discharge = min(filter(None, out), default=None)
        charge = max(filter(None, into), default=None)
        return Power(
            *_within(*ahead.with_std(discharge), limits.max_discharge_a),
            *_within(*ahead.with_std(charge, sign=-1.0), limits.max_charge_a),
            *self._energy(ahead, soc_std_pct),
        )

    def _energy(self, ahead: _Ahead, soc_std_pct: float) -> tuple[float, float, float]:
        """Return the energy left, its standard deviation [Wh] and the SoC at which it ends [%]."""
        health, limits = ahead.health, self.limits
        end_pct = min(limits.cutoff_soc_pct, ahead.soc_pct)
        soc_pct = np.linspace(ahead.soc_pct, end_pct, ENERGY_STEPS + 1)
        step_pct = (ahead.soc_pct - end_pct) / ENERGY_STEPS
        volts = ahead.lasting_v(soc_pct, ENERGY_C_RATE * health.capacity_ah)
        low = np.flatnonzero(volts <= limits.min_voltage_v)
        last = int(low[0]) if low.size else ENERGY_STEPS
        # Part of each step above the lowest voltage: all of it, but for the last.
        part, drop_v = np.ones(last), volts[:last] - volts[1 : last + 1]
        unknown_pct, to_pct = 0.0, end_pct
        if low.size:
            unknown_pct = ahead.std_v / ahead.slope_at(float(soc_pct[last]))
            part[-1:] = (volts[last - 1] - limits.min_voltage_v) / drop_v[-1:]
            to_pct = ahead.soc_pct - float(part.sum()) * step_pct
        mean_v = volts[:last] - 0.5 * part * drop_v
        energy_wh = float(mean_v @ part) * step_pct / 100.0 * health.capacity_ah
        std_wh = math.hypot(
            float(volts[0]) * math.hypot(soc_std_pct, unknown_pct) / 100.0 * health.capacity_ah,
            energy_wh * health.capacity_std_ah / health.capacity_ah,
        )
        return energy_wh, std_wh, to_pct


class _Moment(NamedTuple):
    """What a constant current from now on does to the voltage after a time."""

    pct_per_a: float
    """Charge that it takes [% per A]."""
    base: FloatArray
    """Load row without it, shape (k,)."""
    per_a: FloatArray
    """Change of the load row by it [1/A], shape (k,)."""
    unknown_v: float
    """Drop of currents that were not observed [V]."""


class _Possible(NamedTuple):
    """A current that meets a limit of the voltage; ordered by the current."""

    current_a: float
    volt_per_a: float
    moment: _Moment


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
            functions.soc_pct, functions.value @ learned, functions.slope @ learned
        )
        theta = model.load_coefficients
        self._theta = theta + self.resistance * np.r_[0.0, theta[1:]] + functions.load @ learned

    def slope_at(self, soc_pct: float) -> float:
        """Return the curve's slope [V per %], not less than the least."""
        return max(self._model.pseudo_ocv_at(soc_pct)[1], LEAST_SLOPE)

    def moment(self, seconds: float) -> _Moment:
        """Return the effect of a current after a time [s]."""
        model = self._model
        loads, line = model.model.loads, model.delay_line
        past, share, unknown_v = [], [], 0.0
        for delay_s, ohm in zip(loads.delays_s, loads.resistance_ohm, strict=False):
            is_ahead = delay_s <= seconds
            past.append(0.0 if is_ahead else line.current_at(delay_s - seconds))
            share.append(1.0 if is_ahead else 0.0)
            if delay_s - seconds > line.filled_s:
                unknown_v += abs(ohm) * ENERGY_C_RATE * self.health.capacity_ah
        for tau_s, lag in zip(loads.low_pass_s, model.lags, strict=True):
            keep = math.exp(-seconds / tau_s)
            past.append(keep * lag.value)
            share.append(1.0 - keep)
        base = model.load_at(self._temperature_c, np.array(past))
        ones = model.load_at(self._temperature_c, np.array(past) + np.array(share))
        pct_per_a = seconds / (36.0 * self.health.capacity_ah)
        return _Moment(pct_per_a, base, ones - base, unknown_v)

    def possible(self, limit_v: float, moment: _Moment) -> _Possible | None:
        """Return the current that meets a voltage at a moment.

        None: the voltage rises with the current, so it is no limit.
        """
        learned_v = self._learned.at(self.soc_pct)[0]
        fixed_v = self._fixed_v + learned_v + float(moment.base @ self._theta) - limit_v
        ohm = float(moment.per_a @ self._theta)
        current_a = volt_per_a = 0.0
        for _ in range(_ITERATIONS):
            volts, slope = self._model.pseudo_ocv_at(self.soc_pct - moment.pct_per_a * current_a)
            volt_per_a = slope * moment.pct_per_a - ohm
            step_a = (volts + fixed_v + ohm * current_a) / volt_per_a
            current_a += step_a
            if abs(step_a) < _CLOSE_A:
                break
        return _Possible(current_a, volt_per_a, moment) if volt_per_a > 0.0 else None

    def with_std(self, found: _Possible | None, sign: float = 1.0) -> tuple[float, float]:
        """Return a possible current times a sign and its standard deviation [A]; NaN for None."""
        if found is None:
            return math.nan, math.nan
        current_a, volt_per_a, moment = found
        model = self._model
        load = moment.base + current_a * moment.per_a
        after_pct = self.soc_pct - moment.pct_per_a * current_a
        slope = model.pseudo_ocv_at(after_pct)[1]
        drop_v = float(load[1:] @ model.load_coefficients[1:])
        functions = model.functions.row(after_pct, load).tolist()
        H = np.array([slope, 0.0, self._A, self._level_v, *functions, 0.0, drop_v])
        residual_v = self._A * model.noise.residual_std_v
        std_v = math.sqrt(H @ self._P @ H + residual_v**2 + moment.unknown_v**2)
        return sign * current_a, std_v / volt_per_a

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

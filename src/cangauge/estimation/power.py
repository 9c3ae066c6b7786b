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
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.estimation.ekf import FUNCTIONS, LEAST_SLOPE, LEVEL, SLOW, SocFilter
from cangauge.estimation.health import health_of
from cangauge.model.extended import OnlineModel
from cangauge.model.voltage_model import VoltageModel
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


@dataclass(frozen=True)
class PackLimits:
    """Limits of voltage and current; None: from the range that the model was identified on.

    Parameters
    ----------
    min_voltage_v, max_voltage_v : float, optional
        Pack voltage [V]; by default the pseudo-OCV at the ends of the identified SoC, or what the
        logs reached under load: the answer does not contradict them.
    max_discharge_a, max_charge_a : float, optional
        Largest currents, both positive [A]; by default the ends of the identified current.
    cutoff_soc_pct : float, optional
        SoC at which the energy ends [%]; by default the lower end of the identified SoC.

    Raises
    ------
    InputError
        If a value is out of range, or the voltages contradict each other.
    """

    min_voltage_v: float | None = None
    max_voltage_v: float | None = None
    max_discharge_a: float | None = None
    max_charge_a: float | None = None
    cutoff_soc_pct: float | None = None

    def __post_init__(self) -> None:
        for name, high in (
            ("min_voltage_v", 1e4),
            ("max_voltage_v", 1e4),
            ("max_discharge_a", 1e4),
            ("max_charge_a", 1e4),
            ("cutoff_soc_pct", 100.0),
        ):
            value = getattr(self, name)
            if value is not None and not 0.0 <= value <= high:
                raise InputError(
                    f"must lie within 0 … {high:g}", field=f"limits.{name}", value=value
                )
        low, high_v = self.min_voltage_v, self.max_voltage_v
        if low is not None and high_v is not None and low >= high_v:
            raise InputError(
                "is not below limits.max_voltage_v", field="limits.min_voltage_v", value=low
            )

    def of_model(self, model: VoltageModel) -> KnownLimits:
        """Return the limits with those of the model where none are stated.

        Raises
        ------
        InputError
            If a stated voltage contradicts the model's other end.
        """
        low_pct, high_pct = model.soc_range_pct
        low_a, high_a = model.current_range_a
        low_v, high_v = model.pseudo_ocv_at(low_pct)[0], model.pseudo_ocv_at(high_pct)[0]
        if model.voltage_range_v is not None:
            low_v = min(low_v, model.voltage_range_v[0])
            high_v = max(high_v, model.voltage_range_v[1])
        known = KnownLimits(
            _or(self.min_voltage_v, low_v),
            _or(self.max_voltage_v, high_v),
            _or(self.max_discharge_a, max(high_a, 0.0)),
            _or(self.max_charge_a, max(-low_a, 0.0)),
            _or(self.cutoff_soc_pct, max(low_pct, 0.0)),
        )
        if known.min_voltage_v >= known.max_voltage_v:
            raise InputError(
                "the lowest voltage is not below the highest",
                field="limits",
                value=f"{known.min_voltage_v:.1f} … {known.max_voltage_v:.1f} V",
                cure="state both min_voltage_v and max_voltage_v",
            )
        return known


class KnownLimits(NamedTuple):
    """`PackLimits`, all known."""

    min_voltage_v: float
    max_voltage_v: float
    max_discharge_a: float
    max_charge_a: float
    cutoff_soc_pct: float


class PowerModel:
    """Predict the voltage of a constant current, and find the possible one.

    Parameters
    ----------
    model : OnlineModel
    limits : PackLimits
    """

    def __init__(self, model: OnlineModel, limits: PackLimits) -> None:
        self.limits = limits.of_model(model.model)
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
        moments = [HORIZON_S * step / STEPS for step in range(1, STEPS + 1)]
        out = [ahead.current_at(limits.min_voltage_v, each) for each in moments]
        into = [ahead.current_at(limits.max_voltage_v, each) for each in moments]
        discharge = min(filter(None, out), default=(math.nan, math.nan))
        charge = max(filter(None, into), default=(math.nan, math.nan))
        return Power(
            *_within(discharge[0], discharge[1], limits.max_discharge_a),
            *_within(-charge[0], charge[1], limits.max_charge_a),
            *self._energy(ahead, soc_std_pct),
        )

    def _energy(self, ahead: _Ahead, soc_std_pct: float) -> tuple[float, float]:
        """Return the energy left and its standard deviation [Wh]."""
        health, limits, soc_pct = ahead.health, self.limits, ahead.soc_pct
        lowest_v, end_pct, energy_wh = limits.min_voltage_v, 0.0, 0.0
        usual_a = ENERGY_C_RATE * health.capacity_ah
        step_pct = max(soc_pct - limits.cutoff_soc_pct, 0.0) / ENERGY_STEPS
        load_v = ahead.load_v(usual_a)
        first_v = volts = ahead.lasting_v(soc_pct, load_v)
        for _ in range(ENERGY_STEPS):
            if volts <= lowest_v:
                end_pct = ahead.std_v / max(self._model.curve(soc_pct)[1], LEAST_SLOPE)
                break
            soc_pct -= step_pct
            below_v = ahead.lasting_v(soc_pct, load_v)
            part = 1.0 if below_v >= lowest_v else (volts - lowest_v) / (volts - below_v)
            mean_v = volts - 0.5 * part * (volts - below_v)
            energy_wh += mean_v * part * step_pct / 100.0 * health.capacity_ah
            volts = below_v
        return energy_wh, math.hypot(
            first_v * math.hypot(soc_std_pct, end_pct) / 100.0 * health.capacity_ah,
            energy_wh * health.capacity_std_ah / health.capacity_ah,
        )


class _Ahead:
    """The filter's prediction from one moment on."""

    def __init__(
        self, model: OnlineModel, filter_: SocFilter, soc_pct: float, temperature_c: float
    ) -> None:
        self.soc_pct = soc_pct
        self.health: Health = health_of(filter_, temperature_c)
        x, self._P = filter_.joint()
        self._x, self.resistance = x[:-2], float(x[-1])
        self._model, self._temperature_c = model, temperature_c
        noise, self._A = model.noise, model.noise.cold(temperature_c)
        slope = max(model.curve(soc_pct)[1], LEAST_SLOPE)
        self._level_v = math.hypot(self._A * noise.level_std_v, noise.soc_std_pct * slope)
        self.std_v = math.hypot(self._level_v, self._A * noise.slow_std_v)
        self._fixed_v = self._level_v * float(self._x[LEVEL]) + self._A * float(self._x[SLOW])
        self._no_load = np.zeros_like(model.load_coefficients)
        self._learned_now_v = self._learned_v(soc_pct)

    def current_at(self, limit_v: float, seconds: float) -> tuple[float, float] | None:
        """Return the current that meets a voltage after a time [s], and its deviation [A].

        None: the voltage rises with the current, so it is no limit.
        """
        model = self._model
        base, per_a, unknown_v = self._loads(seconds)
        pct_per_a = seconds / (36.0 * self.health.capacity_ah)
        fixed_v = self._fixed_v + self._learned_now_v + self._volts(base) - limit_v
        ohm = self._volts(per_a)
        current_a, slope = 0.0, 0.0
        for _ in range(_ITERATIONS):
            volts, slope = model.curve(self.soc_pct - pct_per_a * current_a)
            step_a = (volts + fixed_v + ohm * current_a) / (slope * pct_per_a - ohm)
            current_a += step_a
            if abs(step_a) < _CLOSE_A:
                break
        volt_per_a = slope * pct_per_a - ohm
        if volt_per_a <= 0.0:
            return None
        load = base + current_a * per_a
        after_pct = self.soc_pct - pct_per_a * current_a
        drop_v = float(load[1:] @ model.load_coefficients[1:])
        functions = model.row(after_pct, load).tolist()
        H = np.array([slope, 0.0, self._A, self._level_v, *functions, 0.0, drop_v])
        variance = H @ self._P @ H + (self._A * model.noise.residual_std_v) ** 2 + unknown_v**2
        return current_a, math.sqrt(variance) / volt_per_a

    def load_v(self, current_a: float) -> float:
        """Return the voltage that a lasting current adds to the curve's [V]."""
        lasting = np.full(len(self._model.model.resistance_ohm), current_a)
        return self._volts(self._model.load_at(self._temperature_c, lasting))

    def lasting_v(self, soc_pct: float, load_v: float) -> float:
        """Return the voltage under a lasting load that adds `load_v` [V]."""
        return self._model.curve(soc_pct)[0] + self._learned_v(soc_pct) + load_v + self._fixed_v

    def _learned_v(self, soc_pct: float) -> float:
        """Return the learned change of the curve [V]."""
        return float(self._model.row(soc_pct, self._no_load) @ self._x[FUNCTIONS:])

    def _volts(self, load: FloatArray) -> float:
        """Return the voltage of a load row with what is learned of it [V]."""
        theta, x = self._model.load_coefficients, self._x[FUNCTIONS:]
        learned_v = float(self._model.row(self.soc_pct, load) @ x) - self._learned_now_v
        return float(load @ theta) + self.resistance * float(load[1:] @ theta[1:]) + learned_v

    def _loads(self, seconds: float) -> tuple[FloatArray, FloatArray, float]:
        """Return the load row after a time [s] without current, and its change by a current [1/A].

        The third is the drop of currents that were not observed [V].
        """
        model = self._model
        voltage, line = model.model, model.delay_line
        past, share, unknown_v = [], [], 0.0
        for delay_s, ohm in zip(voltage.delay_s, voltage.resistance_ohm, strict=False):
            is_ahead = delay_s <= seconds
            past.append(0.0 if is_ahead else line.current_at(delay_s - seconds))
            share.append(1.0 if is_ahead else 0.0)
            if delay_s - seconds > line.filled_s:
                unknown_v += abs(ohm) * ENERGY_C_RATE * self.health.capacity_ah
        for tau_s, lag in zip(voltage.low_pass_s, model.lags, strict=True):
            keep = math.exp(-seconds / tau_s)
            past.append(keep * lag.value)
            share.append(1.0 - keep)
        base = model.load_at(self._temperature_c, np.array(past))
        ones = model.load_at(self._temperature_c, np.array(past) + np.array(share))
        return base, ones - base, unknown_v


def _within(current_a: float, std_a: float, most_a: float) -> tuple[float, float]:
    """Return current and std within 0 … `most_a`: of the 2σ band, what lies between them [A]."""

    def clip(value: float) -> float:
        return min(max(value, 0.0), most_a)

    return clip(current_a), 0.25 * (clip(current_a + 2.0 * std_a) - clip(current_a - 2.0 * std_a))


def _or(stated: float | None, default: float) -> float:
    return default if stated is None else stated

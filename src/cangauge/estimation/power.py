"""Power and energy: the current possible for 10 s within limits, and the energy left.

The voltage after h seconds of a constant current I from now on is

    U(h) = OCV(S − a·I·h) + kt·(T − T_r) + ρ·(Σ Rj·I [dj ≤ h] + Σ Rj·I(t + h − dj) [dj > h]) + level

with the currents of the delay line for what lies before now, the learned resistance ratio ρ, and
the present level of the residual, so that an error of the model's level or of the SoC does not
count twice. The smallest current that meets a limit of the voltage within the horizon is the
possible one.

The standard deviation of the current is that of U at the limit over |dU/dI|: the error of the
resistance on the change of the drop, the voltage's fast error, the wander of its bias, and the
curvature of the OCV within the SoC's standard deviation. Effects with dynamics of their own are
held at their present voltage.

The energy is that of a discharge at a third of the capacity per hour, as in the standard energy
test of traction cells (IEC 62660-1), to a SoC or to the lowest voltage, whichever comes first.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

from cangauge.errors import InputError
from cangauge.estimation.health import Health
from cangauge.model.delay_line import DelayLine
from cangauge.model.model_file import ModelNoise
from cangauge.model.voltage_model import Curve, VoltageModel

HORIZON_S: Final = 10.0
"""Time for which the current is possible [s]."""

STEPS: Final = 10
"""Moments within the horizon at which the voltage must lie within the limits."""

LEVEL_MEMORY_S: Final = 30.0
"""Memory of the residual's level [s]: several of the fast error's time constants."""

ENERGY_C_RATE: Final = 1.0 / 3.0
"""Discharge for the energy [1/h] (IEC 62660-1)."""

ENERGY_STEPS: Final = 40
"""Steps of the discharge for the energy."""

_ITERATIONS: Final = 6
_CLOSE_A: Final = 1e-3
_NAN: Final = math.nan


@dataclass(frozen=True)
class PackLimits:
    """Limits of voltage and current; None: from the range that the model was identified on.

    Parameters
    ----------
    min_voltage_v, max_voltage_v : float, optional
        Pack voltage [V]; by default the pseudo-OCV at the ends of the identified SoC.
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
        known = KnownLimits(
            _or(self.min_voltage_v, model.pseudo_ocv_at(low_pct)[0]),
            _or(self.max_voltage_v, model.pseudo_ocv_at(high_pct)[0]),
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


class Power(NamedTuple):
    """Possible currents, both positive, and the energy left; NaN where not known."""

    discharge_a: float = _NAN
    """Discharge current possible for 10 s [A]."""
    discharge_std_a: float = _NAN
    charge_a: float = _NAN
    """Charge current possible for 10 s [A]."""
    charge_std_a: float = _NAN
    energy_wh: float = _NAN
    """Energy left to the cut-off [Wh]."""
    energy_std_wh: float = _NAN


class PackNow(NamedTuple):
    """What the estimator knows at a sample."""

    soc_pct: float
    soc_std_pct: float
    temperature_c: float
    """[°C]; NaN: not known."""
    residual_v: float
    """Level of measured minus predicted voltage [V]; NaN: no voltage lately."""
    drop_v: float
    """Level of the predicted drop, over the same time [V]."""
    health: Health


class PowerModel:
    """Predict the voltage of a constant current, and find the possible one.

    Parameters
    ----------
    curve : Curve
        Pseudo-OCV, effects included.
    model : VoltageModel
    noise : ModelNoise
    limits : KnownLimits
    """

    def __init__(
        self, curve: Curve, model: VoltageModel, noise: ModelNoise, limits: KnownLimits
    ) -> None:
        self.limits = limits
        self._curve = curve
        self._model = model
        self._fast_var = noise.fast_std_v**2
        wander = -math.expm1(-2.0 * (HORIZON_S + LEVEL_MEMORY_S) / noise.slow_time_s)
        self._wander_var = noise.slow_std_v**2 * wander
        self._bias_var = noise.slow_std_v**2 + noise.lasting_std_v**2

    def at(self, now: PackNow, line: DelayLine) -> Power:
        """Return the possible currents and the energy left.

        Parameters
        ----------
        now : PackNow
        line : DelayLine
            Currents up to now.
        """
        # A learned resistance of the wrong sign: those of the model are not the pack's.
        if math.isnan(now.soc_pct) or not line.filled_s > 0.0 or now.health.resistance_ratio <= 0.0:
            return Power()
        level = self._level(now)
        moments = self._moments(now, line)
        limits = self.limits
        out = self._possible(now, level, moments, limits.min_voltage_v, min)
        into = self._possible(now, level, moments, limits.max_voltage_v, max)
        energy = self._energy(now, level)
        return Power(
            *_within(out[0], out[1], limits.max_discharge_a),
            *_within(-into[0], into[1], limits.max_charge_a),
            *energy,
        )

    def voltage_after(self, now: PackNow, line: DelayLine, current_a: float) -> float:
        """Return the voltage at the end of the horizon with a constant current [V]."""
        _, resistance_ohm, past_v, seconds = self._moments(now, line)[-1]
        offset_v = self._level(now)[0]
        soc_pct = now.soc_pct - self._pct_per_as(now) * current_a * seconds
        ocv_v = self._curve.pseudo_ocv_at(soc_pct)[0]
        return ocv_v + offset_v + past_v + resistance_ohm * current_a

    def _level(self, now: PackNow) -> tuple[float, float]:
        """Return the voltage without OCV and drop [V], and its variance [V²]."""
        model, ratio = self._model, now.health.resistance_ratio
        temperature_c = model.t_ref_c if math.isnan(now.temperature_c) else now.temperature_c
        base_v = model.offset_at(temperature_c, (0.0,) * len(model.delay_s))
        if math.isnan(now.residual_v):
            slope = self._curve.pseudo_ocv_at(now.soc_pct)[1]
            return base_v, self._bias_var + (slope * now.soc_std_pct) ** 2
        return base_v + now.residual_v - (ratio - 1.0) * now.drop_v, self._wander_var

    def _pct_per_as(self, now: PackNow) -> float:
        return 100.0 / (3600.0 * now.health.capacity_ah)

    def _moments(self, now: PackNow, line: DelayLine) -> list[tuple[float, float, float, float]]:
        """Return the terms of the drop at each moment of the horizon.

        Unknown past [V], resistance of the current to come [Ω], drop of the past currents [V], and
        time from now [s].
        """
        model, ratio = self._model, now.health.resistance_ratio
        usual_a = ENERGY_C_RATE * now.health.capacity_ah
        filled_s, found = line.filled_s, []
        for step in range(1, STEPS + 1):
            seconds = HORIZON_S * step / STEPS
            ohm = past_v = unknown_v = 0.0
            for resistance, delay in zip(model.resistance_ohm, model.delay_s, strict=True):
                if delay <= seconds:
                    ohm += resistance
                    continue
                past_v += resistance * line.current_at(delay - seconds)
                if delay - seconds > filled_s:
                    unknown_v += abs(resistance) * usual_a
            found.append((unknown_v, ratio * ohm, ratio * past_v, seconds))
        return found

    def _possible(
        self,
        now: PackNow,
        level: tuple[float, float],
        moments: list[tuple[float, float, float, float]],
        limit_v: float,
        nearest: Callable[..., tuple[float, float]],
    ) -> tuple[float, float]:
        """Return the current that meets a voltage first within the horizon, and its std [A].

        A model of constant currents knows the sum of its resistances, but not when each acts: at a
        moment at which its voltage would rise with the current, it knows no limit. NaN: at none.
        """
        per_as = self._pct_per_as(now)
        found = []
        for unknown_v, ohm, past_v, seconds in moments:
            fixed_v = level[0] + past_v - limit_v
            per_a = per_as * seconds
            current_a, slope = 0.0, 0.0
            for _ in range(_ITERATIONS):
                ocv_v, slope = self._curve.pseudo_ocv_at(now.soc_pct - per_a * current_a)
                step_a = (ocv_v + fixed_v + ohm * current_a) / (slope * per_a - ohm)
                current_a += step_a
                if abs(step_a) < _CLOSE_A:
                    break
            volt_per_a = slope * per_a - ohm
            if volt_per_a <= 0.0:
                continue
            drop_v = past_v + ohm * current_a - now.health.resistance_ratio * now.drop_v
            error_v = now.health.resistance_std / now.health.resistance_ratio * drop_v
            variance = self._fast_var + level[1] + error_v**2 + unknown_v**2
            variance += self._curvature_v(now, per_a * current_a) ** 2
            found.append((current_a, math.sqrt(variance) / volt_per_a))
        return nearest(found) if found else (_NAN, _NAN)

    def _curvature_v(self, now: PackNow, taken_pct: float) -> float:
        """Return how much the fall of the OCV differs one standard deviation lower [V]."""
        at = self._curve.pseudo_ocv_at
        lower = now.soc_pct - now.soc_std_pct
        here_v = at(now.soc_pct)[0] - at(now.soc_pct - taken_pct)[0]
        return at(lower)[0] - at(lower - taken_pct)[0] - here_v

    def _energy(self, now: PackNow, level: tuple[float, float]) -> tuple[float, float]:
        """Return the energy left and its standard deviation [Wh]."""
        health, limits = now.health, self.limits
        ohm = health.resistance_ratio * sum(self._model.resistance_ohm)
        drop_v = ohm * ENERGY_C_RATE * health.capacity_ah
        span_pct = now.soc_pct - limits.cutoff_soc_pct
        if span_pct <= 0.0:
            return 0.0, _energy_std_wh(now, 0.0, self._volts(now.soc_pct, level, drop_v), 0.0)
        step_pct = span_pct / ENERGY_STEPS
        energy_wh, soc_pct, end_pct = 0.0, now.soc_pct, 0.0
        volts = self._volts(soc_pct, level, drop_v)
        for _ in range(ENERGY_STEPS):
            if volts <= limits.min_voltage_v:
                slope = self._curve.pseudo_ocv_at(soc_pct)[1]
                end_pct = math.sqrt(level[1]) / slope
                break
            soc_pct -= step_pct
            below_v = self._volts(soc_pct, level, drop_v)
            part = 1.0
            if below_v < limits.min_voltage_v:
                part = (volts - limits.min_voltage_v) / (volts - below_v)
            mean_v = volts - 0.5 * part * (volts - below_v)
            energy_wh += mean_v * part * step_pct / 100.0 * health.capacity_ah
            volts = below_v
        return energy_wh, _energy_std_wh(
            now, energy_wh, self._volts(now.soc_pct, level, drop_v), end_pct
        )

    def _volts(self, soc_pct: float, level: tuple[float, float], drop_v: float) -> float:
        return self._curve.pseudo_ocv_at(soc_pct)[0] + level[0] + drop_v


def _energy_std_wh(now: PackNow, energy_wh: float, volts: float, end_pct: float) -> float:
    """Return the energy's standard deviation from SoC, its end [%] and capacity [Wh]."""
    health = now.health
    ends_pct = math.hypot(now.soc_std_pct, end_pct)
    return math.hypot(
        volts * ends_pct / 100.0 * health.capacity_ah,
        energy_wh * health.capacity_std_ah / health.capacity_ah,
    )


def _within(current_a: float, std_a: float, most_a: float) -> tuple[float, float]:
    """Return current and std within 0 … `most_a`: of the 2σ band, what lies between them [A]."""

    def clip(value: float) -> float:
        return min(max(value, 0.0), most_a)

    return clip(current_a), 0.25 * (clip(current_a + 2.0 * std_a) - clip(current_a - 2.0 * std_a))


def _or(stated: float | None, default: float) -> float:
    return default if stated is None else stated

"""Noise of the voltages that the filter uses, and the error of the curve that it considers.

What is wrong for seconds is measurement noise; slower errors are states of the filter (`ekf`). The
voltage is less certain while earlier currents act on it that are not known: in the delay line, and
in the memory of effects.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from typing import NamedTuple

from cangauge._arithmetic import dot, total
from cangauge.model.delay_line import DelayLine
from cangauge.model.extended import OnlineExtendedModel
from cangauge.model.model_file import Model, ModelNoise, effective_error_std_v

USUAL_CURRENT_C_RATE = 1.0 / 3.0
"""Size of a current before the first sample [1/h]: 20 A at 60 Ah."""

MEMORY_TIMES = 10.0
"""Time constants after which an earlier current is forgotten."""

TEMPERATURE_STD_K = 10.0
"""Standard deviation of a temperature that is not measured [K]."""

OUTSIDE_TEMPERATURE_V_PER_K = 1e-3
"""Relative error of the voltage per K outside the identified temperatures (0.36 V/K for a Leaf)."""


class MeasurementNoise:
    """Fast error of the voltages that the filter uses; the slow errors are states of the filter.

    Parameters
    ----------
    model : Model
        Its noise and rate.
    online : OnlineExtendedModel
        The same with its effects.
    """

    def __init__(self, model: Model, online: OnlineExtendedModel) -> None:
        voltage_model = self._model = online.model
        self._fast_std_v = effective_error_std_v(model.noise, 1.0 / model.rate_hz)
        self._nominal_v = voltage_model.pseudo_ocv_at(50.0)[0]
        curve = model.noise.curve
        self._mean_c = voltage_model.t_ref_c if curve is None else curve.temperature_c
        self._kt_std = 0.0 if curve is None else curve.kt_std_v_per_k
        self._resistance_std = 0.0 if curve is None else curve.resistance_std_per_k
        self._usual_a = USUAL_CURRENT_C_RATE * online.capacity_ah
        self._rate_hz = model.rate_hz
        self._memory = online.memory
        self._memory_s = MEMORY_TIMES * max((tau_s for _, tau_s in self._memory), default=0.0)
        # All samples of one filling delay line share the same unknown currents.
        self._shared_by = max(voltage_model.delay_s[-1] * model.rate_hz, 1.0)

    def at(self, temperature_c: float, line: DelayLine) -> tuple[float, float]:
        """Return the standard deviation of the fast error, and that of the temperature's [V].

        The voltage is less certain while the delay line fills, without a temperature, and outside
        the range that the model was identified on.

        Parameters
        ----------
        temperature_c : float
            Last known temperature [°C]; NaN if there was none.
        line : DelayLine
            The current up to the sample.

        Returns
        -------
        fast_std_v : float
        kt_std_v : float
            Signed effect of one standard deviation of the temperature coefficient.
        """
        model = self._model
        variance = self._fast_std_v * self._fast_std_v
        filled_s = line.filled_s
        if not filled_s >= model.delay_s[-1]:
            variance = self._filling_var_v2(variance, filled_s)
        if filled_s < self._memory_s:
            variance += self._start_var_v2(filled_s)
        if math.isnan(temperature_c):
            return math.sqrt(variance), abs(model.kt_v_per_k) * TEMPERATURE_STD_K
        cold, hot = model.temperature_range_c
        outside = OUTSIDE_TEMPERATURE_V_PER_K * self._nominal_v
        outside_v = outside * (min(temperature_c - cold, 0.0) + max(temperature_c - hot, 0.0))
        return math.sqrt(variance), self._kt_std * (temperature_c - self._mean_c) + outside_v

    def resistance_std(self, temperature_c: float) -> float:
        """Return the signed relative deviation of the resistance at a temperature [°C]."""
        if math.isnan(temperature_c):
            return self._resistance_std * TEMPERATURE_STD_K
        return self._resistance_std * (temperature_c - self._mean_c)

    def _filling_var_v2(self, filled_var_v2: float, filled_s: float) -> float:
        """Return the error's variance while the delay line fills [V²].

        Each sample gets the variance of all that share the unknown currents, so that together
        they carry the information of one.
        """
        model = self._model
        unknown_ohm = total(
            abs(resistance)
            for resistance, delay in zip(model.resistance_ohm, model.delay_s, strict=True)
            if delay > filled_s
        )
        unknown_v = unknown_ohm * self._usual_a
        return (filled_var_v2 + unknown_v * unknown_v) * self._shared_by

    def _start_var_v2(self, known_s: float) -> float:
        """Return the variance from currents before the first, in the effects' memory [V²].

        As while the line fills: each sample gets the variance of all within the time constant.

        Parameters
        ----------
        known_s : float
            Time that the current is known for [s].
        """
        return total(
            (ohm * self._usual_a)
            * (ohm * self._usual_a)
            * math.exp(-2.0 * known_s / tau_s)
            * max(tau_s * self._rate_hz, 1.0)
            for ohm, tau_s in self._memory
        )


class Measurement(NamedTuple):
    """One measured voltage with the terms of its prediction."""

    voltage_v: float
    without_ocv_v: float
    """Predicted voltage less the pseudo-OCV, at the measured currents [V]."""
    soc_pct: float
    """SoC by inverse of the voltage model [%]."""
    std_v: float
    """Standard deviation of the fast error [V]."""
    kt_std_v: float
    """Effect of one standard deviation of the temperature coefficient, signed [V]."""
    resistance_std_v: float
    """That of the resistance's change with temperature [V]."""


class CurveFunctions:
    """Principal functions of the curve's error, interpolated.

    Parameters
    ----------
    noise : ModelNoise
    """

    def __init__(self, noise: ModelNoise) -> None:
        curve = noise.curve
        self._knots: list[float] = [] if curve is None else curve.soc_pct
        by_knot = [] if curve is None else list(zip(*curve.functions_v, strict=True))
        self._at = [list(values) for values in by_knot]
        self.number = len(by_knot[0]) if by_knot else 0

    def at(self, soc_pct: float) -> list[float]:
        """Return the value of each function at a SoC [V]."""
        knots = self._knots
        if not self.number:
            return []
        k = min(max(bisect_right(knots, soc_pct), 1), len(knots) - 1)
        low, high = knots[k - 1], knots[k]
        part = min(max((soc_pct - low) / (high - low), 0.0), 1.0)
        rest = 1.0 - part
        return [rest * a + part * b for a, b in zip(self._at[k - 1], self._at[k], strict=True)]

    def std_v(self, soc_pct: float) -> float:
        """Return the standard deviation of the curve's error at a SoC [V]."""
        values = self.at(soc_pct)
        return math.sqrt(dot(values, values))

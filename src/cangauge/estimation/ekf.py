"""Extended Kalman filter of the voltage model and Coulomb counting, and its measurement noise.

The state x = (S, o, b, l) is the SoC S [%], the current sensor's offset o [A] (measured = true +
o), and the voltage model's bias in a slow part b and a lasting part l [V]. The biases are
first-order Gauss–Markov processes, sized on held-out data. Because they are states, the standard
deviation of S stops falling where the voltage carries no more information: an error that lasts as
long as a trip does not average out.

    S ← S − a·(i − o)·Δt,   a = 100/(3600·C)
    U = OCV(S) + kt·(T − T_r) + Σ Rj·(I(t − dj) − o) + b + l + fast error

References
----------
Plett, Extended Kalman filtering for battery management systems, J. Power Sources 134 (2004); the
filter's arithmetic is filterpy's `ExtendedKalmanFilter`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from cangauge.errors import InputError
from cangauge.estimation.state import EkfState
from cangauge.model.delay_line import DelayLine
from cangauge.model.model_file import Model, ModelNoise, effective_error_std_v
from cangauge.model.voltage_model import Curve, VoltageModel

USUAL_CURRENT_C_RATE = 1.0 / 3.0
"""Size of a current before the first sample [1/h]: 20 A at 60 Ah."""

TEMPERATURE_STD_K = 10.0
"""Standard deviation of a temperature that is not measured [K]."""

OUTSIDE_SLOPE_ERROR = 0.5
"""Relative error of the straight line's slope outside the identified SoC."""

OUTSIDE_TEMPERATURE_V_PER_K = 1e-3
"""Relative error of the voltage per K outside the identified temperatures (0.36 V/K for a Leaf)."""

OFFSET_STD_PER_AH = 0.025
"""Prior standard deviation of the current offset, per Ah of capacity [A/Ah] (1.5 A at 60 Ah)."""

OFFSET_WALK_PER_SQRT_H = 0.1
"""Random walk of the offset, in prior standard deviations per √hour."""

CAPACITY_STD = 0.03
"""Relative standard deviation of the capacity: cells age and cool."""

CAPACITY_SPAN_PCT = 30.0
"""SoC travel over which a capacity error builds up in one direction [%]."""

UNKNOWN_SOC_STD_PCT = 30.0
"""Standard deviation of an unknown SoC [%] (uniform over 0–100: 29 %)."""

PERSISTENT_S = 60.0
"""Memory of the mean innovation, which separates lasting from passing contradictions [s]."""

PERSISTENT_SIGMAS = 4.5
"""A mean innovation beyond this many of its standard deviations contradicts the state."""

OUTLIER_SIGMAS = 5.0
"""For a single innovation beyond this the measurement noise is raised to its size."""

SLOW_SPAN_PCT = 3.0
LASTING_SPAN_PCT = 8.0
"""SoC travel over which each bias decorrelates [%]. The error of the fitted curve varies with SoC;
with a constant bias the filter would slide along the curve until its shape fits."""

LASTING_TIME_S = 7200.0
"""Time constant of the lasting bias [s]; the logs that it is identified on are seldom longer."""

RESTED_BIAS = 0.6
"""The bias after a long rest, in units of its standard deviation while driving."""

ROUNDING = 1e-6
"""Tolerance of a covariance's correlations."""


def count_std_pct(
    capacity_ah: float, start_var_pct2: float, hours: float, moved_pct: float
) -> float:
    """Return the standard deviation of the SoC by counting alone [%].

    Parameters
    ----------
    capacity_ah : float
        Charge from 100 to 0 % [Ah].
    start_var_pct2 : float
        Variance of the SoC that counting started from, and of gaps [%²].
    hours, moved_pct : float
        Time [h] and charge moved in either direction [%] since.
    """
    pct_per_as = 100.0 / (3600.0 * capacity_ah)
    offset_pct = OFFSET_STD_PER_AH * capacity_ah * 3600.0 * hours * pct_per_as
    capacity_pct2 = CAPACITY_STD**2 * CAPACITY_SPAN_PCT * moved_pct
    return math.sqrt(start_var_pct2 + offset_pct**2 + capacity_pct2)


class MeasurementNoise:
    """Fast error of the voltages that the filter uses; the slow errors are states of the filter.

    Parameters
    ----------
    voltage_model : VoltageModel
    model : Model
        Its noise and rate.
    capacity_ah : float
        Charge from 100 to 0 % [Ah].
    """

    def __init__(self, voltage_model: VoltageModel, model: Model, capacity_ah: float) -> None:
        self._model = voltage_model
        self._nominal_v = voltage_model.pseudo_ocv_at(50.0)[0]
        self._fast_std_v = effective_error_std_v(model.noise, 1.0 / model.rate_hz)
        self._usual_a = USUAL_CURRENT_C_RATE * capacity_ah
        # All samples of one filling delay line share the same unknown currents.
        self._shared_by = max(voltage_model.delay_s[-1] * model.rate_hz, 1.0)

    def at(self, temperature_c: float, line: DelayLine) -> tuple[Callable[[float], float], float]:
        """Return the standard deviation of a voltage over the SoC, and that of a lasting error.

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
        std_v : callable
            From the SoC [%], NaN for an unknown one, to the fast error's standard deviation [V].
        outside_std_v : float
            Standard deviation of the error outside the identified temperatures [V]. It lasts as
            long as the temperature does, and does not average out.
        """
        model = self._model
        variance = self._fast_std_v**2
        filled_s = line.filled_s
        if not filled_s >= model.delay_s[-1]:
            variance = self._filling_var_v2(variance, filled_s)
        beyond_k = 0.0
        if math.isnan(temperature_c):
            variance += (model.kt_v_per_k * TEMPERATURE_STD_K) ** 2
        else:
            cold, hot = model.temperature_range_c
            beyond_k = max(cold - temperature_c, temperature_c - hot, 0.0)
        low, high = model.soc_range_pct
        outside_v = OUTSIDE_TEMPERATURE_V_PER_K * self._nominal_v * beyond_k

        def std_v(soc_pct: float) -> float:
            is_known = not math.isnan(soc_pct)
            beyond_pct = max(low - soc_pct, soc_pct - high, 0.0) if is_known else 0.0
            if beyond_pct == 0.0:
                return math.sqrt(variance)
            slope = model.pseudo_ocv_at(soc_pct)[1]
            return math.sqrt(variance + (OUTSIDE_SLOPE_ERROR * slope * beyond_pct) ** 2)

        return std_v, outside_v

    def _filling_var_v2(self, filled_var_v2: float, filled_s: float) -> float:
        """Return the error's variance while the delay line fills [V²].

        Each sample gets the variance of all that share the unknown currents, so that together
        they carry the information of one.
        """
        model = self._model
        unknown_ohm = sum(
            abs(resistance)
            for resistance, delay in zip(model.resistance_ohm, model.delay_s, strict=True)
            if delay > filled_s
        )
        return (filled_var_v2 + (unknown_ohm * self._usual_a) ** 2) * self._shared_by


class Measurement(NamedTuple):
    """One measured voltage with the terms of its prediction."""

    voltage_v: float
    without_ocv_v: float
    """Predicted voltage less the pseudo-OCV, at the measured currents [V]."""
    soc_pct: float
    """SoC by inverse of the voltage model [%]."""
    std_v: Callable[[float], float]
    """Standard deviation of the fast error [V] as a function of the SoC [%]."""
    outside_std_v: float = 0.0
    """Standard deviation of the lasting error outside the identified temperatures [V]."""


class SocEkf:
    """Extended Kalman filter; state and equations are in the module's docstring.

    Parameters
    ----------
    curve : Curve
        Pseudo-OCV, effects included.
    steady_ohm : float
        Change of the voltage with a lasting current, negative [V/A].
    capacity_ah : float
        Charge from 100 to 0 % [Ah].
    noise : ModelNoise
        Size and time constants of the model's biases.

    Attributes
    ----------
    log_likelihood : float
        Of the last voltage, given all before it.
    was_outlier : bool
        Whether the last voltage was down-weighted as an outlier.
    """

    def __init__(
        self, curve: Curve, steady_ohm: float, capacity_ah: float, noise: ModelNoise
    ) -> None:
        self._curve = curve
        self._pct_per_as = 100.0 / (3600.0 * capacity_ah)
        self._steady_ohm = steady_ohm
        self._slow_var = noise.slow_std_v**2
        self._slow_time_s = noise.slow_time_s
        self._lasting_var = noise.lasting_std_v**2
        self._offset_std_a = OFFSET_STD_PER_AH * capacity_ah
        self._outside_var = 0.0
        self._mean_innovation_v = 0.0
        self._mean_seconds = 0.0
        self.log_likelihood = 0.0
        self.was_outlier = False
        self._ekf = ExtendedKalmanFilter(dim_x=4, dim_z=1, dim_u=1)
        self._ekf.B = np.array([[1.0], [0.0], [0.0], [0.0]])

    def start(self, soc_pct: float, soc_std_pct: float) -> None:
        """Restart from a SoC with its standard deviation [%]."""
        self._ekf.x = np.array([[soc_pct], [0.0], [0.0], [0.0]])
        self._ekf.P = np.diag(
            [soc_std_pct**2, self._offset_std_a**2, self._slow_var, self._lasting_var]
        )
        self._reset_innovations()

    def predict(
        self,
        seconds: float,
        discharged_pct: float,
        moved_pct: float,
        gap_var_pct2: float,
        away_s: float = 0.0,
    ) -> None:
        """Propagate the state over the charge counted since the last call.

        Parameters
        ----------
        seconds : float
            Time passed [s].
        discharged_pct, moved_pct : float
            Net charge taken out, and charge moved in either direction [% of capacity].
        gap_var_pct2 : float
            Variance of the charge in gaps and unobserved intervals [%²].
        away_s : float
            Part of the time in which no charge was counted, and hence no offset [s].
        """
        slow_kept = math.exp(-seconds / self._slow_time_s - moved_pct / SLOW_SPAN_PCT)
        lasting_kept = math.exp(-seconds / LASTING_TIME_S - moved_pct / LASTING_SPAN_PCT)
        # What was learned outside the identified temperatures fades as the lasting bias does.
        self._outside_var *= lasting_kept**2
        offset_walk = OFFSET_WALK_PER_SQRT_H * self._offset_std_a
        ekf = self._ekf
        ekf.F = np.diag([1.0, 1.0, slow_kept, lasting_kept])
        ekf.F[0, 1] = self._pct_per_as * (seconds - away_s)
        ekf.Q = np.diag(
            [
                CAPACITY_STD**2 * CAPACITY_SPAN_PCT * moved_pct + gap_var_pct2,
                offset_walk**2 * seconds / 3600.0,
                self._slow_var * (1.0 - slow_kept**2),
                self._lasting_var * (1.0 - lasting_kept**2),
            ]
        )
        ekf.predict(u=np.array([[-discharged_pct]]))
        self._clip_soc()

    def update(self, measurement: Measurement, seconds: float) -> bool:
        """Update with one voltage, `seconds` after the last one [s].

        Returns
        -------
        bool
            Whether a lasting contradiction made the SoC unknown again.
        """
        ekf = self._ekf
        outside_var = measurement.outside_std_v**2
        if outside_var > self._outside_var:
            ekf.P[3, 3] += outside_var - self._outside_var
            self._outside_var = outside_var
        soc_pct = float(ekf.x[0, 0])
        std_v = measurement.std_v(soc_pct)
        ocv_v, slope = self._curve.pseudo_ocv_at(soc_pct)
        predicted_v = self._predicted_v(measurement, ocv_v)
        is_contradicted = self._is_contradicted(measurement, predicted_v, slope, std_v, seconds)
        if is_contradicted:
            ekf.x[2:, 0] = 0.0
            ekf.P = np.diag(
                [
                    UNKNOWN_SOC_STD_PCT**2,
                    float(ekf.P[1, 1]),
                    self._slow_var,
                    self._lasting_var + self._outside_var,
                ]
            )
            self._reset_innovations()
            predicted_v = self._predicted_v(measurement, ocv_v)
        jacobian = np.array([[slope, -self._steady_ohm, 1.0, 1.0]])
        innovation = measurement.voltage_v - predicted_v
        spread = float((jacobian @ ekf.P @ jacobian.T)[0, 0])
        variance = std_v**2
        self.was_outlier = innovation**2 > OUTLIER_SIGMAS**2 * (spread + variance)
        if self.was_outlier:
            variance = max(variance, innovation**2 - spread)
        total = spread + variance
        self.log_likelihood = -0.5 * (innovation**2 / total + math.log(total))
        ekf.update(
            np.array([[measurement.voltage_v]]),
            lambda _: jacobian,
            lambda _: np.array([[predicted_v]]),
            R=variance,
        )
        self._clip_soc()
        return is_contradicted

    def correct(self, soc_pct: float, std_pct: float) -> None:
        """Update with an external SoC reference and its standard deviation [%]."""
        jacobian = np.array([[1.0, 0.0, 0.0, 0.0]])
        self._ekf.update(np.array([[soc_pct]]), lambda _: jacobian, lambda x: x[:1], R=std_pct**2)
        self._clip_soc()

    def shrink_bias(self) -> None:
        """Reduce the slow bias after a long rest, in which slow polarisation has decayed."""
        ekf = self._ekf
        limit = RESTED_BIAS**2 * self._slow_var
        shrink = math.sqrt(limit / ekf.P[2, 2]) if ekf.P[2, 2] > limit else 1.0
        ekf.x[2, 0] *= shrink
        ekf.P[2, :] *= shrink
        ekf.P[:, 2] *= shrink

    def snapshot(self) -> EkfState:
        """Return a copy of the state."""
        return EkfState(
            self._ekf.x[:, 0].tolist(),
            self._ekf.P.tolist(),
            self._mean_innovation_v,
            self._mean_seconds,
            self._outside_var,
        )

    def restore(self, state: EkfState) -> None:
        """Continue from a state.

        Raises
        ------
        InputError
            If it has another number of variables.
        """
        ekf = self._ekf
        size = ekf.dim_x
        if [len(state.x), *map(len, state.p)] != [size] * (size + 1) or len(state.p) != size:
            raise InputError(f"not a filter of {size} states", field="filter.hypotheses")
        ekf.x = np.array(state.x).reshape(size, 1)
        ekf.P = np.array(state.p)
        self._mean_innovation_v = state.mean_innovation_v
        self._mean_seconds = state.mean_seconds
        self._outside_var = state.outside_v2

    def is_valid(self) -> bool:
        """Return whether state and covariance are finite, and the covariance semidefinite."""
        covariance = self._ekf.P
        variance = np.diag(covariance)
        if not (np.isfinite(covariance).all() and (variance >= 0.0).all()):
            return False
        scale = np.sqrt(np.where(variance > 0.0, variance, 1.0))
        correlation = covariance / np.outer(scale, scale)
        # Called after every voltage: `np.allclose` takes four times as long as the eigenvalues.
        if np.abs(correlation - correlation.T).max() > ROUNDING:
            return False
        is_definite = bool(np.linalg.eigvalsh(correlation)[0] > -ROUNDING)
        return is_definite and bool(np.all(np.isfinite(self._ekf.x)))

    @property
    def soc_pct(self) -> float:
        """State of charge [%], within 0–100."""
        return float(self._ekf.x[0, 0])

    @property
    def offset_a(self) -> float:
        """Estimated offset of the current sensor [A]."""
        return float(self._ekf.x[1, 0])

    @property
    def bias_v(self) -> float:
        """Estimated bias of the voltage model [V]."""
        return float(self._ekf.x[2, 0] + self._ekf.x[3, 0])

    @property
    def strain(self) -> float:
        """Larger of offset and bias, in their standard deviations before the first voltage."""
        bias_var = self._slow_var + self._lasting_var + self._outside_var
        bias = abs(self.bias_v) / math.sqrt(bias_var) if bias_var > 0.0 else 0.0
        return max(abs(self.offset_a) / self._offset_std_a, bias)

    def summary(self, counted_s: float) -> tuple[float, float, float]:
        """Return SoC, its standard deviation, and the charge that the offset adds in a time [%]."""
        x = self._ekf.x
        std_pct = math.sqrt(max(float(self._ekf.P[0, 0]), 0.0))
        return float(x[0, 0]), std_pct, self._pct_per_as * counted_s * float(x[1, 0])

    def _predicted_v(self, measurement: Measurement, ocv_v: float) -> float:
        x = self._ekf.x
        volts = ocv_v + (measurement.without_ocv_v - self._steady_ohm * float(x[1, 0]))
        return volts + float(x[2, 0] + x[3, 0])

    def _is_contradicted(
        self,
        measurement: Measurement,
        predicted_v: float,
        slope: float,
        std_v: float,
        seconds: float,
    ) -> bool:
        """Return whether the mean innovation, biases excluded, contradicts state and model."""
        ekf = self._ekf
        if seconds > PERSISTENT_S:
            # After an interval without voltages, earlier innovations carry no information.
            self._reset_innovations()
            return False
        bias_v = float(ekf.x[2, 0] + ekf.x[3, 0])
        unbiased_v = predicted_v - bias_v
        weight = math.exp(-seconds / PERSISTENT_S)
        self._mean_innovation_v *= weight
        self._mean_innovation_v += (1.0 - weight) * (measurement.voltage_v - unbiased_v)
        self._mean_seconds += seconds
        if self._mean_seconds < PERSISTENT_S:
            return False
        mean_var = (
            self._slow_var + self._lasting_var + self._outside_var + slope**2 * float(ekf.P[0, 0])
        )
        mean_var += std_v**2 * seconds / (2.0 * PERSISTENT_S)
        seen = 1.0 - math.exp(-self._mean_seconds / PERSISTENT_S)
        mean = self._mean_innovation_v / seen
        return mean**2 > PERSISTENT_SIGMAS**2 * mean_var

    def _reset_innovations(self) -> None:
        self._mean_innovation_v = 0.0
        self._mean_seconds = 0.0

    def _clip_soc(self) -> None:
        self._ekf.x[0, 0] = min(max(float(self._ekf.x[0, 0]), 0.0), 100.0)

"""How uncertain one voltage is against the model: more where the model is out of its depth.

Fusion of the voltage model and Coulomb counting: an extended Kalman filter (filterpy).

State x = (S, o, b, l): SoC S [%], current sensor's offset o [A] (measured = true + o), and the
voltage model's bias in two parts, slow b and lasting l [V], first-order Gauss–Markov processes
whose sizes were read off held-out data. Because they are states, the standard deviation of S
stops falling where the voltage has no more to say: an error that lasts as long as a trip does not
average out.

    S ← S − a·(i − o)·Δt,   a = 100/(3600·C)
    U = OCV(S) + kt·(T − T_r) + Σ Rj·(I(t − dj) − o) + b + l + fast error
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.estimate.state import FilterState
from cangauge.estimate.validity import outside_model_std_v
from cangauge.model.delay_line import DelayLine
from cangauge.model.extended import OnlineExtendedModel
from cangauge.model.model_file import Model, ModelNoise, effective_error_std_v
from cangauge.model.voltage_model import VoltageModel

# --- How uncertain one voltage is against the model: more where the model is out of its depth

USUAL_CURRENT_C_RATE = 1.0 / 3.0
"""What a current that was not seen may have been [1/h]: 20 A at 60 Ah."""

TEMPERATURE_STD_K = 10.0
"""Uncertainty of a temperature that is not measured [K]."""


class MeasurementNoise:
    """The fast error of the voltages that an estimator uses; its biases are states of the filter.

    Parameters
    ----------
    model : VoltageModel
    file : Model
        What the model came from: its noise and rate.
    capacity_ah : float
    """

    def __init__(self, model: VoltageModel, file: Model, capacity_ah: float) -> None:
        self._model = model
        self._fast_std_v = effective_error_std_v(file.noise, 1.0 / file.rate_hz)
        self._usual_a = USUAL_CURRENT_C_RATE * capacity_ah
        # The guesses of one filling delay line are the same guess for all its samples.
        self._alike = max(model.delay_s[-1] * file.rate_hz, 1.0)

    def at(self, temperature_c: float, line: DelayLine) -> Callable[[float], float]:
        """Return what gives the standard deviation of a voltage [V] by the SoC [%], NaN: unknown.

        Parameters
        ----------
        temperature_c : float
            As far as it is known [°C], else NaN.
        line : DelayLine
        """
        squares = self._fast_std_v**2
        if not line.full:
            squares = self._filling_var_v2(squares, line.filled_s)
        if math.isnan(temperature_c):
            squares += (self._model.kt_v_per_k * TEMPERATURE_STD_K) ** 2

        def std_v(soc_pct: float) -> float:
            outside_v = outside_model_std_v(self._model, soc_pct, temperature_c)
            return math.sqrt(squares + outside_v**2)

        return std_v

    def _filling_var_v2(self, settled_var_v2: float, filled_s: float) -> float:
        """Return the error's variance while the delay line fills [V²].

        The currents before the first sample are a guess, and the same guess for all samples until
        the line is full: together they must tell no more than one of them.
        """
        model = self._model
        unknown_ohm = sum(
            abs(resistance)
            for resistance, delay in zip(model.resistance_ohm, model.delay_s, strict=True)
            if delay > filled_s
        )
        return (settled_var_v2 + (unknown_ohm * self._usual_a) ** 2) * self._alike


# --- Fusion of the voltage model and Coulomb counting: an extended Kalman filter (filterpy)

OFFSET_STD_PER_AH = 0.025
"""Prior standard deviation of the current offset, per Ah of capacity [A/Ah] (1.5 A at 60 Ah)."""

OFFSET_WALK_PER_SQRT_H = 0.1
"""How far the offset wanders, in prior standard deviations per √hour."""

CAPACITY_STD = 0.03
"""Standard deviation of the capacity, relative: cells age and cool."""

CAPACITY_SPAN_PCT = 30.0
"""SoC travel over which a capacity error builds up in one direction [%]."""

UNKNOWN_SOC_STD_PCT = 30.0
"""Standard deviation of a SoC of which nothing is known [%] (uniform over 0–100: 29 %)."""

PERSISTENT_S = 60.0
"""Memory of the mean innovation that tells a lasting contradiction from a passing one [s]."""

PERSISTENT_SIGMAS = 4.5
"""A mean innovation beyond this many of its standard deviations contradicts the state."""

OUTLIER_SIGMAS = 5.0
"""A single innovation beyond this is weighed as if its noise were as large as itself."""

SLOW_SPAN_PCT = 3.0
LASTING_SPAN_PCT = 8.0
"""SoC travel over which each bias becomes another [%]: the fitted curve's error changes with SoC,
and a filter that took the bias as constant would slide along the curve until its shape fits."""

LASTING_TIME_S = 7200.0
"""How long the lasting bias lasts [s]; the logs that show it are seldom longer."""

RESTED_BIAS = 0.6
"""The bias after a long rest, in units of its standard deviation while driving."""

ROUNDING = 1e-6
"""So far may the correlations of a covariance be from those of one."""


@dataclass(frozen=True)
class Measurement:
    """One voltage with what is needed to predict it."""

    voltage_v: float
    beside_v: float
    """The part that does not depend on SoC, at the measured currents [V]."""
    soc_pct: float
    """SoC by the inverse [%]."""
    std_v: Callable[[float], float]
    """Standard deviation of its fast error [V] if the SoC is so large [%]."""


class SocEkf:
    """The filter; see the module's text for its state and equations.

    Parameters
    ----------
    model : OnlineExtendedModel
    capacity_ah : float
    noise : ModelNoise
        Size and duration of the model's biases.
    """

    def __init__(self, model: OnlineExtendedModel, capacity_ah: float, noise: ModelNoise) -> None:
        self._model = model
        self._pct_per_as = 100.0 / (3600.0 * capacity_ah)
        self._steady_ohm = model.steady_ohm
        self._slow_var = noise.slow_std_v**2
        self._slow_time_s = noise.slow_time_s
        self._lasting_var = noise.lasting_std_v**2
        self._offset_std_a = OFFSET_STD_PER_AH * capacity_ah
        self._mean_innovation_v = 0.0
        self._mean_seconds = 0.0
        self.log_likelihood = 0.0
        """Of the last voltage, given all before it."""
        self.was_outlier = False
        """Whether the last voltage was weighed as an outlier."""
        self._ekf = ExtendedKalmanFilter(dim_x=4, dim_z=1, dim_u=1)
        self._ekf.B = np.array([[1.0], [0.0], [0.0], [0.0]])

    def start(self, soc_pct: float, soc_std_pct: float) -> None:
        """Begin from a SoC with its standard deviation [%]."""
        self._ekf.x = np.array([[soc_pct], [0.0], [0.0], [0.0]])
        self._ekf.P = np.diag(
            [soc_std_pct**2, self._offset_std_a**2, self._slow_var, self._lasting_var]
        )
        self._forget_innovations()

    def predict(
        self,
        seconds: float,
        discharged_pct: float,
        moved_pct: float,
        gap_var_pct2: float,
        away_s: float = 0.0,
    ) -> None:
        """Carry the state over the charge counted since the last call.

        Parameters
        ----------
        seconds : float
            Time passed [s].
        discharged_pct, moved_pct : float
            Charge taken out, and moved either way [% of capacity].
        gap_var_pct2 : float
            Variance of the charge lost in gaps [%²].
        away_s : float
            Part of the time in which no charge was counted [s], and so no offset either.
        """
        slow_stays = math.exp(-seconds / self._slow_time_s - moved_pct / SLOW_SPAN_PCT)
        lasting_stays = math.exp(-seconds / LASTING_TIME_S - moved_pct / LASTING_SPAN_PCT)
        offset_walk = OFFSET_WALK_PER_SQRT_H * self._offset_std_a
        ekf = self._ekf
        ekf.F = np.diag([1.0, 1.0, slow_stays, lasting_stays])
        ekf.F[0, 1] = self._pct_per_as * (seconds - away_s)
        ekf.Q = np.diag(
            [
                CAPACITY_STD**2 * CAPACITY_SPAN_PCT * moved_pct + gap_var_pct2,
                offset_walk**2 * seconds / 3600.0,
                self._slow_var * (1.0 - slow_stays**2),
                self._lasting_var * (1.0 - lasting_stays**2),
            ]
        )
        ekf.predict(u=np.array([[-discharged_pct]]))
        self._keep_in_range()

    def update(self, measurement: Measurement, seconds: float) -> bool:
        """Take one voltage in; return True if a lasting contradiction made SoC uncertain again.

        Parameters
        ----------
        measurement : Measurement
        seconds : float
            Time since the last voltage [s].
        """
        std_v = measurement.std_v(self.soc_pct)
        contradicted = self._watch(measurement, std_v, seconds)
        if contradicted:
            self._doubt()
        ekf = self._ekf
        innovation = measurement.voltage_v - float(self._predicted(ekf.x, measurement)[0, 0])
        jacobian = self._jacobian(ekf.x)
        spread = float((jacobian @ ekf.P @ jacobian.T)[0, 0])
        variance = std_v**2
        self.was_outlier = innovation**2 > OUTLIER_SIGMAS**2 * (spread + variance)
        if self.was_outlier:
            variance = max(variance, innovation**2 - spread)
        total = spread + variance
        self.log_likelihood = -0.5 * (innovation**2 / total + math.log(total))
        ekf.update(
            np.array([[measurement.voltage_v]]),
            self._jacobian,
            self._predicted,
            R=variance,
            hx_args=(measurement,),
        )
        self._keep_in_range()
        return contradicted

    def rested(self) -> None:
        """Take note of a long rest: slow polarisation has decayed, so the bias is smaller."""
        ekf = self._ekf
        limit = RESTED_BIAS**2 * self._slow_var
        shrink = math.sqrt(limit / ekf.P[2, 2]) if ekf.P[2, 2] > limit else 1.0
        ekf.x[2, 0] *= shrink
        ekf.P[2, :] *= shrink
        ekf.P[:, 2] *= shrink

    def anchor(self, soc_pct: float, std_pct: float) -> None:
        """Take a SoC in that is known otherwise, with its standard deviation [%]."""
        ekf = self._ekf
        along = np.zeros((1, ekf.dim_x))
        along[0, 0] = 1.0
        ekf.update(np.array([[soc_pct]]), lambda _: along, lambda x: x[:1], R=std_pct**2)
        self._keep_in_range()

    def state(self) -> FilterState:
        """Return what is to be remembered."""
        return FilterState.model_construct(
            x=self._ekf.x[:, 0].tolist(),
            p=self._ekf.P.tolist(),
            mean_innovation_v=self._mean_innovation_v,
            mean_seconds=self._mean_seconds,
        )

    def restore(self, state: FilterState) -> None:
        """Go on from a state.

        Raises
        ------
        InputError
            If it has another number of states.
        """
        ekf = self._ekf
        size = ekf.dim_x
        if [len(state.x), *map(len, state.p)] != [size] * (size + 1) or len(state.p) != size:
            raise InputError(f"is not that of a filter of {size} states", field="belief.filters")
        ekf.x = np.array(state.x).reshape(size, 1)
        ekf.P = np.array(state.p)
        self._mean_innovation_v = state.mean_innovation_v
        self._mean_seconds = state.mean_seconds

    @property
    def is_sound(self) -> bool:
        """Whether state and covariance are still such: finite, and no variance negative."""
        return is_covariance(self._ekf.P) and bool(np.all(np.isfinite(self._ekf.x)))

    @property
    def soc_pct(self) -> float:
        """State of charge [%], within 0–100."""
        return float(self._ekf.x[0, 0])

    @property
    def soc_std_pct(self) -> float:
        """Its standard deviation [%]."""
        return math.sqrt(max(float(self._ekf.P[0, 0]), 0.0))

    @property
    def offset_a(self) -> float:
        """Estimated offset of the current sensor [A]."""
        return float(self._ekf.x[1, 0])

    @property
    def bias_v(self) -> float:
        """Estimated bias of the voltage model, slow and lasting [V]."""
        return float(self._ekf.x[2, 0] + self._ekf.x[3, 0])

    def offset_pct(self, seconds: float) -> float:
        """Return the SoC that the offset alone would feign in some seconds [%]."""
        return self._pct_per_as * seconds * self.offset_a

    def count_std_pct(self, start_var_pct2: float, hours: float, moved_pct: float) -> float:
        """Return the standard deviation of counting alone [%].

        Parameters
        ----------
        start_var_pct2 : float
            Variance of the SoC that it began from and of gaps [%²].
        hours, moved_pct : float
            Time [h] and charge moved either way [%] since.
        """
        offset_pct = self._offset_std_a * 3600.0 * hours * self._pct_per_as
        capacity_pct2 = CAPACITY_STD**2 * CAPACITY_SPAN_PCT * moved_pct
        return math.sqrt(start_var_pct2 + offset_pct**2 + capacity_pct2)

    def _predicted(self, x: FloatArray, measurement: Measurement) -> FloatArray:
        volts, _ = self._model.pseudo_ocv_at(float(x[0, 0]))
        volts += measurement.beside_v - self._steady_ohm * float(x[1, 0])
        volts += float(x[2, 0] + x[3, 0])
        return np.array([[volts]])

    def _jacobian(self, x: FloatArray) -> FloatArray:
        _, slope = self._model.pseudo_ocv_at(float(x[0, 0]))
        return np.array([[slope, -self._steady_ohm, 1.0, 1.0]])

    def _watch(self, measurement: Measurement, std_v: float, seconds: float) -> bool:
        """Whether the mean innovation, before any bias, contradicts state and model."""
        ekf = self._ekf
        if seconds > PERSISTENT_S:
            # One voltage after a pause is no mean, and those before it tell nothing any more.
            self._forget_innovations()
            return False
        plain = float(self._predicted(ekf.x, measurement)[0, 0]) - self.bias_v
        weight = math.exp(-seconds / PERSISTENT_S)
        self._mean_innovation_v *= weight
        self._mean_innovation_v += (1.0 - weight) * (measurement.voltage_v - plain)
        self._mean_seconds += seconds
        if self._mean_seconds < PERSISTENT_S:
            return False
        slope = self._model.pseudo_ocv_at(self.soc_pct)[1]
        mean_var = self._slow_var + self._lasting_var + slope**2 * float(ekf.P[0, 0])
        mean_var += std_v**2 * seconds / (2.0 * PERSISTENT_S)
        seen = 1.0 - math.exp(-self._mean_seconds / PERSISTENT_S)
        mean = self._mean_innovation_v / seen
        return mean**2 > PERSISTENT_SIGMAS**2 * mean_var

    def _doubt(self) -> None:
        """Forget how sure the SoC was, so that the voltage decides again."""
        ekf = self._ekf
        offset_var = float(ekf.P[1, 1])
        ekf.x[2:, 0] = 0.0
        ekf.P = np.diag([UNKNOWN_SOC_STD_PCT**2, offset_var, self._slow_var, self._lasting_var])
        self._forget_innovations()

    def _forget_innovations(self) -> None:
        self._mean_innovation_v = 0.0
        self._mean_seconds = 0.0

    def _keep_in_range(self) -> None:
        self._ekf.x[0, 0] = min(max(float(self._ekf.x[0, 0]), 0.0), 100.0)


def is_covariance(matrix: FloatArray) -> bool:
    """Whether a matrix is finite, symmetric and positive semi-definite, to rounding."""
    variance = np.diag(matrix)
    if not (np.isfinite(matrix).all() and (variance >= 0.0).all()):
        return False
    scale = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    correlation = matrix / np.outer(scale, scale)
    # Asked after every voltage: `np.allclose` takes four times as long as the eigenvalues.
    if np.abs(correlation - correlation.T).max() > ROUNDING:
        return False
    return bool(np.linalg.eigvalsh(correlation)[0] > -ROUNDING)

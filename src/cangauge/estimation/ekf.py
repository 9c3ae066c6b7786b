"""Extended Kalman filter of the state of charge.

State, with C the capacity:

    x = (S, o, z, w, c₁ … cₙ)
    S  state of charge [%]
    o  offset of the current sensor, measured − true [A]
    z  voltage error that lasts minutes [V]
    w  voltage error that lasts a drive (standard normal)
    c  principal functions of the fit's covariance (standard normal)

Prediction over the time dt and the counted charge dq [% of C]. The errors of the voltage, z, w and
c, return to their priors with a time constant τ each, so that no drive teaches for ever:

    S ← S − dq + 100·o·dt/(3600 C),    xᵢ ← xᵢ·exp(−dt/τᵢ),    P ← F P Fᵀ + Q
    Qᵢᵢ = (1 − exp(−2 dt/τᵢ))·(prior variance of xᵢ)

Measurement, the mean voltage of a block of rows with mean load row L, at temperature T:

    U = g(S) + L·θ + row(S, L)·c + A z + √((A·level)² + (δ·g′)² + (outside·g′)² + unknown²)·w + v
    R = var v = (A·fast)² + (δ·g′)² + var of the load between slow samples,   A = A(T) ≥ 1

g′ is the slope of the curve, δ the uncertainty of the SoC against voltage: one part of it lasts,
an equal one is new in each block. Outside the temperatures of the fit a further uncertainty of the
SoC lasts (outside), and without a temperature one of the voltage (unknown). The sizes are those of
the model (`Noise`). While the SoC is uncertain by more than `LINEAR_PCT` the update is iterated
(iterated extended Kalman filter; Jazwinski, Stochastic Processes and Filtering Theory, 1970,
ch. 8.3).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import copy
from functools import cached_property
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike

from cangauge._typing import FloatArray
from cangauge.estimation.counting import UNKNOWN_STD_PCT
from cangauge.estimation.health import PRIOR, FriedlandBias
from cangauge.estimation.state import Block
from cangauge.model.extended import OnlineModel

OFFSET_STD_A: Final = 1.0
"""Prior standard deviation of the current sensor's offset [A]: data sheets of pack sensors state
0.3 to 1 % of a range of ±200 A or more."""

LEVEL_TIME_S: Final = 4.0 * 3600.0
"""Time constant of the voltage error that lasts a drive [s]. From 4 to 24 h all are better than
none on development months. The shortest forgets soonest, and states the largest uncertainty."""

FUNCTIONS_TIME_S: Final = 72.0 * 3600.0
"""Time constant of the functions [s]: temperature and use of a car change within days, and with
them the errors of its model. On development months 6 to 240 h are all better than none. 72 h has
the fewest wrong valid estimates (mean error 1.98 %; 24 h: 2.04 %)."""

DRIFT_PCT2_PER_S: Final = 1e-6
"""Growth of the SoC's variance by self-discharge and unmeasured consumers [%²/s]: 0.06 % in the
first hour (prototype of the filter, development packs)."""

OUTSIDE_PCT_PER_K: Final = 0.2
"""Uncertainty of the SoC against voltage by the distance from the temperatures of the fit [%/K]: a
cell gives a tenth to a quarter less charge at −20 °C than at 25 °C (data sheets), and packs that
the models of warm logs estimate in the cold (development packs)."""

LINEAR_PCT: Final = 1.0
"""Standard deviation of the SoC up to which one linearisation is enough [%]: the slope of a curve
changes little within it."""

ITERATIONS_AT_MOST: Final = 8
CLOSE_PCT: Final = 0.05
"""Iterations, and the change of the SoC that ends them [%]: less than any σ of the filter. Newton's
method doubles its digits with each, so that eight are needed only where the curve has a kink."""

BOUNDS_PCT: Final = (-25.0, 125.0)
"""Bounds of the SoC in the filter [%]: as far as a capacity leads that is stated 20 % too small,
two standard deviations of its prior. A bound that holds the state back falsifies the capacity that
is learned: with −5 % a capacity stated 10 % too small was learned 6 % too small."""

LEAST_SLOPE: Final = 1e-3
"""Least slope of the curve in the filter [V/%]: keeps the SoC observable in a plateau."""

SOC, OFFSET, SLOW, LEVEL, FUNCTIONS = range(5)
"""Index of S, o, z, w and c₁; further functions follow."""


class SocFilter:
    """Extended Kalman filter from one start; equations and symbols are in the module's docstring.

    `predict` moves the state over counted charge, `update` corrects it by the mean voltage of a
    block, `correct` by a SoC that is known otherwise. Between blocks `soc_moments_after` counts
    the SoC on. x, P, F, Q, H, R, K, y and S are filterpy's names. Its prediction is used, and
    imported with the first one: a service whose steps are compiled never makes one here.

    Parameters
    ----------
    model : OnlineModel
    soc_pct, soc_std_pct : float
        Start and its standard deviation [%].

    Attributes
    ----------
    x : array of shape (n,)
    P : array of shape (n, n)
        State and covariance.
    y, S : float
        Latest innovation and its variance.
    evidence : float
        Sum of the log-likelihoods of all voltages, which compares starts.
    bias : FriedlandBias
        Capacity and resistance, learned beside the state by Friedland's filter.
    """

    def __init__(self, model: OnlineModel, soc_pct: float, soc_std_pct: float) -> None:
        n = FUNCTIONS + model.functions.number
        self.model = model
        self._time_s = np.full(n, FUNCTIONS_TIME_S)
        self._time_s[:FUNCTIONS] = math.inf, math.inf, model.noise.slow_time_s, LEVEL_TIME_S
        self._prior_var = np.ones(n)
        self._prior_var[[OFFSET, SLOW]] = OFFSET_STD_A**2, model.noise.slow_std_v**2
        self.x = np.zeros(n)
        self.x[SOC] = soc_pct
        self.P = np.diag(self._prior_var)
        self.P[SOC, SOC] = soc_std_pct**2
        self.y, self.S = 0.0, 1.0
        self.evidence = 0.0
        self.bias = FriedlandBias(n)

    @cached_property
    def _kalman(self) -> Any:
        from filterpy.kalman import ExtendedKalmanFilter  # noqa: PLC0415 - a second and 50 MB

        kalman = ExtendedKalmanFilter(dim_x=self.x.size, dim_z=1)
        kalman.B = np.zeros(self.x.size)
        kalman.B[SOC] = -1.0
        return kalman

    def predict(
        self,
        seconds: float,
        discharged_pct: float,
        variance_pct2: float = 0.0,
        away_s: float = 0.0,
    ) -> None:
        """Propagate the state over counted charge.

        Parameters
        ----------
        seconds : float
            Time in which charge was counted [s].
        discharged_pct : float
            Charge taken out [% of capacity].
        variance_pct2 : float
            Variance of that charge, and of the time without samples [%²].
        away_s : float
            Further time without samples [s].
        """
        kalman = self._kalman
        keep = np.exp(-(seconds + away_s) / self._time_s)
        kalman.F = np.diag(keep)
        kalman.F[SOC, OFFSET] = 100.0 * seconds / (3600.0 * self.model.capacity_ah)
        kalman.Q = np.diag((1.0 - keep**2) * self._prior_var)
        kalman.Q[SOC, SOC] = DRIFT_PCT2_PER_S * seconds + variance_pct2
        kalman.x, kalman.P = self.x, self.P
        kalman.predict(discharged_pct)
        self.x, self.P = kalman.x, kalman.P
        self.bias.predict(kalman.F, discharged_pct, seconds + away_s)

    def update(self, block: Block) -> None:
        """Correct the state by the mean voltage of a block."""
        prior, x = self.x, self.x
        low_pct, high_pct = BOUNDS_PCT
        iterations = ITERATIONS_AT_MOST if self.P[SOC, SOC] > LINEAR_PCT**2 else 1
        damping, last_step_pct = 1.0, 0.0
        for _ in range(iterations):
            voltage_v, H, R = self.measurement(x, block)
            PHt = self.P @ H
            self.S = float(H @ PHt) + R
            K = PHt / self.S
            self.y = block.voltage_v - voltage_v - float(H @ (prior - x))
            target = prior + K * self.y
            target[SOC] = min(max(target[SOC], low_pct), high_pct)
            step_pct = float(target[SOC] - x[SOC])
            if step_pct * last_step_pct < -0.5 * last_step_pct**2:
                damping *= 0.5  # Full Newton steps oscillate across a kink.
            last_step_pct = step_pct
            x = target if damping == 1.0 else x + damping * (target - x)
            if abs(step_pct) < CLOSE_PCT:
                break
        self.x = x
        self._condition(H, PHt, K, block.drop_v)
        log_var = math.log(self.S) if self.S > 0.0 else math.nan  # `is_valid` tests it
        self.evidence -= 0.5 * (self.y**2 / self.S + log_var)

    def correct(self, soc_pct: float, soc_std_pct: float) -> None:
        """Correct the state by a SoC that is known otherwise, with its standard deviation [%]."""
        H = np.zeros_like(self.x)
        H[SOC] = 1.0
        PHt = self.P @ H
        self.S = float(H @ PHt) + soc_std_pct**2
        K = PHt / self.S
        self.y = soc_pct - float(self.x[SOC])
        self.x = self.x + K * self.y
        self._condition(H, PHt, K, 0.0)

    def measurement(self, x: FloatArray, block: Block) -> tuple[float, FloatArray, float]:
        """Return the voltage at a state [V], its gradient H and the variance R [V²]."""
        model, noise = self.model, self.model.noise
        is_missing = math.isnan(block.temperature_c)
        temperature_c = model.model.usual_c if is_missing else block.temperature_c
        A = noise.cold(temperature_c)
        volts, slope = model.pseudo_ocv_at(float(x[SOC]), block.drives)
        slope = max(slope, LEAST_SLOPE)
        soc_axis_v = noise.soc_std_pct * slope
        low_c, high_c = model.model.range.temperature_c
        outside_k = max(low_c - temperature_c, temperature_c - high_c, 0.0)
        lasting_v = (
            A * noise.level_std_v,
            soc_axis_v,
            OUTSIDE_PCT_PER_K * outside_k * slope,
            model.unknown_temperature_v(block.load) if is_missing else 0.0,
        )
        H = np.empty_like(x)
        H[SOC], H[OFFSET], H[SLOW] = slope, 0.0, A
        H[LEVEL] = math.hypot(*lasting_v)
        H[FUNCTIONS:] = model.functions.row(float(x[SOC]), block.load)
        volts += float(block.load @ model.load_coefficients + H[SLOW:] @ x[SLOW:])
        return volts, H, (A * noise.fast_std_v) ** 2 + soc_axis_v**2 + block.unseen_v2

    def row_residual(self, row: Block, soc_pct: float) -> float:
        """Return measured minus predicted voltage of one row over its standard deviation.

        Parameters
        ----------
        row : Block
        soc_pct : float
            SoC counted to it [%].
        """
        x = self.x.copy()
        x[SOC] = soc_pct
        voltage_v, H, R = self.measurement(x, row)
        variance = float(H @ self.P @ H) + R + (H[SLOW] * self.model.noise.residual_std_v) ** 2
        return (row.voltage_v - voltage_v) / math.sqrt(variance)

    def soc_moments_after(
        self, seconds: float, discharged_pct: float, variance_pct2: float = 0.0
    ) -> tuple[float, float]:
        """Return the predicted SoC and its variance [%, %²] without changing the state.

        The variance contains the mean square error by the biases: the SoC counts with the capacity
        and resistance of the model, not with the learned ones.
        """
        a = 100.0 * seconds / (3600.0 * self.model.capacity_ah)
        x, P = self.x, self.P
        variance = P[SOC, SOC] + 2.0 * a * P[SOC, OFFSET] + a * a * P[OFFSET, OFFSET]
        variance += DRIFT_PCT2_PER_S * seconds + variance_pct2
        variance += self.bias.soc_error_pct2
        return float(x[SOC] + a * x[OFFSET] - discharged_pct), float(variance)

    def is_valid(self) -> bool:
        """Return whether state and variances are usable numbers."""
        is_finite = math.isfinite(self.evidence) and np.all(np.isfinite(self.x))
        is_finite = is_finite and np.all(np.isfinite(self.P))
        return bool(is_finite and np.all(np.diag(self.P) > 0.0))

    def strain(self) -> float:
        """Return Σ (learned/prior σ)² of offset, level, functions, capacity and resistance.

        Under the model its distribution is at most χ² with as many degrees of freedom, n + 4.
        """
        biases = self.bias.b / np.sqrt(np.diag(PRIOR))
        learned = np.concatenate(([self.x[OFFSET] / OFFSET_STD_A], self.x[LEVEL:], biases))
        return float(learned @ learned)

    def joint(self) -> tuple[FloatArray, FloatArray]:
        """Return state and covariance with the biases' corrections, followed by the biases."""
        V, b, Pb = self.bias.V, self.bias.b, self.bias.P
        x = np.concatenate((self.x + V @ b, b))
        return x, np.block([[self.P + V @ Pb @ V.T, V @ Pb], [Pb @ V.T, Pb]])

    def copy(self) -> Self:
        """Return an independent copy."""
        other = copy(self)
        other.bias = copy(self.bias)
        return other

    def state(self) -> dict[str, Any]:
        """Return everything needed to continue."""
        bias = self.bias
        biases = {"b": bias.b, "b_P": bias.P, "b_V": bias.V}
        return {"x": self.x, "P": self.P, **biases, "evidence": self.evidence}

    def resume(self, state: Mapping[str, ArrayLike]) -> Self:
        """Continue from a `state` of the same model, its matrices flat or not; return self."""
        shaped = {
            name: np.reshape(state[name], np.shape(now)) for name, now in self.state().items()
        }
        self.x, self.P, bias = shaped["x"], shaped["P"], self.bias
        bias.b, bias.P, bias.V = shaped["b"], shaped["b_P"], shaped["b_V"]
        self.evidence = float(shaped["evidence"])
        return self

    def take_over(self, before: SocFilter) -> None:
        """Take over offset and capacity from the filter of another model, before any update."""
        x, P = before.joint()
        self.x[OFFSET], self.P[OFFSET, OFFSET] = x[OFFSET], P[OFFSET, OFFSET]
        self.bias.take_over(before.bias, self.model.capacity_ah / before.model.capacity_ah)

    def _condition(self, H: FloatArray, PHt: FloatArray, K: FloatArray, drop_v: float) -> None:
        """Update covariance and biases after the state."""
        P = self.P - np.outer(K, PHt)
        self.P = 0.5 * (P + P.T)
        self.bias.update(H, K, self.y, self.S, drop_v)


def inverse_std_pct(model: OnlineModel, soc_pct: float, temperature_c: float) -> float:
    """Return the standard deviation of the SoC by inverse of the latest row's voltage [%]."""
    noise, A = model.noise, model.noise.cold(temperature_c)
    slope = max(model.pseudo_ocv_at(soc_pct)[1], LEAST_SLOPE)
    row = model.functions.row(soc_pct, model.load)
    variance = row @ row + A**2 * (
        noise.level_std_v**2 + noise.slow_std_v**2 + noise.residual_std_v**2
    )
    return min(math.hypot(math.sqrt(variance) / slope, noise.soc_std_pct), UNKNOWN_STD_PCT)

"""Extended Kalman filter of the state of charge.

State, with C the capacity:

    x = (S, o, z, w, c₁ … cₙ)
    S  state of charge [%]
    o  offset of the current sensor, measured − true [A]
    z  voltage error that lasts minutes [V]
    w  voltage error that lasts the whole log (standard normal)
    c  principal functions of the fit's covariance (standard normal)

Prediction over the time dt and the counted charge dq [% of C]:

    S ← S − dq + 100·o·dt/(3600 C),    z ← z·exp(−dt/τ),    P ← F P Fᵀ + Q

Measurement, the mean voltage of a block of rows with mean load row L, at temperature T:

    U = g(S) + L·θ + row(S, L)·c + A z + √((A·level)² + (δ·g′)²)·w + v,    A = A(T) ≥ 1
    R = var v = (A·fast)² + (δ·g′)²

g′ is the slope of the curve, δ the uncertainty of the SoC against voltage: one part of it lasts,
an equal one is new in each block. The sizes are those of the model (`Noise`). While the SoC is
uncertain by more than `LINEAR_PCT` the update is iterated (iterated extended Kalman filter;
Jazwinski, Stochastic Processes and Filtering Theory, 1970, ch. 8.3).
"""

from __future__ import annotations

import math
from typing import Final, Self

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from cangauge._typing import FloatArray
from cangauge.estimation.health import SeparateBias
from cangauge.estimation.state import Block, FilterState
from cangauge.model.extended import OnlineModel

OFFSET_STD_A: Final = 1.0
"""Prior standard deviation of the current sensor's offset [A]: data sheets of pack sensors state
0.3 to 1 % of a range of ±200 A or more."""

DRIFT_PCT2_PER_S: Final = 1e-6
"""Growth of the SoC's variance by self-discharge and unmeasured consumers [%²/s]: 0.06 % in the
first hour (prototype of the filter, development packs)."""

LINEAR_PCT: Final = 1.0
"""Standard deviation of the SoC up to which one linearisation is enough [%]: the slope of a curve
changes little within it."""

ITERATIONS_AT_MOST: Final = 8
CLOSE_PCT: Final = 0.05
"""Iterations, and the change of the SoC that ends them [%]: less than any σ of the filter."""

LOWEST_PCT: Final = -25.0
HIGHEST_PCT: Final = 125.0
"""Bounds of the SoC in the filter [%]: as far as a capacity leads that is stated 20 % too small,
two standard deviations of its prior. A bound that holds the state back falsifies the capacity that
is learned: with −5 % a capacity stated 10 % too small was learned 6 % too small."""

LEAST_SLOPE: Final = 1e-3
"""Least slope of the curve in the filter [V/%]: keeps the SoC observable in a plateau."""

UNKNOWN_STD_PCT: Final = math.sqrt(2000.0)
"""Standard deviation of an unknown SoC [%]: wider than 0–100 % (uniform: 29 %), so that the voltage
decides."""

SOC, OFFSET, SLOW, LEVEL, FUNCTIONS = range(5)
"""Index of S, o, z, w and c₁; further functions follow."""


class SocFilter(ExtendedKalmanFilter):  # type: ignore[misc] # filterpy has no types
    """Kalman filter from one start, in filterpy's names: x, P, F, Q, H, R, K, y and S.

    Only `predict` is filterpy's. `update` takes a block and repeats itself where the curve bends.

    Parameters
    ----------
    model : OnlineModel
    soc_pct, soc_std_pct : float
        Start and its standard deviation [%].

    Attributes
    ----------
    evidence : float
        Sum of the log-likelihoods of all voltages, which compares starts.
    bias : SeparateBias
        Capacity and resistance, learned beside the state.
    """

    def __init__(self, model: OnlineModel, soc_pct: float, soc_std_pct: float) -> None:
        n = FUNCTIONS + model.functions.number
        super().__init__(dim_x=n, dim_z=1)
        noise = model.noise
        self.model = model
        self.x = np.zeros(n)
        self.x[SOC] = soc_pct
        self.P = np.eye(n)
        self.P[SOC, SOC] = soc_std_pct**2
        self.P[OFFSET, OFFSET] = OFFSET_STD_A**2
        self.P[SLOW, SLOW] = noise.slow_std_v**2
        self.B = np.zeros(n)
        self.B[SOC] = -1.0
        self.Q = np.zeros((n, n))
        self.H = np.zeros(n)
        self.y, self.S = 0.0, 1.0
        self.evidence = 0.0
        self.bias = SeparateBias(n)

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
        noise = self.model.noise
        keep = math.exp(-(seconds + away_s) / noise.slow_time_s)
        self.F[SOC, OFFSET] = 100.0 * seconds / (3600.0 * self.model.capacity_ah)
        self.F[SLOW, SLOW] = keep
        self.Q[SOC, SOC] = DRIFT_PCT2_PER_S * seconds + variance_pct2
        self.Q[SLOW, SLOW] = (1.0 - keep**2) * noise.slow_std_v**2
        super().predict(discharged_pct)
        self.bias.predict(self.F, discharged_pct, seconds)

    def update(self, block: Block) -> None:
        """Correct the state by the mean voltage of a block."""
        prior, x = self.x, self.x
        iterations = ITERATIONS_AT_MOST if self.P[SOC, SOC] > LINEAR_PCT**2 else 1
        part, last_pct = 1.0, 0.0
        for _ in range(iterations):
            voltage_v, self.H, self.R = self.measurement(x, block)
            PHt = self.P @ self.H
            self.S = float(self.H @ PHt) + self.R
            self.K = PHt / self.S
            self.y = block.voltage_v - voltage_v - float(self.H @ (prior - x))
            to = prior + self.K * self.y
            to[SOC] = min(max(to[SOC], LOWEST_PCT), HIGHEST_PCT)
            step_pct = float(to[SOC] - x[SOC])
            if step_pct * last_pct < -0.5 * last_pct**2:
                part *= 0.5  # it went too far: where the slope changes, full steps circle
            last_pct = step_pct
            x = to if part == 1.0 else x + part * (to - x)
            if abs(step_pct) < CLOSE_PCT:
                break
        self.x = x
        self._condition(PHt, block.drop_v)
        log_var = math.log(self.S) if self.S > 0.0 else math.nan  # `is_valid` tells
        self.evidence -= 0.5 * (self.y**2 / self.S + log_var)

    def correct(self, soc_pct: float, soc_std_pct: float) -> None:
        """Correct the state by a SoC that is known otherwise, with its standard deviation [%]."""
        self.H = np.zeros_like(self.x)
        self.H[SOC], self.R = 1.0, soc_std_pct**2
        PHt = self.P @ self.H
        self.S = float(self.H @ PHt) + self.R
        self.K = PHt / self.S
        self.y = soc_pct - float(self.x[SOC])
        self.x = self.x + self.K * self.y
        self._condition(PHt, 0.0)

    def measurement(self, x: FloatArray, block: Block) -> tuple[float, FloatArray, float]:
        """Return the voltage at a state [V], its gradient H and the variance R [V²]."""
        model, noise = self.model, self.model.noise
        A = model.noise.cold(block.temperature_c)
        volts, slope = model.pseudo_ocv_at(float(x[SOC]), block.drives)
        slope = max(slope, LEAST_SLOPE)
        axis_v = noise.soc_std_pct * slope
        H = np.empty_like(x)
        H[SOC], H[OFFSET], H[SLOW] = slope, 0.0, A
        H[LEVEL] = math.hypot(A * noise.level_std_v, axis_v)
        H[FUNCTIONS:] = model.functions.row(float(x[SOC]), block.load)
        volts += float(block.load @ model.load_coefficients + H[SLOW:] @ x[SLOW:])
        return volts, H, (A * noise.fast_std_v) ** 2 + axis_v**2

    def soc_after(
        self, seconds: float, discharged_pct: float, variance_pct2: float = 0.0
    ) -> tuple[float, float]:
        """Return the predicted SoC and its variance [%, %²] without changing the state.

        The variance contains the square of the error that the learned capacity and resistance
        imply for the SoC, which counts with those of the model.
        """
        a = 100.0 * seconds / (3600.0 * self.model.capacity_ah)
        x, P = self.x, self.P
        variance = P[SOC, SOC] + 2.0 * a * P[SOC, OFFSET] + a * a * P[OFFSET, OFFSET]
        variance += DRIFT_PCT2_PER_S * seconds + variance_pct2
        variance += (self.bias.V[SOC] @ self.bias.b) ** 2
        return float(x[SOC] + a * x[OFFSET] - discharged_pct), float(variance)

    @property
    def normalised_innovation_squared(self) -> float:
        """Square of the last innovation over its variance; χ² with one degree under the model."""
        return float(self.y**2 / self.S)

    def is_valid(self) -> bool:
        """Return whether state and variances are usable numbers."""
        is_finite = math.isfinite(self.evidence) and np.all(np.isfinite(self.x))
        is_finite = is_finite and np.all(np.isfinite(self.P))
        return bool(is_finite and np.all(np.diag(self.P) > 0.0))

    def strain(self) -> float:
        """Return Σ (learned/prior σ)² of offset, level, functions, capacity and resistance.

        Under the model its distribution is at most χ² with as many degrees of freedom, n + 4.
        """
        learned = np.concatenate(
            ([self.x[OFFSET] / OFFSET_STD_A], self.x[LEVEL:], self.bias.relative)
        )
        return float(learned @ learned)

    def joint(self) -> tuple[FloatArray, FloatArray]:
        """Return state and covariance with the biases' corrections, followed by the biases."""
        V, b, Pb = self.bias.V, self.bias.b, self.bias.P
        x = np.concatenate((self.x + V @ b, b))
        return x, np.block([[self.P + V @ Pb @ V.T, V @ Pb], [Pb @ V.T, Pb]])

    def snapshot(self) -> FilterState:
        """Return a copy of everything needed to continue."""
        return FilterState(
            x=self.x.tolist(), p=self.P.tolist(), evidence=self.evidence, bias=self.bias.snapshot()
        )

    def restore(self, state: FilterState) -> Self:
        """Continue from a state of the same model; return self."""
        self.x, self.P = np.array(state.x), np.array(state.p)
        self.evidence = state.evidence
        self.bias.restore(state.bias)
        return self

    def take_over(self, before: SocFilter) -> None:
        """Take over offset and capacity from the filter of another model, before any update."""
        x, P = before.joint()
        self.x[OFFSET], self.P[OFFSET, OFFSET] = x[OFFSET], P[OFFSET, OFFSET]
        self.bias.take_over(before.bias, self.model.capacity_ah / before.model.capacity_ah)

    def _condition(self, PHt: FloatArray, drop_v: float) -> None:
        """Update covariance and biases after the state."""
        P = self.P - np.outer(self.K, PHt)
        self.P = 0.5 * (P + P.T)
        self.bias.update(self.H, self.K, self.y, self.S, drop_v)


def inverse_std_pct(
    model: OnlineModel, soc_pct: float, temperature_c: float, load: FloatArray
) -> float:
    """Return the standard deviation of the SoC by inverse of one row's voltage [%]."""
    noise, A = model.noise, model.noise.cold(temperature_c)
    slope = max(model.pseudo_ocv_at(soc_pct)[1], LEAST_SLOPE)
    row = model.functions.row(soc_pct, load)
    variance = row @ row + A**2 * (
        noise.level_std_v**2 + noise.slow_std_v**2 + noise.residual_std_v**2
    )
    return min(math.hypot(math.sqrt(variance) / slope, noise.soc_std_pct), UNKNOWN_STD_PCT)

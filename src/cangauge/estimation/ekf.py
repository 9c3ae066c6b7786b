"""Extended Kalman filter of the voltage model and Coulomb counting.

The state x = (S, o, b, l, g, a, c1 … ck) is the SoC S [%], the current sensor's offset o [A]
(measured = true + o), a slow and a lasting error of the voltage b and l [V], the relative error g
of the charge per % SoC (true capacity = C/(1 + g)), and standard normal amplitudes of the model's
own errors: of the temperature coefficient (a), and of the principal functions φ of the pseudo-OCV's
error (c).

    S ← S − (1 + g)·ΔQ + 100/(3600·C)·o·Δt,   ΔQ the counted charge [%]
    U = OCV(S) + kt·(T − T_r) + Σ Rj·(I(t − dj) − o) + b + l + a·σ_kt·(T − T̄)
        + Σ ck·φk(S) + fast error

b and l are Gauss–Markov processes; all sizes come from the identification's error model
(`inference.error_model`). The lasting error l may be another after the time and the charge of a
log, the errors it was identified on. What the current before the first sample left behind, in the
delay line or in an effect, is noise of the voltages that share it (`measurement_noise`).

The error of the resistance over temperature adds its variance to b. It is no state: a filter that
takes it for the same part of the drop throughout reads the SoC from how the voltage follows the
load.

a and c are *considered*: the filter keeps their covariance with the other states, so that the
SoC's standard deviation contains the error of the curve wherever the SoC moves, but does not learn
them: from one drive the shape of a curve is not separable from errors of the charge, and a filter
that tries believes a wrong shape more than a wrong level (Schmidt–Kalman filter; Jazwinski,
Stochastic Processes and Filtering Theory, 1970, ch. 8.4). A correction by more than `LINEAR_PCT`
is iterated (ibid., ch. 8.3).

References
----------
Plett, Extended Kalman filtering for battery management systems, J. Power Sources 134 (2004).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from cangauge._arithmetic import dot
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.estimation.measurement_noise import CurveFunctions, Measurement
from cangauge.estimation.state import EkfState
from cangauge.model.model_file import ModelNoise
from cangauge.model.voltage_model import Curve

OFFSET_STD_PER_AH = 0.025
"""Prior standard deviation of the current offset, per Ah of capacity [A/Ah] (1.5 A at 60 Ah)."""

OFFSET_WALK_PER_SQRT_H = 0.1
"""Random walk of the offset, in prior standard deviations per √hour."""

CAPACITY_STD = 0.05
"""Relative standard deviation of the capacity: cells age and cool."""

UNKNOWN_SOC_STD_PCT = 30.0
"""Standard deviation of an unknown SoC [%] (uniform over 0–100: 29 %)."""

PERSISTENT_S = 60.0
"""Memory of the mean innovation, which separates lasting from passing contradictions [s]."""

PERSISTENT_SIGMAS = 4.5
"""A mean innovation beyond this many of its standard deviations contradicts the state."""

OUTLIER_SIGMAS = 5.0
"""For a single innovation beyond this the measurement noise is raised to its size."""

RESTED_BIAS = 0.6
"""The slow error after a long rest, in units of its standard deviation while driving."""

LOWEST_PCT, HIGHEST_PCT = -10.0, 110.0
"""Bounds of the SoC inside the filter [%]. The estimate is within 0–100; the filter is not, or at
an end of the curve it would attribute what the clipped SoC cannot explain to its other states."""

LINEAR_PCT = 1.0
ITERATIONS_AT_MOST = 8
"""A correction by more than the first [%] is repeated, linearized at its own result, up to the
second number of times (iterated extended Kalman filter; Jazwinski 1970, ch. 8.3)."""

LASTING_TIME_S = 7200.0
"""Time constant of a lasting error whose logs are not known [s]: they are seldom longer."""

ROUNDING = 1e-6
"""Tolerance of a covariance's correlations."""

SOC, OFFSET, SLOW, LASTING, CAPACITY, KT = range(6)
"""Index of each state; the curve's functions follow."""

LEARNED: Final = 5
"""Number of states that the voltage corrects; the others are considered."""


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
    capacity_pct = CAPACITY_STD * moved_pct
    return math.sqrt(start_var_pct2 + offset_pct * offset_pct + capacity_pct * capacity_pct)


def full_covariance(rows: Sequence[Sequence[float]]) -> FloatArray:
    """Return the covariance of all states from the rows of the learned ones."""
    learned = np.array(rows)
    covariance = np.eye(learned.shape[1])
    covariance[:, :LEARNED] = learned.T
    covariance[:LEARNED, :LEARNED] = learned[:, :LEARNED]
    covariance[:LEARNED, LEARNED:] = learned[:, LEARNED:]
    return covariance


class SocEkf:
    """Extended Kalman filter; state and equations are in the module's docstring.

    Plain floats: twelve states are too few for arrays to pay.

    Parameters
    ----------
    curve : Curve
        Pseudo-OCV, effects included.
    steady_ohm : float
        Change of the voltage with a lasting current, negative [V/A].
    capacity_ah : float
        Charge from 100 to 0 % [Ah].
    noise : ModelNoise
        Error model of the voltage.

    Attributes
    ----------
    was_outlier : bool
        Whether the last voltage was down-weighted as an outlier.
    """

    def __init__(
        self, curve: Curve, steady_ohm: float, capacity_ah: float, noise: ModelNoise
    ) -> None:
        self._curve = curve
        self._functions = CurveFunctions(noise)
        self._pct_per_as = 100.0 / (3600.0 * capacity_ah)
        self._steady_ohm = steady_ohm
        self._slow_var = noise.slow_std_v * noise.slow_std_v
        self._slow_time_s = noise.slow_time_s
        self._lasting_time_s = noise.lasting_time_s
        self._lasting_pct = noise.lasting_soc_pct
        self._lasting_var = noise.lasting_std_v * noise.lasting_std_v
        self._offset_std_a = OFFSET_STD_PER_AH * capacity_ah
        walk_a = OFFSET_WALK_PER_SQRT_H * self._offset_std_a
        self._walk_var = walk_a * walk_a
        self._mean_innovation_v = 0.0
        self._mean_seconds = 0.0
        self.was_outlier = False
        self._size = KT + 1 + self._functions.number
        self._x = [0.0] * self._size
        # Rows of the covariance of the states that are learned. The considered ones have variance 1
        # and no covariance among each other, always.
        self._p = [[0.0] * self._size for _ in range(LEARNED)]

    def start(self, soc_pct: float, soc_std_pct: float) -> None:
        """Restart from a SoC with its standard deviation [%]."""
        size = self._size
        self._x = [soc_pct, *[0.0] * (size - 1)]
        variances = (
            soc_std_pct * soc_std_pct, self._offset_std_a * self._offset_std_a, self._slow_var,
            self._lasting_var, CAPACITY_STD * CAPACITY_STD,
        )  # fmt: skip
        self._p = [[0.0] * k + [each] + [0.0] * (size - 1 - k) for k, each in enumerate(variances)]
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
        slow_kept = math.exp(-seconds / self._slow_time_s)
        lasting_kept = math.exp(-seconds / self._lasting_time_s - moved_pct / self._lasting_pct)
        self._propagate(
            discharged_pct,
            (self._pct_per_as * (seconds - away_s), -discharged_pct),
            (slow_kept, lasting_kept),
            (
                gap_var_pct2,
                self._walk_var * seconds / 3600.0,
                self._slow_var * (1.0 - slow_kept * slow_kept),
                self._lasting_var * (1.0 - lasting_kept * lasting_kept),
            ),
        )
        self._clip_soc()

    def _propagate(
        self,
        discharged_pct: float,
        by_offset_and_capacity: tuple[float, float],
        kept: tuple[float, float],
        noise: tuple[float, float, float, float],
    ) -> None:
        """Propagate state and covariance: x ← F·x − charge, P ← F·P·Fᵀ + Q.

        Parameters
        ----------
        discharged_pct : float
            Counted charge [%].
        by_offset_and_capacity : pair of float
            Change of the SoC with offset [%/A] and capacity error [%].
        kept : pair of float
            Part of the slow and of the lasting error that is kept.
        noise : four floats
            Variances added to SoC [%²], offset [A²], slow and lasting error [V²].
        """
        x, p = self._x, self._p
        by_offset, by_capacity = by_offset_and_capacity
        slow_kept, lasting_kept = kept
        x[SOC] += by_offset * x[OFFSET] + by_capacity * x[CAPACITY] - discharged_pct
        x[SLOW] *= slow_kept
        x[LASTING] *= lasting_kept
        first = [
            a + by_offset * b + by_capacity * c
            for a, b, c in zip(p[SOC], p[OFFSET], p[CAPACITY], strict=True)
        ]
        first[SOC] += by_offset * first[OFFSET] + by_capacity * first[CAPACITY]
        first[SLOW] *= slow_kept
        first[LASTING] *= lasting_kept
        p[SOC] = first
        for k, factor in ((SLOW, slow_kept), (LASTING, lasting_kept)):
            row = [factor * value for value in p[k]]
            row[SLOW] *= slow_kept
            row[LASTING] *= lasting_kept
            p[k] = row
        # The scaled rows were scaled twice where they cross; set the columns from the rows.
        slow, lasting = p[SLOW], p[LASTING]
        slow[LASTING] = lasting[SLOW]
        slow[SOC], lasting[SOC] = first[SLOW], first[LASTING]
        for k in range(1, len(p)):
            row = p[k]
            row[SOC] = first[k]
            row[SLOW], row[LASTING] = slow[k], lasting[k]
        first[SOC] += noise[0]
        p[OFFSET][OFFSET] += noise[1]
        slow[SLOW] += noise[2]
        lasting[LASTING] += noise[3]

    def update(self, measurement: Measurement, seconds: float) -> bool:
        """Update with one voltage, `seconds` after the last one [s].

        Returns
        -------
        bool
            Whether a lasting contradiction made the SoC unknown again.
        """
        fast_v2 = measurement.std_v * measurement.std_v
        forgotten = -math.expm1(-2.0 * seconds / self._slow_time_s)
        resistance_v = measurement.resistance_std_v
        self._p[SLOW][SLOW] += resistance_v * resistance_v * forgotten
        jacobian, unbiased_v = self._linearized(measurement, self._x[SOC])
        if self._is_contradicted(measurement, unbiased_v, jacobian, seconds):
            offset_a, offset_var = self._x[OFFSET], self._p[OFFSET][OFFSET]
            self.start(self._x[SOC], UNKNOWN_SOC_STD_PCT)
            self._x[OFFSET], self._p[OFFSET][OFFSET] = offset_a, offset_var
            is_contradicted = True
        else:
            is_contradicted = False
        start_pct = at_pct = self._x[SOC]
        for _ in range(ITERATIONS_AT_MOST):
            innovation = measurement.voltage_v - unbiased_v - (self._x[SLOW] + self._x[LASTING])
            spread = self._spread(jacobian)
            of_state = max(dot(spread, jacobian), 0.0)
            corrected_pct = start_pct + spread[SOC] / (of_state + fast_v2) * innovation
            corrected_pct = min(max(corrected_pct, LOWEST_PCT), HIGHEST_PCT)
            if abs(corrected_pct - at_pct) < LINEAR_PCT:
                break
            at_pct = corrected_pct
            jacobian, unbiased_v = self._linearized(measurement, at_pct)
            unbiased_v += jacobian[SOC] * (start_pct - at_pct)
        square = innovation * innovation
        self.was_outlier = square > OUTLIER_SIGMAS * OUTLIER_SIGMAS * (of_state + fast_v2)
        if self.was_outlier:
            fast_v2 = max(fast_v2, square - of_state)
        self._correct(jacobian, spread, innovation, of_state, fast_v2)
        self._clip_soc()
        return is_contradicted

    def _spread(self, jacobian: list[float]) -> list[float]:
        """Return P·Hᵀ of a voltage, to which slow and lasting error count in full."""
        p = self._p
        slope, by_offset, of_model = jacobian[SOC], jacobian[OFFSET], jacobian[LEARNED:]
        spread = [
            slope * a + by_offset * b + c + d
            for a, b, c, d in zip(p[SOC], p[OFFSET], p[SLOW], p[LASTING], strict=True)
        ]
        for k, row in enumerate(p):
            spread[k] += dot(row[LEARNED:], of_model)
        for k, value in enumerate(of_model, LEARNED):
            spread[k] += value
        return spread

    def _linearized(self, measurement: Measurement, soc_pct: float) -> tuple[list[float], float]:
        """Return the Jacobian at a SoC, and the voltage without the model's errors [V]."""
        ocv_v, slope = self._curve.pseudo_ocv_at(soc_pct)
        jacobian = [
            slope, -self._steady_ohm, 1.0, 1.0, 0.0, measurement.kt_std_v,
            *self._functions.at(soc_pct),
        ]  # fmt: skip
        return jacobian, ocv_v + measurement.without_ocv_v - self._steady_ohm * self._x[OFFSET]

    def correct(self, soc_pct: float, std_pct: float) -> None:
        """Update with an external SoC reference and its standard deviation [%]."""
        jacobian = [1.0, *[0.0] * (self._size - 1)]
        spread = list(self._p[SOC])
        self._correct(jacobian, spread, soc_pct - self._x[SOC], spread[SOC], std_pct * std_pct)
        self._clip_soc()

    def _correct(
        self,
        jacobian: Sequence[float],  # noqa: ARG002 - of the reference filter
        spread: list[float],
        innovation: float,
        of_state: float,
        variance: float,
    ) -> None:
        """Correct state and covariance by one measurement.

        Parameters
        ----------
        jacobian : sequence of float
            H, of the measurement by the state.
        spread : list of float
            P·Hᵀ.
        innovation : float
        of_state, variance : float
            H·P·Hᵀ, and the variance of the measurement.
        """
        x, p = self._x, self._p
        total = of_state + variance
        for k, row in enumerate(p):
            gain = spread[k] / total
            x[k] += gain * innovation
            p[k] = [a - gain * b for a, b in zip(row, spread, strict=True)]
        for k in range(1, LEARNED):
            row = p[k]
            for j in range(k):
                row[j] = p[j][k]

    def shrink_bias(self) -> None:
        """Reduce the slow error after a long rest, in which slow polarization has decayed."""
        limit = RESTED_BIAS * RESTED_BIAS * self._slow_var
        p = self._p
        if p[SLOW][SLOW] <= limit:
            return
        shrink = math.sqrt(limit / p[SLOW][SLOW])
        self._x[SLOW] *= shrink
        p[SLOW] = [shrink * value for value in p[SLOW]]
        for row in p:
            row[SLOW] *= shrink
        for k, row in enumerate(p):
            row[SLOW] = p[SLOW][k]

    def snapshot(self) -> EkfState:
        """Return a copy of the state."""
        return EkfState(
            list(self._x),
            [list(row) for row in self._p],
            self._mean_innovation_v,
            self._mean_seconds,
        )

    def restore(self, state: EkfState) -> None:
        """Continue from a state.

        Raises
        ------
        InputError
            If it has another number of variables, or its covariance is not semidefinite.
        """
        size = self._size
        if [len(state.x), *map(len, state.p)] != [size] * (LEARNED + 1):
            raise InputError(f"not a filter of {size} states", field="filter.hypotheses")
        covariance = full_covariance(state.p)
        variance = np.diag(covariance)
        scale = np.sqrt(np.where(variance > 0.0, variance, 1.0))
        correlation = covariance / np.outer(scale, scale)
        if (
            not (variance >= 0.0).all()
            or np.abs(correlation - correlation.T).max() > ROUNDING
            or not np.linalg.eigvalsh(correlation)[0] > -ROUNDING
        ):
            raise InputError("not a positive semidefinite covariance", field="filter.hypotheses")
        self.resume(state)

    def resume(self, state: EkfState) -> None:
        """Continue from a state that this filter had."""
        self._x = list(state.x)
        self._p = [list(row) for row in state.p]
        self._mean_innovation_v = state.mean_innovation_v
        self._mean_seconds = state.mean_seconds

    def is_valid(self) -> bool:
        """Return whether the state is finite, and no variance negative."""
        return all(
            row[k] >= 0.0 and abs(value) < math.inf
            for k, (row, value) in enumerate(zip(self._p, self._x, strict=False))
        )

    @property
    def soc_pct(self) -> float:
        """State of charge [%], within 0–100."""
        return self._x[SOC]

    @property
    def offset_a(self) -> float:
        """Estimated offset of the current sensor [A]."""
        return self._x[OFFSET]

    @property
    def offset_std_a(self) -> float:
        """Standard deviation of that offset [A]."""
        return math.sqrt(max(self._p[OFFSET][OFFSET], 0.0))

    @property
    def bias_v(self) -> float:
        """Estimated error of the voltage in time, slow and lasting [V]."""
        return self._x[SLOW] + self._x[LASTING]

    @property
    def strain(self) -> float:
        """Largest of offset, lasting bias and capacity error, in prior standard deviations."""
        x = self._x
        lasting_std = math.sqrt(self._lasting_var)
        lasting = abs(x[LASTING]) / lasting_std if lasting_std > 0.0 else 0.0
        return max(abs(x[OFFSET]) / self._offset_std_a, abs(x[CAPACITY]) / CAPACITY_STD, lasting)

    def summary(self, counted_s: float) -> tuple[float, float, float]:
        """Return SoC, its standard deviation, and the charge that the offset adds in a time [%]."""
        x = self._x
        std_pct = math.sqrt(max(self._p[SOC][SOC], 0.0))
        return x[SOC], std_pct, self._pct_per_as * counted_s * x[OFFSET]

    def _is_contradicted(
        self, measurement: Measurement, unbiased_v: float, jacobian: list[float], seconds: float
    ) -> bool:
        """Return whether the mean error of the prediction contradicts state and error model.

        Parameters
        ----------
        measurement : Measurement
        unbiased_v : float
            Predicted voltage, without the errors that the filter attributes [V].
        jacobian : list of float
        seconds : float
            Time since the last voltage [s].
        """
        if seconds > PERSISTENT_S:
            # After an interval without voltages, earlier innovations carry no information.
            self._reset_innovations()
            return False
        weight = math.exp(-seconds / PERSISTENT_S)
        self._mean_innovation_v *= weight
        self._mean_innovation_v += (1.0 - weight) * (measurement.voltage_v - unbiased_v)
        self._mean_seconds += seconds
        if self._mean_seconds < PERSISTENT_S:
            return False
        of_model = jacobian[KT:]
        mean_var = self._slow_var + self._lasting_var + dot(of_model, of_model)
        slope, fast_v = jacobian[SOC], measurement.std_v
        resistance_v = measurement.resistance_std_v
        mean_var += slope * slope * self._p[SOC][SOC] + resistance_v * resistance_v
        mean_var += fast_v * fast_v * seconds / (2.0 * PERSISTENT_S)
        seen = 1.0 - math.exp(-self._mean_seconds / PERSISTENT_S)
        mean = self._mean_innovation_v / seen
        return mean * mean > PERSISTENT_SIGMAS * PERSISTENT_SIGMAS * mean_var

    def _reset_innovations(self) -> None:
        self._mean_innovation_v = 0.0
        self._mean_seconds = 0.0

    def _clip_soc(self) -> None:
        self._x[SOC] = min(max(self._x[SOC], LOWEST_PCT), HIGHEST_PCT)

"""Error model of the voltage: fast, slow, lasting, and the error of the curve itself.

The measured voltage of log l at time t is

    U = model + e(S) + (T − T̄)·a + (T − T̄)·D·b + Σj I(t − dj)·rj + w_l + z(t) + v(t)

with the error e of the pseudo-OCV over SoC, the errors a of the temperature coefficient, b of the
resistance over temperature and rj of the resistances (D is the model's drop), and three errors in
time: w lasts as long as a log, z is slow and v fast (Gauss–Markov processes). e, a, b and rj are
the same in all logs and have physical priors. The sizes and time constants of v, z and w maximise
the restricted likelihood: that of the residuals with e, a, b and rj integrated out (Patterson,
Thompson, Biometrika 58 (1971) 545). It is computed in a Haar transform of each log, whose
coefficients of one time scale have about equal variance and little correlation (Wornell, Proc.
IEEE 81 (1993) 1428), from the scales' normal equations alone.

Few logs show a lasting error badly, and one log not at all. The variances of the slow and the
lasting part are therefore posterior means over a grid, with half-normal priors: with few logs they
are wide. The slow error of a next log is in part the prior's too, as if one more log had shown it:
logs differ, and one whose errors are white does not prove that the next one's are.

The posterior covariance of e is wide where no log has been, whatever the residuals are. Its leading
principal functions are what the estimator carries.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from cangauge._typing import FloatArray
from cangauge.inference.rows import row_blocks, stacked_columns
from cangauge.inference.time_scales import HaarBlocks

SCALES: Final = 14
"""Time scales: stretches of 2, 4, … 16,384 rows; longer ones count as the last."""

KNOTS_PCT: Final = np.concatenate((np.arange(0.0, 15.0, 2.5), np.arange(15.0, 101.0, 5.0)))
"""SoC between which the error of the curve is interpolated [%]; closer near empty, at the knee."""

PART_STD: Final = 0.003
"""Prior standard deviation of the slow and of the lasting error, relative to the voltage: the
accuracy of a vehicle's voltage sensor."""

PRIOR_LOGS: Final = 1.0
"""Weight of that prior in the slow error of a log to come, in logs: the least that keeps one log
from deciding alone. The standard deviations of logs are log-normal, so their mean is geometric."""

LEVEL_STD: Final = 0.2
"""Prior standard deviation of the curve's level, relative to the voltage: not known."""

SLOPE_MEAN, SLOPE_STD = 1.5e-3, 1.0e-3
"""Prior mean and standard deviation of the curve's slope, relative to the voltage [1/%]. Cells of
NMC, NCA and LMO rise by 0.1–0.3 % of their voltage per % SoC, LFP by 0.01–0.05 % (open-circuit
voltages in Plett, Battery Management Systems I, 2015, ch. 2)."""

RESOLUTION: Final = 1e-4
"""Least standard deviation of the fast error, relative to the voltage: that of a voltage reported
in steps of 0.1 V at 360 V is 0.8e-4."""

SLOPE_SPAN_PCT: Final = 20.0
"""SoC over which the slope decorrelates [%]: the width of the features of a pseudo-OCV (phases of
graphite, plateaus)."""

KNEE_STD, KNEE_SPAN_PCT = 0.08, 5.0
"""Prior standard deviation of the knee at empty, relative to the voltage, and the SoC over which it
fades and bends [%]: a cell falls by 0.3 V in the last 5 %."""

FINE_STD: Final = 5e-4
"""Prior standard deviation of features narrower than the knots, relative to the voltage."""

KT_STD_PER_K: Final = 2.5e-4
"""Prior standard deviation of the temperature coefficient's error, relative to the voltage [1/K]:
1 mV/K per cell, a few times the entropic coefficient."""

RESISTANCE_STD: Final = 0.3
"""Prior relative standard deviation of the resistances' error."""

RESISTANCE_STD_PER_K: Final = 0.03
"""Prior standard deviation of the resistance's relative change with temperature [1/K]: 20–30 kJ/mol
of activation energy give 2.7–4 % per K (Waag, Käbitz, Sauer, Appl. Energy 102 (2013) 885)."""

CURVE_FROM_S: Final = 100.0
"""Shortest stretch of time whose voltage says something of the curve [s]: over shorter ones, and
the 70 s of the delayed currents, polarization of the same sign as a slope is larger."""

FUNCTIONS_AT_MOST: Final = 5
EXPLAINED: Final = 0.98
"""Principal functions of the curve's error: as many as explain this part of its variance on average
over SoC; the rest is added to each so that no variance is lost."""

GRID: Final = np.geomspace(0.05, 6.0, 13)
"""Grid of the standard deviations of slow and lasting error, relative to their prior's."""

FAST_TIME_S: Final = (0.0, 30.0)
SLOW_TIME_S: Final = (60.0, 600.0)
"""Bounds of the time constants [s]: the delay line covers 70 s, trips last half an hour. That of
the slow part has a log-normal prior between them (±2σ), for logs that show no slow error."""


@dataclass(frozen=True)
class TimeError:
    """Parts of the voltage error in time."""

    fast_std_v: float
    """Standard deviation of the fast part [V]."""
    fast_time_s: float
    """Time constant of the fast part [s]; 0 if white."""
    slow_std_v: float
    """Standard deviation of the slow part [V]."""
    slow_time_s: float
    """Time constant of the slow part [s]."""
    lasting_std_v: float
    """Standard deviation of the part that lasts as long as a log [V]."""


@dataclass(frozen=True, eq=False)
class CurveError:
    """Error of the curve over SoC and temperature."""

    soc_pct: FloatArray
    """Knots, shape (m,) [%]."""
    function_v: FloatArray
    """Principal functions: independent, with standard deviation 1, shape (k, m) [V]."""
    temperature_c: float
    """Mean temperature of the logs [°C]."""
    kt_std_v_per_k: float
    """Standard deviation of the temperature coefficient [V/K]."""
    resistance_std_per_k: float
    """Standard deviation of the resistance's relative change with temperature [1/K]."""


@dataclass(frozen=True, eq=False)
class LogResidual:
    """Residual of one log with what the model's errors depend on; arrays of shape (n,)."""

    residual_v: FloatArray
    """Measured minus predicted voltage [V]."""
    soc_pct: FloatArray
    temperature_c: FloatArray
    delayed_current_a: FloatArray
    """Shape (n, delays) [A]."""

    def part(self, rows: slice) -> LogResidual:
        """Return some of the rows."""
        return LogResidual(**{name: values[rows] for name, values in vars(self).items()})


@dataclass(frozen=True, eq=False)
class ErrorEquations:
    """Normal equations of logs by time scale; those of several logs add up.

    Parameters
    ----------
    rows : array of shape (logs,)
        Rows of each log.
    means : array of shape (logs, p + 1)
        Haar coefficient of each log's mean.
    counts : array of shape (SCALES,)
        Coefficients of each scale, without the means.
    products : array of shape (SCALES, p + 1, p + 1)
        Their sums of products.
    """

    rows: FloatArray
    means: FloatArray
    counts: FloatArray
    products: FloatArray

    @classmethod
    def of_blocks(cls, blocks: Iterable[FloatArray], finest: int = 1) -> ErrorEquations:
        """Return the equations of one log from blocks of its table (`HaarBlocks.add`).

        Parameters
        ----------
        blocks : iterable of arrays of shape (m, p + 1)
            Columns of the shared errors, residual.
        finest : int
            Rows of the shortest stretches of which the columns count, a power of two; of shorter
            ones only the residual's squares do.
        """
        table, residual = HaarBlocks(SCALES, finest), HaarBlocks(SCALES)
        fast = finest.bit_length() - 1
        sums: list[FloatArray] = []
        counts, rows = np.zeros(SCALES), 0
        for block in itertools.chain(blocks, [None]):
            of_table = table.end() if block is None else table.add(block)
            of_residual = residual.end() if block is None else residual.add(block[:, -1:])
            of_scale = [*of_residual[:fast], *of_table[fast:]]
            rows += 0 if block is None else len(block)
            counts += [len(each) for each in of_scale]
            if not sums:
                sums = [np.zeros((of_table[-1].shape[1],) * 2) for _ in range(SCALES)]
            for j, each in enumerate(of_scale):
                width = each.shape[1]
                sums[j][-width:, -width:] += each.T @ each
        mean = of_table[-1][-1]
        counts[-1] -= 1.0
        sums[-1] -= np.outer(mean, mean)
        return cls(np.array([float(rows)]), mean[None], counts, np.array(sums))

    @classmethod
    def of_tables(cls, tables: Sequence[FloatArray]) -> ErrorEquations:
        """Return the equations of tables, shape (n, p + 1): one of each log, in order of time."""
        return cls.of_all([cls.of_blocks([table]) for table in tables])

    @classmethod
    def of_all(cls, parts: Sequence[ErrorEquations]) -> ErrorEquations:
        """Return the equations of several logs together."""
        return cls(
            rows=np.concatenate([each.rows for each in parts]),
            means=np.vstack([each.means for each in parts]),
            counts=np.sum([each.counts for each in parts], axis=0),
            products=np.sum([each.products for each in parts], axis=0),
        )


class RestrictedLikelihood:
    """Restricted likelihood of the errors in time, from normal equations by time scale.

    Parameters
    ----------
    logs : ErrorEquations
    prior_mean : array of shape (p,)
    prior_precision : array of shape (p, p)
    rate_hz : float
        Rate of the rows.
    """

    def __init__(
        self,
        logs: ErrorEquations,
        prior_mean: FloatArray,
        prior_precision: FloatArray,
        rate_hz: float,
    ) -> None:
        self._rate_hz = rate_hz
        self._prior = prior_precision
        self._rows, self._counts = logs.rows, logs.counts
        self._means, self._products = logs.means, logs.products.copy()
        # Only the residual's own squares count at scales that the delayed currents explain.
        fast = np.arange(SCALES) < fast_scales(rate_hz)
        self._products[fast, :-1, :] = 0.0
        self._products[fast, :, :-1] = 0.0
        # Relative to the prior mean.
        self._prior_mean = prior_mean
        shift = np.eye(prior_mean.size + 1)
        shift[:-1, -1] = -prior_mean
        self._means = self._means @ shift
        self._products[~fast] = shift.T @ self._products[~fast] @ shift

    def variances(self, error: TimeError) -> tuple[FloatArray, FloatArray]:
        """Return the variances of the coefficients of each scale, and of each log's mean [V²]."""
        fast, slow = error.fast_time_s * self._rate_hz, error.slow_time_s * self._rate_hz
        scale_v2 = haar_variances(error.fast_std_v**2, fast) + haar_variances(
            error.slow_std_v**2, slow
        )
        mean_v2 = error.lasting_std_v**2 * self._rows
        for variance, rows in ((error.fast_std_v**2, fast), (error.slow_std_v**2, slow)):
            mean_v2 = mean_v2 + variance * variance_of_sum(self._rows, rows) / self._rows
        return scale_v2, mean_v2

    def normal_equations(self, error: TimeError) -> FloatArray:
        """Return the weighted normal equations with the residual, shape (p + 1, p + 1)."""
        scale_v2, mean_v2 = self.variances(error)
        total = np.tensordot(1.0 / scale_v2, self._products, axes=1)
        return np.asarray(total + (self._means.T / mean_v2) @ self._means)

    def log_likelihood(self, error: TimeError) -> float:
        """Return the restricted log likelihood, up to a constant."""
        scale_v2, mean_v2 = self.variances(error)
        total = self.normal_equations(error)
        root = np.linalg.cholesky(self._prior + total[:-1, :-1])
        explained = np.linalg.solve(root, total[:-1, -1])
        return -0.5 * float(
            self._counts @ np.log(scale_v2)
            + np.sum(np.log(mean_v2))
            + 2.0 * np.sum(np.log(np.diag(root)))
            + total[-1, -1]
            - explained @ explained
        )

    def posterior(self, error: TimeError) -> tuple[FloatArray, FloatArray]:
        """Return mean (p,) and covariance (p, p) of the shared errors.

        All scales get the variance of the slowest one: a faster error is correlated with the
        current, and looks like a slope of the curve. This is the information of least squares,
        with one independent row per correlation time.
        """
        scale_v2, mean_v2 = self.variances(error)
        slowest_v2 = float(scale_v2[-1])
        total = np.sum(self._products, axis=0) / slowest_v2
        total += (self._means.T / np.maximum(mean_v2, slowest_v2)) @ self._means
        covariance = np.linalg.inv(self._prior + total[:-1, :-1])
        return self._prior_mean + covariance @ total[:-1, -1], covariance


def fit_time_error(
    log_likelihood: Callable[[TimeError], float], usual_v: float, voltage_v: float
) -> TimeError:
    """Return the errors in time: the fast part by maximum, slow and lasting by posterior mean.

    Parameters
    ----------
    log_likelihood : callable
    usual_v : float
        Root mean square of the residuals [V]: where the search starts.
    voltage_v : float
        Of the pack [V], for the priors.
    """
    prior_v = PART_STD * voltage_v

    def error_at(x: FloatArray) -> TimeError:
        fast, slow, lasting = (usual_v * math.exp(float(value)) for value in x[:3])
        fast = max(fast, RESOLUTION * voltage_v)
        low, high = SLOW_TIME_S
        return TimeError(
            fast,
            FAST_TIME_S[1] / (1.0 + math.exp(-float(x[3]))),
            slow,
            low * (high / low) ** (1.0 / (1.0 + math.exp(-float(x[4])))),
            lasting,
        )

    def log_prior(error: TimeError) -> float:
        low, high = SLOW_TIME_S
        times = math.log(error.slow_time_s**2 / (low * high)) / math.log(high / low)
        square = (error.slow_std_v / prior_v) ** 2 + (error.lasting_std_v / prior_v) ** 2
        return -0.5 * (square + (2.0 * times) ** 2)

    def objective(x: FloatArray) -> float:
        if np.abs(x).max() > 12.0:
            return 1e300
        error = error_at(x)
        return -log_likelihood(error) - log_prior(error)

    starts = [np.array([-1.0, slow, slow, -2.0, 0.0]) for slow in (-1.0, 0.0)]
    found = min(
        (
            minimize(
                objective, start, method="Nelder-Mead",
                options={
                    "maxiter": 600, "xatol": 1e-2, "fatol": 1e-2,
                    "initial_simplex": np.vstack([start, start + np.eye(5)]),
                },
            )
            for start in starts
        ),
        key=lambda item: float(item.fun),
    )  # fmt: skip
    best = error_at(found.x)
    grid = prior_v * GRID
    # Prior in log steps of the grid: the density over σ times σ.
    trials = [
        TimeError(best.fast_std_v, best.fast_time_s, slow, best.slow_time_s, lasting)
        for slow, lasting in itertools.product(grid, grid)
    ]
    log_weight = np.array(
        [
            log_likelihood(item) + log_prior(item)
            + math.log(item.slow_std_v * item.lasting_std_v)
            for item in trials
        ]
    )  # fmt: skip
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    slow_v2 = float(weight @ [item.slow_std_v**2 for item in trials])
    lasting_v2 = float(weight @ [item.lasting_std_v**2 for item in trials])
    return TimeError(
        best.fast_std_v,
        best.fast_time_s,
        math.sqrt(slow_v2),
        best.slow_time_s,
        math.sqrt(lasting_v2),
    )


def describe_error(
    logs: Sequence[LogResidual],
    ocv_v: FloatArray,
    resistance_ohm: Sequence[float],
    rate_hz: float,
) -> tuple[TimeError, CurveError]:
    """Return the error model of a fitted model.

    Parameters
    ----------
    logs : sequence of LogResidual
    ocv_v : array of shape (m,)
        The model's pseudo-OCV at `KNOTS_PCT` [V].
    resistance_ohm : sequence of float
        Rj [Ω], negative.
    rate_hz : float
        Rate of the rows.
    """
    mean_c = float(np.mean(np.concatenate([log.temperature_c for log in logs])))
    parts = [error_equations(log, mean_c, resistance_ohm, rate_hz) for log in logs]
    residual_v = np.concatenate([log.residual_v for log in logs])
    return describe_error_of(
        ErrorEquations.of_all(parts),
        rms_v=float(np.sqrt(np.mean(residual_v**2))),
        mean_c=mean_c,
        ocv_v=ocv_v,
        resistance_ohm=resistance_ohm,
        rate_hz=rate_hz,
    )


def fast_scales(rate_hz: float) -> int:
    """Return the number of scales too short for the curve's error (`CURVE_FROM_S`)."""
    return int(np.sum(2.0 ** np.arange(1, SCALES + 1) < CURVE_FROM_S * rate_hz))


def error_equations(
    log: LogResidual, mean_c: float, resistance_ohm: Sequence[float], rate_hz: float
) -> ErrorEquations:
    """Return the normal equations that the error model is estimated from, of one log.

    Parameters
    ----------
    log : LogResidual
    mean_c : float
        Mean temperature of all logs [°C].
    resistance_ohm : sequence of float
        Rj [Ω], negative.
    rate_hz : float
        Rate of the rows.
    """
    blocks = (
        stacked_columns(_columns(part, mean_c, resistance_ohm), part.residual_v)
        for part in map(log.part, row_blocks(len(log.residual_v)))
    )
    return ErrorEquations.of_blocks(blocks, 2 ** fast_scales(rate_hz))


def describe_error_of(
    equations: ErrorEquations,
    *,
    rms_v: float,
    mean_c: float,
    ocv_v: FloatArray,
    resistance_ohm: Sequence[float],
    rate_hz: float,
) -> tuple[TimeError, CurveError]:
    """Return the error model from the normal equations of all logs; else as `describe_error`.

    Parameters
    ----------
    equations : ErrorEquations
    rms_v : float
        Root mean square of the residuals [V].
    mean_c : float
        Mean temperature of all logs [°C].
    ocv_v, resistance_ohm, rate_hz
    """
    voltage_v = float(np.mean(ocv_v))
    prior = np.zeros((equations.means.shape[1] - 1,) * 2)
    m = KNOTS_PCT.size
    curve_mean, curve_covariance = curve_prior(voltage_v)
    prior_mean = np.zeros(len(prior))
    prior_mean[:m] = curve_mean - ocv_v
    prior[:m, :m] = np.linalg.inv(curve_covariance)
    total_ohm = abs(sum(resistance_ohm)) or 1e-3
    scales = [KT_STD_PER_K * voltage_v, RESISTANCE_STD_PER_K]
    scales += [RESISTANCE_STD * total_ohm] * len(resistance_ohm)
    prior[np.arange(m, len(prior)), np.arange(m, len(prior))] = np.array(scales) ** -2.0
    likelihood = RestrictedLikelihood(equations, prior_mean, prior, rate_hz)
    usual_v = max(rms_v, 1e-6 * voltage_v)
    error = fit_time_error(likelihood.log_likelihood, usual_v, voltage_v)
    mean, covariance = likelihood.posterior(error)
    weight = PRIOR_LOGS / (PRIOR_LOGS + len(equations.rows))
    next_slow_v = (PART_STD * voltage_v) ** weight * error.slow_std_v ** (1.0 - weight)
    error = replace(error, slow_std_v=next_slow_v)
    # A mean that the model does not contain is an error, too.
    second = covariance + np.outer(mean, mean)
    return error, CurveError(
        KNOTS_PCT,
        principal_functions(second[:m, :m]),
        mean_c,
        math.sqrt(second[m, m]),
        math.sqrt(second[m + 1, m + 1]),
    )


def curve_prior(voltage_v: float, soc_pct: FloatArray = KNOTS_PCT) -> tuple[FloatArray, FloatArray]:
    """Return the prior mean [V] and covariance [V²] of a pseudo-OCV.

    Level, slope and knee are independent. The slope is a Gaussian process over SoC with a squared
    exponential covariance; its integral is the curve.

    Parameters
    ----------
    voltage_v : float
        Of the pack [V].
    soc_pct : array of shape (m,)
        Increasing SoC [%].
    """
    step_pct = np.diff(soc_pct)
    middle = 0.5 * (soc_pct[1:] + soc_pct[:-1])
    apart = (middle[:, None] - middle) / SLOPE_SPAN_PCT
    of_steps = (SLOPE_STD * voltage_v) ** 2 * np.exp(-0.5 * apart**2)
    integral = np.vstack([np.zeros(middle.size), np.tri(middle.size)]) * step_pct
    knee = KNEE_STD * voltage_v * np.exp(-soc_pct / KNEE_SPAN_PCT)
    apart = (soc_pct[:, None] - soc_pct) / KNEE_SPAN_PCT
    # The level is that of the middle of the curve.
    centre = np.eye(soc_pct.size)
    centre[:, soc_pct.size // 2] -= 1.0
    prior = centre @ (integral @ of_steps @ integral.T) @ centre.T
    prior += (LEVEL_STD * voltage_v) ** 2 + np.outer(knee, knee) * np.exp(-0.5 * apart**2)
    prior[np.diag_indices_from(prior)] += (FINE_STD * voltage_v) ** 2
    mean = voltage_v * (1.0 + SLOPE_MEAN * (soc_pct - soc_pct[soc_pct.size // 2]))
    return mean, prior


def principal_functions(covariance: FloatArray) -> FloatArray:
    """Return functions F with FᵀF close to a covariance, and equal to it on the diagonal.

    The principal components of the correlation; those left out are made up for by scaling.
    """
    std = np.sqrt(np.diag(covariance))
    value, vector = np.linalg.eigh(covariance / np.outer(std, std))
    value, vector = np.maximum(value[::-1], 0.0), vector[:, ::-1]
    explained = np.cumsum(value) / value.sum()
    number = min(int(np.searchsorted(explained, EXPLAINED)) + 1, FUNCTIONS_AT_MOST)
    functions = (vector[:, :number] * np.sqrt(value[:number])).T
    return np.asarray(functions / np.linalg.norm(functions, axis=0) * std)


def haar_variances(variance_v2: float, rows: float) -> FloatArray:
    """Return the variance of the Haar coefficients of an exponentially correlated error.

    Parameters
    ----------
    variance_v2 : float
        Its variance [V²].
    rows : float
        Correlation length in rows; 0 is white.

    Returns
    -------
    array of shape (SCALES,)
    """
    half = 2.0 ** np.arange(SCALES)
    sums = 4.0 * variance_of_sum(half, rows) - variance_of_sum(2.0 * half, rows)
    return np.asarray(variance_v2 * sums / (2.0 * half))


def variance_of_sum(n: NDArray[np.floating[Any]], rows: float) -> FloatArray:
    """Return the variance of a sum of n rows of unit variance, correlated over `rows` rows."""
    kept = math.exp(-1.0 / rows) if rows > 1e-3 else 0.0
    return n * (1.0 + kept) / (1.0 - kept) - 2.0 * kept * (1.0 - kept**n) / (1.0 - kept) ** 2


def _columns(log: LogResidual, mean_c: float, resistance_ohm: Sequence[float]) -> FloatArray:
    """Return knots of the curve, kt, resistance over temperature, and resistances."""
    soc = np.clip(log.soc_pct, KNOTS_PCT[0], KNOTS_PCT[-1])
    at = np.clip(np.searchsorted(KNOTS_PCT, soc, side="right") - 1, 0, KNOTS_PCT.size - 2)
    part = (soc - KNOTS_PCT[at]) / (KNOTS_PCT[at + 1] - KNOTS_PCT[at])
    hats = np.zeros((KNOTS_PCT.size, soc.size)).T
    row = np.arange(soc.size)
    hats[row, at], hats[row, at + 1] = 1.0 - part, part
    warmer_k = log.temperature_c - mean_c
    drop_v = log.delayed_current_a @ np.array(resistance_ohm)
    return stacked_columns(hats, warmer_k, warmer_k * drop_v, log.delayed_current_a)

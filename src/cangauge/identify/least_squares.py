"""Posterior of the curve of knots and its loads: weighted least squares with a Gaussian prior.

    U = g(S) + kt·(T − T_r) + Σm Rm·Im + b·(a(T)/a(T̄) − 1)·Σm R⁰m·Im + Σe αe·xe + level + noise

The fit needs of a log only its second moments (`LogSums`): those of several logs are a sum. The
weight of a row is its time. It is less where the log has many rows within the same percent of SoC,
and where the curve is so steep that the error of SoC dominates. The rows of a minute together count
as one independent datum. The level of each log is eliminated. R⁰ are the resistances of the
iteration before, so the equation is linear. The noise variance is a fixed point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.identify.rows import FitRows
from cangauge.model.curve import KNOTS_PCT, hermite_basis
from cangauge.model.prior import RESIDUAL_STD, RESISTANCE_H, Chemistry, Distribution, PackPrior
from cangauge.model.voltage_model import REFERENCE_C, resistance_factor

N: Final = KNOTS_PCT.size
"""Knots of the curve."""
M: Final = len(RESISTANCE_H)
"""Currents: delayed and low-passed."""
P: Final = N + 1 + M + 1
"""Coefficients: knots, kt, resistances, b."""
BASE: Final = N + 1 + 2 * M
"""Columns of the moments before those of effects: curve, T − T_r, currents, a(T)·currents."""

SECONDS_PER_DATUM: Final = 60.0
"""Time that counts as one independent datum [s]: residuals of recorded trips correlate by 0.8 at
1 s and 0.3–0.5 at 60 s."""
SECONDS_PER_PERCENT: Final = 600.0
"""Most time that one log may count within one percent of SoC [s]: rests and charging at constant
voltage repeat themselves."""
ADDED_STD: Final = 0.0015
"""Error of the model added to the residuals, relative to the mean voltage: residuals of few logs
are too small (development packs)."""
B_LEFT_STD: Final = 0.25
"""Spread of b that no log settles [-]: the activation energy differs between cells."""
LEFT_OUT_PRIOR: Final = 2.0
"""Logs that the prior counts as when left-out logs scale the covariance."""
LOGS_AT_LEAST: Final = 3
"""Logs from which on they are left out in turn."""
FOLDS_AT_MOST: Final = 40
"""Groups of logs that are left out; with more logs several are left out together."""


@dataclass(frozen=True, eq=False)
class LogSums:
    """Weighted second moments of one log: all that the fit needs of it.

    Parameters
    ----------
    moments : array of shape (q, q)
        Of curve, T − T_r, currents, a(T)·currents, effects' columns, 1 and voltage.
    weight : float
        Sum of the rows' weights [s].
    mean_soc_pct : float
        Their mean SoC [%].
    """

    moments: FloatArray
    weight: float
    mean_soc_pct: float

    @property
    def mean_c(self) -> float:
        """Mean temperature [°C]."""
        return REFERENCE_C + float(self.moments[-2, N]) / self.weight

    def with_columns(self, columns: Sequence[int]) -> LogSums:
        """Return the sums with some of the effects' columns only."""
        q = len(self.moments)
        kept = [*range(BASE), *(BASE + column for column in columns), q - 2, q - 1]
        return replace(self, moments=self.moments[np.ix_(kept, kept)])


def load_features(temperature_c: FloatArray, currents_a: FloatArray) -> FloatArray:
    """Return T − T_r [K], Im [A] and a(T)·Im [A], shape (n, 1 + 2M)."""
    a = resistance_factor(temperature_c)[:, None]
    warmer_k = (temperature_c - REFERENCE_C)[:, None]
    return np.concatenate([warmer_k, currents_a, a * currents_a], axis=1)


def row_weights(soc_pct: FloatArray, row_s: float, chemistry: Chemistry) -> FloatArray:
    """Return the weight of each row of a log [s], shape (n,); 0 far outside 0–100 %.

    Parameters
    ----------
    soc_pct : array of shape (n,)
        [%].
    row_s : float
        Time that a row stands for [s].
    chemistry : Chemistry
    """
    inside = (soc_pct > -1.0) & (soc_pct < 101.0)
    soc_bin = np.clip(np.floor(soc_pct) + 1.0, 0.0, 102.0).astype(np.uint8)
    counted_s = min(row_s, SECONDS_PER_DATUM)
    bin_s = counted_s * np.bincount(soc_bin, minlength=103)
    share = np.minimum(1.0, SECONDS_PER_PERCENT / np.maximum(bin_s, counted_s))
    curve = chemistry.curve_v / np.interp(50.0, KNOTS_PCT, chemistry.curve_v)
    # Variance of a row by noise and error of SoC, over that by noise; in place, as rows are many.
    variance = np.interp(soc_pct, KNOTS_PCT, np.gradient(curve, KNOTS_PCT))
    variance *= chemistry.soc_std_pct / RESIDUAL_STD
    variance *= variance
    variance += 1.0
    return np.asarray(counted_s * share[soc_bin] * inside / variance)


def features(soc_pct: FloatArray, temperature_c: FloatArray, currents_a: FloatArray) -> FloatArray:
    """Return the columns of the moments before those of effects, shape (m, BASE)."""
    loads = load_features(temperature_c, currents_a)
    return np.concatenate([hermite_basis(soc_pct), loads], axis=1)


def row_features(rows: FitRows) -> FloatArray:
    """Return `features` of the rows of a fit, shape (m, BASE)."""
    return features(rows.soc_pct, rows.dequantized_c, rows.current_columns_a)


def log_sums(
    rows: FitRows,
    chemistry: Chemistry,
    columns: FloatArray | None = None,
    voltage_v: FloatArray | None = None,
) -> LogSums:
    """Return the sums of a log.

    Parameters
    ----------
    rows : FitRows
    chemistry : Chemistry
    columns : array of shape (m, q − 2), optional
        Those of the moments before 1 and voltage; `row_features`, without effects, by default.
    voltage_v : array of shape (m,), optional
        By default the measured voltage [V].

    Raises
    ------
    InputError
        If every row lies so far outside 0–100 % that it has no weight.
    """
    weight = row_weights(rows.soc_pct, rows.row_s, chemistry)
    total = float(weight.sum())
    if not total:
        low, high = float(rows.soc_pct.min()), float(rows.soc_pct.max())
        raise InputError(
            f"the counted SoC stays outside 0–100 % ({low:.1f} … {high:.1f} %): no row is left",
            source=rows.name,
            field="soc_pct",
            cure="check the SoC at the start (soc_pct, --initial-soc), or leave this log out",
        )
    moments: Any = 0.0
    for place, chunk in rows.chunks():
        left = row_features(chunk) if columns is None else columns[place]
        volts = chunk.voltage_v if voltage_v is None else voltage_v[place]
        table = np.column_stack([left, np.ones(len(chunk)), volts])
        moments = moments + table.T @ (table * weight[place, None])
    return LogSums(moments, total, float(weight @ rows.soc_pct) / total)


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution(Distribution):
    """Posterior of the coefficients, the amplitudes of effects after b.

    Parameters
    ----------
    select : array of shape (p, q − 2)
        Maps the columns of the moments to the coefficients' columns.
    """

    select: FloatArray

    @property
    def of_columns(self) -> FloatArray:
        """Coefficients of the columns of the moments, shape (q − 2,)."""
        return np.asarray(self.select.T @ self.coefficients)

    def mean_error(self, sums: LogSums) -> tuple[float, float]:
        """Return the mean residual of a log [V], and its variance by the coefficients [V²]."""
        row = self.select @ (sums.moments[:-2, -2] / sums.weight)
        error = float(sums.moments[-2, -1]) / sums.weight - float(row @ self.coefficients)
        return error, float(row @ self.covariance @ row)

    def strain_of(self, sums: LogSums, level_v: float) -> float:
        """Return Σ (learned/prior σ)² of what a log teaches: all coefficients, and its level.

        Parameters
        ----------
        sums : LogSums
            Of a log that is not among those of the solution.
        level_v : float
            Prior standard deviation of its level [V].
        """
        a = self.select @ sums.moments[:-2, -2]
        A = self.select @ sums.moments[:-2, :-2] @ self.select.T
        r = self.select @ sums.moments[:-2, -1] - A @ self.coefficients
        r_log = float(sums.moments[-2, -1] - a @ self.coefficients)
        v = (self.residual_v**2 + (ADDED_STD * self.mean_v) ** 2) * SECONDS_PER_DATUM
        s = 1.0 / (sums.weight + v / level_v**2)
        Lambda = np.linalg.inv(self.covariance)
        delta = np.linalg.solve((A - s * np.outer(a, a)) / v + Lambda, (r - s * r_log * a) / v)
        level = s * (r_log - float(a @ delta))
        return float(delta @ Lambda @ delta) + (level / level_v) ** 2

    def square_error(self, sums: LogSums) -> float:
        """Return the mean square residual of a log, its level included [V²]."""
        back = np.r_[self.of_columns, 0.0, -1.0]
        return float(back @ sums.moments @ back) / sums.weight


NO_EFFECTS: Final = np.zeros(0)
"""Standard deviations of the amplitudes of no effects."""


def solve(
    sums: Sequence[LogSums],
    pack: PackPrior,
    amplitude_std: FloatArray = NO_EFFECTS,
) -> Solution:
    """Return the posterior of the coefficients for some logs.

    With rows X of weights W and the prior N(θ₀, Λ⁻¹), θ = θ₀ + δ solves

        [(A − Σl sl·al·alᵀ)/v + Λ]·δ = (r − Σl sl·rl·al)/v

    with A = XᵀWX and r = XᵀW·(u − X·θ₀). al and rl are the sums over log l of its weighted rows and
    errors, sl = 1/(wl + v/σl²) eliminates its level of prior N(0, σl²), and v is the noise variance
    of a datum times its seconds.

    Parameters
    ----------
    sums : sequence of LogSums, one or more
    pack : PackPrior
    amplitude_std : array of shape (e,)
        Prior standard deviations of the effects' amplitudes, of mean 0.
    """
    moments, w = np.array([item.moments for item in sums]), np.array([item.weight for item in sums])
    total, weight = moments.sum(axis=0), float(w.sum())
    mean_v = float(total[-2, -1]) / weight
    mean_c = REFERENCE_C + float(total[-2, N]) / weight
    mean_soc = float(w @ [item.mean_soc_pct for item in sums]) / weight
    prior = pack.coefficients(mean_v, mean_soc)
    theta0 = np.r_[prior.coefficients, np.zeros(amplitude_std.size)]
    Lambda = np.diag(np.r_[1.0 / np.diag(prior.covariance), amplitude_std**-2.0])
    Lambda[:N, :N] = np.linalg.inv(prior.covariance[:N, :N])
    level_std = pack.chemistry.level_v(mean_v, [item.mean_c for item in sums])
    ohm = prior.arrhenius_ohm
    for _ in range(2):  # the column of b needs the resistances: twice
        arrhenius_ohm = ohm
        select = _selection(arrhenius_ohm, float(resistance_factor(mean_c)), amplitude_std.size)
        delta, precision, residual_v2 = _with_own_noise(
            moments,
            w,
            select,
            theta0,
            Lambda=Lambda,
            level_std=level_std,
            variance_v2=prior.residual_v**2,
            added_v2=(ADDED_STD * mean_v) ** 2,
        )
        theta = theta0 + delta
        fitted_ohm = theta[N + 1 : N + 1 + M]
        ohm = fitted_ohm if fitted_ohm.sum() < 0.0 else prior.arrhenius_ohm
    covariance = np.linalg.inv(precision)
    covariance = 0.5 * (covariance + covariance.T)
    covariance[P - 1, P - 1] += B_LEFT_STD**2
    residual_v = float(np.sqrt(residual_v2))
    return Solution(theta, covariance, arrhenius_ohm, residual_v, mean_v, mean_c, select=select)


def _with_own_noise(
    moments: FloatArray,
    w: FloatArray,
    select: FloatArray,
    theta0: FloatArray,
    *,
    Lambda: FloatArray,
    level_std: FloatArray,
    variance_v2: float,
    added_v2: float,
) -> tuple[FloatArray, FloatArray, float]:
    """Solve the normal equations with the noise that their own residuals have: a fixed point.

    The symbols are those of `solve`.

    Parameters
    ----------
    moments : array of shape (logs, q, q)
    w : array of shape (logs,)
        Weights wl.
    select : array of shape (p, q − 2)
        See `Solution`.
    theta0 : array of shape (p,)
    Lambda : array of shape (p, p)
    level_std : array of shape (logs,)
        σl [V].
    variance_v2 : float
        Variance of a datum to begin with [V²].
    added_v2 : float
        What it has beside the residuals [V²].

    Returns
    -------
    delta : array of shape (p,)
    precision : array of shape (p, p)
    residual_v2 : float
        Mean square residual [V²].
    """
    total = moments.sum(axis=0)
    A = select @ total[:-2, :-2] @ select.T
    XWu = select @ total[:-2, -1]
    r = XWu - A @ theta0
    a = moments[:, :-2, -2] @ select.T
    r_log = moments[:, -2, -1] - a @ theta0
    square_v2 = float(total[-1, -1] - theta0 @ (XWu + r))  # (u − X·θ₀)ᵀW(u − X·θ₀)
    for _ in range(12):  # fewer where it has converged
        v = variance_v2 * SECONDS_PER_DATUM
        s = 1.0 / (w + v / level_std**2)
        precision = (A - (a * s[:, None]).T @ a) / v + Lambda
        delta = np.asarray(np.linalg.solve(precision, (r - a.T @ (s * r_log)) / v), np.float64)
        left = r_log - a @ delta
        level = s * left
        left_v2 = square_v2 - 2.0 * float(delta @ r) + float(delta @ A @ delta)
        left_v2 += float(level @ (w * level - 2.0 * left))
        residual_v2 = max(left_v2, 0.0) / float(w.sum())
        following_v2 = residual_v2 + added_v2
        if abs(following_v2 / variance_v2 - 1.0) < 1e-3:
            break
        variance_v2 = following_v2
    return delta, precision, residual_v2


def _selection(arrhenius_ohm: FloatArray, warm: float, amplitudes: int) -> FloatArray:
    """Return `Solution.select`; `warm` is a(T̄), at which the resistances hold."""
    select = np.zeros((P + amplitudes, BASE + amplitudes))
    at = np.arange(N + 1 + M)
    select[at, at] = 1.0
    select[P - 1, N + 1 : N + 1 + M] = -arrhenius_ohm
    select[P - 1, N + 1 + M : BASE] = arrhenius_ohm / warm
    select[P:, BASE:] = np.eye(amplitudes)
    return select


def solve_without(
    sums: Sequence[LogSums],
    pack: PackPrior,
    amplitude_std: FloatArray = NO_EFFECTS,
) -> list[Solution]:
    """Return for each log the posterior of the logs outside its fold; [] for too few logs."""
    number = len(sums)
    if number < LOGS_AT_LEAST:
        return []
    count = min(number, FOLDS_AT_MOST)
    by_fold = [
        solve([item for k, item in enumerate(sums) if k % count != fold], pack, amplitude_std)
        for fold in range(count)
    ]
    return [by_fold[k % count] for k in range(number)]


def left_out_calibration(
    sums: Sequence[LogSums], without: Sequence[Solution], chemistry: Chemistry
) -> tuple[float, float]:
    """Return how errors of left-out logs compare with those that the posterior states.

    Returns
    -------
    scale : float
        κ²: mean of their squared mean residuals, each over its stated variance; 1 at least.
    strain : float
        Mean of `Solution.strain_of`, over κ² and over its mean under the model; 1 at most. The
        prior's logs have 1, so that it is two fifths or more.
    """
    squares, strains = [], []
    for item, other in zip(sums, without, strict=False):
        if item.weight < SECONDS_PER_DATUM:
            continue
        error, variance = other.mean_error(item)
        level_v = float(chemistry.level_v(other.mean_v, item.mean_c))
        fast2 = other.residual_v**2 + (ADDED_STD * other.mean_v) ** 2
        fast2 *= SECONDS_PER_DATUM / item.weight
        squares.append(error**2 / (variance + level_v**2 + fast2))
        strains.append(other.strain_of(item, level_v) / (chemistry.functions + 1))
    scale = (LEFT_OUT_PRIOR + float(np.sum(squares))) / (LEFT_OUT_PRIOR + len(squares))
    scale = max(1.0, scale)
    # A mean of many logs is no bound of the next one, so that they weigh no more than a few.
    weight = min(len(strains), LOGS_AT_LEAST) / max(len(strains), 1)
    strain = LEFT_OUT_PRIOR + weight * float(np.sum(strains)) / scale
    return scale, min(1.0, strain / (LEFT_OUT_PRIOR + weight * len(strains)))


def solve_scaled(
    sums: Sequence[LogSums],
    pack: PackPrior,
    amplitude_std: FloatArray = NO_EFFECTS,
) -> tuple[Solution, list[Solution]]:
    """Return the posterior scaled by left-out logs, and those of `solve_without`."""
    solution = solve(sums, pack, amplitude_std)
    without = solve_without(sums, pack, amplitude_std)
    scale, strain = left_out_calibration(sums, without, pack.chemistry)
    covariance = solution.covariance * scale
    return replace(solution, covariance=covariance, scale=scale, strain=strain), without

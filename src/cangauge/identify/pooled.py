"""The fit of `voltage_fit` from summaries of the logs: exact, and out of core.

Least squares needs of a log only the triangular factor R of the QR decomposition of its rows
[columns, voltage] (square-root information, RᵀR = the normal equations). The factor of several logs
is that of their factors stacked, and has the condition of the rows, not its square as the normal
equations have (Golub, Van Loan, Matrix Computations, 4th ed., §5.3; Bierman, Factorization Methods
for Discrete Sequential Estimation, 1977, ch. 5). The prior on kt needs one more factor per time
scale.

First pass: `LogInformation` of each log; their sum gives the coefficients, and those without each
fold of logs. Second pass: `LogErrors` of each log under these, which add up to the standard errors,
the held-out error and the error model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cangauge._typing import FloatArray
from cangauge.identify.evaluate import LogFit
from cangauge.identify.voltage_fit import (
    KT,
    check_identifiable,
    design_matrix,
    rising,
    voltage_model_of,
    with_prior_errors,
    with_prior_row,
)
from cangauge.inference.error_model import ErrorEquations, LogResidual, error_equations
from cangauge.inference.least_squares import (
    CLUSTER_S,
    Solution,
    kt_prior_by_scale,
    sandwich_std_error,
)
from cangauge.inference.rows import FitOptions, FitRows, block_numbers
from cangauge.inference.time_scales import SCALES, haar_transform
from cangauge.model.voltage_model import VoltageModel

LEVELS_AT_MOST = 4096
"""Different voltages that are counted one by one; with more they are rounded, …"""

LEVEL_STEP = 1e-4
"""… to this part of the voltage [-]: they only scale two priors."""


@dataclass(frozen=True, eq=False)
class LogInformation:
    """What the fit needs of one or more logs.

    Parameters
    ----------
    rows, logs : int
    root : array of shape (p + 1, p + 1)
        Triangular factor of [columns, voltage].
    scale_roots : array of shape (SCALES, p + 1, p + 1)
        The same of the Haar coefficients of each time scale.
    counts : array of int, shape (SCALES,)
        Numbers of coefficients.
    low, high : array of shape (3,)
        Range of SoC [%], temperature [°C] and current [A].
    levels_v, level_rows : array of shape (m,)
        Voltages [V], increasing, and how many rows have them.
    temperature_sum : float
        Sum of the rows' temperatures [°C].
    spans : array of shape (2,)
        Duration [s] and range of SoC [%], summed over the logs.
    """

    rows: int
    logs: int
    root: FloatArray
    scale_roots: FloatArray
    counts: FloatArray
    low: FloatArray
    high: FloatArray
    levels_v: FloatArray
    level_rows: FloatArray
    temperature_sum: float
    spans: FloatArray

    @property
    def nominal_v(self) -> float:
        """Median of the voltage [V]; to `LEVEL_STEP` where there are more than LEVELS_AT_MOST."""
        ends = np.cumsum(self.level_rows)
        below, above = (self.rows - 1) // 2, self.rows // 2
        at = np.searchsorted(ends, [below, above], side="right")
        return float(np.mean(self.levels_v[at]))

    @property
    def mean_c(self) -> float:
        """Mean temperature of the rows [°C]."""
        return self.temperature_sum / self.rows


def information_of(rows: FitRows, options: FitOptions) -> LogInformation:
    """Return what the fit needs of one log's rows."""
    columns = design_matrix(rows, options.epsilon, options.t_ref_c)
    table = np.column_stack([columns, rows.voltage_v])
    by_scale = haar_transform(table, SCALES)
    channels = (rows.soc_pct, rows.temperature_c, rows.delayed_current_a[:, 0])
    levels, level_rows = _levels(rows.voltage_v, np.ones(len(rows)))
    return LogInformation(
        rows=len(rows),
        logs=1,
        root=_factor(table),
        scale_roots=np.array([_factor(each) for each in by_scale]),
        counts=np.array([len(each) for each in by_scale], dtype=np.float64),
        low=np.array([values.min() for values in channels]),
        high=np.array([values.max() for values in channels]),
        levels_v=levels,
        level_rows=level_rows,
        temperature_sum=float(rows.temperature_c.sum()),
        spans=np.array([np.ptp(rows.time_s), np.ptp(rows.soc_pct)]),
    )


def _levels(volts: FloatArray, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the different voltages [V], rounded if they are many, and the rows of each."""
    levels, at = np.unique(volts, return_inverse=True)
    if levels.size > LEVELS_AT_MOST:
        step = np.log1p(LEVEL_STEP)
        rounded = np.exp(np.round(np.log(volts) / step) * step)
        levels, at = np.unique(rounded, return_inverse=True)
    return levels, np.asarray(np.bincount(at, weights=rows), dtype=np.float64)


def pooled(parts: Sequence[LogInformation]) -> LogInformation:
    """Return the information of several logs together."""
    levels, level_rows = _levels(
        np.concatenate([each.levels_v for each in parts]),
        np.concatenate([each.level_rows for each in parts]),
    )
    return LogInformation(
        rows=sum(each.rows for each in parts),
        logs=sum(each.logs for each in parts),
        root=_factor(np.vstack([each.root for each in parts])),
        scale_roots=np.array(
            [_factor(np.vstack([each.scale_roots[j] for each in parts])) for j in range(SCALES)]
        ),
        counts=np.sum([each.counts for each in parts], axis=0),
        low=np.min([each.low for each in parts], axis=0),
        high=np.max([each.high for each in parts], axis=0),
        levels_v=levels,
        level_rows=level_rows,
        temperature_sum=float(np.sum([each.temperature_sum for each in parts])),
        spans=np.sum([each.spans for each in parts], axis=0),
    )


def _factor(table: FloatArray) -> FloatArray:
    """Return the triangular factor of a table, square: short ones are filled with zeros."""
    root = np.linalg.qr(table, mode="r")
    return np.asarray(np.pad(root, ((0, table.shape[1] - len(root)), (0, 0))))


def fit_information(
    information: LogInformation, options: FitOptions, *, source: str = ""
) -> tuple[VoltageModel, Solution]:
    """Fit the coefficients as `fit_voltage_model` does; standard errors are those of kt's prior.

    Parameters
    ----------
    information : LogInformation
    options : FitOptions
    source : str
        Name of the logs, for messages.

    Returns
    -------
    VoltageModel
    Solution
        `with_std_errors` completes it.

    Raises
    ------
    InputError
        If the logs cannot identify the model.
    """
    columns, volts = information.root[:, :-1], information.root[:, -1]
    span = information.high - information.low
    check_identifiable(source, (information.rows, columns.shape[1]), float(span[0]), float(span[2]))
    soc_range = float(information.low[0]), float(information.high[0])
    nominal_v, block = information.nominal_v, np.arange(len(volts))
    plain = rising(columns, volts, block, soc_range, options.epsilon, nominal_v=nominal_v)
    error_v = volts - columns @ plain.coefficients
    prior = kt_prior_by_scale(
        columns,
        [_with_residual(each, plain.coefficients) for each in information.scale_roots],
        information.counts.astype(int).tolist(),
        KT,
        nominal_v=nominal_v,
        residual_std_v=float(np.sqrt(error_v @ error_v / information.rows)),
    )
    columns, volts = with_prior_row(columns, volts, prior)
    block = np.arange(len(volts))
    solution = rising(columns, volts, block, soc_range, options.epsilon, nominal_v=nominal_v)
    solution = replace(solution, kt_prior=prior)
    return voltage_model_of(solution, options, information.low, information.high), solution


def _with_residual(root: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Return a factor with the residual in place of the voltage."""
    return np.column_stack([root[:, :-1], root[:, -1] - root[:, :-1] @ coefficients])


@dataclass(frozen=True, eq=False)
class LogErrors:
    """Errors of one or more logs under the model of all, as sums that add up.

    Parameters
    ----------
    sums : dict of str to float
        `rows`, `voltage_pct`, `square_v2`, `newton_pct`, `clusters`; the same held out:
        `held_out`, `held_out_pct`, `held_out_v2`; and of the slope resistance.
    scores : array of shape (kept, kept)
        Sum over blocks of correlated rows of the products of their scores.
    currents : array of shape (n + 2, n + 2)
        Sums of products of 1, the drop (U − pseudo-OCV) and the delayed currents.
    equations : ErrorEquations
        Of the error model.
    """

    sums: dict[str, float]
    scores: FloatArray
    currents: FloatArray
    equations: ErrorEquations


def errors_of(
    fitted: LogFit,
    options: FitOptions,
    solution: Solution,
    held_out: VoltageModel | None,
    mean_c: float,
) -> LogErrors:
    """Return the errors of one log.

    Parameters
    ----------
    fitted : LogFit
        Of the log, under the model of all logs.
    options : FitOptions
    solution : Solution
        Of all logs.
    held_out : VoltageModel, optional
        Model of the logs without the fold that holds this one out.
    mean_c : float
        Mean temperature of all logs [°C].
    """
    rows, volts = fitted.rows, fitted.rows.voltage_v
    columns = design_matrix(rows, options.epsilon, options.t_ref_c)
    error_v = volts - columns @ solution.coefficients
    blocks = block_numbers([rows], CLUSTER_S)
    number = int(blocks[-1]) + 1
    scores = np.zeros((number, solution.back.shape[1]))
    np.add.at(scores, blocks, (columns @ solution.back) * error_v[:, None])
    resistance_ohm = solution.coefficients[KT + 1 :]
    logged = LogResidual(
        fitted.residual_v, rows.soc_pct, rows.temperature_c, rows.delayed_current_a
    )
    drop_v = volts - fitted.pseudo_ocv_v
    currents = np.column_stack([np.ones(len(rows)), drop_v, rows.delayed_current_a])
    newton = np.abs(fitted.soc_newton_pct - rows.soc_pct)
    return LogErrors(
        sums={
            "rows": float(len(rows)),
            "voltage_pct": 100.0 * float(np.sum(np.abs(fitted.residual_v) / volts)),
            "square_v2": float(fitted.residual_v @ fitted.residual_v),
            "fit_v2": float(error_v @ error_v),
            "newton_pct": float(newton.sum()),
            "clusters": float(np.unique(blocks).size),
            **_held_out_sums(rows, held_out),
        },
        scores=scores.T @ scores,
        currents=currents.T @ currents,
        equations=error_equations([logged], mean_c, resistance_ohm.tolist()),
    )


def _held_out_sums(rows: FitRows, model: VoltageModel | None) -> dict[str, float]:
    if model is None:
        return {"held_out": 0.0, "held_out_pct": 0.0, "held_out_v2": 0.0}
    low, high = model.soc_range_pct
    seen = (rows.soc_pct > low - 1.0) & (rows.soc_pct < high + 1.0)
    volts = rows.voltage_v[seen]
    predicted = model.voltage(
        rows.soc_pct[seen], rows.temperature_c[seen], rows.delayed_current_a[seen]
    )
    error_v = volts - predicted
    return {
        "held_out": float(seen.sum()),
        "held_out_pct": 100.0 * float(np.sum(np.abs(error_v) / volts)),
        "held_out_v2": float(error_v @ error_v),
    }


def summed(parts: Sequence[LogErrors]) -> LogErrors:
    """Return the errors of several logs together."""
    equations = [each.equations for each in parts]
    return LogErrors(
        sums={name: sum(each.sums[name] for each in parts) for name in parts[0].sums},
        scores=np.sum([each.scores for each in parts], axis=0),
        currents=np.sum([each.currents for each in parts], axis=0),
        equations=ErrorEquations(
            rows=np.concatenate([each.rows for each in equations]),
            means=np.vstack([each.means for each in equations]),
            counts=np.sum([each.counts for each in equations], axis=0),
            products=np.sum([each.products for each in equations], axis=0),
        ),
    )


def with_std_errors(solution: Solution, errors: LogErrors) -> Solution:
    """Return the solution with the standard errors of `fit_voltage_model`."""
    prior, back = solution.kt_prior, solution.back
    weight = 0.0 if prior is None else prior.row_weight
    kt = float(solution.coefficients[KT])
    # The prior's row is a cluster of its own.
    score = weight * back[KT] * (-weight * kt)
    scores = errors.scores + np.outer(score, score)
    std_error = sandwich_std_error(
        back,
        np.einsum("ij,jk,ik->i", back, scores, back),
        int(errors.sums["clusters"]) + 1,
        square_v2=errors.sums["fit_v2"] + (weight * kt) ** 2,
        rows=int(errors.sums["rows"]) + 1,
    )
    solution = replace(solution, std_error=std_error)
    return solution if prior is None else with_prior_errors(solution, prior)


def slope_resistances(errors: LogErrors, resistance_ohm: Sequence[float]) -> tuple[float, float]:
    """Return minus the slope of (U − pseudo-OCV) over I, and −(R1 + Σ Rj·ρj), [Ω] each."""
    sums = errors.currents
    means = sums[0] / sums[0, 0]
    centred = sums - sums[0, 0] * np.outer(means, means)
    variance = centred[2, 2]
    slope = float(centred[1, 2] / variance)
    return -slope, -float(np.array(resistance_ohm) @ (centred[2:, 2] / variance))

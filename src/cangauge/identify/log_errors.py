"""Errors of logs under the model of all: what is summed over them for the figures of a fit.

Second pass of `voltage_fit`: `LogErrors` of each log add up to the standard errors, the held-out
error and the error model.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cangauge._typing import FloatArray
from cangauge.identify.evaluate import LogFit, evaluate
from cangauge.identify.voltage_fit import KT, table_of
from cangauge.inference.error_model import ErrorEquations, LogResidual, error_equations
from cangauge.inference.least_squares import (
    CLUSTER_S,
    KtPrior,
    Solution,
    sandwich_std_error,
)
from cangauge.inference.rows import (
    FitOptions,
    FitRows,
    Mask,
    block_numbers,
    row_blocks,
    stacked_columns,
)
from cangauge.model.voltage_model import VoltageModel

HeldOut = Sequence[tuple[Mask | None, VoltageModel]]
"""For one log: models that hold some of its rows out (None: all of them)."""


def held_out_error(rows: FitRows, held_out: HeldOut) -> FloatArray:
    """Return measured minus predicted voltage by models that did not see the row [V], shape (m,).

    NaN where no model holds a row out, and where the row's SoC lies outside that of the training
    rows (an estimate is flagged there).
    """
    error_v = np.full(len(rows), np.nan)
    for mask, model in held_out:
        low, high = model.soc_range_pct
        seen = (rows.soc_pct > low - 1.0) & (rows.soc_pct < high + 1.0)
        part = rows.part(seen if mask is None else seen & mask)
        predicted = model.voltage(part.soc_pct, part.temperature_c, part.delayed_current_a)
        error_v[seen if mask is None else seen & mask] = part.voltage_v - predicted
    return error_v


@dataclass(frozen=True, eq=False)
class LogErrors:
    """Errors of one or more logs under the model of all, as sums that add up.

    Parameters
    ----------
    sums : dict of str to float
        `rows`, `voltage_pct`, `square_v2`, `newton_pct`; the same held out: `held_out`,
        `held_out_pct`, `held_out_v2`; and `clusters`, `fit_v2` of `score_sums`.
    scores : array of shape (kept, kept)
        Of `score_sums`.
    currents : array of shape (n + 2, n + 2)
        Sums of products of 1, the drop (U − pseudo-OCV) and the delayed currents.
    equations : ErrorEquations
        Of the error model.
    """

    sums: dict[str, float]
    scores: FloatArray
    currents: FloatArray
    equations: ErrorEquations


@dataclass(frozen=True)
class LogFigures:
    """Figures of one log.

    Parameters
    ----------
    name : str
    removed : dict of str to int
        Number of rows removed by each rule.
    sums : dict of str to float
        Of `LogErrors`.
    """

    name: str
    removed: dict[str, int]
    sums: Mapping[str, float]

    @property
    def rows(self) -> int:
        """Number of rows of the fit."""
        return int(self.sums["rows"])

    @property
    def voltage_mae_pct(self) -> float:
        """Mean absolute voltage error relative to the measured voltage [%]."""
        return self.sums["voltage_pct"] / self.sums["rows"]

    @property
    def soc_newton_mae_pct(self) -> float:
        """Mean absolute error of the Newton inverse against the counted SoC [% SoC]."""
        return self.sums["newton_pct"] / self.sums["rows"]


def score_sums(
    rows: FitRows, options: FitOptions, solution: Solution, extra: FloatArray | None = None
) -> tuple[dict[str, float], FloatArray]:
    """Return what the standard errors need of one log's rows.

    Parameters
    ----------
    rows, options, extra
        As of `information_of`.
    solution : Solution

    Returns
    -------
    dict of str to float
        `rows`, `clusters` of correlated rows, `fit_v2` the sum of their squared errors [V²].
    array of shape (kept, kept)
        Sum over the clusters of the products of their scores.
    """
    square_v2 = 0.0
    scores, numbers = [], []
    cluster = block_numbers([rows], CLUSTER_S)
    for block in row_blocks(len(rows)):
        table = table_of(rows.part(block), options, None if extra is None else extra[block])
        error_v = table[:, -1] - table[:, :-1] @ solution.coefficients
        square_v2 += float(error_v @ error_v)
        first = np.flatnonzero(np.diff(cluster[block], prepend=-1))
        each = (table[:, :-1] @ solution.back) * error_v[:, None]
        scores.append(np.add.reduceat(each, first, axis=0))
        numbers.append(cluster[block][first])
    first = np.flatnonzero(np.diff(np.concatenate(numbers), prepend=-1))  # across blocks
    by_cluster = np.add.reduceat(np.concatenate(scores), first, axis=0)
    sums = {"rows": float(len(rows)), "clusters": float(first.size), "fit_v2": square_v2}
    return sums, by_cluster.T @ by_cluster


def _added(parts: Sequence[Mapping[str, float]]) -> dict[str, float]:
    return {name: sum(each[name] for each in parts) for name in parts[0]}


def summed_scores(
    parts: Sequence[tuple[dict[str, float], FloatArray]],
) -> tuple[dict[str, float], FloatArray]:
    """Return `score_sums` of several logs together."""
    return _added([sums for sums, _ in parts]), np.sum([scores for _, scores in parts], axis=0)


def errors_of(
    rows: FitRows,
    options: FitOptions,
    model: VoltageModel,
    solution: Solution,
    *,
    held_out: HeldOut = (),
    mean_c: float,
) -> LogErrors:
    """Return the errors of one log.

    Parameters
    ----------
    rows : FitRows
    options : FitOptions
    model : VoltageModel
        Of all logs.
    solution : Solution
        The same, from `fit_information`.
    held_out : HeldOut
    mean_c : float
        Mean temperature of all logs [°C].
    """
    parts = (
        (
            evaluate(model, rows.part(block)),
            held_out_error(
                rows.part(block),
                [(None if mask is None else mask[block], each) for mask, each in held_out],
            ),
        )
        for block in row_blocks(len(rows))
    )
    sums, scores = score_sums(rows, options, solution)
    errors = errors_of_fit(rows, parts, model.resistance_ohm, options.rate_hz, mean_c=mean_c)
    return replace(errors, sums=errors.sums | sums, scores=scores)


def errors_of_fit(
    rows: FitRows,
    parts: Iterable[tuple[LogFit, FloatArray]],
    resistance_ohm: Sequence[float],
    rate_hz: float,
    *,
    mean_c: float,
) -> LogErrors:
    """Return the errors of one log without those of the least squares; else as `errors_of`.

    Parameters
    ----------
    rows : FitRows
    parts : iterable of pairs
        Blocks of the rows in order: their fit, and their held-out error [V], shape (m,).
    resistance_ohm : sequence of float
        Rj [Ω], negative.
    rate_hz : float
        Rate of the rows.
    mean_c : float
        Mean temperature of all logs [°C].
    """
    sums: list[dict[str, float]] = []
    currents = np.zeros((2 + len(resistance_ohm),) * 2)
    residuals = []
    for fitted, error_v in parts:
        part, volts, residual_v = fitted.rows, fitted.rows.voltage_v, fitted.residual_v
        residuals.append(residual_v)
        drop_v = volts - fitted.pseudo_ocv_v
        table = stacked_columns(np.ones(len(part)), drop_v, part.delayed_current_a)
        currents += table.T @ table
        known = np.isfinite(error_v)
        sums.append(
            {
                "rows": float(len(part)),
                "voltage_pct": 100.0 * float(np.sum(np.abs(residual_v) / volts)),
                "square_v2": float(residual_v @ residual_v),
                "newton_pct": float(np.abs(fitted.soc_newton_pct - part.soc_pct).sum()),
                "held_out": float(known.sum()),
                "held_out_pct": 100.0 * float(np.sum(np.abs(error_v[known]) / volts[known])),
                "held_out_v2": float(error_v[known] @ error_v[known]),
            }
        )
    logged = LogResidual(
        np.concatenate(residuals), rows.soc_pct, rows.temperature_c, rows.delayed_current_a
    )
    equations = error_equations(logged, mean_c, resistance_ohm, rate_hz)
    return LogErrors(_added(sums), np.zeros((0, 0)), currents, equations)


def summed(parts: Sequence[LogErrors]) -> LogErrors:
    """Return the errors of several logs together."""
    return LogErrors(
        sums=_added([each.sums for each in parts]),
        scores=np.sum([each.scores for each in parts], axis=0),
        currents=np.sum([each.currents for each in parts], axis=0),
        equations=ErrorEquations.of_all([each.equations for each in parts]),
    )


def with_std_errors(solution: Solution, sums: Mapping[str, float], scores: FloatArray) -> Solution:
    """Return the solution with the standard errors of the rows.

    Parameters
    ----------
    solution : Solution
    sums, scores
        Of `score_sums`, added up over all logs.
    """
    prior, back = solution.kt_prior, solution.back
    rows, clusters, square_v2 = (int(sums["rows"]), int(sums["clusters"]), sums["fit_v2"])
    if prior is not None:  # its row is a cluster of its own
        kt = float(solution.coefficients[KT])
        score = prior.row_weight * back[KT] * (-prior.row_weight * kt)
        scores = scores + np.outer(score, score)
        rows, clusters = rows + 1, clusters + 1
        square_v2 += (prior.row_weight * kt) ** 2
    std_error = sandwich_std_error(
        back, np.einsum("ij,jk,ik->i", back, scores, back), clusters, square_v2=square_v2, rows=rows
    )
    solution = replace(solution, std_error=std_error)
    return solution if prior is None else _with_prior_errors(solution, prior)


def _with_prior_errors(solution: Solution, prior: KtPrior) -> Solution:
    """Return the solution with standard errors that include the uncertainty of kt.

    The other coefficients shift with kt: the pseudo-OCV absorbs what the prior takes from it.
    """
    more = max(prior.posterior_std_v_per_k**2 - float(solution.std_error[KT]) ** 2, 0.0)
    shift = prior.shift_per_kt.copy()
    shift[KT] = 1.0
    std_error = np.sqrt(solution.std_error**2 + more * shift**2)
    return replace(solution, std_error=std_error, kt_prior=prior)


def slope_resistances(errors: LogErrors, resistance_ohm: Sequence[float]) -> tuple[float, float]:
    """Return minus the slope of (U − pseudo-OCV) over I, and −(R1 + Σ Rj·ρj), [Ω] each."""
    sums = errors.currents
    means = sums[0] / sums[0, 0]
    centred = sums - sums[0, 0] * np.outer(means, means)
    variance = centred[2, 2]
    slope = float(centred[1, 2] / variance)
    return -slope, -float(np.array(resistance_ohm) @ (centred[2:, 2] / variance))

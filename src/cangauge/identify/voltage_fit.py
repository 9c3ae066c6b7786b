"""Fit of the voltage model's coefficients from summaries of blocks of rows: exact, and out of core.

Least squares needs of a log only the triangular factor R of the QR decomposition of its rows
[columns, voltage] (square-root information, RᵀR = the normal equations). The factor of several
blocks or logs is that of their factors stacked, and has the condition of the rows, not its square
as the normal equations have (Golub, Van Loan, Matrix Computations, 4th ed., §5.3; Bierman,
Factorization Methods for Discrete Sequential Estimation, 1977, ch. 5). The prior on kt needs one
factor per time scale; since the Haar transform is orthonormal, their stack is that of the rows.

First pass: `LogInformation` of each log; their sum gives the coefficients, and those without each
fold of logs. Second pass: `log_errors`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.inference.least_squares import (
    KtPrior,
    Solution,
    kt_prior,
    solve,
    triangular_factor,
)
from cangauge.inference.linearized import SLOPE_CHECKS
from cangauge.inference.rows import FitOptions, FitRows, Mask, row_blocks, stacked_columns
from cangauge.inference.time_scales import SCALES, HaarBlocks
from cangauge.model.voltage_model import (
    BASIS_NAMES,
    SLOPE_AT_LEAST,
    SLOPE_POINTS,
    VoltageModel,
    ocv_basis,
    ocv_basis_slope,
)

REFINED_AT_MOST = 6
"""Fits with further slope constraints where the pseudo-OCV fell between two of them."""

KT = len(BASIS_NAMES)
"""Index of kt among the coefficients."""

SOC_SPAN_AT_LEAST_PCT = 2.0
"""Least SoC span of a fit [%]."""

LEVELS_AT_MOST = 4096
"""Different voltages that are counted one by one; with more they are rounded, …"""

LEVEL_STEP = 1e-4
"""… to this part of the voltage [-]: they only scale two priors."""


def design_matrix(rows: FitRows, epsilon: float, t_ref_c: float) -> FloatArray:
    """Return the columns k0 … k7, kt, R1 … Rn on the rows of a log, shape (m, 9 + n)."""
    return stacked_columns(
        ocv_basis(rows.soc_pct, epsilon), rows.dequantized_c - t_ref_c, rows.delayed_current_a
    )


@dataclass(frozen=True, eq=False)
class LogInformation:
    """Summary of one or more logs for the fit.

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
        Voltages [V], increasing, and how many rows have them; empty where they are not counted.
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


def information_of(
    rows: FitRows,
    options: FitOptions,
    *,
    extra: FloatArray | None = None,
    keep: Mask | None = None,
    with_levels: bool = False,
) -> LogInformation:
    """Return what the fit needs of one log's rows, from blocks of `BLOCK_ROWS`.

    Parameters
    ----------
    rows : FitRows
    options : FitOptions
    extra : array of shape (m, k), optional
        Further columns, before the voltage.
    keep : array of bool, shape (m,), optional
        Rows to fit; all by default.
    with_levels : bool
        Whether to count the levels of the voltage.
    """
    indices = None if keep is None else np.flatnonzero(keep)
    number = len(rows) if indices is None else indices.size
    transform = HaarBlocks(SCALES)
    roots: list[list[FloatArray]] = [[] for _ in range(SCALES)]
    counts = np.zeros(SCALES)
    lows, highs, temperature_sum = [], [], 0.0
    for block in (*row_blocks(number), None):
        if block is None:
            by_scale = transform.end()
        else:
            some = block if indices is None else indices[block]
            part = rows.part(some)
            by_scale = transform.add(
                table_of(part, options, None if extra is None else extra[some])
            )
            channels = (part.soc_pct, part.temperature_c, part.delayed_current_a[:, 0])
            lows.append([values.min() for values in channels])
            highs.append([values.max() for values in channels])
            temperature_sum += float(part.temperature_c.sum())
        counts += [len(each) for each in by_scale]
        for root, each in zip(roots, by_scale, strict=True):
            root[:] = [triangular_factor([*root, each])]
    scale_roots = np.array([root for (root,) in roots])
    low, high = np.min(lows, axis=0), np.max(highs, axis=0)
    levels, level_rows = np.empty(0), np.empty(0)
    if with_levels:
        levels, level_rows = _levels(np.sort(rows.voltage_v), np.ones(len(rows)))
    first, last = (0, -1) if indices is None else indices[[0, -1]]
    return LogInformation(
        rows=number,
        logs=1,
        root=triangular_factor([np.vstack(list(scale_roots))]),  # the transform is orthonormal
        scale_roots=scale_roots,
        counts=counts,
        low=low,
        high=high,
        levels_v=levels,
        level_rows=level_rows,
        temperature_sum=temperature_sum,
        spans=np.array([rows.time_s[last] - rows.time_s[first], high[0] - low[0]]),
    )


def table_of(rows: FitRows, options: FitOptions, extra: FloatArray | None = None) -> FloatArray:
    """Return [columns, extra columns, voltage] of a block of rows."""
    columns = design_matrix(rows, options.epsilon, options.t_ref_c)
    return stacked_columns(columns, *([] if extra is None else [extra]), rows.voltage_v)


def _levels(volts: FloatArray, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the different voltages, rounded if they are many, and the rows of each.

    Parameters
    ----------
    volts, rows : array of shape (m,)
        Voltages in increasing order, and the rows that have them.
    """
    if not volts.size:
        return volts, rows
    for step in (None, np.log1p(LEVEL_STEP)):
        if step is not None:
            volts = np.exp(np.round(np.log(volts) / step) * step)
        first = np.flatnonzero(np.diff(volts, prepend=-np.inf))
        volts, rows = volts[first], np.add.reduceat(rows, first)
        if volts.size <= LEVELS_AT_MOST:
            break
    return volts, rows


def pooled(parts: Sequence[LogInformation]) -> LogInformation:
    """Return the information of several logs together."""
    volts = np.concatenate([each.levels_v for each in parts])
    order = np.argsort(volts, kind="stable")
    level_rows = np.concatenate([each.level_rows for each in parts])
    levels, level_rows = _levels(volts[order], level_rows[order])
    return LogInformation(
        rows=sum(each.rows for each in parts),
        logs=sum(each.logs for each in parts),
        root=triangular_factor([np.vstack([each.root for each in parts])]),
        scale_roots=np.array(
            [
                triangular_factor([np.vstack([each.scale_roots[j] for each in parts])])
                for j in range(SCALES)
            ]
        ),
        counts=np.sum([each.counts for each in parts], axis=0),
        low=np.min([each.low for each in parts], axis=0),
        high=np.max([each.high for each in parts], axis=0),
        levels_v=levels,
        level_rows=level_rows,
        temperature_sum=float(np.sum([each.temperature_sum for each in parts])),
        spans=np.sum([each.spans for each in parts], axis=0),
    )


def fit_information(
    information: LogInformation,
    options: FitOptions,
    *,
    source: str = "",
    nominal_v: float | None = None,
    with_kt_prior: bool = True,
) -> tuple[VoltageModel, Solution]:
    """Fit the coefficients by least squares with a rising pseudo-OCV.

    Parameters
    ----------
    information : LogInformation
    options : FitOptions
    source : str
        Name of the logs, for messages.
    nominal_v : float, optional
        Median of the voltage [V]; by default that of the counted levels, which may be rounded.
    with_kt_prior : bool
        Whether to use the prior on kt (`least_squares.kt_prior`).

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
    span = information.high - information.low
    shape = information.rows, information.root.shape[1] - 1
    check_identifiable(source, shape, float(span[0]), float(span[2]))
    solution = solve_information(
        information, options.epsilon, nominal_v=nominal_v, with_kt_prior=with_kt_prior
    )
    return voltage_model_of(solution, options, information.low, information.high), solution


def solve_information(
    information: LogInformation,
    epsilon: float,
    *,
    nominal_v: float | None = None,
    with_kt_prior: bool = True,
) -> Solution:
    """Return the coefficients of all columns, extra ones too; else as `fit_information`."""
    root = information.root
    span = float(information.low[0]), float(information.high[0])
    nominal_v = information.nominal_v if nominal_v is None else nominal_v
    solution = rising(root, span, epsilon, nominal_v=nominal_v)
    if not with_kt_prior:
        return solution
    coefficients = solution.coefficients
    error_v = root[:, -1] - root[:, :-1] @ coefficients
    prior = kt_prior(
        root[:, :-1],
        [
            np.column_stack([each[:, :-1], each[:, -1] - each[:, :-1] @ coefficients])
            for each in information.scale_roots
        ],
        information.counts.astype(int).tolist(),
        KT,
        nominal_v=nominal_v,
        residual_std_v=float(np.sqrt(error_v @ error_v / information.rows)),
    )
    solution = rising(with_prior_row(root, prior), span, epsilon, nominal_v=nominal_v)
    return replace(solution, kt_prior=prior)


def models_without(
    by_fold: Sequence[LogInformation],
    options: FitOptions,
    *,
    nominal_v: Sequence[float] | None = None,
    with_kt_prior: bool = True,
) -> tuple[VoltageModel | None, ...]:
    """Return the model without each fold of logs; None where the rest identifies none.

    Parameters
    ----------
    by_fold : sequence of LogInformation
    options : FitOptions
    nominal_v : sequence of float, optional
        Median of the voltage without each fold [V].
    with_kt_prior : bool

    Raises
    ------
    InputError
        If that is so for every fold.
    """
    found: list[VoltageModel | None] = []
    refused: InputError | None = None
    for k in range(len(by_fold)):
        rest = pooled([part for j, part in enumerate(by_fold) if j != k])
        median_v = None if nominal_v is None else nominal_v[k]
        try:
            model, _ = fit_information(
                rest, options, nominal_v=median_v, with_kt_prior=with_kt_prior
            )
        except InputError as error:
            refused = error
            found.append(None)
        else:
            found.append(model)
    if refused is not None and not any(found):
        raise refused
    return tuple(found)


def check_identifiable(
    source: str, shape: tuple[int, ...], soc_span_pct: float, current_span_a: float
) -> None:
    """Refuse rows that cannot identify a model.

    Parameters
    ----------
    source : str
        Names of the logs, for the message.
    shape : tuple of int
        Numbers of rows and coefficients.
    soc_span_pct, current_span_a : float
        Largest minus smallest SoC [%] and current [A].

    Raises
    ------
    InputError
        If there are too few rows, or SoC or current hardly change.
    """
    if shape[0] < 4 * shape[1]:
        raise InputError(
            f"{shape[0]} rows cannot identify {shape[1]} coefficients", source=source,
            cure="give a longer log or more logs",
        )  # fmt: skip
    if soc_span_pct < SOC_SPAN_AT_LEAST_PCT:
        raise InputError(
            f"the logs cover only {soc_span_pct:.2f} % SoC, too little for a voltage model",
            source=source,
            field="soc_pct",
            cure=f"give logs over at least {SOC_SPAN_AT_LEAST_PCT:.0f} %, better the whole range",
        )
    if current_span_a == 0.0:
        raise InputError(
            "the current is constant, so resistance and open-circuit voltage are not separable",
            source=source,
            field="current_a",
            cure="give a log with changing load",
        )


def rising(
    root: FloatArray, span_pct: tuple[float, float], epsilon: float, *, nominal_v: float
) -> Solution:
    """Return the least-squares solution whose pseudo-OCV rises over a span of SoC [%].

    Its standard errors are meaningless.

    Parameters
    ----------
    root : array of shape (n, p + 1)
        Columns of `design_matrix`, others that may follow, and the voltage; or the triangular
        factor of their QR decomposition.
    span_pct : pair of float
        SoC over which the pseudo-OCV rises [%].
    epsilon : float
    nominal_v : float
        Median of the voltage [V], for the least slope.
    """
    columns, volts, block = root[:, :-1], root[:, -1], np.arange(len(root))
    at_least = SLOPE_AT_LEAST * nominal_v
    grid = np.linspace(*span_pct, SLOPE_CHECKS)
    between = np.linspace(*span_pct, SLOPE_POINTS)
    for _ in range(REFINED_AT_MOST):
        bounds = np.zeros((grid.size, columns.shape[1]))
        bounds[:, : len(BASIS_NAMES)] = ocv_basis_slope(grid, epsilon)
        solution = solve(columns, volts, block, bounds, at_least)
        slope = ocv_basis_slope(between, epsilon) @ solution.coefficients[: len(BASIS_NAMES)]
        if np.all(slope > 0.0):
            break
        # Near empty the curve bends so sharply that it may fall between two constraints.
        grid = np.union1d(grid, between[slope < at_least])
    return solution


def with_prior_row(root: FloatArray, prior: KtPrior) -> FloatArray:
    """Return columns and voltage with a further row, kt = 0 V/K by its weight."""
    row = np.zeros((1, root.shape[1]))
    row[0, KT] = prior.row_weight
    return np.vstack([root, row])


def voltage_model_of(
    solution: Solution, options: FitOptions, low: FloatArray, high: FloatArray
) -> VoltageModel:
    """Return the model of a solution; low and high of SoC [%], temperature [°C], current [A]."""
    x = solution.coefficients.tolist()
    soc, temperature, current = zip(low.tolist(), high.tolist(), strict=True)
    return VoltageModel(
        ocv_v=tuple(x[:KT]),
        kt_v_per_k=x[KT],
        resistance_ohm=tuple(x[KT + 1 :]),
        delay_s=options.delay_s,
        epsilon=options.epsilon,
        t_ref_c=options.t_ref_c,
        soc_range_pct=soc,
        temperature_range_c=temperature,
        current_range_a=current,
    )

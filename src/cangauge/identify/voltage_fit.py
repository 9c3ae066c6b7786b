"""Fit of the voltage model's coefficients to rows of logs, and its held-out error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.inference.least_squares import CLUSTER_S, KtPrior, Solution, kt_prior, solve
from cangauge.inference.linearized import SLOPE_CHECKS
from cangauge.inference.rows import (
    LOGS_AT_LEAST,
    FitOptions,
    FitRows,
    Mask,
    block_numbers,
    folds,
)
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


def fit_voltage_model(
    rows: Sequence[FitRows],
    options: FitOptions,
    keep: Mask | None = None,
    *,
    with_kt_prior: bool = True,
) -> tuple[VoltageModel, Solution]:
    """Fit the coefficients by least squares with a rising pseudo-OCV.

    Parameters
    ----------
    rows : sequence of FitRows
    options : FitOptions
    keep : array of bool, optional
        Rows of all logs, in order, to fit; all by default.
    with_kt_prior : bool
        Whether to use the prior on kt (`least_squares.kt_prior`).

    Raises
    ------
    InputError
        If the rows cannot identify the model.
    """
    columns, volts, block = stacked(rows, options)
    soc = np.concatenate([item.soc_pct for item in rows])
    temperature = np.concatenate([item.temperature_c for item in rows])
    current = np.concatenate([item.delayed_current_a[:, 0] for item in rows])
    number = np.repeat(np.arange(len(rows)), [len(item) for item in rows])
    if keep is not None:
        columns, volts, block, number = columns[keep], volts[keep], block[keep], number[keep]
        soc, temperature, current = soc[keep], temperature[keep], current[keep]
    source = ", ".join(item.name for item in rows)
    check_identifiable(source, columns.shape, float(np.ptp(soc)), float(np.ptp(current)))
    span = float(soc.min()), float(soc.max())
    if with_kt_prior:
        lengths = np.bincount(number, minlength=len(rows)).tolist()
        solution, prior = rising_with_kt_prior(
            columns, volts, block, span, options.epsilon, lengths=lengths
        )
        solution = with_prior_errors(solution, prior)
    else:
        nominal_v = float(np.median(volts))
        solution = rising(columns, volts, block, span, options.epsilon, nominal_v=nominal_v)
    low, high = (np.array([of(x) for x in (soc, temperature, current)]) for of in (np.min, np.max))
    return voltage_model_of(solution, options, low, high), solution


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


def rising(
    columns: FloatArray,
    volts: FloatArray,
    block: NDArray[np.intp],
    span_pct: tuple[float, float],
    epsilon: float,
    *,
    nominal_v: float,
) -> Solution:
    """Return the least-squares solution whose pseudo-OCV rises over a span of SoC [%].

    Columns beyond those of `design_matrix` may follow. In place of rows there may be a triangular
    factor of their QR decomposition: the standard errors are then meaningless.

    Parameters
    ----------
    columns, volts, block, span_pct, epsilon
        As `rising_with_kt_prior`.
    nominal_v : float
        Median of the voltage [V], for the least slope.
    """
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


def rising_with_kt_prior(
    columns: FloatArray,
    volts: FloatArray,
    block: NDArray[np.intp],
    span_pct: tuple[float, float],
    epsilon: float,
    *,
    lengths: Sequence[int],
) -> tuple[Solution, KtPrior]:
    """Return the least-squares solution with a rising pseudo-OCV and the prior on kt.

    Parameters
    ----------
    columns : array of shape (n, m)
        Those of `design_matrix`; others may follow.
    volts : array of shape (n,)
    block : array of int of shape (n,)
        Block of correlated rows that each row belongs to.
    span_pct : pair of float
        SoC over which the pseudo-OCV rises [%].
    epsilon : float
    lengths : sequence of int
        Rows of each log.
    """
    nominal_v = float(np.median(volts))
    solution = rising(columns, volts, block, span_pct, epsilon, nominal_v=nominal_v)
    prior = kt_prior(columns, volts - columns @ solution.coefficients, volts, lengths, KT)
    columns, volts = with_prior_row(columns, volts, prior)
    block = np.append(block, block.max() + 1)
    return rising(columns, volts, block, span_pct, epsilon, nominal_v=nominal_v), prior


def with_prior_row(
    columns: FloatArray, volts: FloatArray, prior: KtPrior
) -> tuple[FloatArray, FloatArray]:
    """Return columns and voltage with a further row, kt = 0 V/K by its weight."""
    row = np.zeros(columns.shape[1])
    row[KT] = prior.row_weight
    return np.vstack([columns, row]), np.append(volts, 0.0)


def with_prior_errors(solution: Solution, prior: KtPrior) -> Solution:
    """Return the solution with standard errors that include the uncertainty of kt.

    The other coefficients shift with kt: the pseudo-OCV absorbs what the prior takes from it.
    """
    more = max(prior.posterior_std_v_per_k**2 - float(solution.std_error[KT]) ** 2, 0.0)
    shift = prior.shift_per_kt.copy()
    shift[KT] = 1.0
    std_error = np.sqrt(solution.std_error**2 + more * shift**2)
    return replace(solution, std_error=std_error, kt_prior=prior)


def held_out_errors(
    rows: Sequence[FitRows], options: FitOptions, *, with_kt_prior: bool = True
) -> list[FloatArray]:
    """Return the held-out errors of each log's rows [V], shape (m,) each.

    NaN where no fold holds a row out, where the row's SoC lies outside that of the training rows
    (an estimate is flagged there), and for a whole log without which the others identify no model.

    Raises
    ------
    InputError
        If no fold leaves training rows that identify a model.
    """
    volts = np.concatenate([item.voltage_v for item in rows])
    soc = np.concatenate([item.soc_pct for item in rows])
    temperature = np.concatenate([item.temperature_c for item in rows])
    delayed = np.concatenate([item.delayed_current_a for item in rows])
    errors = np.full(volts.size, np.nan)
    refused: InputError | None = None
    for training, held_out in folds(rows):
        shape = int(training.sum()), KT + 1 + delayed.shape[1]
        try:
            current = delayed[training, 0]
            check_identifiable("", shape, float(np.ptp(soc[training])), float(np.ptp(current)))
        except InputError as error:
            if len(rows) < LOGS_AT_LEAST:
                raise  # a log that identifies a model does so without one of its blocks
            refused = error
            continue
        model, _ = fit_voltage_model(rows, options, training, with_kt_prior=with_kt_prior)
        lo, hi = model.soc_range_pct
        seen = held_out & (soc > lo - 1.0) & (soc < hi + 1.0)
        errors[seen] = volts[seen] - model.voltage(soc[seen], temperature[seen], delayed[seen])
    if refused is not None and not np.isfinite(errors).any():
        raise refused
    return np.split(errors, np.cumsum([len(item) for item in rows])[:-1])


def design_matrix(rows: FitRows, epsilon: float, t_ref_c: float) -> FloatArray:
    """Return the columns k0 … k7, kt, R1 … Rn on the rows of a log, shape (m, 9 + n)."""
    return np.column_stack(
        [ocv_basis(rows.soc_pct, epsilon), rows.dequantized_c - t_ref_c, rows.delayed_current_a]
    )


def stacked(
    rows: Sequence[FitRows], options: FitOptions
) -> tuple[FloatArray, FloatArray, NDArray[np.intp]]:
    """Return design matrix (n, 9 + delays), voltage [V] and block number (n,) of all logs."""
    columns = np.vstack([design_matrix(item, options.epsilon, options.t_ref_c) for item in rows])
    volts = np.concatenate([item.voltage_v for item in rows])
    return columns, volts, block_numbers(rows, CLUSTER_S)


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

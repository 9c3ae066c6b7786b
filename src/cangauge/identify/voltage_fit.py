"""Rows of logs → coefficients: the columns, the bounds, the fit, and its error held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.identify.rows import LOGS_AT_LEAST, FitOptions, FitRows, fit_rows, folds
from cangauge.inference.least_squares import BLOCK_S, Held, Solution, how_firmly, solve
from cangauge.logs.log import Log
from cangauge.model.voltage_model import (
    BASIS_NAMES,
    SLOPE_AT_LEAST,
    SLOPE_POINTS,
    VoltageModel,
    ocv_basis,
    ocv_basis_slope,
)

SLOPE_CHECKS = 201
"""Points over the identified SoC at which the pseudo-OCV must rise."""

REFINED_AT_MOST = 6
"""So often are points added between which it fell."""

KT = len(BASIS_NAMES)
"""Where the temperature's coefficient is among all."""

SOC_SPAN_AT_LEAST_PCT = 2.0
"""A fit over less SoC than this would be all extrapolation."""


def prepare(logs: Sequence[Log], options: FitOptions) -> list[FitRows]:
    """Return the rows of each log that take part in the fit."""
    if options.capacity_ah is None:
        raise InputError("the capacity is not known", field="capacity_ah")
    return [
        fit_rows(
            log,
            capacity_ah=options.capacity_ah,
            delay_s=options.delay_s,
            rate_hz=options.rate_hz,
            initial_soc_pct=options.initial_soc_pct,
        )
        for log in logs
    ]


def fit_voltage_model(
    rows: Sequence[FitRows],
    options: FitOptions,
    keep: NDArray[np.bool_] | None = None,
    *,
    is_held: bool = True,
) -> tuple[VoltageModel, Solution]:
    """Fit the coefficients.

    Parameters
    ----------
    rows : sequence of FitRows
    options : FitOptions
    keep : array of bool, optional
        Rows of all logs in order that count; all by default.
    is_held : bool
        Whether kt is held as firmly as the rows leave it open (`identify.temperature`).

    Raises
    ------
    InputError
        If the rows cannot identify the model.
    """
    columns, volts, block = stack(rows, options)
    soc = np.concatenate([item.soc_pct for item in rows])
    temperature = np.concatenate([item.temperature_c for item in rows])
    current = np.concatenate([item.delayed_current_a[:, 0] for item in rows])
    number = np.repeat(np.arange(len(rows)), [len(item) for item in rows])
    if keep is not None:
        columns, volts, block, number = columns[keep], volts[keep], block[keep], number[keep]
        soc, temperature, current = soc[keep], temperature[keep], current[keep]
    _check_identifiable(rows, soc, current, columns.shape)
    span = float(soc.min()), float(soc.max())
    solution = _rising(columns, volts, block, span, options.epsilon)
    if is_held:
        lengths = np.bincount(number, minlength=len(rows)).tolist()
        residual_v = volts - columns @ solution.coefficients
        held = how_firmly(columns, residual_v, volts, lengths, KT)
        row = np.zeros(columns.shape[1])
        row[KT] = held.weight
        solution = _rising(
            np.vstack([columns, row]),
            np.append(volts, 0.0),
            np.append(block, block.max() + 1),
            span,
            options.epsilon,
        )
        solution = _opened(solution, held)
    x = [float(value) for value in solution.coefficients]
    return VoltageModel(
        ocv_v=tuple(x[: len(BASIS_NAMES)]),
        kt_v_per_k=x[len(BASIS_NAMES)],
        resistance_ohm=tuple(x[len(BASIS_NAMES) + 1 :]),
        delay_s=options.delay_s,
        epsilon=options.epsilon,
        t_ref_c=options.t_ref_c,
        soc_range_pct=span,
        temperature_range_c=(float(temperature.min()), float(temperature.max())),
        current_range_a=(float(current.min()), float(current.max())),
    ), solution


def _rising(
    columns: FloatArray,
    volts: FloatArray,
    block: NDArray[np.intp],
    span_pct: tuple[float, float],
    epsilon: float,
) -> Solution:
    """Return the least-squares solution whose pseudo-OCV rises over a span of SoC."""
    at_least = SLOPE_AT_LEAST * float(np.median(volts))
    grid = np.linspace(*span_pct, SLOPE_CHECKS)
    between = np.linspace(*span_pct, SLOPE_POINTS)
    for _ in range(REFINED_AT_MOST):
        bounds = np.zeros((grid.size, columns.shape[1]))
        bounds[:, : len(BASIS_NAMES)] = ocv_basis_slope(grid, epsilon)
        solution = solve(columns, volts, block, bounds, at_least)
        slope = ocv_basis_slope(between, epsilon) @ solution.coefficients[: len(BASIS_NAMES)]
        if np.all(slope > 0.0):
            break
        # Near empty the curve bends so sharply that it may fall between two points and rise again.
        grid = np.union1d(grid, between[slope < at_least])
    return solution


def _opened(solution: Solution, held: Held) -> Solution:
    """Return a solution with how far the logs leave the temperature's coefficient open.

    The others move with it: what is taken from kt the pseudo-OCV takes over.
    """
    more = max(held.held_std_v_per_k**2 - float(solution.std_error[KT]) ** 2, 0.0)
    moves = held.others.copy()
    moves[KT] = 1.0
    std_error = np.sqrt(solution.std_error**2 + more * moves**2)
    return replace(solution, std_error=std_error, held=held)


def held_out_errors(
    rows: Sequence[FitRows], options: FitOptions, *, is_held: bool = True
) -> list[FloatArray]:
    """Return each log's errors [V] under fits that did not see the rows.

    NaN where no fold judged a row, or only with a fit that did not see its SoC: how far the
    model can be trusted beyond its range is another question (the estimate is flagged there). NaN
    too for a whole log without which the others identify no model.

    Raises
    ------
    InputError
        If a fold cannot be fitted, or none leaves logs that identify a model.
    """
    volts = np.concatenate([item.voltage_v for item in rows])
    soc = np.concatenate([item.soc_pct for item in rows])
    temperature = np.concatenate([item.temperature_c for item in rows])
    delayed = np.concatenate([item.delayed_current_a for item in rows])
    errors = np.full(volts.size, np.nan)
    refused: InputError | None = None
    for fitted, left_out in folds(rows):
        shape = int(fitted.sum()), KT + 1 + delayed.shape[1]
        try:
            _check_identifiable(rows, soc[fitted], delayed[fitted, 0], shape)
        except InputError as error:
            if len(rows) < LOGS_AT_LEAST:
                raise  # a log that identifies a model does so without any of its blocks
            refused = error
            continue
        model, _ = fit_voltage_model(rows, options, fitted, is_held=is_held)
        lo, hi = model.soc_range_pct
        judged = left_out & (soc > lo - 1.0) & (soc < hi + 1.0)
        errors[judged] = volts[judged] - model.voltage(
            soc[judged], temperature[judged], delayed[judged]
        )
    if refused is not None and not np.isfinite(errors).any():
        raise refused
    return np.split(errors, np.cumsum([len(item) for item in rows])[:-1])


def columns_of(rows: FitRows, epsilon: float, t_ref_c: float) -> FloatArray:
    """Return the model's columns k0 … k7, kt, R1 … Rn on the rows, shape (m, 9 + n)."""
    return np.column_stack(
        [ocv_basis(rows.soc_pct, epsilon), rows.between_c - t_ref_c, rows.delayed_current_a]
    )


def stack(
    rows: Sequence[FitRows], options: FitOptions
) -> tuple[FloatArray, FloatArray, NDArray[np.intp]]:
    """Return columns (n, 9 + delays), voltage [V] (n,) and block numbers (n,) of all logs."""
    columns = np.vstack([columns_of(item, options.epsilon, options.t_ref_c) for item in rows])
    volts = np.concatenate([item.voltage_v for item in rows])
    return columns, volts, blocks_of(rows)


def blocks_of(rows: Sequence[FitRows]) -> NDArray[np.intp]:
    """Return the number of each row's block of `BLOCK_S`, over all logs in order, shape (n,)."""
    blocks: list[NDArray[np.intp]] = []
    first = 0
    for item in rows:
        number = ((item.time_s - item.time_s[0]) // BLOCK_S).astype(np.intp) + first
        first = int(number[-1]) + 1
        blocks.append(number)
    return np.concatenate(blocks)


def _check_identifiable(
    rows: Sequence[FitRows], soc: FloatArray, current: FloatArray, shape: tuple[int, ...]
) -> None:
    where = ", ".join(item.name for item in rows)
    if shape[0] < 4 * shape[1]:
        raise InputError(
            f"{shape[0]} rows cannot identify {shape[1]} coefficients", source=where,
            cure="give a longer log or more logs",
        )  # fmt: skip
    if np.ptp(soc) < SOC_SPAN_AT_LEAST_PCT:
        raise InputError(
            f"the SoC moves by only {np.ptp(soc):.2f} %, too little for a voltage model",
            source=where,
            field="soc_pct",
            cure=f"give logs that together cover at least {SOC_SPAN_AT_LEAST_PCT:.0f} %,"
            " better the whole range",
        )
    if np.ptp(current) == 0.0:
        raise InputError(
            "the current never changes, so no resistance can be told from the open-circuit voltage",
            source=where,
            field="current_a",
            cure="give a log with changing load",
        )

"""Linearization of the extended model: residual, its derivatives, and Gauss–Newton steps.

The residual is U_corrected − U_model. The column of an effect's amplitude is minus the derivative
of the residual, by a finite difference through the effect's own offline code, so the fit weighs
exactly what the extended model computes.

Coefficients, amplitudes and shapes with many trial values (time constants, widths) are fitted
jointly. The model is nearly linear in the first two. Each Gauss–Newton step is a convex problem
with the physical bounds and a rising pseudo-OCV.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.inference.least_squares import Solution, solve
from cangauge.inference.rows import Mask, SampledLog
from cangauge.model.effects.base import PackState, Parameter
from cangauge.model.effects.library import STEP, Candidate
from cangauge.model.extended import ExtendedModel, Prediction
from cangauge.model.voltage_model import BASIS_NAMES, SLOPE_AT_LEAST, ocv_basis_slope

SLOPE_CHECKS = 201
"""Points over the identified SoC at which the pseudo-OCV must rise."""


SHAPE_STEP = (0.7, 1.4)
"""Factors by which one Gauss–Newton step may change a shape: the model is not linear in it."""

REFINED_FROM = 3
"""A shape with fewer trial values is a discrete choice; others are continuous."""

STEPS_AT_MOST, HALVINGS_AT_MOST = 12, 4
CONVERGED, ROUGHLY_CONVERGED = 1e-5, 1e-3
"""Relative decrease of the sum of squares at which the iteration stops; roughly, in a search."""

WIDE_KT_PRIOR_PER_K = 2.5e-3
"""Wide prior standard deviation of kt, relative to the voltage [1/K]: 10 mV/K per cell, more than
the published one. Cross-validation tests kt; the prior only defines it at constant temperature."""


def residual(log: SampledLog, model: ExtendedModel) -> FloatArray:
    """Return U_corrected − U_model on the rows of a log [V], shape (m,)."""
    return model.predict(log.signals, log.initial_soc_pct, log.at).residual_v


def stacked_residual(model: ExtendedModel, logs: Sequence[SampledLog]) -> FloatArray:
    """Return U_corrected − U_model on the rows of all logs in order [V], shape (n,)."""
    return np.concatenate([residual(log, model) for log in logs])


def predict_logs(model: ExtendedModel, logs: Sequence[SampledLog]) -> list[Prediction]:
    """Return the model's prediction for each log, on the rows of the fit."""
    return [model.predict(item.signals, item.initial_soc_pct, item.at) for item in logs]


def pack_state(log: SampledLog, model: ExtendedModel) -> PackState:
    """Return the inputs of the extra voltages, on the rows of the log."""
    corrected = model.corrected(log.signals)
    return model.state(corrected, model.counted_soc(corrected, log.initial_soc_pct), log.at)


def with_modelled_voltage(log: SampledLog, model: ExtendedModel) -> SampledLog:
    """Return the log with the model's voltage instead of the measured one on its rows.

    The derivative by an effect in proportion to the voltage would otherwise contain its noise.
    """
    volts = log.signals.voltage_v.copy()
    volts[log.at] -= residual(log, model)
    return replace(log, signals=replace(log.signals, voltage_v=volts))


def effect_columns(
    log: SampledLog,
    model: ExtendedModel,
    candidate: Candidate,
    residual_v: FloatArray,
    state: PackState | None = None,
) -> FloatArray:
    """Return minus the derivative of the residual by each amplitude, shape (m, k).

    Parameters
    ----------
    log : SampledLog
        From `with_modelled_voltage`.
    model : ExtendedModel
        Without the candidate.
    candidate : Candidate
    residual_v : array of shape (m,)
        Residual without the candidate [V].
    state : PackState, optional
        From `pack_state`; a shortcut for effects that only add a voltage.
    """
    columns = np.empty((residual_v.size, len(candidate.amplitudes)))
    for k, step in enumerate(candidate.steps):
        amplitude = np.zeros(len(candidate.amplitudes))
        amplitude[k] = step
        values = candidate.values(amplitude)
        if state is not None and candidate.effect.adds_voltage_only:
            extra = candidate.effect.extra_voltage_at(state, values, model.model, model.pack)
            columns[:, k] = 0.0 if extra is None else extra / step
            continue
        extended = model.with_effect(candidate.effect, values)
        columns[:, k] = (residual_v - residual(log, extended)) / step
    return columns


@dataclass(frozen=True)
class FreeParameter:
    """A fitted parameter of an effect."""

    effect: int
    """Index of the effect in the model."""
    name: str
    value: float
    low: float
    high: float
    step: float
    """Finite-difference step."""
    is_shape: bool

    def step_bounds(self) -> tuple[float, float]:
        """Return the bounds of the change in one Gauss–Newton step."""
        low, high = self.low - self.value, self.high - self.value
        if self.is_shape:
            # Sorted, since a skew may be negative.
            least, most = sorted((factor - 1.0) * self.value for factor in SHAPE_STEP)
            low, high = max(low, least), min(high, most)
        return min(low, 0.0), max(high, 0.0)


@dataclass(frozen=True, eq=False)
class Linearization:
    """The residual of all logs near a model, residual_v − columns·change; n rows."""

    model: ExtendedModel
    predictions: tuple[Prediction, ...]
    """The model's prediction for each log."""
    free: tuple[FreeParameter, ...]
    columns: FloatArray
    """Of the voltage model's coefficients, then of `free`, shape (n, p)."""
    residual_v: FloatArray
    """Shape (n,)."""
    kt_weight: float
    """Weight of the prior row kt = 0 V/K [K]; see `WIDE_KT_PRIOR_PER_K`."""

    @property
    def prior_row(self) -> FloatArray:
        """Prior row of kt in [columns | residual], shape (1, p + 1)."""
        kt = len(BASIS_NAMES)
        row = np.zeros((1, self.columns.shape[1] + 1))
        row[0, kt] = self.kt_weight
        row[0, -1] = -self.kt_weight * self.model.model.kt_v_per_k
        return row

    def constraints(self, soc_range_pct: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
        """Return matrix (m, p) and lower bounds (m,) of a change: slope and parameter bounds."""
        voltage_model = self.model.model
        n, p = len(BASIS_NAMES), self.columns.shape[1]
        slopes = ocv_basis_slope(np.linspace(*soc_range_pct, SLOPE_CHECKS), voltage_model.epsilon)
        rising = np.zeros((SLOPE_CHECKS, p))
        rising[:, :n] = slopes
        needed = SLOPE_AT_LEAST * self.model.pack.voltage_v - slopes @ np.array(voltage_model.ocv_v)
        kept = np.eye(p)[p - len(self.free) :]
        spans = np.array([item.step_bounds() for item in self.free]).reshape(-1, 2)
        return (
            np.vstack([rising, kept, -kept]),
            # No change must be feasible despite rounding.
            np.minimum(np.concatenate((needed, spans[:, 0], -spans[:, 1])), 0.0),
        )


def free_parameters(model: ExtendedModel) -> tuple[FreeParameter, ...]:
    """Return the fitted parameters of a model's effects."""
    found = []
    for number, (effect, values) in enumerate(model.effects):
        for parameter in effect.parameters:
            is_shape = parameter not in effect.amplitudes
            if is_shape and not _is_continuous(parameter):
                continue
            value = values[parameter.name]
            low, high = parameter.bounds(model.pack)
            step = STEP * (value if is_shape and value else high - low)
            found.append(
                FreeParameter(
                    number,
                    parameter.name,
                    value,
                    min(low, value),
                    max(high, value),
                    step if value + step <= high else -step,
                    is_shape,
                )
            )
    return tuple(found)


def _is_continuous(parameter: Parameter) -> bool:
    if parameter.grid is None:
        return False
    return parameter.neutral is not None or len(parameter.grid) >= REFINED_FROM


def linearize(
    model: ExtendedModel, logs: Sequence[SampledLog], kt_weight: float | None = None
) -> Linearization:
    """Return the linearization at a model; the weight of kt follows from the residual there."""
    at_model = predict_logs(model, logs)
    residual_v = np.concatenate([item.residual_v for item in at_model])
    columns = [coefficient_columns(model, logs, at_model)]
    free = free_parameters(model)
    for item in free:
        moved = _with_value(model, item, item.value + item.step)
        columns.append((residual_v - stacked_residual(moved, logs)) / item.step)
    if kt_weight is None:
        kt_weight = _kt_weight(model, at_model)
    return Linearization(
        model, tuple(at_model), free, np.column_stack(columns), residual_v, kt_weight
    )


def _kt_weight(model: ExtendedModel, at_model: Sequence[Prediction]) -> float:
    """Return the weight of the prior row kt = 0 V/K for white errors [K]."""
    residual_v = np.concatenate([item.residual_v for item in at_model])
    return float(np.sqrt(np.mean(residual_v**2))) / (WIDE_KT_PRIOR_PER_K * model.pack.voltage_v)


def coefficient_columns(
    model: ExtendedModel, logs: Sequence[SampledLog], at_model: Sequence[Prediction]
) -> FloatArray:
    """Return the derivatives of the voltage by k0 … k7, kt, R1 … Rn, shape (n, p).

    Without effects these are the columns of the fit (`voltage_fit.design_matrix`). An effect may
    scale the drop, or change the temperature, that a coefficient multiplies.
    """
    voltage_model = model.model
    residual_v = np.concatenate([item.residual_v for item in at_model])
    soc = np.concatenate([item.soc_pct[item.rows] for item in at_model])
    coefficients = voltage_model.coefficients
    columns = [voltage_model.pseudo_ocv_columns(soc)]
    # The model is linear in kt and the resistances, so the step size does not matter.
    for k in range(len(BASIS_NAMES), coefficients.size):
        step = np.zeros(coefficients.size)
        step[k] = max(abs(coefficients[k]), 1e-3)
        moved = replace(model, model=voltage_model.with_coefficients(coefficients + step))
        columns.append((residual_v - stacked_residual(moved, logs)) / step[k])
    return np.column_stack(columns)


def changed_model(linear: Linearization, change: FloatArray) -> ExtendedModel:
    """Return the model after a change of its coefficients and free parameters, shape (p,).

    Raises
    ------
    InputError
        If the pseudo-OCV would not rise.
    """
    model = linear.model
    coefficients = model.model.coefficients
    moved = replace(
        model, model=model.model.with_coefficients(coefficients + change[: coefficients.size])
    )
    for item, by in zip(linear.free, change[coefficients.size :].tolist(), strict=True):
        moved = _with_value(moved, item, min(max(item.value + by, item.low), item.high))
    return moved


def _with_value(model: ExtendedModel, item: FreeParameter, value: float) -> ExtendedModel:
    effects = list(model.effects)
    effect, values = effects[item.effect]
    effects[item.effect] = (effect, {**values, item.name: value})
    return replace(model, effects=tuple(effects))


def with_ranges(
    model: ExtendedModel, at_model: Sequence[Prediction], keep: Mask | None = None
) -> ExtendedModel:
    """Return the model with the ranges of SoC, temperature and current of the corrected rows.

    Parameters
    ----------
    model : ExtendedModel
    at_model : sequence of Prediction
        The model's prediction for each log.
    keep : array of bool, shape (n,), optional
        Rows of all logs to consider; all by default.
    """
    kept = slice(None) if keep is None else keep

    def span(values: Sequence[FloatArray]) -> tuple[float, float]:
        of_rows = np.concatenate(
            [each[item.rows] for each, item in zip(values, at_model, strict=True)]
        )[kept]
        return float(of_rows.min()), float(of_rows.max())

    ranged = replace(
        model.model,
        soc_range_pct=span([item.soc_pct for item in at_model]),
        temperature_range_c=span([item.signals.temperature_c for item in at_model]),
        current_range_a=span([item.signals.current_a for item in at_model]),
    )
    return replace(model, model=ranged)


def gauss_newton_step(linear: Linearization, keep: Mask | None = None) -> FloatArray:
    """Return the least-squares change on some of the rows, within the constraints, shape (p,).

    Parameters
    ----------
    linear : Linearization
        The pseudo-OCV must rise over its model's SoC range.
    keep : array of bool, shape (n,), optional
        Rows to fit; all by default.
    """
    table = np.column_stack([linear.columns, linear.residual_v])
    kept = table if keep is None else table[keep]
    factor = np.linalg.qr(np.vstack([kept, linear.prior_row])).R
    return constrained_change(factor, linear.constraints(linear.model.model.soc_range_pct))


def constrained_change(
    factor: FloatArray, constraints: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """Return the least-squares change from a triangular factor of [columns | residual]."""
    rows = np.arange(factor.shape[0])
    return solve(factor[:, :-1], factor[:, -1], rows, *constraints).coefficients


def fit_extended(
    model: ExtendedModel, logs: Sequence[SampledLog], converged: float = CONVERGED
) -> ExtendedModel:
    """Return the model fitted to the logs by Gauss–Newton steps, with the ranges of the logs."""
    at_model = predict_logs(model, logs)
    weight = _kt_weight(model, at_model)
    model, square = _with_ranges_and_square(model, at_model, weight)
    for _ in range(STEPS_AT_MOST):
        linear = linearize(model, logs, weight)
        change = gauss_newton_step(linear)
        for _halving in range(HALVINGS_AT_MOST):
            try:
                trial = changed_model(linear, change)
                trial, now = _with_ranges_and_square(trial, predict_logs(trial, logs), weight)
            except InputError:
                now = np.inf
            if now < square:
                break
            change = 0.5 * change
        else:
            return model
        model, before, square = trial, square, now
        if square > (1.0 - converged) * before:
            break
    return model


def _with_ranges_and_square(
    model: ExtendedModel, at_model: Sequence[Prediction], kt_weight: float
) -> tuple[ExtendedModel, float]:
    """Return the model with the ranges of the logs, and its sum of squares [V²]."""
    square = float(sum(item.residual_v @ item.residual_v for item in at_model))
    return with_ranges(model, at_model), square + (kt_weight * model.model.kt_v_per_k) ** 2


def solution_at(linear: Linearization, block: NDArray[np.intp]) -> Solution:
    """Return the parameters of a fitted model with their standard errors.

    Parameters
    ----------
    linear : Linearization
        At the fitted model.
    block : array of shape (n,)
        Rows with the same number may have correlated residuals.

    Returns
    -------
    Solution
        Coefficients of the voltage model, then the values of `linear.free`.
    """
    constraints = linear.constraints(linear.model.model.soc_range_pct)
    columns = np.vstack([linear.columns, linear.prior_row[:, :-1]])
    residual_v = np.append(linear.residual_v, linear.prior_row[0, -1])
    block = np.append(block, block.max() + 1)
    found = solve(columns, residual_v, block, *constraints)
    plain = solve(columns, residual_v, block, None, 0.0).coefficients
    falls = bool(np.any((constraints[0] @ plain - constraints[1])[:SLOPE_CHECKS] < 0.0))
    at = np.concatenate((linear.model.model.coefficients, [item.value for item in linear.free]))
    return replace(found, coefficients=at, constrained=falls)

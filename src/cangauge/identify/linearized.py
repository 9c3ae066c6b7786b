"""A log as the extended model sees it: its residual, and how that moves with an effect.

The residual is U_corrected − U_model. An effect's column is minus the derivative of the residual
by its amplitude, taken by a finite difference through the effect's own offline code, so what is
weighed is what the extended model does.

The extended model near where it stands: its numbers, how its residual moves with them, bounds.

Coefficients, amplitudes and those shapes that have many values (time constants, widths) are free
together. The model is nearly linear in the first two; it is fitted by Gauss and Newton's steps on
its own equations, each a convex problem under the physical bounds and a rising pseudo-OCV.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.identify.rows import FitOptions, FitRows
from cangauge.identify.voltage_fit import SLOPE_CHECKS, prepare
from cangauge.inference.least_squares import Solution, solve
from cangauge.logs.log import Log
from cangauge.model.charge import discharged_ah
from cangauge.model.effects.base import PackState, Parameter, Signals
from cangauge.model.effects.library import Candidate
from cangauge.model.extended import ExtendedModel, Prediction
from cangauge.model.voltage_model import BASIS_NAMES, SLOPE_AT_LEAST, ocv_basis_slope

# --- A log as the extended model sees it: its residual, and how that moves with an effect


@dataclass(frozen=True, eq=False)
class Prepared:
    """A log with the rows that the diagnosis uses."""

    log: Log
    rows: FitRows
    at: NDArray[np.intp]
    """Index of the rows in the log, shape (m,)."""
    initial_soc_pct: float
    """SoC at the log's first sample [%]."""
    signals: Signals
    """The log's signals at its own rate."""

    def remembering(self) -> Prepared:
        """Return the same, with the current's history kept as long as it: quicker, and larger."""
        return replace(self, signals=self.signals.remembering())


def prepare_log(log: Log, options: FitOptions) -> Prepared:
    """Return a log with its rows and its count.

    Parameters
    ----------
    log : Log
    options : FitOptions
        The model's capacity, rate and delays; the initial SoC if one was given.

    Raises
    ------
    InputError
        If the log gives no rows, or its count leaves 0–100 %.
    """
    rows = prepare([log], options)[0]
    at = np.searchsorted(log.time_s, rows.time_s)
    out_ah = discharged_ah(log.time_s, log.current_a)
    first = float(rows.soc_pct[0] + 100.0 * out_ah[at[0]] / (options.capacity_ah or np.nan))
    signals = Signals(log.time_s, log.current_a, log.voltage_v, log.temperature_c)
    return Prepared(log, rows, at, first, signals)


def residual(prepared: Prepared, model: ExtendedModel) -> FloatArray:
    """Return U_corrected − U_model on the rows, shape (m,) [V]."""
    prediction = model.predict(prepared.signals, prepared.initial_soc_pct, prepared.at)
    return prediction.residual_v


def state_of(prepared: Prepared, model: ExtendedModel) -> PackState:
    """Return what extra voltages depend on, for all of the log's rows."""
    corrected = model.corrected(prepared.signals)
    return model.state(corrected, model.counted_soc(corrected, prepared.initial_soc_pct))


def effect_columns(
    prepared: Prepared,
    model: ExtendedModel,
    candidate: Candidate,
    here: FloatArray,
    state: PackState | None = None,
) -> FloatArray:
    """Return minus the residual's change per unit of each amplitude, shape (m, k).

    Parameters
    ----------
    prepared : Prepared
        With the model's voltage in place of the measured one: an effect in proportion to the
        voltage would else follow its noise.
    model : ExtendedModel
        Without the candidate.
    candidate : Candidate
    here : array of shape (m,)
        Residual without it [V].
    state : PackState, optional
        From `state_of`: an effect that only adds a voltage needs nothing else, and is quicker.
    """
    columns = np.empty((here.size, len(candidate.amplitudes)))
    for k, step in enumerate(candidate.steps):
        moved = np.zeros(len(candidate.amplitudes))
        moved[k] = step
        values = candidate.values(moved)
        if state is not None and candidate.effect.adds_voltage_only:
            extra = candidate.effect.extra_voltage(state, values, model.model, model.pack)
            columns[:, k] = 0.0 if extra is None else extra[prepared.at] / step
            continue
        with_it = model.with_effect(candidate.effect, values)
        columns[:, k] = (here - residual(prepared, with_it)) / step
    return columns


def as_modelled(prepared: Prepared, model: ExtendedModel) -> Prepared:
    """Return the log's signals with the model's voltage in place of the measured one."""
    signals = prepared.signals
    everywhere = np.arange(signals.time_s.size)
    prediction = model.predict(signals, prepared.initial_soc_pct, everywhere)
    volts = signals.voltage_v - prediction.residual_v
    return replace(prepared, signals=replace(signals, voltage_v=volts))


# --- The extended model near where it stands: its numbers, how its residual moves with them,…

Mask = NDArray[np.bool_]

STEP = 0.02
"""Finite-difference step, relative to the width of an amplitude's bounds or to a shape."""

SHAPE_WITHIN = (0.7, 1.4)
"""By how much one Gauss–Newton step may change a shape: it is far from linear in it."""

REFINED_FROM = 3
"""A shape with fewer values to try is a choice between them; others are refined in between."""

STEPS_AT_MOST, HALVINGS_AT_MOST = 12, 4
CONVERGED, ROUGHLY_CONVERGED = 1e-5, 1e-3
"""The steps end when the sum of squares falls by less than this part; roughly, in a search."""


KT_WITHIN_PER_K = 2.5e-3
"""How large kt may well be, in parts of the voltage [1/K]: 10 mV/K a cell, more than the published
one. The logs that are left out judge it; but a temperature that never moves says nothing of it, and
it could be anything."""


@dataclass(frozen=True)
class Free:
    """One number of an effect that is fitted."""

    effect: int
    """Which of the model's effects."""
    name: str
    value: float
    low: float
    high: float
    step: float
    """Over which the residual's change is taken."""
    is_shape: bool

    def in_one_step(self) -> tuple[float, float]:
        """Return how far one step may change it."""
        low, high = self.low - self.value, self.high - self.value
        if self.is_shape:
            # A skew may be negative: then more of it is less.
            least, most = sorted((part - 1.0) * self.value for part in SHAPE_WITHIN)
            low, high = max(low, least), min(high, most)
        return min(low, 0.0), max(high, 0.0)


@dataclass(frozen=True, eq=False)
class Linear:
    """The residual of all logs near a model: residual − columns·change; n rows in all."""

    model: ExtendedModel
    here: tuple[Prediction, ...]
    """What the model says of each log."""
    free: tuple[Free, ...]
    columns: FloatArray
    """Of the voltage model's coefficients, then of `free`, shape (n, p)."""
    residual_v: FloatArray
    """Shape (n,)."""
    kt_weight: float
    """Weight of a row that says kt is 0 V/K [K] (`KT_WITHIN_PER_K`)."""

    @property
    def holding(self) -> FloatArray:
        """The row that holds kt, of [columns | residual], shape (1, p + 1)."""
        kt = len(BASIS_NAMES)
        row = np.zeros((1, self.columns.shape[1] + 1))
        row[0, kt] = self.kt_weight
        row[0, -1] = -self.kt_weight * self.model.model.kt_v_per_k
        return row

    def limits(self, soc_range_pct: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
        """Return matrix and lower limits of what a change must respect, (m, p) and (m,)."""
        voltage_model = self.model.model
        n, p = len(BASIS_NAMES), self.columns.shape[1]
        slopes = ocv_basis_slope(np.linspace(*soc_range_pct, SLOPE_CHECKS), voltage_model.epsilon)
        rising = np.zeros((SLOPE_CHECKS, p))
        rising[:, :n] = slopes
        needed = SLOPE_AT_LEAST * self.model.pack.voltage_v - slopes @ np.array(voltage_model.ocv_v)
        kept = np.eye(p)[p - len(self.free) :]
        spans = np.array([item.in_one_step() for item in self.free]).reshape(-1, 2)
        return (
            np.vstack([rising, kept, -kept]),
            # Where the model stands is allowed, whatever the rounding.
            np.minimum(np.concatenate((needed, spans[:, 0], -spans[:, 1])), 0.0),
        )


def free_of(model: ExtendedModel) -> tuple[Free, ...]:
    """Return the numbers of a model's effects that are fitted."""
    found = []
    for number, (effect, values) in enumerate(model.effects):
        for parameter in effect.parameters:
            is_shape = parameter not in effect.amplitudes
            if is_shape and not _refined(parameter):
                continue
            value = values[parameter.name]
            low, high = parameter.bounds(model.pack)
            step = STEP * (value if is_shape and value else high - low)
            found.append(
                Free(
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


def _refined(parameter: Parameter) -> bool:
    if parameter.grid is None:
        return False
    return parameter.neutral is not None or len(parameter.grid) >= REFINED_FROM


def predictions(model: ExtendedModel, logs: Sequence[Prepared]) -> list[Prediction]:
    """Return what the model says of each log, on the rows of the fit."""
    return [model.predict(item.signals, item.initial_soc_pct, item.at) for item in logs]


def residual_of(model: ExtendedModel, logs: Sequence[Prepared]) -> FloatArray:
    """Return U_corrected − U_model on the rows of all logs, one after another [V], shape (n,)."""
    return np.concatenate([item.residual_v for item in predictions(model, logs)])


def linearise(
    model: ExtendedModel, logs: Sequence[Prepared], kt_weight: float | None = None
) -> Linear:
    """Return the residual of the logs near a model; kt is held by the model's errors there."""
    here = predictions(model, logs)
    residual_v = np.concatenate([item.residual_v for item in here])
    columns = [coefficient_columns(model, logs, here)]
    free = free_of(model)
    for item in free:
        moved = _with_value(model, item, item.value + item.step)
        columns.append((residual_v - residual_of(moved, logs)) / item.step)
    if kt_weight is None:
        kt_weight = _kt_weight(model, here)
    return Linear(model, tuple(here), free, np.column_stack(columns), residual_v, kt_weight)


def _kt_weight(model: ExtendedModel, here: Sequence[Prediction]) -> float:
    """Return the weight of a row that holds kt at 0, errors taken as white [K]."""
    residual_v = np.concatenate([item.residual_v for item in here])
    within_v_per_k = KT_WITHIN_PER_K * model.pack.voltage_v
    return float(np.sqrt(np.mean(residual_v**2))) / within_v_per_k


def coefficient_columns(
    model: ExtendedModel, logs: Sequence[Prepared], here: Sequence[Prediction]
) -> FloatArray:
    """Return how the voltage moves with k0 … k7, kt, R1 … Rn, effects included, shape (n, p).

    Without effects these are the columns of the fit (`voltage_fit.columns_of`). An effect may
    scale the drop, or the temperature, that a coefficient multiplies.
    """
    voltage_model = model.model
    residual_v = np.concatenate([item.residual_v for item in here])
    soc = np.concatenate([item.soc_pct[item.rows] for item in here])
    coefficients = voltage_model.coefficients
    columns = [voltage_model.pseudo_ocv_columns(soc)]
    # The model is linear in kt and the resistances, whatever effects scale them: any step will do.
    for k in range(len(BASIS_NAMES), coefficients.size):
        step = np.zeros(coefficients.size)
        step[k] = max(abs(coefficients[k]), 1e-3)
        moved = replace(model, model=voltage_model.with_coefficients(coefficients + step))
        columns.append((residual_v - residual_of(moved, logs)) / step[k])
    return np.column_stack(columns)


def moved_by(linear: Linear, change: FloatArray) -> ExtendedModel:
    """Return the model after a change of its coefficients and free numbers.

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


def _with_value(model: ExtendedModel, item: Free, value: float) -> ExtendedModel:
    effects = list(model.effects)
    effect, values = effects[item.effect]
    effects[item.effect] = (effect, {**values, item.name: value})
    return replace(model, effects=tuple(effects))


def spanning(
    model: ExtendedModel, here: Sequence[Prediction], keep: Mask | None = None
) -> ExtendedModel:
    """Return the model with its ranges set to what the (corrected) rows of the logs span.

    Parameters
    ----------
    model : ExtendedModel
    here : sequence of Prediction
        What the model says of each log.
    keep : array of bool, shape (n,), optional
        Rows of all logs that count; all by default.
    """
    kept = slice(None) if keep is None else keep

    def span(values: Sequence[FloatArray]) -> tuple[float, float]:
        of_rows = np.concatenate(
            [each[item.rows] for each, item in zip(values, here, strict=True)]
        )[kept]
        return float(of_rows.min()), float(of_rows.max())

    ranged = replace(
        model.model,
        soc_range_pct=span([item.soc_pct for item in here]),
        temperature_range_c=span([item.signals.temperature_c for item in here]),
        current_range_a=span([item.signals.current_a for item in here]),
    )
    return replace(model, model=ranged)


def step_on(linear: Linear, keep: Mask | None = None) -> FloatArray:
    """Return the change that fits some of the rows best, within bounds.

    Parameters
    ----------
    linear : Linear
        Its model's SoC range is where the pseudo-OCV is held to rise.
    keep : array of bool, shape (n,), optional
        Rows to fit; all by default.
    """
    table = np.column_stack([linear.columns, linear.residual_v])
    kept = table if keep is None else table[keep]
    compact = np.linalg.qr(np.vstack([kept, linear.holding])).R
    return best_change(compact, linear.limits(linear.model.model.soc_range_pct))


def best_change(compact: FloatArray, limits: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Return the change that fits best, from a triangular factor of [columns | residual]."""
    rows = np.arange(compact.shape[0])
    return solve(compact[:, :-1], compact[:, -1], rows, *limits).coefficients


def refine(
    model: ExtendedModel, logs: Sequence[Prepared], converged: float = CONVERGED
) -> ExtendedModel:
    """Return the model fitted to the logs on its own equations, its ranges those of the logs."""
    here = predictions(model, logs)
    weight = _kt_weight(model, here)
    model, square = _ranged(model, here, weight)
    for _ in range(STEPS_AT_MOST):
        linear = linearise(model, logs, weight)
        change = step_on(linear)
        for _halving in range(HALVINGS_AT_MOST):
            try:
                trial = moved_by(linear, change)
                trial, now = _ranged(trial, predictions(trial, logs), weight)
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


def _ranged(
    model: ExtendedModel, here: Sequence[Prediction], kt_weight: float
) -> tuple[ExtendedModel, float]:
    """Return the model with the ranges of the logs, and its sum of squares [V²]."""
    square = float(sum(item.residual_v @ item.residual_v for item in here))
    return spanning(model, here), square + (kt_weight * model.model.kt_v_per_k) ** 2


def solution_at(linear: Linear, block: NDArray[np.intp]) -> Solution:
    """Return the numbers of a fitted model with their standard errors.

    Parameters
    ----------
    linear : Linear
        At the fitted model.
    block : array of shape (n,)
        Rows with the same number may have correlated residuals.

    Returns
    -------
    Solution
        Coefficients of the voltage model, then the values of `linear.free`.
    """
    limits = linear.limits(linear.model.model.soc_range_pct)
    columns = np.vstack([linear.columns, linear.holding[:, :-1]])
    residual_v = np.append(linear.residual_v, linear.holding[0, -1])
    block = np.append(block, block.max() + 1)
    found = solve(columns, residual_v, block, *limits)
    plain = solve(columns, residual_v, block, None, 0.0).coefficients
    falls = bool(np.any((limits[0] @ plain - limits[1])[:SLOPE_CHECKS] < 0.0))
    at = np.concatenate((linear.model.model.coefficients, [item.value for item in linear.free]))
    return replace(found, coefficients=at, constrained=falls)

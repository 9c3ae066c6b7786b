"""A log seen by every effect of the library: how the residual would move with each amplitude.

The residual is U_corrected − U_model. An effect's column is minus the derivative of the residual
by its amplitude, for each value of its shape on a grid; it is taken by a finite difference through
the effect's own offline code, so what the diagnosis weighs is what the extended model does.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cangauge.identify.options import FitOptions
from cangauge.identify.rows import FitRows
from cangauge.identify.voltage_fit import columns_of, prepare
from cangauge.logs.log import Log
from cangauge.model.charge import BRIDGE_S, discharged_ah
from cangauge.model.effects.effect import Effect, Pack, Signals, Values
from cangauge.model.effects.first_order import low_passed
from cangauge.model.extended import ExtendedModel

FloatArray = NDArray[np.float64]

OWN = ("constant voltage [V]", "assumed initial SoC [%]", "slow polarisation", "resistance level")
"""What differs from log to log without a cause; the last two in parts of the pack's resistance.
Trips of one pack differ in the state that they begin from, in how hard they are, in how warm the
cells inside are."""

OWN_SLOW_S = 150.0
"""Time constant of a log's own slow polarisation [s]."""

STEP = 0.02
"""Finite-difference step, relative to the width of the amplitude's bounds."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """A log with the rows that the diagnosis uses."""

    log: Log
    rows: FitRows
    at: NDArray[np.intp]
    """Index of the rows in the log, shape (m,)."""
    initial_soc_pct: float
    """SoC at the log's first sample [%]."""

    @property
    def signals(self) -> Signals:
        """The log's signals at its own rate."""
        log = self.log
        return Signals(log.time_s, log.current_a, log.voltage_v, log.temperature_c)


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect with one value of each shape: a few columns."""

    effect: Effect
    shape: Mapping[str, float]
    amplitudes: tuple[str, ...]
    neutral: FloatArray
    """Amplitudes at which the effect does nothing, shape (k,)."""
    bounds: FloatArray
    """Physical bounds of the amplitudes, less the neutral values, shape (k, 2)."""

    def values(self, amplitude: FloatArray) -> dict[str, float]:
        """Return the effect's parameters for amplitudes beside the neutral ones."""
        total = (self.neutral + amplitude).tolist()
        return {**dict(zip(self.amplitudes, total, strict=True)), **self.shape}


@dataclass(frozen=True, eq=False)
class LogTerms:
    """Everything that the evidence needs of one log; m rows."""

    prepared: Prepared
    residual_v: FloatArray
    """Of the model as it is, shape (m,)."""
    baseline: FloatArray
    """Columns of the voltage model's coefficients, shape (m, 9 + delays)."""
    own: FloatArray
    """Columns of what differs from log to log without a cause (`OWN`), shape (m, 4)."""
    effects: tuple[FloatArray, ...]
    """Columns of each candidate, shape (m, k) each."""

    def at(self, keep: NDArray[np.bool_]) -> LogTerms:
        """Return the terms on some of the rows."""
        return replace(
            self,
            residual_v=self.residual_v[keep],
            baseline=self.baseline[keep],
            own=self.own[keep],
            effects=tuple(columns[keep] for columns in self.effects),
        )


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
    return Prepared(log, rows, at, first)


def candidates(effects: Sequence[Effect], pack: Pack, time_s: FloatArray) -> list[Candidate]:
    """Return every effect with every value of its shapes.

    Parameters
    ----------
    effects : sequence of Effect
    pack : Pack
    time_s : array
        Times of a log; the k-th shape means the same on every log of a group.
    """
    result = []
    for effect in effects:
        neutral = effect.neutral(pack)
        if not effect.amplitudes:  # time_skew's only parameter is both shape and amplitude
            only = effect.parameters[0]
            result.append(
                Candidate(effect, {}, (only.name,), np.zeros(1), np.array([only.bounds(pack)]))
            )
            continue
        names = tuple(parameter.name for parameter in effect.amplitudes)
        centre = np.array([neutral[name] for name in names])
        bounds = np.array([parameter.bounds(pack) for parameter in effect.amplitudes])
        grids = [effect.trials(parameter, pack, time_s) for parameter in effect.shapes]
        for choice in itertools.product(*grids):
            shape = dict(zip((p.name for p in effect.shapes), choice, strict=True))
            result.append(Candidate(effect, shape, names, centre, bounds - centre[:, None]))
    return result


def residual(prepared: Prepared, model: ExtendedModel) -> FloatArray:
    """Return U_corrected − U_model on the rows, shape (m,) [V]."""
    prediction = model.predict(prepared.signals, prepared.initial_soc_pct, prepared.at)
    return prediction.residual_v


def effect_columns(
    prepared: Prepared,
    model: ExtendedModel,
    candidate: Candidate,
    around: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return the residual and minus its derivative by each amplitude, shapes (m,) and (m, k).

    Parameters
    ----------
    prepared : Prepared
    model : ExtendedModel
        Without the candidate.
    candidate : Candidate
    around : array of shape (k,), optional
        Amplitudes beside the neutral ones to take the derivative at; zero by default.
    """
    zero = np.zeros(len(candidate.amplitudes))
    centre = zero if around is None else around
    effect = candidate.effect
    here = residual(prepared, _with(model, effect, candidate.values(centre), around is None))
    columns = np.empty((here.size, zero.size))
    for k in range(zero.size):
        low, high = candidate.bounds[k]
        step = STEP * (high - low)
        if centre[k] + step > high:
            step = -step
        moved = centre.copy()
        moved[k] += step
        there = residual(prepared, model.with_effect(effect, candidate.values(moved)))
        columns[:, k] = (here - there) / step
    return here, columns


def log_terms(prepared: Prepared, model: ExtendedModel, choices: Sequence[Candidate]) -> LogTerms:
    """Return all terms of one log."""
    voltage_model = model.model
    plain = residual(prepared, model)
    rows = prepared.rows
    current = prepared.log.current_a
    slow = low_passed(prepared.log.time_s, current, OWN_SLOW_S, 0.0, rest_s=BRIDGE_S)
    own = np.column_stack(
        [
            np.ones(len(rows)),
            voltage_model.pseudo_ocv_slope(rows.soc_pct),
            -model.pack.resistance_ohm * slow[prepared.at],
            -model.pack.resistance_ohm * current[prepared.at],
        ]
    )
    return LogTerms(
        prepared=prepared,
        residual_v=plain,
        baseline=columns_of(rows, voltage_model.epsilon, voltage_model.t_ref_c),
        own=own,
        effects=tuple(effect_columns(prepared, model, choice)[1] for choice in choices),
    )


def _with(model: ExtendedModel, effect: Effect, values: Values, is_neutral: bool) -> ExtendedModel:
    return model if is_neutral else model.with_effect(effect, values)

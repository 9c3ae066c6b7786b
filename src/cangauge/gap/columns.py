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
from cangauge.model.effects.effect import Effect, Pack, Signals
from cangauge.model.effects.first_order import low_passed
from cangauge.model.extended import ExtendedModel

FloatArray = NDArray[np.float64]

LEVELS = ("slow polarisation", "resistance level")
"""What differs from log to log beside the effects, in parts of the pack's resistance: trips of one
pack differ in the state that they begin from, and in how warm the cells inside are."""

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
    steps: FloatArray
    """Change of each amplitude over which the voltage's change is taken, shape (k,)."""

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
    """Columns of `LEVELS`, shape (m, 2)."""
    effects: tuple[FloatArray, ...]
    """Columns of each candidate (of a reference: of those in `Frame.shown`), shape (m, k) each."""

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
        amplitudes = effect.amplitudes or effect.parameters[:1]  # time_skew's is a shape as well
        names = tuple(parameter.name for parameter in amplitudes)
        centre = np.array([neutral[name] for name in names])
        bounds = np.array([parameter.bounds(pack) for parameter in amplitudes]) - centre[:, None]
        shapes = effect.shapes if effect.amplitudes else ()
        grids = [effect.trials(parameter, pack, time_s) for parameter in shapes]
        for choice in itertools.product(*grids):
            shape = dict(zip((p.name for p in shapes), choice, strict=True))
            shape |= effect.constants(pack)
            result += [
                Candidate(effect, shape, names, centre, bounds, steps)
                for steps in _steps(effect, bounds)
            ]
    return result


def _steps(effect: Effect, bounds: FloatArray) -> list[FloatArray]:
    """Return over which changes of the amplitudes the voltage's change is taken."""
    widest = float(np.abs(bounds).max()) if effect.bends_at else 0.0
    return [_tangent_steps(bounds), *(np.array([part * widest]) for part in effect.bends_at)]


def _tangent_steps(bounds: FloatArray) -> FloatArray:
    """Return small changes of the amplitudes, within their bounds, shape (k,)."""
    small = STEP * (bounds[:, 1] - bounds[:, 0])
    return np.where(small > bounds[:, 1], -small, small)


def residual(prepared: Prepared, model: ExtendedModel) -> FloatArray:
    """Return U_corrected − U_model on the rows, shape (m,) [V]."""
    prediction = model.predict(prepared.signals, prepared.initial_soc_pct, prepared.at)
    return prediction.residual_v


def effect_columns(
    prepared: Prepared, model: ExtendedModel, candidate: Candidate, here: FloatArray
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
    """
    columns = np.empty((here.size, len(candidate.amplitudes)))
    for k, step in enumerate(candidate.steps):
        moved = np.zeros(len(candidate.amplitudes))
        moved[k] = step
        with_it = model.with_effect(candidate.effect, candidate.values(moved))
        columns[:, k] = (here - residual(prepared, with_it)) / step
    return columns


def log_terms(prepared: Prepared, model: ExtendedModel, choices: Sequence[Candidate]) -> LogTerms:
    """Return the terms of one log, with the columns of some candidates."""
    voltage_model = model.model
    rows = prepared.rows
    current = prepared.log.current_a
    slow = low_passed(prepared.log.time_s, current, OWN_SLOW_S, 0.0, rest_s=BRIDGE_S)
    own = np.column_stack(
        [
            -model.pack.resistance_ohm * slow[prepared.at],
            -model.pack.resistance_ohm * current[prepared.at],
        ]
    )
    smooth = _as_modelled(prepared, model)
    here = residual(smooth, model)
    return LogTerms(
        prepared=prepared,
        residual_v=residual(prepared, model),
        baseline=columns_of(rows, voltage_model.epsilon, voltage_model.t_ref_c),
        own=own,
        effects=tuple(effect_columns(smooth, model, choice, here) for choice in choices),
    )


def _as_modelled(prepared: Prepared, model: ExtendedModel) -> Prepared:
    """Return the log with the model's voltage in place of the measured one."""
    everywhere = np.arange(len(prepared.log))
    prediction = model.predict(prepared.signals, prepared.initial_soc_pct, everywhere)
    volts = prepared.log.voltage_v - prediction.residual_v
    return replace(prepared, log=replace(prepared.log, voltage_v=volts))

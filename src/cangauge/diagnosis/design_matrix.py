"""Design matrix of a log: sensitivity of the voltage residual to every amplitude.

The residual is U_corrected − U_model. A column is minus the derivative of the residual with respect
to an amplitude, taken as a finite difference of the effect's own offline code, so that the
diagnosis and the extended model agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.inference.linearized import (
    coefficient_columns,
    effect_columns,
    pack_state,
    predict_logs,
    residual,
    with_modelled_voltage,
)
from cangauge.inference.rows import SampledLog
from cangauge.model.effects.base import Pack
from cangauge.model.effects.library import Candidate
from cangauge.model.effects.library import candidates as library_candidates
from cangauge.model.extended import ExtendedModel

PER_LOG_STATES = ("slow polarisation", "resistance level")
"""Unmeasured states of a log, in parts of the pack resistance: trips of one pack differ in their
initial polarisation, and in the temperature inside the cells."""

SLOW_POLARISATION_S = 150.0
"""Time constant of the per-log slow polarisation [s]."""


@dataclass(frozen=True, eq=False)
class DesignMatrix:
    """Residual and columns of one log with m rows."""

    sampled: SampledLog
    residual_v: FloatArray
    """Residual that the columns explain, shape (m,) [V]. With a structured model it is that model's
    residual plus what the columns attribute to its structure, so that columns are exact there."""
    coefficients: FloatArray
    """Columns of the voltage model coefficients, shape (m, 9 + delays)."""
    per_log_states: FloatArray
    """Columns of `PER_LOG_STATES`, shape (m, 2)."""
    effects: tuple[FloatArray, ...]
    """Columns of each candidate, shape (m, amplitudes) each; of a reference those of
    `Hypotheses.reference_columns`."""

    def voltage(self, coefficients: FloatArray, amplitudes: FloatArray) -> FloatArray:
        """Return the voltage of coefficients (p,) and all amplitudes in order [V], shape (m,)."""
        volts = self.coefficients @ coefficients
        first = 0
        for columns in self.effects:
            of_effect = amplitudes[first : first + columns.shape[1]]
            first += columns.shape[1]
            if np.any(of_effect):
                volts += columns @ of_effect
        return volts

    def rows(self, keep: NDArray[np.bool_]) -> DesignMatrix:
        """Return the matrix restricted to some rows."""
        return replace(
            self,
            residual_v=self.residual_v[keep],
            coefficients=self.coefficients[keep],
            per_log_states=self.per_log_states[keep],
            effects=tuple(columns[keep] for columns in self.effects),
        )


def design_matrix(
    sampled: SampledLog,
    model: ExtendedModel,
    candidates: Sequence[Candidate],
    structured: ExtendedModel | None = None,
) -> DesignMatrix:
    """Linearise the residual of one log in all amplitudes.

    Parameters
    ----------
    sampled : SampledLog
    model : ExtendedModel
        Model to linearise about.
    candidates : sequence of Candidate
        Their shapes as of this log (`candidates_for`).
    structured : ExtendedModel, optional
        `model` with the structure that the references need. The residual and the columns of
        thermal effects are taken about it: a wrong temperature acts through everything that depends
        on temperature, which in `model` is a single coefficient.
    """
    voltage_model = model.model
    rows = sampled.rows
    slow = sampled.signals.history.at(sampled.at).lagged_a(SLOW_POLARISATION_S)
    per_log_states = np.column_stack(
        [
            -model.pack.resistance_ohm * slow,
            -model.pack.resistance_ohm * sampled.log.current_a[sampled.at],
        ]
    )
    smooth = with_modelled_voltage(sampled, model)
    at_model = (residual(smooth, model), pack_state(smooth, model))
    if structured is not None:
        smooth_structured = with_modelled_voltage(sampled, structured)
        at_structured = (
            residual(smooth_structured, structured),
            pack_state(smooth_structured, structured),
        )
    # Effects of the given model may scale the columns of its coefficients.
    coefficients = (
        coefficient_columns(model, [sampled], predict_logs(model, [sampled]))
        if model.effects
        else np.column_stack(
            [
                voltage_model.pseudo_ocv_columns(rows.soc_pct),
                rows.temperature_c - voltage_model.t_ref_c,
                rows.delayed_current_a,
            ]
        )
    )
    effects = tuple(
        effect_columns(smooth_structured, structured, candidate, *at_structured)
        if structured is not None and candidate.effect.family == "thermal"
        else effect_columns(smooth, model, candidate, *at_model)
        for candidate in candidates
    )
    residual_v = residual(sampled, structured or model)
    if structured is not None:
        change = structured.model.coefficients - voltage_model.coefficients
        residual_v += coefficients @ change + _structure_v(model, structured, candidates, effects)
    return DesignMatrix(sampled, residual_v, coefficients, per_log_states, effects)


def candidates_for(
    candidates: Sequence[Candidate], pack: Pack, sampled: SampledLog
) -> list[Candidate]:
    """Return the candidates with their shapes on one log: times of onset scale with its length.

    Raises
    ------
    InputError
        If the log has other candidates.
    """
    effects = list(dict.fromkeys(candidate.effect for candidate in candidates))
    found = library_candidates(effects, pack, sampled.log.time_s, for_diagnosis=True)
    if [each.effect.id for each in found] != [each.effect.id for each in candidates]:
        raise InputError("the effects' shapes differ between logs", source=sampled.log.source)
    return found


def _structure_v(
    model: ExtendedModel,
    structured: ExtendedModel,
    candidates: Sequence[Candidate],
    columns: Sequence[FloatArray],
) -> FloatArray:
    """Return the voltage that the columns attribute to the structured model, shape (m,) [V]."""
    volts = np.zeros(columns[0].shape[0])
    added = list(structured.effects)
    for given in model.effects:
        added.remove(given)  # effects are in the order of the library, not of being added
    for effect, values in added:
        # Shapes depend on the capacity at most, which coefficients do not change.
        at = next(
            k
            for k, candidate in enumerate(candidates)
            if candidate.effect.id == effect.id
            and all(values[name] == value for name, value in candidate.shape.items())
        )
        amplitudes = [values[name] for name in candidates[at].amplitudes]
        volts += columns[at] @ (np.array(amplitudes) - candidates[at].neutral)
    return volts

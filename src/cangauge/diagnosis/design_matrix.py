"""A log seen by every effect of the library: how the residual would move with each amplitude.

The residual is U_corrected − U_model. An effect's column is minus the derivative of the residual
by its amplitude, for each value of its shape on a grid; it is taken by a finite difference through
the effect's own offline code, so what the diagnosis weighs is what the extended model does.
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
from cangauge.model.effects.library import Candidate, candidates
from cangauge.model.extended import ExtendedModel

LEVELS = ("slow polarisation", "resistance level")
"""What differs from log to log beside the effects, in parts of the pack's resistance: trips of one
pack differ in the state that they begin from, and in how warm the cells inside are."""

OWN_SLOW_S = 150.0
"""Time constant of a log's own slow polarisation [s]."""


@dataclass(frozen=True, eq=False)
class DesignMatrix:
    """Everything that the evidence needs of one log; m rows."""

    prepared: SampledLog
    residual_v: FloatArray
    """What the columns are to explain, shape (m,): of the model as it is or, so that they are exact
    where the structure acts, of the acting one and what they say that its structure does."""
    baseline: FloatArray
    """Columns of the voltage model's coefficients, shape (m, 9 + delays)."""
    own: FloatArray
    """Columns of `LEVELS`, shape (m, 2)."""
    effects: tuple[FloatArray, ...]
    """Columns of each candidate (of a reference: of those in `Frame.shown`), shape (m, k) each."""

    def at(self, keep: NDArray[np.bool_]) -> DesignMatrix:
        """Return the terms on some of the rows."""
        return replace(
            self,
            residual_v=self.residual_v[keep],
            baseline=self.baseline[keep],
            own=self.own[keep],
            effects=tuple(columns[keep] for columns in self.effects),
        )


def design_matrix(
    prepared: SampledLog,
    model: ExtendedModel,
    choices: Sequence[Candidate],
    acting: ExtendedModel | None = None,
) -> DesignMatrix:
    """Return the terms of one log, with the columns of some candidates.

    Parameters
    ----------
    prepared : SampledLog
    model : ExtendedModel
    choices : sequence of Candidate
    acting : ExtendedModel, optional
        The model with the structure that references call for, whose residual the columns keep. A
        temperature that is wrong shows through all that follows the temperature, and in `model`
        that is one coefficient.
    """
    voltage_model = model.model
    rows = prepared.rows
    remembering = prepared.with_history_cache()  # until all columns are there
    current = prepared.log.current_a
    slow = remembering.signals.history.lagged_a(OWN_SLOW_S)
    own = np.column_stack(
        [
            -model.pack.resistance_ohm * slow[prepared.at],
            -model.pack.resistance_ohm * current[prepared.at],
        ]
    )
    smooth = with_modelled_voltage(remembering, model)
    here = residual(smooth, model)
    state = pack_state(smooth, model)
    if acting is not None:
        smooth_acting = with_modelled_voltage(remembering, acting)
        here_acting = residual(smooth_acting, acting)
        state_acting = pack_state(smooth_acting, acting)
    # Effects that the model has already may scale what its coefficients multiply.
    baseline = (
        coefficient_columns(model, [prepared], predict_logs(model, [prepared]))
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
        effect_columns(smooth_acting, acting, choice, here_acting, state_acting)
        if acting is not None and choice.effect.family == "thermal"
        else effect_columns(smooth, model, choice, here, state)
        for choice in choices
    )
    residual_v = residual(remembering, acting or model)
    if acting is not None:
        change = acting.model.coefficients - voltage_model.coefficients
        residual_v += baseline @ change + _structure_v(model, acting, choices, effects)
    return DesignMatrix(prepared, residual_v, baseline, own, effects)


def own_choices(choices: Sequence[Candidate], pack: Pack, prepared: SampledLog) -> list[Candidate]:
    """Return the candidates as they are on one log: a moment is a part of its length.

    Raises
    ------
    InputError
        If they are not as many.
    """
    effects = list(dict.fromkeys(choice.effect for choice in choices))
    own = candidates(effects, pack, prepared.log.time_s, for_diagnosis=True)
    if [each.effect.id for each in own] != [each.effect.id for each in choices]:
        raise InputError("the effects' shapes differ between logs", source=prepared.log.source)
    return own


def _structure_v(
    model: ExtendedModel,
    acting: ExtendedModel,
    choices: Sequence[Candidate],
    columns: Sequence[FloatArray],
) -> FloatArray:
    """Return what the columns say that the acting model's structure does, shape (m,) [V]."""
    volts = np.zeros(columns[0].shape[0])
    added = list(acting.effects)
    for given in model.effects:
        added.remove(given)  # they stand in the library's order, not in that of being added
    for effect, values in added:
        # Shapes are relative to the capacity at most, which coefficients leave alone.
        at = next(
            k
            for k, choice in enumerate(choices)
            if choice.effect.id == effect.id
            and all(values[name] == value for name, value in choice.shape.items())
        )
        amplitudes = [values[name] for name in choices[at].amplitudes]
        volts += columns[at] @ (np.array(amplitudes) - choices[at].neutral)
    return volts

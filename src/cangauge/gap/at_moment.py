"""The moment at which a cause begins: found by trying, since the voltage jumps there.

A slope by the moment is nothing but the jump, so no descent finds it. All logs are tried with the
same moment, as the extended model has it, each moment with the amplitude that suits it best.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cangauge.gap.columns import LogTerms, residual
from cangauge.identify.effects.prepared import state_of
from cangauge.model.effects.effect import Effect, Values
from cangauge.model.extended import ExtendedModel

FloatArray = NDArray[np.float64]

TRIED = 100
"""Moments that are tried, spread over the longest log; then as many between the best one's
neighbours."""

LEAST_V2 = 1e-12
"""Mean square below which a column is nothing but rounding [V²]."""


def at_moment(
    logs: Sequence[LogTerms], model: ExtendedModel, effect: Effect, start: Values
) -> dict[str, float]:
    """Return the values with the moments that leave the least mean square of the logs' voltage.

    Parameters
    ----------
    logs : sequence of LogTerms
    model : ExtendedModel
        Without the effect.
    effect : Effect
        One that has no moment keeps its values.
    start : mapping
        Its values; the amplitudes' sizes do not matter, their proportions do.
    """
    values = dict(start)
    for parameter in effect.shapes:
        if parameter.is_moment:
            values[parameter.name] = _best(logs, model, effect, values, parameter.name)
    return values


def _best(
    logs: Sequence[LogTerms], model: ExtendedModel, effect: Effect, values: Values, name: str
) -> float:
    states = [state_of(terms.prepared, model) for terms in logs]
    # What the coefficients or a log's own level explain as well is no jump.
    known = [np.linalg.qr(np.column_stack([terms.baseline, terms.own]))[0] for terms in logs]
    left_v = np.concatenate(
        [
            _beside(basis, residual(terms.prepared, model))
            for basis, terms in zip(known, logs, strict=True)
        ]
    )

    def taken_v2(moment_s: float) -> float:
        trial = {**values, name: moment_s}
        columns = []
        for basis, terms, state in zip(known, logs, states, strict=True):
            extra_v = effect.extra_voltage(state, trial, model.model, model.pack)
            rows = terms.prepared.at
            columns.append(
                _beside(basis, np.zeros(rows.size) if extra_v is None else extra_v[rows])
            )
        column = np.concatenate(columns)
        square = float(column @ column)
        return float(column @ left_v) ** 2 / square if square > LEAST_V2 * column.size else 0.0

    longest_s = max(float(np.ptp(terms.prepared.log.time_s)) for terms in logs)
    apart_s = longest_s / TRIED
    tried = [values[name], *np.arange(TRIED) * apart_s]
    best = float(max(tried, key=taken_v2))
    tried = [best, *np.linspace(max(best - apart_s, 0.0), best + apart_s, TRIED)]
    return float(max(tried, key=taken_v2))


def _beside(basis: FloatArray, volts: FloatArray) -> FloatArray:
    """Return what orthonormal columns do not explain."""
    return np.asarray(volts - basis @ (basis.T @ volts))

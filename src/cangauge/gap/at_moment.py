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

LEAST_PART = 0.02
"""A jump that leaves less than this part of its column's square beside what is known, if it were
there all along, has next to no rows before or after it: it is a row that is wrong, not a jump."""


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

    def columns_of(moment_s: float) -> list[FloatArray]:
        trial = {**values, name: moment_s}
        columns = []
        for terms, state in zip(logs, states, strict=True):
            extra_v = effect.extra_voltage(state, trial, model.model, model.pack)
            rows = terms.prepared.at
            columns.append(np.zeros(rows.size) if extra_v is None else extra_v[rows])
        return columns

    least_v2 = LEAST_PART * float(np.sum(np.concatenate(columns_of(0.0)) ** 2))

    def taken_v2(moment_s: float) -> float:
        beside = [_beside(*pair) for pair in zip(known, columns_of(moment_s), strict=True)]
        column = np.concatenate(beside)
        square = float(column @ column)
        return float(column @ left_v) ** 2 / square if square > least_v2 else 0.0

    longest_s = max(float(np.ptp(terms.prepared.log.time_s)) for terms in logs)
    apart_s = longest_s / TRIED
    tried = [values[name], *np.arange(TRIED) * apart_s]
    best = float(max(tried, key=taken_v2))
    tried = [best, *np.linspace(max(best - apart_s, 0.0), best + apart_s, TRIED)]
    return float(max(tried, key=taken_v2))


def _beside(basis: FloatArray, volts: FloatArray) -> FloatArray:
    """Return what orthonormal columns do not explain."""
    return np.asarray(volts - basis @ (basis.T @ volts))

"""Fit of a curve of knots to the rows of logs, with effects if any are asked for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.identify.effect_search import Search, Selected, linearize
from cangauge.identify.held_out import comparable, stated_error
from cangauge.identify.least_squares import (
    BASE,
    N,
    P,
    Solution,
    log_sums,
    row_features,
    solve_scaled,
)
from cangauge.identify.published import PublishedEquation, PublishedFit
from cangauge.identify.rows import FitRows, usable_delays
from cangauge.model.curve import KNOTS_PCT
from cangauge.model.effects.base import Effect, Values
from cangauge.model.effects.library import effect_entries
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Information, Model
from cangauge.model.prior import PackPrior
from cangauge.model.voltage_model import DELAYS_S

RELINEARIZED: Final = 4
"""Gauss–Newton steps of a fit with effects: enough for products of effects and resistances."""


def fit_knots(
    rows: Sequence[FitRows],
    pack: PackPrior,
    effect_ids: Sequence[str],
    fields: dict[str, Any],
) -> tuple[Model, PublishedFit, tuple[FloatArray, ...], Selected | None]:
    """Fit a curve of knots, with the effects that are asked for.

    Parameters
    ----------
    rows : sequence of FitRows
        Of each log.
    pack : PackPrior
    effect_ids : sequence of str
        Ids, or "auto".
    fields : dict
        Fields of the model file that are known before the fit.

    Returns
    -------
    model : Model
    published : PublishedFit
        The published equation on the same rows.
    errors_v : tuple of array of shape (m,)
        Errors of left-out logs [V]; () for too few logs.
    selected : Selected or None
        Effects, if any were asked for.
    """
    equation = PublishedEquation()
    published = equation.fit(rows, [equation.root(item) for item in rows])
    if usable_delays([item.log for item in rows], DELAYS_S) == DELAYS_S and published.identified:
        fields = fields | {"published": published.fields()}
    solution, without = solve_scaled([log_sums(item, pack.chemistry) for item in rows], pack)
    errors_v = comparable(
        rows,
        [
            item.voltage_v - item.product(row_features, other.of_columns)
            for item, other in zip(rows, without, strict=False)  # none for too few logs
        ],
    )
    effects: tuple[tuple[Effect, Values], ...] = ()
    selected: Selected | None = None
    if effect_ids:
        search = Search(knots_model(solution, fields).extended_model(), rows, pack, effect_ids)
        while (selected := search.select()).chosen:
            with_effects = _with_effects(solution, rows, selected, pack, fields)
            at_bound = selected.at_bound(with_effects[0])
            if not at_bound:
                solution, effects, errors_v = with_effects
                break
            search.refused += at_bound
    fields = fields | {"effects": effect_entries(effects)}
    model = knots_model(solution, fields, errors_v, rows)
    return model, published, errors_v, selected


def _with_effects(
    plain: Solution,
    rows: Sequence[FitRows],
    selected: Selected,
    pack: PackPrior,
    fields: dict[str, Any],
) -> tuple[Solution, tuple[tuple[Effect, Values], ...], tuple[FloatArray, ...]]:
    """Fit the selected effects too, by Gauss–Newton steps from the solution without effects.

    Returns
    -------
    solution : Solution
    effects : tuple of (Effect, values)
    errors_v : tuple of array of shape (m,)
        Errors of left-out logs [V].
    """
    solution, std = plain, selected.amplitude_std
    extended = knots_model(solution, fields).extended_model()
    amplitudes = np.zeros(std.size)
    for _ in range(RELINEARIZED):
        about = [linearize(extended, item, selected, amplitudes) for item in rows]
        base = solution.of_columns[:BASE]
        volts = [  # what is to be explained
            item.table[:, :BASE] @ base + item.table[:, BASE:] @ amplitudes + item.residual_v
            for item in about
        ]
        sums = [
            log_sums(item.rows, pack.chemistry, item.table, volts_of_log)
            for item, volts_of_log in zip(about, volts, strict=True)
        ]
        solution, without = solve_scaled(sums, pack, std)
        solution = selected.clipped(solution)
        amplitudes = solution.coefficients[P:]
        effects = selected.effects(solution)
        voltage = knots_model(solution, fields).voltage_model()
        extended = ExtendedModel(voltage, pack.capacity_ah, effects)
    errors_v = [
        volts_of_log - item.table @ other.of_columns
        for volts_of_log, item, other in zip(volts, about, without, strict=False)
    ]
    return solution, effects, comparable([item.rows for item in about], errors_v)


def knots_model(
    solution: Solution,
    fields: dict[str, Any],
    held_out_v: Sequence[FloatArray] = (),
    rows: Sequence[FitRows] = (),
) -> Model:
    """Return the model of a solution.

    Parameters
    ----------
    solution : Solution
        With its covariance already scaled by left-out logs.
    fields : dict
        The other fields of `Model`.
    held_out_v : sequence of array of shape (m,)
        Errors of left-out logs [V], which the model states; by default it states those of the fit.
    rows : sequence of FitRows
        Rows of `held_out_v`.
    """
    # The square root of the precision, and the names of its columns.
    root = np.linalg.cholesky(np.linalg.inv(solution.covariance)).T
    names = [f"knot_{soc:g}" for soc in KNOTS_PCT.tolist()]
    names += ["kt", *(f"R{k}" for k in range(1, P - N - 1)), "b"]
    names += [f"amplitude_{k}" for k in range(1, solution.coefficients.size - P + 1)]
    information = Information(
        columns=names,
        root=np.triu(root).tolist(),
        projected=(root @ solution.coefficients).tolist(),
    )
    judged = stated_error(held_out_v, rows, solution.residual_v, solution.mean_v)
    return Model.of_knots(solution, judged, information=information, **fields)

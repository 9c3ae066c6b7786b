"""Cross-validation of extended models, and whether one is significantly better than another.

Three logs or more: whole logs are held out in turn (in groups, beyond twelve). One or two logs:
interleaved blocks of 240 s with a guard of 60 s (`rows.folds`). Each log, or block, is one
comparison of two models: the log ratio of their mean square errors there, so that a log that is
hard for both does not dominate the others.

A model with one more effect is significantly better if the mean log ratio exceeds its standard
error by the quantile of Student's t at probability `CHANCE`, divided by the number of the effect's
amplitudes (2.2 standard errors for eleven logs, 4.3 for three), and if the pooled root mean square
error falls by `GAIN_AT_LEAST`. With one standard error, the best of ten useless effects would be
accepted too often, in particular one with several amplitudes. Where whole logs are held out, half
as many standard errors are also required of the error's variance within each log: an effect of
temperature easily explains errors that last as long as a log, by chance and without support within
the logs.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit  # scipy.stats takes half a second to import

from cangauge._typing import FloatArray
from cangauge.errors import CangaugeError, InputError
from cangauge.inference.linearized import (
    Linearization,
    changed_model,
    constrained_change,
    gauss_newton_step,
    linearize,
    stacked_residual,
    with_ranges,
)
from cangauge.inference.rows import (
    BLOCK_S,
    LOGS_AT_LEAST,
    Mask,
    SampledLog,
    block_numbers,
    folds,
)
from cangauge.model.extended import ExtendedModel

CHANCE = 0.025
"""Significance level of an effect. A useless effect mostly raises the held-out error, so even the
best of many is rarely taken."""

GAIN_AT_LEAST = 0.01
"""Least relative decrease of the held-out root mean square error."""

UNITS_AT_LEAST = 3
"""Least number of logs or blocks for a test."""

WITHIN = 0.5
"""Standard errors required within the logs, relative to those required in total."""

LEAST_V2 = 1e-12
"""Lower limit of mean square errors [V²]."""

SOC_BEYOND_PCT = 1.0
"""Held-out rows farther than this outside the SoC of the training rows are left out [%]."""


@dataclass(frozen=True, eq=False)
class Fold:
    """Training and held-out rows, masks of shape (n,) over all logs."""

    training: Mask
    held_out: Mask
    logs: tuple[int, ...]
    """Index of the logs with held-out rows."""


@dataclass(frozen=True, eq=False)
class HeldOutErrors:
    """Held-out errors of a model."""

    error_v: FloatArray
    """Shape (n,); NaN where no fold holds the row out."""
    unit: NDArray[np.intp]
    """Number of the log, or block, of each row, shape (n,)."""
    whole_logs: bool = False
    """Whether whole logs are held out."""

    @property
    def rmse_v(self) -> float:
        """Root mean square error of all held-out rows [V]."""
        return float(np.sqrt(np.nanmean(self.error_v**2)))

    @property
    def unit_v2(self) -> FloatArray:
        """Mean square error of each log or block [V²], shape (units,)."""
        seen = ~np.isnan(self.error_v)
        return _mean_squares(self.error_v[seen] ** 2, self.unit[seen])

    @property
    def within_v2(self) -> FloatArray:
        """Variance of the error within each log [V²], shape (units,)."""
        seen = ~np.isnan(self.error_v)
        unit = self.unit[seen]
        mean = np.bincount(unit, self.error_v[seen]) / np.maximum(np.bincount(unit), 1)
        return _mean_squares((self.error_v[seen] - mean[unit]) ** 2, unit)


def _mean_squares(squares: FloatArray, unit: NDArray[np.intp]) -> FloatArray:
    """Return the mean of squares over each unit with rows, in order, at least `LEAST_V2`."""
    total, count = np.bincount(unit, squares), np.bincount(unit)
    return np.maximum(total[count > 0] / count[count > 0], LEAST_V2)


class CrossValidation:
    """Held-out errors of models on the same rows of the same logs.

    Parameters
    ----------
    logs : sequence of SampledLog

    Raises
    ------
    InputError
        If the logs are too short to hold rows out.
    """

    def __init__(self, logs: Sequence[SampledLog]) -> None:
        self.logs = tuple(logs)
        rows = [item.rows for item in logs]
        soc = np.concatenate([item.soc_pct for item in rows])
        owner = np.repeat(np.arange(len(rows)), [len(item) for item in rows])
        self._owner = owner
        self.unit = owner if len(logs) >= LOGS_AT_LEAST else block_numbers(rows, BLOCK_S)
        self.folds: list[Fold] = []
        for training, held_out in folds(rows):
            lo, hi = soc[training].min() - SOC_BEYOND_PCT, soc[training].max() + SOC_BEYOND_PCT
            inside = held_out & (soc > lo) & (soc < hi)
            if inside.any():
                of_logs = tuple(np.unique(owner[inside]).tolist())
                self.folds.append(Fold(training, inside, of_logs))
        held_out = np.any([fold.held_out for fold in self.folds], axis=0)
        if not self.folds or np.unique(self.unit[held_out]).size < UNITS_AT_LEAST:
            seconds = sum(item.log.duration_s for item in logs)
            raise InputError(
                f"{seconds:.0f} s of data are too little to hold rows out for a test of effects",
                source=", ".join(item.log.name for item in logs),
                field="effects",
                cure="give an hour with changing load, or three logs and more over the same SoC;"
                " or fit without --effects",
            )

    def errors(self, model: ExtendedModel) -> HeldOutErrors:
        """Return the held-out errors of a fitted model.

        For each fold one Gauss–Newton step is taken on its training rows, which is the fold's own
        fit up to the nonlinearity.
        """
        error_v = np.full(self.unit.size, np.nan)
        whole = linearize(model, self.logs)
        for fold in self.folds:
            in_fold = replace(whole, model=with_ranges(model, whole.predictions, fold.training))
            try:
                changed = changed_model(in_fold, gauss_newton_step(in_fold, fold.training))
            except CangaugeError:
                error_v[fold.held_out] = math.inf  # a model that a fold cannot fit is no better
                continue
            of_logs = np.isin(self._owner, fold.logs)
            residual_v = stacked_residual(changed, [self.logs[k] for k in fold.logs])
            error_v[fold.held_out] = residual_v[fold.held_out[of_logs]]
        return HeldOutErrors(error_v, self.unit, whole_logs=len(self.logs) >= LOGS_AT_LEAST)

    def screen(
        self, linear: Linearization, extra: Sequence[FloatArray], bounds: Sequence[FloatArray]
    ) -> list[float]:
        """Return the decrease of the held-out error by each of several additions, linearly.

        Parameters
        ----------
        linear : Linearization
            At the model to which they are added.
        extra : sequence of arrays of shape (n, k)
            Columns of each addition.
        bounds : sequence of arrays of shape (k, 2)
            Bounds of each addition's amplitudes.

        Returns
        -------
        list of float
            Mean log ratio of mean square errors, before over after.
        """
        p = linear.columns.shape[1]
        table = np.column_stack([linear.columns, *extra, linear.residual_v])
        prior_row = np.zeros((1, table.shape[1]))
        prior_row[:, [*range(p), -1]] = linear.prior_row
        first = p + np.cumsum([0, *(columns.shape[1] for columns in extra)])
        choices = [np.arange(0), *(np.arange(a, b) for a, b in itertools.pairwise(first))]
        squares = np.full((len(choices), self.unit.size), np.nan)
        for fold in self.folds:
            factor = np.linalg.qr(np.vstack([table[fold.training], prior_row])).R
            rows = table[fold.held_out]
            in_fold = with_ranges(linear.model, linear.predictions, fold.training).model
            constraints = linear.constraints(in_fold.soc_range_pct)
            for k, own in enumerate(choices):
                used = np.concatenate((np.arange(p), own, [table.shape[1] - 1]))
                bounded = _with_bounds(constraints, bounds[k - 1] if own.size else np.empty((0, 2)))
                change = constrained_change(factor[:, used], bounded)
                error_v = rows[:, -1] - rows[:, used[:-1]] @ change
                squares[k, fold.held_out] = error_v**2
        seen = np.isfinite(squares[0])
        log_v2 = [np.log(_mean_squares(item[seen], self.unit[seen])) for item in squares]
        return [float(np.mean(log_v2[0] - item)) for item in log_v2[1:]]


def _with_bounds(
    constraints: tuple[FloatArray, FloatArray], bounds: FloatArray
) -> tuple[FloatArray, FloatArray]:
    matrix, at_least = constraints
    k = bounds.shape[0]
    wider = np.hstack([matrix, np.zeros((matrix.shape[0], k))])
    own = np.hstack([np.zeros((k, matrix.shape[1])), np.eye(k)])
    return (
        np.vstack([wider, own, -own]),
        np.concatenate((at_least, bounds[:, 0], -bounds[:, 1])),
    )


@dataclass(frozen=True)
class Comparison:
    """Held-out errors of two models, and the test statistic of their difference."""

    before_rmse_v: float
    after_rmse_v: float
    t_value: float
    """Mean log ratio of mean square errors over its standard error. Where whole logs are held out,
    at most twice the same statistic of the variances within the logs."""
    t_critical: float
    """Quantile that `t_value` must exceed."""

    @property
    def is_significant(self) -> bool:
        """Whether the second model is better, significantly and by `GAIN_AT_LEAST`."""
        return self.is_worthwhile and self.t_value > self.t_critical

    @property
    def is_worthwhile(self) -> bool:
        """Whether the error falls by `GAIN_AT_LEAST`, significantly or not."""
        return self.after_rmse_v <= (1.0 - GAIN_AT_LEAST) * self.before_rmse_v


def compare(before: HeldOutErrors, after: HeldOutErrors, amplitudes: int = 1) -> Comparison:
    """Compare two models on the same held-out rows.

    Parameters
    ----------
    before, after : HeldOutErrors
    amplitudes : int
        Number of amplitudes that the second model has in addition.
    """
    t_value = _t_value(before.unit_v2, after.unit_v2)
    if before.whole_logs:
        t_value = min(t_value, _t_value(before.within_v2, after.within_v2) / WITHIN)
    return Comparison(
        before.rmse_v,
        after.rmse_v,
        t_value,
        float(stdtrit(before.unit_v2.size - 1, 1.0 - CHANCE / amplitudes)),
    )


def _t_value(before_v2: FloatArray, after_v2: FloatArray) -> float:
    """Return the mean log ratio of mean squares over its standard error."""
    with np.errstate(invalid="ignore"):
        ratios = np.log(before_v2) - np.log(after_v2)
    if not np.all(np.isfinite(ratios)):
        return -math.inf
    error = float(np.std(ratios, ddof=1)) / math.sqrt(ratios.size)
    return float(np.mean(ratios)) / max(error, 1e-12)

"""Models judged on rows that their fit did not see, and whether one is better by more than chance.

Three logs or more: whole logs are left out in turn (in groups, beyond twelve). One or two logs:
interleaved blocks of 240 s with a guard of 60 s (`identify.held_out`). Each log, or block, is one
comparison of two models: the logarithm of the ratio of their mean square errors there, so that a
log that is hard for both does not outweigh the others.

The rule: a model with one more effect is better by more than chance if the mean of these
logarithms exceeds its standard error by so much as Student's t exceeds with probability `CHANCE`
(2.2 standard errors for eleven logs, 4.3 for three) over the effect's amplitudes, and if the pooled
root mean square error falls by `GAIN_AT_LEAST`. One standard error would let in the best of ten
useless effects too often, and those with several amplitudes first. Where whole logs are left out,
half as many standard errors are asked of the error's variance within each log: a few logs that
differ by what lasts as long as they do are easily told apart by an effect of the temperature, by
chance, and nothing within them bears it out.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student_t

from cangauge._typing import FloatArray
from cangauge.errors import CangaugeError, InputError
from cangauge.identify.linearized import (
    Linear,
    Mask,
    Prepared,
    best_change,
    linearise,
    moved_by,
    residual_of,
    spanning,
    step_on,
)
from cangauge.identify.rows import BLOCK_S, LOGS_AT_LEAST, folds
from cangauge.model.extended import ExtendedModel

CHANCE = 0.025
"""Probability with which Student's t exceeds what is asked for. A useless effect mostly raises the
error on rows left out, so even the best of many is rarely taken."""

GAIN_AT_LEAST = 0.01
"""The held-out root mean square error must fall by this part, or the effect is not worth it."""

UNITS_AT_LEAST = 3
"""Fewer logs or blocks than this tell nothing about chance."""

WITHIN = 0.5
"""So many standard errors, in parts of those asked for, must the error fall within the logs."""

LEAST_V2 = 1e-12
"""Mean square errors below this are alike [V²]."""

SOC_BEYOND_PCT = 1.0
"""Rows this far outside the SoC of the fit are judged; beyond, the model is not to be trusted."""


@dataclass(frozen=True, eq=False)
class Fold:
    """Rows to fit on and rows to judge on, shape (n,) over all logs."""

    fit_on: Mask
    judge_on: Mask
    logs: tuple[int, ...]
    """Which logs the judged rows belong to."""


@dataclass(frozen=True, eq=False)
class Judged:
    """A model's errors on rows left out."""

    error_v: FloatArray
    """Shape (n,); NaN where no fold judged the row."""
    unit: NDArray[np.intp]
    """Number of the log, or block, that each row belongs to, shape (n,)."""
    whole_logs: bool = False
    """Whether whole logs were left out."""

    @property
    def rmse_v(self) -> float:
        """Root mean square error of all judged rows [V]."""
        return float(np.sqrt(np.nanmean(self.error_v**2)))

    @property
    def unit_v2(self) -> FloatArray:
        """Mean square error of each judged log or block [V²], shape (units,)."""
        seen = ~np.isnan(self.error_v)
        return mean_squares(self.error_v[seen] ** 2, self.unit[seen])

    @property
    def within_v2(self) -> FloatArray:
        """Variance of the error within each log, shape (units,)."""
        seen = ~np.isnan(self.error_v)
        unit = self.unit[seen]
        mean = np.bincount(unit, self.error_v[seen]) / np.maximum(np.bincount(unit), 1)
        return mean_squares((self.error_v[seen] - mean[unit]) ** 2, unit)


def mean_squares(squares: FloatArray, unit: NDArray[np.intp]) -> FloatArray:
    """Return the mean of squares over each unit that has any, in order; never zero."""
    total, count = np.bincount(unit, squares), np.bincount(unit)
    return np.maximum(total[count > 0] / count[count > 0], LEAST_V2)


class Judge:
    """Judges models of some logs, all on the same rows.

    Parameters
    ----------
    logs : sequence of Prepared

    Raises
    ------
    InputError
        If the logs are too short to hold anything out.
    """

    def __init__(self, logs: Sequence[Prepared]) -> None:
        self.logs = tuple(logs)
        rows = [item.rows for item in logs]
        soc = np.concatenate([item.soc_pct for item in rows])
        self.unit = _units(logs)
        owner = np.concatenate([np.full(len(item), k) for k, item in enumerate(rows)])
        self._owner = owner
        self.folds: list[Fold] = []
        for fit_on, left_out in folds(rows):
            lo, hi = soc[fit_on].min() - SOC_BEYOND_PCT, soc[fit_on].max() + SOC_BEYOND_PCT
            judged = left_out & (soc > lo) & (soc < hi)
            if judged.any():
                of_logs = tuple(np.unique(owner[judged]).tolist())
                self.folds.append(Fold(fit_on, judged, of_logs))
        judged = np.any([fold.judge_on for fold in self.folds], axis=0)
        if not self.folds or np.unique(self.unit[judged]).size < UNITS_AT_LEAST:
            seconds = sum(item.log.duration_s for item in logs)
            raise InputError(
                f"too little of {seconds:.0f} s of data can be held out to judge effects on",
                source=", ".join(item.log.name for item in logs),
                field="effects",
                cure="give an hour with changing load, or three logs and more over the same SoC;"
                " or fit without --effects",
            )

    def __call__(self, model: ExtendedModel) -> Judged:
        """Return the errors of a fitted model, each row's by a fit that did not see it.

        Every fold goes one Gauss–Newton step from the model, which is where the fold's own fit
        lies but for what the step is not linear in.
        """
        error_v = np.full(self.unit.size, np.nan)
        whole = linearise(model, self.logs)
        for fold in self.folds:
            in_fold = replace(whole, model=spanning(model, whole.here, fold.fit_on))
            try:
                moved = moved_by(in_fold, step_on(in_fold, fold.fit_on))
            except CangaugeError:
                # A fold on which the model cannot be fitted is judged as it would be in use.
                error_v[fold.judge_on] = math.inf
                continue
            of_logs = np.isin(self._owner, fold.logs)
            seen = residual_of(moved, [self.logs[k] for k in fold.logs])
            error_v[fold.judge_on] = seen[fold.judge_on[of_logs]]
        return Judged(error_v, self.unit, whole_logs=len(self.logs) >= LOGS_AT_LEAST)

    def screen(
        self, linear: Linear, extra: Sequence[FloatArray], bounds: Sequence[FloatArray]
    ) -> list[float]:
        """Return by how much each of some additions would lower the held-out error, linearly.

        Parameters
        ----------
        linear : Linear
            At the model that they are added to.
        extra : sequence of arrays of shape (n, k)
            Columns of each addition.
        bounds : sequence of arrays of shape (k, 2)
            Limits of each addition's amplitudes.

        Returns
        -------
        list of float
            Mean logarithm of the ratio of mean square errors, before over after.
        """
        p = linear.columns.shape[1]
        table = np.column_stack([linear.columns, *extra, linear.residual_v])
        holding = np.zeros((1, table.shape[1]))
        holding[:, [*range(p), -1]] = linear.holding
        first = p + np.cumsum([0, *(columns.shape[1] for columns in extra)])
        choices = [np.arange(0), *(np.arange(a, b) for a, b in itertools.pairwise(first))]
        squares = np.full((len(choices), self.unit.size), np.nan)
        for fold in self.folds:
            compact = np.linalg.qr(np.vstack([table[fold.fit_on], holding])).R
            rows = table[fold.judge_on]
            span = spanning(linear.model, linear.here, fold.fit_on).model.soc_range_pct
            limits = linear.limits(span)
            for k, own in enumerate(choices):
                used = np.concatenate((np.arange(p), own, [table.shape[1] - 1]))
                within = _with_bounds(limits, bounds[k - 1] if own.size else np.empty((0, 2)))
                change = best_change(compact[:, used], within)
                error_v = rows[:, -1] - rows[:, used[:-1]] @ change
                squares[k, fold.judge_on] = error_v**2
        seen = np.isfinite(squares[0])
        log_v2 = [np.log(mean_squares(item[seen], self.unit[seen])) for item in squares]
        return [float(np.mean(log_v2[0] - item)) for item in log_v2[1:]]


def _with_bounds(
    limits: tuple[FloatArray, FloatArray], bounds: FloatArray
) -> tuple[FloatArray, FloatArray]:
    matrix, at_least = limits
    k = bounds.shape[0]
    wider = np.hstack([matrix, np.zeros((matrix.shape[0], k))])
    own = np.hstack([np.zeros((k, matrix.shape[1])), np.eye(k)])
    return (
        np.vstack([wider, own, -own]),
        np.concatenate((at_least, bounds[:, 0], -bounds[:, 1])),
    )


@dataclass(frozen=True)
class Comparison:
    """How much better one model is than another on rows left out."""

    before_rmse_v: float
    after_rmse_v: float
    t_value: float
    """Mean logarithm of the ratio of mean square errors over its standard error; where whole logs
    are left out, the lesser of that and twice the same of the variances within the logs."""
    needed: float
    """What chance would not exceed."""

    @property
    def better(self) -> bool:
        """Whether the second is better by more than chance, and by enough."""
        return self.worth_it and self.t_value > self.needed

    @property
    def worth_it(self) -> bool:
        """Whether the error falls by enough, be it by chance."""
        return self.after_rmse_v <= (1.0 - GAIN_AT_LEAST) * self.before_rmse_v


def compare(before: Judged, after: Judged, amplitudes: int = 1) -> Comparison:
    """Compare two models on the same rows.

    Parameters
    ----------
    before, after : Judged
    amplitudes : int
        Of the effect that the second has beside the first.
    """
    t_value = _t_value(before.unit_v2, after.unit_v2)
    if before.whole_logs:
        t_value = min(t_value, _t_value(before.within_v2, after.within_v2) / WITHIN)
    return Comparison(
        before.rmse_v,
        after.rmse_v,
        t_value,
        float(student_t.ppf(1.0 - CHANCE / amplitudes, before.unit_v2.size - 1)),
    )


def _t_value(before_v2: FloatArray, after_v2: FloatArray) -> float:
    """Return the mean logarithm of the ratio of mean squares over its standard error."""
    with np.errstate(invalid="ignore"):
        logs = np.log(before_v2) - np.log(after_v2)
    if not np.all(np.isfinite(logs)):
        return -math.inf
    error = float(np.std(logs, ddof=1)) / math.sqrt(logs.size)
    return float(np.mean(logs)) / max(error, 1e-12)


def _units(logs: Sequence[Prepared]) -> NDArray[np.intp]:
    """Return the number of each row's log; of its block, where blocks are left out."""
    numbers: list[NDArray[np.intp]] = []
    first = 0
    for item in logs:
        time_s = item.rows.time_s
        number = np.zeros(time_s.size, dtype=np.intp)
        if len(logs) < LOGS_AT_LEAST:
            number = ((time_s - time_s[0]) // BLOCK_S).astype(np.intp)
        numbers.append(first + number)
        first = int(numbers[-1].max()) + 1
    return np.concatenate(numbers)

"""The given model with the effect that explains the logs, judged on rows that did not size it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge._version import __version__
from cangauge.diagnosis.evidence import Evidence
from cangauge.diagnosis.pack import Healthy, LogRows
from cangauge.diagnosis.rows import Simulated, added
from cangauge.diagnosis.shapes import Shape
from cangauge.diagnosis.sizes import folds
from cangauge.diagnosis.where import Errors, rms
from cangauge.estimation.offline import estimate
from cangauge.model.effects.library import effect_entries
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model

SETTLING_S: Final = 300.0
"""With its start withheld, an estimate of the SoC counts from here on [s]."""


def errors_of(given: Sequence[Simulated], logs: Sequence[LogRows]) -> Errors:
    """Return the errors of simulated logs on the rows that count."""
    parts = []
    for k, (log, of) in enumerate(zip(logs, given, strict=True)):
        at, time_s = log.trace.rows[log.kept], of.signals.time_s
        error_v = of.plain.residual_v[log.kept]
        parts.append(
            (
                np.full(at.size, k),
                time_s[at] - time_s[0],
                of.signals.current_a[at],
                of.signals.temperature_c[at],
                of.plain.soc_pct[at],
                error_v,
                error_v,
            )
        )
    return Errors(*map(np.concatenate, zip(*parts, strict=True)))


def soc_errors_pct(model: Model, logs: Sequence[LogRows]) -> FloatArray:
    """Return absolute error and standard deviation of the SoC, start withheld [%], shape (2, m).

    On the rows that count. Both are NaN for a log that mostly has no SoC, and the error while the
    estimate settles.
    """
    return np.concatenate([_soc_errors_of_log_pct(model, log) for log in logs], axis=1)


def _soc_errors_of_log_pct(model: Model, log: LogRows) -> FloatArray:
    of, at = log.trace.log, log.trace.rows[log.kept]
    known = np.isfinite(np.full(len(of), np.nan) if of.soc_pct is None else of.soc_pct)
    if of.soc_pct is None or known.mean() < 0.5:
        return np.full((2, at.size), np.nan)
    table = estimate(replace(of, soc_pct=None), model, initial_soc_pct="auto")
    own_pct = np.interp(of.time_s, of.time_s[known], of.soc_pct[known])
    is_settled = of.time_s - of.time_s[0] >= SETTLING_S
    error_pct = np.where(is_settled, np.abs(table.soc_pct - own_pct), np.nan)
    return np.stack([error_pct[at], table.soc_std_pct[at]])


def mean_errors(before: FloatArray, after: FloatArray) -> tuple[float, float]:
    """Return the means of two errors on the rows where both are known; NaN where none is."""
    known = np.isfinite(before + after)
    if not known.any():
        return math.nan, math.nan
    return float(before[known].mean()), float(after[known].mean())


@dataclass(frozen=True, eq=False)
class Correction:
    """One effect that corrects a model.

    Parameters
    ----------
    evidence : Evidence
    errors : Errors
        Before and after, on the rows that count, sized without them.
    """

    evidence: Evidence
    errors: Errors = field(repr=False)

    @property
    def rmse_v(self) -> float:
        """Error of the corrected model [V]."""
        return rms(self.errors.after_v)

    @property
    def is_better(self) -> bool:
        """Whether the error of rows that did not size it is smaller with it."""
        return self.rmse_v < rms(self.errors.before_v)

    @property
    def is_of_log(self) -> bool:
        """Whether it belongs to these logs and not to the pack."""
        return self.evidence.fault == "start"

    def applied(self, given: ExtendedModel) -> ExtendedModel:
        """Return the model for later logs: a step that has happened persists."""
        shape = self.evidence.shape
        if shape.place is not None:
            shape = replace(shape, place=0.0).in_log(0.0)
        return added(given, shape.effect, shape.values(self.evidence.size))


class HeldOut:
    """Logs whose parts are held out in turn, to judge corrections of a model.

    Parameters
    ----------
    model : Model
    healthy : Healthy
    logs : sequence of LogRows
    """

    def __init__(self, model: Model, healthy: Healthy, logs: Sequence[LogRows]) -> None:
        self._model, self._logs, self.extended = model, logs, model.extended_model()
        self._simulated = [Simulated(self.extended, log.trace) for log in logs]
        self._folds = folds(healthy, logs)
        self.errors = errors_of(self._simulated, logs)
        """Without a correction."""

    @cached_property
    def soc(self) -> FloatArray:
        """SoC errors without a correction, and the standard deviations of the SoC [%]."""
        return soc_errors_pct(self._model, self._logs)

    def correction(self, evidence: Evidence) -> Correction:
        """Return the correction by an effect."""
        after_v = self._judged(evidence, self.errors.before_v, self._voltage_errors_v)
        return Correction(evidence, replace(self.errors, after_v=after_v))

    def corrected_soc_errors_pct(self, correction: Correction) -> FloatArray:
        """Return the SoC errors with a correction, sized without the rows that are judged [%]."""
        errors_with = partial(self._soc_errors_pct, correction.rmse_v)
        return self._judged(correction.evidence, self.soc[0], errors_with)

    def keeps_soc(self, correction: Correction) -> bool:
        """Whether the SoC error grows by no more than the standard deviation of the SoC.

        A smaller growth is within the estimator's own uncertainty.
        """
        if correction.is_of_log or not np.isfinite(self.soc[0]).any():
            return True
        errors_pct, std_pct = self.soc
        growth_pct = self.corrected_soc_errors_pct(correction) - errors_pct
        known = np.isfinite(growth_pct)
        return bool(known.any() and growth_pct[known].mean() <= std_pct[known].mean())

    def _judged(
        self,
        evidence: Evidence,
        before: FloatArray,
        errors_with: Callable[[int, Shape, float], FloatArray],
    ) -> FloatArray:
        """Return errors on all rows that count; the other parts of the logs size each part.

        `errors_with(k, shape, size)` returns the errors of log k with a shape of that size.
        """
        after = [before[self.errors.log == k] for k in range(len(self._logs))]
        for profile, judged in self._folds:
            size = profile.sized(evidence)
            for k, (shape, rows) in enumerate(zip(evidence.shapes, judged, strict=True)):
                if shape is not None and rows.any():
                    after[k] = np.where(rows, errors_with(k, shape, size), after[k])
        return np.concatenate(after)

    def _voltage_errors_v(self, k: int, shape: Shape, size: float) -> FloatArray:
        corrected = self._simulated[k].with_effect(shape.effect, shape.values(size))
        return corrected.residual_v[self._logs[k].kept]

    def _soc_errors_pct(self, rmse_v: float, k: int, shape: Shape, size: float) -> FloatArray:
        corrected = added(self.extended, shape.effect, shape.values(size))
        model = model_file(self._model, corrected, rmse_v)
        return np.asarray(soc_errors_pct(model, [self._logs[k]])[0])


def model_file(given: Model, corrected: ExtendedModel, rmse_v: float) -> Model:
    """Return the corrected model, ready to save and run, with its error on held-out rows."""
    made = given.made.model_copy(update={"by": f"cangauge {__version__} gap"})
    judged = {"voltage_rmse_v": rmse_v, "judged_on": "rows left out by `cangauge gap`"}
    return given.model_copy(
        update={
            "name": f"{given.name}, corrected",
            "effects": effect_entries(corrected.effects),
            "noise": given.noise.model_copy(update=judged),
            "information": None,
            "made": made,
        }
    )

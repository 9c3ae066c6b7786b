"""Both passes of the fit over logs: rows are made for each log when it is its turn."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np

from cangauge._typing import FloatArray
from cangauge.identify.log_errors import (
    HeldOut,
    LogErrors,
    LogFigures,
    errors_of,
    score_sums,
    summed,
    summed_scores,
    with_std_errors,
)
from cangauge.identify.voltage_fit import (
    LogInformation,
    fit_information,
    information_of,
    models_without,
    pooled,
)
from cangauge.inference.least_squares import Solution
from cangauge.inference.rows import (
    FOLDS_AT_MOST,
    LOGS_AT_LEAST,
    FitOptions,
    FitRows,
    Mask,
    fit_rows,
    folds,
)
from cangauge.logs.log import Log
from cangauge.model.voltage_model import VoltageModel

_LOG = logging.getLogger(__name__)


class RowsOfLogs(Sequence[FitRows]):
    """Rows of the fit of each log, made anew at each access: those of one log are held at a time.

    Parameters
    ----------
    logs : sequence of Log
    options : FitOptions
    """

    def __init__(self, logs: Sequence[Log], options: FitOptions) -> None:
        self._logs, self._options = tuple(logs), options

    def __len__(self) -> int:
        """Return the number of logs."""
        return len(self._logs)

    @overload
    def __getitem__(self, at: int) -> FitRows: ...
    @overload
    def __getitem__(self, at: slice) -> RowsOfLogs: ...
    def __getitem__(self, at: int | slice) -> FitRows | RowsOfLogs:
        """Return the rows of one log."""
        if isinstance(at, slice):
            return RowsOfLogs(self._logs[at], self._options)
        return fit_rows(self._logs[at], self._options)


@dataclass(frozen=True, eq=False)
class RowsFit:
    """Model of the rows of logs.

    Parameters
    ----------
    model : VoltageModel
    solution : Solution
    information : LogInformation or None
        Of all logs; None with effects.
    mean_c : float
        Mean temperature of the rows [°C].
    spans : array of shape (2,)
        Duration [s] and range of SoC [%], the mean of the logs.
    held_out : tuple of HeldOut
        Models that hold rows of each log out.
    errors : LogErrors
        Of all logs.
    figures : tuple of LogFigures
        Of each log.
    """

    model: VoltageModel
    solution: Solution
    information: LogInformation | None
    mean_c: float
    spans: FloatArray
    held_out: tuple[HeldOut, ...]
    errors: LogErrors
    figures: tuple[LogFigures, ...]


def fit_logs(rows: Sequence[FitRows], options: FitOptions) -> RowsFit:
    """Fit the coefficients, and evaluate them on all rows and on held-out rows.

    Parameters
    ----------
    rows : sequence of FitRows
        Three or more are gone through twice: `RowsOfLogs` makes them at each access.
    options : FitOptions

    Raises
    ------
    InputError
        If the rows cannot identify the model.
    """
    if len(rows) < LOGS_AT_LEAST:
        rows = list(rows)  # their blocks are held out
    first = _FirstPass(rows, options)
    model, solution = first.solve()
    _LOG.debug("cross-validation")
    held_out = first.held_out()
    whole: LogErrors | None = None
    figures = []
    for number, (item, models) in enumerate(zip(rows, held_out, strict=True), start=1):
        _LOG.debug("errors of log %d of %d", number, len(rows))
        found = errors_of(
            item, options, model, solution, held_out=models, mean_c=first.whole.mean_c
        )
        figures.append(LogFigures(item.name, item.removed, found.sums))
        whole = found if whole is None else summed([whole, found])
    if whole is None:
        raise ValueError("no log is given")
    solution = with_std_errors(solution, whole.sums, whole.scores)
    information = first.whole
    spans = information.spans / information.logs
    return RowsFit(
        model, solution, information, information.mean_c, spans, held_out, whole, tuple(figures)
    )


def fit_voltage_model(
    rows: Sequence[FitRows], options: FitOptions, *, with_kt_prior: bool = True
) -> tuple[VoltageModel, Solution]:
    """Fit the coefficients to rows of logs, without held-out errors; else as `fit_logs`."""
    model, solution = _FirstPass(rows, options, with_kt_prior=with_kt_prior).solve()
    parts = [score_sums(item, options, solution) for item in rows]
    return model, with_std_errors(solution, *summed_scores(parts))


def held_out_models(
    rows: Sequence[FitRows], options: FitOptions, *, with_kt_prior: bool = True
) -> tuple[HeldOut, ...]:
    """Return the models that hold rows of each log out (`rows.folds`).

    Raises
    ------
    InputError
        If no fold leaves training rows that identify a model.
    """
    return _FirstPass(list(rows), options, with_kt_prior=with_kt_prior).held_out()


class _FirstPass:
    """Information and voltages of all logs."""

    def __init__(
        self, rows: Sequence[FitRows], options: FitOptions, *, with_kt_prior: bool = True
    ) -> None:
        self._rows, self._options, self._with_kt_prior = rows, options, with_kt_prior
        self._fold = np.arange(len(rows)) % FOLDS_AT_MOST
        self._volts: list[FloatArray] = []
        self._by_fold: dict[int, LogInformation] = {}
        names = []
        for number, (item, fold) in enumerate(zip(rows, self._fold.tolist(), strict=True), start=1):
            _LOG.debug("fitting log %d of %d: %d rows", number, len(rows), len(item))
            names.append(item.name)
            self._volts.append(item.voltage_v)
            before = [self._by_fold[fold]] if fold in self._by_fold else []
            self._by_fold[fold] = pooled([*before, information_of(item, options)])
        self._names = ", ".join(names)
        self.whole = pooled(list(self._by_fold.values()))

    def solve(self) -> tuple[VoltageModel, Solution]:
        return fit_information(
            self.whole,
            self._options,
            source=self._names,
            nominal_v=self._median_v(self._fold >= 0),
            with_kt_prior=self._with_kt_prior,
        )

    def _median_v(self, logs: Mask) -> float:
        volts = [self._volts[k] for k in np.flatnonzero(logs)]
        return float(np.median(np.concatenate(volts), overwrite_input=True))

    def held_out(self) -> tuple[HeldOut, ...]:
        if len(self._rows) < LOGS_AT_LEAST:
            return self._by_blocks()
        medians = [
            float(
                np.median(np.concatenate([self._volts[k] for k in np.flatnonzero(self._fold != j)]))
            )
            for j in self._by_fold
        ]
        models = models_without(
            list(self._by_fold.values()), self._options,
            nominal_v=medians, with_kt_prior=self._with_kt_prior,
        )  # fmt: skip
        without = [models[j] for j in self._fold.tolist()]
        return tuple([] if model is None else [(None, model)] for model in without)

    def _by_blocks(self) -> tuple[HeldOut, ...]:
        ends = np.cumsum([len(item) for item in self._rows])[:-1]
        found: tuple[list[tuple[Mask | None, VoltageModel]], ...] = tuple([] for _ in self._rows)
        for number, (training, held_out) in enumerate(folds(self._rows), start=1):
            _LOG.debug("cross-validation: fold %d", number)
            kept = [
                (item, mask)
                for item, mask in zip(self._rows, np.split(training, ends), strict=True)
                if mask.any()
            ]
            volts = np.concatenate([item.voltage_v[mask] for item, mask in kept])
            model, _ = fit_information(
                pooled([information_of(item, self._options, keep=mask) for item, mask in kept]),
                self._options,
                nominal_v=float(np.median(volts, overwrite_input=True)),
                with_kt_prior=self._with_kt_prior,
            )
            for of_log, mask in zip(found, np.split(held_out, ends), strict=True):
                of_log.append((mask, model))
        return found

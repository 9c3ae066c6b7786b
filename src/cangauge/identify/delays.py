"""Greedy search over number and length of the delays by held-out error.

In each round one delay is added or moved, as long as the held-out error falls by at least
`GAIN_AT_LEAST`. All choices are compared on the same rows (those with the longest candidate behind
them), without the constraint of a rising pseudo-OCV, which the final fit adds.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.identify.voltage_fit import design_matrix
from cangauge.inference.rows import FitOptions, FitRows, fit_rows, folds
from cangauge.logs.log import Log

_LOG = logging.getLogger(__name__)

CANDIDATES_S = (0.0, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 50.0, 70.0, 100.0, 150.0, 200.0, 300.0)
DELAYS_AT_MOST = 6
GAIN_AT_LEAST = 0.005
"""Least relative decrease of the held-out error for a change to be taken."""


@dataclass(frozen=True)
class DelaySearch:
    """Result of `search_delays`."""

    delay_s: tuple[float, ...]
    """The chosen delays [s], increasing from 0."""
    held_out_rmse_v: float
    """Their held-out error [V]."""
    tried: tuple[tuple[tuple[float, ...], float], ...]
    """Every choice tried, with its held-out error [V], in order."""


@dataclass(frozen=True, eq=False)
class _Fold:
    """Triangular factors of [columns | voltage], sufficient for least squares."""

    training: FloatArray
    held_out: FloatArray
    held_out_rows: int


def search_delays(logs: Sequence[Log], options: FitOptions) -> DelaySearch:
    """Choose delays for the logs; each choice taken is logged at INFO.

    Parameters
    ----------
    logs : sequence of Log
    options : FitOptions
        Its delays are ignored.

    Raises
    ------
    InputError
        If the logs are too short to hold rows out.
    """
    candidates = replace(options, delay_s=CANDIDATES_S)
    held_out_error = _HeldOutError([fit_rows(log, candidates) for log in logs], options)
    best: tuple[float, ...] = (0.0,)
    error_v = held_out_error(best)
    while True:
        choices = _neighbours(best)
        errors_v = [held_out_error(choice) for choice in choices]
        k = int(np.argmin(errors_v))
        if not errors_v[k] < (1.0 - GAIN_AT_LEAST) * error_v:
            return DelaySearch(best, error_v, tuple(held_out_error.tried.items()))
        best, error_v = choices[k], errors_v[k]
        _LOG.info("delays %s s: %.4f V held out", ", ".join(f"{d:g}" for d in best), error_v)


def _neighbours(delay_s: tuple[float, ...]) -> list[tuple[float, ...]]:
    """Return the choices with one more delay, or with one moved; 0 s is always kept."""
    free = [delay for delay in CANDIDATES_S if delay not in delay_s]
    more = [tuple(sorted((*delay_s, new))) for new in free] if len(delay_s) < DELAYS_AT_MOST else []
    moved = [
        tuple(sorted((*(kept for kept in delay_s if kept != old), new)))
        for old in delay_s[1:]
        for new in free
    ]
    return more + moved


class _HeldOutError:
    """Held-out error of a choice of delays [V], with a cache of the choices tried."""

    def __init__(self, rows: Sequence[FitRows], options: FitOptions) -> None:
        columns = np.vstack(
            [design_matrix(item, options.epsilon, options.t_ref_c) for item in rows]
        )
        scale = np.linalg.norm(columns, axis=0)
        scale[scale == 0.0] = 1.0
        volts = np.concatenate([item.voltage_v for item in rows])
        soc = np.concatenate([item.soc_pct for item in rows])
        table = np.column_stack([columns / scale, volts])
        self._shared = columns.shape[1] - len(CANDIDATES_S)
        self._folds: list[_Fold] = []
        for training, held_out in folds(rows):
            inside = (soc >= soc[training].min()) & (soc <= soc[training].max())
            tested = held_out & inside
            if tested.any():
                factors = np.linalg.qr(table[training]).R, np.linalg.qr(table[tested]).R
                self._folds.append(_Fold(*factors, int(tested.sum())))
        if not self._folds:
            raise InputError(
                "the logs are too short to hold rows out for a search over delays",
                field="delays",
                cure="give the delays, for example --delays 0,10,30,70, or more logs",
            )
        self.tried: dict[tuple[float, ...], float] = {}

    def __call__(self, delay_s: tuple[float, ...]) -> float:
        if delay_s not in self.tried:
            self.tried[delay_s] = self._error(delay_s)
        return self.tried[delay_s]

    def _error(self, delay_s: tuple[float, ...]) -> float:
        used = [
            *range(self._shared),
            *(self._shared + CANDIDATES_S.index(delay) for delay in delay_s),
        ]
        square, count = 0.0, 0
        for fold in self._folds:
            x = np.linalg.lstsq(fold.training[:, used], fold.training[:, -1], rcond=1e-11)[0]
            square += float(np.sum((fold.held_out[:, used] @ x - fold.held_out[:, -1]) ** 2))
            count += fold.held_out_rows
        return math.sqrt(square / count)

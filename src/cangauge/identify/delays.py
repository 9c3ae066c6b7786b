"""A search over number and size of delays, like the paper's trial and error, by held-out error.

Delays are added one at a time, and then each is tried elsewhere, as long as the error on rows
that the fit did not see falls by at least `GAIN_AT_LEAST`. All choices are judged on the same rows
(those with the longest candidate behind them). The pseudo-OCV is not held rising here; the final
fit does that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.identify.rows import FitOptions, FitRows, folds
from cangauge.identify.voltage_fit import columns_of, prepare
from cangauge.logs.log import Log

CANDIDATES_S = (0.0, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 50.0, 70.0, 100.0, 150.0, 200.0, 300.0)
DELAYS_AT_MOST = 6
GAIN_AT_LEAST = 0.005
"""A change must lower the held-out error by this much, relative, to be worth it."""


@dataclass(frozen=True)
class DelaySearch:
    """What the search found."""

    delay_s: tuple[float, ...]
    """The chosen delays [s], increasing from 0."""
    held_out_rmse_v: float
    """Their error on rows that the fit did not see [V]."""
    tried: tuple[tuple[tuple[float, ...], float], ...]
    """Every choice that was tried, with its held-out error [V], in order."""


@dataclass(frozen=True, eq=False)
class _Fold:
    """Triangular factors of [columns | voltage]: all that least squares needs of the rows."""

    fitted: FloatArray
    judged: FloatArray
    judged_rows: int


def search_delays(
    logs: Sequence[Log],
    options: FitOptions,
    progress: Callable[[str], None] | None = None,
) -> DelaySearch:
    """Choose delays for the logs.

    Parameters
    ----------
    logs : sequence of Log
    options : FitOptions
        Its capacity must be given; its delays are ignored.
    progress : callable, optional
        Called with a line of text for each delay that is taken in.

    Raises
    ------
    InputError
        If the logs are too short to hold anything out.
    """
    rows = prepare(logs, replace(options, delay_s=CANDIDATES_S))
    judge = _Judge(rows, options)
    best: tuple[float, ...] = (0.0,)
    error = judge(best)
    improved = True
    while improved:
        choices = _neighbours(best)
        errors = [judge(choice) for choice in choices]
        k = int(np.argmin(errors))
        improved = errors[k] < (1.0 - GAIN_AT_LEAST) * error
        if improved:
            best, error = choices[k], errors[k]
            if progress is not None:
                progress(f"delays {', '.join(f'{d:g}' for d in best)} s: {error:.4f} V held out")
    return DelaySearch(best, error, tuple(judge.tried.items()))


def _neighbours(delay_s: tuple[float, ...]) -> list[tuple[float, ...]]:
    """Return the choices with one delay more, or one moved elsewhere; 0 s always stays."""
    free = [delay for delay in CANDIDATES_S if delay not in delay_s]
    more = [tuple(sorted((*delay_s, new))) for new in free] if len(delay_s) < DELAYS_AT_MOST else []
    moved = [
        tuple(sorted((*(kept for kept in delay_s if kept != old), new)))
        for old in delay_s[1:]
        for new in free
    ]
    return more + moved


class _Judge:
    """Held-out error of a choice of delays; remembers what was tried."""

    def __init__(self, rows: Sequence[FitRows], options: FitOptions) -> None:
        columns = np.vstack([columns_of(item, options.epsilon, options.t_ref_c) for item in rows])
        scale = np.linalg.norm(columns, axis=0)
        scale[scale == 0.0] = 1.0
        volts = np.concatenate([item.voltage_v for item in rows])
        soc = np.concatenate([item.soc_pct for item in rows])
        table = np.column_stack([columns / scale, volts])
        self._shared = columns.shape[1] - len(CANDIDATES_S)
        self._folds = []
        for fitted, left_out in folds(rows):
            seen = (soc >= soc[fitted].min()) & (soc <= soc[fitted].max())
            judged = left_out & seen
            if judged.any():
                self._folds.append(
                    _Fold(
                        np.linalg.qr(table[fitted]).R,
                        np.linalg.qr(table[judged]).R,
                        int(judged.sum()),
                    )
                )
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
            x = np.linalg.lstsq(fold.fitted[:, used], fold.fitted[:, -1], rcond=1e-11)[0]
            square += float(np.sum((fold.judged[:, used] @ x - fold.judged[:, -1]) ** 2))
            count += fold.judged_rows
        return math.sqrt(square / count)

"""What the model's error is like in time: fast, slow, and lasting.

The filter must know the difference. An error that is new every second averages out; one that
lasts as long as a trip does not, however many samples are taken. All are read off the
autocovariance of errors on logs that the fit did not see.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.stats import t as student_t

from cangauge.identify.held_out import LOGS_AT_LEAST

FloatArray = NDArray[np.float64]

LAGS_S = (1.0, 2.0, 5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0, 1280.0)
TIME_CONSTANTS_S = (3.0, 10.0, 30.0, 100.0, 300.0, 1e6)
"""Durations that the error is made up of [s]; the last stands for the whole log. Those in between
cannot be told from it in trips of half an hour."""

SLOW_UNSEEN_S = 300.0
"""Duration of a slow part that the logs do not show [s]."""

SLOW_S, LASTING_S = 60.0, 1e5
"""Parts that last longer count as slow, and as lasting [s]."""

PARTS_AT_LEAST = 0.5
"""Fewer than three logs do not show how the error differs from log to log; the slow and the
lasting part are then taken to be at least this large, relative to the root mean square error."""


@dataclass(frozen=True)
class Noise:
    """The model's voltage error."""

    fast_std_v: float
    """Standard deviation of the fast part [V]."""
    fast_time_s: float
    """How long the fast part lasts [s]; 0 if it is new at each sample."""
    slow_std_v: float
    """Standard deviation of the slow part [V]."""
    slow_time_s: float
    """How long the slow part lasts [s]."""
    lasting_std_v: float
    """Standard deviation from log to log of what lasts as long as a log [V]."""


def describe_noise(residuals: Sequence[tuple[FloatArray, FloatArray]], rate_hz: float) -> Noise:
    """Split errors into a fast and a slow part.

    Parameters
    ----------
    residuals : sequence of (time_s, error_v)
        Errors [V] of each log on its rows' times [s], from a fit that did not see the log.
    rate_hz : float
        Rate of the rows.

    Notes
    -----
    The autocovariance at `LAGS_S` is fitted by a non-negative sum of white noise and exponentials
    with `TIME_CONSTANTS_S` (scipy's nnls).
    """
    lags = np.array([0.0, *LAGS_S])
    total, count = np.zeros(lags.size), np.zeros(lags.size)
    for time_s, error_v in residuals:
        on_grid, present = _on_grid(time_s, error_v, rate_hz)
        for k, lag in enumerate(lags):
            shift = round(lag * rate_hz)
            if shift >= on_grid.size or (lag > 0.0 and shift == 0):
                continue  # longer than the log, or shorter than a row lasts
            both = present[shift:] & present[: on_grid.size - shift]
            total[k] += float(on_grid[shift:][both] @ on_grid[: on_grid.size - shift][both])
            count[k] += float(both.sum())
    seen = count > 0
    covariance, weight = total[seen] / count[seen], np.sqrt(count[seen] / count[0])
    columns = np.column_stack(
        [lags[seen] == 0.0, *(np.exp(-lags[seen] / tau) for tau in TIME_CONSTANTS_S)]
    )
    variance, _ = nnls(columns * weight[:, None], covariance * weight)
    times = np.array([0.0, *TIME_CONSTANTS_S])
    slow = (times > SLOW_S) & (times < LASTING_S)
    fast = times <= SLOW_S
    slow_v2, lasting_v2 = float(variance[slow].sum()), float(variance[-1])
    if len(residuals) < LOGS_AT_LEAST:
        floor_v2 = PARTS_AT_LEAST**2 * float(covariance[0])
        slow_v2, lasting_v2 = max(slow_v2, floor_v2), max(lasting_v2, floor_v2)
    few = _few_logs(len(residuals))
    return Noise(
        fast_std_v=float(np.sqrt(variance[fast].sum())),
        fast_time_s=_mean_time(variance[fast], times[fast]),
        slow_std_v=few * math.sqrt(slow_v2),
        slow_time_s=_mean_time(variance[slow], times[slow]) or SLOW_UNSEEN_S,
        lasting_std_v=few * math.sqrt(lasting_v2),
    )


def _few_logs(number: int) -> float:
    """Return by how much a spread seen in a few logs understates that of the next log.

    The 95 % prediction interval of a normal variable from n values, relative to ±1.96 σ.
    """
    if number < LOGS_AT_LEAST:
        return 1.0
    return float(student_t.ppf(0.975, number - 1) / 1.96 * np.sqrt(1.0 + 1.0 / number))


def _mean_time(variance: FloatArray, times_s: FloatArray) -> float:
    total = float(variance.sum())
    return float(variance @ times_s) / total if total > 0.0 else 0.0


def _on_grid(
    time_s: FloatArray, error_v: FloatArray, rate_hz: float
) -> tuple[FloatArray, NDArray[np.bool_]]:
    slot = np.round((time_s - time_s[0]) * rate_hz).astype(np.intp)
    values, present = np.zeros(int(slot[-1]) + 1), np.zeros(int(slot[-1]) + 1, dtype=bool)
    values[slot] = error_v
    present[slot] = True
    return values, present

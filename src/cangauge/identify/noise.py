"""Voltage error of a model by correlation time: a fast, a slow and a lasting part.

The filter treats them differently: an error that is independent every second averages out, an error
that lasts as long as a trip does not. The parts are fitted to the autocovariance of held-out
errors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.stats import t as student_t

from cangauge._typing import FloatArray
from cangauge.inference.rows import LOGS_AT_LEAST

LAGS_S = (1.0, 2.0, 5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0, 1280.0)
TIME_CONSTANTS_S = (3.0, 10.0, 30.0, 100.0, 300.0, 1e6)
"""Time constants of the error's parts [s]; the last represents the whole log. Those between 300 s
and a log's length are not separable from it in trips of half an hour."""

SLOW_UNSEEN_S = 300.0
"""Time constant of a slow part that the logs do not show [s]."""

SLOW_S, LASTING_S = 60.0, 1e5
"""Time constants from which a part counts as slow, and as lasting [s]."""

PARTS_AT_LEAST = 0.5
"""Least standard deviation of the slow and the lasting part, relative to the root mean square
error, for fewer than three logs: they do not show how the error differs from log to log."""


@dataclass(frozen=True)
class Noise:
    """Parts of the model's voltage error."""

    fast_std_v: float
    """Standard deviation of the fast part [V]."""
    fast_time_s: float
    """Mean time constant of the fast part [s]; 0 if white."""
    slow_std_v: float
    """Standard deviation of the slow part [V]."""
    slow_time_s: float
    """Mean time constant of the slow part [s]."""
    lasting_std_v: float
    """Standard deviation of the part that lasts as long as a log [V]."""


def describe_noise(residuals: Sequence[tuple[FloatArray, FloatArray]], rate_hz: float) -> Noise:
    """Split errors into a fast, a slow and a lasting part.

    Parameters
    ----------
    residuals : sequence of (time_s, error_v)
        Held-out errors [V] of each log, and the times of its rows [s].
    rate_hz : float
        Rate of the rows.

    Notes
    -----
    The autocovariance at `LAGS_S` is fitted by a non-negative sum of white noise and exponentials
    with `TIME_CONSTANTS_S`.
    """
    lags = np.array([0.0, *LAGS_S])
    total, count = np.zeros(lags.size), np.zeros(lags.size)
    for time_s, error_v in residuals:
        on_grid, present = _on_grid(time_s, error_v, rate_hz)
        for k, lag in enumerate(lags):
            shift = round(lag * rate_hz)
            if shift >= on_grid.size or (lag > 0.0 and shift == 0):
                continue  # longer than the log, or shorter than the row interval
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
    widening = _few_logs_factor(len(residuals))
    return Noise(
        fast_std_v=float(np.sqrt(variance[fast].sum())),
        fast_time_s=_mean_time(variance[fast], times[fast]),
        slow_std_v=widening * math.sqrt(slow_v2),
        slow_time_s=_mean_time(variance[slow], times[slow]) or SLOW_UNSEEN_S,
        lasting_std_v=widening * math.sqrt(lasting_v2),
    )


def _few_logs_factor(number: int) -> float:
    """Return the factor from the spread of a few logs to that expected of the next one.

    It is the 95 % prediction interval of a normal variable from n values, relative to ±1.96 σ.
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

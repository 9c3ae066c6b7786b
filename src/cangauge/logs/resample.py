"""Dequantize the temperature of a log for a fit or diagnosis; not causal, so offline only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cangauge._typing import FloatArray, IntArray
from cangauge.logs.log import Log

PLATEAU_S = 60.0
"""A reported value that lasts this long [s] is assumed exact in the middle of its plateau; shorter
plateaus are noise of a temperature between two steps."""
STEPPED_SHARE = 0.5
"""A temperature that changes at this fraction of the rows or more is not quantized [-]."""


def dequantize(log: Log) -> Log:
    """Return a log whose quantized temperature is interpolated between its steps.

    A sensor reports whole or quarter degrees, while the temperature may change by less in an hour:
    the error of up to half a step lasts as long. With a coefficient of tenths of a volt per kelvin
    (0.74 V/K in the published model) it exceeds most effects. At a step the temperature is known:
    half-way between the two values.

    Interpolation is linear between steps and the middles of long plateaus, and clipped to half a
    usual step around the reported value, which preserves jumps, as after an unobserved interval. A
    temperature that never changes, or changes at most rows, is kept.
    """
    time_s, reported = log.time_s, log.temperature_c
    change = np.flatnonzero(np.diff(reported))
    if not 0 < change.size < STEPPED_SHARE * len(log):
        return log
    half_step = 0.5 * usual_step_k(log)
    first, last = np.append(0, change + 1), np.append(change, len(log) - 1)
    plateau = time_s[last] - time_s[first] >= PLATEAU_S
    plateau[[0, -1]] = True  # nothing else is known before the first step and after the last
    knots_s = np.append(_midpoints(time_s, change), 0.5 * (time_s[first] + time_s[last])[plateau])
    knots_c = np.append(_midpoints(reported, change), reported[first][plateau])
    order = np.argsort(knots_s, kind="stable")
    line = np.interp(time_s, knots_s[order], knots_c[order])
    bounded = np.clip(line, reported - half_step, reported + half_step)
    return replace(log, temperature_c=bounded)


def usual_step_k(log: Log) -> float:
    """Return the median step of a log's reported temperature [K]; 0 if it never changes."""
    steps = np.abs(np.diff(log.temperature_c))
    changed = steps > 0.0
    return float(np.median(steps[changed])) if changed.any() else 0.0


def _midpoints(values: FloatArray, change: IntArray) -> FloatArray:
    return np.asarray(0.5 * (values[change] + values[change + 1]))

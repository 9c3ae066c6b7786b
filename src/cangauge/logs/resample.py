"""Prepare a log for a fit or diagnosis: dequantize its temperature, average fast rows.

Both are non-causal, hence for offline use only.
"""

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
ENOUGH_HZ = 20.0
"""Rate of an averaged log [Hz]. A log below twice this rate is returned unchanged."""


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


def resample(log: Log, rate_hz: float = ENOUGH_HZ) -> Log:
    """Return a log averaged over bins of 1 / `rate_hz`.

    A diagnosis evaluates hundreds of effects over all samples. The fastest act within a few tenths
    of a second, while a car's bus gives a hundred samples per second.

    Each row holds the means of all signals at the mean time of its bin: relative delays, charge and
    unobserved intervals are preserved. The reference SoC is the first finite value
    of each bin.
    """
    if len(log) < 2 or float(np.median(np.diff(log.time_s))) * 2.0 * rate_hz > 1.0:
        return log
    bins = np.floor((log.time_s - log.time_s[0]) * rate_hz)
    first = np.flatnonzero(np.diff(bins, prepend=-1.0))
    counts = np.diff(first, append=len(log))

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.add.reduceat(values, first) / counts)

    return replace(
        log,
        time_s=log.time_s[0] + mean(log.time_s - log.time_s[0]),
        current_a=mean(log.current_a),
        voltage_v=mean(log.voltage_v),
        temperature_c=mean(log.temperature_c),
        soc_pct=None if log.soc_pct is None else _first_finite(log.soc_pct, first),
    )


def _first_finite(values: FloatArray, first: IntArray) -> FloatArray:
    """Return the first finite value of each bin, NaN where there is none."""
    known = np.flatnonzero(np.isfinite(values))
    found = np.full(first.size, np.nan)
    bins, at = np.unique(np.searchsorted(first, known, side="right") - 1, return_index=True)
    found[bins] = values[known[at]]
    return found

"""A reported temperature without its steps.

A battery's sensor shows whole degrees, or quarters of one, while its temperature moves by less in
an hour: the report stands, and is wrong by up to half a step for as long. With a coefficient of
tenths of a volt per kelvin (the published one: 0.74) that is more than most causes do, and it lasts
as long as they do. Where the report changes, though, the temperature is known: half-way.

Fast logs for a diagnosis: stretches of a twentieth of a second, averaged.

A diagnosis tries hundreds of shapes of effects over all samples of a log. None of them lasts less
than a few tenths of a second, while a car's bus brings a hundred samples a second.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.logs.log import Log

# --- A reported temperature without its steps

STANDS_S = 60.0
"""A report that stands for so long [s] is right in its middle; a shorter one is the noise of a
temperature between two steps."""


STEPPED_PART = 0.5
"""A temperature that changes at this part of the rows or more is not reported in steps."""


def dequantize(log: Log) -> Log:
    """Return a log with the temperature that its reports are the steps of.

    Straight lines from change to change, through the middle of what stands in between, and nowhere
    further from the report than half of its usual step: a jump, as after a pause, stays one. Looks
    ahead, so it is for a diagnosis or a fit, not for the service. A temperature that never changes
    stays, and so does one that nearly always does.
    """
    time_s, reported = log.time_s, log.temperature_c
    change = np.flatnonzero(np.diff(reported))
    if not 0 < change.size < STEPPED_PART * len(log):
        return log
    half_step = 0.5 * usual_step_k(log)
    first, last = np.append(0, change + 1), np.append(change, len(log) - 1)
    stands = time_s[last] - time_s[first] >= STANDS_S
    stands[[0, -1]] = True  # before the first change and after the last nothing else is known
    knots_s = np.append(_between(time_s, change), 0.5 * (time_s[first] + time_s[last])[stands])
    knots_c = np.append(_between(reported, change), reported[first][stands])
    order = np.argsort(knots_s, kind="stable")
    line = np.interp(time_s, knots_s[order], knots_c[order])
    between = np.clip(line, reported - half_step, reported + half_step)
    return replace(log, temperature_c=between)


def usual_step_k(log: Log) -> float:
    """Return by how much a log's reported temperature usually changes at once [K]; 0 if never."""
    steps = np.abs(np.diff(log.temperature_c))
    changed = steps > 0.0
    return float(np.median(steps[changed])) if changed.any() else 0.0


def _between(values: FloatArray, change: NDArray[np.intp]) -> FloatArray:
    """Return the middle of the two values at each change."""
    return np.asarray(0.5 * (values[change] + values[change + 1]))


# --- Fast logs for a diagnosis: stretches of a twentieth of a second, averaged

ENOUGH_HZ = 20.0
"""Stretches a second [Hz]. A log with less than twice as many samples is taken as it is."""


def resample(log: Log, rate_hz: float = ENOUGH_HZ) -> Log:
    """Return a log with no more rows than a diagnosis can use.

    The means of all signals over a stretch stand at the mean of its times, so nothing is late
    against another and the charge stays; pauses stay pauses. The reference SoC is the first that
    each stretch tells: it may come more slowly than the current.
    """
    if len(log) < 2 or float(np.median(np.diff(log.time_s))) * 2.0 * rate_hz > 1.0:
        return log
    stretch = np.floor((log.time_s - log.time_s[0]) * rate_hz)
    first = np.flatnonzero(np.diff(stretch, prepend=-1.0))
    counts = np.diff(first, append=len(log))

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.add.reduceat(values, first) / counts)

    return replace(
        log,
        time_s=log.time_s[0] + mean(log.time_s - log.time_s[0]),
        current_a=mean(log.current_a),
        voltage_v=mean(log.voltage_v),
        temperature_c=mean(log.temperature_c),
        soc_pct=None if log.soc_pct is None else _first_known(log.soc_pct, first),
    )


def _first_known(values: FloatArray, first: NDArray[np.intp]) -> FloatArray:
    """Return the first finite value of each stretch, NaN where there is none."""
    known = np.flatnonzero(np.isfinite(values))
    found = np.full(first.size, np.nan)
    stretch, at = np.unique(np.searchsorted(first, known, side="right") - 1, return_index=True)
    found[stretch] = values[known[at]]
    return found

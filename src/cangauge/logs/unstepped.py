"""A reported temperature without its steps.

A battery's sensor shows whole degrees, or quarters of one, while its temperature moves by less in
an hour: the report stands, and is wrong by up to half a step for as long. With a coefficient of
tenths of a volt per kelvin (the published one: 0.74) that is more than most causes do, and it lasts
as long as they do. Where the report changes, though, the temperature is known: half-way.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cangauge.logs.log import Log

FloatArray = NDArray[np.float64]

STANDS_S = 60.0
"""A report that stands for so long [s] is right in its middle; a shorter one is the noise of a
temperature between two steps."""


STEPPED_PART = 0.5
"""A temperature that changes at this part of the rows or more is not reported in steps."""


def unstepped(log: Log) -> Log:
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

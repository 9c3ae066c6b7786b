"""Fast logs for a diagnosis: stretches of a twentieth of a second, averaged.

A diagnosis tries hundreds of shapes of effects over all samples of a log. None of them lasts less
than a few tenths of a second, while a car's bus brings a hundred samples a second.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cangauge.logs.log import Log

FloatArray = NDArray[np.float64]

ENOUGH_HZ = 20.0
"""Stretches a second [Hz]. A log with less than twice as many samples is taken as it is."""


def thinned(log: Log) -> Log:
    """Return a log with no more rows than a diagnosis can use.

    The means of all signals over a stretch stand at the mean of its times, so nothing is late
    against another and the charge stays; pauses stay pauses. The reference SoC is the first that
    each stretch tells: it may come more slowly than the current.
    """
    if len(log) < 2 or float(np.median(np.diff(log.time_s))) * 2.0 * ENOUGH_HZ > 1.0:
        return log
    stretch = np.floor((log.time_s - log.time_s[0]) * ENOUGH_HZ)
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

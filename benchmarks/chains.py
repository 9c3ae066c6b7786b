"""Recorded drives in a row, with a counted charge between each two of them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cangauge.estimation.offline import samples_of
from cangauge.logs.log import Log
from cangauge.types import Sample

SEAM_S, CHARGING_S = 720, 600
"""Time between two drives, and its part with a current [s]."""


def chain(
    drives: Sequence[Log], capacity_ah: float, offset_a: float
) -> tuple[list[Sample], np.ndarray]:
    """Chain drives; return samples and reference SoC [%] (NaN between drives).

    Between two drives there is no voltage, and the current moves the charge by which the
    reference differs.

    Parameters
    ----------
    drives : sequence of Log
        With a reference SoC.
    capacity_ah : float
        Capacity that converts a change of SoC to charge [Ah].
    offset_a : float
        Added to the current of the drives [A].
    """
    samples: list[Sample] = []
    reference: list[np.ndarray] = []
    start_s, last_pct = 0.0, math.nan
    for log in drives:
        soc = log.soc_pct
        if samples:
            gained_pct = soc[0] - last_pct
            samples += _charge(start_s, gained_pct, capacity_ah, float(log.temperature_c[0]))
            reference.append(np.full(SEAM_S, np.nan))
            start_s += SEAM_S
        begin_s = start_s - log.time_s[0]
        samples += [
            row._replace(time_s=row.time_s + begin_s, current_a=row.current_a + offset_a)
            for row in samples_of(log)
        ]
        reference.append(soc)
        start_s, last_pct = samples[-1].time_s, soc[np.isfinite(soc)][-1]
    return samples, np.concatenate(reference)


def _charge(
    start_s: float, gained_pct: float, capacity_ah: float, temperature_c: float
) -> list[Sample]:
    time_s = start_s + np.arange(SEAM_S) + 0.5
    current_a = np.zeros(SEAM_S)
    current_a[10:CHARGING_S] = 1.0
    moved_ah = float(np.trapezoid(current_a, time_s)) / 3600.0
    current_a *= -gained_pct / 100.0 * capacity_ah / moved_ah
    return [
        Sample(time, current, math.nan, temperature_c)
        for time, current in zip(time_s.tolist(), current_a.tolist(), strict=True)
    ]

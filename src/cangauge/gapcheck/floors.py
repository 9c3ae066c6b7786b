"""What the model misses on clean days: the floor that gaps are counted in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cangauge.identify.fit import FitOptions, Identification, fit
from cangauge.identify.voltage_fit import prepare
from cangauge.logs.log import Log


def identify(logs: Sequence[Log], capacity_ah: float) -> Identification:
    """Return the model of clean logs, as `cangauge fit` makes it.

    Parameters
    ----------
    logs : sequence of Log
    capacity_ah : float
        Capacity that the gauge assumes [Ah].
    """
    return fit(logs, FitOptions(capacity_ah=capacity_ah))


def missed_v(known: Identification, logs: Sequence[Log]) -> float:
    """Return the RMS error of a model on clean logs [V], by the SoC counted from their start.

    Parameters
    ----------
    known : Identification
    logs : sequence of Log
        Not those that it was identified on.
    """
    model = known.voltage_model
    options = FitOptions(
        capacity_ah=known.model.capacity_ah,
        rate_hz=known.model.rate_hz,
        delay_s=tuple(known.model.delays_s),
    )
    errors = [
        rows.voltage_v - model.voltage(rows.soc_pct, rows.temperature_c, rows.delayed_current_a)
        for rows in prepare(logs, options)
    ]
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))

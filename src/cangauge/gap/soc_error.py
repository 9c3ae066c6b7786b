"""The gap in SoC: the online estimator over the diagnosed logs, before and after."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cangauge.estimate.estimator import EstimatorSettings
from cangauge.estimate.offline import run_estimator, samples_of
from cangauge.logs.log import Log
from cangauge.model.model_file import ModelFile

FloatArray = NDArray[np.float64]

SETTLED_S = 300.0
"""The estimate is judged from here on, its initial SoC withheld [s]."""

TOLD_EVERY_S, TOLD_PART = 60.0, 0.5
"""A log tells its SoC if it does in this part of its minutes: one value is where it starts."""


def soc_mae_pct(logs: Sequence[Log], model: ModelFile) -> float | None:
    """Return the EKF's mean absolute error, initial SoC withheld [%]; None without reference.

    Parameters
    ----------
    logs : sequence of Log
        Those that tell their SoC all along are judged.
    model : ModelFile
        Plain or extended: what `cangauge run` would run.
    """
    errors = []
    for log in logs:
        if log.soc_pct is None or not _tells(log.time_s, log.soc_pct):
            continue
        found = run_estimator(samples_of(log), model, EstimatorSettings())
        error = np.abs(found.soc_pct - log.soc_pct)
        errors.append(error[np.isfinite(error) & (log.time_s - log.time_s[0] >= SETTLED_S)])
    together = np.concatenate(errors) if errors else np.zeros(0)
    return float(together.mean()) if together.size else None


def _tells(time_s: FloatArray, soc_pct: FloatArray) -> bool:
    minute = ((time_s - time_s[0]) // TOLD_EVERY_S).astype(np.intp)
    told = np.unique(minute[np.isfinite(soc_pct)]).size
    return told >= TOLD_PART * np.unique(minute).size

"""Days of the published equation's pack, and what is done to them, that several tests diagnose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cangauge.logs.log import Log
from synthetic import synthetic_log


def day(seed: int) -> Log:
    """A healthy drive from 85 to 60 %."""
    return synthetic_log(
        hours=0.8, start_pct=85.0, end_pct=60.0, noise_v=0.5, seed=seed, name=f"day {seed}"
    )


def late(log: Log) -> Log:
    """The current of a second ago."""
    return replace(log, current_a=np.interp(log.time_s - 1.0, log.time_s, log.current_a))

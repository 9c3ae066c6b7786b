"""What a user may choose in an identification."""

from __future__ import annotations

from dataclasses import dataclass

DELAYS_S = (0.0, 10.0, 30.0, 70.0)
"""The published delays [s]."""


@dataclass(frozen=True)
class FitOptions:
    """What a user may choose; the defaults are the published choices."""

    capacity_ah: float | None = None
    """Charge from 100 to 0 % [Ah]; by default from a log that runs from full to empty."""
    initial_soc_pct: float | None = None
    """SoC at each log's first row [%]; by default the logs' own reference, else 100."""
    rate_hz: float = 1.0
    delay_s: tuple[float, ...] = DELAYS_S
    epsilon: float = 0.05
    t_ref_c: float = 20.0
    name: str | None = None
    effects: tuple[str, ...] = ()
    """Effects beyond the coefficients: ids, or `auto` alone to let logs left out choose."""

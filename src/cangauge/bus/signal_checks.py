"""When the values of a signal are believed: limits by default, and what a mapping states."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

from cangauge.bus.mapping import CheckMap

INVALID_AFTER: Final = 5
VALID_AFTER: Final = 3
STUCK_AFTER_S: Final = 10.0


@dataclass(frozen=True, slots=True)
class SignalChecks:
    """What a signal's values must satisfy, and how many may fail.

    Parameters
    ----------
    lowest, highest : float
        What a value can be [A, positive = discharge; V; °C; %].
    max_jump, max_rate_per_s : float
        A value may differ from the latest good one by the first, and for every second since by
        the second more [A, V, K, %].
    invalid_after, valid_after : int
        So many refused values in a row make the signal invalid; so many good ones valid again.
    stuck_after_s : float
        See `CheckMap` [s].
    timeout_s : float, optional
        Stated time-out [s].
    usual_timeout_s : float
        Time-out while the period is not known [s].
    """

    lowest: float = -math.inf
    highest: float = math.inf
    max_jump: float = math.inf
    max_rate_per_s: float = 0.0
    invalid_after: int = INVALID_AFTER
    valid_after: int = VALID_AFTER
    stuck_after_s: float = math.inf
    timeout_s: float | None = None
    usual_timeout_s: float = 10.0


DEFAULTS: Final = {
    "current": SignalChecks(stuck_after_s=STUCK_AFTER_S, usual_timeout_s=2.0),
    "voltage": SignalChecks(stuck_after_s=STUCK_AFTER_S, usual_timeout_s=2.0),
    "temperature": SignalChecks(),
    "soc_reference": SignalChecks(),
}
"""By role. What no pack can be is bounded where its model is known; see `input_health`."""


def checks_of(role: str, *stated: CheckMap) -> SignalChecks:
    """Return the checks of a role, with what mappings state in their place, the last one first."""
    checks = DEFAULTS[role]
    for each in stated:
        own = {
            name: value
            for name in CheckMap.model_fields
            if (value := getattr(each, name)) is not None
        }
        checks = replace(checks, **own)
    return checks

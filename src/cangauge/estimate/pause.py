"""A time that nobody saw: the bus asleep, or the service not running.

Two stories can be told of it. *Parked*: nothing but small consumers, so the SoC is what it was to
within a little. *Moved*: somebody charged or drove, so the SoC may be anything that a fast charger
can reach. How likely the second is before any voltage is seen grows with the time; after it, the
voltage decides (see `belief`).
"""

from __future__ import annotations

import math

USE_S = 120.0
"""The current before a pause may have gone on for so long into it [s]."""

DRAIN_PCT_PER_HOUR = 0.05
DRAIN_AT_MOST_PCT = 5.0
"""What consumers of a parked car and self-discharge may take [% per hour; %]: 1.2 % a day."""

MOVED_AT_MOST = 0.3
"""Probability that somebody charged or drove in a long pause: a guess, of which the voltage takes
little notice."""

MOVED_TIME_S = 1800.0
"""Within such a time it grows to 63 % of that [s]."""

SHORTEST_S = 1.0
"""No time is so short that nobody can have [s]."""

FASTEST_PCT_PER_HOUR = 150.0
"""How fast the SoC may change unseen [% per hour]: a fast charger."""

MOVED_STD_AT_MOST_PCT = 30.0
"""Standard deviation of a SoC of which nothing is known [%] (uniform over 0–100: 29 %)."""


def parked_std_pct(seconds: float, rms_pct_per_s: float) -> float:
    """Return the standard deviation of the charge that a parked car loses or gains [%].

    Parameters
    ----------
    seconds : float
        How long [s].
    rms_pct_per_s : float
        Recent current before [% of capacity per s].
    """
    drain_pct = min(DRAIN_PCT_PER_HOUR * seconds / 3600.0, DRAIN_AT_MOST_PCT)
    use_pct = min(rms_pct_per_s * min(seconds, USE_S), MOVED_STD_AT_MOST_PCT)
    return math.hypot(drain_pct, use_pct)


def moved_std_pct(seconds: float) -> float:
    """Return the standard deviation of the SoC if somebody charged or drove for a time [%]."""
    return min(FASTEST_PCT_PER_HOUR * seconds / 3600.0, MOVED_STD_AT_MOST_PCT)


def moved_log_odds(seconds: float) -> float:
    """Return ln(p / (1 − p)) for p, the probability that somebody did, before any voltage."""
    probability = -MOVED_AT_MOST * math.expm1(-max(seconds, SHORTEST_S) / MOVED_TIME_S)
    return math.log(probability / (1.0 - probability))

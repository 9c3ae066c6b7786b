"""Charge moved, the capacity that it implies, and the resistance seen in steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from cangauge.inspect.sign import charge_ah, current_steps
from cangauge.logs.log import Log

MIN_SOC_SPAN_PCT: Final = 5.0
"""Below this span of the reference SoC [%] no capacity is told: its steps weigh too much."""
MIN_STEPS: Final = 8


@dataclass(frozen=True, slots=True)
class Charge:
    """Charge moved over a log, by trapezoids, positive current discharging.

    Parameters
    ----------
    discharged_ah, charged_ah : float
        Sums of the parts with positive and negative current [Ah], both ≥ 0.
    net_ah : float
        Their difference, positive = taken out [Ah].
    span_ah : float
        Largest less smallest charge state on the way [Ah].
    in_gaps_ah : float
        Part of the moved charge (absolute) that lies in gaps and is only interpolated [Ah].
    """

    discharged_ah: float
    charged_ah: float
    net_ah: float
    span_ah: float
    in_gaps_ah: float


@dataclass(frozen=True, slots=True)
class Soc:
    """The reference SoC of a log.

    Parameters
    ----------
    coverage : float
        Part of the rows that have it [-].
    first_pct, last_pct, minimum_pct, maximum_pct : float
        [%].
    last_at_s : float
        Time of the last finite value [s].
    longest_hole_s : float
        Longest time between finite values [s].
    implied_capacity_ah : float or None
        Charge per 100 % of reference, by least squares [Ah]; None below 5 % of span.
    """

    coverage: float
    first_pct: float
    last_pct: float
    minimum_pct: float
    maximum_pct: float
    last_at_s: float
    longest_hole_s: float
    implied_capacity_ah: float | None


@dataclass(frozen=True, slots=True)
class Resistance:
    """Ohmic resistance seen in steps of current about a second long.

    Parameters
    ----------
    median_ohm, lower_ohm, upper_ohm : float
        Median and quartiles of −ΔU/ΔI [Ω]; negative when the sign of current is turned.
    steps : int
        Steps that it is the median of.
    """

    median_ohm: float
    lower_ohm: float
    upper_ohm: float
    steps: int


def describe_charge(log: Log, gap_limit_s: float) -> Charge:
    """Return the charge moved over a log; intervals longer than `gap_limit_s` [s] are gaps."""
    state = charge_ah(log)
    part = np.diff(state)
    gaps = np.diff(log.time_s) > gap_limit_s
    return Charge(
        discharged_ah=float(part[part > 0.0].sum()),
        charged_ah=float(np.abs(part[part < 0.0]).sum()),
        net_ah=float(state[-1]),
        span_ah=float(np.ptp(state)),
        in_gaps_ah=float(np.abs(part[gaps]).sum()),
    )


def describe_soc(log: Log) -> Soc | None:
    """Return what the reference SoC covers, or None if the log has none."""
    if log.soc_pct is None:
        return None
    known = np.flatnonzero(np.isfinite(log.soc_pct))
    if known.size == 0:
        return None
    soc = log.soc_pct[known]
    capacity = None
    if np.ptp(soc) >= MIN_SOC_SPAN_PCT:
        taken = charge_ah(log)[known]
        slope = float(np.polyfit(soc - soc.mean(), taken, 1)[0])
        capacity = abs(100.0 * slope)  # whichever way current counts
    holes = np.diff(log.time_s[known])
    return Soc(
        coverage=float(known.size / len(log)),
        first_pct=float(soc[0]),
        last_pct=float(soc[-1]),
        minimum_pct=float(soc.min()),
        maximum_pct=float(soc.max()),
        last_at_s=float(log.time_s[known[-1]]),
        longest_hole_s=float(holes.max()) if holes.size else 0.0,
        implied_capacity_ah=capacity,
    )


def describe_resistance(log: Log) -> Resistance | None:
    """Return the resistance seen in steps of current, or None below eight clear steps."""
    steps = current_steps(log)
    if steps.current_a.size < MIN_STEPS:
        return None
    each = -steps.voltage_v / steps.current_a
    lower, median, upper = np.quantile(each, [0.25, 0.5, 0.75])
    return Resistance(float(median), float(lower), float(upper), int(each.size))

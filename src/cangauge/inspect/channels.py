"""Figures of a log: timing, channels, charge, reference SoC and resistance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.logs.gaps import uncounted_gaps
from cangauge.logs.log import Log
from cangauge.logs.sign import STEP_SPACING_S, charge_ah, current_steps, spaced_rows
from cangauge.model.coulomb_counting import capacity_from_reference

GAP_S: Final = 2.0
"""Longest interval that the delay line of the model bridges [s]; longer ones are gaps."""
LISTED_GAPS: Final = 10


@dataclass(frozen=True, slots=True)
class Gap:
    """Time without rows: time of the last row before it, and its length [s]."""

    start_s: float
    length_s: float


@dataclass(frozen=True, slots=True)
class Timing:
    """Timing of the rows of a log.

    Parameters
    ----------
    start_s, duration_s : float
        Time of the first row, time from it to the last [s].
    interval_median_s, interval_min_s, interval_max_s : float or None
        Time between rows [s]; None for a single row.
    rate_hz : float or None
        1 / median interval [1/s].
    regular : bool
        Whether 99 % of the intervals are within 10 % of the median.
    gap_limit_s : float
        Longer intervals are gaps [s].
    gap_count : int
    gap_total_s : float
        Sum of the gaps [s].
    longest_gaps : tuple of Gap
        The longest first, at most ten.
    """

    start_s: float
    duration_s: float
    interval_median_s: float | None
    interval_min_s: float | None
    interval_max_s: float | None
    rate_hz: float | None
    regular: bool
    gap_limit_s: float
    gap_count: int
    gap_total_s: float
    longest_gaps: tuple[Gap, ...]


def describe_timing(time_s: FloatArray, gap_limit_s: float = GAP_S) -> Timing:
    """Describe increasing time stamps [s] of shape (n,)."""
    step = np.diff(time_s)
    gaps = np.flatnonzero(step > gap_limit_s)
    longest = gaps[np.argsort(-step[gaps], kind="stable")][:LISTED_GAPS]
    median = float(np.median(step)) if step.size else None
    return Timing(
        start_s=float(time_s[0]),
        duration_s=float(time_s[-1] - time_s[0]),
        interval_median_s=median,
        interval_min_s=float(step.min()) if step.size else None,
        interval_max_s=float(step.max()) if step.size else None,
        rate_hz=1.0 / median if median else None,
        regular=bool(median and np.mean(np.abs(step - median) <= 0.1 * median) >= 0.99),
        gap_limit_s=gap_limit_s,
        gap_count=int(gaps.size),
        gap_total_s=float(step[gaps].sum()),
        longest_gaps=tuple(Gap(float(time_s[i]), float(step[i])) for i in longest),
    )


# --- Channels

STUCK_S: Final = 10.0
"""Shortest interval of one value that may be stuck [s], …"""
STUCK_ROWS: Final = 5
"""… its fewest rows, …"""
STUCK_JUMPS: Final = 3
"""… and the fewest jumps of the other channel within it."""
JUMP_LIMIT_S: Final = 5.0
"""Longest interval between rows for a jump [s]."""
END_S: Final = 2.0
"""Jumps this close to the ends of an interval do not count [s]."""
_FREQUENT: Final = (3, 6, 12, 50)
"""Numbers of most frequent values whose differences are candidates for the quantum."""
_MIN_PLACES: Final = 4
"""Fewest occupied places of a grid."""
_ON_PLACE: Final = 0.9
"""Least share of the rows on a grid that hold the main value of their place."""
_ON_GRID: Final = 0.95
"""Least share of the rows on a grid."""
_OFF_GRID: Final = 0.05
"""Largest distance from a place of the grid, in quanta."""


@dataclass(frozen=True, slots=True)
class Stuck:
    """An interval in which a channel kept one value while the other one jumped.

    Parameters
    ----------
    start_s, duration_s : float
        Time of its first row, length [s].
    value : float
        The constant value, in the channel's unit.
    why : str
        Jumps of the other channel, with figures.
    """

    start_s: float
    duration_s: float
    value: float
    why: str


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel of a log.

    Parameters
    ----------
    unit : str
    minimum, maximum, median : float
        In `unit`.
    quantum : float or None
        Quantization step, in `unit`; None if there is none.
    levels : int
        Distinct values; 1: constant.
    missing : int
        Rows without a value (only of the reference SoC).
    stuck : tuple of Stuck
    """

    unit: str
    minimum: float
    maximum: float
    median: float
    quantum: float | None
    levels: int
    missing: int
    stuck: tuple[Stuck, ...] = ()


def describe_channel(values: FloatArray, unit: str, stuck: tuple[Stuck, ...] = ()) -> Channel:
    """Describe one channel; `values` of shape (n,) may hold NaN but not only NaN."""
    finite = values[np.isfinite(values)]
    low, high = float(finite.min()), float(finite.max())
    return Channel(
        unit=unit,
        minimum=low,
        maximum=high,
        median=float(np.median(finite)),
        quantum=quantum_of(finite),
        levels=int(np.unique(finite).size),
        missing=int(values.size - finite.size),
        stuck=stuck,
    )


def quantum_of(values: FloatArray) -> float | None:
    """Return the quantization step of finite values, or None if there is none.

    It is the largest step on whose grid (through the most frequent value) 95 % of the values lie,
    so that a few interpolated rows do not hide it. Candidates are differences between
    neighbouring values, of the frequent ones and of all.

    Parameters
    ----------
    values : array of shape (n,)
    """
    distinct, count = np.unique(values, return_counts=True)
    if distinct.size < _MIN_PLACES:
        return None
    noise = 1e-9 * max(abs(float(distinct[0])), abs(float(distinct[-1])))
    by_count = distinct[np.argsort(-count, kind="stable")]
    origin = by_count[0]
    candidates = {float(step) for k in _FREQUENT for step in _some_steps(by_count[:k])}
    for candidate in sorted(candidates | set(_some_steps(distinct)), reverse=True):
        if candidate <= noise:
            break
        place = (distinct - origin) / candidate
        near = np.abs(place - np.rint(place)) < _OFF_GRID
        places, first = np.unique(np.rint(place[near]), return_index=True)
        if places.size < _MIN_PLACES or count[near].sum() < _ON_GRID * values.size:
            continue
        # Several values at one place (64.98 and 65.00 on a grid of 65) mean a finer step.
        at_most = np.maximum.reduceat(count[near], first).sum()
        if at_most >= _ON_PLACE * count[near].sum():
            return _refined(distinct[near] - origin, np.rint(place[near]), count[near])
    return None


def _some_steps(values: FloatArray) -> list[float]:
    steps = np.diff(np.sort(values))
    return [float(step) for step in np.quantile(steps, [0.0, 0.02, 0.1, 0.5])] if steps.size else []


def _refined(offsets: FloatArray, place: FloatArray, weight: FloatArray) -> float:
    """Return the step of a grid by least squares over the values on it, to five digits."""
    step = float(np.sum(weight * place * offsets) / np.sum(weight * place * place))
    return float(f"{step:.5g}")


def find_stuck(
    log: Log, values: FloatArray, other: FloatArray, jump: float, unit: str
) -> tuple[Stuck, ...]:
    """Return the intervals in which a channel keeps one value while the other jumps.

    Jumps are changes from one second to the next; several in both directions are needed, since in
    a constant-current or constant-voltage phase the other channel drifts but does not jump.

    Parameters
    ----------
    log : Log
    values, other : arrays of shape (n,)
        The channel that may be stuck, and the one that it should follow.
    jump : float
        Smallest jump of `other`, in its unit.
    unit : str
        Unit of `other`, for the text.
    """
    rows = spaced_rows(log.time_s, STEP_SPACING_S)
    near = np.diff(log.time_s[rows]) <= JUMP_LIMIT_S
    change = np.where(near, np.diff(other[rows]), 0.0)
    time = log.time_s[rows[1:]]
    up, down = time[change > jump], time[change < -jump]
    found = []
    for first, last in _constant_runs(log.time_s, values):
        start, end = log.time_s[first], log.time_s[last - 1]
        # A jump at either end bounds the interval; jumps in one direction are relaxation.
        ends = (start + END_S, end - END_S)
        ups, downs = (int(np.diff(np.searchsorted(jumps, ends))[0]) for jumps in (up, down))
        count = ups + downs
        if count >= STUCK_JUMPS and ups and downs:
            found.append(
                Stuck(
                    start_s=float(start),
                    duration_s=float(end - start),
                    value=float(values[first]),
                    why=f"the other channel jumped {count} times by more than {jump:.3g} {unit}",
                )
            )
    return tuple(found)


def _constant_runs(time_s: FloatArray, values: FloatArray) -> list[tuple[int, int]]:
    """Return (first, one past last) of runs of equal values that are long enough."""
    edges = np.concatenate(([0], np.flatnonzero(np.diff(values) != 0.0) + 1, [values.size]))
    first, last = edges[:-1], edges[1:]
    lasting = time_s[last - 1] - time_s[first] >= STUCK_S
    chosen = np.flatnonzero(lasting & (last - first >= STUCK_ROWS))
    return [(int(first[i]), int(last[i])) for i in chosen]


# --- Charge, reference SoC and resistance

MIN_SOC_SPAN_PCT: Final = 5.0
"""Least span of the reference SoC for a capacity [%]: below, its quantization dominates."""
MIN_STEPS: Final = 8
"""Fewest clear steps of current for a resistance."""


@dataclass(frozen=True, slots=True)
class Charge:
    """Charge moved over a log, by trapezoids, positive current discharging.

    Nothing is counted over a gap longer than `logs.gaps.bridge_s`, as in a fit.

    Parameters
    ----------
    discharged_ah, charged_ah : float
        Charge at positive and at negative current [Ah], both ≥ 0.
    net_ah : float
        Their difference, positive = taken out [Ah].
    span_ah : float
        Range of the charge state over the log [Ah].
    in_gaps_ah : float
        Absolute charge interpolated over gaps [Ah].
    uncounted_gaps : int
        Gaps over which nothing is counted.
    uncounted_s : float
        Their sum [s].
    """

    discharged_ah: float
    charged_ah: float
    net_ah: float
    span_ah: float
    in_gaps_ah: float
    uncounted_gaps: int
    uncounted_s: float


@dataclass(frozen=True, slots=True)
class Soc:
    """The reference SoC of a log.

    Parameters
    ----------
    coverage : float
        Share of the rows with a value [-].
    first_pct, last_pct, minimum_pct, maximum_pct : float
        [%].
    last_at_s : float
        Time of the last finite value [s].
    longest_hole_s : float
        Longest time between finite values [s].
    implied_capacity_ah : float or None
        Charge per 100 % of reference, by least squares [Ah]; None below 5 % span.
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
    """Ohmic resistance from steps of current over about a second.

    Parameters
    ----------
    median_ohm, lower_ohm, upper_ohm : float
        Median and quartiles of −ΔU/ΔI [Ω]; negative when the sign of current is inverted.
    steps : int
        Number of steps.
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
    uncounted = uncounted_gaps(log.time_s)
    return Charge(
        discharged_ah=float(part[part > 0.0].sum()),
        charged_ah=float(np.abs(part[part < 0.0]).sum()),
        net_ah=float(state[-1]),
        span_ah=float(np.ptp(state)),
        in_gaps_ah=float(np.abs(part[gaps]).sum()),
        uncounted_gaps=int(uncounted.size),
        uncounted_s=float(np.diff(log.time_s)[uncounted].sum()),
    )


def describe_soc(log: Log) -> Soc | None:
    """Return figures of the reference SoC, or None if the log has none."""
    if log.soc_pct is None:
        return None
    known = np.flatnonzero(np.isfinite(log.soc_pct))
    if known.size == 0:
        return None
    soc = log.soc_pct[known]
    capacity = None
    if np.ptp(soc) >= MIN_SOC_SPAN_PCT:
        capacity = abs(capacity_from_reference([log]))  # for either sign of current
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
    """Return the resistance from steps of current, or None below eight clear steps."""
    steps = current_steps(log)
    if steps.current_a.size < MIN_STEPS:
        return None
    each = -steps.voltage_v / steps.current_a
    lower, median, upper = np.quantile(each, [0.25, 0.5, 0.75])
    return Resistance(float(median), float(lower), float(upper), int(each.size))

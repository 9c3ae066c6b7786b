"""What one channel holds: range, step of quantisation, stretches where it is stuck."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from cangauge.inspect.sign import STEP_SPACING_S, spaced_rows
from cangauge.logs.log import FloatArray, Log

STUCK_S: Final = 10.0
"""A channel that keeps one value for longer [s] while the other moves is stuck."""
STUCK_ROWS: Final = 5
STUCK_JUMPS: Final = 3
"""So many jumps of the other channel mean that this one is stuck."""
JUMP_LIMIT_S: Final = 5.0
"""Rows further apart [s] make no jump."""
END_S: Final = 2.0
"""Jumps so near to the ends of a stretch [s] do not count."""
_FREQUENT: Final = (3, 6, 12, 50)
_MIN_PLACES: Final = 4
_ON_PLACE: Final = 0.9
_ON_GRID: Final = 0.95
_OFF_GRID: Final = 0.05


@dataclass(frozen=True, slots=True)
class Stuck:
    """A stretch in which a channel did not move though it should have.

    Parameters
    ----------
    start_s, duration_s : float
        Time of its first row, length [s].
    value : float
        The value that it kept, in the channel's unit.
    why : str
        What moved meanwhile, with figures.
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
        Step that all values are multiples of, apart from a constant, in `unit`; None if none
        shows.
    levels : int
        Distinct values; 1 means that it never moves.
    missing : int
        Rows without a value (only the reference SoC may have such).
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
    """Return the step of quantisation of finite values, or None if none shows.

    The largest step is taken on whose grid (through the most frequent value) 95 % of the values
    lie, so that a few interpolated rows do not hide it. Candidates are differences between
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
        # Many rows that share a place (64.98 and 65.00 on a grid of 65) show a finer step.
        at_most = np.maximum.reduceat(count[near], first).sum()
        if at_most >= _ON_PLACE * count[near].sum():
            return _refined(distinct[near] - origin, np.rint(place[near]), count[near])
    return None


def _some_steps(values: FloatArray) -> list[float]:
    steps = np.diff(np.sort(values))
    return [float(step) for step in np.quantile(steps, [0.0, 0.02, 0.1, 0.5])] if steps.size else []


def _refined(offsets: FloatArray, place: FloatArray, weight: FloatArray) -> float:
    """Return the step of a grid by least squares over the values on it."""
    step = float(np.sum(weight * place * offsets) / np.sum(weight * place * place))
    return float(f"{step:.5g}")


def find_stuck(
    log: Log, values: FloatArray, other: FloatArray, jump: float, unit: str
) -> tuple[Stuck, ...]:
    """Return the stretches where a channel keeps one value while the other jumps.

    Only jumps from one second to the next count, several and both ways: in a constant-current or a
    constant-voltage phase the other channel drifts but does not jump.

    Parameters
    ----------
    log : Log
    values, other : arrays of shape (n,)
        The channel that may be stuck, and the one that should move it.
    jump : float
        What counts as a jump of `other` [its unit].
    unit : str
        Unit of `other`, for the words.
    """
    rows = spaced_rows(log.time_s, STEP_SPACING_S)
    near = np.diff(log.time_s[rows]) <= JUMP_LIMIT_S
    change = np.where(near, np.diff(other[rows]), 0.0)
    time = log.time_s[rows[1:]]
    up, down = time[change > jump], time[change < -jump]
    found = []
    for first, last in _constant_runs(log.time_s, values):
        start, end = log.time_s[first], log.time_s[last - 1]
        # Jumps at either end began or ended the stretch; those in one direction only relax.
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

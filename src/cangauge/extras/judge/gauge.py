"""What a gauge published in a stretch of samples: counts, limits, stands and jumps.

A published SoC y that counts has y + Q constant, Q being the charge drawn [% of the capacity]. It
is cut where this sum jumps, at 0 and 100 %, which are limits and no counts, and where y stands
still while charge moves. Between two cuts lies a piece.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Final

import numpy as np

from cangauge._typing import BoolArray, FloatArray
from cangauge.logs.log import Log

COARSE_PCT: Final = 0.2
"""Resolution from which y is used only at the rows that `_counts` selects [%]."""
LIMIT_PCT: Final = 0.05
"""A published SoC as close to 0 or 100 % is a limit [%]."""
JUMP_PCT: Final = 1.0
"""Least jump against the charge [%]: a dashboard shows it. One beyond two steps of y counts."""
SEVERAL: Final = 4
"""A jump is this many times the change against the charge that one window in ten exceeds. A gauge
that jumps more often in a stretch does not count: its jumps are noise."""
STAND_PCT: Final = 2.0
"""A published SoC stands still where charge moves by this and two of its steps [%]."""
WINDOW_S: Final = 30.0
"""Windows whose medians are searched for jumps [s]."""


def published_pct(log: Log) -> FloatArray:
    """Return the SoC that the gauge published at each row [%]; NaN where it did not."""
    return np.full(len(log), np.nan) if log.soc_pct is None else log.soc_pct


def resolution_pct(log: Log) -> float:
    """Return the resolution of the published SoC [%]."""
    values = np.unique(np.round(published_pct(log), 4))
    values = values[np.isfinite(values)]
    return float(np.quantile(np.diff(values), 0.1)) if values.size > 1 else 1.0


def is_limit(shown_pct: FloatArray | float) -> BoolArray:
    """Return whether a published SoC is a limit."""
    return np.minimum(np.abs(shown_pct), np.abs(np.subtract(shown_pct, 100.0))) <= LIMIT_PCT


def stands(held_pct: FloatArray, step_pct: FloatArray, least_pct: float = STAND_PCT) -> BoolArray:
    """Return whether y stands still, given the charge that moves meanwhile and its resolution."""
    return held_pct >= least_pct + 2.0 * step_pct


def read_published(
    log: Log, drawn_pct: FloatArray, step_pct: float
) -> tuple[FloatArray, FloatArray, BoolArray, FloatArray, FloatArray]:
    """Cut what a gauge published into pieces.

    Parameters
    ----------
    log : Log
        A stretch of uninterrupted samples.
    drawn_pct : array of shape (rows,)
        Q [%].
    step_pct : float
        Resolution of y [%].

    Returns
    -------
    shown_pct, count_pct, is_cut, held_pct, step_pct : array of shape (rows,)
        As in `Samples`.
    """
    shown, steps = published_pct(log), np.full(len(log), step_pct)
    held, is_cut = _held(shown, drawn_pct), np.zeros(len(log), dtype=bool)
    is_blank = stands(held, steps) | is_limit(shown)
    count = _counts(np.where(is_blank, np.nan, shown), drawn_pct, step_pct) + drawn_pct
    least = max(JUMP_PCT, 2.0 * step_pct)
    is_cut[_jumps(log.time_s, count, shown, least)] = True
    # A count that goes on after a stand or a limit as it would have without is the same piece.
    for before, after in pairwise(np.flatnonzero(np.isfinite(count))):
        if is_blank[before + 1 : after].any():
            is_cut[after] |= abs(count[after] - count[before]) >= least
    return shown, count, is_cut, held, steps


def _held(shown: FloatArray, drawn: FloatArray) -> FloatArray:
    """Return the charge that moves while a value is held; at a limit, away from it."""
    held, known = np.zeros_like(shown), np.flatnonzero(np.isfinite(shown))
    edges = np.flatnonzero(np.diff(shown[known], prepend=np.nan, append=np.nan) != 0.0)
    for low, high in pairwise(edges):
        value, charge = shown[known[low]], drawn[known[low:high]]
        moved = np.ptp(charge)
        if value <= LIMIT_PCT:
            moved = np.max(np.maximum.accumulate(charge) - charge)
        elif value >= 100.0 - LIMIT_PCT:
            moved = np.max(charge - np.minimum.accumulate(charge))
        held[known[low] : known[high - 1] + 1] = moved
    return held


def _counts(shown: FloatArray, drawn: FloatArray, step_pct: float) -> FloatArray:
    """Return y at the rows where it is known better than by its resolution, NaN elsewhere [%].

    A coarse SoC that changes by one step is half-way between two. It is known to half a step where
    it changes by more, at its first and last row, and whenever charge of two further steps has
    flowed without a change.
    """
    known = np.flatnonzero(np.isfinite(shown))
    if step_pct < COARSE_PCT or not known.size:
        return shown
    value, charge = shown[known], drawn[known]
    change = np.diff(value, prepend=value[0])
    held = np.cumsum(change != 0.0)  # number of the value that is held
    since = np.flatnonzero(np.diff(held, prepend=-1))[held]
    steps = np.floor(np.abs(charge - charge[since]) / (2.0 * step_pct))
    most = np.maximum.accumulate(held * (1.0 + steps.max()) + steps)
    is_used = np.diff(most, prepend=-1.0) > 0.0
    is_used[-1] = True
    is_crossing = np.round(np.abs(change) / step_pct) == 1.0
    used = np.full_like(shown, np.nan)
    used[known[is_used]] = (value - np.where(is_crossing, 0.5 * change, 0.0))[is_used]
    return used


def _jumps(time_s: FloatArray, count: FloatArray, shown: FloatArray, least: float) -> list[int]:
    """Return the rows at which the count has jumped; the rows within a jump become NaN."""
    known = np.flatnonzero(np.isfinite(count))
    window = np.floor((time_s[known] - time_s[known[:1]]) / WINDOW_S)
    first = np.flatnonzero(np.diff(window, prepend=-1.0))
    if first.size < 3:
        return []
    level, value = (
        np.array([np.median(part) for part in np.split(of[known], first[1:])])
        for of in (count, shown)
    )
    # Over two windows, so that a jump of a minute counts whole.
    change = level[2:] - level[:-2]
    usual = float(np.quantile(np.abs(np.diff(level)), 0.9))
    sizes = np.minimum(np.abs(change), np.abs(value[2:] - value[:-2]))
    is_large = sizes >= max(least, SEVERAL * usual)
    if np.count_nonzero(is_large[1:] & ~is_large[:-1]) > SEVERAL:
        return []
    result, after = list[int](), -1
    for k in np.flatnonzero(is_large).tolist():
        near = np.abs(change[max(0, k - 1) : k + 2])
        if k <= after or abs(change[k]) < near.max():
            continue
        inside = known[first[k] + 1 : first[k + 2] + 1]
        beyond = (count[inside] - 0.5 * (level[k] + level[k + 2])) * np.sign(change[k]) > 0.0
        row = inside[np.argmax(beyond)] if beyond.any() else inside[-1]
        ends = np.abs(count[inside] - np.where(inside < row, level[k], level[k + 2]))
        count[inside[ends > 0.25 * abs(change[k])]] = np.nan
        result.append(int(row if np.isfinite(count[row]) else inside[-1]))
        after = k + 1
    return result

"""What a gauge published in a stretch of samples: counts, limits, stands and jumps.

A published SoC y that counts has y + Q constant, Q being the charge drawn [% of the capacity]. It
is cut where this sum jumps, at 0 and 100 %, which are limits and no counts, and where y stands
still while charge moves. Between two cuts lies a piece.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Final

import numpy as np
from scipy.ndimage import median

from cangauge._typing import BoolArray, FloatArray
from cangauge.logs.log import Log
from cangauge.model.prior import BLOCK_S

LIMIT_PCT: Final = 0.05
"""A published SoC as close to 0 or 100 % is a limit [%]."""
JUMP_PCT: Final = 1.0
"""Least jump against the charge [%]: a dashboard shows it. One beyond two steps of y counts."""
SEVERAL: Final = 4
"""A jump is this many times the change against the charge that one window in ten exceeds. A gauge
that jumps more often in a stretch does not count: its jumps are noise."""
STAND_PCT: Final = 2.0
"""A published SoC stands still where charge moves by this and two of its steps [%]."""


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
    count = np.where(is_blank, np.nan, shown) + drawn_pct
    least = max(JUMP_PCT, 2.0 * step_pct)
    is_cut[_jumps(log.time_s, count, shown, least)] = True
    # A count that goes on after a stand or a limit as it would have without is the same piece.
    known, blanks = np.flatnonzero(np.isfinite(count)), np.cumsum(is_blank)
    is_after_blank = np.diff(blanks[known]) > 0
    is_cut[known[1:]] |= is_after_blank & (np.abs(np.diff(count[known])) >= least)
    return shown, count, is_cut, held, steps


def _held(shown: FloatArray, drawn: FloatArray) -> FloatArray:
    """Return the charge that moves while a value is held; at a limit, away from it."""
    held, known = np.zeros_like(shown), np.flatnonzero(np.isfinite(shown))
    edges = np.flatnonzero(np.diff(shown[known], prepend=np.nan, append=np.nan) != 0.0)
    for low, high in pairwise(edges.tolist()):
        if high - low < 2:  # within one row nothing moves
            continue
        value, charge = shown[known[low]], drawn[known[low:high]]
        moved = np.ptp(charge)
        if value <= LIMIT_PCT:
            moved = np.max(np.maximum.accumulate(charge) - charge)
        elif value >= 100.0 - LIMIT_PCT:
            moved = np.max(charge - np.minimum.accumulate(charge))
        held[known[low] : known[high - 1] + 1] = moved
    return held


def _jumps(time_s: FloatArray, count: FloatArray, shown: FloatArray, least: float) -> list[int]:
    """Return the rows at which the count has jumped; the rows within a jump become NaN.

    Medians of windows are compared.
    """
    known = np.flatnonzero(np.isfinite(count))
    window = np.floor((time_s[known] - time_s[known[:1]]) / BLOCK_S)
    first = np.flatnonzero(np.diff(window, prepend=-1.0))
    if first.size < 3:
        return []
    level, value = (median(of[known], window, window[first]) for of in (count, shown))
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

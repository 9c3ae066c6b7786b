"""What a gauge published in a stretch of samples: counts, limits, stands and jumps.

A published SoC y that counts has y + Q constant, Q being the charge drawn [% of the capacity]. It
is cut where this sum jumps, at 0 and 100 %, which are limits and no counts, and where y stands
still while charge moves. Between two cuts lies a piece.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from cangauge._typing import BoolArray, FloatArray, IntArray
from cangauge.logs.log import Log

COARSE_PCT: Final = 0.2
"""Resolution from which y is used only at the rows that `counts` selects [%]."""
LIMIT_PCT: Final = 0.05
"""A published SoC as close to 0 or 100 % is a limit [%]."""
JUMP_PCT: Final = 1.0
"""Least jump against the charge [%]: a dashboard shows it."""
SEVERAL: Final = 4.0
"""A jump is this many times the change against the charge that one window in ten exceeds."""
MOST_JUMPS: Final = 4
"""A gauge that jumps more often in a stretch does not count: its jumps are noise."""
STAND_PCT: Final = 2.0
"""A published SoC stands still where charge moves by this and two of its steps [%]."""
WINDOW_S: Final = 30.0
"""Windows whose medians are searched for jumps [s]."""


class Stand(NamedTuple):
    """A published SoC that stands still while charge moves."""

    first: int
    last: int
    """Its rows."""
    shown_pct: float
    moved_pct: float
    """Charge that moved, in either direction [%]."""


class GaugeRecord(NamedTuple):
    """What a gauge published; arrays of shape (rows,)."""

    shown_pct: FloatArray
    """y [%]; NaN where there is none."""
    count_pct: FloatArray
    """y + Q where y is a count [%]; NaN elsewhere."""
    piece: IntArray
    """Number of the piece, from 0; −1 outside."""
    stands: list[Stand]
    held_pct: float
    """Charge that moved at the end while y did not [%]."""
    step_pct: float
    """Resolution [%]."""


def published_pct(log: Log) -> FloatArray:
    """Return the SoC that the gauge published at each row [%]; NaN where it did not."""
    return np.full(len(log), np.nan) if log.soc_pct is None else log.soc_pct


def resolution_pct(log: Log) -> float:
    """Return the resolution of the published SoC [%]."""
    values = np.unique(np.round(published_pct(log), 4))
    values = values[np.isfinite(values)]
    return float(np.quantile(np.diff(values), 0.1)) if values.size > 1 else 1.0


def read_published(
    time_s: FloatArray, shown_pct: FloatArray, drawn_pct: FloatArray, step_pct: float
) -> GaugeRecord:
    """Cut what a gauge published into pieces.

    Parameters
    ----------
    time_s, shown_pct, drawn_pct : array of shape (rows,)
        Stamps [s], y [%] and Q [%].
    step_pct : float
        Resolution of y [%].
    """
    held = _held(shown_pct, drawn_pct)
    stands = [each for each in held if each.moved_pct >= STAND_PCT + 2.0 * step_pct]
    moving = shown_pct.copy()
    for stand in stands:
        moving[stand.first : stand.last + 1] = np.nan
    limited = is_limit(shown_pct)
    count = _counts(np.where(limited, np.nan, moving), drawn_pct, step_pct) + drawn_pct
    cut = np.zeros(len(count), dtype=bool)
    for row in _jumps(time_s, count, shown_pct, step_pct):
        cut[row] = True
    # A count that goes on after a stand or a limit as it would have without is the same piece.
    blank = np.isnan(count) & (limited | np.isnan(moving))
    known = np.flatnonzero(np.isfinite(count))
    least = max(JUMP_PCT, 2.0 * step_pct)
    for k in np.flatnonzero(np.diff(known) > 1):
        before, after = known[k], known[k + 1]
        if blank[before + 1 : after].any():
            cut[after] |= abs(count[after] - count[before]) >= least
    piece = np.where(np.isfinite(count), np.cumsum(cut), -1)
    held_pct = held[-1].moved_pct if held else 0.0
    return GaugeRecord(shown_pct, count, piece, stands, held_pct, step_pct)


def is_limit(shown_pct: FloatArray) -> BoolArray:
    """Return whether a published SoC is a limit."""
    return (np.abs(shown_pct) <= LIMIT_PCT) | (np.abs(shown_pct - 100.0) <= LIMIT_PCT)


def _held(shown: FloatArray, drawn: FloatArray) -> list[Stand]:
    """Return where each value is held, and the charge that moves; at a limit, away from it."""
    known = np.flatnonzero(np.isfinite(shown))
    if not known.size:
        return []
    value, charge = shown[known], drawn[known]
    first = np.flatnonzero(np.diff(value, prepend=np.nan) != 0.0)
    result = []
    for low, high in zip(first, [*first[1:], len(value)], strict=True):
        part = charge[low:high]
        moved = float(np.ptp(part))
        if value[low] <= LIMIT_PCT:
            moved = float(np.max(np.maximum.accumulate(part) - part))
        elif value[low] >= 100.0 - LIMIT_PCT:
            moved = float(np.max(part - np.minimum.accumulate(part)))
        result.append(Stand(int(known[low]), int(known[high - 1]), float(value[low]), moved))
    return result


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


def _jumps(time_s: FloatArray, count: FloatArray, shown: FloatArray, step_pct: float) -> list[int]:
    """Return the rows at which the count has jumped; the rows within a jump become NaN."""
    known = np.flatnonzero(np.isfinite(count))
    if known.size < 3:
        return []
    window = np.floor((time_s[known] - time_s[known[0]]) / WINDOW_S)
    first = known[np.flatnonzero(np.diff(window, prepend=-1.0))]
    level, value = (
        np.array([np.median(part) for part in np.split(of[known], _places(window))])
        for of in (count, shown)
    )
    if level.size < 3:
        return []
    # Over two windows, so that a jump of a minute counts whole.
    change = level[2:] - level[:-2]
    moved = value[2:] - value[:-2]
    one = np.diff(level)
    least = max(JUMP_PCT, 2.0 * step_pct, SEVERAL * float(np.quantile(np.abs(one), 0.9)))
    result, after = list[int](), -1
    large = np.minimum(np.abs(change), np.abs(moved)) >= least
    if np.count_nonzero(large[1:] & ~large[:-1]) > MOST_JUMPS:
        return []
    for k in np.flatnonzero(large):
        near = slice(max(0, int(k) - 1), int(k) + 2)
        if k <= after or np.abs(change[k]) < np.abs(change[near]).max():
            continue
        low, high = first[k] + 1, first[k + 2]
        half = 0.5 * (level[k] + level[k + 2])
        inside = known[(known >= low) & (known <= high)]
        beyond = (count[inside] - half) * np.sign(change[k]) > 0.0
        row = int(inside[int(np.argmax(beyond))]) if beyond.any() else int(high)
        ends = np.abs(count[inside] - np.where(inside < row, level[k], level[k + 2]))
        count[inside[ends > 0.25 * abs(change[k])]] = np.nan
        result.append(row if np.isfinite(count[row]) else int(high))
        after = int(k) + 1
    return result


def _places(numbers: FloatArray) -> IntArray:
    """Return where another number begins."""
    return np.flatnonzero(np.diff(numbers)) + 1

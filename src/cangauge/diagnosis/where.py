"""Where the error lies: its excess over SoC, temperature, current, rest and time."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from cangauge._text import number
from cangauge._typing import FloatArray, IntArray

REST_C_RATE, LONG_REST_S = 0.02, 300.0
"""Current below which the pack rests [1/h], and the rest from which on what comes after it counts
as after a rest [s]."""
AFTER_REST_MIN: Final = (0.0, 10.0, 30.0)
"""Edges of the time since the last long rest [min]; the last interval is open."""

PIECE_S, LEAST_PIECES, DRAWS = 300, 3, 400
"""Bootstrap: length of a piece [s], longer than errors are correlated; least number of pieces with
rows in an interval, since two always agree; and number of draws, which leaves quantiles uncertain
by one per cent."""
DIFFERENT: Final = 1.3
"""Smallest ratio of errors that counts as a difference: a third is visible in a plot."""


@dataclass(frozen=True, eq=False)
class LogErrors:
    """Errors of one diagnosed log; m rows that count.

    Parameters
    ----------
    name : str
    time_s : array of shape (m,)
        Since the first row of the log [s].
    current_a, temperature_c, soc_pct : array of shape (m,)
        As measured, and counted.
    before_v : array of shape (m,)
        Measured less given model [V].
    after_v : array of shape (m,)
        With the correction, sized without these rows; equal to `before_v` without one [V].
    """

    name: str
    time_s: FloatArray
    current_a: FloatArray
    temperature_c: FloatArray
    soc_pct: FloatArray
    before_v: FloatArray
    after_v: FloatArray


def rms(logs: Sequence[LogErrors], *, after: bool = False) -> float:
    """Return the RMS error of all logs, before or after [V]."""
    errors = [log.after_v if after else log.before_v for log in logs]
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


def pieces(logs: Sequence[LogErrors]) -> IntArray:
    """Return the number of each row's piece of `PIECE_S`, over all logs in order."""
    numbers, first = [], 0
    for log in logs:
        piece = (log.time_s // PIECE_S).astype(np.intp)
        numbers.append(piece + first)
        first += int(piece.max(initial=-1)) + 1
    return np.concatenate(numbers)


def drawn_sums(piece: IntArray, *values: FloatArray) -> list[FloatArray]:
    """Return sums of values over pieces drawn with replacement, shape (draws,) each."""
    sums = [np.bincount(piece, weights=each) for each in values]
    draw = np.random.default_rng(0).integers(0, sums[0].size, (DRAWS, sums[0].size))
    return [np.asarray(each[draw].sum(axis=1)) for each in sums]


def closed_part(
    logs: Sequence[LogErrors], healthy_v2: float
) -> tuple[float | None, tuple[float, float] | None]:
    """Return the closed part of the squared error above a healthy log's, and its 95 % interval.

    By a bootstrap over pieces. None without a gap above the healthy error.
    """
    before = np.concatenate([log.before_v for log in logs]) ** 2
    after = np.concatenate([log.after_v for log in logs]) ** 2
    gap = before.mean() - healthy_v2
    if not gap > 0.0:
        return None, None
    closed = min(float((before.mean() - after.mean()) / gap), 1.0)
    sums = drawn_sums(pieces(logs), before, after, np.ones(before.size))
    drawn_before, drawn_after, rows = sums
    gaps = drawn_before - healthy_v2 * rows
    usable = gaps > 0.0
    if usable.mean() < 0.9:
        return closed, None
    parts = np.minimum((drawn_before - drawn_after)[usable] / gaps[usable], 1.0)
    low, high = np.quantile(parts, [0.025, 0.975])
    return closed, (float(low), float(high))


def excesses(logs: Sequence[LogErrors], capacity_ah: float) -> list[dict[str, Any]]:
    """Return the error of the given model in each interval of each axis, over that of all rows.

    `excess` is a ratio of RMS errors, `ci` its 95 % interval. None where there is no error at all.
    """
    piece = pieces(logs)
    square = np.concatenate([log.before_v for log in logs]) ** 2
    if not square.any():
        return []
    every = np.ones(square.size)
    found = []
    for axis, unit, values, edges in _axes(logs, capacity_ah):
        for low, high in itertools.pairwise(edges.tolist()):
            inside = (values >= low) & ((values < high) | (high >= edges[-1]))
            if np.unique(piece[inside]).size < LEAST_PIECES:
                continue
            part, rows, whole, all_rows = drawn_sums(
                piece, square * inside, inside.astype(np.float64), square, every
            )
            usable = (rows > 0.0) & (whole > 0.0)
            ratios = np.sqrt(part[usable] / rows[usable] * all_rows[usable] / whole[usable])
            mean = float(square[inside].mean())
            found.append(
                {
                    "axis": axis,
                    "range": [low, high],
                    "unit": unit,
                    "excess": float(np.sqrt(mean / square.mean())),
                    "rmse_v": float(np.sqrt(mean)),
                    "ci": np.quantile(ratios, [0.025, 0.975]).tolist(),
                }
            )
    return found


def stands_out(place: Mapping[str, Any]) -> bool:
    """Return whether the error of an interval is larger than that of all rows for certain."""
    return bool(place["excess"] >= DIFFERENT and place["ci"][0] > 1.0)


def clause(where: Sequence[dict[str, Any]]) -> str:
    """Return where the error is larger than elsewhere, in a clause."""
    worst = [place for place in where if stands_out(place)]
    if not worst:
        return "everywhere alike"
    lowest = [place["ci"][0] for place in worst]
    place = worst[lowest.index(max(lowest))]
    ranges = [each["range"] for each in where if each["axis"] == place["axis"]]
    first, last = min(low for low, _ in ranges), max(high for _, high in ranges)
    times = number(place["excess"], 1)
    return f"{_place(place, first, last)} ({times} times that of all rows)"


def _place(place: dict[str, Any], first: float, last: float) -> str:
    """Return an interval of an axis from `first` to `last`, as a reader would say it."""
    axis, (low, high) = place["axis"], place["range"]
    if axis in ("soc", "temperature"):
        unit = "% SoC" if axis == "soc" else "°C"
        if low == first:
            return f"below {high:.0f} {unit}"
        return f"above {low:.0f} {unit}" if high == last else f"at {low:.0f} to {high:.0f} {unit}"
    if axis == "current":
        if high <= 0.0:
            return f"while charging at {-high:.0f} to {-low:.0f} A"
        span = f"{low:.0f} to {high:.0f} A"
        return f"at rest ({span})" if low < 0.0 else f"at {span}"
    if axis == "rest":
        start = f"in the first {high:.0f}" if low == 0.0 else f"{low:.0f}"
        return f"{start} min after a rest"
    return f"in minutes {low / 60.0:.0f} to {high / 60.0:.0f}"


def _axes(
    logs: Sequence[LogErrors], capacity_ah: float
) -> Iterator[tuple[str, str, FloatArray, FloatArray]]:
    """Yield name, unit, values of all rows and edges of each axis."""
    current = np.concatenate([log.current_a for log in logs])
    temperature = np.concatenate([log.temperature_c for log in logs])
    elapsed = np.concatenate([log.time_s for log in logs])
    yield "soc", "%", np.concatenate([log.soc_pct for log in logs]), np.linspace(-5, 105, 12)
    low = 5.0 * np.floor(temperature.min() / 5.0)
    yield "temperature", "°C", temperature, np.arange(low, max(temperature.max(), low + 0.1) + 5, 5)
    edges = capacity_ah * np.array([-0.5, -REST_C_RATE, REST_C_RATE, 0.5, 1.0, 2.0])
    inner = edges[(edges > current.min()) & (edges < current.max())]
    yield "current", "A", current, np.array([current.min(), *inner, current.max()])
    since = np.concatenate([_since_rest(log, capacity_ah) for log in logs])
    after = since[np.isfinite(since)]
    if after.size:
        edges = np.array([*AFTER_REST_MIN, max(float(after.max()), AFTER_REST_MIN[-1]) + 1.0])
        yield "rest", "min", since, edges
    yield "time", "s", elapsed, np.linspace(0.0, float(elapsed.max()) + 1e-9, 6)


def _since_rest(log: LogErrors, capacity_ah: float) -> FloatArray:
    """Return the time since the last long rest [min], shape (m,); NaN before one."""
    moving = np.abs(log.current_a) >= REST_C_RATE * capacity_ah
    last = np.maximum.accumulate(np.where(moving, log.time_s, -np.inf))
    before = np.r_[-np.inf, last[:-1]]
    rested_s = log.time_s - before
    ends = moving & np.isfinite(before) & (rested_s >= LONG_REST_S)
    ended = np.maximum.accumulate(np.where(ends, log.time_s, -np.inf))
    minutes = (log.time_s - ended) / 60.0
    return np.where(np.isfinite(ended), minutes, np.nan)

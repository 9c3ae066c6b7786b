"""Where the error lies: its excess over SoC, temperature, current, rest and time."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from cangauge._text import number
from cangauge._typing import FloatArray, IntArray

REST_C_RATE, LONG_REST_S = 0.02, 300.0
"""Current below which the pack rests [1/h], and the rest from which on what comes after it counts
as after a rest [s]."""

PIECE_S, LEAST_PIECES, DRAWS = 300, 3, 400
"""Bootstrap: length of a piece [s], longer than errors are correlated; least number of pieces with
rows in an interval, since two always agree; and number of draws, which leaves quantiles uncertain
by one per cent."""


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of the diagnosed logs; m rows that count, log by log.

    Parameters
    ----------
    log : array of int, shape (m,)
        Number of the log.
    time_s : array of shape (m,)
        Since the first row of the log [s].
    current_a, temperature_c, soc_pct : array of shape (m,)
        As measured, and counted.
    before_v : array of shape (m,)
        Measured less given model [V].
    after_v : array of shape (m,)
        With the correction, sized without these rows; equal to `before_v` without one [V].
    """

    log: IntArray
    time_s: FloatArray
    current_a: FloatArray
    temperature_c: FloatArray
    soc_pct: FloatArray
    before_v: FloatArray
    after_v: FloatArray

    @property
    def by_log(self) -> list[Errors]:
        """The errors of each log."""
        return [
            Errors(*(getattr(self, each.name)[self.log == k] for each in fields(self)))
            for k in range(int(self.log[-1]) + 1)
        ]

    @cached_property
    def piece(self) -> IntArray:
        """Number of each row's piece of `PIECE_S`, over all logs in order."""
        piece = (self.time_s // PIECE_S).astype(np.intp)
        in_logs = [piece[self.log == k].max(initial=-1) + 1 for k in range(int(self.log[-1]) + 1)]
        return np.asarray(piece + np.cumsum([0, *in_logs])[self.log])

    def drawn(self, values: FloatArray) -> FloatArray:
        """Return sums of values over pieces drawn with replacement, shape (draws,)."""
        sums = np.bincount(self.piece, weights=values)
        draw = np.random.default_rng(0).integers(0, sums.size, (DRAWS, sums.size))
        return np.asarray(sums[draw].sum(axis=1))


def rms(errors_v: FloatArray) -> float:
    """Return the root mean square of errors [V]."""
    return float(np.sqrt(np.mean(errors_v**2)))


def closed_part(
    errors: Errors, healthy_v2: float
) -> tuple[float | None, tuple[float, float] | None]:
    """Return the closed part of the squared error above a healthy log's, and its 95 % interval.

    By a bootstrap over pieces. None without a gap above the healthy error.
    """
    before, after = errors.before_v**2, errors.after_v**2
    gap = before.mean() - healthy_v2
    if not gap > 0.0:
        return None, None
    closed = min(float((before.mean() - after.mean()) / gap), 1.0)
    gaps = errors.drawn(before) - healthy_v2 * errors.drawn(np.ones(before.size))
    usable = gaps > 0.0
    if usable.mean() < 0.9:
        return closed, None
    parts = np.minimum(errors.drawn(before - after)[usable] / gaps[usable], 1.0)
    low, high = np.quantile(parts, [0.025, 0.975])
    return closed, (float(low), float(high))


def excesses(errors: Errors, capacity_ah: float) -> list[dict[str, Any]]:
    """Return the error of the given model in each interval of each axis, over that of all rows.

    `excess` is a ratio of RMS errors, `ci` its 95 % interval. None where there is no error at all.
    """
    square, found = errors.before_v**2, []
    if not square.any():
        return []
    whole, all_rows = errors.drawn(square), errors.drawn(np.ones(square.size))
    for axis, unit, values, edges in _axes(errors, capacity_ah):
        for low, high in itertools.pairwise(edges.tolist()):
            inside = (values >= low) & ((values < high) | (high >= edges[-1]))
            if np.unique(errors.piece[inside]).size < LEAST_PIECES:
                continue
            part, rows = errors.drawn(square * inside), errors.drawn(inside.astype(np.float64))
            usable = (rows > 0.0) & (whole > 0.0)
            ratios = np.sqrt(part[usable] / rows[usable] * all_rows[usable] / whole[usable])
            here = rms(errors.before_v[inside])
            entry = {
                "axis": axis,
                "range": [low, high],
                "unit": unit,
                "excess": here / rms(errors.before_v),
                "rmse_v": here,
                "ci": np.quantile(ratios, [0.025, 0.975]).tolist(),
            }
            found.append(entry)
    return found


def stands_out(place: Mapping[str, Any]) -> bool:
    """Return whether the error of an interval is larger than that of all rows for certain.

    And by a third at least, which is visible in a plot.
    """
    return bool(place["excess"] >= 1.3 and surely(place) > 1.0)


def surely(place: Mapping[str, Any]) -> float:
    """Return the excess of an interval's error that is certain."""
    return float(place["ci"][0])


def where_sentence(where: Sequence[Mapping[str, Any]]) -> str:
    """Return where the error is larger than elsewhere, in a sentence."""
    worst = [place for place in where if stands_out(place)]
    if not worst:
        return "The error is alike everywhere."
    surest = max(worst, key=surely)
    alike = [place["range"] for place in where if place["axis"] == surest["axis"]]
    place = _place(surest, alike[0][0], alike[-1][1])
    times = number(surest["excess"], 1)
    return f"{place[0].upper()}{place[1:]} the error is {times} times that of all rows."


def _place(place: Mapping[str, Any], first: float, last: float) -> str:
    """Return an interval of an axis from `first` to `last`, as a reader would say it."""
    axis, (low, high) = place["axis"], place["range"]
    if axis == "time":
        return f"in minutes {low / 60.0:.0f} to {high / 60.0:.0f}"
    if axis == "rest":
        start = f"in the first {high:.0f}" if low == 0.0 else f"{low:.0f}"
        return f"{start} min after a rest"
    if axis == "current":
        if high <= 0.0:
            return f"while charging at {-high:.0f} to {-low:.0f} A"
        span = f"{low:.0f} to {high:.0f} A"
        return f"at rest ({span})" if low < 0.0 else f"at {span}"
    unit = "% SoC" if axis == "soc" else "°C"
    if low == first:
        return f"below {high:.0f} {unit}"
    return f"above {low:.0f} {unit}" if high == last else f"at {low:.0f} to {high:.0f} {unit}"


def _axes(errors: Errors, capacity_ah: float) -> Iterator[tuple[str, str, FloatArray, FloatArray]]:
    """Yield name, unit, values of all rows and edges of each axis."""
    current, celsius, time_s = errors.current_a, errors.temperature_c, errors.time_s
    yield "soc", "%", errors.soc_pct, np.linspace(-5, 105, 12)
    low = 5.0 * np.floor(celsius.min() / 5.0)
    yield "temperature", "°C", celsius, np.arange(low, max(celsius.max(), low + 0.1) + 5, 5)
    edges = capacity_ah * np.array([-0.5, -REST_C_RATE, REST_C_RATE, 0.5, 1.0, 2.0])
    inner = edges[(edges > current.min()) & (edges < current.max())]
    yield "current", "A", current, np.array([current.min(), *inner, current.max()])
    since = np.concatenate([_since_rest(log, capacity_ah) for log in errors.by_log])
    if np.isfinite(since).any():
        last = max(float(np.nanmax(since)), 30.0) + 1.0
        yield "rest", "min", since, np.array([0.0, 10.0, 30.0, last])
    yield "time", "s", time_s, np.linspace(0.0, float(time_s.max()) + 1e-9, 6)


def _since_rest(log: Errors, capacity_ah: float) -> FloatArray:
    """Return the time since the last long rest [min], shape (m,); NaN before one."""
    moving = np.abs(log.current_a) >= REST_C_RATE * capacity_ah
    last = np.maximum.accumulate(np.where(moving, log.time_s, -np.inf))
    before = np.r_[-np.inf, last[:-1]]
    rested_s = log.time_s - before
    ends = moving & np.isfinite(before) & (rested_s >= LONG_REST_S)
    ended = np.maximum.accumulate(np.where(ends, log.time_s, -np.inf))
    minutes = (log.time_s - ended) / 60.0
    return np.where(np.isfinite(ended), minutes, np.nan)

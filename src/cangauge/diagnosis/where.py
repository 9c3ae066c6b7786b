"""Where the error lies: its shares over SoC, temperature, current, rest, time and time scale."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.ndimage import uniform_filter1d

from cangauge._typing import BoolArray, FloatArray, IntArray

TIME_SCALES_S: Final = (0.0, 10.0, 100.0, 1000.0, 1e6)
"""Edges of the time scales [s]: faster than 10 s, 10–100 s, …, slower than 1000 s."""

REST_C_RATE: Final = 0.02
"""Current below which the pack rests [1/h]."""

PIECE_S: Final = 300
"""Length of the pieces that a bootstrap draws, beyond the correlation of errors [s]."""

DRAWS: Final = 400
"""Draws of a bootstrap; its quantiles vary by one per cent."""


@dataclass(frozen=True, eq=False)
class LogErrors:
    """Errors of one diagnosed log at 1 Hz; m rows that count."""

    name: str
    time_s: FloatArray
    """Since the first row of the log, shape (m,) [s]."""
    current_a: FloatArray
    temperature_c: FloatArray
    soc_pct: FloatArray
    """As counted."""
    before_v: FloatArray
    """Measured less given model [V]."""
    after_v: FloatArray
    """With the cause, sized without these rows; equal to `before_v` without a cause [V]."""
    judged: BoolArray
    """Rows that the cause can change; all without a cause."""


def rms(logs: Sequence[LogErrors], *, after: bool = False) -> float:
    """Return the RMS error of the judged rows of all logs, before or after [V]."""
    errors = [(log.after_v if after else log.before_v)[log.judged] for log in logs]
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

    Of the judged rows, by a bootstrap over pieces. None without a gap above the healthy error.
    """
    weight = np.concatenate([log.judged for log in logs]).astype(np.float64)
    before = np.concatenate([log.before_v for log in logs]) ** 2 * weight
    after = np.concatenate([log.after_v for log in logs]) ** 2 * weight
    gap = before.sum() / weight.sum() - healthy_v2
    if not gap > 0.0:
        return None, None
    closed = min(float((before.sum() - after.sum()) / weight.sum() / gap), 1.0)
    drawn_before, drawn_after, rows = drawn_sums(pieces(logs), before, after, weight)
    rows = np.maximum(rows, 1.0)
    gaps = drawn_before / rows - healthy_v2
    usable = gaps > 0.0
    if usable.mean() < 0.9:
        return closed, None
    parts = np.minimum(((drawn_before - drawn_after) / rows)[usable] / gaps[usable], 1.0)
    low, high = np.quantile(parts, [0.025, 0.975])
    return closed, (float(low), float(high))


def error_shares(logs: Sequence[LogErrors], capacity_ah: float) -> list[dict[str, Any]]:
    """Return the shares of the given model's squared error; on each axis they sum to one.

    Each with its RMS error within the interval and the 95 % interval of the share.
    """
    piece, shares = pieces(logs), []
    square = np.concatenate([log.before_v for log in logs]) ** 2
    parts = [
        (axis, unit, limits, square * inside, square, inside)
        for axis, unit, values, edges in _axes(logs, capacity_ah)
        for limits in itertools.pairwise(edges.tolist())
        if (inside := _inside(values, *limits, last=limits[1] >= edges[-1])).any()
    ]
    bands = [np.concatenate(each) ** 2 for each in zip(*map(_bands, logs), strict=True)]
    every, total = np.ones(square.size, dtype=bool), np.sum(bands, axis=0)
    parts += [
        ("timescale", "s", limits, band, total, every)
        for limits, band in zip(itertools.pairwise(TIME_SCALES_S), bands, strict=True)
    ]
    for axis, unit, limits, part, whole, rows in parts:
        drawn_part, drawn_whole = drawn_sums(piece, part, whole)
        ci = np.quantile(drawn_part / np.maximum(drawn_whole, 1e-12), [0.025, 0.975]).tolist()
        share = float(part.sum() / max(float(whole.sum()), 1e-12))
        rms_v = float(np.sqrt(part.sum() / rows.sum()))
        shares.append({"axis": axis, "range": list(limits), "unit": unit, "share": share,
                       "rmse_v": rms_v, "ci": ci})  # fmt: skip
    return shares


def _inside(values: FloatArray, low: float, high: float, *, last: bool) -> BoolArray:
    return np.asarray((values >= low) & ((values < high) | last))


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
    resting = (np.abs(current) < REST_C_RATE * capacity_ah).astype(np.float64)
    yield "rest", "1 = rest", resting, np.array([0.0, 0.5, 1.0])
    yield "time", "s", elapsed, np.linspace(0.0, float(elapsed.max()) + 1e-9, 6)


def _bands(log: LogErrors) -> list[FloatArray]:
    """Return a log's error in each band of time scales, by moving averages of its rows."""
    bands, left = [], log.before_v
    for width in TIME_SCALES_S[1:-1]:
        smooth = uniform_filter1d(left, min(int(width), left.size), mode="nearest")
        bands.append(left - smooth)
        left = smooth
    return [*bands, left]

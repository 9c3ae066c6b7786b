"""Error breakdown: shares along each axis, worst segments, and maps over two quantities."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.diagnosis.cross_validation import DRAWS, PIECE_S
from cangauge.diagnosis.design_matrix import DesignMatrix
from cangauge.inference.rows import SampledLog, block_numbers

TIME_SCALES_S = (0.0, 10.0, 100.0, 1000.0, np.inf)
"""Edges of the time scales: faster than 10 s, 10–100 s, …, slower than 1000 s."""

REST_C_RATE = 0.02
"""Current below which the pack rests [1/h]."""

SEGMENTS = 10
"""Number of worst segments."""

SEGMENT_S = 60.0
"""Least distance of worst segments of one log, and length shown before and after each [s]."""

MIN_BIN_ROWS = 10
"""Rows that a bin of a map needs; others stay empty."""

ROWS_PER_BIN, MIN_BINS = 150, 5
"""An axis of a map has at most one bin per this many rows of the logs, but may have `MIN_BINS`."""

MAX_SOC_BINS, MAX_OTHER_BINS = 20, 14

TAIL_ROWS, TAIL_PART = 100, (0.01, 0.1)
"""Rows at either end of the current that share one bin, within these parts of all."""

MIN_BIN_WIDTH = 1.0
"""Least width of a bin [%, A or K]."""


@dataclass(frozen=True, eq=False)
class LogErrors:
    """Errors of one diagnosed log; m rows at the model's rate."""

    sampled: SampledLog
    before_v: FloatArray
    """Measured − given model, shape (m,) [V]."""
    after_v: FloatArray
    """Measured, corrected for sensor effects, − extended model, shape (m,) [V]. The extended model
    was fitted to these rows; `Diagnosis.extended_rmse_v` is of held-out rows."""


@dataclass(frozen=True)
class ErrorShare:
    """Share of the squared error in one interval of an axis."""

    axis: str
    low: float
    high: float
    unit: str
    share: float
    rmse_v: float
    """Within the interval [V]."""
    ci: tuple[float, float]
    """95 % interval of the share."""

    def to_dict(self) -> dict[str, object]:
        """Return the entry of `where` in `gap --json`."""
        return {
            "axis": self.axis,
            "range": [self.low, self.high],
            "unit": self.unit,
            "share": self.share,
            "rmse_v": self.rmse_v,
            "ci": list(self.ci),
        }


def error_shares(
    logs: Sequence[DesignMatrix], errors_v: Sequence[FloatArray], capacity_ah: float
) -> list[ErrorShare]:
    """Return the shares along SoC, temperature, current, rest, time and time scale.

    On each axis they sum to one.

    Parameters
    ----------
    logs : sequence of DesignMatrix
    errors_v : sequence of arrays
        Measured − given model on the rows of each log [V].
    capacity_ah : float
        Defines rest [Ah].
    """
    square = np.concatenate(errors_v) ** 2
    piece = block_numbers([matrix.sampled.rows for matrix in logs], PIECE_S)
    result = []
    for axis, unit, values, edges in _axes(logs, capacity_ah):
        for low, high in itertools.pairwise(edges.tolist()):
            inside = (values >= low) & ((values < high) | (high >= edges[-1]))
            if inside.any():
                part = square * inside
                share = float(part.sum() / max(float(square.sum()), 1e-12))
                rmse_v = float(np.sqrt(square[inside].mean()))
                ci = _share_interval(_sums(piece, part), _sums(piece, square))
                result.append(ErrorShare(axis, low, high, unit, share, rmse_v, ci))
    return result + _time_scale_shares(logs, errors_v, piece)


def _axes(
    logs: Sequence[DesignMatrix], capacity_ah: float
) -> Iterator[tuple[str, str, FloatArray, FloatArray]]:
    """Yield name, unit, values of all rows and edges of each axis."""
    rows = [matrix.sampled.rows for matrix in logs]
    current = np.concatenate([item.delayed_current_a[:, 0] for item in rows])
    yield "soc", "%", np.concatenate([item.soc_pct for item in rows]), np.linspace(-5, 105, 12)
    temperature = np.concatenate([item.temperature_c for item in rows])
    low = 5.0 * np.floor(temperature.min() / 5.0)
    edges = np.array([low, low + 5.0])
    if np.ptp(temperature) > 0:
        edges = np.arange(low, temperature.max() + 5.0, 5.0)
    yield "temperature", "°C", temperature, edges
    inner = capacity_ah * np.array([-0.5, -0.02, 0.02, 0.5, 1.0, 2.0])
    ends = float(current.min()), float(current.max())
    inside = inner[(inner > ends[0]) & (inner < ends[1])]
    yield "current", "A", current, np.array([ends[0], *inside, ends[1]])
    resting = (np.abs(current) < REST_C_RATE * capacity_ah).astype(np.float64)
    yield "rest", "1 = rest", resting, np.array([0.0, 0.5, 1.0])
    elapsed = np.concatenate(
        [matrix.sampled.rows.time_s - matrix.sampled.log.time_s[0] for matrix in logs]
    )
    yield "time", "s", elapsed, np.linspace(0.0, float(elapsed.max()) + 1e-9, 6)


def _sums(piece: NDArray[np.intp], values: FloatArray) -> FloatArray:
    return np.bincount(piece, weights=values).astype(np.float64)


def _share_interval(part: FloatArray, whole: FloatArray) -> tuple[float, float]:
    """Return the 95 % interval of a share by a bootstrap over pieces of the logs."""
    rng = np.random.default_rng(0)
    draw = rng.integers(0, whole.size, (DRAWS, whole.size))
    share = part[draw].sum(axis=1) / np.maximum(whole[draw].sum(axis=1), 1e-12)
    low, high = np.quantile(share, [0.025, 0.975])
    return float(low), float(high)


def _time_scale_shares(
    logs: Sequence[DesignMatrix], errors_v: Sequence[FloatArray], piece: NDArray[np.intp]
) -> list[ErrorShare]:
    """Split the error into bands by moving averages; a band's share is that of its squares."""
    bands: list[list[FloatArray]] = [[] for _ in TIME_SCALES_S[1:]]
    for matrix, error_v in zip(logs, errors_v, strict=True):
        rest = error_v
        step_s = float(np.median(np.diff(matrix.sampled.rows.time_s)))
        for k, width_s in enumerate(TIME_SCALES_S[1:]):
            smooth = _moving_average(rest, width_s / step_s)
            bands[k].append(rest - smooth if np.isfinite(width_s) else rest)
            rest = smooth
    squares = [np.concatenate(parts) ** 2 for parts in bands]
    whole = _sums(piece, np.sum(squares, axis=0))
    result = []
    for (low, high), square in zip(itertools.pairwise(TIME_SCALES_S), squares, strict=True):
        part = _sums(piece, square)
        share = float(part.sum() / max(whole.sum(), 1e-12))
        rmse_v = float(np.sqrt(square.mean()))
        ci = _share_interval(part, whole)
        result.append(ErrorShare("timescale", low, min(high, 1e6), "s", share, rmse_v, ci))
    return result


def _moving_average(values: FloatArray, width: float) -> FloatArray:
    if not np.isfinite(width) or width >= values.size:
        return np.full_like(values, values.mean())
    half = int(width) // 2
    total = np.concatenate(([0.0], np.cumsum(values)))
    at = np.arange(values.size)
    low, high = np.maximum(at - half, 0), np.minimum(at + half + 1, values.size)
    return np.asarray((total[high] - total[low]) / (high - low))


@dataclass(frozen=True)
class WorstSegment:
    """Centre of a segment with a large error."""

    number: int
    """Number of the diagnosed log."""
    log: str
    """Name of the log."""
    time_s: float
    """Time of the log [s]."""
    residual_v: float
    """Measured − given model [V]."""
    soc_pct: float
    """Counted SoC [%]."""
    current_a: float
    """Positive = discharge [A]."""
    temperature_c: float

    def to_dict(self) -> dict[str, object]:
        """Return the entry of `worst_moments` in `gap --json`."""
        return {name: value for name, value in vars(self).items() if name != "number"}


@dataclass(frozen=True, eq=False)
class SegmentSignals:
    """Signals of a segment; times are relative to its centre [s]."""

    time_s: FloatArray
    """Of the errors, shape (m,)."""
    before_v: FloatArray
    """Measured − given model, shape (m,) [V]."""
    after_v: FloatArray
    """Measured − extended model, shape (m,) [V]."""
    current_time_s: FloatArray
    """Of the current at the log's own rate, shape (n,)."""
    current_a: FloatArray
    """Shape (n,)."""


def worst_segments(
    logs: Sequence[DesignMatrix], errors_v: Sequence[FloatArray], number: int = SEGMENTS
) -> list[WorstSegment]:
    """Return the segments with the largest errors of all logs, worst first.

    Parameters
    ----------
    logs : sequence of DesignMatrix
    errors_v : sequence of arrays
        Measured − model on the rows of each log [V].
    number : int
        Segments to return; fewer from short logs.
    """
    found: list[WorstSegment] = []
    for k, (matrix, error_v) in enumerate(zip(logs, errors_v, strict=True)):
        rows = matrix.sampled.rows
        found += [
            WorstSegment(
                number=k,
                log=rows.name,
                time_s=float(rows.time_s[at]),
                residual_v=float(error_v[at]),
                soc_pct=float(rows.soc_pct[at]),
                current_a=float(rows.delayed_current_a[at, 0]),
                temperature_c=float(rows.temperature_c[at]),
            )
            for at in _peaks(rows.time_s, np.abs(error_v), number)
        ]
    return sorted(found, key=lambda segment: -abs(segment.residual_v))[:number]


def _peaks(time_s: FloatArray, size_v: FloatArray, number: int) -> list[int]:
    """Return the rows of the largest values, at least `SEGMENT_S` apart."""
    free = np.ones(size_v.size, dtype=bool)
    found: list[int] = []
    for at in np.argsort(-size_v, kind="stable").tolist():
        if free[at]:
            found.append(at)
            free &= np.abs(time_s - time_s[at]) >= SEGMENT_S
        if len(found) == number:
            break
    return found


def segment_signals(segment: WorstSegment, errors: Sequence[LogErrors]) -> SegmentSignals:
    """Return errors and current from a minute before a segment's centre to a minute after.

    Parameters
    ----------
    segment : WorstSegment
    errors : sequence of LogErrors
        Of all diagnosed logs.
    """
    of_log = errors[segment.number]
    time_s, log = of_log.sampled.rows.time_s - segment.time_s, of_log.sampled.log
    near = np.abs(time_s) <= SEGMENT_S
    current_time_s = log.time_s - segment.time_s
    current_near = np.abs(current_time_s) <= SEGMENT_S
    return SegmentSignals(
        time_s=time_s[near],
        before_v=of_log.before_v[near],
        after_v=of_log.after_v[near],
        current_time_s=current_time_s[current_near],
        current_a=log.current_a[current_near],
    )


@dataclass(frozen=True, eq=False)
class ErrorMap:
    """Error over SoC (m bins) and a second quantity (k bins)."""

    soc_edges_pct: FloatArray
    """Shape (m + 1,)."""
    edges: FloatArray
    """Of the second quantity, shape (k + 1,)."""
    rows: NDArray[np.intp]
    """Rows in each bin, shape (k, m)."""
    rms_v: FloatArray
    """RMS error, shape (k, m) [V]; NaN in bins with fewer than `MIN_BIN_ROWS` rows."""
    mean_v: FloatArray
    """Mean error, shape (k, m) [V]; NaN in the same bins."""
    tails: bool = False
    """Whether the outer bins of the second quantity include everything beyond them."""


def error_map(
    soc_pct: FloatArray, values: FloatArray, error_v: FloatArray, *, tails: bool = False
) -> ErrorMap:
    """Map an error over SoC and a second quantity.

    Parameters
    ----------
    soc_pct, values : array of shape (n,)
        SoC [%], and current [A] or temperature [°C]. They alone define the bins, so that maps of
        two errors on the same rows are comparable.
    error_v : array of shape (n,)
        Measured − model [V].
    tails : bool
        Put long tails of `values` into the outer bins.
    """
    if tails:
        # Otherwise one pulse of 400 A would compress a drive at 50 A into two rows of bins.
        part = float(np.clip(TAIL_ROWS / values.size, *TAIL_PART))
        values = np.clip(values, *np.quantile(values, [part, 1.0 - part]))
    most = max(MIN_BINS, soc_pct.size // ROWS_PER_BIN)
    soc_edges = even_edges(soc_pct, min(MAX_SOC_BINS, most))
    edges = even_edges(values, min(MAX_OTHER_BINS, most))
    shape = edges.size - 1, soc_edges.size - 1
    at = _bin(edges, values) * shape[1] + _bin(soc_edges, soc_pct)

    def total(weights: FloatArray | None = None) -> FloatArray:
        sums = np.bincount(at, weights=weights, minlength=shape[0] * shape[1])
        return sums.reshape(shape).astype(np.float64)

    rows = total()
    enough = np.where(rows >= MIN_BIN_ROWS, rows, np.nan)
    return ErrorMap(
        soc_edges_pct=soc_edges,
        edges=edges,
        rows=rows.astype(np.intp),
        rms_v=np.sqrt(total(error_v**2) / enough),
        mean_v=total(error_v) / enough,
        tails=tails,
    )


def even_edges(values: FloatArray, at_most: int) -> FloatArray:
    """Return edges of at most this many even bins over all values, 1, 2 or 5 · 10ᵏ wide."""
    low, high = float(values.min()), float(values.max())
    width = MIN_BIN_WIDTH
    for factor in np.tile([2.0, 2.5, 2.0], 10):
        first, last = np.floor(low / width), np.floor(high / width) + 1.0
        if last - first <= at_most:
            break
        width *= factor
    return np.asarray(width * np.arange(first, last + 0.5))


def _bin(edges: FloatArray, values: FloatArray) -> NDArray[np.intp]:
    found = np.searchsorted(edges, values, side="right") - 1
    return np.clip(found, 0, edges.size - 2)

"""Where the gap lies: shares of the squared error over SoC, temperature, current, rest and time.

The worst moments: where the error is largest, and what happened around them.

Maps of the error: its root mean square over SoC × current and SoC × temperature.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.diagnosis.cross_validation import DRAWS, PIECE_S, LogErrors
from cangauge.diagnosis.design_matrix import DesignMatrix

# --- Where the gap lies: shares of the squared error over SoC, temperature, current, rest an…

SCALES_S = (0.0, 10.0, 100.0, 1000.0, np.inf)
"""Edges of the time scales: faster than 10 s, 10–100 s, …, slower than 1000 s."""

REST_C_RATE = 0.02
"""Below this current the pack rests [1/h]."""


@dataclass(frozen=True)
class Place:
    """A part of the logs and its share in the gap."""

    axis: str
    low: float
    high: float
    unit: str
    share: float
    rmse_v: float
    ci: tuple[float, float]
    """95 % interval of the share."""

    def to_dict(self) -> dict[str, object]:
        """Return the place as `gap --json` prints it."""
        return {
            "axis": self.axis,
            "range": [self.low, self.high],
            "unit": self.unit,
            "share": self.share,
            "rmse_v": self.rmse_v,
            "ci": list(self.ci),
        }


def places(
    logs: Sequence[DesignMatrix], errors_v: Sequence[FloatArray], capacity_ah: float
) -> list[Place]:
    """Return the shares of every axis; on each axis they sum to one.

    Parameters
    ----------
    logs : sequence of DesignMatrix
        Diagnosed logs.
    errors_v : sequence of arrays
        Measured − model as given on the rows of each log [V].
    capacity_ah : float
        To tell rest from drive [Ah].
    """
    square = np.concatenate(errors_v) ** 2
    piece = _pieces(logs)
    result = []
    for axis, unit, values, edges in _axes(logs, capacity_ah):
        for low, high in itertools.pairwise(edges.tolist()):
            inside = (values >= low) & ((values < high) | (high >= edges[-1]))
            if inside.any():
                result.append(
                    _place(axis, unit, (low, high), square * inside, (inside, square, piece))
                )
    return result + _time_scales(logs, errors_v, piece)


def _axes(
    logs: Sequence[DesignMatrix], capacity_ah: float
) -> Iterator[tuple[str, str, FloatArray, FloatArray]]:
    rows = [terms.prepared.rows for terms in logs]
    current = np.concatenate([item.delayed_current_a[:, 0] for item in rows])
    yield "soc", "%", np.concatenate([item.soc_pct for item in rows]), np.linspace(-5, 105, 12)
    temperature = np.concatenate([item.temperature_c for item in rows])
    yield "temperature", "°C", temperature, _even_edges(temperature, 5.0)
    inner = capacity_ah * np.array([-0.5, -0.02, 0.02, 0.5, 1.0, 2.0])
    ends = float(current.min()), float(current.max())
    inside = inner[(inner > ends[0]) & (inner < ends[1])]
    yield "current", "A", current, np.array([ends[0], *inside, ends[1]])
    resting = (np.abs(current) < REST_C_RATE * capacity_ah).astype(np.float64)
    yield "rest", "1 = rest", resting, np.array([0.0, 0.5, 1.0])
    passed = np.concatenate(
        [terms.prepared.rows.time_s - terms.prepared.log.time_s[0] for terms in logs]
    )
    yield "time", "s", passed, np.linspace(0.0, float(passed.max()) + 1e-9, 6)


def _even_edges(values: FloatArray, width: float) -> FloatArray:
    low = width * np.floor(values.min() / width)
    return (
        np.arange(low, values.max() + width, width)
        if np.ptp(values) > 0
        else np.array([low, low + width])
    )


def _place(
    axis: str,
    unit: str,
    span: tuple[float, float],
    mine: FloatArray,
    rows: tuple[NDArray[np.bool_], FloatArray, NDArray[np.intp]],
) -> Place:
    inside, square, piece = rows
    per_piece, whole = _sums(piece, mine), _sums(piece, square)
    return Place(
        axis=axis,
        low=span[0],
        high=span[1],
        unit=unit,
        share=float(mine.sum() / max(float(square.sum()), 1e-12)),
        rmse_v=float(np.sqrt(square[inside].mean())),
        ci=_interval(per_piece, whole),
    )


def _sums(piece: NDArray[np.intp], values: FloatArray) -> FloatArray:
    return np.bincount(piece, weights=values).astype(np.float64)


def _interval(mine: FloatArray, whole: FloatArray) -> tuple[float, float]:
    rng = np.random.default_rng(0)
    draw = rng.integers(0, whole.size, (DRAWS, whole.size))
    share = mine[draw].sum(axis=1) / np.maximum(whole[draw].sum(axis=1), 1e-12)
    low, high = np.quantile(share, [0.025, 0.975])
    return float(low), float(high)


def _time_scales(
    logs: Sequence[DesignMatrix], errors_v: Sequence[FloatArray], piece: NDArray[np.intp]
) -> list[Place]:
    """Split the residual into bands by moving averages; a band's share is its squares'."""
    bands: list[list[FloatArray]] = [[] for _ in SCALES_S[1:]]
    for terms, error_v in zip(logs, errors_v, strict=True):
        rest = error_v
        step_s = float(np.median(np.diff(terms.prepared.rows.time_s)))
        for k, width in enumerate(SCALES_S[1:]):
            smooth = _moving_average(rest, width / step_s)
            bands[k].append(rest - smooth if np.isfinite(width) else rest)
            rest = smooth
    squares = [np.concatenate(parts) ** 2 for parts in bands]
    whole = _sums(piece, np.sum(squares, axis=0))
    result = []
    for k, square in enumerate(squares):
        mine = _sums(piece, square)
        result.append(
            Place(
                axis="timescale",
                low=SCALES_S[k],
                high=min(SCALES_S[k + 1], 1e6),
                unit="s",
                share=float(mine.sum() / max(whole.sum(), 1e-12)),
                rmse_v=float(np.sqrt(square.mean())),
                ci=_interval(mine, whole),
            )
        )
    return result


def _moving_average(values: FloatArray, width: float) -> FloatArray:
    if not np.isfinite(width) or width >= values.size:
        return np.full_like(values, values.mean())
    half = int(width) // 2
    total = np.concatenate(([0.0], np.cumsum(values)))
    at = np.arange(values.size)
    low, high = np.maximum(at - half, 0), np.minimum(at + half + 1, values.size)
    return np.asarray((total[high] - total[low]) / (high - low))


def _pieces(logs: Sequence[DesignMatrix]) -> NDArray[np.intp]:
    numbers, first = [], 0
    for terms in logs:
        time_s = terms.prepared.rows.time_s
        number = ((time_s - time_s[0]) // PIECE_S).astype(np.intp) + first
        first = int(number[-1]) + 1
        numbers.append(number)
    return np.concatenate(numbers)


# --- The worst moments: where the error is largest, and what happened around them

MOMENTS = 10
APART_S = 60.0
"""Moments of one log are at least this far apart, and shown with as much before and after [s]."""


@dataclass(frozen=True)
class Moment:
    """A row with a large error."""

    number: int
    """Which of the diagnosed logs."""
    log: str
    """The log's name."""
    time_s: float
    """The log's own time [s]."""
    residual_v: float
    """Measured − model as given [V]."""
    soc_pct: float
    """Counted SoC [%]."""
    current_a: float
    """Current, positive = discharge [A]."""
    temperature_c: float
    """Temperature [°C]."""

    def to_dict(self) -> dict[str, object]:
        """Return the moment as `gap --json` prints it."""
        return {name: value for name, value in vars(self).items() if name != "number"}


@dataclass(frozen=True, eq=False)
class Around:
    """What happened around a moment; times are relative to it [s]."""

    time_s: FloatArray
    """Of the errors, shape (m,)."""
    before_v: FloatArray
    """Measured − model as given [V], shape (m,)."""
    after_v: FloatArray
    """Measured − extended model [V], shape (m,)."""
    current_time_s: FloatArray
    """Of the current, at the log's own rate, shape (n,)."""
    current_a: FloatArray
    """Shape (n,)."""


def worst_moments(
    logs: Sequence[DesignMatrix], errors_v: Sequence[FloatArray], number: int = MOMENTS
) -> list[Moment]:
    """Return the moments with the largest error of all logs, the worst first.

    Parameters
    ----------
    logs : sequence of DesignMatrix
    errors_v : sequence of arrays
        Measured − model on the rows of each log [V].
    number : int
        So many, if the logs are long enough for them.
    """
    found: list[Moment] = []
    for k, (terms, error_v) in enumerate(zip(logs, errors_v, strict=True)):
        rows = terms.prepared.rows
        found += [
            Moment(
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
    return sorted(found, key=lambda moment: -abs(moment.residual_v))[:number]


def around(moment: Moment, errors: Sequence[LogErrors]) -> Around:
    """Return errors and current from a minute before a moment to a minute after.

    Parameters
    ----------
    moment : Moment
    errors : sequence of LogErrors
        Of all diagnosed logs.
    """
    mine = errors[moment.number]
    time_s, log = mine.prepared.rows.time_s - moment.time_s, mine.prepared.log
    near = np.abs(time_s) <= APART_S
    current_time_s = log.time_s - moment.time_s
    current_near = np.abs(current_time_s) <= APART_S
    return Around(
        time_s=time_s[near],
        before_v=mine.before_v[near],
        after_v=mine.after_v[near],
        current_time_s=current_time_s[current_near],
        current_a=log.current_a[current_near],
    )


def _peaks(time_s: FloatArray, size_v: FloatArray, number: int) -> list[int]:
    """Return the rows of the largest values, at least `APART_S` apart."""
    free = np.ones(size_v.size, dtype=bool)
    found: list[int] = []
    for at in np.argsort(-size_v, kind="stable").tolist():
        if free[at]:
            found.append(at)
            free &= np.abs(time_s - time_s[at]) >= APART_S
        if len(found) == number:
            break
    return found


# --- Maps of the error: its root mean square over SoC × current and SoC × temperature

LEAST_ROWS = 10
"""A bin with fewer rows says little and is left empty."""

ROWS_A_BIN = 150
"""No axis has more bins than one for so many rows of the logs, or than `LEAST_BINS`."""

LEAST_BINS = 5

SOC_BINS, OTHER_BINS = 20, 14
"""No axis has more bins than this."""

TAIL_ROWS, TAIL_PART = 100, (0.01, 0.1)
"""So many rows at either end of the current, within these parts of all, share one bin."""

LEAST_WIDTH = 1.0
"""No bin is narrower than 1 %, 1 A or 1 K."""


@dataclass(frozen=True, eq=False)
class ErrorMap:
    """Error over two quantities; k × m bins, k of the second quantity, m of the SoC."""

    soc_edges_pct: FloatArray
    """Shape (m + 1,)."""
    edges: FloatArray
    """Of the second quantity, shape (k + 1,)."""
    rows: NDArray[np.intp]
    """Rows in each bin, shape (k, m)."""
    rms_v: FloatArray
    """Root mean square error [V]; NaN in bins with fewer than `LEAST_ROWS` rows."""
    mean_v: FloatArray
    """Mean error [V]; NaN where `rms_v` is."""
    tails: bool = False
    """Whether the lowest and highest bins of the second quantity hold all that lies beyond."""


def error_map(
    soc_pct: FloatArray, values: FloatArray, error_v: FloatArray, *, tails: bool = False
) -> ErrorMap:
    """Return the map of an error.

    Parameters
    ----------
    soc_pct, values : array of shape (n,)
        SoC [%], and current [A] or temperature [°C] of each row: they alone choose the bins, so
        that maps of two errors on the same rows can be compared.
    error_v : array of shape (n,)
        Measured − model [V].
    tails : bool
        Whether `values` has long tails, which then go into its outermost bins.
    """
    if tails:
        values = _without_tails(values)
    most = max(LEAST_BINS, soc_pct.size // ROWS_A_BIN)
    across = even_edges(soc_pct, min(SOC_BINS, most))
    up = even_edges(values, min(OTHER_BINS, most))
    shape = up.size - 1, across.size - 1
    at = _bin(up, values) * shape[1] + _bin(across, soc_pct)

    def total(weights: FloatArray | None = None) -> FloatArray:
        sums = np.bincount(at, weights=weights, minlength=shape[0] * shape[1])
        return sums.reshape(shape).astype(np.float64)

    rows = total()
    enough = np.where(rows >= LEAST_ROWS, rows, np.nan)
    return ErrorMap(
        soc_edges_pct=across,
        edges=up,
        rows=rows.astype(np.intp),
        rms_v=np.sqrt(total(error_v**2) / enough),
        mean_v=total(error_v) / enough,
        tails=tails,
    )


def _without_tails(values: FloatArray) -> FloatArray:
    # One pulse of 400 A must not squeeze a drive at 50 A into two rows of bins.
    part = float(np.clip(TAIL_ROWS / values.size, *TAIL_PART))
    low, high = np.quantile(values, [part, 1.0 - part])
    return np.clip(values, low, high)


def even_edges(values: FloatArray, at_most: int) -> FloatArray:
    """Return edges of even bins over all values, 1, 2 or 5 · 10ᵏ wide.

    Parameters
    ----------
    values : array of shape (n,)
    at_most : int
        No more bins than this.
    """
    low, high = float(values.min()), float(values.max())
    width = LEAST_WIDTH
    for factor in np.tile([2.0, 2.5, 2.0], 10):
        first, last = np.floor(low / width), np.floor(high / width) + 1.0
        if last - first <= at_most:
            break
        width *= factor
    return np.asarray(width * np.arange(first, last + 0.5))


def _bin(edges: FloatArray, values: FloatArray) -> NDArray[np.intp]:
    found = np.searchsorted(edges, values, side="right") - 1
    return np.clip(found, 0, edges.size - 2)

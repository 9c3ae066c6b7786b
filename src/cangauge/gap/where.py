"""Where the gap lies: shares of the squared error over SoC, temperature, current, rest and time."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cangauge.gap.columns import LogTerms
from cangauge.gap.held_out import DRAWS, PIECE_S

FloatArray = NDArray[np.float64]

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
    logs: Sequence[LogTerms], errors_v: Sequence[FloatArray], capacity_ah: float
) -> list[Place]:
    """Return the shares of every axis; on each axis they sum to one.

    Parameters
    ----------
    logs : sequence of LogTerms
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
    logs: Sequence[LogTerms], capacity_ah: float
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
    logs: Sequence[LogTerms], errors_v: Sequence[FloatArray], piece: NDArray[np.intp]
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


def _pieces(logs: Sequence[LogTerms]) -> NDArray[np.intp]:
    numbers, first = [], 0
    for terms in logs:
        time_s = terms.prepared.rows.time_s
        number = ((time_s - time_s[0]) // PIECE_S).astype(np.intp) + first
        first = int(number[-1]) + 1
        numbers.append(number)
    return np.concatenate(numbers)

"""Columns of one log: what all logs share, what a healthy log may differ by, and every effect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import BoolArray, FloatArray, IntArray
from cangauge.diagnosis.pack_fit import PackFit, Trace, hats
from cangauge.diagnosis.trials import (
    STEP,
    Trial,
    additive_column,
    healthy_columns,
    residual,
    slope,
)

FOLDS, BLOCK_S = 4, 240
"""Interleaved blocks of a log that are held out in turn, and their length [s]: longer than the
correlation of the errors."""

PLACES = tuple(float(part) for part in np.arange(10) / 10)
"""Places of a resistance step, in parts of a log."""

COVER_PCT = 2.0
"""References cover SoC this far beyond their own [%]."""

MAX_OUTLIERS, OUTLIER = 5, 0.1
"""At most so many single rows, off by this part of the voltage, are faults of a bus and left out;
more are diagnosed."""

MIN_COVERED = 0.2
"""A log with less of its rows at SoC that references visit is judged on all of them."""


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns of one log on the rows that count, and their products."""

    log: Trace
    rows: IntArray
    """Rows of the trace that count, shape (m,)."""
    x: FloatArray
    """Shared structure, shape (m, p)."""
    b: FloatArray
    """What a healthy log may differ by, shape (m, 12)."""
    parts: FloatArray
    """Products of (x, b, effects, r) in each set of blocks, shape (folds, k, k)."""

    @property
    def products(self) -> FloatArray:
        """Products on all rows, shape (k, k)."""
        return np.asarray(self.parts.sum(axis=0))

    @property
    def fold(self) -> IntArray:
        """Set of blocks of each row that counts, shape (m,)."""
        return self.rows // BLOCK_S % FOLDS


def soc_covered(pack: PackFit, log: Trace, others: Sequence[Trace]) -> BoolArray:
    """Return the rows whose SoC other logs visit, all without other logs, shape (n,)."""
    s, covered = pack.soc(log), np.full(len(log.current_a), not others)
    for other in others:
        visited = pack.soc(other)
        covered |= (s >= visited.min() - COVER_PCT) & (s <= visited.max() + COVER_PCT)
    return covered


def rows_that_count(pack: PackFit, log: Trace, others: Sequence[Trace], r: FloatArray) -> IntArray:
    """Return measured rows whose SoC other logs visit; all measured rows if those are few.

    The residual r [V] shows single rows that no pack can have produced.
    """
    covered = log.measured & soc_covered(pack, log, others)
    if covered.sum() < MIN_COVERED * log.measured.sum():
        covered = log.measured.copy()
    outliers = np.flatnonzero(np.abs(r - np.median(r)) > OUTLIER * pack.volts)
    if 0 < outliers.size <= MAX_OUTLIERS:
        covered[outliers] = False
    return np.flatnonzero(covered)


def shared_columns(pack: PackFit, log: Trace) -> FloatArray:
    """Return the columns of θ on all rows of a log, shape (n, p)."""
    s = pack.soc(log)
    return np.column_stack([hats(s), pack.structure(log.current_a, s, log.temperature_c)])


def all_columns(pack: PackFit, log: Trace, trials: Sequence[Trial]) -> list[FloatArray]:
    """Return x, b, effects in units of their bounds, and r on all rows of a log."""
    r = residual(pack, log)
    effects = [slope(pack, log, trial, 0.0, r) * trial.bound for trial in trials]
    effects += [
        additive_column(pack, log, replace(STEP, shape=place)) * STEP.bound for place in PLACES
    ]
    return [
        shared_columns(pack, log),
        healthy_columns(pack, log, r),
        np.column_stack(effects),
        r[:, None],
    ]


def on_rows(
    log: Trace, columns: Sequence[FloatArray], rows: IntArray, folds: int = FOLDS
) -> Columns:
    """Return the columns of a log on some rows; in one part for a reference, never held out."""
    every = np.concatenate(columns, axis=1)[rows]
    return Columns(log, rows, columns[0][rows], columns[1][rows], in_blocks(every, rows, folds))


def in_blocks(columns: FloatArray, rows: IntArray, folds: int) -> FloatArray:
    """Return products of k columns in each set of blocks, shape (folds, k, k)."""
    fold = rows // BLOCK_S % folds
    blocks = [columns[fold == k] for k in range(folds)] if folds > 1 else [columns]
    return np.array([block.T @ block for block in blocks])


def without_own(products: FloatArray, log: Columns, s2: float) -> FloatArray:
    """Return products / s² of (x, effects, r) with the log's own deviations integrated out."""
    nx, nb = log.x.shape[1], log.b.shape[1]
    g, own = products / s2, slice(nx, nx + nb)
    others = np.r_[0:nx, nx + nb : len(g)]
    z = np.linalg.solve(np.linalg.cholesky(g[own, own] + np.eye(nb)), g[own][:, others])
    return np.asarray(g[np.ix_(others, others)] - z.T @ z, dtype=np.float64)


def squares(
    log: Columns, theta: NDArray[np.floating], column: int | None = None, a: float = 0.0
) -> float:
    """Return a log's sum of squares [V²] with θ and an effect's column; b remains in it."""
    w = np.zeros(log.parts.shape[1])
    w[: len(theta)], w[-1] = -theta, 1.0
    if column is not None:
        w[len(theta) + log.b.shape[1] + column] = -a
    return float(w @ log.products @ w)

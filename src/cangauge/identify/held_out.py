"""Which rows to fit on and which to judge on.

Several logs: whole logs are left out in turn. One or two logs: short interleaved blocks with a
guard between them, the first and the last block of each log always kept for the fit, since the
1/s⁴ terms explode beyond the SoC that they saw.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from cangauge.identify.rows import FitRows

Mask = NDArray[np.bool_]

LOGS_AT_LEAST = 3
FOLDS_AT_MOST = 12
BLOCK_S, GUARD_S = 240.0, 60.0
BLOCK_FOLDS = 5


def folds(logs: Sequence[FitRows]) -> Iterator[tuple[Mask, Mask]]:
    """Yield (fit on, judge on) masks over the rows of all logs, one after another."""
    owner = np.concatenate([np.full(len(rows), k) for k, rows in enumerate(logs)])
    if len(logs) >= LOGS_AT_LEAST:
        number = min(len(logs), FOLDS_AT_MOST)
        for fold in range(number):
            judged = owner % number == fold
            yield ~judged, judged
        return
    block, since = _blocks(logs)
    for fold in range(BLOCK_FOLDS):
        judged = block % BLOCK_FOLDS == fold
        edge = _edge_blocks(block, owner)
        core = judged & ~edge & (since >= GUARD_S) & (since < BLOCK_S - GUARD_S)
        if core.any():
            yield ~judged | edge, core


def _blocks(logs: Sequence[FitRows]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    number, since, first = [], [], 0
    for rows in logs:
        elapsed = rows.time_s - rows.time_s[0]
        number.append(first + (elapsed // BLOCK_S).astype(np.intp))
        since.append(elapsed % BLOCK_S)
        first = int(number[-1][-1]) + 1
    return np.concatenate(number), np.concatenate(since)


def _edge_blocks(block: NDArray[np.intp], owner: NDArray[np.intp]) -> Mask:
    edge = np.zeros(block.size, dtype=bool)
    for log in np.unique(owner):
        numbers = block[owner == log]
        edge |= (block == numbers[0]) | (block == numbers[-1])
    return edge

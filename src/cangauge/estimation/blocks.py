"""Blocks: the mean of the rows of 30 s, with which the voltage corrects the filter.

Blocks are counted in time from the first sample. A log's errors last for minutes, so rows of one
second repeat each other; a mean of 30 s holds all that they know.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cangauge.estimation.ekf import Block
from cangauge.estimation.state import BlockState


class OpenBlock:
    """Sums of the rows of the block that is being filled.

    Attributes
    ----------
    state : BlockState
    """

    def __init__(self) -> None:
        self.state = BlockState()

    def begin(self, number: int) -> None:
        """Begin the block of a number."""
        self.state = BlockState(number)

    def add(self, row: Block) -> None:
        """Add one row, given as a block of its own."""
        values = (*row[:5], *row.load.tolist(), *row.drives.tolist())
        state = self.state
        sums = state.sums or [0.0] * len(values)
        state.columns = row.load.size
        state.sums = [a + b for a, b in zip(sums, values, strict=True)]
        state.rows += 1

    def close(self) -> Block | None:
        """Return the means of the rows; None without rows, or with a gap among them."""
        state = self.state
        if state.is_broken or not state.rows:
            return None
        numbers, load, drives = np.split(np.array(state.sums) / state.rows, [5, 5 + state.columns])
        return Block._make([*numbers.tolist(), load, drives])

    def snapshot(self) -> BlockState:
        """Return a copy of the state."""
        return replace(self.state, sums=list(self.state.sums))

    def restore(self, state: BlockState) -> None:
        """Continue from a state."""
        self.state = replace(state, sums=list(state.sums))

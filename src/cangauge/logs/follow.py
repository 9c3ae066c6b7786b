"""Which column is a voltage: it moves when the current does, a temperature does not."""

from __future__ import annotations

from typing import Final

import numpy as np

from cangauge.logs.log import FloatArray

LARGE_SHARE: Final = 0.25
"""This part of the rows, those with the largest changes of current, is asked [-]."""
LEAST_ROWS: Final = 20
FOLLOWS: Final = 0.7
"""Agreement from which a column follows the current [-]: in real drives voltages agree by 0.89 and
more, temperatures by 0.01; under a constant current voltages agree by 0.6 at most."""


def follows_current(current_a: FloatArray, values: FloatArray) -> bool:
    """Whether a column's steps have the sign of the current's steps, or all the opposite one.

    Only signs count, so that neither a unit nor a few wrong rows matter. False where the current
    hardly changes, as in a cycler's discharge.

    Parameters
    ----------
    current_a, values : arrays of shape (n,)
        In any unit.
    """
    change = np.diff(current_a)
    size = np.abs(change)
    if size.size < LEAST_ROWS:
        return False
    large = (size >= np.quantile(size, 1.0 - LARGE_SHARE)) & (size > 0.0)
    if np.count_nonzero(large) < LEAST_ROWS:
        return False
    agreement = np.mean(np.sign(change[large]) * np.sign(np.diff(values)[large]))
    return bool(abs(agreement) >= FOLLOWS)

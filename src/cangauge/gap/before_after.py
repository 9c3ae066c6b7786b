"""Errors of the diagnosed logs, row by row: with the model as given and with the extended one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cangauge.gap.columns import Prepared, residual
from cangauge.gap.settle import Settled
from cangauge.model.extended import ExtendedModel

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LogErrors:
    """One diagnosed log; m rows at the model's rate."""

    prepared: Prepared
    before_v: FloatArray
    """Measured − model as given, shape (m,) [V]."""
    after_v: FloatArray
    """Measured, corrected by what the model knows of the sensors, − extended model [V]."""


def errors_before_and_after(settled: Settled, extended: ExtendedModel) -> list[LogErrors]:
    """Return the errors of every diagnosed log.

    Those after are of rows that the extended model was fitted on; how far the gap shrinks is
    judged on rows left out (`held_out`).

    Parameters
    ----------
    settled : Settled
    extended : ExtendedModel
        Of the diagnosis (`Extension.model`).
    """
    _, given = settled.given_errors_v
    return [
        LogErrors(terms.prepared, before, residual(terms.prepared, extended))
        for terms, before in zip(settled.diagnosed, given, strict=True)
    ]

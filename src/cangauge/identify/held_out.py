"""Errors of logs by fits without them: what a model file states of its error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cangauge._typing import FloatArray
from cangauge.identify.rows import FitRows


def comparable(rows: Sequence[FitRows], errors_v: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
    """Return the errors of left-out logs [V], NaN at a SoC that no other log reaches.

    Parameters
    ----------
    rows : sequence of FitRows
    errors_v : sequence of array of shape (m,)
        Error of each log by the model of the others [V]; empty for too few logs.
    """
    ends = np.array([(item.soc_pct.min(), item.soc_pct.max()) for item in rows])
    found = []
    for number, error_v in enumerate(errors_v):
        lows, highs = np.delete(ends, number, axis=0).T
        soc = rows[number].soc_pct
        found.append(np.where((soc >= lows.min()) & (soc <= highs.max()), error_v, np.nan))
    return tuple(found)


def stated_error(
    held_out_error_v: Sequence[FloatArray],
    rows: Sequence[FitRows],
    residual_v: float,
    mean_v: float,
) -> dict[str, Any]:
    """Return the error that a model file states: of left-out logs, or of the fit without any."""
    judged = sum(int(np.isfinite(error_v).sum()) for error_v in held_out_error_v)
    if not judged:
        return {
            "voltage_mae_pct": 100.0 * (2.0 / np.pi) ** 0.5 * residual_v / mean_v,
            "voltage_rmse_v": residual_v,
            "judged_on": "the rows of the fit itself (too few logs to leave one out)",
        }
    of_logs = list(zip(held_out_error_v, rows, strict=True))
    relative = sum(float(np.nansum(np.abs(error) / item.voltage_v)) for error, item in of_logs)
    square_v2 = sum(float(np.nansum(error_v**2)) for error_v in held_out_error_v)
    return {
        "voltage_mae_pct": 100.0 * relative / judged,
        "voltage_rmse_v": (square_v2 / judged) ** 0.5,
        "judged_on": "whole logs left out in turn",
    }

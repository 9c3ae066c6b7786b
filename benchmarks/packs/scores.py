"""Errors of SoC estimates: scored log by log, pooled to rows.

A log counts by its samples. Errors are of the SoC [%] against the log's reference.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

VALID = 1
"""Code of a valid estimate in the published frame."""
SETTLED_S = 300.0
"""An unknown start is scored after five minutes [s]."""
LATE_S = 600.0
"""A wrong start is scored after ten minutes; a log is astray by what follows [s]."""
COVER = 0.88
"""Least share of the time within 2σ."""
ASTRAY_PCT, ASTRAY_STD = 3.0, 3.0
"""A sample is wrong if off by more than this [% SoC] and by more than so many σ."""


@dataclass(frozen=True)
class LogScore:
    """Sums over the scored samples of one log in one case, by one draw's model."""

    log: str
    samples: int
    error: float
    square: float
    std: float
    covered: float
    newton: float
    counting: float
    late_wrong: float
    mismatch: bool
    errors: np.ndarray
    all_samples: int
    """Of the whole log, as the three that follow: an estimate is published from the beginning."""
    valid: float
    valid_wrong: float
    right_not_valid: float


def score(
    log: Any,
    soc_pct: np.ndarray,
    std_pct: np.ndarray,
    newton_pct: np.ndarray,
    counted_pct: np.ndarray,
    *,
    status: np.ndarray | None = None,
    after_s: float,
    mismatch: bool,
) -> LogScore:
    """Compare an estimate with the log's reference; the arrays have a value per row [%].

    Without status, as of an estimator that states no validity, nothing is valid.
    """
    since_s = log.time_s - log.time_s[0]
    error = np.abs(soc_pct - log.soc_pct)
    known = np.isfinite(error)
    use, late = known & (since_s >= after_s), known & (since_s >= LATE_S)
    wrong = (error > ASTRAY_PCT) & (error > ASTRAY_STD * std_pct)
    valid = np.zeros(known.size, bool) if status is None else known & (status == VALID)
    right = (error <= ASTRAY_PCT) & (error <= 2.0 * std_pct)

    def total(values) -> float:
        return float(np.nansum(values[use]))

    return LogScore(
        log.name, int(use.sum()), total(error), total(error**2), total(std_pct),
        total((error <= 2.0 * std_pct).astype(float)),
        total(np.abs(newton_pct - log.soc_pct)), total(np.abs(counted_pct - log.soc_pct)),
        float(wrong[late].mean()) if late.any() else 0.0, bool(mismatch), error[use],
        int(np.isfinite(log.soc_pct).sum()), float(valid.sum()), float((valid & wrong).sum()),
        float((right & ~valid).sum()),
    )  # fmt: skip


@dataclass
class Row:
    """Errors of a pack in one case by models of one number of logs, over all draws [% SoC]."""

    estimator: str
    pack: str
    size: int
    case: str
    logs: int
    mae: float
    median: float
    rmse: float
    cover: float
    std: float
    newton: float
    counting: float
    astray: int
    mismatches: int
    valid: float
    """Share of all samples, as the two that follow."""
    valid_wrong: float
    right_not_valid: float


def pool(scores: Iterable[LogScore], **names) -> Row:
    """Return the row of some logs' scores."""
    scores = list(scores)
    samples = max(sum(one.samples for one in scores), 1)

    def mean(name: str) -> float:
        return sum(getattr(one, name) for one in scores) / samples

    def share(name: str) -> float:
        return sum(getattr(one, name) for one in scores) / max(
            sum(one.all_samples for one in scores), 1
        )

    errors = np.concatenate([one.errors for one in scores])
    return Row(
        **names, logs=len(scores), mae=mean("error"), rmse=mean("square") ** 0.5,
        median=float(np.median(errors)) if errors.size else 0.0,
        cover=mean("covered"), std=mean("std"), newton=mean("newton"), counting=mean("counting"),
        astray=sum(one.late_wrong > 0.5 for one in scores),
        mismatches=sum(one.mismatch for one in scores),
        valid=share("valid"), valid_wrong=share("valid_wrong"),
        right_not_valid=share("right_not_valid"),
    )  # fmt: skip

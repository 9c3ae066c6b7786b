"""Size of an effect by simulation, on all rows or without those that are judged with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from cangauge._typing import BoolArray, FloatArray
from cangauge.diagnosis.evidence import Evidence
from cangauge.diagnosis.pack import RIDGE, Healthy, LogRows, total_s
from cangauge.diagnosis.shapes import Shape

STEPS, SHRINK, MIN_STEP, MIN_CHANGE = 6, 0.35, 1e-3, 0.02
"""Gauss–Newton: steps, the factor after one that lost evidence, and the steps at which it ends, in
units of the bound and relative to the size."""

SIMULATED_PART: Final = 0.15
"""Effects that change signals or the count are simulated from this part of the best one's
evidence: beyond a bend of the curve, a column at zero misjudges them."""

MOVE_SOC: Final = ("start", "capacity", "current_reading")
"""Faults that move the SoC: their effects are simulated always."""

FOLDS, BLOCK_S = 4, 240.0
"""Interleaved blocks of a log that are held out in turn, and their length [s]: longer than the
correlation of the errors; less in a short log, which has one block of each."""


class SizeProfile:
    """Likelihood of the size of one effect in some logs, δ and the logs' deviations integrated out.

    Sizes are in units of the larger bound of the effect's shape.

    Parameters
    ----------
    healthy : Healthy
    logs : sequence of LogRows
    inside : sequence of BoolArray
        The rows that count of each log, among those kept.
    """

    def __init__(
        self, healthy: Healthy, logs: Sequence[LogRows], inside: Sequence[BoolArray]
    ) -> None:
        self._healthy, self._logs, self._parts = healthy, logs, []
        known = healthy.delta.table.T @ healthy.delta.table
        n = size = healthy.n
        for k, rows in enumerate(inside):
            if rows.any():
                m = logs[k].m
                X = logs[k].columns[rows, : m + n] / np.sqrt(healthy.s2)
                self._parts.append((k, rows, X, np.r_[size : size + m, :n]))
                size += m
        precision, self._right = np.eye(size), np.zeros((size, 2))
        precision[:n, :n], self._right[:n, 1] = known[:-1, :-1], known[:-1, -1]
        for _, _, X, at in self._parts:
            precision[np.ix_(at, at)] += X.T @ X
        self._root = np.linalg.cholesky(precision)

    def about(self, evidence: Evidence, size: float) -> tuple[float, float, float, float]:
        """Return χ² about a size, its gradient and curvature, and the error that is left [V²]."""
        products, right, residuals = np.zeros((2, 2)), self._right.copy(), []
        for k, rows, X, at in self._parts:
            log = self._logs[k]
            vectors, soc = self._residuals(evidence.shapes[k], log, size)
            v = vectors[rows] * np.sqrt(log.trace.row_s / self._healthy.s2)
            products += v.T @ v + np.outer(soc, soc)
            right[at] += X.T @ v
            residuals.append(v[:, 1])
        half = np.linalg.solve(self._root, right)
        left = products - half.T @ half
        n = self._healthy.n
        delta = np.linalg.solve(self._root.T, half[:, 1])[:n]
        square = sum(
            float(np.sum((v - X[:, -n:] @ delta) ** 2))
            for v, (_, _, X, _) in zip(residuals, self._parts, strict=True)
        )
        left_v2 = square * self._healthy.s2 / total_s([self._logs[k] for k, *_ in self._parts])
        return float(left[1, 1]), float(left[0, 1]), max(float(left[0, 0]), 1e-9), left_v2

    def _residuals(
        self, shape: Shape | None, log: LogRows, size: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return slope and residual about a size on the rows kept, and the same of the own SoC.

        The slope has the sign of a column.
        """
        found, change = [log.simulated.plain] * 2, 1.0
        if shape is not None:
            step = abs(shape.about) / shape.bound
            low, high = shape.low / shape.bound, shape.high / shape.bound
            beyond = size + step if size + step <= high else max(size - step, low)
            change = beyond - size
            for k, each in enumerate((size, beyond)):
                if each:
                    values = shape.values(each * shape.bound)
                    found[k] = log.simulated.with_effect(shape.effect, values)
        here_v, there_v = (each.residual_v[log.kept] for each in found)
        here, there = (self._healthy.own_soc(log, each.soc_pct) for each in found)
        slope = np.column_stack([(here_v - there_v) / change, here_v])
        return slope, np.array([(here - there) / change, here])

    def _next(
        self, evidence: Evidence, size: float, here: tuple[float, float, float, float]
    ) -> float:
        """Return the size after a Gauss–Newton step from what `about` returned of one."""
        _, gradient, curvature, _ = here
        change = (gradient - RIDGE * size) / (curvature + RIDGE)
        return float(np.clip(size + change, *evidence.bounds))

    def sized(self, evidence: Evidence) -> float:
        """Return the size by these rows [unit of the shape], a step from that of the evidence."""
        size = evidence.size / evidence.shape.bound
        return self._next(evidence, size, self.about(evidence, size)) * evidence.shape.bound

    def largest(self, evidence: Evidence, starts: Sequence[float]) -> Evidence:
        """Return the evidence at the most probable size, from the best of several starts.

        A size of zero has no evidence.
        """
        size, here = 0.0, self.about(evidence, 0.0)
        without, over = here[0], self._healthy.excess[evidence.shape.effect.id]
        tried = {start: self.about(evidence, start) for start in starts if abs(start) >= MIN_STEP}
        step = min(tried, key=tried.__getitem__, default=0.0)
        for _ in range(STEPS):
            if abs(step) < MIN_STEP:
                break
            there = tried.get(size + step) or self.about(evidence, size + step)
            if there[0] >= here[0]:
                step *= SHRINK
                continue
            size, here = size + step, there
            step = self._next(evidence, size, here) - size
            if abs(step) < MIN_CHANGE * abs(size):
                break
        chi2, _, curvature, left_v2 = here
        bound = evidence.shape.bound
        return replace(
            evidence,
            size=size * bound,
            std=float(np.sqrt(over / (curvature + RIDGE))) * bound,
            nats=0.5 * (without - chi2),
            left_v2=left_v2,
        )


def sized_by_simulation(
    healthy: Healthy, logs: Sequence[LogRows], evidence: dict[str, Evidence]
) -> dict[str, Evidence]:
    """Return the evidence with effects on signals and count simulated at their sizes."""
    most = max(e.nats for e in evidence.values())
    profile, found = SizeProfile(healthy, logs, _every(logs)), dict(evidence)
    for name, e in evidence.items():
        is_likely = e.nats > SIMULATED_PART * most
        shape = e.shape
        if shape.effect.adds_voltage or not (is_likely or e.fault in MOVE_SOC):
            continue
        starts = [e.size / shape.bound]
        if e.fault == "start":  # it moves all rows at once, beyond a bend of the curve
            starts += [part * end for end in e.bounds for part in (0.5, 1.0)]
        if shape.effect.moves_time and 0.0 in (shape.low, shape.high):  # a secant
            starts.append(shape.about / shape.bound)
        found[name] = profile.largest(e, starts)
    return found


def _every(logs: Sequence[LogRows]) -> list[BoolArray]:
    return [np.ones(log.kept.size, dtype=bool) for log in logs]


def folds(healthy: Healthy, logs: Sequence[LogRows]) -> list[tuple[SizeProfile, list[BoolArray]]]:
    """Return sets of rows that are judged together, each with the profile of sizes without them.

    One log of several in turn; of a single log, one set of blocks.
    """
    every = _every(logs)
    if len(logs) > 1:
        judged = [[rows & (k == j) for k, rows in enumerate(every)] for j in range(len(logs))]
    else:
        (log,) = logs
        time_s = log.trace.log.time_s[log.trace.rows][log.kept]
        block_s = min(BLOCK_S, (time_s[-1] - time_s[0]) / FOLDS + 1.0)
        fold = ((time_s - time_s[0]) // block_s).astype(np.intp) % FOLDS
        judged = [[fold == k] for k in range(FOLDS)]
    return [(SizeProfile(healthy, logs, [~rows for rows in part]), part) for part in judged]

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

START_PARTS: Final = (0.5, 1.0)
"""Parts of its bounds from which a wrong start is simulated: it moves all rows at once, beyond a
bend of the curve."""

FOLDS, BLOCK_S = 4, 240.0
"""Interleaved blocks of a log that are held out in turn, and their length [s]: longer than the
correlation of the errors."""


class SizeProfile:
    """Likelihood of the size of one effect in some logs, δ and the logs' deviations integrated out.

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
        self._healthy, self._logs, self._inside = healthy, logs, inside
        self._numbers = [k for k, rows in enumerate(inside) if rows.any()]
        n, known = healthy.n, healthy.known.table
        size = n + sum(logs[k].m for k in self._numbers)
        precision = np.eye(size)
        precision[:n, :n] = known[:, :-1].T @ known[:, :-1]
        self._right = np.zeros((size, 2))
        self._right[:n, 1] = known[:, :-1].T @ known[:, -1]
        self._X, self._at, first = {}, {}, n
        for k in self._numbers:
            m = logs[k].m
            X = logs[k].columns[inside[k], : m + n] / np.sqrt(healthy.s2)
            at = np.r_[first : first + m, :n]
            precision[np.ix_(at, at)] += X.T @ X
            self._X[k], self._at[k], first = X, at, first + m
        self._root = np.linalg.cholesky(precision)

    def about(self, evidence: Evidence, size: float) -> tuple[float, float, float, float]:
        """Return χ² about a size [bounds], its gradient and curvature, and the error left [V²]."""
        products, right, volts = np.zeros((2, 2)), self._right.copy(), {}
        for k in self._numbers:
            log, rows = self._logs[k], self._inside[k]
            vectors, row = self._residuals(evidence.shape_in(k, log), log, size)
            weight = np.sqrt(log.trace.weights[log.kept][rows] / self._healthy.s2)
            v = vectors[rows] * weight[:, None]
            products += v.T @ v + np.outer(row, row)
            right[self._at[k]] += self._X[k].T @ v
            volts[k] = v[:, 1]
        half = np.linalg.solve(self._root, right)
        left = products - half.T @ half
        n = self._healthy.n
        delta = np.linalg.solve(self._root.T, half[:, 1])[:n]
        square = sum(float(np.sum((v - self._X[k][:, -n:] @ delta) ** 2)) for k, v in volts.items())
        left_v2 = square * self._healthy.s2 / total_s([self._logs[k] for k in self._numbers])
        return float(left[1, 1]), float(left[0, 1]), max(float(left[0, 0]), 1e-9), left_v2

    def _residuals(
        self, shape: Shape | None, log: LogRows, size: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return slope and residual about a size on the rows kept, and the same of the own SoC.

        The slope is per bound, with the sign of a column.
        """
        plain = log.of.plain
        if shape is None:
            residual_v = plain.residual_v[log.kept]
            row, _ = self._healthy.own_soc(log, plain.soc_pct)
            return np.column_stack([np.zeros_like(residual_v), residual_v]), np.array([0.0, row])
        step = abs(shape.about) / shape.bound
        low, high = shape.low / shape.bound, shape.high / shape.bound
        beyond = size + step if size + step <= high else size - step
        beyond = min(max(beyond, low), high)
        found = [
            log.of.with_effect(shape.effect, shape.values(each * shape.bound)) if each else plain
            for each in (size, beyond)
        ]
        here, there = (each.residual_v[log.kept] for each in found)
        rows = [self._healthy.own_soc(log, each.soc_pct)[0] for each in found]
        change = beyond - size
        slope = np.column_stack([(here - there) / change, here])
        return slope, np.array([(rows[0] - rows[1]) / change, rows[0]])

    def newton(self, evidence: Evidence, size: float) -> float:
        """Return the size after one step from a size found with all rows [bounds]."""
        _, gradient, curvature, _ = self.about(evidence, size)
        change = (gradient - RIDGE * size) / (curvature + RIDGE)
        return float(np.clip(size + change, *evidence.bounds))

    def largest(self, evidence: Evidence, starts: Sequence[float]) -> Evidence:
        """Return the evidence at the most probable size, from the best of several starts [bounds].

        A size of zero has no evidence.
        """
        size, here = 0.0, self.about(evidence, 0.0)
        without, over = here[0], self._healthy.excess_of(evidence.shape.effect.id)
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
            change = (here[1] - RIDGE * size) / (here[2] + RIDGE)
            step = float(np.clip(size + change, *evidence.bounds)) - size
            if abs(step) < MIN_CHANGE * abs(size):
                break
        chi2, _, curvature, left_v2 = here
        bound = evidence.shape.bound
        return replace(
            evidence,
            size=size * bound,
            std=float(np.sqrt(over / (curvature + RIDGE))) * bound,
            nats=0.5 * (without - chi2) / over,
            left_v2=left_v2,
        )


def simulated(
    healthy: Healthy, logs: Sequence[LogRows], evidence: dict[str, Evidence]
) -> dict[str, Evidence]:
    """Return the evidence with effects on signals and count simulated at their sizes."""
    nats = {name: e.nats * healthy.excess_of(name) for name, e in evidence.items()}
    profile, found = SizeProfile(healthy, logs, _every(logs)), dict(evidence)
    for name, e in evidence.items():
        is_likely = nats[name] > SIMULATED_PART * max(nats.values())
        if e.shape.effect.adds_voltage or not (is_likely or e.fault in MOVE_SOC):
            continue
        bound = e.shape.bound
        starts = [e.size / bound]
        if e.fault == "start":
            starts += [part * end for end in e.bounds for part in START_PARTS]
        if e.shape.effect.moves_time and not e.shape.is_tangent:
            starts.append(e.shape.about / bound)
        found[name] = profile.largest(e, starts)
    return found


def _every(logs: Sequence[LogRows]) -> list[BoolArray]:
    return [np.ones(log.kept.size, dtype=bool) for log in logs]


def held_out(
    healthy: Healthy, logs: Sequence[LogRows]
) -> list[tuple[SizeProfile, list[BoolArray]]]:
    """Return the rows that are judged together, with the profile of sizes without them.

    One log of several in turn; of a single log, one set of blocks.
    """
    every = _every(logs)
    if len(logs) > 1:
        judged = [[rows & (k == j) for k, rows in enumerate(every)] for j in range(len(logs))]
    else:
        (log,) = logs
        time_s = log.trace.log.time_s[log.trace.rows][log.kept]
        fold = ((time_s - time_s[0]) // BLOCK_S).astype(np.intp) % FOLDS
        judged = [[fold == k] for k in range(FOLDS)]
    return [(SizeProfile(healthy, logs, [~rows for rows in part]), part) for part in judged]

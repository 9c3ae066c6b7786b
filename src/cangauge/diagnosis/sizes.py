"""Size of an effect by simulation, on all rows or without those that are judged with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from cangauge._typing import BoolArray, FloatArray
from cangauge.diagnosis.evidence import EffectEvidence, Evidence, soc_row
from cangauge.diagnosis.pack import RIDGE, Healthy, LogRows
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


def shape_in_log(evidence: EffectEvidence, number: int, log: LogRows) -> Shape | None:
    """Return the shape in one of the diagnosed logs; None before a step of resistance."""
    part = evidence.in_logs[number]
    if part is None or evidence.shape.place is None:
        return None if part is None else evidence.shape
    return evidence.shape.at(part, log.trace.log.duration_s)


class _Block:
    """One log with δ and its own deviations, on some of its rows."""

    def __init__(self, healthy: Healthy, log: LogRows, inside: BoolArray | None) -> None:
        self.log = log
        self.inside = np.ones(log.kept.size, dtype=bool) if inside is None else inside
        self._weight = np.sqrt(log.trace.weights[log.kept][self.inside] / healthy.s2)
        own, delta = healthy.fixed_columns(log)
        noise = np.sqrt(healthy.s2)
        self._own, self._delta = own[self.inside] / noise, delta[self.inside] / noise
        self._root = np.linalg.cholesky(self._own.T @ self._own + np.eye(own.shape[1]))
        self._of_delta = np.linalg.solve(self._root, self._own.T @ self._delta)
        self.precision = self._delta.T @ self._delta - self._of_delta.T @ self._of_delta

    def products(self, vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the products of some vectors over all kept rows, and those with δ."""
        v = vectors[self.inside] * self._weight[:, None]
        of_own = np.linalg.solve(self._root, self._own.T @ v)
        return v.T @ v - of_own.T @ of_own, self._delta.T @ v - self._of_delta.T @ of_own

    def square(self, residual_v: FloatArray, delta: FloatArray) -> float:
        """Return the sum of squares of a residual less δ, in noise variances."""
        left = residual_v[self.inside] * self._weight - self._delta @ delta
        return float(left @ left)


@dataclass(frozen=True)
class _About:
    """Likelihood of a size about one."""

    chi2: float
    gradient: float
    curvature: float
    delta: FloatArray
    residuals: list[FloatArray]


class SizeProfile:
    """Likelihood of the size of one effect in some logs, everything else integrated out.

    Parameters
    ----------
    healthy : Healthy
    logs : sequence of LogRows
    numbers : sequence of int
        The logs that count.
    inside : sequence of BoolArray, optional
        The kept rows of each that count.
    """

    def __init__(
        self,
        healthy: Healthy,
        logs: Sequence[LogRows],
        numbers: Sequence[int],
        inside: Sequence[BoolArray] | None = None,
    ) -> None:
        self._healthy, self._numbers = healthy, list(numbers)
        self._blocks = [
            _Block(healthy, logs[k], None if inside is None else inside[k]) for k in self._numbers
        ]
        known = healthy.known.table
        self._right = known[:, :-1].T @ known[:, -1]
        precision = known[:, :-1].T @ known[:, :-1]
        precision = precision + sum(block.precision for block in self._blocks)
        self._root = np.linalg.cholesky(precision)

    def about(self, evidence: EffectEvidence, size: float) -> _About:
        """Return the likelihood about a size [bounds]."""
        products, right = np.zeros((2, 2)), np.zeros((self._right.size, 2))
        residuals = []
        right[:, 1] = self._right
        for number, block in zip(self._numbers, self._blocks, strict=True):
            shape = shape_in_log(evidence, number, block.log)
            vectors, row = _residuals(self._healthy, block.log, shape, size)
            own, delta = block.products(vectors)
            products += own + np.outer(row, row)
            right += delta
            residuals.append(vectors[:, 1])
        half = np.linalg.solve(self._root, right)
        left = products - half.T @ half
        return _About(
            float(left[1, 1]),
            float(left[0, 1]),
            max(float(left[0, 0]), 1e-9),
            np.linalg.solve(self._root.T, half[:, 1]),
            residuals,
        )

    def left_v2(self, at: _About) -> float:
        """Return the mean square error that remains about a size [V²]."""
        blocks = zip(self._blocks, at.residuals, strict=True)
        square = sum(block.square(residual_v, at.delta) for block, residual_v in blocks)
        seconds = sum(block.log.seconds for block in self._blocks)
        return square * self._healthy.s2 / seconds

    def newton(self, evidence: EffectEvidence, size: float) -> float:
        """Return the size after one step from a size found with all rows [bounds]."""
        there = self.about(evidence, size)
        change = (there.gradient - RIDGE * size) / (there.curvature + RIDGE)
        low, high = evidence.bounds
        return float(np.clip(size + change, low, high))

    def largest(self, evidence: EffectEvidence, starts: Sequence[float]) -> tuple[float, _About]:
        """Return the most probable size [bounds], from the best of several starts."""
        low, high = evidence.bounds
        size, here = 0.0, self.about(evidence, 0.0)
        tried = {start: self.about(evidence, start) for start in starts if abs(start) >= MIN_STEP}
        step = min(tried, key=lambda start: tried[start].chi2, default=0.0)
        for _ in range(STEPS):
            if abs(step) < MIN_STEP:
                break
            there = tried.get(size + step) or self.about(evidence, size + step)
            if there.chi2 >= here.chi2:
                step *= SHRINK
                continue
            size, here = size + step, there
            change = (here.gradient - RIDGE * size) / (here.curvature + RIDGE)
            step = float(np.clip(size + change, low, high)) - size
            if abs(step) < MIN_CHANGE * abs(size):
                break
        return size, here


def _residuals(
    healthy: Healthy, log: LogRows, shape: Shape | None, size: float
) -> tuple[FloatArray, FloatArray]:
    """Return slope and residual about a size on the rows that count, and the same of its SoC row.

    The slope is per bound, with the sign of a column.
    """
    plain = log.of.plain
    if shape is None:
        residual_v = plain.residual_v[log.kept]
        row = soc_row(healthy, log, plain.soc_pct)
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
    rows = [soc_row(healthy, log, each.soc_pct) for each in found]
    change = beyond - size
    slope = np.column_stack([(here - there) / change, here])
    return slope, np.array([(rows[0] - rows[1]) / change, rows[0]])


def simulated(healthy: Healthy, logs: Sequence[LogRows], evidence: Evidence) -> Evidence:
    """Return the evidence with effects on signals and count simulated at their sizes."""
    best = max(e.nats * healthy.excess_of(name) for name, e in evidence.effects.items())
    profile, found = None, dict(evidence.effects)
    for name, e in evidence.effects.items():
        over = healthy.excess_of(name)
        effect = e.shape.effect
        likely = e.nats * over > SIMULATED_PART * best
        if effect.adds_voltage or not (likely or effect.fault in MOVE_SOC):
            continue
        if profile is None:
            profile = SizeProfile(healthy, logs, range(len(logs)))
        found[name] = _simulated(profile, e, over)
    return replace(evidence, effects=found)


def _simulated(profile: SizeProfile, evidence: EffectEvidence, over: float) -> EffectEvidence:
    bound = evidence.shape.bound
    low, high = evidence.bounds
    starts = [evidence.size / bound]
    if evidence.shape.effect.fault == "start":
        starts += [part * end for end in (low, high) for part in START_PARTS]
    if evidence.shape.effect.moves_time and not evidence.shape.is_tangent:
        starts.append(evidence.shape.about / bound)
    without = profile.about(evidence, 0.0).chi2
    size, at = profile.largest(evidence, starts)
    nats = 0.5 * (without - at.chi2)
    return replace(
        evidence,
        size=size * bound,
        std=float(np.sqrt(over / (at.curvature + RIDGE))) * bound,
        nats=nats / over,
        left_v2=profile.left_v2(at),
    )


class HeldOut:
    """Sizes of effects for the rows of some logs, found without these rows.

    Without their log where there are two or more, else without their set of blocks.
    """

    def __init__(self, healthy: Healthy, logs: Sequence[LogRows]) -> None:
        self._logs = logs
        numbers = range(len(logs))
        if len(logs) > 1:
            self._parts = [np.full(log.kept.size, k) for k, log in enumerate(logs)]
            self._without = [
                SizeProfile(healthy, logs, [k for k in numbers if k != left]) for left in numbers
            ]
            return
        (log,) = logs
        time_s = log.trace.log.time_s[log.trace.rows][log.kept]
        fold = ((time_s - time_s[0]) // BLOCK_S).astype(np.intp) % FOLDS
        self._parts = [fold]
        self._without = [SizeProfile(healthy, logs, [0], [fold != k]) for k in range(FOLDS)]

    def sizes(self, evidence: EffectEvidence) -> list[FloatArray]:
        """Return the size of an effect for each row that counts of each log."""
        bound = evidence.shape.bound
        size = evidence.size / bound
        found = np.array([part.newton(evidence, size) for part in self._without]) * bound
        return [found[part] for part in self._parts]

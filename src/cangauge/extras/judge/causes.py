"""Causes of a gauge's error, their prior sizes, and the evidence of each.

A cause is one or more signatures: a direction in the columns of `chain`, from a moment on, with a
size of normal prior N(0, σ²). All else is integrated out, so that the Bayes factor of a signature
with gradient g and curvature K is exact (linear Gaussian model; Bishop, Pattern Recognition and
Machine Learning, 2006, sec. 3.4):

    ln B = ½·g²/(K + 1/σ²) − ½·ln(1 + σ²·K),        size = N(g/(K + 1/σ²), 1/(K + 1/σ²))

The voltage is linearised for each cause at the SoC that the cause itself implies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from cangauge._typing import FloatArray
from cangauge.extras.judge.chain import (
    BY_VOLTAGE,
    CAPACITY,
    COUNT_OFFSET,
    COUNT_SCALE,
    ERROR,
    FUNCTIONS,
    GAUGES,
    LEVEL,
    OFFSET,
    START,
    STEP,
    VOLTAGE,
    VOLTAGE_SCALES,
    Chain,
    Design,
    GaugeNoise,
    Stretch,
)

UNITS: Final = {
    "current_offset": "A", "count_scale": "%", "pack_capacity": "%", "start_or_reset": "% SoC",
    "voltage_sensor": "%", "model_capacity": "%",
}  # fmt: skip
"""Causes that the pack's signals can show, and the unit of their size."""
NAMES: Final = ("none", "unknown", *UNITS)
RIGHT: Final = ("none", "model_capacity")
"""Answers in which the gauge is right; in the second, the pack has aged and the gauge knows it."""

LEAST_SHARE: Final = 0.01
"""Least probability of a signature within its answer whose SoC is mixed in."""
PRIOR_NONE: Final = 0.5
"""Prior probability that the gauge is right: whoever asks has a reason. The other answers share
the rest alike."""
LOCAL: Final = [START, LEVEL, ERROR, STEP, COUNT_OFFSET, COUNT_SCALE]
"""Columns with a size of their own in each stretch."""
FREE_PCT: Final = 60.0
"""Standard deviation of the SoC at the start of a stretch [%]: unknown."""
UNKNOWN_PCT: Final = 8.0
"""Difference of the gauge's error between stretches under `unknown` [% SoC]."""
ITERATIONS: Final = 8
"""Linearisations at most, …"""
DAMPING: Final = 0.6
"""… each this part of the way, since the slope of a curve jumps between its features, …"""
SETTLED_PCT: Final = 0.1
"""… until no SoC moves by more [%]."""
STRAYS: Final = 0.05
"""Prior probability that a gauge strays further on a stretch than it usually does: a trip in
twenty has a balancing, a reset or lost frames in it."""
WINDOW_PCT: Final = 5.0
"""Standard deviation of the zero of a gauge beside the typical oxide cell [% SoC]: cars show the
usable part of a pack, which leaves up to a tenth of the cells' charge at either end. A gauge of LFP
cells is set to 100 % at the end of a charge."""

Point = tuple[int, int]
"""Sizes of the noise of voltage and gauge: places in `VOLTAGE_SCALES` and `GAUGES`."""
GRID: Final[list[Point]] = [(v, y) for v in range(len(VOLTAGE_SCALES)) for y in range(len(GAUGES))]
"""All of them, equally likely before the logs."""


@dataclass(frozen=True)
class Priors:
    """Standard deviations of what healthy packs and gauges show, and of faults.

    Parameters
    ----------
    capacity_ah : float
        [Ah].
    capacity_std_pct : float
        Of the capacity, as it was stated [%].
    zero_std_pct : float
        Of the gauge's own zero beside the model's [% SoC].
    """

    capacity_ah: float
    capacity_std_pct: float = 1.5
    zero_std_pct: float = 0.5

    def healthy(self, gauge: GaugeNoise) -> dict[int, float]:
        """Return what is the same in all stretches of a healthy pack, by column."""
        return {
            LEVEL: 0.5,  # half of what differs from log to log does not average out over days
            ERROR: self.zero_std_pct,
            COUNT_OFFSET: gauge.drift_pct * self.capacity_ah / 100.0,  # [A]
            COUNT_SCALE: max(gauge.scale_pct, self.capacity_std_pct / 4.0),
            OFFSET: self.capacity_ah / 400.0,  # 0.15 A at 60 Ah [A]
            CAPACITY: self.capacity_std_pct,
            BY_VOLTAGE: gauge.error_pct / 8.0,  # the same in volts at a usual slope [%]
            VOLTAGE: 0.1,  # data sheets of stack monitors, with wiring [%]
        }

    def fault(self, cause: str) -> float:
        """Return the standard deviation of a fault's size, in `UNITS`; 1 for no cause."""
        return {
            "current_offset": self.capacity_ah / 25.0,  # 1 % of a sensor's range of 4 C
            "count_scale": 5.0,  # a wrong capacity in the gauge's configuration, or gain
            "pack_capacity": 6.0,  # what ageing takes between two updates of a gauge
            "start_or_reset": 10.0,
            "voltage_sensor": 1.5,
            "model_capacity": 5.0,  # as `count_scale`: only the voltage separates the two
        }.get(cause, 1.0)


class Signature(NamedTuple):
    """A cause as a direction in the columns."""

    onset: int
    """First stretch that it holds in."""
    inside: bool
    """Whether it begins at the step within that stretch."""
    weight: float
    """Prior probability within its cause."""
    columns: FloatArray
    """Coefficients in each stretch, shape (L, columns)."""


def signatures_of(  # noqa: C901 - a table of causes
    name: str, hours: FloatArray, starts: FloatArray, columns: int, capacity_ah: float
) -> list[Signature]:
    """Return the signatures of an answer; of `none` and `unknown` an empty one.

    Parameters
    ----------
    name : str
    hours, starts : array of shape (L,)
        Duration of each stretch [h], and the SoC at its start [%].
    columns : int
        Number of columns.
    capacity_ah : float
        [Ah].
    """
    L = len(hours)
    if name not in UNITS:
        # An error that differs between stretches needs some: of one it is that of the start.
        weight = 1.0 if name == "none" else max(1.0 - 1.0 / L, 1e-9)
        return [Signature(0, False, weight, np.zeros((L, columns)))]
    counted_h = np.concatenate(([0.0], np.cumsum(hours)[:-1]))
    one = np.ones(L)
    result = []

    def add(m: int, weight: float, parts: dict[int, FloatArray], *, inside: bool = False) -> None:
        table = np.zeros((L, columns))
        for column, value in parts.items():
            table[m:, column] = value[m:]
        result.append(Signature(m, inside, weight, table))

    for m in range(L):
        begins = 1.0 if L == 1 else 0.5 if m == 0 else 0.5 / (L - 1)  # half of it before all
        if name == "current_offset":
            grown = -100.0 / capacity_ah * (counted_h - counted_h[m])
            for column in (OFFSET, COUNT_OFFSET):  # in the sensor, or in the count alone
                add(m, 0.35 * begins, {column: one, ERROR: grown})
                add(m, 0.15 * begins, {column: one})  # the gauge corrects itself when parked
        elif name == "start_or_reset":
            here = np.eye(L)[m]
            add(m, 0.8 * begins, {ERROR: one})
            add(m, 0.2 / L, {STEP: here, ERROR: one - here}, inside=True)
        elif name == "voltage_sensor":
            add(m, 0.6 * begins, {VOLTAGE: one})  # as logged; the gauge counts
            if m == 0:
                add(m, 0.4, {BY_VOLTAGE: one})  # in a gauge that reads the voltage
    if name in {"count_scale", "pack_capacity"}:  # not of one day to the next
        column = COUNT_SCALE if name == "count_scale" else CAPACITY
        add(0, 0.4, {column: one, ERROR: (starts - starts[0]) / 100.0})
        add(0, 0.3, {column: one, ERROR: (starts - 100.0) / 100.0})  # right when full
        add(0, 0.3, {column: one})
    elif name == "model_capacity":  # the gauge counts with what the pack has
        # Seldom: a model is of the pack as it is. Chosen on i3_dev, twin_lfp and aged packs.
        add(0, 0.01, {CAPACITY: one, COUNT_SCALE: -one})
    return result


class Track(NamedTuple):
    """SoC of a stretch and its standard deviation at each block [%]."""

    soc_pct: FloatArray
    std_pct: FloatArray


def mixture(tracks: Sequence[Track], share: FloatArray) -> Track:
    """Return mean and standard deviation of the SoC over tracks of some probability each."""
    soc = np.array([track.soc_pct for track in tracks])
    var = np.array([track.std_pct for track in tracks]) ** 2
    mean = share @ soc
    return Track(mean, np.sqrt(share @ (var + (soc - mean) ** 2)))


class Sums(NamedTuple):
    """Sums of all stretches with the local columns integrated out, and what brings them back."""

    gram: FloatArray
    """Shape (L, columns + 1, columns + 1)."""
    inverse: FloatArray
    """A⁻¹ of the local columns, shape (L, local, local)."""
    back: FloatArray
    """A⁻¹·M, shape (L, local, columns + 1)."""
    at: list[int]
    """Shared columns, …"""
    precision: FloatArray
    """… their precision …"""
    gradient: FloatArray
    """… and gradient."""
    log_evidence: float


class Weighed(NamedTuple):
    """All signatures of an answer at one size of the noise; arrays of shape (signatures,)."""

    log_evidence: FloatArray
    size: FloatArray
    variance: FloatArray
    sums: Sums


@dataclass(frozen=True, eq=False)
class Explanation:
    """One answer, with all that follows from it.

    Attributes
    ----------
    name : str
        `none`, `unknown` or a cause.
    log_evidence : float
        With the prior of the answer.
    signatures : list of Signature
    share, size, std : array of shape (signatures,)
        Probability of each within the answer; its size and standard deviation.
    tracks : list of Track
        SoC of each stretch over all signatures; where the gauge is `RIGHT`, as if its zero were
        free, so that the gauge does not confirm itself.
    sums : Sums
    point : Point
        Sums at the likeliest sizes of the noise, and which those are.
    functions, covariance : array of shape (c,), (c, c)
        Principal functions of the curve after the logs.
    """

    name: str
    log_evidence: float
    signatures: list[Signature]
    share: FloatArray
    size: FloatArray
    std: FloatArray
    tracks: list[Track]
    sums: Sums
    point: Point
    functions: FloatArray
    covariance: FloatArray

    @property
    def best(self) -> int:
        """Number of the most probable signature."""
        return int(np.argmax(self.share))


def explain(chain: Chain, priors: Priors) -> list[Explanation]:
    """Return all answers, each linearised at its own SoC."""
    stretches, result = chain.stretches, list[Explanation]()
    for name in NAMES:
        points, linear = GRID, [part.fitting_pct for part in stretches]
        for _ in range(ITERATIONS):
            designs = [chain.design(*of) for of in zip(stretches, linear, strict=True)]
            answer = Answer(name, stretches, designs, priors)
            explanation = answer.explanation(points)
            points = [explanation.point]
            steps = [
                np.clip(track.soc_pct, -3.0, 103.0) - soc_pct
                for track, soc_pct in zip(explanation.tracks, linear, strict=True)
            ]
            if max(float(np.abs(step).max()) for step in steps) < SETTLED_PCT:
                break
            linear = [a + DAMPING * step for a, step in zip(linear, steps, strict=True)]
        explanation = answer.explanation(GRID)
        explanation = replace(explanation, tracks=answer.mixed_tracks(explanation))
        if name != "none":
            # The null hypothesis may use any linearisation: no curvature accuses a gauge.
            null = Answer("none", stretches, designs, priors).explanation(GRID).log_evidence
            result[0] = replace(result[0], log_evidence=max(result[0].log_evidence, null))
        result.append(explanation)
    return result


class Answer:
    """An answer at one linearisation.

    Parameters
    ----------
    name : str
    stretches : sequence of Stretch
    designs : sequence of Design
        Of each stretch.
    priors : Priors
    """

    def __init__(
        self, name: str, stretches: Sequence[Stretch], designs: Sequence[Design], priors: Priors
    ) -> None:
        self._name, self._priors, self._std = name, priors, priors.fault(name)
        self._stretches, self._designs = stretches, designs
        self._columns = designs[0].gauge[0].shape[0] - 1
        hours = np.array([part.hours[-1] for part in stretches])
        starts = np.array([design.start_pct for design in designs])
        self._signatures = signatures_of(name, hours, starts, self._columns, priors.capacity_ah)

    def explanation(self, points: Sequence[Point]) -> Explanation:
        """Return the explanation, with the noise integrated over some points."""
        weighed = [self._weighed(point) for point in points]
        table = np.array([of_point.log_evidence for of_point in weighed])
        sizes = np.array([of_point.size for of_point in weighed])
        variances = np.array([of_point.variance for of_point in weighed])
        top = float(table.max())
        weights = np.exp(table - top)
        share = weights.sum(axis=0)
        within = np.exp(table - table.max(axis=0))
        within /= within.sum(axis=0)
        size = (within * sizes).sum(axis=0)
        square = (within * (variances + sizes**2)).sum(axis=0)
        best = int(np.argmax(share))
        likeliest = int(np.argmax(table[:, best]))
        sums = weighed[likeliest].sums
        tracks, functions, covariance = self.tracks(sums, self._signatures[best].columns, self._std)
        prior = PRIOR_NONE if self._name == "none" else (1.0 - PRIOR_NONE) / (len(NAMES) - 1)
        return Explanation(
            self._name,
            float(np.log(prior * weights.sum() / len(GRID))) + top,
            self._signatures,
            share / share.sum(),
            size,
            np.sqrt(np.maximum(square - size**2, 0.0)),
            tracks,
            sums,
            points[likeliest],
            functions,
            covariance,
        )

    def mixed_tracks(self, explanation: Explanation) -> list[Track]:
        """Return the SoC of each stretch over all signatures, each by its probability."""
        sums = explanation.sums
        if self._name in RIGHT:  # the SoC that the voltage alone would have shown
            zero, known = sums.at.index(ERROR), self._priors.zero_std_pct
            free = np.hypot(known, self._priors.fault("start_or_reset"))
            precision = sums.precision.copy()
            precision[zero, zero] += free**-2.0 - known**-2.0
            sums = sums._replace(precision=precision)
        likely = np.flatnonzero(explanation.share >= LEAST_SHARE)
        share = explanation.share[likely] / explanation.share[likely].sum()
        columns = [explanation.signatures[k].columns for k in likely]
        of_each = [self.tracks(sums, W, self._std)[0] for W in columns]
        return [mixture(tracks, share) for tracks in zip(*of_each, strict=True)]

    def tracks(
        self, sums: Sums, W: FloatArray, std: float
    ) -> tuple[list[Track], FloatArray, FloatArray]:
        """Return the SoC under a signature, and the curve's functions with their covariance.

        Parameters
        ----------
        sums : Sums
        W : array of shape (L, columns)
            Columns of the signature.
        std : float
            Prior standard deviation of its size.
        """
        p = len(sums.at)
        theta, V = _posterior(sums, W, std)
        tracks = []
        for k, part in enumerate(self._stretches):
            inverse, back = sums.inverse[k], sums.back[k]
            C = np.zeros((self._columns, p + 1))
            C[sums.at, range(p)] = 1.0
            C[:, p] = W[k]
            X = np.outer(100.0 * part.hours / self._priors.capacity_ah, C[OFFSET])
            X += np.outer(part.drawn_pct / 100.0, C[CAPACITY]) - back[0, :-1] @ C
            start_pct = self._designs[k].start_pct + back[0, -1]
            variance = inverse[0, 0] + np.einsum("ni,ij,nj->n", X, V, X)
            tracks.append(Track(start_pct - part.drawn_pct + X @ theta, np.sqrt(variance)))
        functions = slice(p - (self._columns - FUNCTIONS), p)
        return tracks, theta[functions], V[functions, functions]

    def _weighed(self, point: Point) -> Weighed:
        """Weigh the signatures; stretches get a larger noise where that raises the evidence."""
        usual = [point[1]] * len(self._stretches)
        weighed = self._at(point, usual)
        best = self._signatures[int(np.argmax(weighed.log_evidence))].columns
        theta, _ = _posterior(weighed.sums, best, self._std)
        shared = best * theta[-1]
        shared[:, weighed.sums.at] += theta[:-1]
        classes = self._straying(point, shared)
        if classes == usual:
            return weighed
        strayed = self._at(point, classes)
        return max(weighed, strayed, key=lambda of: float(of.log_evidence.max()))

    def _at(self, point: Point, classes: Sequence[int]) -> Weighed:
        """Return the signatures with a size of the gauge's noise (class) for each stretch."""
        W = np.array([signature.columns for signature in self._signatures])
        log_weight = np.log([signature.weight for signature in self._signatures])
        sums = self._sums(point, classes)
        MW = np.einsum("lcd,hld->hlc", sums.gram[:, :-1, :-1], W)
        cross = MW.sum(axis=1)[:, sums.at]
        solved = np.linalg.solve(sums.precision, cross.T)
        K = np.einsum("hlc,hlc->h", MW, W) - np.einsum("hs,sh->h", cross, solved)
        g = np.einsum("hlc,lc->h", W, sums.gram[:, :-1, -1]) - sums.gradient @ solved
        precision = np.maximum(K, 0.0) + self._std**-2
        log_factor = 0.5 * g**2 / precision - 0.5 * np.log(precision * self._std**2)
        log_evidence = sums.log_evidence + log_weight + log_factor
        return Weighed(log_evidence, g / precision, 1.0 / precision, sums)

    def _sums(self, point: Point, classes: Sequence[int]) -> Sums:
        """Integrate out what each stretch has of its own, and collect what all share."""
        v, y = point
        M = np.array(
            [of.voltage[v] + of.gauge[c] for of, c in zip(self._designs, classes, strict=True)]
        )
        stretches = list(zip(self._stretches, classes, strict=True))
        prior = np.array([self._local_std(part, v, c) for part, c in stretches])
        A = M[:, LOCAL][:, :, LOCAL] + np.eye(len(LOCAL)) * prior[:, None] ** -2.0
        inverse = np.linalg.inv(A)
        back = inverse @ M[:, LOCAL]
        gram: FloatArray = M - M[:, :, LOCAL] @ back
        log_evidence = sum(
            part.whiten_voltage[v].log_norm + part.whiten_gauge[c].log_norm + _log_stray(c, y)
            for part, c in stretches
        )
        log_evidence -= 0.5 * float(np.linalg.slogdet(A)[1].sum()) + float(np.log(prior).sum())
        total = gram.sum(axis=0)
        healthy = self._priors.healthy(GAUGES[y])
        at = [*healthy, *range(FUNCTIONS, self._columns)]
        shared = np.array([healthy.get(column, 1.0) for column in at]) ** -2.0
        A = total[np.ix_(at, at)] + np.diag(shared)
        b = total[at, -1]
        log_evidence += 0.5 * (float(b @ np.linalg.solve(A, b)) - float(total[-1, -1]))
        log_evidence -= 0.5 * (np.linalg.slogdet(A)[1] - float(np.log(shared).sum()))
        return Sums(gram, np.asarray(inverse), back, at, A, b, log_evidence)

    def _straying(self, point: Point, shared: FloatArray) -> list[int]:
        """Return the likeliest size of the gauge's noise in each stretch.

        `shared` is what all stretches share, and the cause, shape (L, columns).
        """
        v, y = point
        classes = range(y, len(GAUGES))
        result = []
        for part, design, theta in zip(self._stretches, self._designs, shared, strict=True):
            left = np.r_[-theta, 1.0]
            scores = []
            for c in classes:
                M = design.voltage[v] + design.gauge[c]
                prior = self._local_std(part, v, c)
                A = M[np.ix_(LOCAL, LOCAL)] + np.diag(prior**-2.0)
                b = M[LOCAL] @ left
                misfit = float(left @ M @ left) - float(b @ np.linalg.solve(A, b))
                norm = part.whiten_gauge[c].log_norm - float(np.log(prior).sum())
                norm -= 0.5 * float(np.linalg.slogdet(A)[1])
                scores.append(norm - 0.5 * misfit + _log_stray(c, y))
            result.append(classes[int(np.argmax(scores))])
        return result

    def _local_std(self, part: Stretch, v: int, c: int) -> FloatArray:
        """Return the standard deviations of the columns that a stretch has of its own."""
        gauge = GAUGES[c]
        hours = np.sqrt(max(part.hours[-1], 1.0))
        drift_a = gauge.drift_pct / 100.0 * self._priors.capacity_ah / hours
        error_pct = UNKNOWN_PCT if self._name == "unknown" else gauge.error_pct
        level = VOLTAGE_SCALES[v]
        return np.array([FREE_PCT, level, error_pct, gauge.error_pct, drift_a, gauge.scale_pct])


def _log_stray(c: int, y: int) -> float:
    """Return the log prior of a stretch's size of noise, where the gauge's usual one is y."""
    larger = len(GAUGES) - 1 - y
    return float(np.log(1.0 - STRAYS if c == y else STRAYS / larger)) if larger else 0.0


def _posterior(sums: Sums, W: FloatArray, std: float) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of what all stretches share, and of a signature's size."""
    MW = np.einsum("lcd,ld->lc", sums.gram[:, :-1, :-1], W)
    cross = MW.sum(axis=0)[sums.at]
    own = np.array([[float(np.sum(MW * W)) + std**-2]])
    V = np.linalg.inv(np.block([[sums.precision, cross[:, None]], [cross[None], own]]))
    theta = V @ np.r_[sums.gradient, float(np.sum(W * sums.gram[:, :-1, -1]))]
    return np.asarray(theta), np.asarray(V)

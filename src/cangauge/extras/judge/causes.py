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
    Design,
    GaugeNoise,
    Stretch,
    Voltage,
    design_of,
)
from cangauge.model.model_file import Model

UNITS: Final = {
    "current_offset": "A", "count_scale": "%", "pack_capacity": "%", "start_or_reset": "% SoC",
    "voltage_sensor": "%",
}  # fmt: skip
"""Causes that the pack's signals can show, and the unit of their size."""
NAMES: Final = ("none", "unknown", *UNITS)

PRIOR_NONE: Final = 0.5
"""Prior probability that the gauge is right: whoever asks has a reason. The other answers share
the rest alike."""
LOCAL: Final = (START, LEVEL, ERROR, STEP, COUNT_OFFSET, COUNT_SCALE)
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
GRID: Final = [(v, y) for v in range(len(VOLTAGE_SCALES)) for y in range(len(GAUGES))]
"""Sizes of the noise of voltage and gauge, equally likely before the logs."""


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
        """Return the standard deviation of a fault's size, in `UNITS`."""
        return {
            "current_offset": self.capacity_ah / 25.0,  # 1 % of a sensor's range of 4 C
            "count_scale": 5.0,  # a wrong capacity in the gauge's configuration, or gain
            "pack_capacity": 6.0,  # what ageing takes between two updates of a gauge
            "start_or_reset": 10.0,
            "voltage_sensor": 1.5,
        }[cause]


class Signature(NamedTuple):
    """A cause as a direction in the columns."""

    onset: int
    """First stretch that it holds in."""
    inside: bool
    """Whether it begins at the step within that stretch."""
    weight: float
    """Prior probability within its cause."""
    std: float
    columns: FloatArray
    """Coefficients in each stretch, shape (L, columns)."""


def signatures_of(  # noqa: C901 - a table of causes
    name: str, chain: Sequence[Stretch], starts: FloatArray, columns: int, priors: Priors
) -> list[Signature]:
    """Return the signatures of an answer; of `none` and `unknown` an empty one.

    Parameters
    ----------
    name : str
    chain : sequence of Stretch
    starts : array of shape (L,)
        SoC at the start of each stretch [%].
    columns : int
        Number of columns.
    priors : Priors
    """
    L = len(chain)
    if name not in UNITS:
        # An error that differs between stretches needs some: of one it is that of the start.
        weight = 1.0 if name == "none" else max(1.0 - 1.0 / L, 1e-9)
        return [Signature(0, False, weight, 1.0, np.zeros((L, columns)))]
    counted = np.array([part.counted_h for part in chain])
    one = np.ones(L)
    found = []

    def add(m: int, weight: float, *parts: tuple[int, FloatArray], inside: bool = False) -> None:
        table = np.zeros((L, columns))
        for column, value in parts:
            table[m:, column] += value[m:]
        found.append(Signature(m, inside, weight, priors.fault(name), table))

    def begins(m: int) -> float:
        """Return the prior probability that it began with stretch m: half of it before all."""
        return 1.0 if L == 1 else 0.5 if m == 0 else 0.5 / (L - 1)

    for m in range(L):
        grown = -100.0 / priors.capacity_ah * (counted - counted[m])
        if name == "current_offset":
            for column in (OFFSET, COUNT_OFFSET):  # in the sensor, or in the count alone
                add(m, 0.35 * begins(m), (column, one), (ERROR, grown))
                add(m, 0.15 * begins(m), (column, one))  # the gauge corrects itself when parked
        if name in {"count_scale", "pack_capacity"} and m == 0:  # not of one day to the next
            column = COUNT_SCALE if name == "count_scale" else CAPACITY
            add(m, 0.4, (column, one), (ERROR, (starts - starts[m]) / 100.0))
            add(m, 0.3, (column, one), (ERROR, (starts - 100.0) / 100.0))  # right when full
            add(m, 0.3, (column, one))
        if name == "voltage_sensor":
            add(m, 0.6 * begins(m), (VOLTAGE, one))  # as logged; the gauge counts
            if m == 0:
                add(m, 0.4, (BY_VOLTAGE, one))  # in a gauge that reads the voltage
        if name == "start_or_reset":
            here = np.eye(L)[m]
            add(m, 0.8 * begins(m), (ERROR, one))
            add(m, 0.2 / L, (STEP, here), (ERROR, one - here), inside=True)
    return found


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


def sums_of(
    designs: Sequence[Design],
    chain: Sequence[Stretch],
    grid: tuple[int, int],
    classes: Sequence[int],
    priors: Priors,
    *,
    unknown: bool,
) -> Sums:
    """Integrate out what each stretch has of its own, and collect what all share.

    Parameters
    ----------
    grid : pair of int
        Size of the voltage's noise, and of the gauge's as it usually is.
    classes : sequence of int
        Size of the gauge's noise in each stretch.
    """
    v, y = grid
    own = list(LOCAL)
    M = np.array(
        [design.voltage[v] + design.gauge[c] for design, c in zip(designs, classes, strict=True)]
    )
    prior = np.array(
        [
            _local(part, v, c, priors, unknown=unknown)
            for part, c in zip(chain, classes, strict=True)
        ]
    )
    A = M[:, own][:, :, own] + np.eye(len(own)) * prior[:, None] ** -2.0
    inverse = np.linalg.inv(A)
    back = inverse @ M[:, own]
    gram: FloatArray = M - M[:, :, own] @ back
    log_evidence = sum(
        part.whiten_voltage[v].log_norm + part.whiten_gauge[c].log_norm + _log_stray(c, y)
        for part, c in zip(chain, classes, strict=True)
    )
    log_evidence -= 0.5 * float(np.linalg.slogdet(A)[1].sum()) + float(np.log(prior).sum())
    total = gram.sum(axis=0)
    healthy = priors.healthy(GAUGES[y])
    at = [*healthy, *range(FUNCTIONS, total.shape[0] - 1)]
    shared = np.array([healthy.get(column, 1.0) for column in at]) ** -2.0
    A = total[np.ix_(at, at)] + np.diag(shared)
    b = total[at, -1]
    log_evidence += 0.5 * (float(b @ np.linalg.solve(A, b)) - float(total[-1, -1]))
    log_evidence -= 0.5 * (np.linalg.slogdet(A)[1] - float(np.log(shared).sum()))
    return Sums(gram, np.asarray(inverse), back, at, A, b, log_evidence)


def _local(part: Stretch, v: int, c: int, priors: Priors, *, unknown: bool) -> FloatArray:
    """Return the standard deviations of the columns that a stretch has of its own."""
    gauge = GAUGES[c]
    drift_a = gauge.drift_pct / 100.0 * priors.capacity_ah / np.sqrt(max(part.hours_long, 1.0))
    error_pct = UNKNOWN_PCT if unknown else gauge.error_pct
    return np.array(
        [FREE_PCT, VOLTAGE_SCALES[v], error_pct, gauge.error_pct, drift_a, gauge.scale_pct]
    )


def _log_stray(c: int, y: int) -> float:
    """Return the log prior of a stretch's size of noise, where the gauge's usual one is y."""
    larger = len(GAUGES) - 1 - y
    return float(np.log(1.0 - STRAYS if c == y else STRAYS / larger)) if larger else 0.0


def straying(
    designs: Sequence[Design],
    chain: Sequence[Stretch],
    grid: tuple[int, int],
    shared: FloatArray,
    priors: Priors,
    *,
    unknown: bool,
) -> list[int]:
    """Return the likeliest size of the gauge's noise in each stretch.

    Parameters
    ----------
    shared : array of shape (L, columns)
        What all stretches share, and the cause, in the columns of each stretch.
    """
    (v, y), own = grid, list(LOCAL)
    found = []
    for design, part, theta in zip(designs, chain, shared, strict=True):
        scores = []
        for c in range(y, len(GAUGES)):
            M = design.voltage[v] + design.gauge[c]
            prior = _local(part, v, c, priors, unknown=unknown)
            A = M[np.ix_(own, own)] + np.diag(prior**-2.0)
            left = np.r_[-theta, 1.0]
            b = M[own] @ left
            fit = float(left @ M @ left) - float(b @ np.linalg.solve(A, b))
            norm = part.whiten_gauge[c].log_norm - float(np.log(prior).sum())
            norm -= 0.5 * float(np.linalg.slogdet(A)[1])
            scores.append(norm - 0.5 * fit + _log_stray(c, y))
        found.append(y + int(np.argmax(scores)))
    return found


class Track(NamedTuple):
    """SoC of a stretch and its standard deviation at each block [%]."""

    soc_pct: FloatArray
    std_pct: FloatArray


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
        SoC of each stretch under the most probable signature; of `none`, as if the gauge's zero
        were free, so that the gauge does not confirm itself.
    sums : Sums
    point : pair of int
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
    point: tuple[int, int]
    functions: FloatArray
    covariance: FloatArray

    @property
    def best(self) -> int:
        """Number of the most probable signature."""
        return int(np.argmax(self.share))


def explain(chain: Sequence[Stretch], model: Model, priors: Priors) -> list[Explanation]:
    """Return all answers, each linearised at its own SoC."""
    first = [part.linear_pct for part in chain]
    voltage = Voltage.of(model)
    found = []
    for name in NAMES:
        for part, linear_pct in zip(chain, first, strict=True):
            part.linear_pct = linear_pct
        points: Sequence[tuple[int, int]] = GRID
        for _ in range(ITERATIONS):
            designs = [design_of(part, voltage) for part in chain]
            explanation = _explanation(name, chain, designs, priors, points)
            points = [explanation.point]
            moved_pct = 0.0
            for part, track in zip(chain, explanation.tracks, strict=True):
                step = np.clip(track.soc_pct, -3.0, 103.0) - part.linear_pct
                part.linear_pct = part.linear_pct + DAMPING * step
                moved_pct = max(moved_pct, float(np.abs(step).max()))
            if moved_pct < SETTLED_PCT:
                break
        explanation = _explanation(name, chain, designs, priors, GRID)
        if name == "none":
            # Not by the gauge itself: the SoC that the voltage alone would have shown.
            free = np.zeros_like(explanation.signatures[0].columns)
            free[:, ERROR] = 1.0
            apart = Signature(0, False, 1.0, priors.fault("start_or_reset"), free)
            tracks, *_ = _tracks(chain, designs, explanation.sums, apart, priors)
            explanation = replace(explanation, tracks=tracks)
        found.append(explanation)
        if name != "none":
            # The null hypothesis may use any linearisation: no curvature accuses a gauge.
            null = _explanation("none", chain, designs, priors, GRID).log_evidence
            found[0] = replace(found[0], log_evidence=max(found[0].log_evidence, null))
    return found


class _OfPoint(NamedTuple):
    """All signatures of an answer at some sizes of the noise."""

    logs: FloatArray
    """Logarithm of the evidence."""
    size: FloatArray
    variance: FloatArray
    sums: Sums


def _explanation(
    name: str,
    chain: Sequence[Stretch],
    designs: Sequence[Design],
    priors: Priors,
    points: Sequence[tuple[int, int]],
) -> Explanation:
    """Return an answer at one linearisation, with its noise integrated over some points."""
    starts = np.array([design.start_pct for design in designs])
    columns = designs[0].gauge[0].shape[0] - 1
    signatures = signatures_of(name, chain, starts, columns, priors)
    W = np.array([each.columns for each in signatures])
    std = np.array([each.std for each in signatures])
    log_weight = np.log([each.weight for each in signatures])

    def _at(point: tuple[int, int], classes: list[int]) -> _OfPoint:
        sums = sums_of(designs, chain, point, classes, priors, unknown=name == "unknown")
        MW = np.einsum("lcd,hld->hlc", sums.gram[:, :-1, :-1], W)
        cross = MW.sum(axis=1)[:, sums.at]
        solved = np.linalg.solve(sums.precision, cross.T)
        K = np.einsum("hlc,hlc->h", MW, W) - np.einsum("hs,sh->h", cross, solved)
        g = np.einsum("hlc,lc->h", W, sums.gram[:, :-1, -1]) - sums.gradient @ solved
        precision = np.maximum(K, 0.0) + std**-2
        factor = 0.5 * g**2 / precision - 0.5 * np.log(precision * std**2)
        return _OfPoint(
            sums.log_evidence + log_weight + factor, g / precision, 1.0 / precision, sums
        )

    logs, sizes, variances, all_sums = [], [], [], []
    for point in points:
        of_point = _at(point, [point[1]] * len(chain))
        best = int(np.argmax(of_point.logs))
        theta, _ = _posterior(of_point.sums, signatures[best])
        shared = np.zeros((len(chain), columns))
        shared[:, of_point.sums.at] = theta[:-1]
        shared += signatures[best].columns * theta[-1]
        classes = straying(designs, chain, point, shared, priors, unknown=name == "unknown")
        if any(c != point[1] for c in classes):
            strayed = _at(point, classes)
            of_point = strayed if strayed.logs.max() > of_point.logs.max() else of_point
        logs.append(of_point.logs)
        sizes.append(of_point.size)
        variances.append(of_point.variance)
        all_sums.append(of_point.sums)
    table = np.array(logs)
    top = float(table.max())
    weights = np.exp(table - top)
    share = weights.sum(axis=0)
    within = np.exp(table - table.max(axis=0))
    within /= within.sum(axis=0)
    size = (within * np.array(sizes)).sum(axis=0)
    square = (within * (np.array(variances) + np.array(sizes) ** 2)).sum(axis=0)
    best = int(np.argmax(share))
    likeliest = int(np.argmax(table[:, best]))
    sums = all_sums[likeliest]
    tracks, functions, covariance = _tracks(chain, designs, sums, signatures[best], priors)
    prior = PRIOR_NONE if name == "none" else (1.0 - PRIOR_NONE) / (len(NAMES) - 1)
    return Explanation(
        name,
        float(np.log(prior * weights.sum() / len(GRID))) + top,
        signatures,
        share / share.sum(),
        size,
        np.sqrt(np.maximum(square - size**2, 0.0)),
        tracks,
        sums,
        points[likeliest],
        functions,
        covariance,
    )


def _tracks(
    chain: Sequence[Stretch],
    designs: Sequence[Design],
    sums: Sums,
    signature: Signature,
    priors: Priors,
) -> tuple[list[Track], FloatArray, FloatArray]:
    """Return the SoC under one signature, and the curve's functions with their covariance."""
    p, columns = len(sums.at), sums.gram.shape[1] - 1
    W = signature.columns
    theta, V = _posterior(sums, signature)
    tracks = []
    for k, (design, part) in enumerate(zip(designs, chain, strict=True)):
        inverse, back = sums.inverse[k], sums.back[k]
        C = np.zeros((columns, p + 1))
        C[sums.at, range(p)] = 1.0
        C[:, p] = W[k]
        X = np.outer(100.0 * part.hours / priors.capacity_ah, C[OFFSET])
        X += np.outer(part.drawn_pct / 100.0, C[CAPACITY]) - back[0, :-1] @ C
        soc_pct = design.start_pct + back[0, -1] - part.drawn_pct + X @ theta
        variance = inverse[0, 0] + np.einsum("ni,ij,nj->n", X, V, X)
        tracks.append(Track(soc_pct, np.sqrt(variance)))
    functions = slice(p - (columns - FUNCTIONS), p)
    return tracks, theta[functions], V[functions, functions]


def _posterior(sums: Sums, signature: Signature) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of what all stretches share, and of the cause's size."""
    W = signature.columns
    MW = np.einsum("lcd,ld->lc", sums.gram[:, :-1, :-1], W)
    cross = MW.sum(axis=0)[sums.at]
    own = np.array([[float(np.sum(MW * W)) + signature.std**-2]])
    V = np.linalg.inv(np.block([[sums.precision, cross[:, None]], [cross[None], own]]))
    theta = V @ np.r_[sums.gradient, float(np.sum(W * sums.gram[:, :-1, -1]))]
    return np.asarray(theta), np.asarray(V)

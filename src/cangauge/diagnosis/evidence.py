"""Evidence, size and remaining error of every effect in logs that share one cause."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from cangauge._typing import FloatArray, IntArray
from cangauge.diagnosis.pack import (
    RIDGE,
    Healthy,
    LogRows,
    corrected_by,
    of_model,
    total,
    total_s,
)
from cangauge.diagnosis.rows import COVER_PCT, Trace
from cangauge.diagnosis.shapes import Shape
from cangauge.model.model_file import Model

VISIBLE_NATS: Final = 6.0
"""Evidence from which an effect counts as visible [nats]: 400 to 1 for one effect."""

TWO_SIDED, SHAPE_STD = 1.96, 0.05
"""Standard deviations of a 95 % interval, and the relative uncertainty of a size by its shape: it
is the library's and not the pack's, and sizes of development cases were off by 1 to 15 %."""


@dataclass(frozen=True)
class Quantity:
    """Value of a parameter with its 95 % interval.

    Parameters
    ----------
    value : float
    ci : (float, float), optional
        None for a shape.
    unit : str
    """

    value: float
    ci: tuple[float, float] | None
    unit: str


@dataclass(frozen=True)
class Evidence:
    """Evidence of one effect at its best shape and size, in logs that share one cause."""

    shapes: tuple[Shape | None, ...]
    """Its shape in each log; None before a step of resistance."""
    nats: float
    """n_k: gain of log likelihood [nats]."""
    left_v2: float
    """V_k: mean square error that remains [V²]."""
    size: float
    """Amplitude relative to neutral [unit of the shape]."""
    std: float
    """Its standard deviation by noise and excess."""
    visible: float
    """Smallest size that would have been visible."""
    chi2: float
    """χ² (one degree of freedom) of its most significant shape: about 1 without the effect."""
    bounds: tuple[float, float]
    """Lowest and highest amplitude relative to neutral, in units of the shape's larger bound."""

    @property
    def shape(self) -> Shape:
        """The shape in the first log that has it."""
        return next(filter(None, self.shapes))

    @property
    def fault(self) -> str:
        """The fault that the effect shows."""
        return self.shape.effect.fault

    @property
    def half_width(self) -> float:
        """Half of the 95 % interval of the size [unit of the shape]."""
        return TWO_SIDED * float(np.hypot(self.std, SHAPE_STD * self.size))

    @property
    def parameters(self) -> dict[str, Quantity]:
        """Parameters of the effect, with the 95 % interval of its amplitude."""
        shape, half = self.shape, self.half_width
        found = {}
        for item in shape.effect.parameters:
            value, ci = shape.values(self.size)[item.name], None
            if item is shape.amplitude:
                ci = (value - half, value + half)
            found[item.name] = Quantity(value, ci, item.unit)
        return found


def analyse(healthy: Healthy, logs: Sequence[LogRows]) -> dict[str, Evidence]:
    """Return the evidence of every effect in logs that share one cause, to first order.

    Each shape is weighed by itself beside δ: its size by ridge regression within its bounds. The
    best one stands for its effect.
    """
    at = _trials(healthy.tried, len(logs))
    tried = [healthy.tried[k] for k in at.max(axis=1)]
    n = healthy.n
    R = np.asarray(np.linalg.qr(_design(healthy, logs, at), mode="r"))
    left = R[n:, n:]  # δ integrated out
    # Gradient and curvature of the log likelihood of each trial's size, about zero.
    g, s = left[:, :-1].T @ left[:, -1], np.maximum(np.sum(left[:, :-1] ** 2, axis=0), 1e-9)
    bounds = np.array([_bounds(shape, logs) for shape in tried])
    size = np.clip(g / (s + RIDGE), *bounds.T)
    gain = g * size - 0.5 * s * size**2
    chi2 = g**2 / (s + RIDGE)
    solved = np.linalg.solve(R[:n, :n], R[:n, n:])
    found = {}
    names = np.array([shape.effect.id for shape in tried])
    for name in dict.fromkeys(names.tolist()):
        mine, o = np.flatnonzero(names == name), healthy.excess[name]
        top = int(mine[np.argmax(gain[mine])])
        bound, delta = tried[top].bound, solved[:, -1] - solved[:, top] * size[top]
        square_v2 = sum(
            healthy.square_v2(log, delta, k, float(size[top]))
            for log, k in zip(logs, at[top].tolist(), strict=True)
        )
        visible = np.sqrt(2.0 * VISIBLE_NATS * o / s[mine]) * [tried[j].bound for j in mine]
        found[name] = Evidence(
            tuple(
                None if k < 0 else healthy.tried[k].in_log(log.trace.log.duration_s)
                for log, k in zip(logs, at[top].tolist(), strict=True)
            ),
            nats=float(gain[top]),
            left_v2=square_v2 / total_s(logs),
            size=float(size[top]) * bound,
            std=float(np.sqrt(o / (s[top] + RIDGE))) * bound,
            visible=float(visible.min()),
            chi2=float(chi2[mine].max()),
            bounds=(float(bounds[top, 0]), float(bounds[top, 1])),
        )
    return found


def _design(healthy: Healthy, logs: Sequence[LogRows], at: IntArray) -> FloatArray:
    """Return the rows of δ and of each trial: of the references, the logs, and their own SoC."""
    n, number = healthy.n, len(at)
    tables = [np.insert(healthy.delta.table, [n] * number, 0.0, axis=1)]
    for log, column in zip(logs, at.T, strict=True):
        table = healthy.rows_of(log).table
        shapes = np.where(column >= 0, table[:, n + column], 0.0)
        tables.append(np.column_stack([table[:, :n], shapes, table[:, -1]]))
        if beyond := healthy.own_soc(log, log.simulated.plain.soc_pct):
            counts = np.array([_moved(shape, healthy, log, beyond) for shape in healthy.tried])
            counts = np.where(column >= 0, counts[column], 0.0)
            tables.append(np.r_[np.zeros(n), counts, beyond][None, :])
    return np.concatenate(tables)


def _moved(shape: Shape, healthy: Healthy, log: LogRows, beyond: float) -> float:
    """Return the change of what `own_soc` returned without a shape, by it at its bound."""
    if shape.effect.fault not in ("current_reading", "capacity"):
        return 0.0
    changed = log.simulated.with_effect(shape.effect, shape.values(shape.about)).soc_pct
    return (beyond - healthy.own_soc(log, changed)) * shape.bound / shape.about


def _trials(tried: Sequence[Shape], logs: int) -> IntArray:
    """Return the column of each trial in each log, −1 for none, shape (trials, logs).

    A step of resistance happens at one place of one log and lasts through the later ones.
    """
    plain = [[k] * logs for k, shape in enumerate(tried) if shape.place is None]
    first, *steps = range(len(plain), len(tried))
    later = [
        [-1] * before + [step] + [first] * (logs - before - 1)
        for before, step in itertools.product(range(logs), steps)
    ]
    return np.array(plain + later)


def _bounds(shape: Shape, logs: Sequence[LogRows]) -> tuple[float, float]:
    """Return the bounds of an amplitude [larger bound]; no log starts beyond full or empty."""
    low, high = shape.low / shape.bound, shape.high / shape.bound
    if shape.effect.fault != "start":
        return low, high
    starts = [log.trace.start_pct for log in logs]
    full = (100.0 + COVER_PCT - max(starts)) / shape.bound
    empty = -(min(starts) + COVER_PCT) / shape.bound
    return min(max(low, empty), 0.0), max(min(high, full), 0.0)


def learn(model: Model, references: Sequence[Trace]) -> Healthy:
    """Return what references, logs without a fault, show; of the model alone without any."""
    stated_v = model.noise.voltage_rmse_v
    if not references:
        return of_model(model, stated_v)
    healthy, logs = corrected_by(references, model)
    every = [healthy.delta_rows_of(log) for log in logs]
    # Each reference that the others cover, and the healthy pack without it.
    left_out = [
        (log, replace(healthy, delta=total(healthy.delta, every[:k] + every[k + 1 :])))
        for k, log in enumerate(logs)
        if log.is_covered
    ]
    healthy = replace(healthy, delta=total(healthy.delta, every))
    if len(left_out) < 2:
        return replace(healthy, s2=max(healthy.s2, stated_v**2))
    found = [analyse(others, [log]) for log, others in left_out]
    chi2 = {name: np.array([one[name].chi2 for one in found]) for name in found[0]}
    usual = max(1.0, float(np.median([x.mean() for x in chi2.values()])))
    # The mean of few references may be far off: two more that show the usual χ² of all effects,
    # as a conjugate prior of that weight, draw it there.
    excess = {k: max((x.sum() + 2.0 * usual) / (len(x) + 2.0), usual) for k, x in chi2.items()}
    return replace(
        healthy,
        mean_squares_v2=tuple(others.gap_v2([log]) for log, others in left_out),
        mean_open_v2=float(np.mean([others.open_v2([log]) for log, others in left_out])),
        nats=tuple(max(0.0, *(e.nats / excess[name] for name, e in one.items())) for one in found),
        excess=excess,
    )

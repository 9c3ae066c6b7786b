"""Evidence, size and remaining error of every effect in logs that share one cause."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from cangauge.diagnosis.pack import RIDGE, Healthy, LogRows, correct, of_model, total, total_s
from cangauge.diagnosis.rows import COVER_PCT, Trace
from cangauge.diagnosis.shapes import PLACES, Shape
from cangauge.model.gaussian import Rows
from cangauge.model.model_file import Model

VISIBLE_NATS: Final = 6.0
"""Evidence from which an effect counts as visible [nats]: 400 to 1 for one effect."""

TWO_SIDED, SHAPE_STD = 1.96, 0.05
"""Standard deviations of a 95 % interval, and the relative uncertainty of a size by its shape: it
is the library's and not the pack's, and sizes of development cases were off by 1 to 15 %."""

Places = tuple[float | None, ...]
"""Where a shape begins in each log, in parts of it: 0 is from its first row on, None never."""


@dataclass(frozen=True)
class Quantity:
    """Value of a parameter with its 95 % interval.

    Parameters
    ----------
    value : float
    unit : str
    ci : (float, float), optional
        None for a shape.
    """

    value: float
    unit: str
    ci: tuple[float, float] | None


@dataclass(frozen=True)
class Evidence:
    """Evidence of one effect at its best shape and size, in logs that share one cause."""

    shape: Shape
    nats: float
    """n_k/o_k: gain of log likelihood over the excess that references show [nats]."""
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
    places: Places
    bounds: tuple[float, float]
    """Lowest and highest amplitude relative to neutral, in units of the shape's larger bound."""

    @property
    def fault(self) -> str:
        """The fault that the effect shows."""
        return self.shape.effect.fault

    @property
    def parameters(self) -> dict[str, Quantity]:
        """Parameters of the effect, with the 95 % interval of its amplitude."""
        half = TWO_SIDED * float(np.hypot(self.std, SHAPE_STD * self.size))
        found = {}
        for item in self.shape.effect.parameters:
            value = self.shape.values(self.size)[item.name]
            ci = (value - half, value + half) if item.name == self.shape.name else None
            found[item.name] = Quantity(value, item.unit, ci)
        return found

    def shape_in(self, number: int, log: LogRows) -> Shape | None:
        """Return the shape in one of the logs; None before a step of resistance."""
        part = self.places[number]
        if part is None or self.shape.place is None:
            return None if part is None else self.shape
        return self.shape.at(part, log.trace.log.duration_s)


def analyse(healthy: Healthy, logs: Sequence[LogRows]) -> dict[str, Evidence]:
    """Return the evidence of every effect in logs that share one cause, to first order."""
    trials = _trials(healthy.tried, len(logs))
    at = np.array([columns for columns, _ in trials]).T
    tried = [healthy.tried[max(columns)] for columns, _ in trials]
    n = healthy.n
    tables = [np.insert(healthy.known.table, [n] * len(tried), 0.0, axis=1)]
    for log, column in zip(logs, at, strict=True):
        table = healthy.rows_of(log).table
        shapes = np.where(column >= 0, table[:, n + column], 0.0)
        tables.append(np.column_stack([table[:, :n], shapes, table[:, -1]]))
        beyond, std = healthy.own_soc(log, log.of.plain.soc_pct)
        if beyond:
            counts = np.where(column >= 0, log.count_by_shape[column], 0.0)
            tables.append(np.r_[np.zeros(n), counts / std, beyond][None, :])
    rows = Rows(np.concatenate(tables), 0.0).reduced()
    left = rows.eliminated(n).table
    g, s = left[:, :-1].T @ left[:, -1], np.maximum(np.sum(left[:, :-1] ** 2, axis=0), 1e-9)
    bounds = np.array([_bounds(shape, logs) for shape in tried])
    size = np.clip(g / (s + RIDGE), *bounds.T)
    gain = g * size - 0.5 * s * size**2
    R = np.asarray(np.linalg.qr(rows.table, mode="r"), dtype=np.float64)
    solved = np.linalg.solve(R[:n, :n], R[:n, n:])
    found = {}
    names = np.array([shape.effect.id for shape in tried])
    for name in dict.fromkeys(names.tolist()):
        mine = np.flatnonzero(names == name)
        top = int(mine[np.argmax(gain[mine])])
        shape, places, o = tried[top], trials[top][1], healthy.excess_of(name)
        if shape.place is not None:
            duration_s = logs[places.count(None)].trace.log.duration_s
            shape = shape.at(shape.place, duration_s)
        delta = solved[:, -1] - solved[:, top] * size[top]
        square_v2 = sum(
            healthy.square_v2(log, delta, int(column), float(size[top]))
            for log, column in zip(logs, at[:, top], strict=True)
        )
        visible = np.sqrt(2.0 * VISIBLE_NATS * o / s[mine]) * [tried[j].bound for j in mine]
        found[name] = Evidence(
            shape=shape,
            nats=float(gain[top]) / o,
            left_v2=square_v2 / total_s(logs),
            size=float(size[top]) * shape.bound,
            std=float(np.sqrt(o / (s[top] + RIDGE))) * shape.bound,
            visible=float(visible.min()),
            chi2=float(np.max(g[mine] ** 2 / (s[mine] + RIDGE))),
            places=places,
            bounds=(float(bounds[top, 0]), float(bounds[top, 1])),
        )
    return found


def _trials(tried: Sequence[Shape], logs: int) -> list[tuple[list[int], Places]]:
    """Return what is tried on some logs: the column in each log, −1 for none, and its places.

    A step of resistance happens at one place of one log and lasts through the later ones.
    """
    plain = [k for k, shape in enumerate(tried) if shape.place is None]
    first, *steps = (k for k, shape in enumerate(tried) if shape.place is not None)
    trials: list[tuple[list[int], Places]] = [([k] * logs, (0.0,) * logs) for k in plain]
    for before, (k, part) in itertools.product(range(logs), zip(steps, PLACES[1:], strict=True)):
        after = logs - before - 1
        places = (None,) * before + (part,) + (0.0,) * after
        trials.append(([-1] * before + [k] + [first] * after, places))
    return trials


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
    if not references:
        return of_model(model)
    healthy, logs, counts = correct(model, references)
    every = [healthy.rows_of(log).with_columns(range(healthy.n)) for log in logs]
    plain, judged, left_out = replace(healthy, excess={"": 1.0}), [], []
    for k, log in enumerate(logs):
        if counts[k]:
            others = replace(plain, known=total(healthy.known, every[:k] + every[k + 1 :]))
            judged.append((others.gap_v2([log]), others.open_v2([log])))
            left_out.append(analyse(others, [log]))
    known = total(healthy.known, every)
    if len(left_out) < 2:
        stated_v2 = model.noise.voltage_rmse_v**2
        return replace(healthy, known=known, s2=max(healthy.s2, stated_v2))
    chi2 = {name: np.array([one[name].chi2 for one in left_out]) for name in left_out[0]}
    usual = max(1.0, float(np.median([x.mean() for x in chi2.values()])))
    # Two more references of the usual χ² keep the mean of few from being far off.
    excess = {k: max((x.sum() + 2.0 * usual) / (len(x) + 2.0), usual) for k, x in chi2.items()}
    nats = [max(0.0, *(e.nats / excess[name] for name, e in one.items())) for one in left_out]
    return replace(
        healthy,
        known=known,
        mean_squares_v2=tuple(gap_v2 for gap_v2, _ in judged),
        mean_open_v2=float(np.mean([open_v2 for _, open_v2 in judged])),
        nats=tuple(nats),
        excess=excess,
    )

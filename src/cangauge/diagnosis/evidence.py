"""Evidence, size and remaining error of every effect in logs that share one cause."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.diagnosis.pack import (
    RIDGE,
    SOC_STANDS_OUT,
    Healthy,
    LogRows,
    correct,
    of_model,
    total,
)
from cangauge.diagnosis.rows import COVER_PCT, Trace
from cangauge.diagnosis.shapes import PLACES, Shape
from cangauge.model.gaussian import Rows
from cangauge.model.model_file import Model

VISIBLE_NATS: Final = 6.0
"""Evidence from which an effect counts as visible [nats]: 400 to 1 for one effect."""


@dataclass(frozen=True)
class EffectEvidence:
    """Evidence of one effect at its best shape and size."""

    shape: Shape
    nats: float
    """Gain of log likelihood over the excess o_k that references show of this effect [nats]."""
    left_v2: float
    """Mean square error that remains [V²]."""
    size: float
    """Amplitude relative to neutral [unit of the shape]."""
    std: float
    """Its standard deviation by noise and excess."""
    visible: float
    """Smallest size that would have been visible."""
    chance: float
    """Largest χ² of its shapes: about 1 without the effect."""
    in_logs: tuple[float | None, ...]
    """Place in each log, in parts of it: 0 from its first row on, None before a step."""
    bounds: tuple[float, float]
    """Of the amplitude, in larger bounds of the shape."""


@dataclass(frozen=True)
class Evidence:
    """Evidence of every effect in logs that share one cause."""

    effects: dict[str, EffectEvidence]
    gap_v2: float
    """Mean square error of the healthy pack's model [V²]."""
    open_v2: float
    """Mean variance of it by what the references leave open [V²]."""


@dataclass(frozen=True, eq=False)
class Trials:
    """What is tried on some logs: shapes, and the column of each in every log."""

    shapes: list[Shape]
    at: NDArray[np.intp]
    """Column of each shape in each log, −1 where it has none, shape (logs, k)."""
    places: list[tuple[float | None, ...]]
    low: FloatArray
    high: FloatArray
    """Bounds of the amplitudes [bounds of the shapes], shape (k,)."""

    @classmethod
    def of(cls, healthy: Healthy, logs: Sequence[LogRows]) -> Trials:
        """Return the trials on some logs.

        A step of resistance happens at one place of one log and lasts through the later ones. No
        log starts beyond full or empty.
        """
        plain = [k for k, shape in enumerate(healthy.tried) if shape.place is None]
        steps = [k for k, shape in enumerate(healthy.tried) if shape.place is not None]
        number = len(logs)
        shapes = [healthy.tried[k] for k in plain]
        at = [[k] * number for k in plain]
        places: list[tuple[float | None, ...]] = [(0.0,) * number for _ in plain]
        for log in range(number):
            for k, part in zip(steps[1:], PLACES[1:], strict=True):
                shapes.append(healthy.tried[k])
                column = [-1] * log + [k] + [steps[0]] * (number - log - 1)
                at.append(column)
                places.append((None,) * log + (part,) + (0.0,) * (number - log - 1))
        starts = [log.trace.start_pct for log in logs]
        low = np.array([shape.low / shape.bound for shape in shapes])
        high = np.array([shape.high / shape.bound for shape in shapes])
        for k, shape in enumerate(shapes):
            if shape.effect.fault == "start":
                high[k] = max(min(high[k], (100.0 + COVER_PCT - max(starts)) / shape.bound), 0.0)
                low[k] = min(max(low[k], -(min(starts) + COVER_PCT) / shape.bound), 0.0)
        return cls(shapes, np.array(at).T, places, low, high)


def analyse(healthy: Healthy, logs: Sequence[LogRows]) -> Evidence:
    """Return the evidence of every effect in logs that share one cause, to first order."""
    trials = Trials.of(healthy, logs)
    n = healthy.known.table.shape[1] - 1
    k = len(trials.shapes)
    tables = [np.insert(healthy.known.table, [n] * k, 0.0, axis=1)]
    for log, places in zip(logs, trials.at, strict=True):
        table = healthy.rows_of(log).table
        shapes = np.where(places >= 0, table[:, n + np.maximum(places, 0)], 0.0)
        tables.append(np.concatenate([table[:, :n], shapes, table[:, -1:]], axis=1))
    tables.append(_soc_rows(healthy, logs, trials, n))
    rows = Rows(np.concatenate(tables), 0.0).reduced()
    left = rows.eliminated(n).table
    g, s = left[:, :-1].T @ left[:, -1], np.maximum(np.sum(left[:, :-1] ** 2, axis=0), 1e-9)
    size = np.clip(g / (s + RIDGE), trials.low, trials.high)
    gain = g * size - 0.5 * s * size**2
    triangular = np.asarray(np.linalg.qr(rows.table, mode="r"), dtype=np.float64)
    solved = np.linalg.solve(triangular[:n, :n], triangular[:n, n:])
    moved, theta = solved[:, :-1], solved[:, -1]
    over = np.array([healthy.excess_of(shape.effect.id) for shape in trials.shapes])
    seconds = sum(log.seconds for log in logs)
    effects = {}
    names = np.array([shape.effect.id for shape in trials.shapes])
    for name in dict.fromkeys(names.tolist()):
        mine = np.flatnonzero(names == name)
        top = int(mine[np.argmax(gain[mine])])
        shape = trials.shapes[top]
        change = theta - moved[:, top] * size[top]
        square = sum(
            healthy.mean_square_v2(log, change, int(column), float(size[top])) * log.seconds
            for log, column in zip(logs, trials.at[:, top], strict=True)
        )
        o = float(over[top])
        effects[name] = EffectEvidence(
            shape=shape,
            nats=float(gain[top]) / o,
            left_v2=square / seconds,
            size=float(size[top]) * shape.bound,
            std=float(np.sqrt(o / (s[top] + RIDGE))) * shape.bound,
            visible=float(
                min(np.sqrt(2.0 * VISIBLE_NATS * o / s[j]) * trials.shapes[j].bound for j in mine)
            ),
            chance=float(np.max(g[mine] ** 2 / (s[mine] + RIDGE))),
            in_logs=trials.places[top],
            bounds=(float(trials.low[top]), float(trials.high[top])),
        )
    before = healthy.known.posterior().mean
    gap = sum(healthy.mean_square_v2(log, before) * log.seconds for log in logs) / seconds
    open_v2 = sum(healthy.open_v2(log) * log.seconds for log in logs) / seconds
    return Evidence(effects, gap, open_v2)


def soc_row(healthy: Healthy, log: LogRows, soc_pct: FloatArray) -> float:
    """Return counted less own change of SoC in standard deviations; 0 where it does not stand out.

    `soc_pct` is the counted SoC of all rows of the log.
    """
    count = log.counted
    if count is None or abs(count.deviation(healthy.soc_ratio, count.counted_pct)) < SOC_STANDS_OUT:
        return 0.0
    change = log.trace.own_change(soc_pct)
    return 0.0 if change is None else count.deviation(healthy.soc_ratio, change[1])


def _soc_rows(healthy: Healthy, logs: Sequence[LogRows], trials: Trials, n: int) -> FloatArray:
    """Return a row for each log whose own SoC stands out against the counted charge."""
    rows = [np.zeros((0, n + len(trials.shapes) + 1))]
    for log, places in zip(logs, trials.at, strict=True):
        beyond = soc_row(healthy, log, log.of.plain.soc_pct)
        if log.counted is not None and beyond:
            std = log.counted.std(healthy.soc_ratio)
            by_shape = np.where(places >= 0, log.counted.by_shape[np.maximum(places, 0)], 0.0)
            rows.append(np.r_[np.zeros(n), by_shape / std, beyond][None, :])
    return np.concatenate(rows)


def learn(model: Model, references: Sequence[Trace]) -> Healthy:
    """Return what references, logs without a fault, show; of the model alone without any."""
    if not references:
        return of_model(model)
    healthy, logs, counts = correct(model, references)
    every = [healthy.rows_of(log).with_columns(range(healthy.size)) for log in logs]
    plain = replace(healthy, excess={"": 1.0})
    left_out = []
    for k, log in enumerate(logs):
        if counts[k]:
            known = total(healthy.known, every[:k] + every[k + 1 :])
            left_out.append(analyse(replace(plain, known=known), [log]))
    known = total(healthy.known, every)
    if len(left_out) < 2:
        stated_v2 = model.noise.voltage_rmse_v**2
        return replace(healthy, known=known, s2=max(healthy.s2, stated_v2))
    chance = {
        name: np.array([one.effects[name].chance for one in left_out])
        for name in left_out[0].effects
    }
    usual = max(1.0, float(np.median([x.mean() for x in chance.values()])))
    excess = {k: max((x.sum() + 2.0 * usual) / (len(x) + 2.0), usual) for k, x in chance.items()}
    nats = [
        max(0.0, *(e.nats / excess[name] for name, e in one.effects.items())) for one in left_out
    ]
    return replace(
        healthy,
        known=known,
        mean_squares_v2=tuple(one.gap_v2 for one in left_out),
        known_v2=float(np.mean([one.open_v2 for one in left_out])),
        nats=tuple(nats),
        excess=excess,
    )

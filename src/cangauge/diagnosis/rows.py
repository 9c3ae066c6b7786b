"""Rows of a log at 1 Hz, and what a model with an effect misses on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from cangauge._typing import BoolArray, FloatArray, IntArray
from cangauge.identify.rows import dequantize, usable_rows
from cangauge.logs.gaps import usual_step_s
from cangauge.logs.log import Log
from cangauge.model.effects.base import Effect, Signals, Values
from cangauge.model.extended import ExtendedModel, Prediction
from cangauge.model.voltage_model import DELAYS_S

STEP_S, MOST_SECONDS = 0.9, 60.0
"""Logs with a shorter step are averaged over seconds; a logger of 1 Hz jitters. A row stands for at
most the latter time, as in a fit [s]."""

COVER_PCT: Final = 2.0
"""Logs cover SoC this far beyond their own [%]."""

MAX_OUTLIERS, OUTLIER = 5, 0.1
"""At most so many single rows, off by this part of the voltage, are faults of a bus and left out;
more are diagnosed."""


@dataclass(frozen=True, eq=False)
class Trace:
    """A log at 1 Hz.

    Parameters
    ----------
    log : Log
        Means over each second; a slower log as it is.
    original : Signals
        At the log's own rate.
    second : array of int
        Row of `log` of each row of `original`.
    start_pct : float
        Assumed SoC before the first row [%].
    rows : array of int, shape (m,)
        Rows of `log` that take part, as in a fit.
    row_s : float
        Time that each of them stands for [s].
    """

    log: Log
    original: Signals
    second: IntArray
    start_pct: float
    rows: IntArray
    row_s: float

    def own_change(self, soc_pct: FloatArray) -> tuple[float, float]:
        """Return the change of the log's own SoC, and that of a counted one over the same time [%].

        Between its highest and its lowest value; 0 where it has none.
        """
        own = self.log.soc_pct
        if own is None or not np.isfinite(own).any():
            return 0.0, 0.0
        first, last = sorted((int(np.nanargmax(own)), int(np.nanargmin(own))))
        return float(own[last] - own[first]), float(soc_pct[last] - soc_pct[first])


def trace(log: Log, start_pct: float) -> Trace:
    """Return a log at 1 Hz that starts at a SoC [%]."""
    log = dequantize(log)
    original, second = Signals.of(log), np.arange(len(log))
    if usual_step_s(log.time_s) < STEP_S:
        tick = np.floor(log.time_s - log.time_s[0] + 1e-6)
        _, first, second = np.unique(tick, return_index=True, return_inverse=True)
        soc = None if log.soc_pct is None else log.soc_pct[first]
        log = replace(log, **_means(original, second)._asdict(), soc_pct=soc)
    rows, _ = usable_rows(log, DELAYS_S, 1.0)
    if not rows.size:
        rows = np.arange(len(log))
    row_s = min(max(usual_step_s(log.time_s), 1.0), MOST_SECONDS)
    return Trace(log, original, second, start_pct, rows, row_s)


def _means(signals: Signals, second: IntArray) -> Signals:
    counts = np.bincount(second)
    return Signals(*(np.bincount(second, weights=each) / counts for each in signals))


class Simulated:
    """A log as a model with effects predicts it.

    Parameters
    ----------
    model : ExtendedModel
    trace : Trace
    """

    def __init__(self, model: ExtendedModel, trace: Trace) -> None:
        self.model, self.trace = model, trace
        self.signals = Signals.of(trace.log)
        self._currents_a = model.model.currents(trace.log.time_s, trace.log.current_a, slice(None))
        self.plain = self._predict(model, self.signals)

    def _predict(self, model: ExtendedModel, signals: Signals) -> Prediction:
        at, currents_a = self.trace, self._currents_a if signals is self.signals else None
        return model.predict(signals, at.start_pct, at.rows, currents_a=currents_a)

    def with_effect(self, effect: Effect, values: Values) -> Prediction:
        """Return the prediction by the model with one more effect."""
        if not effect.moves_time:
            return self._predict(added(self.model, effect, values), self.signals)
        context = effect.context(values, self.model.model, self.model.pack)
        moved = effect.correct(self.trace.original, values, context._replace(is_whole=True))
        return self._predict(self.model, _means(moved, self.trace.second))


def added(model: ExtendedModel, effect: Effect, values: Values) -> ExtendedModel:
    """Return a model with an effect, added to one of the same shape."""
    amplitudes = [item.name for item in effect.amplitudes]
    fixed = values.keys() - amplitudes
    neutral, total, others = effect.neutral(model.pack), dict(values), []
    for other, known in model.effects:
        if other.id != effect.id or any(known[name] != values[name] for name in fixed):
            others.append((other, known))
            continue
        for name in amplitudes:
            total[name] += known[name] - neutral[name]
    return replace(model, effects=(*others, (effect, effect.clipped(total, model.pack))))


def covered(soc_pct: FloatArray, others: Sequence[FloatArray]) -> BoolArray:
    """Return where a SoC [%] lies within those that others visit; everywhere without others."""
    result = np.full(soc_pct.size, not others)
    for other in others:
        low, high = float(other.min()) - COVER_PCT, float(other.max()) + COVER_PCT
        result |= (soc_pct >= low) & (soc_pct <= high)
    return result


def without_outliers(residual_v: FloatArray, usual_v: float) -> BoolArray:
    """Return the rows but single ones that no pack can have produced, shape (m,)."""
    off = np.abs(residual_v - np.median(residual_v)) > OUTLIER * usual_v
    return ~off if 0 < off.sum() <= MAX_OUTLIERS else np.ones(off.size, dtype=bool)

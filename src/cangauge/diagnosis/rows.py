"""Rows of a log at 1 Hz, and what a model with an effect misses on them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from cangauge._typing import BoolArray, FloatArray, IntArray
from cangauge.identify.rows import dequantize, usable_rows
from cangauge.logs.gaps import usual_step_s
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import soc_at_first_row
from cangauge.model.effects.base import Effect, Signals, Values
from cangauge.model.effects.library import shape_key
from cangauge.model.extended import ExtendedModel, Prediction
from cangauge.model.voltage_model import DELAYS_S

STEP_S, MOST_SECONDS = 0.9, 60.0
"""Logs with a shorter step are averaged over seconds; a logger of 1 Hz jitters. A row stands for at
most the latter time, as in a fit [s]."""

LEAST_ROWS: Final = 60
"""A log with fewer rows after the delay line has filled is used as a whole."""

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
    """

    log: Log
    original: Signals
    second: IntArray
    start_pct: float
    rows: IntArray

    @property
    def name(self) -> str:
        """Name of the log."""
        return self.log.name

    @cached_property
    def weights(self) -> FloatArray:
        """Time that each row of `rows` stands for [s], shape (m,)."""
        step_s = usual_step_s(self.log.time_s)
        return np.full(self.rows.size, min(max(step_s, 1.0), MOST_SECONDS))

    def has_gap(self, longest_s: float) -> bool:
        """Whether a step between rows is longer [s]."""
        return bool(np.any(np.diff(self.original.time_s) > longest_s))

    def means(self, signals: Signals) -> Signals:
        """Return signals at the log's own rate as means over the rows of `log`."""
        if self.second.size == len(self.log):
            return signals
        counts = np.bincount(self.second)
        return Signals(*(np.bincount(self.second, weights=each) / counts for each in signals))

    def own_change(self, soc_pct: FloatArray) -> tuple[float, float] | None:
        """Return the change of the log's own SoC, and that of a counted one over the same time [%].

        Between its highest and its lowest value; None where it has none that changes.
        """
        own = self.log.soc_pct
        if own is None or np.isfinite(own).sum() < 2:
            return None
        first, last = sorted((int(np.nanargmax(own)), int(np.nanargmin(own))))
        return float(own[last] - own[first]), float(soc_pct[last] - soc_pct[first])


def trace(log: Log, capacity_ah: float, start_pct: float | None = None) -> Trace:
    """Return a log at 1 Hz.

    Its start is `start_pct`, or counted from its first known SoC back to the first row.
    """
    if start_pct is None:
        start_pct = soc_at_first_row(log, capacity_ah)
    if start_pct is None:
        raise ValueError("unknown SoC at the start")
    log = dequantize(log)
    original = Signals.of(log)
    second = np.arange(len(log))
    if usual_step_s(log.time_s) < STEP_S:
        tick = np.floor(log.time_s - log.time_s[0] + 1e-6)
        first, second = np.unique(tick, return_index=True, return_inverse=True)[1:]
        counts = np.bincount(second)
        means = [np.bincount(second, weights=each) / counts for each in original]
        soc = None if log.soc_pct is None else log.soc_pct[first]
        log = replace(
            log,
            time_s=means[0],
            current_a=means[1],
            voltage_v=means[2],
            temperature_c=means[3],
            soc_pct=soc,
        )
    rows, _ = usable_rows(log, DELAYS_S, 1.0)
    if rows.size < LEAST_ROWS:
        rows = np.arange(len(log))
    return Trace(log, original, second, start_pct, rows)


class Simulated:
    """A log as a model with effects predicts it.

    Parameters
    ----------
    model : ExtendedModel
    of : Trace
    """

    def __init__(self, model: ExtendedModel, of: Trace) -> None:
        self.model, self.of = model, of
        self.signals = Signals.of(of.log)
        every = slice(None)
        self._currents = model.model.currents(of.log.time_s, of.log.current_a, every)
        self.plain = self._predict(model, self.signals)

    def _predict(self, model: ExtendedModel, signals: Signals) -> Prediction:
        kept = signals.current_a is self.signals.current_a
        return model.predict(
            signals,
            self.of.start_pct,
            self.of.rows,
            currents_a=self._currents if kept else None,
        )

    def with_effect(self, effect: Effect, values: Values) -> Prediction:
        """Return the prediction by the model with one more effect."""
        if effect.moves_time:
            context = effect.context(values, self.model.model, self.model.pack)
            moved = effect.correct(self.of.original, values, context._replace(is_whole=True))
            return self._predict(self.model, self.of.means(moved))
        return self._predict(added(self.model, effect, values), self.signals)


def added(model: ExtendedModel, effect: Effect, values: Values) -> ExtendedModel:
    """Return a model with an effect, added to one of the same shape."""
    key, neutral = shape_key(effect, values), effect.neutral(model.pack)
    if not effect.amplitudes:  # the amplitude of a skew is its shape
        key = (effect.id,)
    same = [item for item in model.effects if (shape_key(*item) == key or key == (item[0].id,))]
    names = [item.name for item in effect.amplitudes or effect.parameters[:1]]
    total = dict(values)
    for _, known in same:
        for name in names:
            total[name] += known[name] - neutral[name]
    others = tuple(item for item in model.effects if item not in same)
    clipped = effect.clipped(total, model.pack) if effect.amplitudes else total
    return replace(model, effects=(*others, (effect, clipped)))


def covered(soc_pct: FloatArray, others: list[FloatArray]) -> BoolArray:
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

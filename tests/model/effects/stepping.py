"""Signals, and the extended model run sample by sample, for the tests of effects."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cangauge.estimation.counting import CoulombCounter
from cangauge.model.delay_line import DelayLine
from cangauge.model.effects.base import Effect, Pack, Parameter, Signals
from cangauge.model.effects.library import LIBRARY
from cangauge.model.extended import ExtendedModel, OnlineModel
from cangauge.model.published import CAPACITY_AH, leaf_2012_model, leaf_2012_model_file
from cangauge.types import Sample
from synthetic import drive_current

MODEL = leaf_2012_model()
PACK = Pack.of(MODEL, CAPACITY_AH)
EFFECTS = list(LIBRARY.values())
FILE = leaf_2012_model_file()


def irregular_signals(rows: int = 3000, seed: int = 1, *, gaps: bool = True) -> Signals:
    """A drive with steps of 10 ms to 3 s and, on demand, gaps of 20 s, 10 min and 5 h."""
    rng = np.random.default_rng(seed)
    step = rng.choice([0.01, 0.1, 0.4, 1.0, 3.0], rows, p=[0.1, 0.2, 0.2, 0.4, 0.1])
    step = step * rng.uniform(0.5, 1.5, rows)
    if gaps:
        step[[rows // 4, rows // 2, 3 * rows // 4]] = 20.0, 600.0, 18000.0
    time_s = np.cumsum(step)
    current_a = drive_current(time_s - time_s[0], 25.0, seed) + rng.normal(0.0, 3.0, rows)
    temperature_c = 15.0 + 8.0 * np.sin(time_s / 900.0) + np.round(rng.normal(0.0, 0.6, rows))
    voltage_v = 370.0 - 0.13 * current_a + rng.normal(0.0, 0.5, rows)
    return Signals(time_s, current_a, voltage_v, temperature_c)


def middle(effect: Effect, pack: Pack = PACK) -> dict[str, float]:
    """Values halfway between neutral and the upper bound; shapes in the middle of their grid."""
    values = {}
    for parameter in effect.parameters:
        low, high = parameter.bounds(pack)
        if parameter in effect.shapes:
            trials = parameter.trials(pack)
            values[parameter.name] = trials[len(trials) // 2]
        else:
            neutral = parameter.neutral * parameter.factor(pack)
            far = high if high > neutral else low
            values[parameter.name] = 0.5 * (neutral + far)
    return values


def within(parameter: Parameter, part: float, pack: Pack = PACK) -> float:
    """The value at a fraction (0–1) between the bounds."""
    low, high = parameter.bounds(pack)
    return min(max(low + part * (high - low), low), high)


def online_of(extended: ExtendedModel, capacity_ah: float | None = None) -> OnlineModel:
    """The sample-by-sample form with a delay line that keeps every sample."""
    online = OnlineModel(extended, FILE.functions, FILE.noise, capacity_ah)
    online.delay_line = DelayLine(extended.model.loads.delays_s, gap_s=math.inf, spacing_s=0.0)
    return online


@dataclass
class Stepped:
    """Results of the sample-by-sample form."""

    readings: list[Sample]
    soc_pct: np.ndarray
    """Counted by the estimator's counter."""
    voltage_v: np.ndarray
    """Predicted at `asked_soc_pct` if given, else at the counted SoC."""


def step_through(
    extended: ExtendedModel,
    signals: Signals,
    initial_soc_pct: float,
    asked_soc_pct: np.ndarray | None = None,
) -> Stepped:
    """Run a log through online model, delay line and counter, as the estimator does."""
    online = online_of(extended)
    counter = CoulombCounter(online.capacity_ah, gap_s=2.0)
    start = online.initial_soc_pct(initial_soc_pct)
    readings, soc, volts = [], [], []
    columns = (signals.time_s, signals.current_a, signals.voltage_v, signals.temperature_c)
    for row in zip(*(column.tolist() for column in columns), strict=True):
        for reading in online.correct(Sample(*row)):
            counter.step(reading.time_s, online.counted(reading.current_a))
            online.advance(reading.time_s, reading.current_a, reading.temperature_c)
            counted = start - counter.discharged_pct
            asked = counted if asked_soc_pct is None else float(asked_soc_pct[len(readings)])
            readings.append(reading)
            soc.append(counted)
            volts.append(online.pseudo_ocv_at(asked)[0] + online.load_v)
    return Stepped(readings, np.array(soc), np.array(volts))

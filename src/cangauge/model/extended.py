"""Extended model: the voltage model with effects, over whole logs and one sample at a time.

Both apply the same steps in the same order: correct the signals, count charge, delay and low-pass
the current, add the effects' voltages to the voltage model's. `OnlineModel` calls the array form
with one row and carries the effects' memories. Without effects both equal the voltage model.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.logs.gaps import BRIDGE_S, discharged_ah
from cangauge.model.curve import SLOPE_AT_LEAST
from cangauge.model.delay_line import DelayLine
from cangauge.model.effects.base import (
    Counting,
    Effect,
    Inputs,
    Memories,
    Pack,
    Signals,
    Values,
    same_signals,
)
from cangauge.model.effects.library import LIBRARY
from cangauge.model.first_order import Lag
from cangauge.model.inverse import socs_from_ocv
from cangauge.model.noise import Noise
from cangauge.model.voltage_model import Functions, VoltageModel
from cangauge.settings import GAP_S
from cangauge.types import Sample

UNKNOWN_STD_K = 8.0
"""Standard deviation of an unknown temperature about the mean of the model's logs [K]: that of the
days of a year in a temperate climate."""

_ORDER = {effect_id: number for number, effect_id in enumerate(LIBRARY)}


def _place(item: tuple[Effect, Values]) -> int:
    """Return the place of an effect in the library's order; the last for one of the user's own."""
    return _ORDER.get(item[0].id, len(_ORDER))


@dataclass(frozen=True, eq=False)
class Prediction:
    """Prediction of the extended model for a log."""

    rows: NDArray[np.intp]
    """Rows of the log at which the voltage is predicted, shape (m,)."""
    voltage_v: FloatArray
    """Predicted voltage [V], shape (m,)."""
    signals: Signals
    """All rows as ideal sensors would have shown them, shape (n,)."""
    soc_pct: FloatArray
    """Counted SoC of all rows [%], shape (n,)."""
    currents_a: FloatArray = field(repr=False)
    """Delayed and low-passed currents at `rows` [A], shape (m, M)."""
    beside_v: FloatArray = field(repr=False)
    """Part of the voltage at `rows` that does not depend on SoC [V], shape (m,)."""
    drives: list[FloatArray] = field(repr=False)
    """Drives of `ExtendedModel.over_soc` at `rows` [V], shape (m,) each."""

    @property
    def residual_v(self) -> FloatArray:
        """Corrected measured voltage minus predicted [V], shape (m,)."""
        return self.signals.voltage_v[self.rows] - self.voltage_v


@dataclass(frozen=True)
class ExtendedModel:
    """A voltage model with effects.

    Parameters
    ----------
    model : VoltageModel
    capacity_ah : float
        Capacity of the model [Ah]; the effects' bounds and C-rates are relative to it.
    effects : sequence of (Effect, values)
        Applied in the library's order, not in the given one.
    """

    model: VoltageModel
    capacity_ah: float
    effects: tuple[tuple[Effect, Values], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "effects", tuple(sorted(self.effects, key=_place)))

    @cached_property
    def pack(self) -> Pack:
        """The pack's sizes."""
        return Pack.of(self.model, self.capacity_ah)

    @cached_property
    def over_soc(self) -> list[tuple[Effect, Values]]:
        """The effects whose voltage depends on SoC."""
        return [each for each in self.effects if each[0].uses_soc]

    def add_over_soc(
        self, volts: FloatArray, soc_pct: FloatArray, drives: Iterable[FloatArray]
    ) -> FloatArray:
        """Return voltages with those of `over_soc` at a SoC added [V], given their drives."""
        for (effect, values), drive in zip(self.over_soc, drives, strict=True):
            volts = volts + drive * effect.over_soc(soc_pct, values, self.model)
        return volts

    def with_effect(self, effect: Effect, values: Values) -> ExtendedModel:
        """Return the model with one more effect."""
        return replace(self, effects=(*self.effects, (effect, values)))

    def predict(
        self,
        signals: Signals,
        initial_soc_pct: float,
        at_rows: NDArray[np.intp],
        *,
        initial_row: int = 0,
        currents_a: FloatArray | None = None,
    ) -> Prediction:
        """Predict voltage and SoC of a log.

        Parameters
        ----------
        signals : Signals
            All measured rows, shape (n,).
        initial_soc_pct : float
            SoC at `initial_row` [%].
        at_rows : array of int, shape (m,)
            Rows at which to predict the voltage.
        initial_row : int
            Row at which the initial SoC holds.
        currents_a : array of shape (n, M), optional
            `VoltageModel.currents` of the measured current at every row, where it is known.
        """
        model, effects, pack = self.model, self.effects, self.pack
        measured_a = signals.current_a
        for effect, values in effects:
            context = effect.context(values, model, pack)._replace(is_whole=True)
            signals = effect.correct(signals, values, context)
        counting = self.counting(initial_soc_pct)
        out_ah = discharged_ah(signals.time_s, counting.counted(signals.current_a))
        moved_pct = 100.0 * (out_ah - out_ah[initial_row]) / counting.capacity_ah
        soc = np.asarray(counting.initial_soc_pct - moved_pct)
        # An effect that adds a voltage remembers: it needs every row.
        is_whole = any(effect.adds_voltage for effect, _ in effects)
        rows = slice(None) if is_whole else at_rows
        if currents_a is not None and signals.current_a is measured_a:
            currents = currents_a[rows]
        else:
            currents = model.currents(signals.time_s, signals.current_a, rows)
        temperature_c = signals.temperature_c[rows]
        load_columns = model.load_columns(temperature_c, currents)
        volts = load_columns @ model.load_coefficients
        drop_v = load_columns[:, 1:] @ model.load_coefficients[1:]
        inputs = Inputs(signals.time_s[rows], signals.current_a[rows], temperature_c, drop_v)
        drives = []
        for effect, values in effects:
            drive = effect.drive(inputs, values, effect.context(values, model, pack))
            if drive is None:
                continue
            if effect.uses_soc:
                drives.append(drive[at_rows])
            else:
                volts = volts + drive
        if is_whole:
            volts, currents = volts[at_rows], currents[at_rows]
        ocv_v = model.pseudo_ocv(soc[at_rows])
        voltage_v = self.add_over_soc(ocv_v + volts, soc[at_rows], drives)
        return Prediction(at_rows, voltage_v, signals, soc, currents, volts, drives)

    def voltage_at(self, soc_pct: FloatArray, prediction: Prediction) -> FloatArray:
        """Return the voltages at the rows of a prediction if the SoC were another [V].

        Parameters
        ----------
        soc_pct : array of shape (m,)
        prediction : Prediction
        """
        volts = self.model.pseudo_ocv(soc_pct) + prediction.beside_v
        return self.add_over_soc(volts, soc_pct, prediction.drives)

    def counting(self, initial_soc_pct: float) -> Counting:
        """Return how charge is counted from an assumed initial SoC [%]."""
        counting = Counting(self.capacity_ah, initial_soc_pct)
        for effect, values in self.effects:
            counting = effect.count(counting, values)
        return counting


def newton_soc(model: ExtendedModel, prediction: Prediction) -> FloatArray:
    """Return the SoC at which the model has the measured voltage at each row [%], shape (m,).

    Newton's method where the curve alone depends on SoC; bisection with effects, whose slope is not
    at hand.
    """
    measured = prediction.signals.voltage_v[prediction.rows]
    if not prediction.drives:
        return socs_from_ocv(model.model, measured - prediction.beside_v)
    low, high = np.zeros_like(measured), np.full_like(measured, 100.0)
    for _ in range(45):  # down to 3e-12 %
        middle = 0.5 * (low + high)
        above = model.voltage_at(middle, prediction) > measured
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    return 0.5 * (low + high)


class OnlineModel:
    """The extended model one sample at a time, for the estimator.

    Call `correct`, then `advance` for each reading it returns. The other methods then describe the
    voltage at that reading.

    Parameters
    ----------
    extended : ExtendedModel
    functions : Functions
        Covariance of the coefficients.
    noise : Noise
        Errors of the voltage.
    capacity_ah : float, optional
        Capacity set by the user [Ah].
    gap_s : float
        A longer step between two samples empties the delay line [s].
    """

    def __init__(
        self,
        extended: ExtendedModel,
        functions: Functions,
        noise: Noise,
        capacity_ah: float | None = None,
        gap_s: float = GAP_S,
    ) -> None:
        self.extended = extended
        self.model = extended.model
        self.functions = functions
        self.noise = noise
        # Capacity and efficiency do not depend on the SoC.
        self._counting = extended.counting(50.0)
        self.capacity_ah = capacity_ah or self._counting.capacity_ah
        """Capacity for the Coulomb counter [Ah]."""
        self.delay_line = DelayLine(self.model.loads.delays_s, gap_s=gap_s)
        self.lags = [Lag(tau_s, 0.0, rest_s=BRIDGE_S) for tau_s in self.model.loads.low_pass_s]
        self._contexts = [
            effect.context(values, self.model, extended.pack) for effect, values in extended.effects
        ]
        self.load_coefficients = self.model.load_coefficients
        """Coefficients of the load columns, shape (k,)."""
        self.unseen_v_per_a = float(np.sum(self.model.loads.resistance_ohm[1:]))
        """Voltage by earlier currents, which a slow log shows in part [V/A]."""
        self.load = np.full(self.load_coefficients.size, math.nan)
        """The load row at the latest reading, shape (k,); NaN before any."""
        self.drives = np.zeros(1 + len(extended.over_soc))
        """The effects' drives at the latest reading, shape (1 + effects over SoC,).

        The first is the voltage of effects that do not depend on the SoC [V]. The effects' voltage
        is linear in the drives, so that a mean of readings has the mean of their drives.
        """

    @property
    def load_v(self) -> float:
        """Voltage of the load row [V]."""
        return float(self.load @ self.load_coefficients)

    @property
    def drop_v(self) -> float:
        """Part of it over the resistances [V]; negative while discharging."""
        return float(self.load[1:] @ self.load_coefficients[1:])

    def initial_soc_pct(self, assumed_pct: float) -> float:
        """Return the SoC at which to start for an assumed one, within 0–100 [%]."""
        return min(max(self.extended.counting(assumed_pct).initial_soc_pct, 0.0), 100.0)

    def counted(self, current_a: float) -> float:
        """Return the counted part of a corrected current [A]."""
        return float(self._counting.counted(np.array(current_a)))

    def correct(self, sample: Sample) -> Sequence[Sample]:
        """Return the corrected samples that are ready, usually one, in order."""
        if all(effect.correct is same_signals for effect, _ in self.extended.effects):
            return (sample,)
        signals = Signals(*(np.array([value]) for value in sample))
        for (effect, values), context in zip(self.extended.effects, self._contexts, strict=True):
            if signals.time_s.size:
                signals = effect.correct(signals, values, context)
        return [Sample(*row) for row in np.stack(signals, axis=1).tolist()]

    def advance(self, time_s: float, current_a: float, temperature_c: float) -> None:
        """Advance to a corrected reading (every one, in order).

        Parameters
        ----------
        time_s, current_a : float
            Time [s] and current [A].
        temperature_c : float
            Latest known temperature [°C]; NaN without one: then the usual temperature holds.
        """
        self.delay_line.push(time_s, current_a)
        at, now = np.array([time_s]), np.array([current_a])
        smooth = [float(lag.step(at, now)[0]) for lag in self.lags]
        currents = [*self.delay_line.currents(), *smooth]
        known_c = self.model.usual_c if math.isnan(temperature_c) else temperature_c
        self.load = self.load_at(known_c, currents)
        self.drives = np.zeros_like(self.drives)
        if not self.extended.effects:
            return
        inputs = Inputs(at, now, np.array([known_c]), np.array([self.drop_v]))
        over = 0
        for (effect, values), context in zip(self.extended.effects, self._contexts, strict=True):
            drive = effect.drive(inputs, values, context)
            place = 1 + over if effect.uses_soc else 0
            over += effect.uses_soc
            if drive is not None:
                self.drives[place] += float(drive[0])

    def load_at(self, temperature_c: float, currents_a: Sequence[float] | FloatArray) -> FloatArray:
        """Return the load columns of given delayed and low-passed currents [A], shape (k,)."""
        return np.asarray(self.model.load_columns([temperature_c], np.array([currents_a]))[0])

    def unknown_temperature_v(self, load: FloatArray) -> float:
        """Return the standard deviation of the voltage by an unknown temperature [V].

        Parameters
        ----------
        load : array of shape (k,)
            Load row at the usual temperature.
        """
        currents = load[1 : 1 + len(self.model.loads.delays_s) + len(self.model.loads.low_pass_s)]
        change = self.load_at(self.model.usual_c + UNKNOWN_STD_K, currents) - load
        by_functions = change @ self.functions.load_parts(change.size)
        return math.hypot(float(change @ self.load_coefficients), *by_functions.tolist())

    def pseudo_ocv_at(
        self, soc_pct: float, drives: FloatArray | None = None
    ) -> tuple[float, float]:
        """Return curve and effects [V] at one SoC [%], and the slope [V per %].

        The effects are those of given drives, by default of the latest reading.

        The slope is limited to positive values, for Newton's method and the filter: with an effect
        the voltage may fall over a few per cent of SoC (resistance that rises toward empty, while
        charging).
        """
        volts, slope = self.model.curve.at(soc_pct)
        drives = self.drives if drives is None else drives
        volts += float(drives[0])
        if self.extended.over_soc:
            step_pct = 0.05  # of a central difference
            at = soc_pct + step_pct * np.array([-1.0, 0.0, 1.0])
            extra = self.extended.add_over_soc(np.zeros(3), at, drives[1:])
            volts += float(extra[1])
            slope += float(extra[2] - extra[0]) / (2.0 * step_pct)
            slope = max(slope, SLOPE_AT_LEAST * self.model.nominal_v)
        return volts, slope

    def curve_values(self, soc_pct: FloatArray) -> FloatArray:
        """Return curve and effects [V] of the latest reading at SoC [%] of shape (n,)."""
        volts = self.model.curve.values(soc_pct) + float(self.drives[0])
        return self.extended.add_over_soc(volts, soc_pct, self.drives[1:])

    def take_over(self, before: OnlineModel) -> None:
        """Take over the currents of another model's form; low-passed ones where τ is the same."""
        times, currents, since_s = before.delay_line.contents
        if times and self.delay_line.longest_s > before.delay_line.longest_s:
            since_s = max(since_s, times[0])  # the other line has dropped what this one needs
        self.delay_line.fill(times, currents, since_s)
        known = {lag.tau_s: lag.state() for lag in before.lags}
        for lag in self.lags:
            lag.restore(known.get(lag.tau_s, []))

    def resume(self, load: FloatArray, drives: FloatArray, low_passed_a: Sequence[float]) -> None:
        """Describe a reading that was advanced to elsewhere.

        Parameters
        ----------
        load, drives : array
            As the attributes.
        low_passed_a : sequence of floats
            Outputs of `lags` [A].
        """
        self.load, self.drives = load, drives
        for lag, value in zip(self.lags, low_passed_a, strict=True):
            lag.restore([0.0, 0.0, value])

    def state(self) -> list[list[list[float]]]:
        """Return the state of the low-passed currents, then of each effect, for `restore`."""
        return [[each.state() for each in memory] for memory in self._memories]

    def restore(self, state: Sequence[Sequence[Sequence[float]]]) -> None:
        """Continue from a saved state of the same model; the delay line is filled separately.

        Raises
        ------
        ValueError
            If the state does not belong to this model, or is damaged.
        """
        for memory, saved in zip(self._memories, state, strict=True):
            for each, numbers in zip(memory, saved, strict=True):
                each.restore(numbers)

    @property
    def _memories(self) -> list[Memories]:
        return [self.lags, *(context.memory for context in self._contexts)]

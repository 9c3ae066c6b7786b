"""Extended model: the voltage model with effects, over whole logs and one sample at a time.

Both forms apply the same steps in the same order: correct the signals, count charge, delay the
current, add the effects' voltages to the voltage model's. Without effects they equal the voltage
model bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from cangauge._arithmetic import total
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.model.coulomb_counting import discharged_ah
from cangauge.model.effects.base import Counting, Effect, Pack, PackState, Reading, Signals, Values
from cangauge.model.effects.library import LIBRARY
from cangauge.model.voltage_model import SLOPE_AT_LEAST, VoltageModel

SLOPE_STEP_PCT = 0.05
"""Half step of the finite difference of the effects' voltage over SoC [%]."""

STEADY_S, STEADY_STEP_S = 4.0 * 3600.0, 10.0
"""Duration of a constant current until the voltage counts as steady, and its time step [s]."""

STEADY_C_RATE = 1.0 / 3.0
STEADY_CHANGE = 0.05
"""Current at which the change of the steady voltage is taken, in both directions [1/h] (20 A at
60 Ah, as in driving), and the relative change of current."""

_ORDER = {effect_id: number for number, effect_id in enumerate(LIBRARY)}


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
        last = len(_ORDER)
        ordered = sorted(self.effects, key=lambda item: _ORDER.get(item[0].id, last))
        object.__setattr__(self, "effects", tuple(ordered))

    @cached_property
    def pack(self) -> Pack:
        """The pack's sizes."""
        return Pack.of(self.model, self.capacity_ah)

    def with_effect(self, effect: Effect, values: Values) -> ExtendedModel:
        """Return the model with one more effect."""
        return replace(self, effects=(*self.effects, (effect, values)))

    def online(self, capacity_ah: float | None = None) -> OnlineExtendedModel:
        """Return the sample-by-sample form, before the first sample.

        Parameters
        ----------
        capacity_ah : float, optional
            Capacity set by the user [Ah]; effects do not change it.
        """
        return OnlineExtendedModel(self, capacity_ah)

    def predict(
        self,
        signals: Signals,
        initial_soc_pct: float,
        at_rows: NDArray[np.intp],
        *,
        initial_row: int = 0,
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
        """
        corrected = self.corrected(signals)
        soc = self.counted_soc(corrected, initial_soc_pct, initial_row=initial_row)
        # A fast log has far more samples than rows.
        delayed = corrected.history.at(at_rows).delayed_a(self.model.delay_s)
        volts = self.model.voltage(soc[at_rows], corrected.temperature_c[at_rows], delayed)
        if self.effects:
            volts = volts + self.extra_voltage(self.state(corrected, soc, at_rows))
        return Prediction(at_rows, volts, corrected, soc)

    def corrected(self, signals: Signals) -> Signals:
        """Return the signals as ideal sensors would have shown them."""
        for effect, values in self.effects:
            signals = effect.correct(signals, values, self.pack)
        return signals

    def counting(self, initial_soc_pct: float) -> Counting:
        """Return how charge is counted from an assumed initial SoC [%]."""
        counting = Counting(self.capacity_ah, initial_soc_pct)
        for effect, values in self.effects:
            counting = effect.count(counting, values)
        return counting

    def counted_soc(
        self, corrected: Signals, initial_soc_pct: float, *, initial_row: int = 0
    ) -> FloatArray:
        """Return the SoC counted from corrected signals [%], shape (n,)."""
        counting = self.counting(initial_soc_pct)
        counted = counting.counted(corrected.current_a)
        if counted is corrected.current_a:
            out = corrected.history.out_ah
        else:
            steps_s = corrected.history.counted_s
            out = discharged_ah(corrected.time_s, counted, steps_s)
        moved = 100.0 * (out - out[initial_row]) / counting.capacity_ah
        return np.asarray(counting.initial_soc_pct - moved)

    def state(
        self, corrected: Signals, soc_pct: FloatArray, rows: NDArray[np.intp] | None = None
    ) -> PackState:
        """Return the inputs of the extra voltages, for some or all rows of corrected signals."""
        history = corrected.history
        kept = slice(None) if rows is None else rows
        at_rows = history if rows is None else history.at(rows)
        return PackState(
            time_s=corrected.time_s[kept],
            current_a=corrected.current_a[kept],
            temperature_c=corrected.temperature_c[kept],
            soc_pct=soc_pct[kept],
            drop_v=at_rows.delayed_a(self.model.delay_s) @ np.array(self.model.resistance_ohm),
            cached_history=at_rows,
            rows=rows,
            log=None if rows is None else corrected,
            of_log=None if rows is None else partial(self.state, corrected, soc_pct),
        )

    def extra_voltage(self, state: PackState) -> FloatArray:
        """Return the sum of the effects' voltages [V], shape (n,)."""
        volts = np.zeros_like(state.time_s)
        for effect, values in self.effects:
            extra = effect.extra_voltage_at(state, values, self.model, self.pack)
            if extra is not None:
                volts += extra
        return volts

    def steady_ohm(self) -> float:
        """Return dU/dI for a lasting current, negative [Ω].

        Polarisation counts in full; effects of the sign of the current alone, such as hysteresis,
        do not.
        """
        ohm = total(self.model.resistance_ohm)
        if not self.effects:
            return ohm
        usual_a = STEADY_C_RATE * self.capacity_ah
        change_a = STEADY_CHANGE * usual_a
        steady_v = [
            self._steady_extra_v(sign * usual_a + change)
            for sign in (1.0, -1.0)
            for change in (change_a, -change_a)
        ]
        return ohm + (steady_v[0] - steady_v[1] + steady_v[2] - steady_v[3]) / (4.0 * change_a)

    def _steady_extra_v(self, current_a: float) -> float:
        """Return the effects' voltage after a long constant current, at 50 % SoC [V]."""
        time_s = np.arange(0.0, STEADY_S, STEADY_STEP_S)
        constant = np.ones_like(time_s)
        state = PackState(
            time_s=time_s,
            current_a=current_a * constant,
            temperature_c=self.model.t_ref_c * constant,
            soc_pct=50.0 * constant,
            drop_v=current_a * total(self.model.resistance_ohm) * constant,
        )
        return float(self.extra_voltage(state)[-1])


class OnlineExtendedModel:
    """Sample-by-sample form of the extended model, for the estimator.

    Call `correct`, then `advance` for each reading it returns; `pseudo_ocv_at` then includes
    the effects' voltages.

    Parameters
    ----------
    extended : ExtendedModel
    capacity_ah : float, optional
        Capacity set by the user [Ah].
    """

    def __init__(self, extended: ExtendedModel, capacity_ah: float | None = None) -> None:
        self.model = extended.model
        self._extended = extended
        # Capacity and efficiency do not depend on the SoC.
        self._counting = extended.counting(50.0)
        self.capacity_ah = capacity_ah or self._counting.capacity_ah
        """Capacity for the Coulomb counter [Ah]."""
        self._effects = [
            effect.online(values, extended.model, extended.pack)
            for effect, values in extended.effects
        ]
        self._over_soc = [effect for effect in self._effects if effect.uses_soc]
        self._beside_soc = [effect for effect in self._effects if not effect.uses_soc]
        self._beside_soc_v = 0.0
        self._slope_at_least = SLOPE_AT_LEAST * extended.pack.voltage_v

    @cached_property
    def steady_ohm(self) -> float:
        """`ExtendedModel.steady_ohm`, computed once [Ω]."""
        return self._extended.steady_ohm()

    @property
    def plain(self) -> bool:
        """Whether there are no effects, so that nothing needs correcting or advancing."""
        return not self._effects

    @property
    def memory(self) -> list[tuple[float, float]]:
        """Resistance [Ω] and time constant [s] of the effects' voltages from earlier currents."""
        return [element for effect in self._effects for element in effect.memory]

    def initial_soc_pct(self, assumed_pct: float) -> float:
        """Return the SoC at which to start for an assumed one, within 0–100 [%]."""
        return min(max(self._extended.counting(assumed_pct).initial_soc_pct, 0.0), 100.0)

    def counted(self, current_a: float) -> float:
        """Return the counted part of a corrected current [A]."""
        return self._counting.counted_at(current_a)

    def correct(self, reading: Reading) -> Sequence[Reading]:
        """Return the corrected readings that are ready, usually one, in order."""
        readings: Sequence[Reading] = (reading,)
        for effect in self._effects:
            if len(readings) == 1:
                readings = effect.correct(readings[0])
            else:
                readings = [done for item in readings for done in effect.correct(item)]
        return readings

    def advance(
        self, time_s: float, current_a: float, temperature_c: float,
        delayed_current_a: Sequence[float],
    ) -> None:  # fmt: skip
        """Advance the effects' states to a corrected reading (every one, in order).

        Parameters
        ----------
        time_s, current_a : float
            Time [s] and current [A].
        temperature_c : float
            Latest known temperature [°C]; NaN before the first. Effects then use the reference
            temperature, but those that lag behind the temperature wait for the first known one.
        delayed_current_a : sequence of floats
            Current at each delay, from the delay line of corrected currents [A].
        """
        drop_v = 0.0
        for resistance, current in zip(self.model.resistance_ohm, delayed_current_a, strict=True):
            drop_v += resistance * current
        is_known = math.isfinite(temperature_c)
        for effect in self._effects:
            if is_known:
                effect.advance(time_s, current_a, temperature_c, drop_v)
            elif not effect.follows_temperature:
                effect.advance(time_s, current_a, self.model.t_ref_c, drop_v)
        self._beside_soc_v = total(item.extra_voltage(0.0) for item in self._beside_soc)

    def state(self) -> list[list[float]]:
        """Return the state of each effect, for `restore`."""
        return [effect.state() for effect in self._effects]

    def restore(self, state: Sequence[Sequence[float]], latest_s: float) -> None:
        """Continue from a saved state of the same effects.

        Parameters
        ----------
        state : sequence of sequences
        latest_s : float
            Time of the latest sample before [s]; NaN if there was none. No time in the state may
            be later.

        Raises
        ------
        InputError
            If the state does not belong to these effects or is malformed; names the effect.
        """
        if len(state) != len(self._effects):
            raise InputError(f"the model has {len(self._effects)} effects", field="effects")
        for number, (effect, of_effect) in enumerate(zip(self._effects, state, strict=True)):
            try:
                effect.restore(of_effect, latest_s)
            except ValueError as error:
                raise InputError(str(error), field=f"effects.{number}") from error

    def pseudo_ocv_at(self, soc_pct: float) -> tuple[float, float]:
        """Return the voltage without the model's drop and kt [V], and its slope [V per %].

        The effects' voltages at the latest reading are included. The slope is limited to positive
        values, for Newton's method and the filter: with an effect the voltage may fall over a few
        per cent of SoC (resistance that rises toward empty, while charging).
        """
        volts, slope = self.model.pseudo_ocv_at(soc_pct)
        volts += self._beside_soc_v
        if self._over_soc:
            volts += self._over_soc_v(soc_pct)
            above = self._over_soc_v(soc_pct + SLOPE_STEP_PCT)
            slope += (above - self._over_soc_v(soc_pct - SLOPE_STEP_PCT)) / (2.0 * SLOPE_STEP_PCT)
            slope = max(slope, self._slope_at_least)
        return volts, slope

    def _over_soc_v(self, soc_pct: float) -> float:
        return total(effect.extra_voltage(soc_pct) for effect in self._over_soc)

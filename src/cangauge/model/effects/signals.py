"""Effects on signals and charge: errors of sensors, clocks, thermometers and of the count.

The rows stand in the order of correction: sensors before quantities computed from their signals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from cangauge.logs.gaps import BRIDGE_S
from cangauge.model.effects.base import (
    Context,
    CoreForm,
    Counting,
    Effect,
    Memories,
    Pack,
    Parameter,
    Signals,
    Values,
)
from cangauge.model.first_order import Lag
from cangauge.model.voltage_model import VoltageModel

SMOOTHING_S: Final = 200.0
"""Time constant of the smoothed derivative [s]: short against the warming of a pack, long against
the steps of a sensor with whole degrees; the same for all lags, so that the effect is linear in
`tau_s`."""


def offset_and_gain(values: Values) -> tuple[float, float]:
    """Return the error of a sensor, measured = gain·true + offset, by its only parameter."""
    ((name, value),) = values.items()
    return (0.0, 1.0 + value / 100.0) if name == "gain_pct" else (value, 1.0)


def true_signals(field: str, signals: Signals, values: Values, _: Context) -> Signals:
    """Return the signals without the error of one sensor."""
    offset, gain = offset_and_gain(values)
    return signals._replace(**{field: (getattr(signals, field) - offset) / gain})


def sensor_form(kind: str, values: Values, *_: object) -> CoreForm:
    """Return the error of a sensor in the C core."""
    return CoreForm(kind, offset_and_gain(values))


def counted_form(*_: object) -> CoreForm:
    """Return the form of an effect that the C core applies in the count."""
    return CoreForm("no_effect")


class _Waiting:
    """Rows that wait for their current, and the currents that later rows need."""

    def __init__(self, skew_s: float) -> None:
        self._skew_s = skew_s
        self._waiting = np.empty((4, 0))
        self._currents = np.empty((2, 0))

    def step(self, signals: Signals, *, is_last: bool) -> Signals:
        """Append rows and return those whose current has come; all of them at the end."""
        self._waiting = np.concatenate([self._waiting, np.stack(signals)], axis=1)
        self._currents = np.concatenate([self._currents, np.stack(signals[:2])], axis=1)
        times, currents = self._currents
        at_s = self._waiting[0] + self._skew_s
        ready = at_s.size if is_last else int(np.searchsorted(at_s, times[-1], side="right"))
        time_s, _, voltage_v, temperature_c = self._waiting[:, :ready]
        skewed = np.interp(at_s[:ready], times, currents)
        self._waiting = self._waiting[:, ready:]
        upcoming_s = self._waiting[0, 0] if self._waiting.size else times[-1]
        stale = int(np.searchsorted(times, upcoming_s + self._skew_s, side="right")) - 1
        if stale > 64:  # not at each row
            self._currents = self._currents[:, stale:]
        return Signals(time_s, skewed, voltage_v, temperature_c)

    def state(self) -> list[float]:
        """Return the number of rows that wait, these, and the currents."""
        both = (self._waiting, self._currents)
        return [float(self._waiting.shape[1]), *np.concatenate(both, axis=None).tolist()]

    def restore(self, state: Sequence[float]) -> None:
        """Continue from a saved state; raise ValueError if it is of something else."""
        count, *numbers = state
        waiting, currents = np.split(np.array(numbers), [4 * int(count)])
        self._waiting, self._currents = waiting.reshape(4, -1), currents.reshape(2, -1)


def skewed_current(signals: Signals, _: Values, at: Context) -> Signals:
    """Return the signals with the current of the moment of their voltage."""
    realigned: Signals = at.memory[0].step(signals, is_last=at.is_whole)
    return realigned


def skew_memory(values: Values, _: Pack) -> Memories:
    """Return the rows that wait."""
    return (_Waiting(values["skew_s"]),)


def skew_form(values: Values, *_: object) -> CoreForm:
    """Return the skew in the C core, which delays every sample where it is not 0."""
    return CoreForm("time_skew", (values["skew_s"],)) if values["skew_s"] else counted_form()


def ahead_of_lag(signals: Signals, values: Values, at: Context) -> Signals:
    """Return the signals with the temperature ahead of a slow sensor."""
    measured = signals.temperature_c
    ahead = values["tau_s"] / SMOOTHING_S
    smooth = at.memory[0].step(signals.time_s, measured)
    return signals._replace(temperature_c=measured + ahead * (measured - smooth))


def lag_memory(*_: object) -> Memories:
    """Return the smoothed temperature."""
    return (Lag(SMOOTHING_S),)


def lag_form(values: Values, *_: object) -> CoreForm:
    """Return the lag in the C core."""
    return CoreForm("temperature_lag", (values["tau_s"] / SMOOTHING_S,), (SMOOTHING_S,))


def core_temperature(signals: Signals, values: Values, at: Context) -> Signals:
    """Return the signals with the temperature of the core."""
    time_s, current_a, _, outside = signals
    heat = at.memory[0].step(time_s, (current_a / at.pack.capacity_ah) ** 2)
    core = outside + values["rise_k"] * heat
    if values["late"]:
        core = core + values["late"] * (at.memory[1].step(time_s, outside) - outside)
    return signals._replace(temperature_c=core)


def core_temperature_memory(values: Values, _: Pack) -> Memories:
    """Return the heat, and where the core is late, the outside temperature."""
    heat = Lag(values["tau_s"], 0.0, rest_s=BRIDGE_S)
    return (heat, Lag(values["tau_s"])) if values["late"] else (heat,)


def core_temperature_form(values: Values, _: VoltageModel, pack: Pack) -> CoreForm:
    """Return the thermal model in the C core."""
    constants = (values["rise_k"], values["late"], pack.capacity_ah)
    return CoreForm("core_temperature", constants, (values["tau_s"],) * 2)


def changed_capacity(counting: Counting, values: Values) -> Counting:
    """Return the count with another capacity."""
    capacity_ah = counting.capacity_ah * (1.0 + values["change_pct"] / 100.0)
    return replace(counting, capacity_ah=capacity_ah)


def changed_start(counting: Counting, values: Values) -> Counting:
    """Return the count from another start."""
    return replace(counting, initial_soc_pct=counting.initial_soc_pct + values["offset_pct"])


def changed_efficiency(counting: Counting, values: Values) -> Counting:
    """Return the count with a loss while charging."""
    efficiency = counting.charge_efficiency * values["efficiency"]
    return replace(counting, charge_efficiency=efficiency)


CORRECTIONS: Final = (
    # Or an unmeasured parasitic load (with opposite sign).
    Effect(
        id="current_offset",
        fault="current_reading",
        parameters=(Parameter("offset_a", "A", -0.15, 0.15, healthy_std=5e-4),),
        about="""
            **Signature.** a constant R·b, and a slope over time as the count drifts: OCV′·b·t/C

            **Separated by** a long rest with the bus awake: the count drifts while no current
            flows. Not separable from a load that bypasses the sensor; from capacity by alternating
            driving and resting

            **Source.** zero error, JCGM 200:2012 (VIM)
            """,
        equation="I = I_measured − b",
        correct=partial(true_signals, "current_a"),
        core_form=partial(sensor_form, "current_sensor"),
    ),
    Effect(
        id="current_gain",
        fault="current_reading",
        parameters=(Parameter("gain_pct", "%", -10.0, 10.0),),
        about="""
            **Signature.** a scaled drop over the resistance, and a slope over SoC as the count is
            scaled

            **Separated by** a drive at high current over little SoC (drop) against a long gentle
            one (count); not separable from a joint change of capacity and resistance

            **Source.** sensitivity error, JCGM 200:2012 (VIM)
            """,
        equation="I = I_measured / (1 + g)",
        correct=partial(true_signals, "current_a"),
        core_form=partial(sensor_form, "current_sensor"),
    ),
    Effect(
        id="voltage_offset",
        fault="voltage_reading",
        parameters=(Parameter("offset_v", "V", -0.04, 0.04, healthy_std=2e-4),),
        about="""
            **Signature.** a constant, at any current, SoC and temperature

            **Separated by** a log over much SoC: the error of an initial SoC shrinks where the OCV
            is flat, that of a gain follows the voltage, this one is constant; or the voltage with
            open contactors

            **Source.** zero error, JCGM 200:2012 (VIM)
            """,
        equation="U = U_measured − b",
        correct=partial(true_signals, "voltage_v"),
        core_form=partial(sensor_form, "voltage_sensor"),
    ),
    Effect(
        id="voltage_gain",
        fault="voltage_reading",
        parameters=(Parameter("gain_pct", "%", -4.0, 4.0),),
        about="""
            **Signature.** in proportion to the voltage: nearly constant, a little smaller near
            empty

            **Separated by** a log from full to empty: at one SoC it is not separable from
            voltage_offset, since the voltage of a pack varies by only a fifth

            **Source.** sensitivity error, JCGM 200:2012 (VIM)
            """,
        equation="U = U_measured / (1 + g)",
        correct=partial(true_signals, "voltage_v"),
        core_form=partial(sensor_form, "voltage_sensor"),
    ),
    # The current is interpolated, never the voltage: averaging neighbouring voltages would reduce
    # their noise and look like an improvement. Online, with a positive skew, a voltage is held
    # until its current arrives, so estimates are `skew_s` late. The last rows of a whole log, whose
    # current never arrives, use the last current.
    Effect(
        id="time_skew",
        fault="clock",
        parameters=(Parameter("skew_s", "s", -4.0, 4.0, healthy_std=0.0125),),
        about="""
            **Signature.** ∝ R·dI/dt: spikes of either sign at every change of load

            **Separated by** a log at 10 Hz or faster: a skew gives spikes of both signs and the
            same area at both ends of a pulse, fast_polarization a tail after each

            **Source.** definition
            """,
        equation="I(t) = I_measured(t + skew)",
        correct=skewed_current,
        memory=skew_memory,
        core_form=skew_form,
        moves_time=True,
    ),
    # A constant error of the thermometer. Without it a warm reading looks like a low resistance.
    Effect(
        id="temperature_offset",
        fault="temperature",
        parameters=(Parameter("offset_k", "K", -20.0, 20.0, healthy_std=0.375),),
        about="""
            **Signature.** kt·x and the drop over the resistance as if warmer, throughout the log

            **Separated by** a second thermometer; a resistance that has grown leaves the voltage at
            rest as it is

            **Source.** zero error, JCGM 200:2012 (VIM)
            """,
        equation="T = T_measured − x",
        correct=partial(true_signals, "temperature_c"),
        core_form=partial(sensor_form, "temperature_sensor"),
    ),
    # Undone with a causal smoothed derivative.
    Effect(
        id="temperature_lag",
        fault="temperature",
        parameters=(Parameter("tau_s", "s", 0.0, 2000.0),),
        about="""
            **Signature.** kt·τ·dT/dt: while the pack warms or cools, zero at constant temperature

            **Separated by** warming or cooling from outside without current: core_temperature needs
            current

            **Source.** first-order response of a sensor; Michalski et al., Temperature Measurement,
            2001
            """,
        equation="T = T_measured + τ·dT_measured/dt, the derivative smoothed over 200 s",
        correct=ahead_of_lag,
        memory=lag_memory,
        core_form=lag_form,
    ),
    # The thermal insulation also delays changes of the ambient temperature, with the same time
    # constant: `late` is the fraction of them that the core follows with the lag (1: the whole cell
    # is core). It has an effect only in a model with a temperature coefficient, or together with an
    # effect that uses the temperature.
    Effect(
        id="core_temperature",
        fault="temperature",
        parameters=(
            Parameter("rise_k", "K", 0.0, 25.0),
            Parameter("late", "1", 0.0, 1.0),
            Parameter(
                "tau_s",
                "s",
                150.0,
                4000.0,
                grid=(200.0, 500.0, 1000.0, 2000.0, 3500.0),
            ),
        ),
        about="""
            **Signature.** kt times low-passed I²: it builds up over minutes of high current of
            either sign; and the negative change of the measured temperature over the same time

            **Separated by** high current of alternating sign at constant SoC: slow_diffusion,
            linear in I, cancels; temperature_lag follows the sensor and not the current

            **Source.** two-state thermal model, Forgez et al., J. Power Sources 195 (2010) 2961
            """,
        equation=(
            "T = T_m + ΔT + late·(T_τ − T_m),  τ·dΔT/dt = rise·(I/C)² − ΔT (rise: at a lasting"
            " 1 C), τ·dT_τ/dt = T_m − T_τ"
        ),
        correct=core_temperature,
        memory=core_temperature_memory,
        core_form=core_temperature_form,
    ),
)

COUNTS: Final = (
    # By ageing, cold or a wrong data sheet.
    Effect(
        id="capacity",
        fault="capacity",
        parameters=(Parameter("change_pct", "%", -35.0, 35.0, healthy_std=0.125),),
        about="""
            **Signature.** OCV′·(Ah since the start): a slope over charge, steep in the knee near
            empty

            **Separated by** a discharge from full to the knee at steady temperature; from
            current_offset by alternating driving and resting, from current_gain by the drop over
            the resistance

            **Source.** Plett, Battery Management Systems vol. II, Artech House 2015, ch. 4
            """,
        equation="S = S₀ − 100·∫I dt / (C·(1 + x))",
        count=changed_capacity,
        core_form=counted_form,
    ),
    # A property of a log, not of a pack. Online it is added to the initial SoC given by the user;
    # an initial SoC from the first voltage needs no correction.
    Effect(
        id="initial_soc",
        fault="start",
        parameters=(Parameter("offset_pct", "%", -15.0, 15.0, healthy_std=0.175),),
        about="""
            **Signature.** OCV′(S): larger where the OCV is steep, at any current and time

            **Separated by** a long rest before the start (the first voltage is then the OCV), or a
            log that reaches the steep ends of the OCV, where it grows and voltage_offset does not

            **Source.** definition
            """,
        equation="S₀ = S₀_assumed + x",
        count=changed_start,
        core_form=counted_form,
    ),
    # Cells lose less than a tenth. A larger loss is a sensor that reads charging too high, or
    # charge that bypasses it, with the same signature.
    Effect(
        id="coulombic_efficiency",
        fault="capacity",
        parameters=(Parameter("efficiency", "1", 0.85, 1.0, neutral=1.0),),
        about="""
            **Signature.** OCV′·(Ah charged since the start): a drift that grows with regeneration
            only

            **Separated by** logs with much and with little regeneration over the same discharge, or
            a full charge within the log; not separable from capacity and current_offset in a plain
            drive

            **Source.** Plett, Battery Management Systems vol. II, Artech House 2015, ch. 1
            """,
        equation="S = S₀ − 100·∫(I⁺ + η·I⁻)dt / C",
        count=changed_efficiency,
        core_form=counted_form,
    ),
)

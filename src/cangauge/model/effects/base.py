"""Parameters of effects and their physical bounds, relative to a pack's sizes.

What a log's current leaves behind: delayed and lagged currents, each worked out once.

Many effects and shapes ask for the same ones, which are most of the work on a long log. What
follows the temperature or the count of charge may change meanwhile; the current's history stays.

What effects act on: measured signals, the count of charge, and the state that follows.

The temperature of the cells' inside, which may follow the measured one late.

What an effect is: a named mechanism at the pack's terminals, offline and online.

An effect acts in one or more of three places, in this order:

1. `correct`: the measured signals become what a perfect sensor would have shown
   (current_offset, voltage_gain, time_skew, temperature_lag …);
2. `count`: how charge becomes SoC (capacity, initial_soc, coulombic_efficiency);
3. `extra_voltage`: a voltage on top of the voltage model (resistances, dynamics, hysteresis …).

Offline works on whole logs as arrays, online on one sample at a time; both are written in the
effect's file and must agree. With neutral values an effect does nothing.

Parameters are amplitudes, which enter the voltage (nearly) linearly and have a neutral value, or
shapes (a time constant, a moment), which have values to try and mean nothing alone. `time_skew`
has a single parameter that is both. A few are constants, taken from the pack once
(`Parameter.from_pack`).

Labels are signatures seen at the terminals, not proof of a mechanism.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Final, Literal, NamedTuple

import numpy as np

from cangauge._typing import FloatArray
from cangauge.model.charge import BRIDGE_S, discharged_ah
from cangauge.model.delay_line import delayed_currents
from cangauge.model.effects.first_order import LowPass, low_passed
from cangauge.model.voltage_model import VoltageModel

# --- Parameters of effects and their physical bounds, relative to a pack's sizes

Scale = Literal["one", "capacity", "voltage", "resistance"]

WITHIN_C: Final = (-60.0, 120.0)
"""Beyond these no temperature of a pack is believed [°C]; laws of temperature are held there."""

RESISTANCE_AT_LEAST = 0.002
"""Least resistance that bounds are relative to, in voltage over 1 C current (a Leaf has 0.018): a
model whose resistances happen to cancel must not shut every resistance effect out."""

LEEWAY = 10.0
"""Bounds that are relative to the pack are this much wider in a model that has effects: the pack's
sizes are read off its coefficients, and effects such as RC elements may have taken most of its
resistance from these. A wrong unit is still found."""


@dataclass(frozen=True)
class Pack:
    """Sizes that bounds are relative to, so that one library fits a cell and an 800 V pack."""

    voltage_v: float
    """Pseudo-OCV at half charge [V]."""
    capacity_ah: float
    resistance_ohm: float
    """Sum of the model's resistances, positive [Ω]."""
    cells: int
    """Cells in series, from `voltage_v` at about 3.7 V a cell."""
    temperature_c: float = 25.0
    """Middle of the temperatures that the model was identified on [°C]."""

    @classmethod
    def of(cls, model: VoltageModel, capacity_ah: float) -> Pack:
        """Return the sizes of the pack that a model describes."""
        volts = model.pseudo_ocv_at(50.0)[0]
        coldest, hottest = WITHIN_C
        return cls(
            voltage_v=volts,
            capacity_ah=capacity_ah,
            resistance_ohm=max(
                abs(sum(model.resistance_ohm)), RESISTANCE_AT_LEAST * volts / capacity_ah
            ),
            cells=max(1, round(volts / 3.7)),
            temperature_c=min(max(0.5 * sum(model.temperature_range_c), coldest), hottest),
        )


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect.

    Parameters
    ----------
    name, unit : str
    low, high : float
        Physical bounds, in units of `scale`.
    neutral : float, optional
        Value at which the effect does nothing, in units of `scale`; None for a shape that has no
        such value.
    scale : {"one", "capacity", "voltage", "resistance"}
        What the bounds are multiplied by to get the parameter's unit.
    grid : tuple of floats, optional
        Values to try for a shape (a time constant, a moment); amplitudes have none and enter the
        voltage nearly linearly.
    from_pack : {"temperature_c"}, optional
        A constant that is neither fitted nor tried: this of the pack's sizes when the effect is
        added, and kept from then on, whatever becomes of the model.
    elsewhere : tuple of float, optional
        What a diagnosis tries and a fit does not. Of a shape: further values. Of such a constant:
        what is added to it; a fit's coefficients, which move with the effect, take up the
        difference.
    formerly : float, optional
        What it was before it was a parameter, in units of `scale`: that of a file without it.
    is_moment : bool
        Of a shape: a time of the log at which the voltage jumps.
    """

    name: str
    unit: str
    low: float
    high: float
    neutral: float | None = 0.0
    scale: Scale = "one"
    grid: tuple[float, ...] | None = None
    from_pack: Literal["temperature_c"] | None = None
    elsewhere: tuple[float, ...] = ()
    formerly: float | None = None
    is_moment: bool = False

    def factor(self, pack: Pack) -> float:
        """Return what turns bounds and grid into the parameter's unit for a pack."""
        sizes = {
            "one": 1.0,
            "capacity": pack.capacity_ah,
            "voltage": pack.voltage_v,
            "resistance": pack.resistance_ohm,
        }
        return sizes[self.scale]

    def bounds(self, pack: Pack, leeway: float = 1.0) -> tuple[float, float]:
        """Return the physical bounds in the parameter's unit.

        Those that are relative to the pack are `leeway` times wider (`LEEWAY`).
        """
        factor = self.factor(pack)
        low, high = self.low * factor, self.high * factor
        if self.scale != "one":
            low, high = (low * leeway if low < 0.0 else low / leeway), high * leeway
        return low, high

    def trials(self, pack: Pack) -> tuple[float, ...]:
        """Return the values to try for a shape, in the parameter's unit; none for an amplitude."""
        factor = self.factor(pack)
        return tuple(value * factor for value in self.grid or ())


# --- What a log's current leaves behind: delayed and lagged currents, each worked out once

MOST_LAGS = 64
"""No more are kept: all shapes of all effects ask for some fifty."""


@dataclass(frozen=True, eq=False)
class CurrentHistory:
    """A current over a whole log, n samples, positive = discharge. No array is to be written to."""

    time_s: FloatArray
    current_a: FloatArray
    _lagged_a: dict[float, FloatArray] = field(default_factory=dict, init=False, repr=False)
    _lagged_a2: dict[float, FloatArray] = field(default_factory=dict, init=False, repr=False)
    _delayed_a: dict[tuple[float, ...], FloatArray] = field(
        default_factory=dict, init=False, repr=False
    )

    def lagged_a(self, tau_s: float) -> FloatArray:
        """Return the current behind a first-order lag [A], shape (n,), at rest before the log."""
        if tau_s not in self._lagged_a:
            while len(self._lagged_a) >= MOST_LAGS:  # a fit asks for ever new ones
                del self._lagged_a[next(iter(self._lagged_a))]
            self._lagged_a[tau_s] = low_passed(
                self.time_s, self.current_a, tau_s, 0.0, rest_s=BRIDGE_S
            )
        return self._lagged_a[tau_s]

    def lagged_a2(self, tau_s: float) -> FloatArray:
        """Return the square of the current behind such a lag [A²], shape (n,)."""
        if tau_s not in self._lagged_a2:
            self._lagged_a2[tau_s] = low_passed(
                self.time_s, self.current_a**2, tau_s, 0.0, rest_s=BRIDGE_S
            )
        return self._lagged_a2[tau_s]

    def delayed_a(self, delay_s: tuple[float, ...]) -> FloatArray:
        """Return I(t − dj) [A], shape (n, len(delay_s))."""
        if delay_s not in self._delayed_a:
            self._delayed_a[delay_s] = delayed_currents(
                self.time_s, self.current_a, delay_s, self.time_s
            )
        return self._delayed_a[delay_s]

    @cached_property
    def out_ah(self) -> FloatArray:
        """Charge taken out since the first sample [Ah], shape (n,)."""
        return discharged_ah(self.time_s, self.current_a)


def history_of(
    time_s: FloatArray, current_a: FloatArray, remembered: CurrentHistory | None
) -> CurrentHistory:
    """Return what is remembered, if it is of these very arrays, or a new history."""
    if remembered is not None and remembered.current_a is current_a and remembered.time_s is time_s:
        return remembered
    return CurrentHistory(time_s, current_a)


# --- What effects act on: measured signals, the count of charge, and the state that follows

AT_ONCE_S: Final = 1e-3
"""A lag up to this is none [s]."""


@dataclass(frozen=True, eq=False)
class Signals:
    """Measured signals of one log, shape (n,) each; positive current discharges."""

    time_s: FloatArray
    current_a: FloatArray
    voltage_v: FloatArray
    temperature_c: FloatArray
    remembered: CurrentHistory | None = None
    """The current's history, of use as long as it is the same current."""

    @property
    def history(self) -> CurrentHistory:
        """The current's history: what is remembered of it, or a new one."""
        return history_of(self.time_s, self.current_a, self.remembered)

    def remembering(self) -> Signals:
        """Return the signals with a history that lasts as long as the current does."""
        return replace(self, remembered=CurrentHistory(self.time_s, self.current_a))


@dataclass(frozen=True)
class Counting:
    """How charge becomes SoC: S = S0 − 100·∫(I⁺ + η·I⁻)dt / C."""

    capacity_ah: float
    initial_soc_pct: float
    charge_efficiency: float = 1.0
    """η: part of the charge put in that can be taken out again."""

    def counted(self, current_a: FloatArray) -> FloatArray:
        """Return I⁺ + η·I⁻ [A], shape (n,): the current whose charge counts."""
        if self.charge_efficiency == 1.0:
            return current_a
        return np.where(current_a < 0.0, self.charge_efficiency * current_a, current_a)

    def counted_at(self, current_a: float) -> float:
        """Return I⁺ + η·I⁻ [A] of one sample."""
        return self.charge_efficiency * current_a if current_a < 0.0 else current_a


@dataclass(frozen=True, eq=False)
class PackState:
    """What an extra voltage may depend on, shape (n,) each, after correction and counting."""

    time_s: FloatArray
    current_a: FloatArray
    temperature_c: FloatArray
    soc_pct: FloatArray
    drop_v: FloatArray
    """Σ Rj·I(t − dj) of the voltage model [V]; negative while discharging."""
    remembered: CurrentHistory | None = None
    """The history of that current, where it is known already."""
    _inside_c: dict[float, FloatArray] = field(default_factory=dict, init=False, repr=False)
    _slopes: dict[VoltageModel, FloatArray] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def history(self) -> CurrentHistory:
        """The current's history."""
        return history_of(self.time_s, self.current_a, self.remembered)

    def inside_c(self, lag_s: float) -> FloatArray:
        """Return the temperature of cells that follow the measured one late [°C], shape (n,).

        At first the measured one; kept like the lagged currents.
        """
        if lag_s not in self._inside_c:
            measured = self.temperature_c
            self._inside_c[lag_s] = (
                low_passed(self.time_s, measured, lag_s, float(measured[0]))
                if lag_s > AT_ONCE_S
                else measured
            )
        return self._inside_c[lag_s]

    def ocv_slope(self, model: VoltageModel) -> FloatArray:
        """Return the slope of a model's pseudo-OCV [V per %], shape (n,); kept as well."""
        if model not in self._slopes:
            self._slopes[model] = model.pseudo_ocv_slope(self.soc_pct)
        return self._slopes[model]

    def scaled_drop_v(self, delayed: float, pack: Pack) -> FloatArray:
        """Return the drop that an effect scales [V], shape (n,) (`DELAYED`)."""
        now_v = -pack.resistance_ohm * self.current_a
        return delayed * self.drop_v + (1.0 - delayed) * now_v


def scaled_drop_at(drop_v: float, current_a: float, delayed: float, resistance_ohm: float) -> float:
    """Return the same of one sample, the pack's resistance being `resistance_ohm`."""
    return delayed * drop_v + (1.0 - delayed) * (-resistance_ohm * current_a)


DELAYED: Final = Parameter("delayed", "1", 0.0, 1.0, neutral=None, grid=(1.0, 0.0))
"""Whether an effect scales the whole drop of the voltage model (1), or only that of the current
now, over the sum of the resistances (0): contacts and electrolyte answer at once, diffusion not.
In between it scales a mixture of both."""


# --- The temperature of the cells' inside, which may follow the measured one late

LAG = Parameter(
    "lag_s", "s", 0.0, 10000.0, neutral=None, grid=(0.0,), elsewhere=(600.0, 1800.0), formerly=0.0
)
"""How late (0: at once; `PackState.inside_c`). Only a diagnosis tries others: on a day on which the
pack warms, what the inside does tells causes apart."""


class Inside:
    """That temperature, one sample at a time."""

    def __init__(self, lag_s: float) -> None:
        self._lag = LowPass(lag_s) if lag_s > AT_ONCE_S else None

    @property
    def is_late(self) -> bool:
        """Whether it follows late."""
        return self._lag is not None

    def step(self, time_s: float, measured_c: float) -> float:
        """Take one sample and return the temperature inside [°C]."""
        return measured_c if self._lag is None else self._lag.step(time_s, measured_c)

    def memory(self) -> list[float]:
        """Return what is to be remembered of earlier samples."""
        return [] if self._lag is None else self._lag.memory()

    def remember(self, memory: Sequence[float], latest_s: float) -> None:
        """Go on from a memory, no later than `latest_s` [s]; may raise ValueError."""
        if self._lag is not None:
            self._lag.remember(memory, latest_s)
        elif memory:
            raise ValueError("follows at once, and remembers nothing")


# --- What an effect is: a named mechanism at the pack's terminals, offline and online

Values = Mapping[str, float]
"""Parameter name → value, in the parameter's unit."""

Family = Literal[
    "current_sensing",
    "voltage_sensing",
    "thermal",
    "timing",
    "charge",
    "resistance",
    "dynamics",
    "equilibrium",
    "imbalance",
]


class Reading(NamedTuple):
    """One sample on its way through the corrections.

    Voltage and temperature may be NaN where that signal is missing; current never is.
    """

    time_s: float
    current_a: float
    """Positive = discharge [A]."""
    voltage_v: float
    temperature_c: float


class OnlineEffect:
    """An effect at work in the estimator: its state, advanced one sample at a time."""

    uses_soc: ClassVar[bool] = False
    """Whether `extra_voltage` depends on the SoC that it is asked for."""

    follows_temperature: bool = False
    """Whether it follows the temperature late: then it begins with the first one that is known."""

    def correct(self, reading: Reading) -> Sequence[Reading]:
        """Return what perfect sensors would have shown, as far as it is known by now.

        Mostly one reading for each that comes in. An effect that needs a later current for a
        voltage (`time_skew`) holds readings back and gives them out, in order and with their own
        times, once it knows; nothing is made up or dropped.
        """
        return (reading,)

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        """Carry the state to this sample (corrected values; every sample, in order)."""

    def extra_voltage(self, soc_pct: float) -> float:
        """Return the extra voltage at this sample if the SoC were `soc_pct` [V]; no side effect."""
        del soc_pct
        return 0.0

    def memory(self) -> list[float]:
        """Return what is to be remembered of earlier samples; NaN where nothing is known yet."""
        return []

    def remember(self, memory: Sequence[float], latest_s: float) -> None:
        """Go on from a memory of the same effect.

        Parameters
        ----------
        memory : sequence of floats
        latest_s : float
            Time of the latest sample before [s]; NaN: none came yet. No time in the memory may
            lie after it, for time would run backwards.

        Raises
        ------
        ValueError
            If it is none.
        """
        del latest_s
        if memory:
            raise ValueError("this effect remembers nothing")


class Effect(ABC):
    """A mechanism that the baseline model lacks."""

    id: ClassVar[str]
    family: ClassVar[Family]
    parameters: ClassVar[tuple[Parameter, ...]]
    signature: ClassVar[str]
    """What it looks like in U_measured − U_model, in words."""
    equation: ClassVar[str]
    source: ClassVar[str]
    separated_by: ClassVar[str]
    """What test would tell it from its look-alikes."""
    is_cause: ClassVar[bool] = True
    """Whether the diagnosis may name it; else it is structure that only clean logs teach."""
    is_structure: ClassVar[bool] = False
    """Whether a healthy pack may have it for good: what the references show of it is no cause."""
    bends_at: ClassVar[tuple[float, ...]] = ()
    """Parts of the widest bound of its only amplitude at which the diagnosis takes the voltage's
    change, beside a small one: for effects that are far from linear in their amplitude."""

    @property
    def amplitudes(self) -> tuple[Parameter, ...]:
        """Parameters without values to try: they enter the voltage nearly linearly."""
        return tuple(
            parameter
            for parameter in self.parameters
            if parameter.grid is None and parameter.from_pack is None
        )

    @property
    def shapes(self) -> tuple[Parameter, ...]:
        """Parameters with values to try."""
        return tuple(parameter for parameter in self.parameters if parameter.grid is not None)

    @property
    def adds_voltage_only(self) -> bool:
        """Whether it leaves signals and count alone: then its voltage is all that it changes."""
        kind = type(self)
        return kind.correct is Effect.correct and kind.count is Effect.count

    def constants(self, pack: Pack) -> dict[str, float]:
        """Return the parameters that are taken from the pack when the effect is added to it."""
        return {
            parameter.name: float(getattr(pack, parameter.from_pack))
            for parameter in self.parameters
            if parameter.from_pack is not None
        }

    def constants_to_try(self, pack: Pack) -> list[dict[str, float]]:
        """Return the constants, those of the pack first, and what a diagnosis tries beside them."""
        tried = [self.constants(pack)]
        for parameter in self.parameters:
            if parameter.from_pack is None:
                continue
            low, high = parameter.bounds(pack)
            for beside in parameter.elsewhere:
                value = min(max(tried[0][parameter.name] + beside, low), high)
                tried.append(tried[0] | {parameter.name: value})
        return tried

    def neutral(self, pack: Pack) -> dict[str, float]:
        """Return values with which the effect does nothing."""
        values = self.constants(pack)
        for parameter in self.parameters:
            if parameter.from_pack is not None:
                continue
            if parameter.neutral is None:
                trials = parameter.trials(pack)
                values[parameter.name] = trials[len(trials) // 2]
            else:
                values[parameter.name] = parameter.neutral * parameter.factor(pack)
        return values

    def within(self, values: Values, pack: Pack) -> dict[str, float]:
        """Return values with the amplitudes held within what a file for a pack may say."""
        held = dict(values)
        for parameter in self.amplitudes:
            low, high = parameter.bounds(pack, LEEWAY)
            held[parameter.name] = min(max(held[parameter.name], low), high)
        return held

    def trials(self, parameter: Parameter, pack: Pack, time_s: FloatArray) -> tuple[float, ...]:
        """Return the values to try for a shape on a log with these times, in its unit.

        The k-th value means the same on every log of a group that shares one cause.
        """
        del time_s
        return parameter.trials(pack)

    def correct(self, signals: Signals, values: Values, pack: Pack) -> Signals:
        """Return the signals as perfect sensors would have shown them."""
        del values, pack
        return signals

    def count(self, counting: Counting, values: Values) -> Counting:
        """Return how charge is counted with the effect."""
        del values
        return counting

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray | None:
        """Return the extra voltage [V], shape (n,), or None if the effect adds none."""
        del state, values, model, pack
        return None

    @abstractmethod
    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the effect at work, from the first sample on."""

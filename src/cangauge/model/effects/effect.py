"""What an effect is: a named mechanism at the pack's terminals, offline and online.

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
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cangauge.model.effects.pack_state import Counting, PackState, Signals
from cangauge.model.effects.parameter import LEEWAY, Pack, Parameter
from cangauge.model.voltage_model import VoltageModel

FloatArray = NDArray[np.float64]
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

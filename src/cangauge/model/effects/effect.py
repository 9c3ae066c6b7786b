"""What an effect is: a named mechanism at the pack's terminals, offline and online.

An effect acts in one or more of three places, in this order:

1. `correct`: the measured signals become what a perfect sensor would have shown
   (current_offset, voltage_gain, time_skew, temperature_lag …);
2. `count`: how charge becomes SoC (capacity, initial_soc, coulombic_efficiency);
3. `extra_voltage`: a voltage on top of the voltage model (resistances, dynamics, hysteresis …).

Offline works on whole logs as arrays, online on one sample at a time; both are written in the
effect's file and must agree. With neutral values an effect does nothing.

Labels are signatures seen at the terminals, not proof of a mechanism.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

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

Scale = Literal["one", "capacity", "voltage", "resistance"]


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

    @classmethod
    def of(cls, model: VoltageModel, capacity_ah: float) -> Pack:
        """Return the sizes of the pack that a model describes."""
        volts = model.pseudo_ocv_at(50.0)[0]
        return cls(
            voltage_v=volts,
            capacity_ah=capacity_ah,
            resistance_ohm=abs(sum(model.resistance_ohm)),
            cells=max(1, round(volts / 3.7)),
        )


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect.

    Parameters
    ----------
    name, unit : str
    low, high : float
        Physical bounds, in units of `scale`.
    neutral : float
        Value at which the effect does nothing (amplitudes); ignored for shapes.
    scale : {"one", "capacity", "voltage", "resistance"}
        What the bounds are multiplied by to get the parameter's unit.
    grid : tuple of floats, optional
        Values to try for a shape (a time constant, a moment); amplitudes have none and enter the
        voltage nearly linearly.
    """

    name: str
    unit: str
    low: float
    high: float
    neutral: float = 0.0
    scale: Scale = "one"
    grid: tuple[float, ...] | None = None

    def factor(self, pack: Pack) -> float:
        """Return what turns bounds and grid into the parameter's unit for a pack."""
        sizes = {
            "one": 1.0,
            "capacity": pack.capacity_ah,
            "voltage": pack.voltage_v,
            "resistance": pack.resistance_ohm,
        }
        return sizes[self.scale]

    def bounds(self, pack: Pack) -> tuple[float, float]:
        """Return the physical bounds in the parameter's unit."""
        factor = self.factor(pack)
        return self.low * factor, self.high * factor


@dataclass(frozen=True, eq=False)
class Signals:
    """Measured signals of one log, shape (n,) each; positive current discharges."""

    time_s: FloatArray
    current_a: FloatArray
    voltage_v: FloatArray
    temperature_c: FloatArray


@dataclass(frozen=True)
class Counting:
    """How charge becomes SoC: S = S0 − 100·∫(I⁺ + η·I⁻)dt / C."""

    capacity_ah: float
    initial_soc_pct: float
    charge_efficiency: float = 1.0
    """η: part of the charge put in that can be taken out again."""


@dataclass(frozen=True, eq=False)
class PackState:
    """What an extra voltage may depend on, shape (n,) each, after correction and counting."""

    time_s: FloatArray
    current_a: FloatArray
    temperature_c: FloatArray
    soc_pct: FloatArray
    drop_v: FloatArray
    """Σ Rj·I(t − dj) of the voltage model [V]; negative while discharging."""


class OnlineEffect:
    """An effect at work in the estimator: its state, advanced one sample at a time."""

    def correct(
        self, time_s: float, current_a: float, voltage_v: float, temperature_c: float
    ) -> tuple[float, float, float]:
        """Return current, voltage and temperature as a perfect sensor would have shown them."""
        del time_s
        return current_a, voltage_v, temperature_c

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        """Carry the state to this sample (corrected values; every sample, in order)."""

    def extra_voltage(self, soc_pct: float) -> float:
        """Return the extra voltage at this sample if the SoC were `soc_pct` [V]; no side effect."""
        del soc_pct
        return 0.0


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

    def correct(self, signals: Signals, values: Values) -> Signals:
        """Return the signals as perfect sensors would have shown them."""
        del values
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

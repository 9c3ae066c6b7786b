"""Interface of an effect: a named mechanism at the pack's terminals.

An effect acts in up to three places, in this order:

1. `correct`: measured signals → what ideal sensors would have shown
   (current_offset, voltage_gain, time_skew, temperature_lag …);
2. `count`: how charge becomes SoC (capacity, initial_soc, coulombic_efficiency);
3. `drive` and `over_soc`: a voltage added to the voltage model's, the product of a part that
   follows from the signals and a part that follows from the SoC (resistances, hysteresis …).

Everything is written once, over arrays. A log is one call; the estimator calls with arrays of one
row and keeps the effect's `memory` in between. At its neutral values an effect changes nothing.

Parameters are of two kinds. *Amplitudes* have a neutral value and enter the voltage (nearly)
linearly, except for a shift in time. *Shapes* (a time constant, a change point) have a grid of
trial values and no meaning without an amplitude.

An effect is a signature at the terminals; it does not prove a mechanism. It sees the model only
through its pseudo-OCV, the slope of that, and its drop over the resistances.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.logs.log import Log
from cangauge.model.voltage_model import PLAUSIBLE_C, VoltageModel

if TYPE_CHECKING:
    from cangauge.model.extended import ExtendedModel

FaultName = Literal[
    "voltage_reading",
    "current_reading",
    "start",
    "capacity",
    "clock",
    "temperature",
    "resistance",
    "slow_voltage",
    "weak_cell",
]
"""What an engineer would repair; each shows as one of several effects."""

Values = Mapping[str, float]
"""Parameter name → value, in the parameter's unit."""

Memories = Sequence[Any]
"""What an effect carries from sample to sample: objects such as `Lag`.

`state()` returns the numbers that one needs to go on, and `restore(state)` takes them. A lag has
none before the first sample."""

RESISTANCE_AT_LEAST = 0.002
"""Lower limit of the resistance that bounds scale with, as voltage drop at 1 C relative to the
pack voltage (0.018 for a Leaf): coefficients that happen to cancel must not exclude every
resistance effect."""

BOUND_MARGIN = 10.0
"""Factor by which bounds relative to the pack are widened in a model with effects. The pack's sizes
come from its coefficients, and effects such as RC elements may have taken over most of its
resistance. A wrong unit is still detected."""


@dataclass(frozen=True)
class Pack:
    """Sizes that bounds scale with, so that one library serves a cell and an 800 V pack."""

    voltage_v: float
    """Pseudo-OCV at half charge [V]."""
    capacity_ah: float
    resistance_ohm: float
    """Sum of the model's resistances, positive [Ω]."""
    temperature_c: float = 25.0
    """Middle of the identified temperature range [°C]."""

    @classmethod
    def of(cls, model: VoltageModel, capacity_ah: float) -> Pack:
        """Return the sizes of the pack that a model describes."""
        volts = model.nominal_v
        least_ohm = RESISTANCE_AT_LEAST * volts / capacity_ah
        return cls(
            voltage_v=volts,
            capacity_ah=capacity_ah,
            resistance_ohm=max(abs(sum(model.loads.resistance_ohm)), least_ohm),
            temperature_c=float(np.clip(0.5 * sum(model.range.temperature_c), *PLAUSIBLE_C)),
        )


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect.

    Parameters
    ----------
    name : str
    unit : str
        Bounds, neutral value, grid and `healthy_std` of a voltage, current or resistance are
        relative to the pack's voltage, capacity or resistance, and the grid of a temperature to
        the middle of its temperature range.
    low, high : float
        Physical bounds.
    neutral : float
        Value of an amplitude at which the effect does nothing.
    grid : tuple of floats, optional
        Trial values of a shape, of which the middle one is neutral; () for an amplitude.
    healthy_std : float
        Standard deviation of an amplitude between logs of one healthy pack.
    """

    name: str
    unit: str
    low: float
    high: float
    neutral: float = 0.0
    grid: tuple[float, ...] = ()
    healthy_std: float = 0.0

    @property
    def is_relative(self) -> bool:
        """Whether its bounds are relative to the pack."""
        return self.unit in {"A", "V", "V/K", "ohm"}

    def factor(self, pack: Pack) -> float:
        """Return what bounds and grid are relative to, in the parameter's unit."""
        volts = pack.voltage_v
        sizes = {
            "A": pack.capacity_ah,
            "V": volts,
            "V/K": volts,
            "ohm": pack.resistance_ohm,
            "°C": pack.temperature_c,
        }
        return sizes.get(self.unit, 1.0)

    def bounds(self, pack: Pack, margin: float = 1.0) -> tuple[float, float]:
        """Return the physical bounds in the parameter's unit.

        Those relative to the pack are widened by the factor `margin` (`BOUND_MARGIN`).
        """
        if not self.is_relative:
            return self.low, self.high
        factor = self.factor(pack)
        low, high = self.low * factor, self.high * factor
        return (low * margin if low < 0.0 else low / margin), high * margin

    def trials(self, pack: Pack) -> tuple[float, ...]:
        """Return the trial values of a shape in its unit; none for an amplitude."""
        factor = self.factor(pack)
        return tuple(value * factor for value in self.grid)


DELAYED: Final = Parameter("delayed", "1", 0.0, 1.0, grid=(1.0, 0.0))
"""Whether an effect scales the whole drop of the voltage model (1) or only that of the present
current over the sum of the resistances (0): contacts and electrolyte respond at once, diffusion
does not. Values in between mix both."""


class Signals(NamedTuple):
    """Measured signals, shape (n,) each; positive current discharges."""

    time_s: FloatArray
    current_a: FloatArray
    voltage_v: FloatArray
    temperature_c: FloatArray

    @classmethod
    def of(cls, log: Log) -> Signals:
        """Return the signals of a log."""
        return cls(log.time_s, log.current_a, log.voltage_v, log.temperature_c)


class Inputs(NamedTuple):
    """Inputs of an added voltage, shape (n,) each, after correction."""

    time_s: FloatArray
    current_a: FloatArray
    temperature_c: FloatArray
    drop_v: FloatArray
    """Voltage of the model's resistances [V]; negative while discharging."""


@dataclass(frozen=True)
class Counting:
    """How charge becomes SoC: S = S₀ − 100·∫(I⁺ + η·I⁻)dt / C."""

    capacity_ah: float
    initial_soc_pct: float
    charge_efficiency: float = 1.0
    """η: fraction of the charge put in that can be discharged again."""

    def counted(self, current_a: FloatArray) -> FloatArray:
        """Return I⁺ + η·I⁻ [A], shape (n,)."""
        return np.where(current_a < 0.0, self.charge_efficiency * current_a, current_a)


class CoreForm(NamedTuple):
    """Constants of an effect in the C core (`core/cangauge.h`)."""

    kind: str
    """Name in `cg_effect_kind`, in lower case without its prefix."""
    values: tuple[float, ...] = ()
    """In the order that the header states."""
    tau_s: tuple[float, ...] = ()
    """Time constants of its lags [s]."""


class Context(NamedTuple):
    """What an effect works with."""

    model: VoltageModel
    pack: Pack
    memory: Memories = ()
    """Carried from sample to sample."""
    is_whole: bool = False
    """Whether a call gets a whole log, after which no sample comes."""


def core_values(
    kind: str, names: Sequence[str], values: Values, model: VoltageModel, pack: Pack
) -> CoreForm:
    """Return a form in the C core whose constants are parameters, sizes of the pack or T_r."""
    known = {**vars(pack), "t_ref_c": model.loads.t_ref_c, **values}
    return CoreForm(kind, tuple(known[name] for name in names))


def same_signals(signals: Signals, *_: object) -> Signals:
    """Return the signals: the effect corrects none."""
    return signals


def same_count(counting: Counting, *_: object) -> Counting:
    """Return the counting: the effect does not change it."""
    return counting


def no_memory(*_: object) -> Memories:
    """Return nothing: the effect carries nothing from sample to sample."""
    return ()


def none(*_: object) -> None:
    """Return nothing: no added voltage, or no form in the C core."""


def at_every_soc(*_: object) -> float:
    """Return 1: the added voltage does not depend on the SoC."""
    return 1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Effect:
    """A mechanism that the voltage model lacks: a row of the library's table.

    Parameters
    ----------
    id : str
    fault : FaultName
        The fault that it is a shape of.
    parameters : tuple of Parameter
    equation : str
    about : str
        Its signature in U_measured − U_model, the test that separates it from effects that look
        alike, and its source: paragraphs for the page of effects.
    correct : callable
        (signals, values, context) → signals as ideal sensors would have shown them. Rows may be
        held back in the memory until later ones have come.
    count : callable
        (counting, values) → how charge is counted with the effect.
    drive : callable
        (inputs, values, context) → added voltage [V], or its part besides `over_soc`, shape (n,);
        None if it adds none. Rows come once and in order: the memory is advanced.
    over_soc : callable
        (soc_pct, values, model) → factor on `drive` at SoC [%] of shape (n,).
    memory : callable
        (values, pack) → what is carried from sample to sample, before the first one.
    core_form : callable
        (values, model, pack) → form in the C core; None if it has none.
    is_rc : bool
        Whether it is an RC element, of time constant `tau_s`.
    scales_drop : bool
        Whether the added voltage follows the model's drop over the resistances.
    moves_time : bool
        Whether it moves samples in time, which means over seconds would blur.
    """

    id: str
    fault: FaultName
    parameters: tuple[Parameter, ...]
    equation: str
    about: str
    correct: Callable[[Signals, Values, Context], Signals] = same_signals
    count: Callable[[Counting, Values], Counting] = same_count
    drive: Callable[[Inputs, Values, Context], FloatArray | None] = none
    over_soc: Callable[[FloatArray, Values, VoltageModel], FloatArray | float] = at_every_soc
    memory: Callable[[Values, Pack], Memories] = no_memory
    core_form: Callable[[Values, VoltageModel, Pack], CoreForm | None] = none
    is_rc: bool = False
    scales_drop: bool = False
    moves_time: bool = False

    @property
    def amplitudes(self) -> tuple[Parameter, ...]:
        """Parameters that enter the voltage nearly linearly."""
        return tuple(item for item in self.parameters if not item.grid)

    @property
    def shapes(self) -> tuple[Parameter, ...]:
        """Parameters with trial values."""
        return tuple(item for item in self.parameters if item.grid)

    def context(self, values: Values, model: VoltageModel, pack: Pack) -> Context:
        """Return what it works with on a model, before the first sample."""
        return Context(model, pack, self.memory(values, pack))

    @property
    def adds_voltage(self) -> bool:
        """Whether it adds a voltage, and changes neither signals nor count."""
        return self.drive is not none

    @property
    def uses_soc(self) -> bool:
        """Whether the added voltage depends on the SoC."""
        return self.over_soc is not at_every_soc

    def added_v(
        self,
        inputs: Inputs,
        rows: NDArray[np.intp] | slice,
        soc_pct: FloatArray,
        values: Values,
        model: ExtendedModel,
    ) -> FloatArray:
        """Return the added voltage of a log at some rows [V], shape (m,).

        Parameters
        ----------
        inputs : Inputs
            Of the whole log.
        rows : array of int, shape (m,), or slice
        soc_pct : array of shape (m,)
            SoC there [%].
        values : dict of str to float
        model : ExtendedModel
        """
        drive = self.drive(inputs, values, self.context(values, model.model, model.pack))
        if drive is None:
            return np.zeros_like(soc_pct)
        return np.asarray(drive[rows] * self.over_soc(soc_pct, values, model.model))

    def neutral(self, pack: Pack) -> dict[str, float]:
        """Return values at which the effect does nothing."""
        values = {item.name: item.neutral * item.factor(pack) for item in self.amplitudes}
        for item in self.shapes:
            trials = item.trials(pack)
            values[item.name] = trials[len(trials) // 2]
        return values

    def clipped(self, values: Values, pack: Pack) -> dict[str, float]:
        """Return values with the amplitudes clipped to the bounds of a model file."""
        result = dict(values)
        for item in self.amplitudes:
            low, high = item.bounds(pack, BOUND_MARGIN)
            result[item.name] = min(max(result[item.name], low), high)
        return result

"""Interface of an effect: a named mechanism at the pack's terminals, offline and online.

An effect acts in up to three places, in this order:

1. `correct`: measured signals → what ideal sensors would have shown
   (current_offset, voltage_gain, time_skew, temperature_lag …);
2. `count`: how charge becomes SoC (capacity, initial_soc, coulombic_efficiency);
3. `extra_voltage`: a voltage added to the voltage model's (resistances, dynamics, hysteresis …).

Each effect has two forms in its file, over whole logs as arrays and one sample at a time; a test
checks that they agree. At its neutral values an effect changes nothing.

Parameters are of three kinds. *Amplitudes* have a neutral value and enter the voltage (nearly)
linearly. *Shapes* (a time constant, a change point) have a grid of trial values and no meaning
without an amplitude; `time_skew` has a single parameter that is both. *Constants* are taken from
the pack when the effect is added (`Parameter.from_pack`).

An effect names a signature at the terminals; it does not prove a mechanism.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cangauge._arithmetic import total
from cangauge._typing import FloatArray
from cangauge.logs.gaps import BRIDGE_S, counted_steps_s, discharged_ah
from cangauge.model.delay_line import delayed_currents
from cangauge.model.effects.first_order import NO_LAG_S, LowPass, decaying_sum, low_passed
from cangauge.model.voltage_model import VoltageModel

Scale = Literal["one", "capacity", "voltage", "resistance"]

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

Values = Mapping[str, float]
"""Parameter name → value, in the parameter's unit."""

WITHIN_C: Final = (-60.0, 120.0)
"""Plausible pack temperatures [°C]; laws of temperature are constant outside."""

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
    cells: int
    """Cells in series, estimated from `voltage_v` at 3.7 V per cell."""
    temperature_c: float = 25.0
    """Middle of the identified temperature range [°C]."""

    @classmethod
    def of(cls, model: VoltageModel, capacity_ah: float) -> Pack:
        """Return the sizes of the pack that a model describes."""
        volts = model.pseudo_ocv_at(50.0)[0]
        coldest, hottest = WITHIN_C
        return cls(
            voltage_v=volts,
            capacity_ah=capacity_ah,
            resistance_ohm=max(
                abs(total(model.resistance_ohm)), RESISTANCE_AT_LEAST * volts / capacity_ah
            ),
            cells=max(1, round(volts / 3.7)),
            temperature_c=min(max(0.5 * total(model.temperature_range_c), coldest), hottest),
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
        Value at which the effect does nothing, in units of `scale`; None for a shape without one.
    scale : {"one", "capacity", "voltage", "resistance"}
        Pack size that converts bounds, neutral value and grid to `unit`.
    grid : tuple of floats, optional
        Trial values of a shape; None for an amplitude.
    from_pack : {"temperature_c"}, optional
        Marks a constant: this size of the pack at the time the effect is added, fixed afterwards.
    diagnosis_values : tuple of float, optional
        Further trial values that only a diagnosis uses. For a shape: values. For a constant:
        offsets, which a fit absorbs in its coefficients.
    is_change_point : bool
        Whether this shape is the time of a step in the voltage.
    """

    name: str
    unit: str
    low: float
    high: float
    neutral: float | None = 0.0
    scale: Scale = "one"
    grid: tuple[float, ...] | None = None
    from_pack: Literal["temperature_c"] | None = None
    diagnosis_values: tuple[float, ...] = ()
    is_change_point: bool = False

    def factor(self, pack: Pack) -> float:
        """Return the factor from units of `scale` to the parameter's unit."""
        sizes = {
            "one": 1.0,
            "capacity": pack.capacity_ah,
            "voltage": pack.voltage_v,
            "resistance": pack.resistance_ohm,
        }
        return sizes[self.scale]

    def bounds(self, pack: Pack, margin: float = 1.0) -> tuple[float, float]:
        """Return the physical bounds in the parameter's unit.

        Bounds that scale with the pack are widened by the factor `margin` (`BOUND_MARGIN`).
        """
        factor = self.factor(pack)
        low, high = self.low * factor, self.high * factor
        if self.scale != "one":
            low, high = (low * margin if low < 0.0 else low / margin), high * margin
        return low, high

    def trials(self, pack: Pack) -> tuple[float, ...]:
        """Return the trial values of a shape in its unit; none for an amplitude."""
        factor = self.factor(pack)
        return tuple(value * factor for value in self.grid or ())


DELAYED: Final = Parameter("delayed", "1", 0.0, 1.0, neutral=None, grid=(1.0, 0.0))
"""Whether an effect scales the whole drop of the voltage model (1) or only that of the present
current over the sum of the resistances (0): contacts and electrolyte respond at once, diffusion
does not. Values in between mix both."""

LAG: Final = Parameter(
    "lag_s", "s", 0.0, 10000.0, neutral=None, grid=(0.0,), diagnosis_values=(600.0, 1800.0)
)
"""Time constant of the cell interior behind the measured temperature (0: none). Only a diagnosis
tries others: on a day on which the pack warms, the interior's temperature separates causes."""

MOST_LAGS, MOST_SHIFTS = 64, 4
"""Lagged and shifted currents kept in a cache; all shapes of all effects use about fifty lags."""


@dataclass(frozen=True, eq=False)
class CurrentHistory:
    """Delayed and lagged currents of one log, each computed once.

    Effects and their shapes share them, since they dominate the computing time of a long log.
    `time_s` and `current_a` have shape (n,), positive = discharge. Callers must not write to the
    arrays returned.
    """

    time_s: FloatArray
    current_a: FloatArray
    rows: NDArray[np.intp] | None = None
    """Samples at which lagged and delayed currents are returned; all if None."""
    like: CurrentHistory | None = None
    """History of another current at the same times, whose steps of time are shared."""
    _lagged: dict[tuple[float, bool], FloatArray] = field(
        default_factory=dict, init=False, repr=False
    )
    _lagged_c: dict[float, tuple[FloatArray, FloatArray]] = field(
        default_factory=dict, init=False, repr=False
    )
    _turned: dict[float, FloatArray] = field(default_factory=dict, init=False, repr=False)
    _at_rows: dict[int, CurrentHistory] = field(default_factory=dict, init=False, repr=False)
    _shifted: dict[float, CurrentHistory] = field(default_factory=dict, init=False, repr=False)
    _delayed_a: dict[tuple[float, ...], FloatArray] = field(
        default_factory=dict, init=False, repr=False
    )

    def at(self, rows: NDArray[np.intp]) -> CurrentHistory:
        """Return the same history at some rows only; the same one for the same array of rows."""
        key = id(rows)
        if key not in self._at_rows:
            self._at_rows[key] = CurrentHistory(self.time_s, self.current_a, rows)
        return self._at_rows[key]

    def shifted(self, seconds: float) -> CurrentHistory:
        """Return the history of I(t + seconds), held beyond the ends of the log."""
        found = self._shifted.pop(seconds, None)
        if found is None:
            current_a = np.interp(self.time_s + seconds, self.time_s, self.current_a)
            found = CurrentHistory(self.time_s, current_a, like=self)
            while len(self._shifted) >= MOST_SHIFTS:
                del self._shifted[next(iter(self._shifted))]
        self._shifted[seconds] = found  # the latest one last
        return found

    def lagged_a(self, tau_s: float) -> FloatArray:
        """Return the current behind a first-order lag [A], shape (n,), at rest before the log."""
        return self._low_passed(tau_s, squared=False)

    def lagged_a2(self, tau_s: float) -> FloatArray:
        """Return the square of the current behind the same lag [A²], shape (n,)."""
        return self._low_passed(tau_s, squared=True)

    def _low_passed(self, tau_s: float, *, squared: bool) -> FloatArray:
        key = (tau_s, squared)
        lagged = self._lagged.pop(key, None)
        if lagged is None:
            while len(self._lagged) >= MOST_LAGS:  # a fit varies the time constants
                del self._lagged[next(iter(self._lagged))]
            values = self.current_a**2 if squared else self.current_a
            lagged = low_passed(self.time_s, values, tau_s, 0.0, rest_s=BRIDGE_S)
            lagged = lagged if self.rows is None else lagged[self.rows]
        self._lagged[key] = lagged  # the latest one last
        return lagged

    def lagged_c(self, temperature_c: FloatArray, lag_s: float) -> FloatArray:
        """Return the temperature of all samples behind a lag, equal to it at the start [°C]."""
        known, lagged = self._lagged_c.get(lag_s, (None, temperature_c))
        if known is not temperature_c:  # corrected differently
            lagged = low_passed(self.time_s, temperature_c, lag_s)
            lagged = lagged if self.rows is None else lagged[self.rows]
            self._lagged_c[lag_s] = (temperature_c, lagged)
        return lagged

    def turned(self, travel_as: float) -> FloatArray:
        """Return the memory of the current's sign over a charge [As], −1 … 1, shape (n,).

        dh/dt = |I|/travel·(−sign(I) − h), 0 before the log and unchanged over gaps.
        """
        if travel_as not in self._turned:
            seconds = np.diff(self.time_s)
            mean = 0.5 * (self.current_a[1:] + self.current_a[:-1])
            decay = np.where(seconds > BRIDGE_S, 0.0, np.abs(mean) * seconds / travel_as)
            turned = decaying_sum(decay, np.sign(mean) * np.expm1(-decay), 0.0)
            self._turned[travel_as] = turned if self.rows is None else turned[self.rows]
        return self._turned[travel_as]

    def delayed_a(self, delay_s: tuple[float, ...]) -> FloatArray:
        """Return I(t − dj) [A], shape (n, len(delay_s))."""
        if delay_s not in self._delayed_a:
            at_s = self.time_s if self.rows is None else self.time_s[self.rows]
            self._delayed_a[delay_s] = delayed_currents(self.time_s, self.current_a, delay_s, at_s)
        return self._delayed_a[delay_s]

    @cached_property
    def out_ah(self) -> FloatArray:
        """Charge discharged since the first sample [Ah], shape (n,)."""
        return discharged_ah(self.time_s, self.current_a, self.counted_s)

    @cached_property
    def counted_s(self) -> FloatArray:
        """Steps over which charge is counted [s], shape (n − 1,)."""
        return counted_steps_s(self.time_s) if self.like is None else self.like.counted_s


def _history_of(
    time_s: FloatArray, current_a: FloatArray, cached: CurrentHistory | None
) -> CurrentHistory:
    """Return the cached history if it was made of the same array objects, else a new one."""
    if cached is None or cached.time_s is not time_s:
        return CurrentHistory(time_s, current_a)
    return (
        cached if cached.current_a is current_a else CurrentHistory(time_s, current_a, like=cached)
    )


@dataclass(frozen=True, eq=False)
class Signals:
    """Measured signals of one log, shape (n,) each; positive current discharges."""

    time_s: FloatArray
    current_a: FloatArray
    voltage_v: FloatArray
    temperature_c: FloatArray
    cached_history: CurrentHistory | None = None
    """History of the current, valid while `current_a` is the same array."""

    @property
    def history(self) -> CurrentHistory:
        """History of the current, from the cache if it is valid."""
        return _history_of(self.time_s, self.current_a, self.cached_history)

    def with_history_cache(self) -> Signals:
        """Return the signals with a cache that lasts as long as the current is unchanged."""
        return replace(self, cached_history=CurrentHistory(self.time_s, self.current_a))


@dataclass(frozen=True)
class Counting:
    """How charge becomes SoC: S = S₀ − 100·∫(I⁺ + η·I⁻)dt / C."""

    capacity_ah: float
    initial_soc_pct: float
    charge_efficiency: float = 1.0
    """η: fraction of the charge put in that can be discharged again."""

    def counted(self, current_a: FloatArray) -> FloatArray:
        """Return I⁺ + η·I⁻ [A], shape (n,)."""
        if self.charge_efficiency == 1.0:
            return current_a
        return np.where(current_a < 0.0, self.charge_efficiency * current_a, current_a)

    def counted_at(self, current_a: float) -> float:
        """Return I⁺ + η·I⁻ of one sample [A]."""
        return self.charge_efficiency * current_a if current_a < 0.0 else current_a


@dataclass(frozen=True, eq=False)
class PackState:
    """Inputs of an extra voltage, shape (n,) each, after correction and counting."""

    time_s: FloatArray
    current_a: FloatArray
    temperature_c: FloatArray
    soc_pct: FloatArray
    drop_v: FloatArray
    """Σ Rj·I(t − dj) of the voltage model [V]; negative while discharging."""
    cached_history: CurrentHistory | None = None
    rows: NDArray[np.intp] | None = None
    """Samples of the log that the state is restricted to; all if None."""
    log: Signals | None = None
    """Corrected signals of the whole log, where `rows` is given."""
    of_log: Callable[[], PackState] | None = None
    """Returns the state of the whole log, where `rows` is given."""
    _lagged_c: dict[float, FloatArray] = field(default_factory=dict, init=False, repr=False)
    _slopes: dict[VoltageModel, FloatArray] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def history(self) -> CurrentHistory:
        """History of the current; at the state's rows."""
        if self.rows is not None and self.cached_history is not None:
            return self.cached_history
        return _history_of(self.time_s, self.current_a, self.cached_history)

    @cached_property
    def whole(self) -> PackState:
        """The state of the whole log."""
        return self if self.of_log is None else self.of_log()

    def lagged_temperature_c(self, lag_s: float) -> FloatArray:
        """Return the temperature behind a lag, equal to it at the start [°C], shape (n,)."""
        if lag_s <= NO_LAG_S:
            return self.temperature_c
        if lag_s not in self._lagged_c:
            whole = self.temperature_c if self.log is None else self.log.temperature_c
            self._lagged_c[lag_s] = self.history.lagged_c(whole, lag_s)
        return self._lagged_c[lag_s]

    def ocv_slope(self, model: VoltageModel) -> FloatArray:
        """Return the slope of a model's pseudo-OCV [V per %], shape (n,)."""
        if model not in self._slopes:
            self._slopes[model] = model.pseudo_ocv_slope(self.soc_pct)
        return self._slopes[model]

    def scaled_drop_v(self, delayed: float, pack: Pack) -> FloatArray:
        """Return the drop that an effect scales [V], shape (n,); see `DELAYED`."""
        now_v = -pack.resistance_ohm * self.current_a
        return delayed * self.drop_v + (1.0 - delayed) * now_v


def scaled_drop_at(drop_v: float, current_a: float, delayed: float, resistance_ohm: float) -> float:
    """Return `PackState.scaled_drop_v` of one sample [V]."""
    return delayed * drop_v + (1.0 - delayed) * (-resistance_ohm * current_a)


class Reading(NamedTuple):
    """One sample during its correction.

    Voltage and temperature may be NaN where that signal is missing; current never is.
    """

    time_s: float
    current_a: float
    """Positive = discharge [A]."""
    voltage_v: float
    temperature_c: float


class CoreForm(NamedTuple):
    """Constants of an online effect in the C core (`core/cangauge.h`)."""

    kind: str
    """Name in `cg_effect_kind`, in lower case without its prefix."""
    values: tuple[float, ...] = ()
    """In the order that the header states."""
    tau_s: tuple[float, ...] = ()
    """Time constants of its lags [s]."""


class OnlineEffect:
    """State of an effect in the estimator, advanced one sample at a time.

    The base class corrects nothing and adds no voltage. A subclass sets `volts` in `advance`, or
    overrides `extra_voltage` and sets `uses_soc`. Its first-order lags go into `lags`, from which
    `state` and `restore` follow.
    """

    uses_soc: ClassVar[bool] = False
    """Whether `extra_voltage` depends on the SoC."""

    follows_temperature: bool = False
    """Whether it lags behind the temperature: then it starts at the first known temperature."""

    volts: float = 0.0
    """Extra voltage at the latest sample, where it does not depend on the SoC [V]."""

    lags: Sequence[LowPass] = ()

    memory: Sequence[tuple[float, float]] = ()
    """Resistance [Ω] and time constant [s] of voltages from earlier currents, 0 at the start."""

    def correct(self, reading: Reading) -> Sequence[Reading]:
        """Return the corrected readings that are complete.

        Usually one for each input. `time_skew`, which needs a later current for a voltage, delays
        readings: it returns all of them in order with unchanged times.
        """
        return (reading,)

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        """Advance the state to a sample (corrected values; every sample, in order)."""

    def extra_voltage(self, soc_pct: float) -> float:
        """Return the extra voltage at the latest sample if the SoC were `soc_pct` [V]."""
        return self.volts

    def core_form(self) -> CoreForm | None:
        """Return its form in the C core; None: it has none, and the estimator stays in Python."""
        return CoreForm("no_effect") if type(self) is OnlineEffect else None

    def state(self) -> list[float]:
        """Return the state as numbers for `restore`."""
        return [number for lag in self.lags for number in lag.state()]

    def restore(self, state: Sequence[float], latest_s: float) -> None:
        """Continue from the saved state of the same effect.

        Parameters
        ----------
        state : sequence of floats
        latest_s : float
            Time of the latest sample before [s]; NaN if there was none. No time in the state may
            be later.

        Raises
        ------
        ValueError
            If the state does not belong to this effect or is malformed.
        """
        size = LowPass.STATE_SIZE
        if len(state) > size * len(self.lags):
            raise ValueError("longer than the state of this effect")
        for k, lag in enumerate(self.lags):
            lag.restore(state[size * k : size * (k + 1)], latest_s)


class OnlineInteriorEffect(OnlineEffect):
    """Online effect of the temperature of the cell interior, `lag_s` behind the measured one."""

    def __init__(self, lag_s: float) -> None:
        self.interior = LowPass(lag_s)
        self.lags = (self.interior,) if self.interior.is_lagging else ()
        self.follows_temperature = self.interior.is_lagging


class Effect:
    """A mechanism that the voltage model lacks."""

    id: ClassVar[str]
    family: ClassVar[Family]
    parameters: ClassVar[tuple[Parameter, ...]]
    signature: ClassVar[str]
    """Its signature in U_measured − U_model, in words."""
    equation: ClassVar[str]
    source: ClassVar[str]
    separated_by: ClassVar[str]
    """The test that separates it from effects that look alike."""
    is_cause: ClassVar[bool] = True
    """Whether a diagnosis may name it; otherwise it is structure, learned from references only."""
    is_structure: ClassVar[bool] = False
    """Whether a healthy pack may have it: the part that references show is then not a cause."""
    is_pointwise: ClassVar[bool] = False
    """Whether the extra voltage at a sample follows from the state there and its histories; then
    it is computed at the rows that are asked for, else over the whole log."""
    secant_points: ClassVar[tuple[float, ...]] = ()
    """For an effect that is strongly nonlinear in its only amplitude: fractions of the widest bound
    at which the diagnosis takes the change of the voltage, besides a small one."""

    @property
    def amplitudes(self) -> tuple[Parameter, ...]:
        """Parameters that enter the voltage nearly linearly."""
        return tuple(
            parameter
            for parameter in self.parameters
            if parameter.grid is None and parameter.from_pack is None
        )

    @property
    def shapes(self) -> tuple[Parameter, ...]:
        """Parameters with trial values."""
        return tuple(parameter for parameter in self.parameters if parameter.grid is not None)

    @property
    def adds_voltage_only(self) -> bool:
        """Whether it changes neither signals nor count."""
        kind = type(self)
        return kind.correct is Effect.correct and kind.count is Effect.count

    def constants(self, pack: Pack) -> dict[str, float]:
        """Return the parameters that are taken from the pack when the effect is added to it."""
        return {
            parameter.name: float(getattr(pack, parameter.from_pack))
            for parameter in self.parameters
            if parameter.from_pack is not None
        }

    def trial_constants(self, pack: Pack) -> list[dict[str, float]]:
        """Return the constants from the pack, then the alternatives that a diagnosis tries."""
        tried = [self.constants(pack)]
        for parameter in self.parameters:
            if parameter.from_pack is None:
                continue
            low, high = parameter.bounds(pack)
            for offset in parameter.diagnosis_values:
                value = min(max(tried[0][parameter.name] + offset, low), high)
                tried.append(tried[0] | {parameter.name: value})
        return tried

    def neutral(self, pack: Pack) -> dict[str, float]:
        """Return values at which the effect does nothing."""
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

    def clipped(self, values: Values, pack: Pack) -> dict[str, float]:
        """Return values with the amplitudes clipped to the bounds of a model file."""
        result = dict(values)
        for parameter in self.amplitudes:
            low, high = parameter.bounds(pack, BOUND_MARGIN)
            result[parameter.name] = min(max(result[parameter.name], low), high)
        return result

    def trials(self, parameter: Parameter, pack: Pack, time_s: FloatArray) -> tuple[float, ...]:
        """Return the trial values of a shape, in its unit, on a log with these times.

        The k-th value has the same meaning on every log of a group with one cause.
        """
        return parameter.trials(pack)

    def correct(self, signals: Signals, values: Values, pack: Pack) -> Signals:
        """Return the signals as ideal sensors would have shown them."""
        return signals

    def count(self, counting: Counting, values: Values) -> Counting:
        """Return how charge is counted with the effect."""
        return counting

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray | None:  # fmt: skip
        """Return the extra voltage [V], shape (n,), or None if the effect adds none."""

    def extra_voltage_at(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray | None:  # fmt: skip
        """Return the extra voltage at the rows of a state [V], or None if the effect adds none."""
        adds_none = type(self).extra_voltage is Effect.extra_voltage
        if state.rows is None or self.is_pointwise or adds_none:
            return self.extra_voltage(state, values, model, pack)
        volts = self.extra_voltage(state.whole, values, model, pack)
        return None if volts is None else volts[state.rows]

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        """Return the effect's state before the first sample."""
        return OnlineEffect()

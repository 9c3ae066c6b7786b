"""Faults of a simulated pack: twenty with a counterpart in the effects library, nine without.

A fault has one size, whose unit and physical limits its kind states, and shape parameters (where,
when, how fast) that are given or drawn from a seed. As text it is `ID`, `ID:parameter=value` or
`ID:parameter=value,shape=value`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from cangauge.errors import InputError
from cangauge.extras.validation.twin.condition import (
    HEALTHY,
    Condition,
    Intermittent,
    Relaxation,
    SocResistance,
    WeakCells,
)
from cangauge.extras.validation.twin.pack import TwinPack

OUTSIDE: Final = "outside"
"""Family of the faults without a counterpart in the effects library."""
GAP: Final = "gap_v"
"""Parameter that replaces the size in a text: RMS gap to open [V]."""

_WARBURG_MODES: Final = 6
_COLE_SPREAD: Final = (-1.6, -1.0, -0.5, 0.0, 0.5, 1.0, 1.6)


@dataclass(frozen=True)
class ShapeRange:
    """Range of a shape parameter.

    Parameters
    ----------
    low, high : float
        Drawn between these.
    logarithmic, whole : bool
        Draw uniformly in the logarithm, or whole numbers.
    accepted : tuple of float, optional
        Range that a user may give; by default from low to high.
    """

    low: float
    high: float
    logarithmic: bool = False
    whole: bool = False
    accepted: tuple[float, float] | None = None

    def draw(self, rng: np.random.Generator) -> float:
        """Draw a value."""
        if self.whole:
            return float(rng.integers(int(self.low), int(self.high) + 1))
        if self.logarithmic:
            return float(np.exp(rng.uniform(np.log(self.low), np.log(self.high))))
        return float(rng.uniform(self.low, self.high))


Shape = Mapping[str, float]
Apply = Callable[[Condition, TwinPack, float, Shape, int], Condition]
Limits = Callable[[TwinPack], tuple[float, float]]


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault.

    Parameters
    ----------
    id, family : str
        As in the effects library, or family `outside`.
    parameter, unit : str
        Name and unit of the size.
    limits : callable
        Pack → smallest and largest physical size, both positive.
    apply : callable
        (condition, pack, size, shape, seed) → condition with the fault.
    signed : bool
        Whether the size may be negative.
    shape : dict of str to ShapeRange
        Further parameters.
    comparable : bool
        Whether the effects library has a parameter of the same meaning as the size.
    resembles : tuple of str
        For faults outside the library: effects with a similar signature.
    summary : str
        What the fault does; x is its size.
    """

    id: str
    family: str
    parameter: str
    unit: str
    limits: Limits
    apply: Apply
    signed: bool = False
    shape: Mapping[str, ShapeRange] = field(default_factory=dict)
    comparable: bool = False
    resembles: tuple[str, ...] = ()
    summary: str = ""


def _span(low: float, high: float) -> Limits:
    return lambda _pack: (low, high)


def _amperes(low: float, high: float) -> Limits:
    """Return limits relative to the 1C current."""
    return lambda pack: (low * pack.one_c_a, high * pack.one_c_a)


def _volts(low: float, high: float) -> Limits:
    """Return limits relative to the nominal voltage."""
    return lambda pack: (low * pack.nominal_v, high * pack.nominal_v)


def _ohms(low: float, high: float) -> Limits:
    """Return limits relative to the pack resistance at 25 °C."""
    return lambda pack: (low * pack.resistance_ohm, high * pack.resistance_ohm)


def cole_cole(ohm: float, tau_s: float, alpha: float) -> tuple[Relaxation, ...]:
    """Return a Cole–Cole element as seven relaxations.

    The distribution of relaxation times sin((1−α)π)/(cosh(α·ln τ/τ0) − cos((1−α)π)), sampled
    within 1.6 e-folds of τ0 (Cole and Cole 1941).
    """
    away = np.array(_COLE_SPREAD)
    weight = np.sin((1.0 - alpha) * np.pi) / (np.cosh(alpha * away) - np.cos((1.0 - alpha) * np.pi))
    weight /= weight.sum()
    return tuple(
        Relaxation(float(ohm * share), float(tau_s * np.exp(shift)))
        for share, shift in zip(weight, away, strict=True)
    )


def finite_warburg(ohm: float, slowest_s: float) -> tuple[Relaxation, ...]:
    """Return a finite-length Warburg element R·tanh(√jωτ)/√jωτ by its first six poles."""
    odd = (2.0 * np.arange(_WARBURG_MODES) + 1.0) ** 2
    weight = 1.0 / odd / np.sum(1.0 / odd)
    return tuple(
        Relaxation(float(ohm * share), float(slowest_s / pole))
        for share, pole in zip(weight, odd, strict=True)
    )


def _fast(c: Condition, _pack: TwinPack, size: float, shape: Shape, _seed: int) -> Condition:
    added = cole_cole(size, shape["tau_s"], shape["alpha"])
    return replace(c, relaxations=(*c.relaxations, *added))


def _slow(c: Condition, _pack: TwinPack, size: float, shape: Shape, _seed: int) -> Condition:
    return replace(c, relaxations=(*c.relaxations, *finite_warburg(size, shape["tau_s"])))


def _soc_rise(c: Condition, _pack: TwinPack, size: float, shape: Shape, _seed: int) -> Condition:
    towards_full = shape["towards_full"] > 0.75
    centre = 1.0 - shape["centre"] if towards_full else shape["centre"]
    width = -shape["width"] if towards_full else shape["width"]
    return replace(c, soc_resistance=SocResistance(size, centre, width))


def _entropy_change(pack: TwinPack, seed: int) -> NDArray[np.float64]:
    """Draw a smooth change of dU/dT over the SoC, of RMS 1, on the pack's grid."""
    rng = np.random.default_rng(seed)
    knots = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    curve = PchipInterpolator(knots, rng.normal(size=5) + 0.8 * rng.choice((-1.0, 1.0)))
    bend = curve(np.clip(pack.chemistry.grid, 0.0, 1.0))
    return np.asarray(bend / np.sqrt(np.mean(bend**2)), dtype=np.float64)


def _entropy(c: Condition, pack: TwinPack, size: float, _shape: Shape, seed: int) -> Condition:
    return replace(c, entropy_shift_v_k=1e-3 * size * _entropy_change(pack, seed))


def _weak(c: Condition, _pack: TwinPack, size: float, shape: Shape, _seed: int) -> Condition:
    weak = WeakCells(int(shape["count"]), size, shape["deficit"] * size)
    return replace(c, weak=weak)


_IN_LIBRARY: Final[tuple[FaultKind, ...]] = (
    FaultKind(
        "current_offset", "current_sensing", "offset_a", "A", _amperes(1e-4, 0.15),
        lambda c, _p, x, _s, _r: replace(c, current_offset_a=x),
        signed=True, comparable=True, summary="the current sensor reads x A too high",
    ),
    FaultKind(
        "current_gain", "current_sensing", "gain", "-", _span(1e-3, 0.10),
        lambda c, _p, x, _s, _r: replace(c, current_gain=x),
        signed=True, comparable=True, summary="the current sensor reads (1 + x) times the current",
    ),
    FaultKind(
        "voltage_offset", "voltage_sensing", "offset_v", "V", _volts(1e-4, 0.03),
        lambda c, _p, x, _s, _r: replace(c, voltage_offset_v=x),
        signed=True, comparable=True, summary="the voltage sensor reads x V too high",
    ),
    FaultKind(
        "voltage_gain", "voltage_sensing", "gain", "-", _span(1e-4, 0.03),
        lambda c, _p, x, _s, _r: replace(c, voltage_gain=x),
        signed=True, comparable=True, summary="the voltage sensor reads (1 + x) times the voltage",
    ),
    FaultKind(
        "temperature_lag", "thermal", "lag_s", "s", _span(40.0, 2000.0),
        lambda c, _p, x, _s, _r: replace(c, temperature_lag_s=x),
        summary="the temperature sensor lags by x s (two lags of x/2 in series)",
    ),
    FaultKind(
        "core_temperature", "thermal", "insulation", "-", _span(0.1, 25.0),
        lambda c, _p, x, _s, _r: replace(c, insulation=x),
        summary="thermal resistance between core and sensor grows by the factor 1 + x",
    ),
    FaultKind(
        "time_skew", "timing", "skew_s", "s", _span(0.01, 4.0),
        lambda c, _p, x, _s, _r: replace(c, current_skew_s=x),
        signed=True, comparable=True, summary="the recorded current is delayed by x s",
    ),
    FaultKind(
        "capacity", "charge", "loss", "-", _span(2e-3, 0.35),
        lambda c, _p, x, _s, _r: replace(c, capacity_factor=1.0 - x),
        signed=True, comparable=True, summary="the true capacity is (1 − x) times the assumed one",
    ),
    FaultKind(
        "initial_soc", "charge", "shift_pct", "%", _span(0.05, 12.0),
        lambda c, _p, x, _s, _r: replace(c, start_soc_shift=x / 100.0),
        signed=True, comparable=True, summary="the true initial SoC is x % above the assumed one",
    ),
    FaultKind(
        "coulombic_efficiency", "charge", "loss", "-", _span(2e-3, 0.10),
        lambda c, _p, x, _s, _r: replace(c, charge_loss=x),
        comparable=True, summary="the fraction x of the charge put in cannot be taken out again",
    ),
    FaultKind(
        "resistance_temperature", "resistance", "stiffness_k", "K", _span(1.0, 150.0),
        lambda c, _p, x, _s, _r: replace(c, cold_resistance_k=x),
        summary="resistance is multiplied by exp(x/(T − 230 K)), relative to 25 °C",
    ),
    FaultKind(
        "resistance_soc", "resistance", "rise", "-", _span(0.02, 4.0), _soc_rise,
        shape={"centre": ShapeRange(0.15, 0.65), "width": ShapeRange(0.02, 0.10),
               "towards_full": ShapeRange(0.0, 1.0)},
        summary="ohmic resistance rises by x along a logistic curve towards empty (or full)",
    ),
    FaultKind(
        "resistance_asymmetry", "resistance", "charging_ohm", "Ω", _ohms(0.01, 1.5),
        lambda c, _p, x, _s, _r: replace(c, charging_ohm=x),
        comparable=True, summary="x Ω more resistance during charge",
    ),
    FaultKind(
        "resistance_step", "resistance", "step_ohm", "Ω", _ohms(0.005, 1.0),
        lambda c, _p, x, s, _r: replace(c, step_ohm=x, step_at_s=s["at_s"]),
        shape={"at_s": ShapeRange(500.0, 3000.0, accepted=(0.0, 86400.0))},
        comparable=True, summary="x Ω more resistance from the time at_s on",
    ),
    FaultKind(
        "charge_transfer", "dynamics", "slowdown", "-", _span(0.05, 80.0),
        lambda c, _p, x, _s, _r: replace(c, transfer_slowdown=x),
        summary="the exchange current of the electrodes falls to 1/(1 + x)",
    ),
    FaultKind(
        "fast_polarization", "dynamics", "added_ohm", "Ω", _ohms(0.01, 1.0), _fast,
        shape={"tau_s": ShapeRange(0.8, 6.0, logarithmic=True), "alpha": ShapeRange(0.75, 0.97)},
        summary="a Cole–Cole element of x Ω with a time constant of seconds",
    ),
    FaultKind(
        "slow_diffusion", "dynamics", "added_ohm", "Ω", _ohms(0.01, 1.5), _slow,
        shape={"tau_s": ShapeRange(150.0, 1800.0, logarithmic=True)},
        summary="a finite Warburg element of x Ω with a time constant of minutes",
    ),
    FaultKind(
        "hysteresis", "equilibrium", "half_width_v", "V", _volts(2e-4, 0.01),
        lambda c, _p, x, s, _r: replace(c, hysteresis_v=x, hysteresis_reach=s["reach"]),
        shape={"reach": ShapeRange(0.005, 0.08, logarithmic=True)},
        summary="the open-circuit voltage is x V lower after discharge, x V higher after charge",
    ),
    FaultKind(
        "entropic_coefficient", "equilibrium", "bend_mv_k", "mV/K", _span(0.01, 0.5), _entropy,
        summary="dU/dT of a cell changes by a smooth curve over the SoC, of RMS x",
    ),
    FaultKind(
        "weak_cell", "imbalance", "loss", "-", _span(0.02, 0.65), _weak,
        shape={"count": ShapeRange(1, 3, whole=True), "deficit": ShapeRange(0.0, 0.3)},
        summary="one to three cells lack the fraction x of their capacity",
    ),
)  # fmt: skip


def _intermittent(name: str) -> Apply:
    def apply(c: Condition, _pack: TwinPack, size: float, shape: Shape, seed: int) -> Condition:
        change: dict[str, Any] = {name: Intermittent(size, shape["on_s"], shape["off_s"], seed)}
        return replace(c, **change)

    return apply


def _stale(c: Condition, _pack: TwinPack, size: float, shape: Shape, seed: int) -> Condition:
    return replace(c, stale=Intermittent(1.0, size, shape["off_s"], seed))


def _ripple(c: Condition, pack: TwinPack, size: float, shape: Shape, _seed: int) -> Condition:
    period = shape["period_share"] * pack.nominal_v
    return replace(c, ripple_v=size, ripple_period_v=period, ripple_phase=shape["phase"])


_OUTSIDE: Final[tuple[FaultKind, ...]] = (
    FaultKind(
        "voltage_nonlinearity", OUTSIDE, "ripple_v", "V",
        _volts(2e-4, 0.02), _ripple,
        shape={"period_share": ShapeRange(0.02, 0.05), "phase": ShapeRange(0.0, 6.28)},
        summary="integral nonlinearity of the voltage sensor, a sine of x V",
    ),
    FaultKind(
        "current_clipping", OUTSIDE, "cut", "-", _span(0.1, 0.9),
        lambda c, _p, x, _s, _r: replace(c, clip_share=1.0 - x),
        resembles=("current_gain",),
        summary="the current sensor saturates at (1 − x) times the largest current",
    ),
    FaultKind(
        "current_remanence", OUTSIDE, "remanence_a", "A",
        _amperes(1e-3, 0.25),
        lambda c, _p, x, _s, _r: replace(c, remanence_a=x),
        resembles=("current_offset",),
        summary="magnetic remanence of x A in the current sensor",
    ),
    FaultKind(
        "string_dropout", OUTSIDE, "rise", "-", _span(0.02, 3.0), _intermittent("string_loss"),
        shape={"on_s": ShapeRange(60.0, 400.0), "off_s": ShapeRange(150.0, 900.0)},
        resembles=("resistance_step",),
        summary="a parallel string drops out at times: overpotentials rise by the factor 1 + x",
    ),
    FaultKind(
        "parasitic_switching", OUTSIDE, "load_a", "A",
        _amperes(2e-3, 0.3), _intermittent("hidden_load"),
        shape={"on_s": ShapeRange(60.0, 500.0), "off_s": ShapeRange(100.0, 700.0)},
        resembles=("current_offset",),
        summary="a load of x A, not measured by the current sensor, switches on and off",
    ),
    FaultKind(
        "noise_bursts", OUTSIDE, "noise_v", "V",
        _volts(2e-4, 0.04), _intermittent("bursts"),
        shape={"on_s": ShapeRange(2.0, 40.0), "off_s": ShapeRange(20.0, 120.0)},
        summary="bursts of noise of x V on the voltage",
    ),
    FaultKind(
        "contact_flicker", OUTSIDE, "contact_ohm", "Ω",
        _ohms(0.02, 3.0), _intermittent("flicker"),
        shape={"on_s": ShapeRange(2.0, 25.0), "off_s": ShapeRange(8.0, 60.0)},
        resembles=("resistance_step",),
        summary="an intermittent contact: x Ω more for some seconds at a time",
    ),
    FaultKind(
        "stale_frames", OUTSIDE, "hold_s", "s", _span(0.5, 200.0), _stale,
        shape={"off_s": ShapeRange(15.0, 90.0)},
        resembles=("time_skew",),
        summary="the voltage repeats its last value for about x s at a time",
    ),
    FaultKind(
        "temperature_stuck", OUTSIDE, "hold", "-", _span(0.1, 1.0),
        lambda c, _p, x, _s, _r: replace(c, temperature_hold=x),
        resembles=("temperature_lag",),
        summary="the temperature sensor follows by the fraction 1 − x",
    ),
)  # fmt: skip


_KINDS: Final[dict[str, FaultKind]] = {kind.id: kind for kind in (*_IN_LIBRARY, *_OUTSIDE)}


@dataclass(frozen=True)
class Fault:
    """One fault of a pack.

    Parameters
    ----------
    id : str
        Id of its kind.
    size : float
        In the unit of its kind; 0 has no effect.
    shape : dict of str to float
        Given shape parameters; the others are drawn from `seed`.
    seed : int
    """

    id: str
    size: float
    shape: Mapping[str, float] = field(default_factory=dict)
    seed: int = 0

    @property
    def kind(self) -> FaultKind:
        """Kind of the fault."""
        return fault_kind(self.id)

    def full_shape(self) -> dict[str, float]:
        """Return all shape parameters, given or drawn."""
        rng = np.random.default_rng(self.seed)
        drawn = {name: values.draw(rng) for name, values in self.kind.shape.items()}
        return drawn | dict(self.shape)

    def sized(self, size: float) -> Fault:
        """Return the fault with another size."""
        return replace(self, size=size)


def apply_faults(pack: TwinPack, faults: tuple[Fault, ...]) -> Condition:
    """Return the condition of a pack with faults.

    Raises
    ------
    InputError
        For an unknown kind, or two faults of the same kind.
    """
    condition = HEALTHY
    if len({fault.id for fault in faults}) != len(faults):
        raise InputError("an effect is given twice", field="--effect", cure="give each once")
    for fault in faults:
        if fault.size != 0.0:
            condition = fault.kind.apply(
                condition, pack, fault.size, fault.full_shape(), fault.seed
            )
    return condition


def fault_kind(fault_id: str) -> FaultKind:
    """Return a kind by its id.

    Raises
    ------
    InputError
        For an unknown id.
    """
    if fault_id not in _KINDS:
        raise InputError(
            "unknown effect", field="--effect", value=fault_id, cure=f"use {', '.join(_KINDS)}"
        )
    return _KINDS[fault_id]


def fault_kinds(*, outside: bool = False) -> tuple[FaultKind, ...]:
    """Return the kinds with a counterpart in the effects library, or those outside it."""
    return tuple(k for k in _KINDS.values() if (k.family == OUTSIDE) is outside)


def parse_effect(
    text: str, pack: TwinPack, *, seed: int, default_gap_v: float
) -> tuple[Fault, float | None]:
    """Parse an effect given as text.

    Parameters
    ----------
    text : str
        For example `current_offset:offset_a=2` or `resistance_step:step_ohm=0.02,at_s=1200`.
        `gap_v=` instead of the size gives the RMS gap to open.
    pack : TwinPack
        Sets the physical limits of the size.
    seed : int
        Seed of shape parameters that are not given.
    default_gap_v : float
        RMS gap to open if neither size nor gap is given [V].

    Returns
    -------
    fault : Fault
        Of size 1 if a gap is to be opened.
    gap_v : float or None
        RMS gap to open [V]; None if the size was given.

    Raises
    ------
    InputError
        For an unknown effect or parameter, or a value that is no number or outside its limits.
    """
    fault_id, _, rest = text.partition(":")
    kind = fault_kind(fault_id.strip())
    given = {}
    for part in filter(None, rest.split(",")):
        name, sign, value = (item.strip() for item in part.partition("="))
        names = (kind.parameter, GAP, *kind.shape)
        if not sign or name not in names:
            raise InputError(
                f"unknown parameter of {kind.id}",
                field="--effect",
                value=part,
                cure=f"use {', '.join(f'{item}=NUMBER' for item in names)}",
            )
        given[name] = _number(value, part)
        if name in kind.shape:
            limits = kind.shape[name]
            low, high = limits.accepted or (limits.low, limits.high)
            if not low <= given[name] <= high:
                raise InputError(
                    f"must lie within {low:g} … {high:g}", field="--effect", value=part
                )
    size = given.pop(kind.parameter, None)
    gap_v = given.pop(GAP, None)
    if size is not None and gap_v is not None:
        raise InputError(
            "either a size or a gap", field="--effect", value=text, cure=f"leave {GAP} out"
        )
    if size is not None:
        _, high = kind.limits(pack)
        low = -high if kind.signed else 0.0
        if not low <= size <= high:
            raise InputError(
                f"{kind.parameter} of {kind.id} lies within {low:.4g} … {high:.4g} {kind.unit}"
                " for this pack",
                field="--effect",
                value=size,
            )
        return Fault(kind.id, size, given, seed), None
    target_v = default_gap_v if gap_v is None else gap_v
    largest_v = 0.2 * pack.nominal_v
    if not 0.0 < target_v < largest_v:
        raise InputError(
            f"a gap lies between 0 and {largest_v:.0f} V for this pack",
            field="--effect",
            value=target_v,
        )
    return Fault(kind.id, 1.0, given, seed), target_v


def _number(text: str, part: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError("not a number", field="--effect", value=part)
    return value

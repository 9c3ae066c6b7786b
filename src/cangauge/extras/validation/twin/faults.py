"""Faults of a simulated pack: twenty-two with a counterpart in the effects library, nine without.

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


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault.

    Parameters
    ----------
    id : str
        As in the effects library, where it has a counterpart.
    parameter, unit : str
        Name and unit of the size.
    limits : callable
        Pack → smallest and largest physical size, both positive.
    change : callable
        (fault, pack) → fields of `Condition` that the fault sets.
    signed : bool
        Whether the size may be negative.
    shape : dict of str to ShapeRange
        Further parameters.
    """

    id: str
    parameter: str
    unit: str
    limits: Callable[[TwinPack], tuple[float, float]]
    change: Callable[[Fault, TwinPack], dict[str, Any]]
    signed: bool = False
    shape: Mapping[str, ShapeRange] = field(default_factory=dict)


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


# --- Limits of sizes


def _span(low: float, high: float) -> Callable[[TwinPack], tuple[float, float]]:
    return lambda _pack: (low, high)


def _amperes(low: float, high: float) -> Callable[[TwinPack], tuple[float, float]]:
    """Return limits relative to the 1C current."""
    return lambda pack: (low * pack.one_c_a, high * pack.one_c_a)


def _volts(low: float, high: float) -> Callable[[TwinPack], tuple[float, float]]:
    """Return limits relative to the nominal voltage."""
    return lambda pack: (low * pack.nominal_v, high * pack.nominal_v)


def _ohms(low: float, high: float) -> Callable[[TwinPack], tuple[float, float]]:
    """Return limits relative to the pack resistance at 25 °C."""
    return lambda pack: (low * pack.resistance_ohm, high * pack.resistance_ohm)


# --- Changes of the condition


def _sets(name: str, of_size: Callable[[float], float] = float) -> Callable[..., dict[str, Any]]:
    """Return the change of one field of `Condition` to a function of the size."""
    return lambda fault, _pack: {name: of_size(fault.size)}


def _intermittent(name: str) -> Callable[..., dict[str, Any]]:
    """Return the change of one field of `Condition` to a disturbance that comes and goes."""

    def change(fault: Fault, _pack: TwinPack) -> dict[str, Any]:
        shape = fault.full_shape()
        return {name: Intermittent(fault.size, shape["on_s"], shape["off_s"], fault.seed)}

    return change


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


def _fast(fault: Fault, _pack: TwinPack) -> dict[str, Any]:
    shape = fault.full_shape()
    return {"relaxations": cole_cole(fault.size, shape["tau_s"], shape["alpha"])}


def _slow(fault: Fault, _pack: TwinPack) -> dict[str, Any]:
    return {"relaxations": finite_warburg(fault.size, fault.full_shape()["tau_s"])}


def _soc_rise(fault: Fault, _pack: TwinPack) -> dict[str, Any]:
    shape = fault.full_shape()
    centre, width = shape["centre"], shape["width"]
    if shape["towards_full"] > 0.75:
        centre, width = 1.0 - centre, -width
    return {"soc_resistance": SocResistance(fault.size, centre, width)}


def _step(fault: Fault, _pack: TwinPack) -> dict[str, Any]:
    return {"step_ohm": fault.size, "step_at_s": fault.full_shape()["at_s"]}


def _hysteresis(fault: Fault, _pack: TwinPack) -> dict[str, Any]:
    return {"hysteresis_v": fault.size, "hysteresis_reach": fault.full_shape()["reach"]}


def _entropy(fault: Fault, pack: TwinPack) -> dict[str, Any]:
    """Change dU/dT by a smooth curve over the SoC, drawn from the seed, whose RMS is the size."""
    rng = np.random.default_rng(fault.seed)
    knots = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    curve = PchipInterpolator(knots, rng.normal(size=5) + 0.8 * rng.choice((-1.0, 1.0)))
    bend = curve(np.clip(pack.chemistry.grid, 0.0, 1.0))
    unit = np.asarray(bend / np.sqrt(np.mean(bend**2)), dtype=np.float64)
    return {"entropy_shift_v_k": 1e-3 * fault.size * unit}


def _weak(fault: Fault, _pack: TwinPack) -> dict[str, Any]:
    shape = fault.full_shape()
    return {"weak": WeakCells(int(shape["count"]), fault.size, shape["deficit"] * fault.size)}


def _stale(fault: Fault, _pack: TwinPack) -> dict[str, Any]:
    return {"stale": Intermittent(1.0, fault.size, fault.full_shape()["off_s"], fault.seed)}


def _ripple(fault: Fault, pack: TwinPack) -> dict[str, Any]:
    shape = fault.full_shape()
    return {
        "ripple_v": fault.size,
        "ripple_period_v": shape["period_share"] * pack.nominal_v,
        "ripple_phase": shape["phase"],
    }


# --- Kinds

_IN_LIBRARY: Final = (
    # The current sensor reads x A too high.
    FaultKind(
        "current_offset",
        "offset_a",
        "A",
        _amperes(1e-4, 0.15),
        _sets("current_offset_a"),
        signed=True,
    ),
    # The current sensor reads (1 + x) times the current.
    FaultKind("current_gain", "gain", "-", _span(1e-3, 0.10), _sets("current_gain"), signed=True),
    # The voltage sensor reads x V too high.
    FaultKind(
        "voltage_offset",
        "offset_v",
        "V",
        _volts(1e-4, 0.03),
        _sets("voltage_offset_v"),
        signed=True,
    ),
    # The voltage sensor reads (1 + x) times the voltage.
    FaultKind("voltage_gain", "gain", "-", _span(1e-4, 0.03), _sets("voltage_gain"), signed=True),
    # The temperature sensor reads x K too high.
    FaultKind(
        "temperature_offset",
        "offset_k",
        "K",
        _span(0.1, 15.0),
        _sets("temperature_offset_k"),
        signed=True,
    ),
    # The temperature sensor lags by x s (two lags of x/2 in series).
    FaultKind("temperature_lag", "lag_s", "s", _span(40.0, 2000.0), _sets("temperature_lag_s")),
    # The thermal resistance between core and sensor grows by the factor 1 + x.
    FaultKind("core_temperature", "insulation", "-", _span(0.1, 25.0), _sets("insulation")),
    # The recorded current is delayed by x s.
    FaultKind("time_skew", "skew_s", "s", _span(0.01, 4.0), _sets("current_skew_s"), signed=True),
    # The true capacity is (1 − x) times the assumed one.
    FaultKind(
        "capacity",
        "loss",
        "-",
        _span(2e-3, 0.35),
        _sets("capacity_factor", lambda x: 1.0 - x),
        signed=True,
    ),
    # The true initial SoC is x % above the assumed one.
    FaultKind(
        "initial_soc",
        "shift_pct",
        "%",
        _span(0.05, 12.0),
        _sets("start_soc_shift", lambda x: x / 100.0),
        signed=True,
    ),
    # The fraction x of the charge put in cannot be taken out again.
    FaultKind("coulombic_efficiency", "loss", "-", _span(2e-3, 0.10), _sets("charge_loss")),
    # Resistance is multiplied by exp(x/(T − 230 K)), relative to 25 °C.
    FaultKind(
        "resistance_temperature",
        "stiffness_k",
        "K",
        _span(1.0, 150.0),
        _sets("cold_resistance_k"),
    ),
    # The ohmic resistance rises by x along a logistic curve towards empty (or full).
    FaultKind(
        "resistance_soc",
        "rise",
        "-",
        _span(0.02, 4.0),
        _soc_rise,
        shape={
            "centre": ShapeRange(0.15, 0.65),
            "width": ShapeRange(0.02, 0.10),
            "towards_full": ShapeRange(0.0, 1.0),
        },
    ),
    # x Ω more resistance during charge.
    FaultKind("resistance_asymmetry", "charging_ohm", "Ω", _ohms(0.01, 1.5), _sets("charging_ohm")),
    # x Ω more resistance from the first row on.
    FaultKind("resistance_growth", "grown_ohm", "Ω", _ohms(0.01, 2.0), _sets("step_ohm")),
    # x Ω more resistance from the time at_s on.
    FaultKind(
        "resistance_step",
        "step_ohm",
        "Ω",
        _ohms(0.005, 1.0),
        _step,
        shape={"at_s": ShapeRange(500.0, 3000.0, accepted=(0.0, 86400.0))},
    ),
    # The exchange current of the electrodes falls to 1/(1 + x).
    FaultKind("charge_transfer", "slowdown", "-", _span(0.05, 80.0), _sets("transfer_slowdown")),
    # A Cole–Cole element of x Ω with a time constant of seconds.
    FaultKind(
        "fast_polarization",
        "added_ohm",
        "Ω",
        _ohms(0.01, 1.0),
        _fast,
        shape={"tau_s": ShapeRange(0.8, 6.0, logarithmic=True), "alpha": ShapeRange(0.75, 0.97)},
    ),
    # A finite Warburg element of x Ω with a time constant of minutes.
    FaultKind(
        "slow_diffusion",
        "added_ohm",
        "Ω",
        _ohms(0.01, 1.5),
        _slow,
        shape={"tau_s": ShapeRange(150.0, 1800.0, logarithmic=True)},
    ),
    # The open-circuit voltage is x V lower after discharge, x V higher after charge.
    FaultKind(
        "hysteresis",
        "half_width_v",
        "V",
        _volts(2e-4, 0.01),
        _hysteresis,
        shape={"reach": ShapeRange(0.005, 0.08, logarithmic=True)},
    ),
    # dU/dT of a cell changes by a smooth curve over the SoC, of RMS x.
    FaultKind("entropic_coefficient", "bend_mv_k", "mV/K", _span(0.01, 0.5), _entropy),
    # One to three cells lack the fraction x of their capacity.
    FaultKind(
        "weak_cell",
        "loss",
        "-",
        _span(0.02, 0.65),
        _weak,
        shape={"count": ShapeRange(1, 3, whole=True), "deficit": ShapeRange(0.0, 0.3)},
    ),
)
_OUTSIDE: Final = (
    # Integral nonlinearity of the voltage sensor, a sine of x V.
    FaultKind(
        "voltage_nonlinearity",
        "ripple_v",
        "V",
        _volts(2e-4, 0.02),
        _ripple,
        shape={"period_share": ShapeRange(0.02, 0.05), "phase": ShapeRange(0.0, 6.28)},
    ),
    # The current sensor saturates at (1 − x) times the largest current.
    FaultKind(
        "current_clipping",
        "cut",
        "-",
        _span(0.1, 0.9),
        _sets("clip_share", lambda x: 1.0 - x),
    ),
    # Magnetic remanence of x A in the current sensor.
    FaultKind("current_remanence", "remanence_a", "A", _amperes(1e-3, 0.25), _sets("remanence_a")),
    # A parallel string drops out at times: overpotentials rise by the factor 1 + x.
    FaultKind(
        "string_dropout",
        "rise",
        "-",
        _span(0.02, 3.0),
        _intermittent("string_loss"),
        shape={"on_s": ShapeRange(60.0, 400.0), "off_s": ShapeRange(150.0, 900.0)},
    ),
    # A load of x A, not measured by the current sensor, switches on and off.
    FaultKind(
        "parasitic_switching",
        "load_a",
        "A",
        _amperes(2e-3, 0.3),
        _intermittent("hidden_load"),
        shape={"on_s": ShapeRange(60.0, 500.0), "off_s": ShapeRange(100.0, 700.0)},
    ),
    # Bursts of noise of x V on the voltage.
    FaultKind(
        "noise_bursts",
        "noise_v",
        "V",
        _volts(2e-4, 0.04),
        _intermittent("bursts"),
        shape={"on_s": ShapeRange(2.0, 40.0), "off_s": ShapeRange(20.0, 120.0)},
    ),
    # An intermittent contact: x Ω more for some seconds at a time.
    FaultKind(
        "contact_flicker",
        "contact_ohm",
        "Ω",
        _ohms(0.02, 3.0),
        _intermittent("flicker"),
        shape={"on_s": ShapeRange(2.0, 25.0), "off_s": ShapeRange(8.0, 60.0)},
    ),
    # The voltage repeats its last value for about x s at a time.
    FaultKind(
        "stale_frames",
        "hold_s",
        "s",
        _span(0.5, 200.0),
        _stale,
        shape={"off_s": ShapeRange(15.0, 90.0)},
    ),
    # The temperature sensor follows by the fraction 1 − x.
    FaultKind("temperature_stuck", "hold", "-", _span(0.1, 1.0), _sets("temperature_hold")),
)
_KINDS: Final[dict[str, FaultKind]] = {kind.id: kind for kind in (*_IN_LIBRARY, *_OUTSIDE)}


def fault_kinds(*, outside: bool = False) -> tuple[FaultKind, ...]:
    """Return the kinds with a counterpart in the effects library, or those outside it."""
    return _OUTSIDE if outside else _IN_LIBRARY


def fault_kind(fault_id: str) -> FaultKind:
    """Return a kind by its id; InputError for an unknown one."""
    if fault_id not in _KINDS:
        raise InputError(
            "unknown effect", field="--effect", value=fault_id, cure=f"use {', '.join(_KINDS)}"
        )
    return _KINDS[fault_id]


def apply_faults(pack: TwinPack, faults: tuple[Fault, ...]) -> Condition:
    """Return the condition of a pack with faults.

    Raises
    ------
    InputError
        For an unknown kind, or two faults of the same kind.
    """
    if len({fault.id for fault in faults}) != len(faults):
        raise InputError("an effect is given twice", field="--effect", cure="give each once")
    condition = HEALTHY
    for fault in faults:
        if fault.size != 0.0:
            changed = fault.kind.change(fault, pack)
            relaxations = (*condition.relaxations, *changed.get("relaxations", ()))
            condition = replace(condition, **(changed | {"relaxations": relaxations}))
    return condition


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
    given = dict(_parameter(kind, part) for part in filter(None, rest.split(",")))
    size, gap_v = given.pop(kind.parameter, None), given.pop(GAP, None)
    if size is not None and gap_v is not None:
        raise _refused("either a size or a gap", text, f"leave {GAP} out")
    if size is not None:
        _, high = kind.limits(pack)
        low = -high if kind.signed else 0.0
        if not low <= size <= high:
            limits = f"within {low:.4g} … {high:.4g} {kind.unit}"
            raise _refused(f"{kind.parameter} of {kind.id} lies {limits} for this pack", size)
        return Fault(kind.id, size, given, seed), None
    target_v = default_gap_v if gap_v is None else gap_v
    largest_v = 0.2 * pack.nominal_v
    if not 0.0 < target_v < largest_v:
        raise _refused(f"a gap lies between 0 and {largest_v:.0f} V for this pack", target_v)
    return Fault(kind.id, 1.0, given, seed), target_v


def _parameter(kind: FaultKind, text: str) -> tuple[str, float]:
    """Parse `NAME=NUMBER` of a kind."""
    name, sign, value = (item.strip() for item in text.partition("="))
    names = (kind.parameter, GAP, *kind.shape)
    if not sign or name not in names:
        cure = f"use {', '.join(f'{item}=NUMBER' for item in names)}"
        raise _refused(f"unknown parameter of {kind.id}", text, cure)
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise _refused("not a number", text)
    if (shape := kind.shape.get(name)) is not None:
        low, high = shape.accepted or (shape.low, shape.high)
        if not low <= number <= high:
            raise _refused(f"must lie within {low:g} … {high:g}", text)
    return name, number


def _refused(problem: str, value: object, cure: str | None = None) -> InputError:
    return InputError(problem, field="--effect", value=value, cure=cure)

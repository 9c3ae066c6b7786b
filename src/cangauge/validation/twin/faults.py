"""What a kind of fault is: its size, its limits, its shape and what it changes.

The twenty faults whose signature a diagnosis may name, each by the twin's own physics.

Faults that no diagnosis is expected to know by name: for tests of its "unknown".

Faults put into a simulated pack.

Twenty have a name that a diagnosis may use; some no diagnosis is expected to know.

A fault has one size, whose meaning and physical limits its kind states, and a shape (where,
when, how fast) drawn from a seed or given.

Faults as text: `ID`, `ID:parameter=value` or `ID:parameter=value,shape=value`.
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
from cangauge.validation.twin.condition import HEALTHY, Condition, Hump, Mode, Switching, WeakCells
from cangauge.validation.twin.pack import Pack

# --- What a kind of fault is: its size, its limits, its shape and what it changes

OUTSIDE: Final = "outside"
"""Family of the faults that are meant to be unknown to a diagnosis."""


@dataclass(frozen=True)
class Span:
    """Range of a shape, drawn evenly or, over decades, evenly in its logarithm.

    Parameters
    ----------
    low, high : float
        What is drawn lies between them.
    logarithmic, whole : bool
        How it is drawn.
    outer : tuple of float, optional
        What a user may give; without, from low to high.
    """

    low: float
    high: float
    logarithmic: bool = False
    whole: bool = False
    outer: tuple[float, float] | None = None

    @property
    def allowed(self) -> tuple[float, float]:
        """Least and largest value that a user may give."""
        return (self.low, self.high) if self.outer is None else self.outer

    def draw(self, rng: np.random.Generator) -> float:
        """Return a value at random."""
        if self.whole:
            return float(rng.integers(int(self.low), int(self.high) + 1))
        if self.logarithmic:
            return float(np.exp(rng.uniform(np.log(self.low), np.log(self.high))))
        return float(rng.uniform(self.low, self.high))


Shape = Mapping[str, float]
Apply = Callable[[Condition, Pack, float, Shape, int], Condition]


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault.

    Parameters
    ----------
    id, family : str
        As in the diagnosis, or family `outside`.
    parameter, unit : str
        Name and unit of the size.
    limits : callable
        Pack → smallest and largest size that make physical sense, both positive.
    apply : callable
        (condition, pack, size, shape, seed) → condition with the fault.
    signed : bool
        Whether the size may be negative too.
    shape : dict of str to Span
        Further parameters.
    physical : bool
        Whether the size is a quantity that a diagnosis could state in the same unit.
    near : tuple of str
        For faults outside: effects whose signature it resembles.
    says : str
        What happens, in words.
    """

    id: str
    family: str
    parameter: str
    unit: str
    limits: Callable[[Pack], tuple[float, float]]
    apply: Apply
    signed: bool = False
    shape: Mapping[str, Span] = field(default_factory=dict)
    physical: bool = False
    near: tuple[str, ...] = ()
    says: str = ""


# --- The twenty faults whose signature a diagnosis may name, each by the twin's own physics

Limits = Callable[[Pack], tuple[float, float]]

_WARBURG_MODES: Final = 6
_COLE_SPREAD: Final = (-1.6, -1.0, -0.5, 0.0, 0.5, 1.0, 1.6)


def _span(low: float, high: float) -> Limits:
    return lambda _pack: (low, high)


def _amperes(low: float, high: float) -> Limits:
    """Limits as parts of the current that empties the pack in an hour."""
    return lambda pack: (low * pack.one_c_a, high * pack.one_c_a)


def _volts(low: float, high: float) -> Limits:
    """Limits as parts of the nominal voltage."""
    return lambda pack: (low * pack.nominal_v, high * pack.nominal_v)


def _ohms(low: float, high: float) -> Limits:
    """Limits as parts of the pack's resistance at 25 °C."""
    return lambda pack: (low * pack.resistance_ohm, high * pack.resistance_ohm)


def cole_cole(ohm: float, tau_s: float, alpha: float) -> tuple[Mode, ...]:
    """Return a Cole–Cole element as seven relaxations.

    The distribution of relaxation times sin((1−α)π)/(cosh(α·ln τ/τ0) − cos((1−α)π)), sampled
    within 1.6 e-folds of τ0 (Cole and Cole 1941).
    """
    away = np.array(_COLE_SPREAD)
    weight = np.sin((1.0 - alpha) * np.pi) / (np.cosh(alpha * away) - np.cos((1.0 - alpha) * np.pi))
    weight /= weight.sum()
    return tuple(
        Mode(float(ohm * share), float(tau_s * np.exp(shift)))
        for share, shift in zip(weight, away, strict=True)
    )


def finite_warburg(ohm: float, slowest_s: float) -> tuple[Mode, ...]:
    """Return a finite-length Warburg element R·tanh(√jωτ)/√jωτ by its first six poles."""
    odd = (2.0 * np.arange(_WARBURG_MODES) + 1.0) ** 2
    weight = 1.0 / odd / np.sum(1.0 / odd)
    return tuple(
        Mode(float(ohm * share), float(slowest_s / pole))
        for share, pole in zip(weight, odd, strict=True)
    )


def _fast(c: Condition, _pack: Pack, size: float, shape: Shape, _seed: int) -> Condition:
    added = cole_cole(size, shape["tau_s"], shape["alpha"])
    return replace(c, modes=(*c.modes, *added))


def _slow(c: Condition, _pack: Pack, size: float, shape: Shape, _seed: int) -> Condition:
    return replace(c, modes=(*c.modes, *finite_warburg(size, shape["tau_s"])))


def _hump(c: Condition, _pack: Pack, size: float, shape: Shape, _seed: int) -> Condition:
    towards_full = shape["towards_full"] > 0.75
    centre = 1.0 - shape["centre"] if towards_full else shape["centre"]
    width = -shape["width"] if towards_full else shape["width"]
    return replace(c, hump=Hump(size, centre, width))


def entropy_bend(pack: Pack, seed: int) -> NDArray[np.float64]:
    """Return a random smooth change of dU/dT over the charge, of RMS 1, on the pack's grid."""
    rng = np.random.default_rng(seed)
    knots = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    curve = PchipInterpolator(knots, rng.normal(size=5) + 0.8 * rng.choice((-1.0, 1.0)))
    bend = curve(np.clip(pack.chemistry.grid, 0.0, 1.0))
    return np.asarray(bend / np.sqrt(np.mean(bend**2)), dtype=np.float64)


def _entropy(c: Condition, pack: Pack, size: float, _shape: Shape, seed: int) -> Condition:
    return replace(c, entropy_shift_v_k=1e-3 * size * entropy_bend(pack, seed))


def _weak(c: Condition, _pack: Pack, size: float, shape: Shape, _seed: int) -> Condition:
    weak = WeakCells(int(shape["count"]), size, shape["deficit"] * size)
    return replace(c, weak=weak)


NAMED: Final[tuple[FaultKind, ...]] = (
    FaultKind(
        "current_offset", "current_sensing", "offset_a", "A", _amperes(1e-4, 0.15),
        lambda c, _p, x, _s, _r: replace(c, current_offset_a=x),
        signed=True, physical=True, says="the current sensor reads x A too much",
    ),
    FaultKind(
        "current_gain", "current_sensing", "gain", "-", _span(1e-3, 0.10),
        lambda c, _p, x, _s, _r: replace(c, current_gain=x),
        signed=True, physical=True, says="the current sensor reads (1 + x) of the current",
    ),
    FaultKind(
        "voltage_offset", "voltage_sensing", "offset_v", "V", _volts(1e-4, 0.03),
        lambda c, _p, x, _s, _r: replace(c, voltage_offset_v=x),
        signed=True, physical=True, says="the voltage sensor reads x V too much",
    ),
    FaultKind(
        "voltage_gain", "voltage_sensing", "gain", "-", _span(1e-4, 0.03),
        lambda c, _p, x, _s, _r: replace(c, voltage_gain=x),
        signed=True, physical=True, says="the voltage sensor reads (1 + x) of the voltage",
    ),
    FaultKind(
        "temperature_lag", "thermal", "lag_s", "s", _span(40.0, 2000.0),
        lambda c, _p, x, _s, _r: replace(c, temperature_lag_s=x),
        says="the temperature sensor sits in a pocket: two lags of x/2 in a row",
    ),
    FaultKind(
        "core_temperature", "thermal", "insulation", "-", _span(0.1, 25.0),
        lambda c, _p, x, _s, _r: replace(c, insulation=x),
        says="the cells' core sheds its heat 1 + x times worse, so it is hotter than the sensor",
    ),
    FaultKind(
        "time_skew", "timing", "skew_s", "s", _span(0.01, 4.0),
        lambda c, _p, x, _s, _r: replace(c, current_skew_s=x),
        signed=True, physical=True, says="the recorded current is x s late",
    ),
    FaultKind(
        "capacity", "charge", "loss", "-", _span(2e-3, 0.35),
        lambda c, _p, x, _s, _r: replace(c, capacity_factor=1.0 - x),
        signed=True, physical=True, says="the true capacity is 1 − x of the assumed one",
    ),
    FaultKind(
        "initial_soc", "charge", "shift_pct", "%", _span(0.05, 12.0),
        lambda c, _p, x, _s, _r: replace(c, start_soc_shift=x / 100.0),
        signed=True, physical=True, says="the true start SoC is x % above the assumed one",
    ),
    FaultKind(
        "coulombic_efficiency", "charge", "loss", "-", _span(2e-3, 0.10),
        lambda c, _p, x, _s, _r: replace(c, charge_loss=x),
        physical=True, says="x of the charge put in cannot be taken out again",
    ),
    FaultKind(
        "resistance_temperature", "resistance", "stiffness_k", "K", _span(1.0, 150.0),
        lambda c, _p, x, _s, _r: replace(c, cold_stiffness_k=x),
        says="resistance rises by exp(x/(T − 230 K)) more than it did, relative to 25 °C",
    ),
    FaultKind(
        "resistance_soc", "resistance", "rise", "-", _span(0.02, 4.0), _hump,
        shape={"centre": Span(0.15, 0.65), "width": Span(0.02, 0.10),
               "towards_full": Span(0.0, 1.0)},
        says="ohmic resistance rises by x along a logistic curve towards empty (or full)",
    ),
    FaultKind(
        "resistance_asymmetry", "resistance", "charging_ohm", "Ω", _ohms(0.01, 1.5),
        lambda c, _p, x, _s, _r: replace(c, charging_ohm=x),
        physical=True, says="x more resistance while charging",
    ),
    FaultKind(
        "resistance_step", "resistance", "step_ohm", "Ω", _ohms(0.005, 1.0),
        lambda c, _p, x, s, _r: replace(c, step_ohm=x, step_at_s=s["at_s"]),
        shape={"at_s": Span(500.0, 3000.0, outer=(0.0, 86400.0))},
        physical=True, says="x more resistance from a moment on",
    ),
    FaultKind(
        "charge_transfer", "dynamics", "slowdown", "-", _span(0.05, 80.0),
        lambda c, _p, x, _s, _r: replace(c, transfer_slowdown=x),
        says="the exchange current of the electrodes falls to 1/(1 + x)",
    ),
    FaultKind(
        "fast_polarization", "dynamics", "added_ohm", "Ω", _ohms(0.01, 1.0), _fast,
        shape={"tau_s": Span(0.8, 6.0, logarithmic=True), "alpha": Span(0.75, 0.97)},
        says="a Cole–Cole element of x Ω with seconds of delay",
    ),
    FaultKind(
        "slow_diffusion", "dynamics", "added_ohm", "Ω", _ohms(0.01, 1.5), _slow,
        shape={"tau_s": Span(150.0, 1800.0, logarithmic=True)},
        says="a finite Warburg element of x Ω with minutes of delay",
    ),
    FaultKind(
        "hysteresis", "equilibrium", "half_width_v", "V", _volts(2e-4, 0.01),
        lambda c, _p, x, s, _r: replace(c, hysteresis_v=x, hysteresis_reach=s["reach"]),
        shape={"reach": Span(0.005, 0.08, logarithmic=True)},
        says="the open-circuit voltage is x V lower after discharge, x V higher after charge",
    ),
    FaultKind(
        "entropic_coefficient", "equilibrium", "bend_mv_k", "mV/K", _span(0.01, 0.5), _entropy,
        says="dU/dT of a cell differs by a smooth curve of RMS x over the charge",
    ),
    FaultKind(
        "weak_cell", "imbalance", "loss", "-", _span(0.02, 0.65), _weak,
        shape={"count": Span(1, 3, whole=True), "deficit": Span(0.0, 0.3)},
        says="one to three cells hold x less than the others",
    ),
)  # fmt: skip


# --- Faults that no diagnosis is expected to know by name: for tests of its "unknown"


def _switching(name: str) -> Callable[[Condition, Pack, float, Shape, int], Condition]:
    def apply(c: Condition, _pack: Pack, size: float, shape: Shape, seed: int) -> Condition:
        change: dict[str, Any] = {name: Switching(size, shape["on_s"], shape["off_s"], seed)}
        return replace(c, **change)

    return apply


def _stale(c: Condition, _pack: Pack, size: float, shape: Shape, seed: int) -> Condition:
    return replace(c, stale=Switching(1.0, size, shape["off_s"], seed))


def _ripple(c: Condition, pack: Pack, size: float, shape: Shape, _seed: int) -> Condition:
    period = shape["period_share"] * pack.nominal_v
    return replace(c, ripple_v=size, ripple_period_v=period, ripple_phase=shape["phase"])


UNNAMED: Final[tuple[FaultKind, ...]] = (
    FaultKind(
        "voltage_nonlinearity", OUTSIDE, "ripple_v", "V",
        lambda p: (2e-4 * p.nominal_v, 0.02 * p.nominal_v), _ripple,
        shape={"period_share": Span(0.02, 0.05), "phase": Span(0.0, 6.28)},
        says="the voltage sensor bends to and fro by x V as its reading rises",
    ),
    FaultKind(
        "current_clipping", OUTSIDE, "cut", "-", lambda _p: (0.1, 0.9),
        lambda c, _p, x, _s, _r: replace(c, clip_share=1.0 - x),
        near=("current_gain",),
        says="the current sensor saturates at 1 − x of the largest current",
    ),
    FaultKind(
        "current_remanence", OUTSIDE, "remanence_a", "A",
        lambda p: (1e-3 * p.one_c_a, 0.25 * p.one_c_a),
        lambda c, _p, x, _s, _r: replace(c, remanence_a=x),
        near=("current_offset",),
        says="the current sensor keeps x A of the way that the current last went",
    ),
    FaultKind(
        "string_dropout", OUTSIDE, "rise", "-", lambda _p: (0.02, 3.0), _switching("string_loss"),
        shape={"on_s": Span(60.0, 400.0), "off_s": Span(150.0, 900.0)},
        near=("resistance_step",),
        says="a parallel string comes and goes: all losses rise by x meanwhile",
    ),
    FaultKind(
        "parasitic_switching", OUTSIDE, "load_a", "A",
        lambda p: (2e-3 * p.one_c_a, 0.3 * p.one_c_a), _switching("hidden_load"),
        shape={"on_s": Span(60.0, 500.0), "off_s": Span(100.0, 700.0)},
        near=("current_offset",),
        says="a load of x A before the current sensor switches on and off",
    ),
    FaultKind(
        "noise_bursts", OUTSIDE, "noise_v", "V",
        lambda p: (2e-4 * p.nominal_v, 0.04 * p.nominal_v), _switching("bursts"),
        shape={"on_s": Span(2.0, 40.0), "off_s": Span(20.0, 120.0)},
        says="bursts of noise of x V on the voltage",
    ),
    FaultKind(
        "contact_flicker", OUTSIDE, "contact_ohm", "Ω",
        lambda p: (0.02 * p.resistance_ohm, 3.0 * p.resistance_ohm), _switching("flicker"),
        shape={"on_s": Span(2.0, 25.0), "off_s": Span(8.0, 60.0)},
        near=("resistance_step",),
        says="a contact flickers: x Ω more for some seconds, again and again",
    ),
    FaultKind(
        "stale_frames", OUTSIDE, "hold_s", "s", lambda _p: (0.5, 200.0), _stale,
        shape={"off_s": Span(15.0, 90.0)},
        near=("time_skew",),
        says="the voltage repeats its last value for x s, again and again",
    ),
    FaultKind(
        "temperature_stuck", OUTSIDE, "hold", "-", lambda _p: (0.1, 1.0),
        lambda c, _p, x, _s, _r: replace(c, temperature_hold=x),
        near=("temperature_lag",),
        says="the temperature sensor follows by 1 − x only",
    ),
)  # fmt: skip


# --- Faults put into a simulated pack

KINDS_BY_ID: Final[dict[str, FaultKind]] = {kind.id: kind for kind in (*NAMED, *UNNAMED)}


@dataclass(frozen=True)
class Fault:
    """One fault of a pack.

    Parameters
    ----------
    id : str
        Of its kind.
    size : float
        In the unit of its kind; 0 does nothing.
    shape : dict of str to float
        As far as given; the rest is drawn from `seed`.
    seed : int
    """

    id: str
    size: float
    shape: Mapping[str, float] = field(default_factory=dict)
    seed: int = 0

    @property
    def kind(self) -> FaultKind:
        """What kind of fault it is."""
        return fault_kind(self.id)

    def full_shape(self) -> dict[str, float]:
        """Return the shape, drawn where it was not given."""
        rng = np.random.default_rng(self.seed)
        drawn = {name: span.draw(rng) for name, span in self.kind.shape.items()}
        return drawn | dict(self.shape)

    def sized(self, size: float) -> Fault:
        """Return the fault with another size."""
        return replace(self, size=size)


def apply_faults(pack: Pack, faults: tuple[Fault, ...]) -> Condition:
    """Return the condition of a pack that has these faults.

    Parameters
    ----------
    pack : Pack
    faults : tuple of Fault

    Raises
    ------
    InputError
        If a kind is unknown, or two faults are of the same kind.
    """
    condition = HEALTHY
    if len({fault.id for fault in faults}) != len(faults):
        raise InputError("a fault is given twice", field="--effect", cure="give each once")
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
        If there is none of this name.
    """
    try:
        return KINDS_BY_ID[fault_id]
    except KeyError:
        raise InputError(
            "no such effect",
            field="--effect",
            value=fault_id,
            cure=f"use one of: {', '.join(KINDS_BY_ID)}",
        ) from None


def fault_kinds(*, outside: bool = False) -> tuple[FaultKind, ...]:
    """Return the kinds that a diagnosis may name, or those outside of its knowledge."""
    return tuple(k for k in KINDS_BY_ID.values() if (k.family == OUTSIDE) is outside)


# --- Faults as text: `ID`, `ID:parameter=value` or `ID:parameter=value,shape=value`

GAP = "gap_v"
"""In place of a size: the RMS gap that the fault shall open [V]."""


@dataclass(frozen=True)
class AskedFault:
    """A fault as asked for.

    Parameters
    ----------
    fault : Fault
        Of size 1 (or −1) if only a gap was asked for.
    gap_v : float, optional
        RMS gap to be opened [V]; None if the size was given.
    """

    fault: Fault
    gap_v: float | None


def parse_effect(text: str, pack: Pack, *, seed: int, default_gap_v: float) -> AskedFault:
    """Return the fault that a text asks for.

    Parameters
    ----------
    text : str
        For example `current_offset:offset_a=2` or `resistance_step:step_ohm=0.02,at_s=1200`.
        `gap_v=` in place of the size asks for a gap; without either, the gap is the default.
    pack : Pack
        For the physical limits of the size.
    seed : int
        Of what is not given.
    default_gap_v : float

    Raises
    ------
    InputError
        If the effect or a parameter is unknown, a value is no number or beyond what is physical.
    """
    fault_id, _, rest = text.partition(":")
    kind = fault_kind(fault_id.strip())
    given = {}
    for part in filter(None, rest.split(",")):
        name, sign, value = (item.strip() for item in part.partition("="))
        allowed = (kind.parameter, GAP, *kind.shape)
        if not sign or name not in allowed:
            raise InputError(
                f"no such parameter of {kind.id}",
                field="--effect",
                value=part,
                cure=f"use {', '.join(f'{item}=NUMBER' for item in allowed)}",
            )
        given[name] = _number(value, part)
        if name in kind.shape:
            _check_shape(kind.shape[name], given[name], part)
    size = given.pop(kind.parameter, None)
    gap_v = given.pop(GAP, None)
    if size is not None and gap_v is not None:
        raise InputError(
            "either a size or a gap", field="--effect", value=text, cure=f"leave {GAP} out"
        )
    if size is not None:
        _check_size(kind.id, size, pack)
        return AskedFault(Fault(kind.id, size, given, seed), None)
    wanted = default_gap_v if gap_v is None else gap_v
    if not 0.0 < wanted < 0.2 * pack.nominal_v:
        raise InputError(
            f"a gap lies between 0 and {0.2 * pack.nominal_v:.0f} V for this pack",
            field="--effect",
            value=wanted,
        )
    return AskedFault(Fault(kind.id, 1.0, given, seed), wanted)


def _check_shape(span: Span, value: float, part: str) -> None:
    low, high = span.allowed
    if not low <= value <= high:
        raise InputError(f"must lie within {low:g} … {high:g}", field="--effect", value=part)


def _check_size(fault_id: str, size: float, pack: Pack) -> None:
    kind = fault_kind(fault_id)
    _, high = kind.limits(pack)
    low = -high if kind.signed else 0.0
    if not low <= size <= high:
        raise InputError(
            f"{kind.parameter} of {kind.id} lies within {low:.4g} … {high:.4g} {kind.unit}"
            " for this pack",
            field="--effect",
            value=size,
        )


def _number(text: str, part: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError("not a number", field="--effect", value=part)
    return value

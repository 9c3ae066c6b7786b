"""The twenty faults whose signature a diagnosis may name, each by the twin's own physics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from cangauge.twin.condition import Condition, Hump, Mode, WeakCells
from cangauge.twin.fault_kind import FaultKind, Shape, Span
from cangauge.twin.pack import Pack

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

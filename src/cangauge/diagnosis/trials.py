"""Every effect as a trial: at a size undone exactly, and as a column about a size.

Effect ids are those of `cangauge.model.effects`; shapes and units are the engine's own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.diagnosis.pack_fit import DROP, KNOTS, LAGS_S, PackFit, Trace, lagged, turned


@dataclass(frozen=True)
class Trial:
    """One effect at one shape, and the bounds of its amplitude."""

    effect: str
    """Its id."""
    shape: float | str | None
    low: float
    high: float
    changes_signal: bool
    """Whether it changes a measured signal or the count; otherwise it adds a voltage."""
    unit: str
    """Unit of the amplitude."""
    scale: float = 0.0
    """Size in which columns are, where the bounds of a case are closer [unit]; 0: the bounds'."""

    @property
    def bound(self) -> float:
        """The larger bound, or the scale [unit]."""
        return self.scale or max(-self.low, self.high)

    @property
    def number(self) -> float:
        """The shape as a number, 0 without one."""
        return self.shape if isinstance(self.shape, float) else 0.0


def library(pack: PackFit) -> list[Trial]:
    """Return every effect at every shape; steps of resistance are added by `analyse`."""
    q, u = pack.capacity_ah, pack.volts
    skews: list[tuple[float | None, float, float]] = [(None, -0.4, 0.4)]
    for seconds in (0.8, 2.0, 3.5):
        skews += [(seconds, 0.0, 1.5 * seconds), (-seconds, -1.5 * seconds, 0.0)]
    signal = [
        Trial("current_offset", None, -0.15 * q, 0.15 * q, True, "A"),
        Trial("current_gain", None, -0.2, 0.2, True, "1"),
        Trial("voltage_offset", None, -0.03 * u, 0.03 * u, True, "V"),
        *[Trial("time_skew", shape, low, high, True, "s") for shape, low, high in skews],
        Trial("temperature_lag", None, 0.0, 1500.0, True, "s"),
        Trial("capacity", None, -0.4, 0.15, True, "1"),
        Trial("initial_soc", None, -15.0, 15.0, True, "%"),
        Trial("coulombic_efficiency", None, 0.0, 0.15, True, "1"),
        *[Trial("core_temperature", tau, -30.0, 30.0, True, "K") for tau in (400.0, 1500.0)],
    ]
    additive: dict[str, tuple[tuple[float | str | None, ...], float, float, str]] = {
        "voltage_gain": ((None,), -0.03, 0.03, "1"),
        "resistance_temperature": ((1500.0, 4000.0), -1.0, 4.0, "1"),
        "resistance_soc": (tuple(_BENDS), -1.0, 4.0, "1"),
        "resistance_asymmetry": ((None,), -0.8, 0.8, "1"),
        "charge_transfer": ((0.05, 0.2, 0.6), -4.0, 4.0, "1"),
        "fast_polarization": ((1.0, 2.5, 6.0, 12.0), -0.2, 2.0, "1"),
        "slow_diffusion": ((60.0, 200.0, 600.0, 1800.0), -0.2, 2.0, "1"),
        "hysteresis": ((0.01, 0.04, 0.12), -0.005 * u, 0.03 * u, "V"),
        "entropic_coefficient": (("level", "slope", "cos", "sin"), -8e-4 * u, 8e-4 * u, "V/K"),
        "weak_cell": ((2.0, 5.0, 10.0), 0.0, 0.15 * u, "V"),
    }
    return signal + [
        Trial(name, shape, low, high, False, unit)
        for name, (shapes, low, high, unit) in additive.items()
        for shape in shapes
    ]


_BENDS = {12.0: 4.0, 25.0: 7.0, 35.0: 7.0, 50.0: 10.0, 75.0: -8.0, 90.0: -4.0}
"""Middle [% SoC] and width [%] of the bends of resistance over SoC; negative: towards full."""

STEP = Trial("resistance_step", None, -0.5, 3.0, False, "1")


_Undo = Callable[[PackFit, Trace, Trial, float], dict[str, Any]]

_UNDO: Final[dict[str, _Undo]] = {
    "current_offset": lambda _, log, __, a: {"current_a": log.current_a - a},
    "current_gain": lambda _, log, __, a: {"current_a": log.current_a / (1.0 + a)},
    "voltage_offset": lambda _, log, __, a: {"voltage_v": log.voltage_v - a},
    "time_skew": lambda _, log, __, a: {"current_a": log.later_current_a(a)},
    "temperature_lag": lambda _, log, __, a: {
        "temperature_c": log.temperature_c + a * np.gradient(log.temperature_c)
    },
    "core_temperature": lambda pack, log, trial, a: {
        "temperature_c": log.temperature_c
        + a * lagged((log.current_a / pack.capacity_ah) ** 2, trial.number)
    },
    "capacity": lambda _, __, ___, a: {"capacity": 1.0 + a},
    "initial_soc": lambda _, log, __, a: {"start_pct": log.start_pct - a},
    "coulombic_efficiency": lambda _, __, ___, a: {"lost": a},
}
"""Effect → the signals of a log without an effect of size a."""


def undone(pack: PackFit, log: Trace, trial: Trial, a: float) -> Trace:
    """Return a log without an effect of size a."""
    return replace(log, **_UNDO[trial.effect](pack, log, trial, a))


def residual(pack: PackFit, log: Trace, trial: Trial | None = None, a: float = 0.0) -> FloatArray:
    """Return measured minus modelled voltage with an effect of size a undone [V], shape (n,)."""
    if trial is not None and not trial.changes_signal:
        return residual(pack, log) - a * additive_column(pack, log, trial)
    if trial is not None:
        log = undone(pack, log, trial, a)
    s = pack.soc(log)
    structure = pack.structure(log.current_a, s, log.temperature_c)
    return np.asarray(log.voltage_v - pack.ocv(s) - structure @ pack.theta[len(KNOTS) :])


def drop(pack: PackFit, log: Trace) -> FloatArray:
    """Return the voltage drop over the fitted resistances [V], positive while discharging."""
    columns = [log.current_a, *[lagged(log.current_a, tau) for tau in LAGS_S]]
    fitted = np.maximum(pack.theta[len(KNOTS) : len(KNOTS) + DROP], 0.0)
    return np.asarray(np.column_stack(columns) @ fitted)


def _colder(pack: PackFit, log: Trace, activation_k: float) -> FloatArray:
    """Return Arrhenius' relative change of a resistance against the references' mean."""
    inverse = 1.0 / (log.temperature_c + 273.15) - 1.0 / (pack.mean_c + 273.15)
    return np.asarray(np.expm1(activation_k * inverse))


def _bend(pack: PackFit, log: Trace, middle_pct: float) -> FloatArray:
    away = (pack.soc(log) - middle_pct) / _BENDS[middle_pct]
    return np.asarray(1.0 / (1.0 + np.exp(np.clip(away, -50.0, 50.0))))


def _entropy(pack: PackFit, log: Trace, shape: str) -> FloatArray:
    s = pack.soc(log)
    over_soc = {
        "level": np.ones_like(s),
        "slope": (s - 50.0) / 50.0,
        "cos": np.cos(s / 50.0 * np.pi),
        "sin": np.sin(s / 50.0 * np.pi),
    }
    return np.asarray((log.temperature_c - pack.mean_c) * over_soc[shape])


def _charge_transfer(pack: PackFit, log: Trace, exchange: float) -> FloatArray:
    rate = log.current_a / pack.capacity_ah
    bend = exchange * np.arcsinh(rate / (2.0 * exchange)) - rate / 2.0
    return np.asarray(-pack.ohm * pack.capacity_ah * bend)


_ADDED: Final[dict[str, Callable[[PackFit, Trace, Trial], FloatArray]]] = {
    "voltage_gain": lambda p, log, _: log.voltage_v - residual(p, log),
    "resistance_temperature": lambda p, log, t: -drop(p, log) * _colder(p, log, t.number),
    "resistance_soc": lambda p, log, t: -drop(p, log) * _bend(p, log, t.number),
    "resistance_asymmetry": lambda p, log, _: -drop(p, log) * (log.current_a < 0.0),
    "resistance_step": lambda p, log, t: (
        -drop(p, log) * (np.arange(len(log.current_a)) >= t.number * len(log.current_a))
    ),
    "charge_transfer": lambda p, log, t: _charge_transfer(p, log, t.number),
    "fast_polarization": lambda p, log, t: -p.ohm * lagged(log.current_a, t.number),
    "slow_diffusion": lambda p, log, t: -p.ohm * lagged(log.current_a, t.number),
    "hysteresis": lambda p, log, t: turned(log.current_a, t.number * p.capacity_ah * 3600.0),
    "entropic_coefficient": lambda p, log, t: _entropy(p, log, str(t.shape)),
    "weak_cell": lambda p, log, t: -np.exp(-np.clip(p.soc(log), -4.0, 100.0) / t.number),
}
"""Effect → the change of the voltage per unit [V]. A gain scales the modelled voltage: the measured
one has the noise of the residual, which would count as evidence of a positive gain."""


def additive_column(pack: PackFit, log: Trace, trial: Trial) -> FloatArray:
    """Return the change of the voltage per unit of an effect that adds a voltage [V]."""
    return np.asarray(_ADDED[trial.effect](pack, log, trial))


def slope(
    pack: PackFit, log: Trace, trial: Trial, a: float = 0.0, r: FloatArray | None = None
) -> FloatArray:
    """Return −d residual / d amplitude at a [V per unit], shape (n,).

    A finite difference; of a long skew at 0 the secant to its shape.
    """
    if not trial.changes_signal:
        return additive_column(pack, log, trial)
    r = residual(pack, log, trial, a) if r is None else r
    h = 0.02 * (trial.high - trial.low)
    if trial.effect == "time_skew" and trial.shape and a == 0.0:
        h = trial.number
    elif a + h > trial.high:
        h = -h
    return (r - residual(pack, log, trial, a + h)) / h


ENTROPY: Final = 4e-4
"""Usual temperature coefficient of a pack's voltage, relative to it [1/K]: a few tenths of a
millivolt per kelvin and cell."""


def healthy_columns(pack: PackFit, log: Trace, r: FloatArray) -> FloatArray:
    """Return what one healthy log may differ by, in standard deviations, shape (n, 12) [V].

    An offset of 0.08 % of the voltage, a start of 0.7 %, a current of 0.002 C, a skew of 0.05 s, a
    capacity of 0.5 %, resistances of 5 and 15 %, an unsettled start, 1.5 K, and the knee.
    """
    n, i, ohm, q, u = (
        np.arange(len(log.current_a)),
        log.current_a,
        pack.ohm,
        pack.capacity_ah,
        pack.volts,
    )
    small = (
        (Trial("initial_soc", None, -1.0, 1.0, True, "%"), 0.7),
        (Trial("current_offset", None, -0.01 * q, 0.01 * q, True, "A"), 0.002 * q),
        (Trial("time_skew", None, -1.0, 1.0, True, "s"), 0.05),
        (Trial("capacity", None, -0.02, 0.02, True, "1"), 0.005),
    )
    per_k = r - residual(pack, replace(log, temperature_c=log.temperature_c + 1.0))
    # A model may fit more per kelvin than any cell has; its sensor's error does not show it.
    per_k *= min(1.0, ENTROPY * u / max(float(np.sqrt(np.mean(per_k**2))), 1e-12))
    return np.column_stack([
        np.full(len(n), 8e-4 * u),
        *[std * slope(pack, log, trial, 0.0, r) for trial, std in small],
        0.05 * drop(pack, log),
        0.1 * ohm * q * np.exp(-n / 150.0), 0.1 * ohm * q * np.exp(-n / 1200.0),
        1.5 * per_k,
        0.15 * ohm * lagged(i, 8.0), 0.15 * ohm * lagged(i, 600.0),
        0.003 * u * np.exp(-np.clip(pack.soc(log), -4.0, 100.0) / 4.0),
    ])  # fmt: skip

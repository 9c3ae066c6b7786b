"""What is wrong with a pack and its sensors on a day; the defaults are a healthy pack."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray


@dataclass(frozen=True)
class Mode:
    """One relaxation of the whole pack beyond the clean ones."""

    ohm: float
    tau_s: float


@dataclass(frozen=True)
class Hump:
    """Ohmic resistance that rises towards one end of the charge, by a logistic curve."""

    height: float
    """Rise over the clean ohmic resistance [-]."""
    centre: float
    """State of charge in the middle of the rise [-]."""
    width: float
    """Width of the rise [-]; negative: towards full."""


@dataclass(frozen=True)
class WeakCells:
    """Some cells that hold less than the others."""

    count: int
    loss: float
    """Part of the capacity that they lack [-]."""
    deficit: float
    """Start SoC below that of the others [-]."""


@dataclass(frozen=True)
class Switching:
    """Something that comes and goes: on for a while, off for a while, at random."""

    size: float
    on_s: float
    off_s: float
    seed: int


@dataclass(frozen=True, eq=False)
class Condition:
    """Everything that a fault can change.

    Parameters
    ----------
    capacity_factor : float
        True capacity over the one that the gauge assumes [-].
    charge_loss : float
        Part of the charge put in that cannot be taken out again [-].
    start_soc_shift : float
        True start SoC minus the one that the gauge assumes [-].
    cold_stiffness_k : float
        Extra steepness of the resistance against temperature [K].
    hump : Hump, optional
        Resistance that depends on the state of charge.
    charging_ohm : float
        Extra resistance of the pack while it is charged [Ω].
    step_ohm, step_at_s : float
        Extra resistance of the pack from a moment on [Ω, s].
    transfer_slowdown : float
        Factor by which the exchange current falls, minus 1 [-].
    modes : tuple of Mode
        Extra relaxations.
    hysteresis_v, hysteresis_reach : float
        Half width of the pack's hysteresis [V], and the widest charge swing that it forgets by [-].
    entropy_shift_v_k : array, optional
        Added to dU/dT of one cell [V/K], on the grid of the chemistry.
    weak : WeakCells, optional
    insulation : float
        Extra thermal resistance between core and surface, over the clean one [-].
    current_offset_a, current_gain, current_skew_s : float
        Recorded = (1 + gain)·true(t − skew) + offset [A, -, s].
    voltage_offset_v, voltage_gain : float
        Recorded = (1 + gain)·true + offset [V, -].
    temperature_lag_s : float
        Extra lag of the temperature sensor [s].

    The rest is outside what a diagnosis is expected to know by name.

    string_loss : Switching, optional
        A parallel string comes and goes; size: rise of all overpotentials [-].
    hidden_load : Switching, optional
        A load before the current sensor [A].
    flicker : Switching, optional
        A contact that opens and closes [Ω].
    bursts : Switching, optional
        Noise on the voltage [V].
    stale : Switching, optional
        The voltage repeats its last value while "on".
    ripple_v, ripple_period_v, ripple_phase : float
        Integral nonlinearity of the voltage sensor [V, V, rad].
    clip_share : float
        Part of the largest current beyond which the sensor saturates, from 1 down [-].
    remanence_a : float
        Magnetic memory of the current sensor [A].
    temperature_hold : float
        0: the temperature sensor follows, 1: it is stuck [-].
    """

    capacity_factor: float = 1.0
    charge_loss: float = 0.0
    start_soc_shift: float = 0.0
    cold_stiffness_k: float = 0.0
    hump: Hump | None = None
    charging_ohm: float = 0.0
    step_ohm: float = 0.0
    step_at_s: float = 0.0
    transfer_slowdown: float = 0.0
    modes: tuple[Mode, ...] = ()
    hysteresis_v: float = 0.0
    hysteresis_reach: float = 0.03
    entropy_shift_v_k: FloatArray | None = None
    weak: WeakCells | None = None
    insulation: float = 0.0

    current_offset_a: float = 0.0
    current_gain: float = 0.0
    current_skew_s: float = 0.0
    voltage_offset_v: float = 0.0
    voltage_gain: float = 0.0
    temperature_lag_s: float = 0.0

    string_loss: Switching | None = None
    hidden_load: Switching | None = None
    flicker: Switching | None = None
    bursts: Switching | None = None
    stale: Switching | None = None
    ripple_v: float = 0.0
    ripple_period_v: float = 1.0
    ripple_phase: float = 0.0
    clip_share: float = 1.0
    remanence_a: float = 0.0
    temperature_hold: float = 0.0


HEALTHY: Final = Condition()


def is_on(switching: Switching, time_s: FloatArray) -> NDArray[np.bool_]:
    """Return when something that switches at random is on, shape (n,); it starts off."""
    rng = np.random.default_rng(switching.seed)
    span = float(time_s[-1] - time_s[0])
    pairs = max(4, int(2.0 * span / (switching.on_s + switching.off_s)) + 4)
    # Drawn in pairs, so that longer stretches are the same ones, stretched.
    lengths = rng.exponential(1.0, (pairs, 2)) * (switching.off_s, switching.on_s)
    edges = time_s[0] + np.cumsum(lengths.ravel())
    passed = np.searchsorted(edges, time_s, side="right")
    return np.asarray(passed % 2 == 1, dtype=np.bool_)

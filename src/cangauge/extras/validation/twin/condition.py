"""State of a pack and its sensors: every quantity that a fault can change."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray


@dataclass(frozen=True)
class Relaxation:
    """One first-order relaxation of the whole pack, added to the healthy ones."""

    ohm: float
    tau_s: float


@dataclass(frozen=True)
class SocResistance:
    """Rise of the ohmic resistance towards one end of the charge, a logistic curve.

    Parameters
    ----------
    height : float
        Rise relative to the healthy ohmic resistance [-].
    centre : float
        State of charge at half the rise [-].
    width : float
        Width of the rise [-]; negative for a rise towards full.
    """

    height: float
    centre: float
    width: float


@dataclass(frozen=True)
class WeakCells:
    """Cells with less capacity than the others.

    Parameters
    ----------
    count : int
    loss : float
        Missing fraction of the capacity [-].
    deficit : float
        Initial SoC below that of the other cells [-].
    """

    count: int
    loss: float
    deficit: float


@dataclass(frozen=True)
class Intermittent:
    """A disturbance of some size that is active and inactive for random times.

    Parameters
    ----------
    size : float
    on_s, off_s : float
        Mean duration of the active and the inactive phases [s].
    seed : int
    """

    size: float
    on_s: float
    off_s: float
    seed: int

    def is_active(self, time_s: FloatArray) -> NDArray[np.bool_]:
        """Return where the disturbance is active, shape (n,); it starts inactive."""
        rng = np.random.default_rng(self.seed)
        span = float(time_s[-1] - time_s[0])
        pairs = max(4, int(2.0 * span / (self.on_s + self.off_s)) + 4)
        # Drawn in pairs, so that another duration stretches the same sequence.
        lengths = rng.exponential(1.0, (pairs, 2)) * (self.off_s, self.on_s)
        edges = time_s[0] + np.cumsum(lengths.ravel())
        passed = np.searchsorted(edges, time_s, side="right")
        return np.asarray(passed % 2 == 1, dtype=np.bool_)


@dataclass(frozen=True, eq=False)
class Condition:
    """Condition of a pack and its sensors; the defaults are healthy.

    Parameters
    ----------
    capacity_factor : float
        True over assumed capacity [-].
    charge_loss : float
        Fraction of the charge put in that cannot be taken out again [-].
    start_soc_shift : float
        True minus assumed initial SoC [-].
    cold_resistance_k : float
        Additional temperature coefficient of the resistance, exp(x/(T − 230 K)) [K].
    soc_resistance : SocResistance, optional
    charging_ohm : float
        Additional pack resistance during charge [Ω].
    step_ohm, step_at_s : float
        Additional pack resistance from a moment on [Ω, s].
    transfer_slowdown : float
        Factor by which the exchange current falls, minus 1 [-].
    relaxations : tuple of Relaxation
    hysteresis_v, hysteresis_reach : float
        Half width of the pack's hysteresis [V], and the charge swing that reverses it fully [-].
    entropy_shift_v_k : array, optional
        Change of dU/dT of one cell [V/K], on the SoC grid of the chemistry.
    weak : WeakCells, optional
    insulation : float
        Additional thermal resistance between core and surface, relative to the healthy one [-].
    current_offset_a, current_gain, current_skew_s : float
        Measured = (1 + gain)·true(t − skew) + offset [A, -, s].
    voltage_offset_v, voltage_gain : float
        Measured = (1 + gain)·true + offset [V, -].
    temperature_lag_s : float
        Additional lag of the temperature sensor [s].
    string_loss : Intermittent, optional
        A parallel string drops out; size: rise of all overpotentials [-].
    hidden_load : Intermittent, optional
        A load that the current sensor does not measure [A].
    flicker : Intermittent, optional
        Contact resistance [Ω].
    bursts : Intermittent, optional
        Noise on the voltage [V].
    stale : Intermittent, optional
        The voltage repeats its last value while active.
    ripple_v, ripple_period_v, ripple_phase : float
        Integral nonlinearity of the voltage sensor [V, V, rad].
    clip_share : float
        Saturation of the current sensor, relative to the largest current [-].
    remanence_a : float
        Magnetic remanence of the current sensor [A].
    temperature_offset_k : float
        Error of the temperature sensor [K].
    temperature_hold : float
        0: the temperature sensor follows, 1: it is stuck [-].

    Notes
    -----
    From `string_loss` on, the effects library has no counterpart.
    """

    capacity_factor: float = 1.0
    charge_loss: float = 0.0
    start_soc_shift: float = 0.0
    cold_resistance_k: float = 0.0
    soc_resistance: SocResistance | None = None
    charging_ohm: float = 0.0
    step_ohm: float = 0.0
    step_at_s: float = 0.0
    transfer_slowdown: float = 0.0
    relaxations: tuple[Relaxation, ...] = ()
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

    string_loss: Intermittent | None = None
    hidden_load: Intermittent | None = None
    flicker: Intermittent | None = None
    bursts: Intermittent | None = None
    stale: Intermittent | None = None
    ripple_v: float = 0.0
    ripple_period_v: float = 1.0
    ripple_phase: float = 0.0
    clip_share: float = 1.0
    remanence_a: float = 0.0
    temperature_offset_k: float = 0.0
    temperature_hold: float = 0.0

    def current_through_cells(self, time_s: FloatArray, current_a: FloatArray) -> FloatArray:
        """Return the current of a drive with that of a hidden load [A], shape (n,)."""
        if self.hidden_load is None:
            return current_a
        return current_a + self.hidden_load.size * self.hidden_load.is_active(time_s)


HEALTHY: Final = Condition()

"""First-order relaxations x' = (u − x)/τ of a signal that runs straight between its samples.

Temperatures of a pack: a core that makes the heat and a surface that loses it.

What the faults of a pack do to charge and voltage, whatever plant is underneath.

The electrical side of a pack: charge, kinetics, diffusion → terminal voltage and heat.

What stands for the pack: the twin's own cells, or another simulator behind the same door.

A pack that obeys the published equation while it is healthy, with other numbers.

What remains of a clean day is then the sensors' doing and the core's few kelvin above the sensor.
Its faults are the twin's, in the twin's own forms; so a diagnosis is asked for the cause alone, and
not for the difference between two kinds of models. Where the gauge knows the core too (`published`)
little but noise is left.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Protocol

import numpy as np
from scipy.signal import lfilter

from cangauge._typing import FloatArray
from cangauge.validation.twin.condition import Condition, is_on
from cangauge.validation.twin.day import Day
from cangauge.validation.twin.pack import KELVIN, Chemistry, Pack

# --- First-order relaxations x' = (u − x)/τ of a signal that runs straight between its samples


def relax(signal: FloatArray, step_s: float, tau_s: FloatArray) -> FloatArray:
    """Return the relaxed signal for several time constants that may change as time passes.

    The update is exact for a straight signal and a constant τ within a step, and the state
    starts at rest (0).

    Parameters
    ----------
    signal : array of shape (n,)
    step_s : float
        Time between samples [s].
    tau_s : array of shape (n, k)
        Time constants [s], above 0.

    Returns
    -------
    array of shape (n, k)
    """
    ratio = step_s / tau_s
    keep = np.exp(-ratio)
    # Integral of the straight piece against the decaying exponential, split by its two ends.
    mean = -np.expm1(-ratio) / ratio
    push = (1.0 - mean) * signal[:, None]
    push[1:] += (mean[1:] - keep[1:]) * signal[:-1, None]
    result = np.empty_like(keep)
    state = np.zeros(keep.shape[1])
    for row in range(keep.shape[0]):
        state *= keep[row]
        state += push[row]
        result[row] = state
    return result


def lagged(signal: FloatArray, step_s: float, tau_s: float) -> FloatArray:
    """Return a signal after one constant lag, settled at its first value, shape (n,)."""
    if tau_s <= 0.0:
        return signal
    keep = float(np.exp(-step_s / tau_s))
    result, _ = lfilter(
        [1.0 - keep], [1.0, -keep], signal, zi=np.array([keep * signal[0]], dtype=np.float64)
    )
    return np.asarray(result, dtype=np.float64)


# --- Temperatures of a pack: a core that makes the heat and a surface that loses it

_STEP_S: Final = 5.0


def temperatures(
    pack: Pack, day: Day, heat_w: FloatArray, insulation: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Return core and surface [°C], shape (n,) each.

    Two nodes, integrated by steps of 5 s (their shortest time constant is minutes):
    C_c·T_c' = heat − G·(T_c − T_s);  C_s·T_s' = G·(T_c − T_s) − H·(T_s − ambient) + conditioning.

    Parameters
    ----------
    pack : Pack
    day : Day
        Ambient temperature, conditioning and the temperature at the start.
    heat_w : array of shape (n,)
        Heat of the cells [W].
    insulation : float
        Extra thermal resistance between core and surface, over the clean one [-].
    """
    time_s = day.time_s
    every = max(1, round(_STEP_S / day.step_s))
    coarse = time_s[::every]
    step = every * day.step_s
    starts = np.arange(0, time_s.size, every)
    counts = np.diff(np.append(starts, time_s.size))
    heat = (np.add.reduceat(heat_w, starts) / counts).tolist()
    ambient = np.interp(coarse, time_s, day.ambient_c).tolist()
    between = pack.core_surface_w_k / (1.0 + insulation)
    core = surface = day.start_c
    cores, surfaces = [core], [surface]
    # Conditioning works until its target is met, from the side that it started on.
    sign = 1.0 if day.target_c >= day.start_c else -1.0
    for joule_w, outside in zip(heat[:-1], ambient[:-1], strict=True):
        flow = between * (core - surface)
        wanted = sign * (day.target_c - surface)
        conditioning = sign * day.conditioning_w * min(1.0, max(0.0, wanted / 2.0))
        loss = pack.surface_ambient_w_k * (surface - outside)
        core += step * (joule_w - flow) / pack.core_j_k
        surface += step * (flow - loss + conditioning) / pack.surface_j_k
        cores.append(core)
        surfaces.append(surface)
    return np.interp(time_s, coarse, cores), np.interp(time_s, coarse, surfaces)


# --- What the faults of a pack do to charge and voltage, whatever plant is underneath

REFERENCE_K: Final = 298.15
_GLASS_K: Final = 230.0
_PLAYS: Final = (0.06, 0.15, 0.35, 0.65, 1.0)  # reach of the hysteresis operators
_BEND_A: Final = 3.0


def stiffness(condition: Condition, kelvin: FloatArray) -> FloatArray:
    """Return resistance over what it was before the law of temperature changed [-]."""
    exponent = 1.0 / (kelvin - _GLASS_K) - 1.0 / (REFERENCE_K - _GLASS_K)
    return np.exp(condition.cold_stiffness_k * exponent)


def discharged(day: Day, current_a: FloatArray, loss: float = 0.0) -> FloatArray:
    """Return the charge taken from the cells since the start [Ah], shape (n,)."""
    counted = np.where(current_a < 0.0, (1.0 - loss) * current_a, current_a)
    steps = 0.5 * (counted[1:] + counted[:-1]) * day.step_s / 3600.0
    return np.concatenate(([0.0], np.cumsum(steps)))


def hump_rise(condition: Condition, soc: FloatArray) -> FloatArray | float:
    """Return the rise of the ohmic resistance with the state of charge [-], shape of soc."""
    hump = condition.hump
    if hump is None:
        return 0.0
    return hump.height / (1.0 + np.exp((soc - hump.centre) / hump.width))


def extra_drop(
    day: Day, condition: Condition, current_a: FloatArray, kelvin: FloatArray
) -> FloatArray:
    """Return what the pack's own faults take from its voltage [V], shape (n,)."""
    drop = np.zeros_like(current_a)
    if condition.charging_ohm:
        # A bad contact that rectifies: the bend is rounded over some amperes.
        charging = 0.5 * (1.0 - current_a / np.hypot(current_a, _BEND_A))
        drop += condition.charging_ohm * current_a * charging
    if condition.step_ohm:
        drop += condition.step_ohm * current_a * (day.time_s >= condition.step_at_s)
    if condition.flicker is not None:
        drop += condition.flicker.size * current_a * is_on(condition.flicker, day.time_s)
    if condition.modes:
        taus = np.array([mode.tau_s for mode in condition.modes])
        slower = np.exp(1500.0 * (1.0 / kelvin - 1.0 / REFERENCE_K))
        states = relax(current_a, day.step_s, slower[:, None] * taus[None, :])
        drop += states @ np.array([mode.ohm for mode in condition.modes])
    return drop


def hysteresis_drop(day: Day, condition: Condition, charge: FloatArray) -> FloatArray:
    """Return what hysteresis takes from the voltage [V]: five stop operators on the charge.

    (Prandtl–Ishlinskii; each follows the charge until it has swung by its own reach.)
    """
    reach = condition.hysteresis_reach * np.array(_PLAYS)
    state = day.history * reach
    total = np.empty_like(charge)
    total[0] = float(np.mean(state / reach))
    low, high = -reach, reach
    share = 1.0 / (reach * reach.size)
    for row, moved in enumerate(np.diff(charge).tolist(), start=1):
        state += moved
        np.minimum(state, high, out=state)
        np.maximum(state, low, out=state)
        total[row] = share @ state
    return condition.hysteresis_v * total


# --- The electrical side of a pack: charge, kinetics, diffusion → terminal voltage and heat

_VOGEL_ZERO_K: Final = 170.0
VOLT_A_KELVIN: Final = 8.617333e-5  # gas constant over Faraday constant


@dataclass(frozen=True, eq=False)
class Electrical:
    """Voltage of a pack under a current at given temperatures, shape (n,) each."""

    voltage_v: FloatArray
    soc: FloatArray
    """Mean of the cells [-], of their true capacity."""
    equilibrium_v: FloatArray
    """Open-circuit voltage of the mean state of each cell, summed [V]."""
    heat_w: FloatArray
    """Irreversible and reversible heat [W]."""
    lowest_v: FloatArray
    """Voltage of the lowest cell [V]; a car stops before it is ruined."""


def ohmic_factor(pack: Pack, kelvin: FloatArray) -> FloatArray:
    """Return ohmic resistance over that at 25 °C [-] (Vogel–Fulcher–Tammann)."""
    exponent = 1.0 / (kelvin - _VOGEL_ZERO_K) - 1.0 / (REFERENCE_K - _VOGEL_ZERO_K)
    return np.exp(pack.ohmic_vogel_k * exponent)


def overpotential_table(anodic: float) -> tuple[FloatArray, FloatArray]:
    """Return i/i0 and Fη/RT of asymmetric Butler–Volmer kinetics, tabulated to be inverted."""
    eta = np.sinh(np.linspace(-6.0, 6.0, 1201)) / np.sinh(6.0) * 30.0
    return np.exp(anodic * eta) - np.exp(-(1.0 - anodic) * eta), eta


def _groups(
    pack: Pack, condition: Condition
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return number of cells, capacity factor, resistance factor, start shift, shape (g,) each."""
    weights, capacity = pack.weights, pack.capacity_factor * condition.capacity_factor
    resistance, shift = pack.resistance_factor, pack.soc_shift
    weak = condition.weak
    if weak is not None:
        weights = weights.copy()
        weights[weights.size // 2] -= weak.count
        weights = np.append(weights, weak.count)
        capacity = np.append(capacity, condition.capacity_factor * (1.0 - weak.loss))
        resistance = np.append(resistance, 1.0 + 0.5 * weak.loss)
        shift = np.append(shift, -weak.deficit)
    return weights, capacity, resistance, shift


def electrical(
    pack: Pack, day: Day, condition: Condition, current_a: FloatArray, core_c: FloatArray
) -> Electrical:
    """Return what a current does to a pack.

    Parameters
    ----------
    pack : Pack
    day : Day
    condition : Condition
        What is wrong with the pack.
    current_a : array of shape (n,)
        Current through the cells [A], positive discharges.
    core_c : array of shape (n,)
        Temperature of the cells [°C].
    """
    kelvin = core_c + KELVIN
    weights, capacity, resistance, shift = _groups(pack, condition)
    charge = discharged(day, current_a, condition.charge_loss) / pack.capacity_ah
    start = day.start_soc + condition.start_soc_shift
    soc = (start + shift)[:, None] - charge / capacity[:, None]

    slow, quick, swing = _relaxed(pack, day, current_a, kelvin)
    surface = soc - swing / capacity[:, None]
    chemistry = pack.chemistry
    entropy = chemistry.entropy(soc)
    if condition.entropy_shift_v_k is not None:
        entropy = entropy + np.interp(soc, chemistry.grid, condition.entropy_shift_v_k)
    warmth = entropy * (kelvin - REFERENCE_K)
    equilibrium = chemistry.ocv(soc) + warmth

    loss = _kinetics(pack, condition, soc, quick, kelvin)
    stiff = stiffness(condition, kelvin)
    ohmic = pack.ohmic_ohm * ohmic_factor(pack, kelvin) * stiff * current_a
    loss += ohmic * (1.0 + hump_rise(condition, soc))
    loss += slow
    loss *= resistance[:, None]
    loss += equilibrium - warmth - chemistry.ocv(surface)

    drop = weights @ loss + pack.busbar_ohm * current_a
    if condition.string_loss is not None:
        drop = drop * (1.0 + condition.string_loss.size * is_on(condition.string_loss, day.time_s))
    drop = drop + extra_drop(day, condition, current_a, kelvin)
    hysteresis = hysteresis_drop(day, condition, charge) if condition.hysteresis_v else 0.0
    open_v = weights @ equilibrium
    reversible = -current_a * kelvin * (weights @ entropy)
    return Electrical(
        voltage_v=open_v - drop - hysteresis,
        soc=weights @ soc / weights.sum(),
        equilibrium_v=open_v,
        heat_w=current_a * drop + reversible,
        lowest_v=np.min(equilibrium - loss, axis=0),
    )


def _relaxed(
    pack: Pack, day: Day, current_a: FloatArray, kelvin: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return drop in the electrolyte [V], current of the reaction [A], swing of the surface [-]."""
    sluggish = np.exp(pack.diffusion_activation_k * (1.0 / kelvin - 1.0 / REFERENCE_K))
    tau = np.array([*pack.electrolyte_tau_s, *pack.solid_tau_s])
    taus = np.column_stack(
        [np.full_like(kelvin, pack.double_layer_s), sluggish[:, None] * tau[None, :]]
    )
    states = relax(current_a, day.step_s, taus)
    after = 1 + len(pack.electrolyte_tau_s)
    electrolyte = states[:, 1:after] @ np.array(pack.electrolyte_ohm) * ohmic_factor(pack, kelvin)
    swing = states[:, after:] @ np.array(pack.solid_swing) * sluggish
    return electrolyte, states[:, 0], swing


def _kinetics(
    pack: Pack, condition: Condition, soc: FloatArray, current_a: FloatArray, kelvin: FloatArray
) -> FloatArray:
    """Return the overpotential of the reaction, shape (g, n)."""
    activation = pack.exchange_activation_k * (1.0 / REFERENCE_K - 1.0 / kelvin)
    fill = np.clip(soc, 0.02, 0.98)
    exchange = pack.exchange_a * 2.0 * np.sqrt(fill * (1.0 - fill)) * np.exp(activation)
    exchange /= (1.0 + condition.transfer_slowdown) * stiffness(condition, kelvin)
    ratio, eta = overpotential_table(pack.anodic)
    return np.interp(current_a / exchange, ratio, eta) * (VOLT_A_KELVIN * kelvin)


# --- What stands for the pack: the twin's own cells, or another simulator behind the same door


class Plant(Protocol):
    """A pack that answers a current with a voltage."""

    @property
    def name(self) -> str:
        """What simulates it, for the truth file."""

    @property
    def pack(self) -> Pack:
        """Its size, thermal masses, sensors and open-circuit voltage."""

    @property
    def settled_k(self) -> float:
        """Change of the core's temperature below which another pass is not worth it [K]."""

    def electrical(
        self, day: Day, condition: Condition, current_a: FloatArray, core_c: FloatArray
    ) -> Electrical:
        """Return voltage, charge and heat, shape (n,) each (parameters as in `cells`)."""


class TwinPlant:
    """The twin's own cells.

    Parameters
    ----------
    pack : Pack
    """

    name = "twin"
    settled_k = 0.05

    def __init__(self, pack: Pack) -> None:
        self.pack = pack

    def electrical(
        self, day: Day, condition: Condition, current_a: FloatArray, core_c: FloatArray
    ) -> Electrical:
        """Return voltage, charge and heat, shape (n,) each."""
        return electrical(self.pack, day, condition, current_a, core_c)


# --- A pack that obeys the published equation while it is healthy, with other numbers

EDGE: Final = 0.05
"""Distance of an empty and of a full pack from the poles of the equation [-]."""
DELAYS_S: Final = (0.0, 10.0, 30.0, 70.0)
SHARES: Final = (0.60, 0.20, 0.12, 0.08)
FINE_PART, FINE_STEP_K, FINE_LAG_S = 0.5, 0.05, 0.1
"""Of a temperature sensor that leaves no volts in the equation, whatever its coefficient."""
_REFERENCE_C: Final = 20.0


class EquationPlant:
    """Pseudo open-circuit voltage, a temperature coefficient and four delayed resistances.

    Parameters
    ----------
    pack : Pack
        Its open-circuit voltage is that of the equation.
    temperature_v_k : float
        Temperature coefficient of the pack [V/K].
    resistance_ohm : array of shape (4,)
        Of the pack, on the current now, 10, 30 and 70 s ago [Ω].
    """

    settled_k = 0.05

    def __init__(self, pack: Pack, temperature_v_k: float, resistance_ohm: FloatArray) -> None:
        self.pack = pack
        self.name = "published" if pack.knows_core else "equation"
        self._temperature_v_k = temperature_v_k
        self._resistance_ohm = resistance_ohm

    def electrical(
        self, day: Day, condition: Condition, current_a: FloatArray, core_c: FloatArray
    ) -> Electrical:
        """Return voltage, charge and heat, shape (n,) each."""
        pack, kelvin = self.pack, core_c + KELVIN
        charge = discharged(day, current_a, condition.charge_loss) / pack.capacity_ah
        start = day.start_soc + condition.start_soc_shift
        soc = start - charge / condition.capacity_factor
        open_v = pack.cells * pack.chemistry.ocv(soc)
        open_v = open_v + self._temperature_v_k * (core_c - _REFERENCE_C)
        lowest_v = open_v / pack.cells
        weak = condition.weak
        if weak is not None:
            factor = condition.capacity_factor * (1.0 - weak.loss)
            of_weak = pack.chemistry.ocv(start - weak.deficit - charge / factor)
            lack = of_weak - pack.chemistry.ocv(soc)
            open_v, lowest_v = open_v + weak.count * lack, lowest_v + np.minimum(lack, 0.0)
        if condition.entropy_shift_v_k is not None:
            shift = np.interp(soc, pack.chemistry.grid, condition.entropy_shift_v_k)
            open_v = open_v + pack.cells * shift * (kelvin - REFERENCE_K)
        drop = self._delayed_drop(day, current_a)
        drop = drop * stiffness(condition, kelvin) * (1.0 + hump_rise(condition, soc))
        drop = drop + self._slower_transfer(condition, current_a, kelvin)
        if condition.string_loss is not None:
            on = is_on(condition.string_loss, day.time_s)
            drop = drop * (1.0 + condition.string_loss.size * on)
        drop = drop + extra_drop(day, condition, current_a, kelvin)
        hysteresis = hysteresis_drop(day, condition, charge) if condition.hysteresis_v else 0.0
        return Electrical(
            voltage_v=open_v - drop - hysteresis,
            soc=soc,
            equilibrium_v=open_v,
            heat_w=current_a * drop,
            lowest_v=lowest_v - drop / pack.cells,
        )

    def _delayed_drop(self, day: Day, current_a: FloatArray) -> FloatArray:
        delayed = [np.interp(day.time_s - delay, day.time_s, current_a) for delay in DELAYS_S]
        return np.asarray(self._resistance_ohm @ np.array(delayed))

    def _slower_transfer(
        self, condition: Condition, current_a: FloatArray, kelvin: FloatArray
    ) -> FloatArray | float:
        if not condition.transfer_slowdown:
            return 0.0
        ratio, eta = overpotential_table(self.pack.anodic)
        before = np.interp(current_a / self.pack.exchange_a, ratio, eta)
        slower = 1.0 + condition.transfer_slowdown
        after = np.interp(current_a * slower / self.pack.exchange_a, ratio, eta)
        return np.asarray(self.pack.cells * VOLT_A_KELVIN * kelvin * (after - before))


def draw_equation_plant(
    rng: np.random.Generator, pack: Pack, *, knows_core: bool = False
) -> EquationPlant:
    """Return a pack of the published form at random.

    Parameters
    ----------
    rng : Generator
    pack : Pack
        Size, thermal masses, kinetics and sensors.
    knows_core : bool
        Let the temperature that is reported be the core's, which the equation goes by, and the
        temperature coefficient up to what was published, not only what entropy has. In half of
        the packs it is reported finely and at once too: there clean days differ by noise alone.
    """
    drawn = pack.chemistry
    inner = np.clip(EDGE + (1.0 - 2.0 * EDGE) * drawn.grid, 0.5 * EDGE, 1.0 - 0.5 * EDGE)
    bend = rng.uniform(0.75, 1.25, 4)
    volts = (
        3.52
        + 0.45 * bend[0] * inner
        - 0.012 * bend[1] / inner
        + 0.03 * bend[2] * np.log(inner)
        - 0.024 * bend[3] * np.log(1.0 - inner)
    )
    # Beyond both ends of the equation a straight line.
    slope = np.gradient(volts, drawn.grid)
    beyond = np.clip(drawn.grid, 0.0, 1.0)
    ends = np.interp(beyond, drawn.grid, volts)
    volts = ends + np.interp(beyond, drawn.grid, slope) * (drawn.grid - beyond)
    table = Chemistry("equation", drawn.grid, volts, np.zeros_like(drawn.grid))
    shares = np.array(SHARES) * rng.uniform(0.7, 1.3, len(SHARES))
    resistance = pack.resistance_ohm * shares / shares.sum()
    # As entropy has it. The published −7.7 mV/K a cell is what a fit to one log made of it; it
    # turns the few kelvin between core and sensor into volts that the equation lacks.
    low, high = (1e-3, 8e-3) if knows_core else (1e-4, 1e-3)
    temperature = -pack.cells * float(np.exp(rng.uniform(np.log(low), np.log(high))))
    own = replace(pack, chemistry=table, knows_core=knows_core)
    if knows_core and rng.random() < FINE_PART:
        fine = replace(pack.sensors, temperature_step_k=FINE_STEP_K, temperature_lag_s=FINE_LAG_S)
        own = replace(own, sensors=fine)
    return EquationPlant(own, temperature, resistance)

"""The pack as a plant: voltage, state of charge, heat and temperatures for a current.

The cells have a tabulated open-circuit voltage, asymmetric Butler–Volmer kinetics, diffusion and
spread. Faults act by their ids (`faults.toml`): those of the pack here, those of its sensors in
`recording`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.signal import lfilter

from cangauge._typing import FloatArray
from cangauge.extras.validation.twin.drive import Drive
from cangauge.extras.validation.twin.faults import HEALTHY, Fault, Faults
from cangauge.extras.validation.twin.pack import KELVIN, TwinPack

REFERENCE_K: Final = 298.15
_GLASS_K: Final = 230.0
"""Temperature at which the fault `resistance_temperature` diverges [K]."""
_VOGEL_ZERO_K: Final = 170.0
_GAS_OVER_FARADAY_V_K: Final = 8.617333e-5
_BEND_A: Final = 3.0
"""Current within which a rectifying contact turns over [A]."""
_HYSTERESIS_REACHES: Final = np.array([0.06, 0.15, 0.35, 0.65, 1.0])
"""Reaches of the stop operators, relative to the fault's."""
_COLE_SPREAD: Final = np.array([-1.6, -1.0, -0.5, 0.0, 0.5, 1.0, 1.6])
"""Relaxations of a Cole–Cole element, in e-folds of its time constant."""
_WARBURG_POLES: Final = np.arange(1.0, 12.0, 2.0) ** 2
"""First six poles of a finite Warburg element, relative to the slowest."""
_ADDED_ACTIVATION_K: Final = 1500.0
"""Activation energy of added relaxations over the gas constant [K]."""
_EMPTY_V: Final = {"lfp": 1.8}
"""Voltage of the lowest cell at which the car stops [V], by chemistry."""
_OTHERS_EMPTY_V: Final = 2.2
_THERMAL_STEP_S: Final = 5.0
TOLERANCE_K: Final = 0.05
"""Change of the core temperature at which the thermal iteration stops."""
_MAX_ITERATIONS: Final = 5


@dataclass(frozen=True, eq=False)
class Response:
    """Response of a pack to a current, shape (n,) each.

    Parameters
    ----------
    voltage_v : array
        Terminal voltage [V].
    soc : array
        Mean SoC of the cells, relative to their true capacity [-].
    equilibrium_v : array
        Open-circuit voltage at the mean SoC of each cell, summed over the cells [V].
    heat_w : array
        Irreversible and reversible heat [W].
    rows : int
        Rows until the lowest cell is empty and the car stops.
    """

    voltage_v: FloatArray
    soc: FloatArray
    equilibrium_v: FloatArray
    heat_w: FloatArray
    rows: int


@dataclass(frozen=True, eq=False)
class Truth(Response):
    """Response to a drive, with the current through the cells [A] and the temperatures [°C]."""

    current_a: FloatArray
    core_c: FloatArray
    surface_c: FloatArray


def simulate_truth(
    pack: TwinPack, drive: Drive, faults: Faults = HEALTHY, near: Truth | None = None
) -> Truth:
    """Simulate a drive of a pack with faults.

    Temperature and voltage are coupled by the heat: a fixed-point iteration runs until the core
    temperature changes by less than the tolerance.

    Parameters
    ----------
    pack : TwinPack
    drive : Drive
    faults : Faults
    near : Truth, optional
        The same drive with other faults, as the start of the iteration. Within the tolerance its
        temperatures are kept, so that the voltages differ by the faults alone.
    """
    current_a, insulation = through_cells(drive, faults), faults.size("core_temperature")
    if near is None:
        kelvin = np.full_like(current_a, drive.start_c + KELVIN)
        heat_w = pack.resistance_ohm * 1.3 * ohmic_factor(pack, kelvin) * current_a**2
        core_c, surface_c = temperatures(pack, drive, heat_w, insulation)
    else:
        core_c, surface_c = near.core_c, near.surface_c
    response = respond(pack, drive, faults, current_a, core_c)
    for _ in range(_MAX_ITERATIONS):
        following = temperatures(pack, drive, response.heat_w, insulation)
        if np.max(np.abs(following[0] - core_c)) < TOLERANCE_K:
            break
        core_c, surface_c = following
        response = respond(pack, drive, faults, current_a, core_c)
    return Truth(**vars(response), current_a=current_a, core_c=core_c, surface_c=surface_c)


def through_cells(drive: Drive, faults: Faults) -> FloatArray:
    """Return the current of a drive with that of a hidden load [A], shape (n,)."""
    if (load := faults.get("parasitic_switching")) is None:
        return drive.current_a
    return drive.current_a + load.size * load.is_active(drive.time_s)


def respond(
    pack: TwinPack, drive: Drive, faults: Faults, current_a: FloatArray, core_c: FloatArray
) -> Response:
    """Return the response to a current.

    Parameters
    ----------
    pack : TwinPack
    drive : Drive
        Time grid, initial SoC and history.
    faults : Faults
    current_a : array of shape (n,)
        Current through the cells [A], positive = discharge.
    core_c : array of shape (n,)
        Temperature of the cells [°C].
    """
    kelvin, cells = core_c + KELVIN, pack.chemistry
    weights, capacity, resistance, shift = _groups(pack, faults)
    charge = discharged(drive, faults, current_a) / pack.capacity_ah
    soc = (start_soc(drive, faults) + shift)[:, None] - charge / capacity[:, None]

    slow, quick, swing = _relaxed(pack, drive, current_a, kelvin)
    entropy = cells.entropy(soc) + _entropy_change(pack, faults, soc)
    warmth = entropy * (kelvin - REFERENCE_K)
    equilibrium = cells.ocv(soc) + warmth

    stiffening = 1.0 / (kelvin - _GLASS_K) - 1.0 / (REFERENCE_K - _GLASS_K)
    stiff = np.exp(faults.size("resistance_temperature") * stiffening)
    loss = _kinetics(pack, soc, quick, kelvin, stiff * (1.0 + faults.size("charge_transfer")))
    ohmic = pack.ohmic_ohm * ohmic_factor(pack, kelvin) * stiff * current_a
    loss += ohmic * (1.0 + _soc_rise(faults, soc))
    loss += slow
    loss *= resistance[:, None]
    loss += equilibrium - warmth - cells.ocv(soc - swing / capacity[:, None])

    drop = weights @ loss + pack.busbar_ohm * current_a
    if (dropout := faults.get("string_dropout")) is not None:
        drop = drop * (1.0 + dropout.size * dropout.is_active(drive.time_s))
    drop = drop + _added_drop(drive, faults, current_a, kelvin)
    open_v = weights @ equilibrium
    lowest_v = np.min(equilibrium - loss, axis=0)
    empty = np.flatnonzero(lowest_v < _EMPTY_V.get(cells.name, _OTHERS_EMPTY_V))
    return Response(
        voltage_v=open_v - drop - _hysteresis(drive, faults, charge),
        soc=weights @ soc / weights.sum(),
        equilibrium_v=open_v,
        heat_w=current_a * drop - current_a * kelvin * (weights @ entropy),
        rows=int(empty[0]) if empty.size else current_a.size,
    )


def start_soc(drive: Drive, faults: Faults) -> float:
    """Return the true initial SoC [-]."""
    return drive.start_soc + faults.size("initial_soc") / 100.0


def discharged(drive: Drive, faults: Faults, current_a: FloatArray) -> FloatArray:
    """Return the charge taken from the cells since the start [Ah], shape (n,)."""
    loss = faults.size("coulombic_efficiency")
    counted = np.where(current_a < 0.0, (1.0 - loss) * current_a, current_a)
    steps = 0.5 * (counted[1:] + counted[:-1]) * drive.step_s / 3600.0
    return np.concatenate(([0.0], np.cumsum(steps)))


def relax(signal: FloatArray, step_s: float, tau_s: FloatArray) -> FloatArray:
    """Solve x' = (u − x)/τ for k time constants that may change with time.

    Exact for an input that is linear and a τ that is constant within a step; starts at x = 0.

    Parameters
    ----------
    signal : array of shape (n,)
    step_s : float
        Time step [s].
    tau_s : array of shape (n, k)
        Time constants [s], above 0.

    Returns
    -------
    array of shape (n, k)
    """
    ratio = step_s / tau_s
    keep = np.exp(-ratio)
    # Integral of the linear input against the decaying exponential, split by its two ends.
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
    """Return a signal after a first-order lag that starts at the signal's first value, (n,)."""
    if tau_s <= 0.0:
        return signal
    keep = float(np.exp(-step_s / tau_s))
    result, _ = lfilter(
        [1.0 - keep], [1.0, -keep], signal, zi=np.array([keep * signal[0]], dtype=np.float64)
    )
    return np.asarray(result, dtype=np.float64)


def temperatures(
    pack: TwinPack, drive: Drive, heat_w: FloatArray, insulation: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Return core and surface temperature [°C], shape (n,) each.

    Two nodes, integrated in steps of 5 s (their shortest time constant is minutes):
    C_c·T_c' = heat − G·(T_c − T_s);  C_s·T_s' = G·(T_c − T_s) − H·(T_s − ambient) + conditioning.

    Parameters
    ----------
    pack : TwinPack
    drive : Drive
        Initial and ambient temperature, conditioning.
    heat_w : array of shape (n,)
        Heat of the cells [W].
    insulation : float
        Additional thermal resistance between core and surface, relative to the healthy one [-].
    """
    time_s = drive.time_s
    every = max(1, round(_THERMAL_STEP_S / drive.step_s))
    coarse = time_s[::every]
    step = every * drive.step_s
    starts = np.arange(0, time_s.size, every)
    counts = np.diff(np.append(starts, time_s.size))
    heat = (np.add.reduceat(heat_w, starts) / counts).tolist()
    ambient = np.interp(coarse, time_s, drive.ambient_c).tolist()
    between = pack.core_surface_w_k / (1.0 + insulation)
    core = surface = drive.start_c
    nodes = [(core, surface)]
    # Conditioning heats or cools until the surface reaches its target.
    sign = 1.0 if drive.target_c >= drive.start_c else -1.0
    for joule_w, outside in zip(heat[:-1], ambient[:-1], strict=True):
        flow = between * (core - surface)
        wanted = sign * (drive.target_c - surface)
        conditioning = sign * drive.conditioning_w * min(1.0, max(0.0, wanted / 2.0))
        loss = pack.surface_ambient_w_k * (surface - outside)
        core += step * (joule_w - flow) / pack.core_j_k
        surface += step * (flow - loss + conditioning) / pack.surface_j_k
        nodes.append((core, surface))
    cores, surfaces = np.array(nodes).T
    return np.interp(time_s, coarse, cores), np.interp(time_s, coarse, surfaces)


def ohmic_factor(pack: TwinPack, kelvin: FloatArray) -> FloatArray:
    """Return the ohmic resistance relative to 25 °C [-] (Vogel–Fulcher–Tammann)."""
    exponent = 1.0 / (kelvin - _VOGEL_ZERO_K) - 1.0 / (REFERENCE_K - _VOGEL_ZERO_K)
    return np.exp(pack.ohmic_vogel_k * exponent)


def _groups(
    pack: TwinPack, faults: Faults
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return number of cells, capacity factor, resistance factor, start shift, shape (g,) each."""
    left = 1.0 - faults.size("capacity")
    weights, capacity = pack.weights, pack.capacity_factor * left
    resistance, shift = pack.resistance_factor, pack.soc_shift
    if (weak := faults.get("weak_cell")) is not None:
        shape = weak.full_shape()
        weights = weights.copy()
        weights[weights.size // 2] -= shape["count"]
        weights = np.append(weights, shape["count"])
        capacity = np.append(capacity, left * (1.0 - weak.size))
        resistance = np.append(resistance, 1.0 + 0.5 * weak.size)
        shift = np.append(shift, -shape["deficit"] * weak.size)
    return weights, capacity, resistance, shift


def _entropy_change(pack: TwinPack, faults: Faults, soc: FloatArray) -> FloatArray | float:
    """Return the change of dU/dT of a cell [V/K]: a smooth curve over the SoC, from the seed."""
    if (fault := faults.get("entropic_coefficient")) is None:
        return 0.0
    rng, grid = np.random.default_rng(fault.seed), pack.chemistry.grid
    knots = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    curve = PchipInterpolator(knots, rng.normal(size=5) + 0.8 * rng.choice((-1.0, 1.0)))
    bend: FloatArray = curve(np.clip(grid, 0.0, 1.0))
    bend *= 1e-3 * fault.size / np.sqrt(np.mean(bend**2))
    return np.interp(soc, grid, bend)


def _soc_rise(faults: Faults, soc: FloatArray) -> FloatArray | float:
    """Return the relative rise of the ohmic resistance over the SoC [-], shape of soc."""
    if (rise := faults.get("resistance_soc")) is None:
        return 0.0
    shape = rise.full_shape()
    centre, width = shape["centre"], shape["width"]
    if shape["towards_full"] > 0.75:
        centre, width = 1.0 - centre, -width
    return np.asarray(rise.size / (1.0 + np.exp((soc - centre) / width)))


def _relaxed(
    pack: TwinPack, drive: Drive, current_a: FloatArray, kelvin: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return drop in the electrolyte [V], current of the reaction [A], swing of the surface [-]."""
    sluggish = np.exp(pack.diffusion_activation_k * (1.0 / kelvin - 1.0 / REFERENCE_K))
    tau = np.array([*pack.electrolyte_tau_s, *pack.solid_tau_s])
    taus = np.column_stack(
        [np.full_like(kelvin, pack.double_layer_s), sluggish[:, None] * tau[None, :]]
    )
    states = relax(current_a, drive.step_s, taus)
    after = 1 + len(pack.electrolyte_tau_s)
    electrolyte = states[:, 1:after] @ np.array(pack.electrolyte_ohm) * ohmic_factor(pack, kelvin)
    swing = states[:, after:] @ np.array(pack.solid_swing) * sluggish
    return electrolyte, states[:, 0], swing


def _kinetics(
    pack: TwinPack,
    soc: FloatArray,
    current_a: FloatArray,
    kelvin: FloatArray,
    slowdown: FloatArray,
) -> FloatArray:
    """Return the overpotential of the reaction [V], shape (g, n): Butler–Volmer, inverted."""
    activation = pack.exchange_activation_k * (1.0 / REFERENCE_K - 1.0 / kelvin)
    fill = np.clip(soc, 0.02, 0.98)
    exchange = pack.exchange_a * 2.0 * np.sqrt(fill * (1.0 - fill)) * np.exp(activation)
    exchange /= slowdown
    eta = np.sinh(np.linspace(-6.0, 6.0, 1201)) / np.sinh(6.0) * 30.0  # F·overpotential/RT
    ratio = np.exp(pack.anodic * eta) - np.exp(-(1.0 - pack.anodic) * eta)
    over = np.interp(current_a / exchange, ratio, eta)
    return np.asarray(over * (_GAS_OVER_FARADAY_V_K * kelvin))


def _added_drop(
    drive: Drive, faults: Faults, current_a: FloatArray, kelvin: FloatArray
) -> FloatArray:
    """Return the voltage drop of faults around the cells [V], shape (n,)."""
    # A rectifying contact, smooth over some amperes around 0.
    charging = 0.5 * (1.0 - current_a / np.hypot(current_a, _BEND_A))
    ohm = faults.size("resistance_asymmetry") * charging + faults.size("resistance_growth")
    if (step := faults.get("resistance_step")) is not None:
        ohm = ohm + step.size * (drive.time_s >= step.full_shape()["at_s"])
    if (contact := faults.get("contact_flicker")) is not None:
        ohm = ohm + contact.size * contact.is_active(drive.time_s)
    drop = ohm * current_a
    slower = np.exp(_ADDED_ACTIVATION_K * (1.0 / kelvin - 1.0 / REFERENCE_K))
    for name, modes in (("fast_polarization", cole_cole), ("slow_diffusion", finite_warburg)):
        if name in faults:
            ohms, taus_s = modes(faults[name])
            drop += relax(current_a, drive.step_s, slower[:, None] * taus_s) @ ohms
    return np.asarray(drop)


def cole_cole(fault: Fault) -> tuple[FloatArray, FloatArray]:
    """Return resistances [Ω] and time constants [s] of a Cole–Cole element.

    The distribution of relaxation times sin((1−α)π)/(cosh(α·ln τ/τ0) − cos((1−α)π)), sampled
    within 1.6 e-folds of τ0 (Cole and Cole 1941).
    """
    shape = fault.full_shape()
    alpha = shape["alpha"]
    weight = 1.0 / (np.cosh(alpha * _COLE_SPREAD) - np.cos((1.0 - alpha) * np.pi))
    return fault.size * weight / weight.sum(), shape["tau_s"] * np.exp(_COLE_SPREAD)


def finite_warburg(fault: Fault) -> tuple[FloatArray, FloatArray]:
    """Return the first six poles [Ω, s] of a finite-length Warburg element R·tanh(√jωτ)/√jωτ."""
    weight = 1.0 / _WARBURG_POLES
    taus_s = fault.full_shape()["tau_s"] / _WARBURG_POLES
    return fault.size * weight / weight.sum(), taus_s


def _hysteresis(drive: Drive, faults: Faults, charge: FloatArray) -> FloatArray | float:
    """Return the voltage drop of hysteresis [V]: five stop operators on the charge.

    Prandtl–Ishlinskii model: each operator follows the charge until it saturates at its reach.
    """
    if (fault := faults.get("hysteresis")) is None:
        return 0.0
    reach = fault.full_shape()["reach"] * _HYSTERESIS_REACHES
    followed = [stopped(charge, each, drive.history * each) / each for each in reach.tolist()]
    return np.asarray(fault.size * np.mean(followed, axis=0))


def stopped(signal: FloatArray, reach: float, start: float = 0.0) -> FloatArray:
    """Return the stop operator of a signal: from its start it follows, within ± its reach."""
    states = [start]
    for moved in np.diff(signal).tolist():
        states.append(min(max(states[-1] + moved, -reach), reach))
    return np.array(states)

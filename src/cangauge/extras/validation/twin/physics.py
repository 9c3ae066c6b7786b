"""Physics of the pack: voltage, state of charge, heat and temperatures under a current.

Cells in groups of equal ones have a tabulated open-circuit voltage, Butler–Volmer kinetics,
diffusion in electrolyte and particles, and two thermal nodes. In the equations U is a voltage [V],
I a current [A], R a resistance [Ω], T a temperature [K], z a state of charge [-], η an
overpotential [V] and τ a time constant [s]. Faults act by their ids (`faults.toml`): those of the
pack here, those of its sensors in `recording`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.signal import lfilter

from cangauge._typing import FloatArray
from cangauge.extras.validation.twin.drive import Drive
from cangauge.extras.validation.twin.faults import HEALTHY, Fault, Faults, size_of
from cangauge.extras.validation.twin.pack import GRID, KELVIN, TwinPack

T0_K: Final = 298.15
"""Temperature of the parameters: 25 °C [K]."""
TOLERANCE_K: Final = 0.05
"""Change of the core temperature at which the thermal iteration stops [K]."""


@dataclass(frozen=True, eq=False)
class Response:
    """What a pack does in a drive, shape (n,) each.

    Parameters
    ----------
    voltage_v : array
        Terminal voltage [V].
    soc : array
        State of charge relative to the true mean capacity [-].
    equilibrium_v : array
        Open-circuit voltage of each cell at its SoC, summed over the cells [V].
    heat_w : array
        Irreversible and reversible heat [W].
    core_c, surface_c : array
        Temperature of the cells, and where the sensor is [°C].
    rows : int
        Rows until the lowest cell is empty and the car stops.
    """

    voltage_v: FloatArray
    soc: FloatArray
    equilibrium_v: FloatArray
    heat_w: FloatArray
    core_c: FloatArray
    surface_c: FloatArray
    rows: int


def simulate_truth(
    pack: TwinPack, drive: Drive, faults: Faults = HEALTHY, near: Response | None = None
) -> Response:
    """Simulate a drive of a pack with faults.

    Temperature and voltage are coupled by the heat: a fixed-point iteration runs until the core
    temperature changes by less than the tolerance. Recorded temperatures are kept, but for the
    difference that a fault between core and sensor makes.

    Parameters
    ----------
    pack : TwinPack
    drive : Drive
    faults : Faults
    near : Response, optional
        The same drive with other faults, as the start of the iteration. Within the tolerance its
        temperatures are kept, so that the voltages differ by the faults alone.
    """
    insulation = size_of(faults, "core_temperature")
    if drive.recorded_c is not None:
        core = drive.recorded_c
        if insulation and near is not None:
            warm, cool = (temperatures(pack, drive, near.heat_w, x)[0] for x in (insulation, 0.0))
            core = core + warm - cool
        truth = respond(pack, drive, faults, core, drive.recorded_c)
        return replace(truth, rows=core.size)
    if near is None:
        kelvin = np.full_like(drive.current_a, drive.start_c + KELVIN)
        ohm = 1.3 * pack.resistance_ohm * ohmic_factor(pack, kelvin)
        core, surface = temperatures(pack, drive, ohm * drive.current_a**2, insulation)
    else:
        core, surface = near.core_c, near.surface_c
    truth = respond(pack, drive, faults, core, surface)
    for _ in range(5):
        core, surface = temperatures(pack, drive, truth.heat_w, insulation)
        if np.max(np.abs(core - truth.core_c)) < TOLERANCE_K:
            break
        truth = respond(pack, drive, faults, core, surface)
    return truth


def respond(
    pack: TwinPack, drive: Drive, faults: Faults, core_c: FloatArray, surface_c: FloatArray
) -> Response:
    """Return the response to the current of a drive at known temperatures [°C], shape (n,)."""
    T, cell = core_c + KELVIN, pack.chemistry
    I = drive.current_a
    drawn = _drawn(pack, drive, faults)
    start = drive.start_soc + size_of(faults, "initial_soc") / 100.0
    cells, capacity, resistance, shift = _groups(pack, faults)
    z = (start + shift)[:, None] - drawn / capacity[:, None]

    dU_dT = cell.entropy(z) + _entropy_change(faults, z)
    reversible = dU_dT * (T - T0_K)
    U0 = cell.ocv(z) + reversible

    electrolyte_v, reacting_a, swing = _relaxed(pack, drive, I, T)
    # This fault diverges at 230 K.
    stiff = np.exp(size_of(faults, "resistance_temperature") * _over(T, 230.0))
    eta = _kinetics(pack, z, reacting_a, T, stiff * (1.0 + size_of(faults, "charge_transfer")))
    R = pack.ohmic_ohm * ohmic_factor(pack, T) * stiff
    eta += R * I * (1.0 + _soc_rise(faults, z)) + electrolyte_v
    eta *= resistance[:, None]
    eta += cell.ocv(z) - cell.ocv(z - swing / capacity[:, None])

    drop = cells @ eta + pack.busbar_ohm * I + _added_drop(drive, faults, T)
    open_v = cells @ U0
    empty = np.flatnonzero(np.min(U0 - eta, axis=0) < cell.empty_v)
    return Response(
        voltage_v=open_v - drop - _hysteresis(drive, faults, drawn),
        soc=start - drawn / (1.0 - size_of(faults, "capacity")),
        equilibrium_v=open_v,
        heat_w=I * drop - I * T * (cells @ dU_dT),
        core_c=core_c,
        surface_c=surface_c,
        rows=int(empty[0]) if empty.size else I.size,
    )


def _drawn(pack: TwinPack, drive: Drive, faults: Faults) -> FloatArray:
    """Return the charge drawn from the mean cell, relative to its healthy capacity [-]."""
    I = drive.current_a
    counted = np.where(I < 0.0, (1.0 - size_of(faults, "coulombic_efficiency")) * I, I)
    integral = np.append(0.0, np.cumsum(0.5 * (counted[1:] + counted[:-1]))) * drive.step_s
    return np.asarray(integral / 3600.0 / pack.capacity_ah)


# --- Cells


def _over(T: FloatArray, pole_k: float) -> FloatArray:
    """Return 1/(T − pole) relative to 25 °C [1/K]: the exponent of a resistance over B."""
    return 1.0 / (T - pole_k) - 1.0 / (T0_K - pole_k)


def ohmic_factor(pack: TwinPack, T: FloatArray) -> FloatArray:
    """Return the ohmic resistance relative to 25 °C [-] (Vogel–Fulcher–Tammann).

    The electrolyte stops conducting at 170 K.
    """
    return np.exp(pack.ohmic_vogel_k * _over(T, 170.0))


def _groups(pack: TwinPack, faults: Faults) -> FloatArray:
    """Return `groups` of a pack with its faults, shape (4, g)."""
    groups = pack.groups.copy()
    if (weak := faults.get("weak_cell")) is not None:
        count, deficit = weak.full_shape["count"], weak.full_shape["deficit"]
        groups[0, groups.shape[1] // 2] -= count
        new = [count, 1.0 - weak.size, 1.0 + 0.5 * weak.size, -deficit * weak.size]
        groups = np.column_stack([groups, new])
    groups[1] *= 1.0 - size_of(faults, "capacity")
    return groups


def _relaxed(
    pack: TwinPack, drive: Drive, I: FloatArray, T: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return drop in the electrolyte [V], current of the reaction [A], swing of the surface [-]."""
    sluggish = np.exp(pack.diffusion_activation_k * _over(T, 0.0))
    tau_s = np.outer(sluggish, [*pack.electrolyte_tau_s, *pack.solid_tau_s])
    double_layer = np.full((T.size, 1), pack.double_layer_s)
    states = relax(I, drive.step_s, np.hstack([double_layer, tau_s]))
    electrolyte, solid = np.split(states[:, 1:], [len(pack.electrolyte_tau_s)], axis=1)
    electrolyte_v = electrolyte @ np.array(pack.electrolyte_ohm) * ohmic_factor(pack, T)
    return electrolyte_v, states[:, 0], solid @ np.array(pack.solid_swing) * sluggish


def _kinetics(
    pack: TwinPack, z: FloatArray, I: FloatArray, T: FloatArray, slowdown: FloatArray
) -> FloatArray:
    """Return the overpotential of the reaction [V], shape (g, n): Butler–Volmer, inverted.

    I/I0 = exp(α·x) − exp(−(1 − α)·x), x = F·η/(R·T).
    """
    fill = np.clip(z, 0.02, 0.98)
    arrhenius = np.exp(-pack.exchange_activation_k * _over(T, 0.0))
    I0 = pack.exchange_a * 2.0 * np.sqrt(fill * (1.0 - fill)) * arrhenius / slowdown
    x = np.sinh(np.linspace(-6.0, 6.0, 1201)) / np.sinh(6.0) * 30.0
    ratio = np.exp(pack.anodic * x) - np.exp(-(1.0 - pack.anodic) * x)
    return np.asarray(np.interp(I / I0, ratio, x) * 8.617333e-5 * T)  # R/F [V/K]


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
    result = (1.0 - mean) * signal[:, None]
    result[1:] += (mean[1:] - keep[1:]) * signal[:-1, None]
    for row in range(1, len(result)):
        result[row] += keep[row] * result[row - 1]
    return result


def lagged(signal: FloatArray, step_s: float, tau_s: float) -> FloatArray:
    """Return a signal after a first-order lag that starts at the signal's first value, (n,)."""
    if tau_s <= 0.0:
        return signal
    keep = float(np.exp(-step_s / tau_s))
    start = np.array([keep * signal[0]])
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], signal, zi=start)[0])


# --- Heat


def temperatures(
    pack: TwinPack, drive: Drive, heat_w: FloatArray, insulation: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Return core and surface temperature [°C], shape (n,) each.

    Two nodes: C_c·T_c' = heat − G·(T_c − T_s);  C_s·T_s' = G·(T_c − T_s) − H·(T_s − ambient) +
    conditioning, which heats or cools until the surface reaches its target.

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
    every = max(1, round(5.0 / drive.step_s))  # 5 s: the shortest time constant is minutes
    starts = np.arange(0, drive.time_s.size, every)
    heat = np.add.reduceat(heat_w, starts) / np.diff(np.append(starts, drive.time_s.size))
    G, H = pack.core_surface_w_k / (1.0 + insulation), pack.surface_ambient_w_k
    step_s = every * drive.step_s
    core = surface = drive.start_c
    nodes = [(core, surface)]
    sign = 1.0 if drive.target_c >= drive.start_c else -1.0
    outside_c = drive.ambient_c[starts].tolist()
    for joule_w, ambient_c in zip(heat[:-1].tolist(), outside_c[:-1], strict=True):
        flow = G * (core - surface)
        wanted = sign * (drive.target_c - surface)
        conditioning = sign * drive.conditioning_w * min(1.0, max(0.0, wanted / 2.0))
        lost = H * (surface - ambient_c)
        core += step_s * (joule_w - flow) / pack.core_j_k
        surface += step_s * (flow - lost + conditioning) / pack.surface_j_k
        nodes.append((core, surface))
    cores, surfaces = np.array(nodes).T
    coarse_s = drive.time_s[starts]
    return np.interp(drive.time_s, coarse_s, cores), np.interp(drive.time_s, coarse_s, surfaces)


# --- Ageing and faults


def _entropy_change(faults: Faults, z: FloatArray) -> FloatArray | float:
    """Return the change of dU/dT of a cell [V/K]: a smooth curve over the SoC, from the seed."""
    if (fault := faults.get("entropic_coefficient")) is None:
        return 0.0
    rng = np.random.default_rng(fault.seed)
    knots = rng.normal(size=5) + 0.8 * rng.choice((-1.0, 1.0))
    curve = PchipInterpolator(np.linspace(0.0, 1.0, 5), knots)
    bend: FloatArray = curve(np.clip(GRID, 0.0, 1.0))
    bend *= 1e-3 * fault.size / np.sqrt(np.mean(bend**2))
    return np.interp(z, GRID, bend)


def _soc_rise(faults: Faults, z: FloatArray) -> FloatArray | float:
    """Return the relative rise of the ohmic resistance over the SoC [-], shape of z."""
    if (rise := faults.get("resistance_soc")) is None:
        return 0.0
    centre, width, towards_full = rise.full_shape.values()
    if towards_full > 0.75:
        centre, width = 1.0 - centre, -width
    return np.asarray(rise.size / (1.0 + np.exp((z - centre) / width)))


def _added_drop(drive: Drive, faults: Faults, T: FloatArray) -> FloatArray:
    """Return the voltage drop of faults around the cells [V], shape (n,)."""
    I = drive.current_a
    charging = 0.5 * (1.0 - I / np.hypot(I, 3.0))  # a contact that rectifies, smooth over 3 A
    ohm = size_of(faults, "resistance_asymmetry") * charging + size_of(faults, "resistance_growth")
    if (step := faults.get("resistance_step")) is not None:
        ohm = ohm + step.size * (drive.time_s >= step.full_shape["at_s"])
    drop = ohm * I
    slower = np.exp(1500.0 * _over(T, 0.0))  # activation energy over the gas constant [K]
    for name, modes in (("fast_polarization", cole_cole), ("slow_diffusion", finite_warburg)):
        if name in faults:
            ohms, taus_s = modes(faults[name])
            drop += relax(I, drive.step_s, np.outer(slower, taus_s)) @ ohms
    return np.asarray(drop)


def cole_cole(fault: Fault) -> tuple[FloatArray, FloatArray]:
    """Return resistances [Ω] and time constants [s] of a Cole–Cole element.

    The distribution of relaxation times sin((1−α)π)/(cosh(α·ln τ/τ0) − cos((1−α)π)), sampled
    within 1.6 e-folds of τ0 (Cole and Cole 1941).
    """
    tau_s, alpha = fault.full_shape["tau_s"], fault.full_shape["alpha"]
    folds = np.array([-1.6, -1.0, -0.5, 0.0, 0.5, 1.0, 1.6])
    weight = 1.0 / (np.cosh(alpha * folds) - np.cos((1.0 - alpha) * np.pi))
    return fault.size * weight / weight.sum(), tau_s * np.exp(folds)


def finite_warburg(fault: Fault) -> tuple[FloatArray, FloatArray]:
    """Return the first six poles [Ω, s] of a finite-length Warburg element R·tanh(√jωτ)/√jωτ."""
    weight = 1.0 / np.arange(1.0, 12.0, 2.0) ** 2
    return fault.size * weight / weight.sum(), fault.full_shape["tau_s"] * weight


def _hysteresis(drive: Drive, faults: Faults, drawn: FloatArray) -> FloatArray | float:
    """Return the voltage drop of hysteresis [V]: five stop operators on the charge.

    Prandtl–Ishlinskii model: each operator follows the charge until it saturates at its reach, a
    part of the fault's.
    """
    if (fault := faults.get("hysteresis")) is None:
        return 0.0
    reach = fault.full_shape["reach"] * np.array([0.06, 0.15, 0.35, 0.65, 1.0])
    followed = [_stopped(drawn, each, drive.history * each) / each for each in reach.tolist()]
    return np.asarray(fault.size * np.mean(followed, axis=0))


def _stopped(signal: FloatArray, reach: float, start: float) -> FloatArray:
    """Return the stop operator of a signal: from its start it follows, within ± its reach."""
    states = [start]
    for moved in np.diff(signal).tolist():
        states.append(min(max(states[-1] + moved, -reach), reach))
    return np.array(states)

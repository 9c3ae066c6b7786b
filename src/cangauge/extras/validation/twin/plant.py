"""Plant: model of a pack that returns voltage, state of charge and heat for a current.

`TwinPlant` simulates the cells by tabulated open-circuit voltage, asymmetric Butler–Volmer
kinetics, diffusion and cell spread.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from scipy.signal import lfilter

from cangauge._typing import FloatArray
from cangauge.extras.validation.twin.condition import Condition
from cangauge.extras.validation.twin.drive import Drive
from cangauge.extras.validation.twin.pack import KELVIN, TwinPack

REFERENCE_K: Final = 298.15
_GLASS_K: Final = 230.0
_HYSTERESIS_REACHES: Final = (0.06, 0.15, 0.35, 0.65, 1.0)  # of the stop operators, relative
_BEND_A: Final = 3.0
_VOGEL_ZERO_K: Final = 170.0
_GAS_OVER_FARADAY_V_K: Final = 8.617333e-5
_THERMAL_STEP_S: Final = 5.0


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
    lowest_v : array
        Voltage of the lowest cell [V].
    """

    voltage_v: FloatArray
    soc: FloatArray
    equilibrium_v: FloatArray
    heat_w: FloatArray
    lowest_v: FloatArray


class Plant(Protocol):
    """Model of a pack."""

    @property
    def name(self) -> str:
        """Name of the model."""

    @property
    def pack(self) -> TwinPack:
        """Size, thermal masses, sensors and open-circuit voltage."""

    @property
    def temperature_tolerance_k(self) -> float:
        """Change of the core temperature at which the thermal iteration stops [K]."""

    def respond(
        self, drive: Drive, condition: Condition, current_a: FloatArray, core_c: FloatArray
    ) -> Response:
        """Return the response to a current.

        Parameters
        ----------
        drive : Drive
            Time grid, initial SoC and history.
        condition : Condition
        current_a : array of shape (n,)
            Current through the cells [A], positive = discharge.
        core_c : array of shape (n,)
            Temperature of the cells [°C].
        """


class TwinPlant:
    """Cells with kinetics, diffusion and spread."""

    name = "twin"
    temperature_tolerance_k = 0.05

    def __init__(self, pack: TwinPack) -> None:
        self.pack = pack

    def respond(
        self, drive: Drive, condition: Condition, current_a: FloatArray, core_c: FloatArray
    ) -> Response:
        """Return the response to a current (see `Plant.respond`)."""
        pack, kelvin = self.pack, core_c + KELVIN
        weights, capacity, resistance, shift = _groups(pack, condition)
        charge = discharged(drive, current_a, condition.charge_loss) / pack.capacity_ah
        start = drive.start_soc + condition.start_soc_shift
        soc = (start + shift)[:, None] - charge / capacity[:, None]

        slow, quick, swing = _relaxed(pack, drive, current_a, kelvin)
        surface = soc - swing / capacity[:, None]
        chemistry = pack.chemistry
        entropy = chemistry.entropy(soc)
        if condition.entropy_shift_v_k is not None:
            entropy = entropy + np.interp(soc, chemistry.grid, condition.entropy_shift_v_k)
        warmth = entropy * (kelvin - REFERENCE_K)
        equilibrium = chemistry.ocv(soc) + warmth

        loss = _kinetics(pack, condition, soc, quick, kelvin)
        stiff = cold_resistance_factor(condition, kelvin)
        ohmic = pack.ohmic_ohm * ohmic_factor(pack, kelvin) * stiff * current_a
        loss += ohmic * (1.0 + soc_resistance_rise(condition, soc))
        loss += slow
        loss *= resistance[:, None]
        loss += equilibrium - warmth - chemistry.ocv(surface)

        drop = weights @ loss + pack.busbar_ohm * current_a
        if condition.string_loss is not None:
            drop = drop * (
                1.0 + condition.string_loss.size * condition.string_loss.is_active(drive.time_s)
            )
        drop = drop + fault_drop(drive, condition, current_a, kelvin)
        hysteresis = hysteresis_drop(drive, condition, charge) if condition.hysteresis_v else 0.0
        open_v = weights @ equilibrium
        reversible = -current_a * kelvin * (weights @ entropy)
        return Response(
            voltage_v=open_v - drop - hysteresis,
            soc=weights @ soc / weights.sum(),
            equilibrium_v=open_v,
            heat_w=current_a * drop + reversible,
            lowest_v=np.min(equilibrium - loss, axis=0),
        )


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
    cores, surfaces = [core], [surface]
    # Conditioning heats or cools until the surface reaches its target.
    sign = 1.0 if drive.target_c >= drive.start_c else -1.0
    for joule_w, outside in zip(heat[:-1], ambient[:-1], strict=True):
        flow = between * (core - surface)
        wanted = sign * (drive.target_c - surface)
        conditioning = sign * drive.conditioning_w * min(1.0, max(0.0, wanted / 2.0))
        loss = pack.surface_ambient_w_k * (surface - outside)
        core += step * (joule_w - flow) / pack.core_j_k
        surface += step * (flow - loss + conditioning) / pack.surface_j_k
        cores.append(core)
        surfaces.append(surface)
    return np.interp(time_s, coarse, cores), np.interp(time_s, coarse, surfaces)


def cold_resistance_factor(condition: Condition, kelvin: FloatArray) -> FloatArray:
    """Return faulty over healthy resistance at a temperature [-]."""
    exponent = 1.0 / (kelvin - _GLASS_K) - 1.0 / (REFERENCE_K - _GLASS_K)
    return np.exp(condition.cold_resistance_k * exponent)


def discharged(drive: Drive, current_a: FloatArray, loss: float = 0.0) -> FloatArray:
    """Return the charge taken from the cells since the start [Ah], shape (n,).

    `loss` is the fraction of the charge put in that is lost.
    """
    counted = np.where(current_a < 0.0, (1.0 - loss) * current_a, current_a)
    steps = 0.5 * (counted[1:] + counted[:-1]) * drive.step_s / 3600.0
    return np.concatenate(([0.0], np.cumsum(steps)))


def soc_resistance_rise(condition: Condition, soc: FloatArray) -> FloatArray | float:
    """Return the relative rise of the ohmic resistance over the SoC [-], shape of soc."""
    rise = condition.soc_resistance
    if rise is None:
        return 0.0
    return rise.height / (1.0 + np.exp((soc - rise.centre) / rise.width))


def fault_drop(
    drive: Drive, condition: Condition, current_a: FloatArray, kelvin: FloatArray
) -> FloatArray:
    """Return the voltage drop of faults around the cells [V], shape (n,)."""
    drop = np.zeros_like(current_a)
    if condition.charging_ohm:
        # A rectifying contact, smooth over some amperes around 0.
        charging = 0.5 * (1.0 - current_a / np.hypot(current_a, _BEND_A))
        drop += condition.charging_ohm * current_a * charging
    if condition.step_ohm:
        drop += condition.step_ohm * current_a * (drive.time_s >= condition.step_at_s)
    if condition.flicker is not None:
        drop += condition.flicker.size * current_a * condition.flicker.is_active(drive.time_s)
    if condition.relaxations:
        taus = np.array([mode.tau_s for mode in condition.relaxations])
        slower = np.exp(1500.0 * (1.0 / kelvin - 1.0 / REFERENCE_K))
        states = relax(current_a, drive.step_s, slower[:, None] * taus[None, :])
        drop += states @ np.array([mode.ohm for mode in condition.relaxations])
    return drop


def hysteresis_drop(drive: Drive, condition: Condition, charge: FloatArray) -> FloatArray:
    """Return the voltage drop of hysteresis [V]: five stop operators on the charge.

    Prandtl–Ishlinskii model: each operator follows the charge until it saturates at its reach.
    """
    reach = condition.hysteresis_reach * np.array(_HYSTERESIS_REACHES)
    state = drive.history * reach
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


def ohmic_factor(pack: TwinPack, kelvin: FloatArray) -> FloatArray:
    """Return the ohmic resistance relative to 25 °C [-] (Vogel–Fulcher–Tammann)."""
    exponent = 1.0 / (kelvin - _VOGEL_ZERO_K) - 1.0 / (REFERENCE_K - _VOGEL_ZERO_K)
    return np.exp(pack.ohmic_vogel_k * exponent)


def _overpotential_table(anodic: float) -> tuple[FloatArray, FloatArray]:
    """Tabulate i/i0 and Fη/RT of asymmetric Butler–Volmer kinetics, to be inverted."""
    eta = np.sinh(np.linspace(-6.0, 6.0, 1201)) / np.sinh(6.0) * 30.0
    return np.exp(anodic * eta) - np.exp(-(1.0 - anodic) * eta), eta


def _groups(
    pack: TwinPack, condition: Condition
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
    pack: TwinPack, condition: Condition, soc: FloatArray, current_a: FloatArray, kelvin: FloatArray
) -> FloatArray:
    """Return the overpotential of the reaction, shape (g, n)."""
    activation = pack.exchange_activation_k * (1.0 / REFERENCE_K - 1.0 / kelvin)
    fill = np.clip(soc, 0.02, 0.98)
    exchange = pack.exchange_a * 2.0 * np.sqrt(fill * (1.0 - fill)) * np.exp(activation)
    exchange /= (1.0 + condition.transfer_slowdown) * cold_resistance_factor(condition, kelvin)
    ratio, eta = _overpotential_table(pack.anodic)
    return np.interp(current_a / exchange, ratio, eta) * (_GAS_OVER_FARADAY_V_K * kelvin)

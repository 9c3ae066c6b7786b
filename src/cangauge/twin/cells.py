"""The electrical side of a pack: charge, kinetics, diffusion → terminal voltage and heat."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cangauge.twin.condition import Condition, is_on
from cangauge.twin.day import Day
from cangauge.twin.extras import (
    REFERENCE_K,
    discharged,
    extra_drop,
    hump_rise,
    hysteresis_drop,
    stiffness,
)
from cangauge.twin.pack import KELVIN, Pack
from cangauge.twin.relaxation import relax

FloatArray = NDArray[np.float64]

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

"""A pack, a day and a condition → what truly happened, and what the log says of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cangauge.twin.cells import ohmic_factor
from cangauge.twin.condition import HEALTHY, Condition, is_on
from cangauge.twin.day import Day
from cangauge.twin.extras import discharged
from cangauge.twin.pack import KELVIN, Pack
from cangauge.twin.plant import Plant
from cangauge.twin.sensors import seen_current, seen_temperature, seen_voltage
from cangauge.twin.thermal import temperatures

FloatArray = NDArray[np.float64]

_MAX_PASSES: Final = 5
_SAME_TEMPERATURE: Final = 0.2
"""Temperatures closer than this part of the plant's threshold give the same voltage."""
_EMPTY_V: Final = {"lfp": 1.8, "other": 2.2}


@dataclass(frozen=True, eq=False)
class Truth:
    """What happened on the grid of the day, shape (n,) each.

    `seen_…` is what a sensor without noise, steps and losses would report: the true value, but
    with the sensor's fault. Currents discharge when positive.
    """

    time_s: FloatArray
    current_a: FloatArray
    voltage_v: FloatArray
    core_c: FloatArray
    surface_c: FloatArray
    soc: FloatArray
    equilibrium_v: FloatArray
    heat_w: FloatArray
    rows: int
    """Rows until the lowest cell is empty and the car stops; the rest is not recorded."""
    seen_current_a: FloatArray
    seen_voltage_v: FloatArray
    seen_temperature_c: FloatArray


def simulate(
    plant: Plant, day: Day, condition: Condition = HEALTHY, near: Truth | None = None
) -> Truth:
    """Return what a pack in a condition does on a day.

    Temperature and voltage depend on each other through the heat; they are passed to and fro
    until the core moves by less than the plant's threshold.

    Parameters
    ----------
    plant : Plant
    day : Day
    condition : Condition
    near : Truth, optional
        The same day in another condition. Its temperatures are kept while they agree with the
        heat, so that what differs in voltage is not the last hundredths of a kelvin.
    """
    pack = plant.pack
    current = day.current_a
    if condition.hidden_load is not None:
        current = current + condition.hidden_load.size * is_on(condition.hidden_load, day.time_s)
    if near is None:
        kelvin = np.full_like(current, day.start_c + KELVIN)
        heat = pack.resistance_ohm * 1.3 * ohmic_factor(pack, kelvin) * current**2
        core, surface = temperatures(pack, day, heat, condition.insulation)
    else:
        core, surface = near.core_c, near.surface_c
    cells = plant.electrical(day, condition, current, core)
    for _ in range(_MAX_PASSES):
        next_core, next_surface = temperatures(pack, day, cells.heat_w, condition.insulation)
        if float(np.max(np.abs(next_core - core))) < plant.settled_k:
            break
        core, surface = next_core, next_surface
        cells = plant.electrical(day, condition, current, core)
    reported = surface
    if pack.knows_core:
        reported = surface + (core - surface) / (1.0 + condition.insulation)
    return Truth(
        time_s=day.time_s,
        current_a=current,
        voltage_v=cells.voltage_v,
        core_c=core,
        surface_c=surface,
        soc=cells.soc,
        equilibrium_v=cells.equilibrium_v,
        heat_w=cells.heat_w,
        rows=_until_empty(pack, cells.lowest_v),
        seen_current_a=seen_current(condition, day, day.current_a),
        seen_voltage_v=seen_voltage(condition, day, cells.voltage_v),
        seen_temperature_c=seen_temperature(pack, condition, day, reported),
    )


def _until_empty(pack: Pack, lowest_v: FloatArray) -> int:
    limit = _EMPTY_V["lfp" if pack.chemistry.name == "lfp" else "other"]
    empty = np.flatnonzero(lowest_v < limit)
    return int(empty[0]) if empty.size else lowest_v.size


def expected_voltage(plant: Plant, day: Day, truth: Truth, healthy: Truth) -> FloatArray:
    """Return what a perfect model of the healthy pack makes of the reported signals [V].

    It is given the reported current and the reported temperature (and knows how the healthy
    core stands above it), and the start SoC that the gauge assumes.

    Parameters
    ----------
    plant : Plant
    day : Day
    truth : Truth
        With the fault.
    healthy : Truth
        The same day without it.
    """
    same_current = np.array_equal(truth.seen_current_a, day.current_a)
    shift = truth.seen_temperature_c - healthy.seen_temperature_c
    if same_current and float(np.max(np.abs(shift))) < _SAME_TEMPERATURE * plant.settled_k:
        return healthy.voltage_v
    core = healthy.core_c + shift
    return plant.electrical(day, HEALTHY, truth.seen_current_a, core).voltage_v


def gap_v(plant: Plant, day: Day, truth: Truth, healthy: Truth) -> FloatArray:
    """Return reported minus expected voltage, noise apart [V], shape (truth.rows,)."""
    gap = truth.seen_voltage_v - expected_voltage(plant, day, truth, healthy)
    return gap[: truth.rows]


def true_soc_pct(pack: Pack, day: Day, truth: Truth, condition: Condition) -> FloatArray:
    """Return the true SoC in % of the true mean capacity, shape (n,)."""
    charge = discharged(day, truth.current_a, condition.charge_loss)
    capacity = pack.capacity_ah * condition.capacity_factor
    return 100.0 * (day.start_soc + condition.start_soc_shift - charge / capacity)

"""A pack that obeys the published equation while it is healthy, with other numbers.

What remains of a clean day is then the sensors' doing and the core's few kelvin above the sensor.
Its faults are the twin's, in the twin's own forms; so a diagnosis is asked for the cause alone, and
not for the difference between two kinds of models. Where the gauge knows the core too (`published`)
little but noise is left.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cangauge.twin.cells import VOLT_A_KELVIN, Electrical, overpotential_table
from cangauge.twin.chemistry import Chemistry
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

FloatArray = NDArray[np.float64]

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

"""Plant of the twin whose cells are PyBaMM's single-particle model with electrolyte (SPMe).

Independent physics: porous electrodes, particles, electrolyte. Capacity, exchange current and
initial SoC change its parameters; faults around the cells (contacts, hysteresis, relaxations) are
added as in the other plants. Needs `pip install pybamm` (https://www.pybamm.org, BSD; Sulzer et al.
2021).
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import CangaugeError, InputError
from cangauge.extras.validation.twin.condition import Condition
from cangauge.extras.validation.twin.drive import Drive
from cangauge.extras.validation.twin.pack import HIGHEST, KELVIN, LOWEST, CellChemistry, TwinPack
from cangauge.extras.validation.twin.plant import (
    REFERENCE_K,
    Response,
    cold_resistance_factor,
    discharged,
    fault_drop,
    hysteresis_drop,
    ohmic_factor,
    soc_resistance_rise,
)

PARAMETER_SETS: Final = ("Mohtat2020", "Ecker2015", "NCA_Kim2011", "Chen2020", "Ai2020")
_POINTS: Final = 501
_MESH: Final = {"x_n": 6, "x_s": 5, "x_p": 6, "r_n": 14, "r_p": 14}
_OUTPUT_S: Final = 1.0
_CACHE_SIZE: Final = 12
"""Solutions: three drives with and without a fault, and some more."""
_CONTACT_SHARE: Final = (0.1, 0.35)


@dataclass(frozen=True)
class Stoichiometry:
    """Stoichiometry of both electrodes at 0 and 100 % SoC [-]."""

    negative_empty: float
    negative_full: float
    positive_full: float
    positive_empty: float


@dataclass(frozen=True)
class _Cell:
    """Initial SoC of a cell, and its changes to PyBaMM's parameters."""

    start: float
    capacity_factor: float
    charge_loss: float
    transfer_slowdown: float


class PybammPlant:
    """Equal cells in series, simulated by PyBaMM.

    Parameters
    ----------
    pack : TwinPack
        Size, thermal masses and sensors; with the open-circuit voltage of the parameters.
    parameters : pybamm.ParameterValues
    stoichiometry : Stoichiometry
    contact_ohm : float
        Ohmic resistance outside the cell, per cell, at 25 °C [Ω].
    """

    name = "pybamm"
    temperature_tolerance_k = 0.3

    def __init__(
        self, pack: TwinPack, parameters: Any, stoichiometry: Stoichiometry, contact_ohm: float
    ) -> None:
        self.pack = pack
        self._parameters = parameters
        self._stoichiometry = stoichiometry
        self._contact_ohm = contact_ohm
        # The nominal capacity of a set often differs from that between its stoichiometries.
        negative_ah = _number(parameters, import_pybamm().LithiumIonParameters().n.Q_init)
        window = stoichiometry.negative_full - stoichiometry.negative_empty
        self._cell_ah = negative_ah * window
        self._solutions: dict[tuple[bytes, bytes, bytes, _Cell], FloatArray] = {}

    def respond(
        self, drive: Drive, condition: Condition, current_a: FloatArray, core_c: FloatArray
    ) -> Response:
        """Return the response to a current (see `Plant.respond`).

        Raises
        ------
        CangaugeError
            If PyBaMM cannot solve the drive.
        """
        pack, kelvin = self.pack, core_c + KELVIN
        charge = discharged(drive, current_a, condition.charge_loss) / pack.capacity_ah
        start = drive.start_soc + condition.start_soc_shift
        soc = start - charge / condition.capacity_factor
        usual = _Cell(
            start, condition.capacity_factor, condition.charge_loss, condition.transfer_slowdown
        )
        cell_v = self._cell_v(drive, current_a, kelvin, usual)
        total_v, lowest = pack.cells * cell_v, cell_v
        weak = condition.weak
        if weak is not None:
            lesser = replace(
                usual,
                start=start - weak.deficit,
                capacity_factor=condition.capacity_factor * (1.0 - weak.loss),
            )
            weak_v = self._cell_v(drive, current_a, kelvin, lesser)
            total_v = total_v + weak.count * (weak_v - cell_v)
            lowest = np.minimum(cell_v, weak_v)
        entropy = pack.chemistry.entropy(soc)
        if condition.entropy_shift_v_k is not None:
            shift = np.interp(soc, pack.chemistry.grid, condition.entropy_shift_v_k)
            total_v = total_v + pack.cells * shift * (kelvin - REFERENCE_K)
            entropy = entropy + shift
        contact = self._contact_ohm * ohmic_factor(pack, kelvin) * current_a
        inner = pack.ohmic_ohm * ohmic_factor(pack, kelvin) * current_a
        stiff = cold_resistance_factor(condition, kelvin)
        drop = pack.cells * (
            contact + inner * (stiff * (1.0 + soc_resistance_rise(condition, soc)) - 1.0)
        )
        drop = drop + fault_drop(drive, condition, current_a, kelvin)
        open_v = pack.cells * (pack.chemistry.ocv(soc) + entropy * (kelvin - REFERENCE_K))
        if condition.string_loss is not None:
            losses = open_v - total_v + drop
            on = condition.string_loss.is_active(drive.time_s)
            drop = drop + condition.string_loss.size * losses * on
        before_hysteresis = total_v - drop
        if condition.hysteresis_v:
            drop = drop + hysteresis_drop(drive, condition, charge)
        return Response(
            voltage_v=total_v - drop,
            soc=soc,
            equilibrium_v=open_v,
            heat_w=current_a * (open_v - before_hysteresis)
            - current_a * kelvin * pack.cells * entropy,
            lowest_v=lowest - drop / pack.cells,
        )

    def _cell_v(
        self, drive: Drive, current_a: FloatArray, kelvin: FloatArray, cell: _Cell
    ) -> FloatArray:
        """Return the voltage of one cell [V]; 0 after PyBaMM ends the discharge.

        Sizing a fault of the sensors or around the cells repeats the same solution, which takes a
        second: the latest ones are cached.
        """
        key = (drive.time_s.tobytes(), current_a.tobytes(), kelvin.tobytes(), cell)
        if key not in self._solutions:
            if len(self._solutions) >= _CACHE_SIZE:
                self._solutions.pop(next(iter(self._solutions)))
            self._solutions[key] = self._solved_v(drive, current_a, kelvin, cell)
        return self._solutions[key]

    def _solved_v(
        self, drive: Drive, current_a: FloatArray, kelvin: FloatArray, cell: _Cell
    ) -> FloatArray:
        pybamm = import_pybamm()
        parameters = self._parameters.copy()
        time_s = drive.time_s
        every = max(1, round(_OUTPUT_S / drive.step_s))
        counted = np.where(current_a < 0.0, (1.0 - cell.charge_loss) * current_a, current_a)
        amperes = counted * self._cell_ah / self.pack.capacity_ah
        coarse_s = time_s[::every]
        # Extended beyond the end, where the solver may evaluate them.
        beyond_s = np.append(time_s, time_s[-1] + 60.0)
        beyond_a = np.append(amperes, amperes[-1])
        beyond_k = np.append(kelvin, kelvin[-1])
        parameters["Current function [A]"] = pybamm.Interpolant(beyond_s, beyond_a, pybamm.t)

        def ambient(_y: Any, _z: Any, t: Any) -> Any:
            return pybamm.Interpolant(beyond_s, beyond_k, t)

        parameters["Ambient temperature [K]"] = ambient
        self._age(parameters, cell.capacity_factor, cell.transfer_slowdown)
        self._fill(parameters, cell.start)
        simulation = pybamm.Simulation(
            pybamm.lithium_ion.SPMe({"thermal": "isothermal"}),
            parameter_values=parameters,
            var_pts=_MESH,
            solver=pybamm.IDAKLUSolver(rtol=1e-4, atol=1e-6),
        )
        try:
            solution = simulation.solve([0.0, float(time_s[-1])], t_interp=coarse_s)
        except pybamm.SolverError as error:
            problem = f"PyBaMM cannot solve this drive: {str(error).splitlines()[0]}"
            raise CangaugeError(problem) from error
        volts = np.asarray(solution["Voltage [V]"](t=coarse_s), dtype=np.float64)
        ended = np.asarray(coarse_s > float(solution.t[-1]))
        volts[ended] = 0.0
        # Within a second only the ohmic part of the cell responds.
        return np.interp(time_s, coarse_s, volts) - self._within_second(current_a, every)

    def _within_second(self, current_a: FloatArray, every: int) -> FloatArray | float:
        if every == 1:
            return 0.0
        rows = np.arange(current_a.size)
        straight = np.interp(rows, rows[::every], current_a[::every])
        return (self.pack.ohmic_ohm - self._contact_ohm) * (current_a - straight)

    def _age(self, parameters: Any, factor: float, slowdown: float) -> None:
        for side in ("Negative", "Positive"):
            active = f"{side} electrode active material volume fraction"
            parameters[active] = parameters[active] * factor
            if slowdown:
                exchange = f"{side} electrode exchange-current density [A.m-2]"
                parameters[exchange] = _divided(parameters[exchange], 1.0 + slowdown)

    def _fill(self, parameters: Any, soc: float) -> None:
        s = self._stoichiometry
        negative = s.negative_empty + soc * (s.negative_full - s.negative_empty)
        positive = s.positive_empty + soc * (s.positive_full - s.positive_empty)
        for side, filled in (("negative", negative), ("positive", positive)):
            most = parameters[f"Maximum concentration in {side} electrode [mol.m-3]"]
            parameters[f"Initial concentration in {side} electrode [mol.m-3]"] = filled * most


def import_pybamm() -> Any:
    """Return the module pybamm; raise InputError if it is not installed."""
    try:
        return importlib.import_module("pybamm")
    except ImportError as error:
        cure = "pip install pybamm"
        raise InputError("PyBaMM is not installed", field="plant", cure=cure) from error


def draw_pybamm_plant(
    rng: np.random.Generator, pack: TwinPack, parameter_set: str | None = None
) -> PybammPlant:
    """Draw a PyBaMM pack: a parameter set with individual exchange currents.

    Parameters
    ----------
    rng : Generator
    pack : TwinPack
        Size, thermal masses and sensors.
    parameter_set : str, optional
        One of `PARAMETER_SETS`; drawn by default.

    Raises
    ------
    InputError
        If PyBaMM is not installed or the set is unknown.
    """
    pybamm = import_pybamm()
    if parameter_set is None:
        parameter_set = str(rng.choice(PARAMETER_SETS))
    if parameter_set not in PARAMETER_SETS:
        raise InputError(
            "unknown parameter set",
            value=parameter_set,
            cure=f"use {', '.join(PARAMETER_SETS)}",
        )
    parameters = pybamm.ParameterValues(parameter_set)
    low, high, high_soc, low_soc = (
        float(value) for value in pybamm.lithium_ion.get_min_max_stoichiometries(parameters)
    )
    stoichiometry = Stoichiometry(low, high, high_soc, low_soc)
    # The pack's protection ends a drive, not the limits of the set.
    parameters["Lower voltage cut-off [V]"] = 1.5
    parameters["Upper voltage cut-off [V]"] = 5.0
    for side in ("Negative", "Positive"):
        key = f"{side} electrode exchange-current density [A.m-2]"
        parameters[key] = _divided(parameters[key], float(rng.uniform(0.8, 1.3)))
    table = _ocv_table(parameters, stoichiometry, pack.chemistry, parameter_set)
    pack = replace(pack, chemistry=table)
    probe = PybammPlant(pack, parameters, stoichiometry, contact_ohm=0.0)
    resistance = _pulse_ohm(probe)
    share = rng.uniform(*_CONTACT_SHARE)
    contact = float(resistance * share)
    sized = replace(
        pack,
        ohmic_ohm=0.5 * resistance + contact,
        exchange_a=0.02569 / (0.5 * resistance),
        busbar_ohm=0.0,
        resistance_factor=np.ones_like(pack.weights),
    )
    return PybammPlant(sized, parameters, stoichiometry, contact)


def _divided(value: Any, divisor: float) -> Any:
    if not callable(value):
        return value / divisor

    def slower(*arguments: Any) -> Any:
        return value(*arguments) / divisor

    return slower


def _ocv_table(
    parameters: Any, s: Stoichiometry, drawn: CellChemistry, parameter_set: str
) -> CellChemistry:
    """Return the open-circuit voltage of the parameters on the grid of `drawn`."""
    soc = np.linspace(max(LOWEST, -0.02), min(HIGHEST, 1.0), _POINTS)
    negative = np.clip(
        s.negative_empty + soc * (s.negative_full - s.negative_empty), 1e-4, 1.0 - 1e-4
    )
    positive = np.clip(
        s.positive_empty + soc * (s.positive_full - s.positive_empty), 1e-4, 1.0 - 1e-4
    )
    volts = np.array(
        [
            _number(parameters, parameters["Positive electrode OCP [V]"](y))
            - _number(parameters, parameters["Negative electrode OCP [V]"](x))
            for x, y in zip(negative, positive, strict=True)
        ]
    )
    volts = np.maximum.accumulate(volts)
    ocv = np.interp(drawn.grid, soc, volts) + 1e-6 * drawn.grid
    slope = (volts[1] - volts[0]) / (soc[1] - soc[0])
    ocv = np.where(drawn.grid < soc[0], volts[0] + slope * (drawn.grid - soc[0]), ocv)
    return CellChemistry(parameter_set, drawn.grid, ocv, np.zeros_like(drawn.grid))


def _number(parameters: Any, expression: Any) -> float:
    return float(np.ravel(parameters.evaluate(expression))[0])


def _pulse_ohm(plant: PybammPlant) -> float:
    """Return the resistance of one cell after 10 s of 1C at 50 % SoC and 25 °C [Ω]."""
    time_s = np.arange(0.0, 60.0)
    current = np.where((time_s >= 20.0) & (time_s < 40.0), plant.pack.one_c_a, 0.0)
    drive = Drive(time_s, current, np.full_like(time_s, 25.0), 25.0, 0.5)
    volts = plant.respond(drive, Condition(), current, np.full_like(time_s, 25.0)).voltage_v
    return float((volts[19] - volts[30]) / plant.pack.one_c_a / plant.pack.cells)

"""Faults in measured drives, diagnosed as the gap of two foreign simulators.

    pip install pybamm thevenin
    python benchmarks/simulators.py --data FOLDER

The simulators under test are PyBaMM's SPMe with the parameters of a similar cell (Chen2020, scaled
to the pack's capacity, nothing fitted), and `thevenin` with one RC element, fitted to four drives.
The measured drives are those of an LG HG2 cell at 25 °C, scaled to a pack of 96 × 17. Four drives
are references; two others get a fault, in the log or in what the simulator is given, and are
diagnosed together. The table gives the most probable fault, and the error of the simulated voltage
before and after the correction.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from cangauge.bus.recording import read_log
from cangauge.diagnosis import diagnose
from cangauge.diagnosis.posterior import Posterior
from cangauge.identify.fit import fit
from cangauge.identify.starts import with_start
from cangauge.logs.log import Log
from figures import publish

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
REFERENCES = ("551_LA92", "551_US06", "552_Mixed3", "552_Mixed5")
DIAGNOSED = ("551_Mixed1", "552_Mixed7")
LG_SERIES, LG_PARALLEL = 96, 17
CAPACITY_AH = 2.78 * LG_PARALLEL
"""By full discharges of a cell at 25 °C [Ah]."""
START_PCT = 100.0
RC_TIME_S = 40.0
"""Time constant of the RC element [s]: between the model's delays."""
SOC_AT_LEAST_PCT = 10.0
"""Rows below are left out: the last tenth of a cell is the simulators' weakest part."""

Simulator = Callable[[Log, float, float], np.ndarray]
"""Log, SoC at the start [%] and factor on the capacity → pack voltage [V]."""


def spme(log: Log, start_pct: float, capacity_factor: float) -> np.ndarray:
    """PyBaMM's single-particle model with electrolyte, with the parameters of an LG M50."""
    import pybamm  # noqa: PLC0415

    parameters = pybamm.ParameterValues("Chen2020")
    cell_ah = float(parameters["Nominal cell capacity [A.h]"])
    amperes = log.current_a * cell_ah / (CAPACITY_AH * capacity_factor)
    time_s = log.time_s - log.time_s[0]
    parameters["Current function [A]"] = pybamm.Interpolant(
        np.append(time_s, time_s[-1] + 60.0), np.append(amperes, amperes[-1]), pybamm.t
    )
    parameters["Ambient temperature [K]"] = float(np.mean(log.temperature_c)) + 273.15
    parameters.set_initial_state(start_pct / 100.0)
    # The measured drive ends the simulation, not the limits of the set.
    parameters["Lower voltage cut-off [V]"], parameters["Upper voltage cut-off [V]"] = 1.5, 5.0
    simulation = pybamm.Simulation(
        pybamm.lithium_ion.SPMe({"thermal": "isothermal"}),
        parameter_values=parameters,
        solver=pybamm.IDAKLUSolver(rtol=1e-4, atol=1e-6),
    )
    solution = simulation.solve([0.0, float(time_s[-1])], t_interp=time_s)
    volts = np.full(len(log), np.nan)
    solved = time_s <= float(solution.t[-1])
    volts[solved] = LG_SERIES * np.asarray(solution["Voltage [V]"](t=time_s[solved]))
    return volts


def fitted_thevenin(training: list[Log]) -> Simulator:
    """Return `thevenin` with one RC element: curve and resistances by our fit of four drives."""
    model = fit(training, capacity_ah=CAPACITY_AH).voltage_model
    soc = np.linspace(0.0, 100.0, 201)
    curve_v = model.pseudo_ocv(soc)
    late_ohm = -sum(model.loads.resistance_ohm[1:])

    def simulate(log: Log, start_pct: float, capacity_factor: float) -> np.ndarray:
        import thevenin  # noqa: PLC0415

        time_s = log.time_s - log.time_s[0]
        simulation = thevenin.Simulation(
            {
                "num_RC_pairs": 1, "soc0": start_pct / 100.0, "gamma": 0.0, "ce": 1.0,
                "capacity": CAPACITY_AH * capacity_factor, "mass": 300.0, "isothermal": True,
                "Cp": 900.0, "T_inf": float(np.mean(log.temperature_c)) + 273.15,
                "h_therm": 10.0, "A_therm": 1.0,
                "ocv": lambda part: np.interp(100.0 * part, soc, curve_v),
                "M_hyst": lambda part: 0.0 * part,
                "R0": lambda part, _kelvin: -model.loads.resistance_ohm[0] + 0.0 * part,
                "R1": lambda part, _kelvin: late_ohm + 0.0 * part,
                "C1": lambda part, _kelvin: RC_TIME_S / late_ohm + 0.0 * part,
            }
        )  # fmt: skip
        experiment = thevenin.Experiment(max_step=10.0)
        experiment.add_step(
            "current_A", lambda t: float(np.interp(t, time_s, log.current_a)), time_s
        )
        solution = simulation.run(experiment)
        return np.interp(time_s, solution.vars["time_s"], solution.vars["voltage_V"])

    return simulate


@dataclass(frozen=True)
class Injected:
    """A fault: the change of the log, and of what the simulator is given."""

    name: str
    fault: str = ""
    change: Callable[[Log], Log] = lambda log: log
    start_pct: float = 0.0
    """Error of the SoC that the simulator starts from [%]."""
    capacity_factor: float = 1.0
    """The simulator's capacity relative to the true one."""


def _amperes(log: Log, offset_a: float = 0.0, factor: float = 1.0) -> Log:
    return replace(log, current_a=factor * log.current_a + offset_a)


def _volts(log: Log, offset_v: float = 0.0, factor: float = 1.0) -> Log:
    return replace(log, voltage_v=factor * log.voltage_v + offset_v)


def _late(log: Log) -> Log:
    return replace(log, current_a=np.interp(log.time_s - 1.0, log.time_s, log.current_a))


FAULTS = (
    Injected("none"),
    Injected("current + 2 A", "current_reading", lambda log: _amperes(log, offset_a=2.0)),
    Injected("current + 5 %", "current_reading", lambda log: _amperes(log, factor=1.05)),
    Injected("voltage + 3 V", "voltage_reading", lambda log: _volts(log, offset_v=3.0)),
    Injected("voltage + 1 %", "voltage_reading", lambda log: _volts(log, factor=1.01)),
    Injected("current 1 s late", "clock", _late),
    Injected("start − 6 %", "start", start_pct=-6.0),
    Injected("capacity − 10 %", "capacity", capacity_factor=1.0 / 0.9),
)


def simulated(
    log: Log, simulator: Simulator, fault: Injected = FAULTS[0]
) -> tuple[Log, np.ndarray]:
    """Return a drive with a fault, and what the simulator made of it [V]."""
    given = fault.change(log)
    start_pct = START_PCT + fault.start_pct
    volts = simulator(given, start_pct, fault.capacity_factor)
    keep = np.isfinite(volts)
    return with_start(given.rows(keep), start_pct), volts[keep]


def rows(folder: Path) -> Iterator[tuple[str, ...]]:
    """Diagnose each fault with each simulator; yield the cells of the table."""
    references, drives = (
        [_drive(folder, name) for name in names] for names in (REFERENCES, DIAGNOSED)
    )
    for name, simulator in (("SPMe", spme), ("thevenin", fitted_thevenin(references))):
        healthy = [simulated(log, simulator) for log in references]
        for fault in track(FAULTS, description=name, console=Console(stderr=True)):
            runs = [simulated(log, simulator, fault) for log in drives]
            found = diagnose(
                [log for log, _ in runs],
                references=[log for log, _ in healthy],
                simulation={log.source or log.name: volts for log, volts in [*runs, *healthy]},
                capacity_ah=CAPACITY_AH,
            )
            before = [log.voltage_v - volts for log, volts in runs]
            after = [found.extended_model.predict(log).residual_v for log in found.logs]
            yield (
                name,
                fault.name,
                *_said(found.posterior, fault.fault),
                f"{rms(before):.1f} V",
                f"{rms(after):.1f} V",
            )


def _said(answer: Posterior, fault: str) -> tuple[str, ...]:
    """Return what is stated, the most probable fault, and the probability of the true one."""
    stated = " or ".join(name.replace("_", " ") for name in answer.stated)
    first, probability = max(answer.faults.items(), key=itemgetter(1))
    return (
        stated or "–",
        f"{first.replace('_', ' ')} {probability:.0%}",
        f"{answer.faults[fault] if fault else answer.none:.0%}",
    )


def rms(parts: list[np.ndarray]) -> float:
    """Return the root mean square of arrays together."""
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def _drive(folder: Path, name: str) -> Log:
    log = read_log(folder / "lg_hg2" / f"25degC__{name}.parquet")
    log = log.rows(np.unique(np.searchsorted(log.time_s, np.arange(*log.time_s[[0, -1]]))))
    assumed = np.full(len(log), np.nan)
    assumed[0] = START_PCT
    pack = replace(
        log,
        current_a=LG_PARALLEL * log.current_a,
        voltage_v=LG_SERIES * log.voltage_v,
        soc_pct=assumed,
    )
    return _above(pack)


def _above(log: Log) -> Log:
    out_ah = np.cumsum(log.current_a * np.diff(log.time_s, prepend=log.time_s[0])) / 3600.0
    return log.rows(100.0 - 100.0 * out_ah / CAPACITY_AH > SOC_AT_LEAST_PCT)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the recorded logs")
    parser.add_argument("--keep", action="store_true", help="keep the figures for the page")
    options = parser.parse_args()
    table = Table(
        "simulator",
        "fault",
        "stated faults",
        "most probable fault",
        "P(truth)",
        "RMSE of the simulator",
        "RMSE after correction",
    )
    for row in rows(options.data):
        table.add_row(*row)
    describes = ["src/cangauge/diagnosis", "src/cangauge/model", "src/cangauge/identify"]
    publish("simulators", [table], describes, keeps=options.keep, width=150)


if __name__ == "__main__":
    main()

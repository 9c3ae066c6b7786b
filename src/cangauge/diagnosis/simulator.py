"""The gap between measured voltages and those of any simulator.

A model is identified on the simulator's own output and gives the effects' columns. The diagnosed
logs carry the model's voltage plus the difference of measured and simulated voltage, so that the
diagnosed error is exactly that difference, however well the model repeats the simulator.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from cangauge._text import significant
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.model_file import Model

Simulation = Callable[[FloatArray, FloatArray, FloatArray, float], Any] | Mapping[str, Any] | Any
"""Function of time [s], current [A], temperature [°C] and SoC of the first row [%] that returns the
voltage [V]; voltages by file or name of each log; or a `pybamm.Simulation`."""

LEVEL_PART: Final = 0.01
"""A simulator is off everywhere where the mean difference is more than this part of the voltage,
and more than what varies about it."""


def simulated_v(simulation: Simulation, log: Log) -> FloatArray:
    """Return the simulated voltage of every row of a log, one finite number each [V]."""
    where, first = log.source or log.name, log.first_soc()
    if first is None:
        raise InputError(
            "unknown SoC at the start of the simulation",
            source=where,
            field="soc_pct",
            cure="give a log with soc_pct, or the initial SoC",
        )
    try:
        if isinstance(simulation, Mapping):
            volts = simulation[where]
        elif callable(simulation):
            volts = simulation(log.time_s, log.current_a, log.temperature_c, first[1])
        else:
            volts = _pybamm_v(simulation, log, first[1])
    except (Exception, SystemExit) as error:
        raise InputError(
            f"the simulation raised {type(error).__name__}: {error}",
            source=where,
            cure="give a pybamm.Simulation, or a function of (time_s, current_a, temperature_c,"
            " initial_soc_pct)",
        ) from error
    volts = np.asarray(volts, dtype=np.float64)
    if volts.shape != log.time_s.shape or not np.isfinite(volts).all():
        bad = "" if volts.shape != log.time_s.shape else " with values that are not finite"
        raise InputError(
            f"the simulator returned shape {volts.shape}{bad} for {len(log)} rows",
            source=where,
            cure="return one voltage [V] for each time; end the log before the simulator stops",
        )
    return volts


def _pybamm_v(simulation: Any, log: Log, start_pct: float) -> FloatArray:
    """Return the pack's voltage of a `pybamm.Simulation` driven with a log's current [V]."""
    pybamm: Any = importlib.import_module("pybamm")  # only where a simulation of it is given
    time_s = log.time_s - log.time_s[0]
    after_s = np.append(time_s, time_s[-1] + 60.0)  # where the solver may evaluate it
    values = simulation.parameter_values.copy()
    amperes = np.append(log.current_a, log.current_a[-1])
    values["Current function [A]"] = pybamm.Interpolant(after_s, amperes, pybamm.t)
    kelvin = np.append(log.temperature_c, log.temperature_c[-1]) + 273.15

    def ambient_k(_y: Any, _z: Any, t: Any) -> Any:
        return pybamm.Interpolant(after_s, kelvin, t)

    values["Ambient temperature [K]"] = ambient_k
    driven = pybamm.Simulation(simulation.model, parameter_values=values)
    solution = driven.solve([0.0, float(time_s[-1])], t_interp=time_s, initial_soc=0.01 * start_pct)
    return np.asarray(solution["Battery voltage [V]"](t=time_s))


def simulator_gap(
    logs: Sequence[Log],
    references: Sequence[Log],
    simulation: Simulation,
    model: Model | None = None,
    capacity_ah: float | None = None,
) -> tuple[tuple[Log, ...], tuple[Log, ...], Model, str]:
    """Return the gap of a simulator as that of a model, by default identified on its output.

    Returns
    -------
    logs, references : tuple of Log
        With the voltage of `model` plus the simulator's difference.
    model : Model
    remark : str
        Where the simulator is off everywhere; "" else.
    """
    every, number = (*logs, *references), len(logs)
    volts = [simulated_v(simulation, log) for log in every]
    outputs = [replace(log, voltage_v=each) for log, each in zip(every, volts, strict=True)]
    if model is None:
        model = fit(outputs, capacity_ah=capacity_ah).model
    on_model = tuple(
        replace(log, voltage_v=model.predict(output).voltage_v + log.voltage_v - output.voltage_v)
        for log, output in zip(every, outputs, strict=True)
    )
    gaps_v = [log.voltage_v - each for log, each in zip(every, volts, strict=True)]
    # Healthy logs show the level where there are any: a fault may hide it, or look like one.
    remark = _level_remark(gaps_v[number:] or gaps_v, float(np.mean(logs[0].voltage_v)))
    return on_model[:number], on_model[number:], model, remark


def _level_remark(gaps_v: Sequence[FloatArray], usual_v: float) -> str:
    """Return that a simulator is off everywhere, which comes before any cause; "" else."""
    gap_v = np.concatenate(gaps_v)
    mean, varies = float(gap_v.mean()), float(gap_v.std())
    if abs(mean) <= max(LEVEL_PART * usual_v, varies):
        return ""
    return (
        f"The simulator is {significant(abs(mean), 2, 'V')}"
        f" {'too low' if mean > 0.0 else 'too high'} everywhere, and varies by"
        f" {significant(varies, 2, 'V')} about that. Correct its level first: the"
        " open-circuit voltage, the number of cells or the initial SoC."
    )

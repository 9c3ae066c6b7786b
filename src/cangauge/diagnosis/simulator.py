"""The gap between measured voltages and those of any simulator.

The voltage model is identified on the simulator's own output and gives the effects' columns. The
diagnosed logs carry the model's voltage plus the difference of measured and simulated voltage, so
that the diagnosed error is exactly that difference, however well the model repeats the simulator.
The extended model's change of that error is the correction of the simulator's voltage.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.diagnosis.cross_validation import rms
from cangauge.diagnosis.diagnose import Diagnosis, diagnose
from cangauge.diagnosis.verdict import ALARM_BELOW
from cangauge.errors import InputError
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.model_file import Model

CORRECTIONS: Final = {
    "capacity": "change the simulator's capacity by {change_pct:+.3g} %",
    "initial_soc": "start the simulator with {offset_pct:+.3g} % SoC",
    "coulombic_efficiency": "let the simulator count {efficiency:.4g} of the charging current",
    "current_offset": "subtract {offset_a:.3g} A from the current that the simulator is given",
    "current_gain": "divide the current that the simulator is given by {factor:.4g}",
    "voltage_offset": "subtract {offset_v:.3g} V from the measured voltage, not the simulator's",
    "voltage_gain": "divide the measured voltage, not the simulator's, by {factor:.4g}",
    "time_skew": "shift the current that the simulator is given by {skew_s:+.3g} s",
}
"""Effect → what to change in the simulator's inputs or parameters, or in the measurement. The
others add a voltage, by the equation in the model file."""


def start_of(log: Log) -> float:
    """Return the SoC that a simulation of a log starts from [%].

    Raises
    ------
    InputError
        If the log has no reference SoC.
    """
    first = log.first_soc()
    if first is None:
        raise InputError(
            "unknown SoC at the start of the simulation",
            source=log.source or log.name,
            field="soc_pct",
            cure="give a log with soc_pct, or the initial SoC",
        )
    return first[1]


@dataclass(frozen=True, eq=False)
class Run:
    """A measured log and what a simulator made of its current and temperature.

    Parameters
    ----------
    log : Log
        With the SoC that the simulator started from as the first finite value of `soc_pct`.
    simulated_v : array of shape (n,)
        Simulated voltage of each row [V].

    Raises
    ------
    InputError
        If the voltages are not one finite number for each row, or the SoC is unknown.
    """

    log: Log
    simulated_v: FloatArray

    def __post_init__(self) -> None:
        volts = np.asarray(self.simulated_v, dtype=np.float64)
        where = self.log.source or self.log.name
        if volts.shape != self.log.time_s.shape:
            raise InputError(
                f"the simulator returned shape {volts.shape} for {len(self.log)} rows",
                source=where,
                cure="return one voltage [V] for each time",
            )
        bad = np.flatnonzero(~np.isfinite(volts))
        if bad.size:
            raise InputError(
                f"{bad.size} of {volts.size} simulated voltages are not finite, the first in row"
                f" {bad[0] + 1}",
                source=where,
                value=float(volts[bad[0]]),
                cure="end the log before the simulator stops, or simulate it whole",
            )
        start_of(self.log)
        object.__setattr__(self, "simulated_v", volts)

    @property
    def simulated(self) -> Log:
        """Log with the simulated voltage in place of the measured one."""
        return replace(self.log, voltage_v=self.simulated_v)

    def on(self, model: Model) -> Log:
        """Return the log with the voltage of `model` plus the difference of the simulator."""
        predicted = model.predict(self.log)
        gap_v = self.log.voltage_v - self.simulated_v
        return replace(self.log, voltage_v=predicted.voltage_v + gap_v)


@dataclass(frozen=True, eq=False)
class SimulatorDiagnosis:
    """Result of `diagnose_simulator`."""

    diagnosis: Diagnosis
    """Diagnosis of the difference; its model is the one identified on the simulator."""
    runs: tuple[Run, ...]
    """Diagnosed runs."""
    fit_rmse_v: float
    """RMS error of the identified model of the simulator's voltage [V]; it does not enter the gap,
    only the columns."""

    @property
    def correction(self) -> str:
        """What to change in the simulator, in one sentence; "" without a named cause."""
        sentences = []
        for effect_id, values in self.diagnosis.extension.cause.items():
            sentence = CORRECTIONS.get(effect_id, "add the voltage of {effect}")
            factor = 1.0 + values.get("gain_pct", 0.0) / 100.0
            sentences.append(sentence.format(effect=effect_id, factor=factor, **values))
        text = "; ".join(sentences)
        return text and f"To correct the simulator: {text}."

    def corrected_v(self, run: Run) -> FloatArray:
        """Return the simulated voltage with the correction [V], shape (n,).

        A cause in the measured voltage is added to the simulated one, so that the result is to be
        compared with the voltage as measured.
        """
        found = self.diagnosis
        log = run.on(found.model)
        before = found.model.predict(log).residual_v
        start = found.extension.cause.get("initial_soc", {})  # of the log, not of the model
        soc_pct = None if log.soc_pct is None else log.soc_pct + start.get("offset_pct", 0.0)
        after = found.extended_model.predict(replace(log, soc_pct=soc_pct)).residual_v
        return run.simulated_v + (before - after)

    def errors(self) -> list[dict[str, Any]]:
        """Return the RMS error of each diagnosed log, as simulated and corrected [V]."""
        return [
            {
                "name": run.log.name,
                "simulated_rmse_v": rms(run.log.voltage_v - run.simulated_v),
                "corrected_rmse_v": rms(run.log.voltage_v - self.corrected_v(run)),
            }
            for run in self.runs
        ]

    def to_dict(self) -> dict[str, object]:
        """Return what `cangauge gap --json` adds for a simulator."""
        return {
            "fit_rmse_v": self.fit_rmse_v,
            "correction": self.correction,
            "logs": self.errors(),
        }


def diagnose_simulator(
    runs: Sequence[Run],
    references: Sequence[Run] = (),
    *,
    model: Model | None = None,
    capacity_ah: float | None = None,
    alarm_below: float = ALARM_BELOW,
) -> SimulatorDiagnosis:
    """Diagnose the difference between measured voltages and those of a simulator.

    Parameters
    ----------
    runs : sequence of Run
        Runs with a gap, which share one cause.
    references : sequence of Run
        Runs in which the simulator is good.
    model : Model, optional
        Voltage model of the simulator; by default identified on its output in all runs.
    capacity_ah : float, optional
        The simulator's charge from 100 to 0 % [Ah]; by default from a run from full to empty.
    alarm_below : float
        As of `diagnose`.

    Returns
    -------
    SimulatorDiagnosis

    Raises
    ------
    InputError
        As `fit` on the simulated voltages, and as `diagnose`.
    """
    if model is None:
        found = fit([run.simulated for run in (*references, *runs)], capacity_ah=capacity_ah)
        model = found.model
    elif capacity_ah is not None:
        model = model.model_copy(update={"capacity_ah": capacity_ah})
    errors = [run.simulated.voltage_v - model.predict(run.log).voltage_v for run in runs]
    diagnosis = diagnose(
        [run.on(model) for run in runs],
        model,
        [run.on(model) for run in references],
        alarm_below=alarm_below,
    )
    return SimulatorDiagnosis(diagnosis, tuple(runs), rms(np.concatenate(errors)))

"""Inject faults into recorded logs: the change that a fault causes is added to the signals.

For a fault of the pack, the change is the difference that it makes to a surrogate: a pack of the
twin under the recorded current and temperature. A fault of a sensor changes the recorded signal
itself. Only differences between two conditions of the surrogate are used, so its slope over SoC and
its resistance must be accurate, not its voltage.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.optimize import isotonic_regression

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.extras.validation.twin.drive import Drive
from cangauge.extras.validation.twin.faults import Fault, faults_by_id
from cangauge.extras.validation.twin.pack import (
    THERMAL_V,
    TYPICAL,
    CellChemistry,
    Sensors,
    TwinPack,
)
from cangauge.extras.validation.twin.physics import lagged, simulate_truth
from cangauge.extras.validation.twin.recording import (
    measured_current,
    measured_voltage,
    read_drive,
    stepped,
)
from cangauge.logs.gaps import discharged_ah
from cangauge.logs.log import Log

_KNOTS: Final = np.array([0.0, 0.02, 0.05, *np.linspace(0.1, 0.9, 17), 0.95, 1.0])
"""Knots of the surrogate's open-circuit voltage over the SoC [-]."""
_LAGS_S: Final = (20.0, 200.0)
"""Lags of the current whose voltage is not taken for a slope over SoC [s]."""


def drive_of(log: Log, capacity_ah: float) -> Drive:
    """Return a recorded log as a drive on an even grid of 0.1 to 1 s, with its temperature.

    The SoC is the log's reference, or its first value.

    Raises
    ------
    InputError
        If the log has no SoC at all, or is too short.
    """
    if log.duration_s < 60.0:
        problem, source = "too short to show a fault: under 60 s", log.source or log.name
        raise InputError(problem, source=source, value=log.duration_s)
    step_s = float(np.clip(np.median(np.diff(log.time_s)), 0.1, 1.0))
    elapsed_s = log.time_s - log.time_s[0]
    time_s = np.arange(0.0, elapsed_s[-1] + step_s, step_s)
    temperature_c = np.interp(time_s, elapsed_s, log.temperature_c)
    return Drive(
        time_s=time_s,
        current_a=np.interp(time_s, elapsed_s, log.current_a),
        ambient_c=temperature_c,
        start_c=float(temperature_c[0]),
        start_soc=float(soc_of(log, capacity_ah)[0]),
        history=1.0,
        recorded_c=temperature_c,
    )


def soc_of(log: Log, capacity_ah: float) -> FloatArray:
    """Return the SoC of a log [-], shape (n,): its reference SoC, or counted from the first value.

    Raises
    ------
    InputError
        If the log has no SoC at all.
    """
    row, start_pct, soc_pct = _start(log)
    finite = np.isfinite(soc_pct)
    if finite.mean() > 0.5:
        return np.interp(log.time_s, log.time_s[finite], soc_pct[finite] / 100.0)
    taken_ah = discharged_ah(log.time_s, log.current_a)
    return np.asarray(start_pct / 100.0 - (taken_ah - taken_ah[row]) / capacity_ah)


def _start(log: Log) -> tuple[int, float, FloatArray]:
    """Return row and value [%] of the first SoC of a log, and all; InputError without one."""
    first = log.first_soc()
    if first is None or log.soc_pct is None:
        source, cure = log.source or log.name, "give a log with its initial SoC"
        raise InputError("no initial SoC", source=source, field="soc_pct", cure=cure)
    return *first, log.soc_pct


def fit_surrogate_pack(
    logs: Sequence[Log], *, capacity_ah: float, cells: int, name: str = "recorded"
) -> TwinPack:
    """Fit open-circuit voltage and resistance of a pack of the twin to recorded logs.

    Its cells are equal, with typical shares of the resistance, masses and sensors.

    Parameters
    ----------
    logs : sequence of Log
        Healthy logs, at least one, each with a SoC.
    capacity_ah : float
    cells : int
        Cells in series.
    name : str

    Raises
    ------
    InputError
        For a log without a SoC.
    """
    curve_v, pack_ohm = _curve_and_resistance(logs, capacity_ah)
    ohm = pack_ohm / cells
    energy_kwh = cells * 3.7 * capacity_ah / 1000.0
    heat_j_k = energy_kwh * 7000.0
    first = logs[0]
    return TwinPack(
        **TYPICAL,
        name=name,
        chemistry=CellChemistry.tabulated(name, _KNOTS, curve_v / cells, 0.0, "nmc"),
        cells=cells,
        capacity_ah=capacity_ah,
        groups=np.array([[float(cells)], [1.0], [1.0], [0.0]]),
        ohmic_ohm=0.55 * ohm,
        busbar_ohm=0.05 * pack_ohm,
        exchange_a=THERMAL_V / (0.40 * ohm),
        electrolyte_ohm=(0.08 * ohm, 0.07 * ohm),
        solid_swing=(0.012 / capacity_ah, 0.005 / capacity_ah, 0.003 / capacity_ah),
        core_j_k=0.75 * heat_j_k,
        surface_j_k=0.25 * heat_j_k,
        core_surface_w_k=energy_kwh * 7.0,
        surface_ambient_w_k=heat_j_k / 18000.0,
        sensors=Sensors(*map(_resolution, (first.current_a, first.voltage_v, first.temperature_c))),
    )


def _curve_and_resistance(logs: Sequence[Log], capacity_ah: float) -> tuple[FloatArray, float]:
    """Return a pack's open-circuit voltage at `_KNOTS` [V], and its resistance within 20 s [Ω].

    Least squares at 1 Hz on a piecewise linear curve, the current, and its lags.
    """
    rows, volts = [], []
    for log in logs:
        time_s = np.arange(log.time_s[0], log.time_s[-1])
        current = np.interp(time_s, log.time_s, log.current_a)
        soc = np.interp(time_s, log.time_s, soc_of(log, capacity_ah))
        hats = [np.interp(soc, _KNOTS, hat) for hat in np.eye(_KNOTS.size)]
        lags = [lagged(current, 1.0, lag_s) for lag_s in _LAGS_S]
        rows.append(np.column_stack([*hats, -current, *np.negative(lags)]))
        volts.append(np.interp(time_s, log.time_s, log.voltage_v))
    voltage_v = np.concatenate(volts)
    # Second differences regularize the curve where the logs have no data.
    bends = np.diff(np.eye(_KNOTS.size), 2, axis=0) * 0.02 * np.sqrt(voltage_v.size)
    bends = np.pad(bends, ((0, 0), (0, 1 + len(_LAGS_S))))
    solution, *_ = np.linalg.lstsq(
        np.vstack([*rows, bends]), np.concatenate([voltage_v, np.zeros(len(bends))])
    )
    curve_v: FloatArray = isotonic_regression(solution[: _KNOTS.size]).x
    # The slower lag is diffusion, which the surrogate has besides.
    return curve_v, max(float(np.sum(solution[_KNOTS.size : -1])), 1e-4)


def _resolution(values: FloatArray) -> float:
    """Return the coarsest usual resolution of which all values are multiples, else 0."""
    for step in (1.0, 0.5, 0.25, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.001):
        if np.all(np.abs(values / step - np.rint(values / step)) < 1e-5):
            return step
    return 0.0


def inject(log: Log, faults: Sequence[Fault], pack: TwinPack) -> tuple[Log, FloatArray]:
    """Return a log as it would have been recorded with the faults, and the gap they open [V].

    Parameters
    ----------
    log : Log
        Healthy log, at least with its initial SoC.
    faults : sequence of Fault
    pack : TwinPack
        From `fit_surrogate_pack`.

    Raises
    ------
    InputError
        If the log has no SoC or is too short, or a fault is unknown.
    """
    present, sensors = faults_by_id(faults), pack.sensors
    drive = drive_of(log, pack.capacity_ah)
    elapsed_s: FloatArray = log.time_s - log.time_s[0]
    clean = simulate_truth(pack, drive)
    read = read_drive(pack, drive, present, clean)

    def at(signal: FloatArray) -> FloatArray:
        return np.interp(elapsed_s, drive.time_s, signal)

    changed_v = log.voltage_v + at(read.truth.voltage_v - clean.voltage_v)
    changed_v = measured_voltage(present, changed_v)
    expected_v = log.voltage_v + at(read.expected_v - clean.voltage_v)
    changed_a = measured_current(present, elapsed_s, log.current_a)
    row, start_pct, _ = _start(log)
    injected = replace(
        log,
        current_a=stepped(changed_a, sensors.current_step_a),
        voltage_v=stepped(changed_v, sensors.voltage_step_v),
        temperature_c=stepped(log.temperature_c + at(read.shift_k), sensors.temperature_step_k),
        soc_pct=np.where(np.arange(len(log)) == row, start_pct, np.nan),
    )
    return injected, changed_v - expected_v

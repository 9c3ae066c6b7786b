"""Inject faults into recorded logs: the change that a fault causes is added to the signals.

For a fault of the pack, the change is the difference that it makes to a surrogate: a pack of the
twin under the recorded current and temperature. A fault of a sensor changes the recorded signal
itself. Only differences between two conditions of the surrogate are used, so its slope over SoC and
its resistance must be accurate, not its voltage.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.optimize import isotonic_regression

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.extras.validation.twin.drive import Drive
from cangauge.extras.validation.twin.faults import HEALTHY, Fault, Faults, find_size
from cangauge.extras.validation.twin.pack import (
    HIGHEST,
    LOWEST,
    THERMAL_V,
    CellChemistry,
    Sensors,
    TwinPack,
    chemistry,
)
from cangauge.extras.validation.twin.plant import (
    Truth,
    lagged,
    respond,
    temperatures,
    through_cells,
)
from cangauge.extras.validation.twin.recording import (
    expected_voltage,
    measured_current,
    measured_temperature,
    measured_voltage,
    rms,
    stepped,
    true_soc_pct,
)
from cangauge.logs.log import Log

_KNOTS: Final = np.array([0.0, 0.02, 0.05, *np.linspace(0.1, 0.9, 17), 0.95, 1.0])
"""Knots of the surrogate's open-circuit voltage over the SoC [-]."""
_LAGS_S: Final = (20.0, 200.0)
"""Lags of the current whose voltage is not taken for a slope over SoC [s]."""
_SMOOTHNESS: Final = 0.02
"""Weight of the curve's second differences against the voltages."""
_POINTS: Final = 1101
_STEP_S: Final = 1.0
_MIN_DURATION_S: Final = 60.0
_RESOLUTIONS: Final = (1.0, 0.5, 0.25, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.001)


def soc_of(log: Log, capacity_ah: float) -> FloatArray:
    """Return the SoC of a log [-], shape (n,): its reference SoC, or counted from the first value.

    Raises
    ------
    InputError
        If the log has no SoC at all.
    """
    first = log.first_soc()
    if first is None or log.soc_pct is None:
        source, cure = log.source or log.name, "give a log with its initial SoC"
        raise InputError("no initial SoC", source=source, field="soc_pct", cure=cure)
    finite = np.isfinite(log.soc_pct)
    if finite.mean() > 0.5:
        return np.interp(log.time_s, log.time_s[finite], log.soc_pct[finite] / 100.0)
    steps = 0.5 * (log.current_a[1:] + log.current_a[:-1]) * np.diff(log.time_s) / 3600.0
    taken = np.concatenate(([0.0], np.cumsum(steps)))
    row, start_pct = first
    return np.asarray(start_pct / 100.0 - (taken - taken[row]) / capacity_ah)


def fit_surrogate_pack(
    logs: Sequence[Log], *, capacity_ah: float, cells: int, name: str = "recorded"
) -> TwinPack:
    """Fit open-circuit voltage and resistance of a pack of the twin to recorded logs.

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
    rows, volts = [], []
    for log in logs:
        time_s = np.arange(log.time_s[0], log.time_s[-1], _STEP_S)
        current = np.interp(time_s, log.time_s, log.current_a)
        soc = np.interp(time_s, log.time_s, soc_of(log, capacity_ah))
        hats = [np.interp(soc, _KNOTS, hat) for hat in np.eye(_KNOTS.size)]
        lags = [-lagged(current, _STEP_S, lag_s) for lag_s in _LAGS_S]
        rows.append(np.column_stack([*hats, -current, *lags]))
        volts.append(np.interp(time_s, log.time_s, log.voltage_v))
    voltage = np.concatenate(volts)
    # Second differences regularize the curve where the logs have no data.
    bends = np.diff(np.eye(_KNOTS.size), 2, axis=0) * _SMOOTHNESS * np.sqrt(voltage.size)
    bends = np.pad(bends, ((0, 0), (0, 1 + len(_LAGS_S))))
    solution, *_ = np.linalg.lstsq(
        np.vstack([*rows, bends]), np.concatenate([voltage, np.zeros(len(bends))])
    )
    ohm = max(float(np.sum(solution[_KNOTS.size : _KNOTS.size + 2])), 1e-4)
    curve = isotonic_regression(solution[: _KNOTS.size]).x / cells
    return _pack(_chemistry(name, curve), cells, capacity_ah, ohm, logs[0])


def _chemistry(name: str, curve: FloatArray) -> CellChemistry:
    grid = np.linspace(LOWEST, HIGHEST, _POINTS)
    soc = np.concatenate(([-0.06, -0.03], _KNOTS, [1.04]))
    volts = np.concatenate(([curve[0] - 1.2, curve[0] - 0.5], curve, [curve[-1] + 0.1]))
    ocv = np.maximum.accumulate(PchipInterpolator(soc, volts)(grid)) + 1e-6 * grid
    entropy = chemistry("nmc", np.random.default_rng(0)).entropy(grid)
    return CellChemistry(name, grid, ocv, entropy)


def _pack(curve: CellChemistry, cells: int, capacity_ah: float, ohm: float, log: Log) -> TwinPack:
    """Return a pack of equal cells with typical shares of its resistance, masses and sensors."""
    one = ohm / cells
    energy_kwh = cells * 3.7 * capacity_ah / 1000.0
    heat_j_k = energy_kwh * 7000.0
    return TwinPack(
        name=curve.name,
        chemistry=curve,
        cells=cells,
        capacity_ah=capacity_ah,
        weights=np.array([float(cells)]),
        capacity_factor=np.ones(1),
        resistance_factor=np.ones(1),
        soc_shift=np.zeros(1),
        ohmic_ohm=0.55 * one,
        ohmic_vogel_k=240.0,
        busbar_ohm=0.05 * ohm,
        exchange_a=THERMAL_V / (0.40 * one),
        exchange_activation_k=5200.0,
        anodic=0.5,
        double_layer_s=0.1,
        electrolyte_ohm=(0.08 * one, 0.07 * one),
        electrolyte_tau_s=(20.0, 50.0),
        solid_swing=(0.012 / capacity_ah, 0.005 / capacity_ah, 0.003 / capacity_ah),
        solid_tau_s=(60.0, 17.0, 5.0),
        diffusion_activation_k=3000.0,
        core_j_k=0.75 * heat_j_k,
        surface_j_k=0.25 * heat_j_k,
        core_surface_w_k=energy_kwh * 7.0,
        surface_ambient_w_k=heat_j_k / 18000.0,
        sensors=Sensors(
            current_step_a=_resolution(log.current_a),
            voltage_step_v=_resolution(log.voltage_v),
            temperature_step_k=_resolution(log.temperature_c),
        ),
    )


def _resolution(values: FloatArray) -> float:
    """Return the coarsest usual resolution of which all values are multiples, else 0."""
    for step in _RESOLUTIONS:
        if np.all(np.abs(values / step - np.rint(values / step)) < 1e-5):
            return step
    return 0.0


@dataclass(frozen=True, eq=False)
class Injected:
    """A recorded log with an injected fault.

    Parameters
    ----------
    log : Log
        `soc_pct` holds the assumed initial SoC alone.
    gap_v : array of shape (n,)
        Gap that the fault opens to a perfect model of the healthy pack [V].
    true_soc_pct : array of shape (n,)
        SoC with the fault, based on the SoC of the recorded log [%].
    """

    log: Log
    gap_v: FloatArray
    true_soc_pct: FloatArray


def inject(log: Log, faults: Sequence[Fault], pack: TwinPack) -> Injected:
    """Return a recorded log as it would have been recorded with the faults.

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
    if log.duration_s < _MIN_DURATION_S:
        problem, source = f"shorter than {_MIN_DURATION_S:g} s", log.source or log.name
        raise InputError(problem, source=source, value=log.duration_s)
    present, sensors = Faults.of(faults), pack.sensors
    elapsed_s: FloatArray = log.time_s - log.time_s[0]
    soc = soc_of(log, pack.capacity_ah)
    drive, recorded_c = _drive(log, float(soc[0]))

    def at(signal: FloatArray) -> FloatArray:
        return np.interp(elapsed_s, drive.time_s, signal)

    response = respond(pack, drive, HEALTHY, drive.current_a, recorded_c)
    clean = Truth(
        **vars(response), current_a=drive.current_a, core_c=recorded_c, surface_c=recorded_c
    )
    current_a, core_c = through_cells(drive, present), recorded_c
    if insulation := present.size("core_temperature"):
        hot, _ = temperatures(pack, drive, clean.heat_w, insulation)
        cool, _ = temperatures(pack, drive, clean.heat_w)
        core_c = recorded_c + hot - cool
    faulty = respond(pack, drive, present, current_a, core_c)
    shift_k = measured_temperature(pack, present, drive, recorded_c) - recorded_c
    expected_v = expected_voltage(pack, drive, present, clean, shift_k)
    voltage_v = measured_voltage(
        pack, present, elapsed_s, log.voltage_v + at(faulty.voltage_v - clean.voltage_v)
    )
    assumed_pct = np.full(len(log), np.nan)
    if (start := log.first_soc()) is not None:
        assumed_pct[start[0]] = start[1]
    read_a = measured_current(present, elapsed_s, log.current_a)
    injected = replace(
        log,
        current_a=stepped(read_a, sensors.current_step_a),
        voltage_v=stepped(voltage_v, sensors.voltage_step_v),
        temperature_c=stepped(log.temperature_c + at(shift_k), sensors.temperature_step_k),
        soc_pct=assumed_pct,
    )
    moved_pct = true_soc_pct(pack, drive, current_a, present)
    moved_pct = moved_pct - true_soc_pct(pack, drive, drive.current_a)
    return Injected(
        injected,
        gap_v=voltage_v - log.voltage_v - at(expected_v - clean.voltage_v),
        true_soc_pct=100.0 * soc + at(moved_pct),
    )


def scale_injection(log: Log, fault: Fault, target_v: float, pack: TwinPack) -> tuple[Fault, float]:
    """Scale a fault to an RMS gap [V] over a recorded log; its size gives the sign."""

    def gap_of(sized: Fault) -> float:
        return rms(inject(log, [sized], pack).gap_v)

    return find_size(gap_of, fault, target_v, pack)


def _drive(log: Log, start_soc: float) -> tuple[Drive, FloatArray]:
    """Return the recorded log as a drive on an even grid, and its temperature [°C]."""
    step_s = float(np.clip(np.median(np.diff(log.time_s)), 0.1, 1.0))
    elapsed_s = log.time_s - log.time_s[0]
    time_s = np.arange(0.0, elapsed_s[-1] + step_s, step_s)
    temperature_c = np.interp(time_s, elapsed_s, log.temperature_c)
    drive = Drive(
        time_s=time_s,
        current_a=np.interp(time_s, elapsed_s, log.current_a),
        ambient_c=temperature_c,
        start_c=float(temperature_c[0]),
        start_soc=start_soc,
        history=1.0,
    )
    return drive, temperature_c

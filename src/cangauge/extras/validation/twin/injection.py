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
from cangauge.extras.validation.twin.condition import HEALTHY
from cangauge.extras.validation.twin.drive import Drive
from cangauge.extras.validation.twin.faults import Fault, apply_faults
from cangauge.extras.validation.twin.pack import (
    HIGHEST,
    LOWEST,
    CellChemistry,
    Sensors,
    TwinPack,
    chemistry,
)
from cangauge.extras.validation.twin.plant import TwinPlant, discharged, lagged, temperatures
from cangauge.extras.validation.twin.recording import (
    measured_current,
    measured_temperature,
    measured_voltage,
    rms,
)
from cangauge.extras.validation.twin.scaling import ScaledFault, find_size
from cangauge.logs.log import Log

_KNOTS: Final = np.array([0.0, 0.02, 0.05, *np.linspace(0.1, 0.9, 17), 0.95, 1.0])
_LAGS_S: Final = (20.0, 200.0)
_SMOOTHNESS: Final = 0.02
_POINTS: Final = 1101
_STEP_S: Final = 1.0
_MIN_DURATION_S: Final = 60.0


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
        return np.asarray(np.interp(log.time_s, log.time_s[finite], log.soc_pct[finite] / 100.0))
    steps = 0.5 * (log.current_a[1:] + log.current_a[:-1]) * np.diff(log.time_s) / 3600.0
    taken = np.concatenate(([0.0], np.cumsum(steps)))
    row, start = first
    return np.asarray(start / 100.0 - (taken - taken[row]) / capacity_ah, dtype=np.float64)


def fit_surrogate_pack(
    logs: Sequence[Log], *, capacity_ah: float, cells: int, name: str = "recorded"
) -> TwinPack:
    """Fit open-circuit voltage and resistance of a pack of the twin to recorded logs.

    Parameters
    ----------
    logs : sequence of Log
        Healthy logs, each with a SoC.
    capacity_ah : float
    cells : int
        Cells in series.
    name : str

    Raises
    ------
    InputError
        Without a log, or for a log without a SoC.
    """
    if not logs:
        raise InputError("no logs to fit a pack to", cure="give at least one healthy log")
    rows, volts = [], []
    for log in logs:
        time_s = np.arange(log.time_s[0], log.time_s[-1], _STEP_S)
        current = np.interp(time_s, log.time_s, log.current_a)
        soc = np.interp(time_s, log.time_s, soc_of(log, capacity_ah))
        slow = [lagged(current, _STEP_S, lag) for lag in _LAGS_S]
        rows.append(np.column_stack([_hats(soc), -current, *(-item for item in slow)]))
        volts.append(np.interp(time_s, log.time_s, log.voltage_v))
    matrix, voltage = np.vstack(rows), np.concatenate(volts)
    # Second differences regularize the curve where the logs have no data.
    bends = np.zeros((_KNOTS.size - 2, matrix.shape[1]))
    for row in range(_KNOTS.size - 2):
        bends[row, row : row + 3] = (1.0, -2.0, 1.0)
    bends *= _SMOOTHNESS * np.sqrt(voltage.size)
    solution, *_ = np.linalg.lstsq(
        np.vstack([matrix, bends]), np.concatenate([voltage, np.zeros(len(bends))])
    )
    resistance = max(float(np.sum(solution[_KNOTS.size : _KNOTS.size + 2])), 1e-4)
    curve = isotonic_regression(solution[: _KNOTS.size]).x / cells
    return _pack(_chemistry(name, curve), cells, capacity_ah, resistance, logs[0])


def _hats(soc: FloatArray) -> FloatArray:
    """Return the linear interpolation weights of the knots, shape (n, knots)."""
    place = np.clip(soc, 0.0, 1.0)
    right = np.clip(np.searchsorted(_KNOTS, place, side="right"), 1, _KNOTS.size - 1)
    share = (place - _KNOTS[right - 1]) / (_KNOTS[right] - _KNOTS[right - 1])
    result = np.zeros((soc.size, _KNOTS.size))
    rows = np.arange(soc.size)
    result[rows, right - 1] = 1.0 - share
    result[rows, right] = share
    return result


def _chemistry(name: str, curve: FloatArray) -> CellChemistry:
    grid = np.linspace(LOWEST, HIGHEST, _POINTS)
    soc = np.concatenate(([-0.06, -0.03], _KNOTS, [1.04]))
    volts = np.concatenate(([curve[0] - 1.2, curve[0] - 0.5], curve, [curve[-1] + 0.1]))
    ocv = np.maximum.accumulate(PchipInterpolator(soc, volts)(grid)) + 1e-6 * grid
    entropy = chemistry("nmc", np.random.default_rng(0)).entropy(grid)
    return CellChemistry(name, grid, ocv, entropy)


def _pack(
    curve: CellChemistry, cells: int, capacity_ah: float, resistance_ohm: float, log: Log
) -> TwinPack:
    one = resistance_ohm / cells
    heat_j_k = cells * 3.7 * capacity_ah / 1000.0 * 7000.0
    interval = float(np.median(np.diff(log.time_s)))
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
        busbar_ohm=0.05 * resistance_ohm,
        exchange_a=0.02569 / (0.40 * one),
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
        core_surface_w_k=cells * 3.7 * capacity_ah / 1000.0 * 7.0,
        surface_ambient_w_k=heat_j_k / 18000.0,
        sensors=Sensors(
            current_step_a=_step(log.current_a),
            current_noise_a=0.0,
            voltage_step_v=_step(log.voltage_v),
            voltage_noise_v=0.0,
            temperature_step_k=_step(log.temperature_c),
            temperature_lag_s=0.0,
            rate_hz=1.0 / interval,
            jitter=0.0,
            drop_share=0.0,
            start_soc_std_pct=0.0,
        ),
    )


def _step(values: FloatArray) -> float:
    """Return the coarsest usual resolution of which all values are multiples, else 0."""
    for step in (1.0, 0.5, 0.25, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.001):
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


def inject(log: Log, faults: Sequence[Fault], pack: TwinPack, *, seed: int = 0) -> Injected:
    """Return a recorded log as it would have been recorded with the faults.

    Parameters
    ----------
    log : Log
        Healthy log, at least with its initial SoC.
    faults : sequence of Fault
    pack : TwinPack
        From `fit_surrogate_pack`.
    seed : int
        Seed of the initial state of the hysteresis.

    Raises
    ------
    InputError
        If the log has no SoC or is too short, or a fault is unknown.
    """
    if log.duration_s < _MIN_DURATION_S:
        problem, source = f"shorter than {_MIN_DURATION_S:g} s", log.source or log.name
        raise InputError(problem, source=source, value=log.duration_s)
    condition = apply_faults(pack, tuple(faults))
    drive, recorded_c = _drive(log, pack, seed)
    plant = TwinPlant(pack)
    clean = plant.respond(drive, HEALTHY, drive.current_a, recorded_c)
    current = condition.current_through_cells(drive.time_s, drive.current_a)
    core = recorded_c
    if condition.insulation:
        hot, _ = temperatures(pack, drive, clean.heat_w, condition.insulation)
        cool, _ = temperatures(pack, drive, clean.heat_w)
        core = recorded_c + hot - cool
    faulty = plant.respond(drive, condition, current, core)
    changed = _at(log, drive, faulty.voltage_v - clean.voltage_v)
    rows = replace(drive, time_s=log.time_s - log.time_s[0])
    voltage = measured_voltage(condition, rows, log.voltage_v + changed)
    recorded_current = measured_current(condition, rows, log.current_a)
    shift = measured_temperature(pack, condition, drive, recorded_c) - recorded_c
    if recorded_current is log.current_a and not np.any(shift):
        expected = log.voltage_v
    else:
        read_a = measured_current(condition, drive, drive.current_a)
        predicted = plant.respond(drive, HEALTHY, read_a, recorded_c + shift)
        expected = log.voltage_v + _at(log, drive, predicted.voltage_v - clean.voltage_v)
    assumed = np.full(len(log), np.nan)
    if (start := log.first_soc()) is not None:
        assumed[start[0]] = start[1]
    sensors = pack.sensors
    result = replace(
        log,
        current_a=_stepped(recorded_current, sensors.current_step_a),
        voltage_v=_stepped(voltage, sensors.voltage_step_v),
        temperature_c=_stepped(
            log.temperature_c + _at(log, drive, shift), sensors.temperature_step_k
        ),
        soc_pct=assumed,
    )
    taken = discharged(drive, current, condition.charge_loss) / pack.capacity_ah
    healthy = discharged(drive, drive.current_a) / pack.capacity_ah
    away = condition.start_soc_shift + healthy - taken / condition.capacity_factor
    true_soc = 100.0 * (soc_of(log, pack.capacity_ah) + _at(log, drive, away))
    return Injected(result, voltage - expected, true_soc)


def scale_injection(
    logs: Sequence[Log], fault: Fault, target_v: float, pack: TwinPack, *, seed: int = 0
) -> ScaledFault:
    """Scale a fault to an RMS gap [V] over recorded logs; its size gives the sign."""

    def gap_of(sized: Fault) -> float:
        gaps = [inject(log, (sized,), pack, seed=seed).gap_v for log in logs]
        return rms(np.concatenate(gaps))

    return find_size(gap_of, fault, target_v, fault.kind.limits(pack))


def _drive(log: Log, pack: TwinPack, seed: int) -> tuple[Drive, FloatArray]:
    """Return the recorded log as a drive on an even grid, and its temperature [°C]."""
    step = float(np.clip(np.median(np.diff(log.time_s)), 0.1, 1.0))
    elapsed = log.time_s - log.time_s[0]
    time_s = np.arange(0.0, elapsed[-1] + step, step)
    temperature_c = np.interp(time_s, elapsed, log.temperature_c)
    rng = np.random.default_rng(seed)
    drive = Drive(
        time_s=time_s,
        current_a=np.interp(time_s, elapsed, log.current_a),
        ambient_c=temperature_c,
        start_c=float(temperature_c[0]),
        start_soc=float(soc_of(log, pack.capacity_ah)[0]),
        history=float(rng.choice((-1.0, 1.0))),
        seed=seed,
    )
    return drive, temperature_c


def _at(log: Log, drive: Drive, signal: FloatArray) -> FloatArray:
    moved: FloatArray = np.interp(log.time_s - log.time_s[0], drive.time_s, signal)
    return moved


def _stepped(values: FloatArray, step: float) -> FloatArray:
    if step == 0.0:
        return values
    return np.asarray(np.round(np.round(values / step) * step, 9), dtype=np.float64)

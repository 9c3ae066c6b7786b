"""From a plant and a drive to a recorded log: ground truth, sensors and their errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.extras.validation.twin.condition import HEALTHY, Condition
from cangauge.extras.validation.twin.drive import Drive
from cangauge.extras.validation.twin.faults import Fault, apply_faults
from cangauge.extras.validation.twin.pack import KELVIN, Sensors, TwinPack
from cangauge.extras.validation.twin.plant import (
    Plant,
    discharged,
    lagged,
    ohmic_factor,
    temperatures,
)
from cangauge.logs.log import Log

_MAX_JITTER: Final = 0.3
_MAX_ITERATIONS: Final = 5
_SAME_TEMPERATURE: Final = 0.2
"""Temperature changes below this fraction of the plant's tolerance leave the voltage as it is."""
_EMPTY_V: Final = {"lfp": 1.8, "other": 2.2}
_SOC_STEP_PCT: Final = 0.1
_TIME_DECIMALS: Final = 4


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """True signals of a pack on the grid of a drive, shape (n,) each.

    Parameters
    ----------
    time_s, current_a, voltage_v, core_c, surface_c, soc, equilibrium_v, heat_w : array
        As in `Response`, and core and surface temperature [°C].
    rows : int
        Rows until the lowest cell is empty and the car stops.
    measured_current_a, measured_voltage_v, measured_temperature_c : array
        Readings of the sensors with their faults, without noise, quantization and lost samples.
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
    measured_current_a: FloatArray
    measured_voltage_v: FloatArray
    measured_temperature_c: FloatArray


@dataclass(frozen=True, eq=False)
class Recording:
    """A recorded log with its ground truth at the log's rows.

    Parameters
    ----------
    log : Log
        `soc_pct` holds the assumed initial SoC in the first row, NaN elsewhere.
    sensor_error_v : array of shape (n,)
        Voltage error of a perfect model by noise, quantization and the assumed initial SoC [V].
    true_soc_pct : array of shape (n,)
        True SoC [%].
    expected_voltage_v : array of shape (n,)
        Prediction of a perfect model of the healthy pack from the measured signals [V].
    gap_v : array of shape (n,)
        Measured minus expected voltage, without noise [V].
    """

    log: Log
    sensor_error_v: FloatArray
    true_soc_pct: FloatArray
    expected_voltage_v: FloatArray
    gap_v: FloatArray


def simulate_truth(
    plant: Plant, drive: Drive, condition: Condition = HEALTHY, near: GroundTruth | None = None
) -> GroundTruth:
    """Simulate a drive of a pack in a condition.

    Temperature and voltage are coupled by the heat: a fixed-point iteration runs until the core
    temperature changes by less than the plant's tolerance.

    Parameters
    ----------
    plant : Plant
    drive : Drive
    condition : Condition
    near : GroundTruth, optional
        The same drive in another condition, as the start of the iteration. Within the tolerance
        its temperatures are kept, so that the voltages differ by the condition alone.
    """
    pack = plant.pack
    current = condition.current_through_cells(drive.time_s, drive.current_a)
    if near is None:
        kelvin = np.full_like(current, drive.start_c + KELVIN)
        heat = pack.resistance_ohm * 1.3 * ohmic_factor(pack, kelvin) * current**2
        core, surface = temperatures(pack, drive, heat, condition.insulation)
    else:
        core, surface = near.core_c, near.surface_c
    response = plant.respond(drive, condition, current, core)
    for _ in range(_MAX_ITERATIONS):
        next_core, next_surface = temperatures(pack, drive, response.heat_w, condition.insulation)
        if float(np.max(np.abs(next_core - core))) < plant.temperature_tolerance_k:
            break
        core, surface = next_core, next_surface
        response = plant.respond(drive, condition, current, core)
    empty_v = _EMPTY_V["lfp" if pack.chemistry.name == "lfp" else "other"]
    empty = np.flatnonzero(response.lowest_v < empty_v)
    return GroundTruth(
        time_s=drive.time_s,
        current_a=current,
        voltage_v=response.voltage_v,
        core_c=core,
        surface_c=surface,
        soc=response.soc,
        equilibrium_v=response.equilibrium_v,
        heat_w=response.heat_w,
        rows=int(empty[0]) if empty.size else current.size,
        measured_current_a=measured_current(condition, drive, drive.current_a),
        measured_voltage_v=measured_voltage(condition, drive, response.voltage_v),
        measured_temperature_c=measured_temperature(pack, condition, drive, surface),
    )


def expected_voltage(
    plant: Plant, drive: Drive, truth: GroundTruth, healthy: GroundTruth
) -> FloatArray:
    """Return the voltage that a perfect model of the healthy pack predicts [V], shape (n,).

    Its inputs are the measured current, the measured temperature (plus the healthy difference
    between core and sensor) and the assumed initial SoC.

    Parameters
    ----------
    plant : Plant
    drive : Drive
    truth : GroundTruth
        With the fault.
    healthy : GroundTruth
        The same drive without it.
    """
    same_current = np.array_equal(truth.measured_current_a, drive.current_a)
    shift = truth.measured_temperature_c - healthy.measured_temperature_c
    if (
        same_current
        and float(np.max(np.abs(shift))) < _SAME_TEMPERATURE * plant.temperature_tolerance_k
    ):
        return healthy.voltage_v
    core = healthy.core_c + shift
    return plant.respond(drive, HEALTHY, truth.measured_current_a, core).voltage_v


def gap_v(plant: Plant, drive: Drive, truth: GroundTruth, healthy: GroundTruth) -> FloatArray:
    """Return measured minus expected voltage, without noise [V], shape (truth.rows,)."""
    gap = truth.measured_voltage_v - expected_voltage(plant, drive, truth, healthy)
    return gap[: truth.rows]


def record_drive(
    plant: Plant,
    drive: Drive,
    faults: Sequence[Fault],
    *,
    name: str = "log",
    healthy: GroundTruth | None = None,
) -> Recording:
    """Simulate and record a drive with faults; the noise follows `drive.seed`.

    Parameters
    ----------
    plant : Plant
    drive : Drive
    faults : sequence of Fault
    name : str
        Name of the log.
    healthy : GroundTruth, optional
        The same drive without faults, if it is known already.
    """
    pack, condition = plant.pack, apply_faults(plant.pack, tuple(faults))
    clean = simulate_truth(plant, drive) if healthy is None else healthy
    truth = clean if condition is HEALTHY else simulate_truth(plant, drive, condition, clean)
    expected_v = expected_voltage(plant, drive, truth, clean)
    rng = np.random.default_rng(drive.seed)
    sampling = _Sampling(pack.sensors, drive.time_s, truth.rows, rng)
    current = sampling.current(truth.measured_current_a)
    voltage = sampling.voltage(truth.measured_voltage_v)
    temperature = sampling.temperature(truth.measured_temperature_c)
    error_pct = float(rng.normal(0.0, pack.sensors.start_soc_std_pct))
    assumed_pct = min(100.0, 100.0 * drive.start_soc + error_pct)
    assumed_pct = round(round(assumed_pct / _SOC_STEP_PCT) * _SOC_STEP_PCT, 6)
    soc_pct = np.full(sampling.time_s.size, np.nan)
    soc_pct[0] = assumed_pct
    log = Log(
        sampling.time_s,
        current,
        voltage,
        temperature,
        soc_pct,
        name=name,
        temperature_source="pack",
    )
    kelvin = sampling.at(truth.core_c) + KELVIN
    resistance = pack.resistance_ohm * ohmic_factor(pack, kelvin)
    true_soc = sampling.at(true_soc_pct(pack, drive, truth, condition))
    start_error = assumed_pct / 100.0 - drive.start_soc
    chemistry = pack.chemistry
    soc_error_v = pack.cells * (
        chemistry.ocv(true_soc / 100.0 + start_error) - chemistry.ocv(true_soc / 100.0)
    )
    error = voltage - sampling.at(truth.measured_voltage_v) - soc_error_v
    error += resistance * (current - sampling.at(truth.measured_current_a))
    return Recording(
        log=log,
        sensor_error_v=error,
        true_soc_pct=true_soc,
        expected_voltage_v=sampling.at(expected_v),
        gap_v=sampling.at(truth.measured_voltage_v - expected_v),
    )


def true_soc_pct(
    pack: TwinPack, drive: Drive, truth: GroundTruth, condition: Condition
) -> FloatArray:
    """Return the true SoC relative to the true mean capacity [%], shape (n,)."""
    charge = discharged(drive, truth.current_a, condition.charge_loss)
    capacity = pack.capacity_ah * condition.capacity_factor
    return 100.0 * (drive.start_soc + condition.start_soc_shift - charge / capacity)


def rms(values: FloatArray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def measured_current(condition: Condition, drive: Drive, current_a: FloatArray) -> FloatArray:
    """Return the current that a sensor without noise reports [A], shape (n,)."""
    measured = current_a
    if condition.current_skew_s:
        measured = np.interp(drive.time_s - condition.current_skew_s, drive.time_s, measured)
    if condition.remanence_a:
        reach = 0.25 * float(np.max(np.abs(measured)))
        measured = measured + condition.remanence_a * _stop(measured, reach) / reach
    if condition.current_gain or condition.current_offset_a:
        measured = (1.0 + condition.current_gain) * measured + condition.current_offset_a
    if condition.clip_share < 1.0:
        limit = condition.clip_share * float(np.max(np.abs(measured)))
        measured = np.clip(measured, -limit, limit)
    return measured


def measured_voltage(condition: Condition, drive: Drive, voltage_v: FloatArray) -> FloatArray:
    """Return the voltage that a sensor without noise reports [V], shape (n,)."""
    measured = voltage_v
    if condition.voltage_gain or condition.voltage_offset_v:
        measured = (1.0 + condition.voltage_gain) * measured + condition.voltage_offset_v
    if condition.ripple_v:
        phase = 2.0 * np.pi * measured / condition.ripple_period_v + condition.ripple_phase
        measured = measured + condition.ripple_v * np.sin(phase)
    if condition.bursts is not None:
        noise = np.random.default_rng(condition.bursts.seed + 1).normal(0.0, 1.0, measured.size)
        measured = measured + condition.bursts.size * noise * condition.bursts.is_active(
            drive.time_s
        )
    if condition.stale is not None:
        held = condition.stale.is_active(drive.time_s)
        last = np.maximum.accumulate(np.where(held, 0, np.arange(measured.size)))
        measured = measured[last]
    return measured


def measured_temperature(
    pack: TwinPack, condition: Condition, drive: Drive, surface_c: FloatArray
) -> FloatArray:
    """Return the temperature that a sensor without noise reports [°C], shape (n,)."""
    measured = lagged(surface_c, drive.step_s, pack.sensors.temperature_lag_s)
    # Two equal lags in series: a sensor in a pocket.
    for _ in range(2):
        measured = lagged(measured, drive.step_s, 0.5 * condition.temperature_lag_s)
    if condition.temperature_hold:
        measured = measured + condition.temperature_hold * (measured[0] - measured)
    return measured + condition.temperature_offset_k


def _stop(signal: FloatArray, reach: float) -> FloatArray:
    """Return the stop operator of a signal: it follows until it has moved by `reach`."""
    result = np.empty_like(signal)
    state = 0.0
    result[0] = state
    for row, moved in enumerate(np.diff(signal).tolist(), start=1):
        state = min(max(state + moved, -reach), reach)
        result[row] = state
    return result


class _Sampling:
    """Sampling of one log: times with jitter and losses, noise, quantization."""

    def __init__(
        self, sensors: Sensors, time_s: FloatArray, rows: int, rng: np.random.Generator
    ) -> None:
        self._sensors = sensors
        self._rng = rng
        self._grid_s = time_s
        period = 1.0 / sensors.rate_hz
        ticks = np.arange(0.0, time_s[rows - 1], period)
        spread = np.clip(sensors.jitter * rng.normal(size=ticks.size), -_MAX_JITTER, _MAX_JITTER)
        keep = rng.random(ticks.size) >= sensors.drop_share
        keep[0] = True
        self.time_s: FloatArray = np.maximum(ticks + period * spread, 0.0)[keep]
        self.time_s = np.round(self.time_s, _TIME_DECIMALS)

    def current(self, signal: FloatArray) -> FloatArray:
        return self._converted(signal, self._sensors.current_noise_a, self._sensors.current_step_a)

    def voltage(self, signal: FloatArray) -> FloatArray:
        return self._converted(signal, self._sensors.voltage_noise_v, self._sensors.voltage_step_v)

    def temperature(self, signal: FloatArray) -> FloatArray:
        step = self._sensors.temperature_step_k
        return self._converted(signal, 0.1 * step, step)

    def at(self, signal: FloatArray) -> FloatArray:
        """Return a signal at the sampling times."""
        return np.interp(self.time_s, self._grid_s, signal)

    def _converted(self, signal: FloatArray, noise: float, step: float) -> FloatArray:
        values = self.at(signal) + self._rng.normal(0.0, noise, self.time_s.size)
        return np.round(np.round(values / step) * step, 9)

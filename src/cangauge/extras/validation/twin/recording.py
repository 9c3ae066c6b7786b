"""From a drive to a recorded log: the sensors with their faults, noise, quantization and losses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.extras.validation.twin.drive import Drive
from cangauge.extras.validation.twin.faults import HEALTHY, Fault, Faults, find_size
from cangauge.extras.validation.twin.pack import KELVIN, Sensors, TwinPack
from cangauge.extras.validation.twin.plant import (
    TOLERANCE_K,
    Truth,
    discharged,
    lagged,
    ohmic_factor,
    respond,
    simulate_truth,
    start_soc,
    stopped,
)
from cangauge.logs.log import Log

_MAX_JITTER: Final = 0.3
"""Largest deviation of a sampling instant, in sampling periods."""
_SOC_STEP_PCT: Final = 0.1
_TIME_DECIMALS: Final = 4
_SAME_TEMPERATURE_K: Final = 0.2 * TOLERANCE_K
"""Errors of the temperature below this leave the expected voltage as it is."""
_MIN_DURATION_S: Final = 900.0
"""A size that ends a drive before this, or before its half, is impossible."""


@dataclass(frozen=True, eq=False)
class Recording:
    """A recorded log with its ground truth at the log's rows.

    Parameters
    ----------
    log : Log
        `soc_pct` holds the assumed initial SoC in the first row, NaN elsewhere.
    assumed_start_pct : float
        Assumed initial SoC [%].
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
    assumed_start_pct: float
    sensor_error_v: FloatArray
    true_soc_pct: FloatArray
    expected_voltage_v: FloatArray
    gap_v: FloatArray


@dataclass(frozen=True, eq=False)
class Readings:
    """What the sensors of a drive read without noise, and what is true, shape (n,) each.

    `expected_v` is the voltage that a perfect model of the healthy pack predicts [V], given the
    measured current, the measured temperature (plus the healthy difference between core and
    sensor) and the assumed initial SoC.
    """

    truth: Truth
    current_a: FloatArray
    voltage_v: FloatArray
    temperature_c: FloatArray
    expected_v: FloatArray

    @property
    def gap_v(self) -> FloatArray:
        """Measured minus expected voltage [V]."""
        return self.voltage_v - self.expected_v


def read_drive(
    pack: TwinPack, drive: Drive, faults: Faults = HEALTHY, healthy: Truth | None = None
) -> Readings:
    """Simulate a drive with faults and read its sensors; `healthy` is the drive without."""
    clean = simulate_truth(pack, drive) if healthy is None else healthy
    truth = simulate_truth(pack, drive, faults, clean) if faults else clean
    temperature_c = measured_temperature(pack, faults, drive, truth.surface_c)
    shift_k = temperature_c - measured_temperature(pack, HEALTHY, drive, clean.surface_c)
    return Readings(
        truth=truth,
        current_a=measured_current(faults, drive.time_s, drive.current_a),
        voltage_v=measured_voltage(pack, faults, drive.time_s, truth.voltage_v),
        temperature_c=temperature_c,
        expected_v=expected_voltage(pack, drive, faults, clean, shift_k),
    )


def expected_voltage(
    pack: TwinPack, drive: Drive, faults: Faults, clean: Truth, shift_k: FloatArray
) -> FloatArray:
    """Return the voltage that a perfect model of the healthy pack predicts [V], shape (n,).

    Parameters
    ----------
    pack : TwinPack
    drive : Drive
    faults : Faults
        Of the sensors, by which the model reads the current.
    clean : Truth
        The healthy pack in this drive.
    shift_k : array of shape (n,)
        Error of the temperature that the model reads [K].
    """
    read_a = measured_current(faults, drive.time_s, drive.current_a)
    if np.array_equal(read_a, drive.current_a) and np.max(np.abs(shift_k)) < _SAME_TEMPERATURE_K:
        return clean.voltage_v
    return respond(pack, drive, HEALTHY, read_a, clean.core_c + shift_k).voltage_v


def scale_to_gap(
    pack: TwinPack, drive: Drive, fault: Fault, target_v: float, healthy: Truth
) -> tuple[Fault, float]:
    """Scale a fault to an RMS gap [V] over a drive, within its physical limits.

    The size of `fault` gives the sign; `healthy` is the drive without it.
    """

    def gap_of(sized: Fault) -> float:
        read = read_drive(pack, drive, Faults.of([sized]), healthy)
        if read.truth.rows * drive.step_s < min(_MIN_DURATION_S, 0.5 * drive.time_s[-1]):
            return float("inf")
        return rms(read.gap_v[: read.truth.rows])

    return find_size(gap_of, fault, target_v, pack)


def record_drive(
    pack: TwinPack,
    drive: Drive,
    faults: Sequence[Fault] = (),
    *,
    name: str = "log",
    healthy: Truth | None = None,
) -> Recording:
    """Simulate and record a drive with faults; the noise follows `drive.seed`.

    Parameters
    ----------
    pack : TwinPack
    drive : Drive
    faults : sequence of Fault
    name : str
        Name of the log.
    healthy : Truth, optional
        The same drive without faults, if it is known already.
    """
    present, sensors, rng = Faults.of(faults), pack.sensors, np.random.default_rng(drive.seed)
    read = read_drive(pack, drive, present, healthy)
    time_s = _sampling_times(sensors, float(drive.time_s[read.truth.rows - 1]), rng)

    def at(signal: FloatArray) -> FloatArray:
        return np.interp(time_s, drive.time_s, signal)

    clean_a, clean_v, kelvin = (
        at(read.current_a),
        at(read.voltage_v),
        at(read.truth.core_c) + KELVIN,
    )
    step_k = sensors.temperature_step_k
    current = _sampled(rng, clean_a, sensors.current_noise_a, sensors.current_step_a)
    voltage = _sampled(rng, clean_v, sensors.voltage_noise_v, sensors.voltage_step_v)
    temperature = _sampled(rng, at(read.temperature_c), 0.1 * step_k, step_k)
    error_pct = rng.normal(0.0, sensors.start_soc_std_pct)
    assumed_pct = min(100.0, 100.0 * drive.start_soc + error_pct)
    assumed_pct = round(round(assumed_pct / _SOC_STEP_PCT) * _SOC_STEP_PCT, 6)
    soc_pct = np.full(time_s.size, np.nan)
    soc_pct[0] = assumed_pct
    true_soc = at(true_soc_pct(pack, drive, read.truth.current_a, present))
    start_error, ocv = assumed_pct / 100.0 - drive.start_soc, pack.chemistry.ocv
    error_v = voltage - clean_v
    error_v -= pack.cells * (ocv(true_soc / 100.0 + start_error) - ocv(true_soc / 100.0))
    error_v += pack.resistance_ohm * ohmic_factor(pack, kelvin) * (current - clean_a)
    return Recording(
        log=Log(
            time_s, current, voltage, temperature, soc_pct, name=name, temperature_source="pack"
        ),
        assumed_start_pct=assumed_pct,
        sensor_error_v=error_v,
        true_soc_pct=true_soc,
        expected_voltage_v=at(read.expected_v),
        gap_v=at(read.gap_v),
    )


def _sampling_times(sensors: Sensors, end_s: float, rng: np.random.Generator) -> FloatArray:
    """Return the instants of a log's rows [s], with jitter and losses."""
    period_s = 1.0 / sensors.rate_hz
    ticks = np.arange(0.0, end_s, period_s)
    spread = np.clip(sensors.jitter * rng.normal(size=ticks.size), -_MAX_JITTER, _MAX_JITTER)
    keep = rng.random(ticks.size) >= sensors.drop_share
    keep[0] = True
    times_s: FloatArray = np.maximum(ticks + period_s * spread, 0.0)[keep]
    return np.round(times_s, _TIME_DECIMALS)


def _sampled(rng: np.random.Generator, signal: FloatArray, noise: float, step: float) -> FloatArray:
    return stepped(signal + rng.normal(0.0, noise, signal.size), step)


def stepped(values: FloatArray, step: float) -> FloatArray:
    """Return values in a resolution, 0 for none."""
    if step == 0.0:
        return values
    return np.asarray(np.round(np.round(values / step) * step, 9), dtype=np.float64)


def true_soc_pct(
    pack: TwinPack, drive: Drive, current_a: FloatArray, faults: Faults = HEALTHY
) -> FloatArray:
    """Return the true SoC relative to the true mean capacity [%], shape (n,)."""
    capacity_ah = pack.capacity_ah * (1.0 - faults.size("capacity"))
    return 100.0 * (start_soc(drive, faults) - discharged(drive, faults, current_a) / capacity_ah)


def rms(values: FloatArray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def measured_current(faults: Faults, time_s: FloatArray, current_a: FloatArray) -> FloatArray:
    """Return the current that a sensor without noise reports [A], shape (n,)."""
    measured = np.interp(time_s - faults.size("time_skew"), time_s, current_a)
    if remanence_a := faults.size("current_remanence"):
        reach = 0.25 * float(np.max(np.abs(measured)))
        measured = measured + remanence_a * stopped(measured, reach) / reach
    measured = (1.0 + faults.size("current_gain")) * measured + faults.size("current_offset")
    limit = (1.0 - faults.size("current_clipping")) * float(np.max(np.abs(measured)))
    return np.clip(measured, -limit, limit)


def measured_voltage(
    pack: TwinPack, faults: Faults, time_s: FloatArray, voltage_v: FloatArray
) -> FloatArray:
    """Return the voltage that a sensor without noise reports [V], shape (n,)."""
    measured = (1.0 + faults.size("voltage_gain")) * voltage_v + faults.size("voltage_offset")
    if (wave := faults.get("voltage_nonlinearity")) is not None:
        shape = wave.full_shape()
        period_v = shape["period_share"] * pack.nominal_v
        measured = measured + wave.size * np.sin(2.0 * np.pi * measured / period_v + shape["phase"])
    if (bursts := faults.get("noise_bursts")) is not None:
        noise = np.random.default_rng(bursts.seed + 1).normal(0.0, 1.0, measured.size)
        measured = measured + bursts.size * noise * bursts.is_active(time_s)
    if (stale := faults.get("stale_frames")) is not None:
        held = stale.is_active(time_s)
        measured = measured[np.maximum.accumulate(np.where(held, 0, np.arange(held.size)))]
    return measured


def measured_temperature(
    pack: TwinPack, faults: Faults, drive: Drive, surface_c: FloatArray
) -> FloatArray:
    """Return the temperature that a sensor without noise reports [°C], shape (n,)."""
    measured = lagged(surface_c, drive.step_s, pack.sensors.temperature_lag_s)
    # Two equal lags in series: a sensor in a pocket.
    for _ in range(2):
        measured = lagged(measured, drive.step_s, 0.5 * faults.size("temperature_lag"))
    held = faults.size("temperature_stuck") * (measured[0] - measured)
    return np.asarray(measured + held + faults.size("temperature_offset"))

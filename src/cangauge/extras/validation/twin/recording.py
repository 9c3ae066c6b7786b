"""From a drive to a recorded log: the sensors with their faults, noise, quantization and losses.

A recorded log is a drive too, whose temperatures are known: see `injection`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Final

import numpy as np
from scipy.optimize import brentq

from cangauge._typing import FloatArray
from cangauge.extras.validation.twin.drive import Drive
from cangauge.extras.validation.twin.faults import (
    HEALTHY,
    Fault,
    Faults,
    faults_by_id,
    size_of,
)
from cangauge.extras.validation.twin.pack import Sensors, TwinPack
from cangauge.extras.validation.twin.physics import (
    TOLERANCE_K,
    Response,
    lagged,
    respond,
    simulate_truth,
)
from cangauge.logs.log import Log

_TOLERANCE: Final = 0.03
"""Relative error of the gap at which the search for a size stops [-]."""


@dataclass(frozen=True, eq=False)
class Recording:
    """A recorded log with its ground truth at the log's rows.

    Parameters
    ----------
    log : Log
        `soc_pct` holds the assumed initial SoC alone, NaN elsewhere.
    assumed_start_pct : float
        Assumed initial SoC [%].
    true_soc_pct : array of shape (n,)
        True SoC, relative to the true mean capacity [%].
    expected_voltage_v : array of shape (n,)
        Prediction of a perfect model of the healthy pack from the measured signals [V].
    gap_v : array of shape (n,)
        Measured minus expected voltage, without noise [V].
    """

    log: Log
    assumed_start_pct: float
    true_soc_pct: FloatArray
    expected_voltage_v: FloatArray
    gap_v: FloatArray


@dataclass(frozen=True, eq=False)
class Readings:
    """What the sensors of a drive read without noise, and what is true, shape (n,) each.

    `expected_v` is the voltage that a perfect model of the healthy pack predicts [V], given the
    measured current, the measured temperature (plus the healthy difference between core and
    sensor) and the assumed initial SoC. `shift_k` is the error of the temperature by faults [K].
    """

    truth: Response
    current_a: FloatArray
    voltage_v: FloatArray
    temperature_c: FloatArray
    shift_k: FloatArray
    expected_v: FloatArray

    @property
    def gap_v(self) -> FloatArray:
        """Measured minus expected voltage [V]."""
        return self.voltage_v - self.expected_v


def read_drive(pack: TwinPack, drive: Drive, faults: Faults, clean: Response) -> Readings:
    """Simulate a drive with faults and read its sensors; `clean` is the drive without."""
    truth = simulate_truth(pack, drive, faults, clean) if faults else clean
    current_a = measured_current(faults, drive.time_s, drive.current_a)
    temperature_c = measured_temperature(pack, faults, drive, truth.surface_c)
    shift_k = temperature_c - measured_temperature(pack, HEALTHY, drive, clean.surface_c)
    expected = clean
    # What the thermal iteration leaves open is no error of the temperature.
    if np.max(np.abs(shift_k)) >= 0.2 * TOLERANCE_K or np.any(current_a != drive.current_a):
        seen = replace(drive, current_a=current_a)
        expected = respond(pack, seen, HEALTHY, clean.core_c + shift_k, clean.surface_c)
    return Readings(
        truth=truth,
        current_a=current_a,
        voltage_v=measured_voltage(faults, truth.voltage_v),
        temperature_c=temperature_c,
        shift_k=shift_k,
        expected_v=expected.voltage_v,
    )


def scale_to_gap(
    pack: TwinPack, drive: Drive, fault: Fault, target_v: float
) -> tuple[Fault, float]:
    """Return a fault of the size that opens the wanted RMS gap over a drive, and that gap.

    Where the physical limits of the size do not allow the wanted gap, it is the nearest.

    Parameters
    ----------
    pack : TwinPack
    drive : Drive
    fault : Fault
        Its size gives the sign.
    target_v : float
        RMS gap [V].
    """
    healthy = simulate_truth(pack, drive)
    # A size that empties the pack sooner than in a quarter of an hour, or the half, is impossible.
    least_s = min(900.0, 0.5 * float(drive.time_s[-1]))
    low, high = map(math.log, fault.kind.limits(pack))
    tried: list[tuple[float, float, float]] = []

    @cache  # brentq begins at both ends again
    def excess(log_size: float) -> float:
        """Return the logarithm of gap over target, 0 within the tolerance."""
        sized = replace(fault, size=math.copysign(math.exp(log_size), fault.size))
        read = read_drive(pack, drive, faults_by_id([sized]), healthy)
        rows = read.truth.rows
        if rows * drive.step_s < least_s:
            return high - low
        gap_v = rms(read.gap_v[:rows])
        level = math.log(max(gap_v, 1e-9) / target_v)
        tried.append((abs(level), sized.size, gap_v))
        return 0.0 if abs(level) < _TOLERANCE else level

    if excess(high) > 0.0 > excess(low):
        brentq(excess, low, high, xtol=0.1 * _TOLERANCE)
    _, size, gap_v = min(tried, default=(0.0, 0.0, 0.0))
    return replace(fault, size=size), gap_v


def record_drive(
    pack: TwinPack,
    drive: Drive,
    faults: Sequence[Fault] = (),
    *,
    name: str = "log",
) -> Recording:
    """Simulate and record a drive with faults; the noise follows `drive.seed`.

    Parameters
    ----------
    pack : TwinPack
    drive : Drive
    faults : sequence of Fault
    name : str
        Name of the log.
    """
    sensors, rng = pack.sensors, np.random.default_rng(drive.seed)
    read = read_drive(pack, drive, faults_by_id(faults), simulate_truth(pack, drive))
    time_s = _sampling_times(sensors, float(drive.time_s[read.truth.rows - 1]), rng)

    def at(signal: FloatArray) -> FloatArray:
        return np.interp(time_s, drive.time_s, signal)

    def sampled(signal: FloatArray, noise: float, step: float) -> FloatArray:
        return stepped(at(signal) + rng.normal(0.0, noise, time_s.size), step)

    current_a = sampled(read.current_a, sensors.current_noise_a, sensors.current_step_a)
    voltage_v = sampled(read.voltage_v, sensors.voltage_noise_v, sensors.voltage_step_v)
    step_k = sensors.temperature_step_k
    temperature_c = sampled(read.temperature_c, 0.1 * step_k, step_k)
    known_pct = 100.0 * drive.start_soc + rng.normal(0.0, sensors.start_soc_std_pct)
    assumed_pct = round(min(100.0, known_pct), 1)
    soc_pct = np.full(time_s.size, np.nan)
    soc_pct[0] = assumed_pct
    log = Log(
        time_s,
        current_a,
        voltage_v,
        temperature_c,
        soc_pct,
        name=name,
        temperature_source="pack",
    )
    return Recording(
        log=log,
        assumed_start_pct=assumed_pct,
        true_soc_pct=100.0 * at(read.truth.soc),
        expected_voltage_v=at(read.expected_v),
        gap_v=at(read.gap_v),
    )


def _sampling_times(sensors: Sensors, end_s: float, rng: np.random.Generator) -> FloatArray:
    """Return the instants of a log's rows [s], with jitter and losses."""
    period_s = 1.0 / sensors.rate_hz
    ticks_s = np.arange(0.0, end_s, period_s)
    late = np.clip(sensors.jitter * rng.normal(size=ticks_s.size), -0.3, 0.3)
    keep = rng.random(ticks_s.size) >= sensors.drop_share
    keep[0] = True
    times_s: FloatArray = np.maximum(ticks_s + period_s * late, 0.0)[keep]
    return np.round(times_s, 4)


def stepped(values: FloatArray, step: float) -> FloatArray:
    """Return values in a resolution, 0 for none."""
    return np.asarray(np.round(np.round(values / step) * step, 9)) if step else values


def rms(values: FloatArray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


# --- Sensors without noise


def measured_current(faults: Faults, time_s: FloatArray, current_a: FloatArray) -> FloatArray:
    """Return the current that a sensor reports [A], shape (n,)."""
    measured = np.interp(time_s - size_of(faults, "time_skew"), time_s, current_a)
    return (1.0 + size_of(faults, "current_gain")) * measured + size_of(faults, "current_offset")


def measured_voltage(faults: Faults, voltage_v: FloatArray) -> FloatArray:
    """Return the voltage that a sensor reports [V], shape (n,)."""
    return (1.0 + size_of(faults, "voltage_gain")) * voltage_v + size_of(faults, "voltage_offset")


def measured_temperature(
    pack: TwinPack, faults: Faults, drive: Drive, surface_c: FloatArray
) -> FloatArray:
    """Return the temperature that a sensor reports [°C], shape (n,)."""
    measured = lagged(surface_c, drive.step_s, pack.sensors.temperature_lag_s)
    # Two equal lags in series: a sensor in a pocket.
    for _ in range(2):
        measured = lagged(measured, drive.step_s, 0.5 * size_of(faults, "temperature_lag"))
    return measured + size_of(faults, "temperature_offset")

"""The log that the sensors write of a simulated day, and how well they can do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cangauge.logs.log import Log
from cangauge.twin.cells import ohmic_factor
from cangauge.twin.day import Day
from cangauge.twin.pack import KELVIN, Pack
from cangauge.twin.sensors import Sampling
from cangauge.twin.simulate import Truth

FloatArray = NDArray[np.float64]

_SOC_STEP_PCT: Final = 0.1


@dataclass(frozen=True, eq=False)
class Recording:
    """A log and what only the truth knows about it.

    Parameters
    ----------
    log : Log
        As a gauge would see it: `soc_pct` holds the assumed start in its first row, NaN after.
    floor_v : array of shape (n,)
        Error of the voltage of a perfect model that comes from noise, steps and the assumed
        start alone [V].
    true_soc_pct, true_voltage_v, expected_voltage_v : array of shape (n,)
        At the log's rows: the true SoC [%] and terminal voltage [V], and what a perfect model of
        the healthy pack makes of the reported signals [V].
    gap_v : array of shape (n,)
        Reported minus expected voltage, noise apart [V].
    """

    log: Log
    floor_v: FloatArray
    true_soc_pct: FloatArray
    true_voltage_v: FloatArray
    expected_voltage_v: FloatArray
    gap_v: FloatArray


def record(
    pack: Pack,
    day: Day,
    truth: Truth,
    *,
    soc_pct: FloatArray,
    expected_v: FloatArray,
    name: str = "log",
) -> Recording:
    """Return what the sensors record of a day; the noise is that of `day.seed`.

    Parameters
    ----------
    pack : Pack
    day : Day
    truth : Truth
    soc_pct : array of shape (n,)
        True SoC on the grid [%].
    expected_v : array of shape (n,)
        Voltage that a perfect model of the healthy pack expects on the grid [V].
    name : str
        Of the log.
    """
    rng = np.random.default_rng(day.seed)
    sampling = Sampling(pack.sensors, day.time_s, truth.rows, rng)
    current = sampling.current(truth.seen_current_a)
    voltage = sampling.voltage(truth.seen_voltage_v)
    temperature = sampling.temperature(truth.seen_temperature_c)
    error_pct = float(rng.normal(0.0, pack.sensors.start_soc_std_pct))
    known = min(100.0, 100.0 * day.start_soc + error_pct)
    known = round(round(known / _SOC_STEP_PCT) * _SOC_STEP_PCT, 6)
    assumed = np.full(sampling.time_s.size, np.nan)
    assumed[0] = known
    log = Log(
        sampling.time_s, current, voltage, temperature, assumed,
        name=name, temperature_source="pack",
    )  # fmt: skip
    kelvin = sampling.at(truth.core_c) + KELVIN
    resistance = pack.resistance_ohm * ohmic_factor(pack, kelvin)
    true_soc = sampling.at(soc_pct)
    start = known / 100.0 - day.start_soc
    chemistry = pack.chemistry
    misplaced = pack.cells * (
        chemistry.ocv(true_soc / 100.0 + start) - chemistry.ocv(true_soc / 100.0)
    )
    floor = voltage - sampling.at(truth.seen_voltage_v) - misplaced
    floor += resistance * (current - sampling.at(truth.seen_current_a))
    return Recording(
        log=log,
        floor_v=floor,
        true_soc_pct=true_soc,
        true_voltage_v=sampling.at(truth.voltage_v),
        expected_voltage_v=sampling.at(expected_v),
        gap_v=sampling.at(truth.seen_voltage_v - expected_v),
    )

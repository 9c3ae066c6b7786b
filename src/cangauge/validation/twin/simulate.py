"""From true signals to recorded ones: faults of the sensors, then noise, steps, jitter, losses.

A pack, a day and a condition → what truly happened, and what the log says of it.

The log that the sensors write of a simulated day, and how well they can do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.logs.log import Log
from cangauge.validation.twin.condition import HEALTHY, Condition, is_on
from cangauge.validation.twin.day import Day
from cangauge.validation.twin.pack import KELVIN, Pack, Sensors
from cangauge.validation.twin.plant import Plant, discharged, lagged, ohmic_factor, temperatures

# --- From true signals to recorded ones: faults of the sensors, then noise, steps, jitter, l…

_MAX_JITTER: Final = 0.3


def seen_current(condition: Condition, day: Day, current_a: FloatArray) -> FloatArray:
    """Return what the current sensor reports, noise apart [A], shape (n,)."""
    seen = current_a
    if condition.current_skew_s:
        seen = np.interp(day.time_s - condition.current_skew_s, day.time_s, seen)
    if condition.remanence_a:
        reach = 0.25 * float(np.max(np.abs(seen)))
        seen = seen + condition.remanence_a * _stop(seen, reach) / reach
    if condition.current_gain or condition.current_offset_a:
        seen = (1.0 + condition.current_gain) * seen + condition.current_offset_a
    if condition.clip_share < 1.0:
        limit = condition.clip_share * float(np.max(np.abs(seen)))
        seen = np.clip(seen, -limit, limit)
    return seen


def seen_voltage(condition: Condition, day: Day, voltage_v: FloatArray) -> FloatArray:
    """Return what the voltage sensor reports, noise apart [V], shape (n,)."""
    seen = voltage_v
    if condition.voltage_gain or condition.voltage_offset_v:
        seen = (1.0 + condition.voltage_gain) * seen + condition.voltage_offset_v
    if condition.ripple_v:
        phase = 2.0 * np.pi * seen / condition.ripple_period_v + condition.ripple_phase
        seen = seen + condition.ripple_v * np.sin(phase)
    if condition.bursts is not None:
        noise = np.random.default_rng(condition.bursts.seed + 1).normal(0.0, 1.0, seen.size)
        seen = seen + condition.bursts.size * noise * is_on(condition.bursts, day.time_s)
    if condition.stale is not None:
        held = is_on(condition.stale, day.time_s)
        last = np.maximum.accumulate(np.where(held, 0, np.arange(seen.size)))
        seen = seen[last]
    return seen


def seen_temperature(
    pack: Pack, condition: Condition, day: Day, surface_c: FloatArray
) -> FloatArray:
    """Return what the temperature sensor reports, noise apart [°C], shape (n,)."""
    seen = lagged(surface_c, day.step_s, pack.sensors.temperature_lag_s)
    # A sensor in a pocket: two equal lags one after the other.
    for _ in range(2):
        seen = lagged(seen, day.step_s, 0.5 * condition.temperature_lag_s)
    if condition.temperature_hold:
        seen = seen + condition.temperature_hold * (seen[0] - seen)
    return seen


def _stop(signal: FloatArray, reach: float) -> FloatArray:
    """Return a stop operator of the signal: it follows until it has moved by `reach`."""
    result = np.empty_like(signal)
    state = 0.0
    result[0] = state
    for row, moved in enumerate(np.diff(signal).tolist(), start=1):
        state = min(max(state + moved, -reach), reach)
        result[row] = state
    return result


class Sampling:
    """When the frames of one log are sent, and what the converters make of the signals.

    Parameters
    ----------
    sensors : Sensors
    time_s : array of shape (n,)
        Grid of the true signals [s].
    rows : int
        Rows of the grid that are recorded.
    rng : Generator
    """

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
        # Stamps on the bus have a resolution of a tenth of a millisecond here.
        self.time_s = np.round(self.time_s, 4)

    def current(self, signal: FloatArray) -> FloatArray:
        """Return the recorded current [A]."""
        return self._converted(signal, self._sensors.current_noise_a, self._sensors.current_step_a)

    def voltage(self, signal: FloatArray) -> FloatArray:
        """Return the recorded voltage [V]."""
        return self._converted(signal, self._sensors.voltage_noise_v, self._sensors.voltage_step_v)

    def temperature(self, signal: FloatArray) -> FloatArray:
        """Return the recorded temperature [°C]."""
        step = self._sensors.temperature_step_k
        return self._converted(signal, 0.1 * step, step)

    def at(self, signal: FloatArray) -> FloatArray:
        """Return a true signal at the moments of the frames."""
        return np.interp(self.time_s, self._grid_s, signal)

    def _converted(self, signal: FloatArray, noise: float, step: float) -> FloatArray:
        values = self.at(signal) + self._rng.normal(0.0, noise, self.time_s.size)
        return np.round(np.round(values / step) * step, 9)


# --- A pack, a day and a condition → what truly happened, and what the log says of it

_MAX_PASSES: Final = 5
_SAME_TEMPERATURE: Final = 0.2
"""Temperatures closer than this part of the plant's threshold give the same voltage."""
_EMPTY_V: Final = {"lfp": 1.8, "other": 2.2}


@dataclass(frozen=True, eq=False)
class Truth:
    """What happened on the grid of the day, shape (n,) each.

    `seen_…` is what a sensor without noise, steps and losses would report: the true value, but
    with the sensor's fault. Currents discharge when positive.
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
    """Rows until the lowest cell is empty and the car stops; the rest is not recorded."""
    seen_current_a: FloatArray
    seen_voltage_v: FloatArray
    seen_temperature_c: FloatArray


def simulate(
    plant: Plant, day: Day, condition: Condition = HEALTHY, near: Truth | None = None
) -> Truth:
    """Return what a pack in a condition does on a day.

    Temperature and voltage depend on each other through the heat; they are passed to and fro
    until the core moves by less than the plant's threshold.

    Parameters
    ----------
    plant : Plant
    day : Day
    condition : Condition
    near : Truth, optional
        The same day in another condition. Its temperatures are kept while they agree with the
        heat, so that what differs in voltage is not the last hundredths of a kelvin.
    """
    pack = plant.pack
    current = day.current_a
    if condition.hidden_load is not None:
        current = current + condition.hidden_load.size * is_on(condition.hidden_load, day.time_s)
    if near is None:
        kelvin = np.full_like(current, day.start_c + KELVIN)
        heat = pack.resistance_ohm * 1.3 * ohmic_factor(pack, kelvin) * current**2
        core, surface = temperatures(pack, day, heat, condition.insulation)
    else:
        core, surface = near.core_c, near.surface_c
    cells = plant.electrical(day, condition, current, core)
    for _ in range(_MAX_PASSES):
        next_core, next_surface = temperatures(pack, day, cells.heat_w, condition.insulation)
        if float(np.max(np.abs(next_core - core))) < plant.settled_k:
            break
        core, surface = next_core, next_surface
        cells = plant.electrical(day, condition, current, core)
    reported = surface
    if pack.knows_core:
        reported = surface + (core - surface) / (1.0 + condition.insulation)
    return Truth(
        time_s=day.time_s,
        current_a=current,
        voltage_v=cells.voltage_v,
        core_c=core,
        surface_c=surface,
        soc=cells.soc,
        equilibrium_v=cells.equilibrium_v,
        heat_w=cells.heat_w,
        rows=_until_empty(pack, cells.lowest_v),
        seen_current_a=seen_current(condition, day, day.current_a),
        seen_voltage_v=seen_voltage(condition, day, cells.voltage_v),
        seen_temperature_c=seen_temperature(pack, condition, day, reported),
    )


def _until_empty(pack: Pack, lowest_v: FloatArray) -> int:
    limit = _EMPTY_V["lfp" if pack.chemistry.name == "lfp" else "other"]
    empty = np.flatnonzero(lowest_v < limit)
    return int(empty[0]) if empty.size else lowest_v.size


def expected_voltage(plant: Plant, day: Day, truth: Truth, healthy: Truth) -> FloatArray:
    """Return what a perfect model of the healthy pack makes of the reported signals [V].

    It is given the reported current and the reported temperature (and knows how the healthy
    core stands above it), and the start SoC that the gauge assumes.

    Parameters
    ----------
    plant : Plant
    day : Day
    truth : Truth
        With the fault.
    healthy : Truth
        The same day without it.
    """
    same_current = np.array_equal(truth.seen_current_a, day.current_a)
    shift = truth.seen_temperature_c - healthy.seen_temperature_c
    if same_current and float(np.max(np.abs(shift))) < _SAME_TEMPERATURE * plant.settled_k:
        return healthy.voltage_v
    core = healthy.core_c + shift
    return plant.electrical(day, HEALTHY, truth.seen_current_a, core).voltage_v


def gap_v(plant: Plant, day: Day, truth: Truth, healthy: Truth) -> FloatArray:
    """Return reported minus expected voltage, noise apart [V], shape (truth.rows,)."""
    gap = truth.seen_voltage_v - expected_voltage(plant, day, truth, healthy)
    return gap[: truth.rows]


def true_soc_pct(pack: Pack, day: Day, truth: Truth, condition: Condition) -> FloatArray:
    """Return the true SoC in % of the true mean capacity, shape (n,)."""
    charge = discharged(day, truth.current_a, condition.charge_loss)
    capacity = pack.capacity_ah * condition.capacity_factor
    return 100.0 * (day.start_soc + condition.start_soc_shift - charge / capacity)


# --- The log that the sensors write of a simulated day, and how well they can do

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

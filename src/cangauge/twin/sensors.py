"""From true signals to recorded ones: faults of the sensors, then noise, steps, jitter, losses."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from cangauge.twin.condition import Condition, is_on
from cangauge.twin.day import Day
from cangauge.twin.pack import Pack, Sensors
from cangauge.twin.relaxation import lagged

FloatArray = NDArray[np.float64]

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

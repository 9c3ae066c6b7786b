"""Simulated drives: speed trace → power → pack current, and the ambient temperature."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.extras.validation.twin.pack import TwinPack, log_uniform

_ROADS: Final = {
    "town": ((6.0, 15.0), (8.0, 60.0), (3.0, 45.0)),
    "country": ((15.0, 26.0), (30.0, 240.0), (2.0, 25.0)),
    "motorway": ((24.0, 36.0), (120.0, 900.0), (2.0, 20.0)),
}
"""Road → cruise speed [m/s], cruise duration [s], stop between micro-trips [s]."""


@dataclass(frozen=True, eq=False)
class Drive:
    """Load on a pack over one drive, on an even time grid.

    Parameters
    ----------
    time_s : array of shape (n,)
        From 0, evenly spaced.
    current_a : array of shape (n,)
        Current that the car draws [A], positive = discharge.
    ambient_c : array of shape (n,)
        Ambient temperature [°C].
    start_c : float
        Initial temperature of the pack [°C].
    start_soc : float
        Initial state of charge of the healthy pack [-].
    conditioning_w, target_c : float
        Heating or cooling power [W] until the surface reaches the target [°C].
    history : float
        Initial state of the hysteresis: −1 after a charge, 1 after a discharge.
    seed : int
        Seed of the sensor noise.
    recorded_c : array of shape (n,), optional
        Temperature of a recorded log [°C], which then is that of the cells.
    """

    time_s: FloatArray
    current_a: FloatArray
    ambient_c: FloatArray
    start_c: float
    start_soc: float
    conditioning_w: float = 0.0
    target_c: float = 20.0
    history: float = -1.0
    seed: int = 0
    recorded_c: FloatArray | None = None

    @property
    def step_s(self) -> float:
        """Time step of the grid [s]."""
        return float(self.time_s[1] - self.time_s[0])


def draw_drive(
    rng: np.random.Generator,
    pack: TwinPack,
    *,
    hours: float | None = None,
    ambient_c: float | None = None,
    start_soc_pct: float | None = None,
    end_soc_pct: float | None = None,
    speed_ms: FloatArray | None = None,
    discharge: bool = False,
) -> Drive:
    """Draw a drive; arguments replace drawn quantities.

    Parameters
    ----------
    rng : Generator
    pack : TwinPack
    hours : float, optional
        Duration [h], 0.05–12; by default 0.5–2.5. The drive ends early at `end_soc_pct`.
    ambient_c : float, optional
        Initial ambient temperature [°C]; by default −10–35.
    start_soc_pct : float, optional
        Initial SoC [%]; by default 45–100.
    end_soc_pct : float, optional
        SoC at which the drive ends [%]; by default 5–20.
    speed_ms : array of shape (m,), optional
        Speed trace at 1 Hz [m/s], repeated as needed; by default a random one.
    discharge : bool
        Scale the power so that the drive runs from start to end within `hours`.

    Raises
    ------
    InputError
        For a value out of range.
    """
    hours = float(rng.uniform(0.5, 2.5)) if hours is None else hours
    ambient_c = float(rng.uniform(-10.0, 35.0)) if ambient_c is None else ambient_c
    start, end = _draw_ends(rng, start_soc_pct, end_soc_pct)
    _check(hours, ambient_c, start, end)
    seconds = int(hours * 3600.0)
    speed = _draw_speed(rng, seconds) if speed_ms is None else _given(speed_ms, seconds)
    is_free = speed_ms is None and not discharge
    if is_free:
        _park(rng, speed)
    power = _battery_power(rng, speed, _auxiliary_w(rng, ambient_c))
    if pack.energy_kwh < 15.0:  # a smaller car than that of 38 kWh which the road load describes
        power *= pack.energy_kwh / 38.0
    if discharge:
        wanted = (start - end) * pack.energy_kwh * 3.6e6
        power *= 1.03 * wanted / max(float(np.sum(power)), 0.2 * wanted)
    current, step_s = _current(rng, pack, power, start)
    if is_free and rng.random() < 0.25:
        current = _with_charging(rng, pack, current, step_s, start)
    current = current[: _rows_until(end, start, current, step_s, pack.capacity_ah)]
    time_s: FloatArray = np.arange(current.size, dtype=np.float64) * step_s
    is_conditioned = rng.random() < 0.45 and not discharge
    return Drive(
        time_s=time_s,
        current_a=current,
        ambient_c=_weather(rng, time_s, ambient_c),
        start_c=ambient_c + float(rng.normal(1.5, 2.0)),
        start_soc=start,
        conditioning_w=float(pack.energy_kwh * rng.uniform(25.0, 130.0)) if is_conditioned else 0.0,
        target_c=float(rng.uniform(14.0, 26.0)),
        history=float(rng.choice((-1.0, -1.0, rng.uniform(-1.0, 1.0), 1.0))),
        seed=int(rng.integers(2**31)),
    )


def _draw_ends(
    rng: np.random.Generator, start_soc_pct: float | None, end_soc_pct: float | None
) -> tuple[float, float]:
    """Return the SoC at the start and at the end [-]: as given, else drawn."""
    start = 1.0 - 0.55 * float(rng.beta(1.0, 1.6))
    if start_soc_pct is not None:
        start = start_soc_pct / 100.0
    if end_soc_pct is not None:
        return start, end_soc_pct / 100.0
    return start, min(float(rng.uniform(0.05, 0.20)), 0.6 * start)


def _check(hours: float, ambient_c: float, start: float, end: float) -> None:
    """Raise InputError for a drive out of range, or one that ends where it starts."""
    for name, value, low, high, unit in (
        ("hours", hours, 0.05, 12.0, "h"),
        ("ambient", ambient_c, -30.0, 50.0, "°C"),
        ("start SoC", 100.0 * start, 3.0, 100.0, "%"),
        ("end SoC", 100.0 * end, 1.0, 99.0, "%"),
    ):
        if not low <= value <= high:
            raise InputError(f"must lie within {low:g} … {high:g} {unit}", field=name, value=value)
    if end >= start:
        problem = f"the drive starts at {100.0 * start:g} %, at or below its end"
        cure = "give a lower end or a higher start"
        raise InputError(problem, field="end SoC", value=100.0 * end, cure=cure)


def _rows_until(
    end: float, start: float, current: FloatArray, step_s: float, capacity_ah: float
) -> int:
    """Return the rows of a current until a SoC [-], at least those of two minutes."""
    middle = 0.5 * (current[1:] + current[:-1])
    left = start - np.append(0.0, np.cumsum(middle)) * step_s / 3600.0 / capacity_ah
    empty = np.flatnonzero(left < end)
    rows = int(empty[0]) if empty.size else current.size
    return max(rows, min(current.size, int(120.0 / step_s)))


# --- Speed


def _given(speed_ms: FloatArray, seconds: int) -> FloatArray:
    """Return a given speed trace, repeated to a duration [m/s]."""
    speed = np.asarray(speed_ms, dtype=np.float64)
    if speed.ndim != 1 or not speed.size or not np.all((speed >= 0.0) & (speed < 85.0)):
        problem, cure = "is not a trace of speeds from 0 to 85 m/s", "give one speed a second"
        raise InputError(problem, field="speed_ms", cure=cure)
    return np.resize(speed, seconds)


def _draw_speed(rng: np.random.Generator, seconds: int) -> FloatArray:
    """Draw a speed trace at 1 Hz [m/s]: micro-trips in town, country and motorway, with stops."""
    trips: list[FloatArray] = []
    length = 0
    briskness = float(rng.uniform(0.7, 1.5))
    while length < seconds:
        road = str(rng.choice(list(_ROADS), p=(0.5, 0.3, 0.2)))
        until = min(length + float(rng.uniform(240.0, 1200.0)), seconds)
        while length < until:
            trips.append(_micro_trip(rng, road, briskness))
            length += trips[-1].size
    return np.concatenate(trips)[:seconds]


def _micro_trip(rng: np.random.Generator, road: str, briskness: float) -> FloatArray:
    """Draw one to three cruises from standstill to standstill [m/s]."""
    cruise_ms, cruise_s, stop_s = _ROADS[road]
    speeds, times = [0.0], [0.0]

    def go(speed: float, seconds: float) -> None:
        speeds.append(speed)
        times.append(times[-1] + seconds)

    for _ in range(int(rng.integers(1, 4))):
        speed = float(rng.uniform(*cruise_ms))
        change = speed - speeds[-1]
        rate = briskness * float(rng.uniform(0.6, 2.2) if change > 0.0 else rng.uniform(0.5, 1.6))
        # Acceleration fades with speed: power is limited.
        rate /= 1.0 + max(speed, speeds[-1]) / 25.0
        go(speed, abs(change) / rate + 1.0)
        go(speed, log_uniform(rng, *cruise_s))
    go(0.0, speeds[-1] / (briskness * float(rng.uniform(0.7, 2.0))) + 1.0)
    go(0.0, float(rng.uniform(*stop_s)))
    seconds = np.arange(0.0, times[-1])
    trace = np.interp(seconds, times, speeds)
    # Driver and traffic: fluctuation that vanishes at standstill.
    wobble = lfilter([1.0], [1.0, -1.72, 0.745], rng.normal(0.0, 0.025, seconds.size))
    smooth = np.convolve(np.pad(trace, 1, mode="edge"), (0.25, 0.5, 0.25), mode="valid")
    return np.asarray(np.maximum(smooth + np.minimum(trace / 5.0, 1.0) * wobble, 0.0))


def _park(rng: np.random.Generator, speed: FloatArray) -> None:
    """Insert standstills at the start and on the way, at random (in place)."""
    if rng.random() < 0.3:
        speed[: int(rng.uniform(60.0, 900.0))] = 0.0
    if rng.random() < 0.3:
        first = int(rng.uniform(0.2, 0.8) * speed.size)
        speed[first : first + int(rng.uniform(180.0, 900.0))] = 0.0


# --- Power and current


def _smooth(rng: np.random.Generator, rows: int, sigma: float) -> FloatArray:
    """Draw a fluctuation of some rows' correlation, of standard deviation 1."""
    drawn = gaussian_filter1d(rng.normal(size=rows), sigma, mode="nearest")
    return np.asarray(drawn / max(float(np.std(drawn)), 1e-9))


def _auxiliary_w(rng: np.random.Generator, ambient_c: float) -> float:
    """Draw the auxiliary power [W], with a cabin heater in the cold."""
    heater_w = max(0.0, 18.0 - ambient_c) * float(rng.uniform(20.0, 110.0))
    return float(rng.uniform(250.0, 900.0)) + heater_w


def _battery_power(rng: np.random.Generator, speed: FloatArray, auxiliary_w: float) -> FloatArray:
    """Return the battery power of a car that follows a speed trace [W]."""
    mass_kg = rng.uniform(1350.0, 1950.0)
    drag = 0.5 * 1.2 * rng.uniform(0.60, 0.75)
    rolling = rng.uniform(0.008, 0.012) * (speed > 0.1)
    slope = _smooth(rng, speed.size, 45.0) * rng.uniform(0.0, 0.015)
    force = mass_kg * (1.04 * np.gradient(speed) + 9.81 * (slope + rolling))
    wheel_w = (force + drag * speed**2) * speed
    driven_w = np.maximum(wheel_w, 0.0) / rng.uniform(0.82, 0.90)
    # Friction brakes take over below walking pace and above 60 kW.
    fade = np.clip((speed - 1.5) / 3.0, 0.0, 1.0)
    recovered_w = np.maximum(np.minimum(wheel_w, 0.0) * rng.uniform(0.45, 0.80), -60e3) * fade
    cycling = 1.0 + 0.4 * np.sign(np.sin(np.arange(speed.size) / rng.uniform(15.0, 60.0)))
    return np.asarray(driven_w + recovered_w + auxiliary_w * cycling)


def _current(
    rng: np.random.Generator, pack: TwinPack, power_w: FloatArray, start: float
) -> tuple[FloatArray, float]:
    """Return the current on the simulation grid [A], and the grid's step [s]."""
    soc = start - np.cumsum(power_w) / 3.6e6 / pack.energy_kwh
    open_v = pack.cells * pack.chemistry.ocv(np.clip(soc, 0.03, 1.0))
    ohm = 1.3 * pack.resistance_ohm
    root_v = np.sqrt(np.maximum(open_v**2 - 4.0 * ohm * power_w, (0.6 * open_v) ** 2))
    current = (open_v - root_v) / (2.0 * ohm)
    # Charge acceptance: none when full, at most about 1.5C.
    room = np.clip((0.985 - soc) / 0.05, 0.02, 1.0)
    limit = pack.capacity_ah * rng.uniform(0.8, 1.6) * room
    current = np.clip(current, -limit, pack.capacity_ah * rng.uniform(2.5, 4.0))
    rate = max(2.0, pack.sensors.rate_hz)
    fine = np.interp(
        np.arange(0.0, power_w.size - 1.0, 1.0 / rate), np.arange(power_w.size), current
    )
    # Traction control and pedal: fluctuation faster than the speed trace.
    flutter = _smooth(rng, fine.size, 0.35 * rate) * rng.uniform(0.01, 0.06)
    return fine + flutter * np.abs(fine), 1.0 / rate


def _with_charging(
    rng: np.random.Generator, pack: TwinPack, current: FloatArray, step_s: float, start: float
) -> FloatArray:
    """Insert a stop at a charger; same number of rows."""
    row = int(rng.uniform(0.2, 0.7) * current.size)
    soc = start - float(np.sum(current[:row])) * step_s / 3600.0 / pack.capacity_ah
    gained = min(float(rng.uniform(0.05, 0.35)), 0.93 - soc)
    if gained < 0.03:
        return current
    # At most a third of the drive.
    most_s = 0.33 * current.size * step_s
    rate = max(float(rng.uniform(0.25, 1.0)), 3600.0 * 0.03 / most_s)
    rows = int(min(3600.0 * gained / rate, most_s) / step_s)
    ramp = np.minimum(1.0, np.arange(rows) * step_s / 20.0)
    idle = np.full(int(rng.uniform(20.0, 120.0) / step_s), 0.002 * pack.capacity_ah)
    plugged = -rate * pack.capacity_ah * ramp * ramp[::-1]
    return np.concatenate((current[:row], idle, plugged, idle, current[row:]))[: current.size]


def _weather(rng: np.random.Generator, time_s: FloatArray, ambient_c: float) -> FloatArray:
    """Return the ambient temperature [°C]: slow drift, at times a step (leaving a garage)."""
    period_s = rng.uniform(3000.0, 12000.0)
    result = ambient_c + rng.uniform(0.0, 2.0) * np.sin(2.0 * np.pi * time_s / period_s)
    if rng.random() < 0.4:
        change = rng.normal(0.0, 6.0)
        result[time_s > rng.uniform(0.1, 0.7) * time_s[-1]] += change
    return np.asarray(result)

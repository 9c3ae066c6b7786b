"""Speed traces at random: micro-trips of town, country and motorway, with stops."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

FloatArray = NDArray[np.float64]

# Style → speed of the cruises [m/s], their length [s], stop between micro-trips [s].
_STYLES: Final = {
    "town": ((6.0, 15.0), (8.0, 60.0), (3.0, 45.0)),
    "country": ((15.0, 26.0), (30.0, 240.0), (2.0, 25.0)),
    "motorway": ((24.0, 36.0), (120.0, 900.0), (2.0, 20.0)),
}


def draw_speed(rng: np.random.Generator, seconds: int) -> FloatArray:
    """Return a speed trace at random [m/s], one value a second, shape (seconds,).

    Parameters
    ----------
    rng : Generator
    seconds : int
        Its length.
    """
    pieces: list[FloatArray] = []
    length = 0
    briskness = float(rng.uniform(0.7, 1.5))
    while length < seconds:
        style = str(rng.choice(list(_STYLES), p=(0.5, 0.3, 0.2)))
        until = length + float(rng.uniform(240.0, 1200.0))
        while length < min(until, seconds):
            trip = _micro_trip(rng, style, briskness)
            pieces.append(trip)
            length += trip.size
    return np.concatenate(pieces)[:seconds]


def _micro_trip(rng: np.random.Generator, style: str, briskness: float) -> FloatArray:
    (slow, fast), (short, long), (brief, wait) = _STYLES[style]
    speeds, times = [0.0], [0.0]
    for _ in range(int(rng.integers(1, 4))):
        cruise = float(rng.uniform(slow, fast))
        change = cruise - speeds[-1]
        rate = briskness * float(rng.uniform(0.6, 2.2) if change > 0.0 else rng.uniform(0.5, 1.6))
        # Acceleration fades with speed: power is limited.
        rate /= 1.0 + max(cruise, speeds[-1]) / 25.0
        times.append(times[-1] + abs(change) / rate + 1.0)
        speeds.append(cruise)
        times.append(times[-1] + float(np.exp(rng.uniform(np.log(short), np.log(long)))))
        speeds.append(cruise)
    times.append(times[-1] + speeds[-1] / (briskness * float(rng.uniform(0.7, 2.0))) + 1.0)
    speeds.append(0.0)
    times.append(times[-1] + float(rng.uniform(brief, wait)))
    speeds.append(0.0)
    seconds = np.arange(0.0, times[-1])
    trace = np.interp(seconds, times, speeds)
    # The driver and the traffic: a wobble that fades out at standstill.
    wobble = lfilter([1.0], [1.0, -1.72, 0.745], rng.normal(0.0, 0.025, seconds.size))
    moving = np.minimum(trace / 5.0, 1.0)
    smooth = np.convolve(np.pad(trace, 1, mode="edge"), (0.25, 0.5, 0.25), mode="valid")
    result: FloatArray = np.maximum(smooth + moving * wobble, 0.0)
    return result

"""Statuses as a service gives them, and a clock to age them."""

from __future__ import annotations

from typing import Any

from cangauge.extras.live.history import History
from live import leaf_model_path


class Clock:
    """Wall-clock time that a test moves [s since 1970]."""

    def __init__(self) -> None:
        self.now_s = 1.7e9

    def __call__(self) -> float:
        return self.now_s


def status(
    time_s: float = 0.0, *, residual_v: float = 0.1, age_s: float = 0.05, **changed: Any
) -> dict[str, Any]:
    """Return the parts of `/status` that the page shows."""
    return {
        "model": str(leaf_model_path()),
        "loop_stuck": False,
        "status": "valid",
        "reasons": [],
        "estimate": {
            "time_s": time_s,
            "soc_pct": 70.0,
            "soc_std_pct": 1.0,
            "soc_newton_pct": None,
            "soc_coulomb_pct": 69.5,
            "voltage_model_v": 380.0,
            "residual_v": residual_v,
        },
        "sample": {
            "age_s": age_s,
            "current_a": 12.5,
            "voltage_v": 380.0 + residual_v,
            "temperature_c": 20.0,
        },
        "samples": int(10 * (time_s - age_s)),
        "samples_per_s": 10.0,
        "frames": {"received": int(20 * time_s)},
        "rejects": {"crc_errors": 0},
        "bus_up": True,
        "bus_trouble": None,
        "config": {"reloading": False, "problem": None},
        "notices": [],
        "latency": {"count": int(10 * time_s), "mean_s": 0.002, "p99_at_most_s": 0.005},
        "uptime_s": time_s,
    } | changed


def driven(seconds: float, clock: Clock, *, every_s: float = 0.1, **changed: Any) -> History:
    """Return a history of so many seconds."""
    history = History(clock)
    for row in range(round(seconds / every_s)):
        clock.now_s += every_s
        history.add(status(every_s * row, **changed))
    return history

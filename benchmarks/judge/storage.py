"""Home storage of iron-phosphate cells over days: sun, loads, full charges at constant voltage.

A simulator of its own: open-circuit curve drawn about a published cell, one RC pair, hysteresis, a
charger that limits the voltage. It shares no equation with the voltage model.
"""

from __future__ import annotations

import numpy as np

import cangauge

SOC = np.array([0, 1, 3, 6, 10, 20, 30, 40, 50, 60, 70, 80, 90, 95, 98, 99, 100, 101]) / 100.0
OCV_V = np.array(
    [2.6, 2.85, 3.05, 3.15, 3.205, 3.252, 3.282, 3.291, 3.294, 3.300, 3.327, 3.334, 3.337, 3.341,
     3.352, 3.372, 3.44, 3.7]
)  # fmt: skip
"""Open-circuit voltage of a LiFePO4 cell [V]: Prada et al., J. Electrochem. Soc. 159 (2012)."""
CELLS, STEP_S = 16, 30.0


def draw_days(
    rng: np.random.Generator, days: int, fills: float
) -> tuple[list[cangauge.Log], float]:
    """Return a log for each day from midnight on, every 30 s, and the capacity [Ah].

    The logs carry the true SoC.

    Parameters
    ----------
    rng : Generator
    days : int
    fills : float
        Share of the days with enough sun to fill the battery.
    """
    capacity_ah = float(rng.choice([100.0, 200.0, 280.0, 300.0]))
    curve_v = OCV_V + 0.004 * np.sin(SOC * rng.uniform(2.0, 8.0) + rng.uniform(0.0, 6.0))
    ohm, slow_ohm = rng.uniform(0.8, 1.4, 2) * np.array([0.11, 0.08]) / capacity_ah
    hysteresis_v, slow_s = rng.uniform(0.006, 0.012), rng.uniform(60.0, 300.0)
    full_v, soc = rng.uniform(3.45, 3.5), rng.uniform(0.4, 0.8)
    rows, logs = round(86400.0 / STEP_S), []
    polarized_v = lag_v = 0.0
    hour = np.arange(rows) * STEP_S / 3600.0
    for day in range(days):
        sun_c = (0.34 if rng.random() < fills else 0.1) * rng.uniform(0.9, 1.2)
        cloud = np.repeat(rng.uniform(0.6, 1.0, rows // 20), 20)
        base_c = np.repeat(np.abs(rng.normal(0.0, 0.035, rows // 10)), 10) + 0.012
        wanted = base_c + 0.04 * np.exp(-0.5 * ((hour - 19.5) / 1.5) ** 2)
        wanted -= sun_c * cloud * np.clip(np.sin(np.pi * (hour - 8.0) / 9.0), 0.0, None)
        wanted *= capacity_ah
        current_a, voltage_v, true_pct = np.zeros((3, rows))
        for k in range(rows):
            current = 0.0 if soc < 0.06 and wanted[k] > 0.0 else float(wanted[k])
            open_v = float(np.interp(soc, SOC, curve_v)) - polarized_v + lag_v
            if open_v - ohm * current > full_v:
                current = min(max(current, (open_v - full_v) / ohm), 0.0)
            if abs(current) < 0.0005 * capacity_ah:
                current = 0.0
            fading = np.exp(-STEP_S / slow_s)
            polarized_v = polarized_v * fading + slow_ohm * current * (1.0 - fading)
            moved = np.exp(-abs(current) * STEP_S / 3600.0 / capacity_ah * 25.0)
            lag_v = lag_v * moved - np.sign(current) * hysteresis_v * (1.0 - moved)
            soc -= current * STEP_S / 3600.0 / capacity_ah
            current_a[k], true_pct[k] = current, 100.0 * soc
            voltage_v[k] = CELLS * (open_v - ohm * current)
        log = cangauge.Log(
            1.7e9 + 86400.0 * day + 3600.0 * hour,
            np.round(current_a + rng.normal(0.0, 0.02, rows), 1),
            np.round(voltage_v + rng.normal(0.0, 0.01, rows), 2),
            np.full(rows, 21.0) + np.round(2.0 * np.sin(hour / 4.0)),
            soc_pct=true_pct,
            name=f"day{day + 1}",
        )
        logs.append(log)
    return logs, capacity_ah

"""The energy balance of a log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cangauge.logs.log import Log
from cangauge.model.charge import BRIDGE_S

JOULE_PER_KWH = 3.6e6


@dataclass(frozen=True)
class Energy:
    """Energy at the pack's terminals [kWh]."""

    driven_kwh: float
    """Taken out, ∫U·I over I > 0."""
    regenerated_kwh: float
    """Put back, −∫U·I over I < 0."""
    net_kwh: float
    heat_kwh: float
    """Joule heat, R·∫I² with the slope resistance R."""
    efficiency_pct: float
    """Net energy over net energy plus heat [%]."""


def energy_balance(logs: Sequence[Log], slope_ohm: float) -> Energy:
    """Return the energy balance summed over the logs, by the trapezoidal rule.

    Parameters
    ----------
    logs : sequence of Log
    slope_ohm : float
        Slope resistance [Ω], positive.
    """
    driven = regenerated = square = 0.0
    for log in logs:
        step_s = np.diff(log.time_s)
        step_s[step_s > BRIDGE_S] = 0.0
        power_w = log.voltage_v * log.current_a
        driven += _integral(np.maximum(power_w, 0.0), step_s)
        regenerated += _integral(np.maximum(-power_w, 0.0), step_s)
        square += _integral(log.current_a**2, step_s)
    net = driven - regenerated
    heat = slope_ohm * square
    return Energy(
        driven_kwh=driven / JOULE_PER_KWH,
        regenerated_kwh=regenerated / JOULE_PER_KWH,
        net_kwh=net / JOULE_PER_KWH,
        heat_kwh=heat / JOULE_PER_KWH,
        efficiency_pct=100.0 * net / (net + heat) if net + heat > 0.0 else float("nan"),
    )


def _integral(values: np.ndarray, step_s: np.ndarray) -> float:
    return float(np.sum((values[1:] + values[:-1]) * step_s) / 2.0)

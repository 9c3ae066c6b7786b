"""Figures of a fitted model on logs: fit of each log, slope resistance, energy balance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cangauge._typing import FloatArray
from cangauge.identify.rows import FitRows
from cangauge.logs.gaps import BRIDGE_S
from cangauge.logs.log import Log
from cangauge.model.effects.base import Signals
from cangauge.model.extended import ExtendedModel, newton_soc

JOULE_PER_KWH = 3.6e6


@dataclass(frozen=True)
class Energy:
    """Energy at the pack's terminals [kWh]."""

    driven_kwh: float
    """Discharged, ∫U·I over I > 0."""
    regenerated_kwh: float
    """Charged, −∫U·I over I < 0."""
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
        efficiency_pct=100.0 * net / (net + heat) if net > 0.0 else float("nan"),
    )


def _integral(values: FloatArray, step_s: FloatArray) -> float:
    return float(np.sum((values[1:] + values[:-1]) * step_s) / 2.0)


@dataclass(frozen=True, eq=False)
class LogFit:
    """Model and measurement of one log, shape (m,) each, on the rows of the fit."""

    rows: FitRows
    pseudo_ocv_v: FloatArray
    voltage_model_v: FloatArray
    soc_newton_pct: FloatArray

    @property
    def residual_v(self) -> FloatArray:
        """Measured minus modelled voltage [V]."""
        return self.rows.voltage_v - self.voltage_model_v

    @property
    def voltage_mae_pct(self) -> float:
        """Mean absolute voltage error relative to the measured voltage [%]."""
        return 100.0 * float(np.mean(np.abs(self.residual_v) / self.rows.voltage_v))

    @property
    def soc_newton_mae_pct(self) -> float:
        """Mean absolute error of the Newton inverse against the counted SoC [% SoC]."""
        return float(np.mean(np.abs(self.soc_newton_pct - self.rows.soc_pct)))


def evaluate(model: ExtendedModel, log: Log, rows: FitRows) -> LogFit:
    """Return the voltages and Newton inverse of a model on the rows of a log."""
    first = log.first_soc()
    if first is None:
        raise ValueError("a log of a fit has a start")
    signals = Signals(log.time_s, log.current_a, log.voltage_v, log.temperature_c)
    row, soc_pct = first
    prediction = model.predict(signals, soc_pct, rows.at, initial_row=row)
    temperature_c = prediction.signals.temperature_c[rows.at]
    return LogFit(
        rows=rows,
        pseudo_ocv_v=model.model.pseudo_ocv(prediction.soc_pct[rows.at], temperature_c),
        voltage_model_v=prediction.voltage_v,
        soc_newton_pct=newton_soc(model, prediction),
    )


def slope_resistances(
    fits: Sequence[LogFit], resistance_ohm: Sequence[float]
) -> tuple[float, float]:
    """Return the regression of U − pseudo-OCV on the current, and what the model expects of it [Ω].

    Both are positive. The expected one is −Σ Rm·ρm, ρm being the regression of the m-th current on
    the present one.

    Parameters
    ----------
    fits : sequence of LogFit
    resistance_ohm : sequence of float
        Rm of the first currents of the rows [Ω], negative.
    """
    table = np.concatenate([
        np.column_stack([
            item.rows.currents_a[:, : len(resistance_ohm)],
            item.rows.voltage_v - item.pseudo_ocv_v,
        ])
        for item in fits
    ])  # fmt: skip
    away = table - table.mean(axis=0)
    slopes = away[:, 0] @ away / max(float(away[:, 0] @ away[:, 0]), 1e-300)
    return -float(slopes[-1]), -float(slopes[:-1] @ np.array(resistance_ohm))

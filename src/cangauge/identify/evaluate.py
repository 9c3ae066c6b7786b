"""Figures of a fitted model on logs: fit of each log, slope resistance, energy balance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cangauge._typing import FloatArray
from cangauge.inference.rows import FitRows, SampledLog
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import BRIDGE_S
from cangauge.model.delay_line import delayed_currents
from cangauge.model.extended import ExtendedModel, Prediction
from cangauge.model.voltage_model import VoltageModel, soc_from_ocv, socs_from_ocv

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

    def part(self, keep: slice) -> LogFit:
        """Return some of the rows."""
        return LogFit(
            self.rows.part(keep),
            self.pseudo_ocv_v[keep],
            self.voltage_model_v[keep],
            self.soc_newton_pct[keep],
        )

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


def evaluate(model: VoltageModel, rows: FitRows) -> LogFit:
    """Return the fit of a voltage model to the rows of a log."""
    at_reference_v = model.pseudo_ocv(rows.soc_pct)
    pseudo_ocv_v = model.pseudo_ocv(rows.soc_pct, rows.temperature_c)
    voltage_v = pseudo_ocv_v + rows.delayed_current_a @ np.array(model.resistance_ohm)
    return LogFit(
        rows=rows,
        pseudo_ocv_v=pseudo_ocv_v,
        voltage_model_v=voltage_v,
        soc_newton_pct=socs_from_ocv(model, rows.voltage_v - (voltage_v - at_reference_v)),
    )


def evaluate_extended(model: ExtendedModel, log: SampledLog) -> LogFit:
    """Return the fit of a model with effects to a log; its rows hold the corrected signals."""
    prediction = model.predict(log.signals, log.initial_soc_pct, log.at)
    signals = prediction.signals
    delayed = delayed_currents(
        signals.time_s, signals.current_a, model.model.delay_s, signals.time_s
    )
    rows = replace(
        log.rows,
        voltage_v=signals.voltage_v[log.at],
        temperature_c=signals.temperature_c[log.at],
        soc_pct=prediction.soc_pct[log.at],
        delayed_current_a=delayed[log.at],
    )
    return LogFit(
        rows=rows,
        pseudo_ocv_v=model.model.pseudo_ocv(rows.soc_pct, rows.temperature_c),
        voltage_model_v=prediction.voltage_v,
        soc_newton_pct=_newton(model, prediction, delayed),
    )


def _newton(model: ExtendedModel, prediction: Prediction, delayed_a: FloatArray) -> FloatArray:
    """Return the Newton inverse on the rows, with the effects advanced over every sample [%]."""
    online, signals = model.online(), prediction.signals
    wanted = dict(zip(prediction.rows.tolist(), range(prediction.rows.size), strict=True))
    newton = np.empty(prediction.rows.size)
    guess = 50.0
    samples = zip(
        signals.time_s.tolist(), signals.current_a.tolist(), signals.temperature_c.tolist(),
        signals.voltage_v.tolist(), delayed_a.tolist(), strict=True,
    )  # fmt: skip
    for k, (time_s, current_a, temperature_c, voltage_v, delayed) in enumerate(samples):
        online.advance(time_s, current_a, temperature_c, delayed)
        if k in wanted:
            offset_v = model.model.offset_at(temperature_c, delayed)
            guess = soc_from_ocv(online, voltage_v - offset_v, guess).soc_pct
            newton[wanted[k]] = guess
    return newton

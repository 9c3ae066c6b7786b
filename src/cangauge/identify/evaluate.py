"""How well a voltage model explains rows of logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cangauge.identify.effects.prepared import Prepared
from cangauge.identify.rows import FitRows
from cangauge.model.delay_line import delayed_currents
from cangauge.model.extended import ExtendedModel, Prediction
from cangauge.model.inverse import soc_from_ocv
from cangauge.model.voltage_model import VoltageModel

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LogFit:
    """How the model fits one log; shape (m,) each, on the rows of the fit."""

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
        """Mean absolute error of the inverse against the counted SoC [% SoC]."""
        return float(np.mean(np.abs(self.soc_newton_pct - self.rows.soc_pct)))


def evaluate(model: VoltageModel, rows: Sequence[FitRows]) -> tuple[LogFit, ...]:
    """Return how the model explains each log's rows."""
    return tuple(_log_fit(model, item) for item in rows)


def _log_fit(model: VoltageModel, rows: FitRows) -> LogFit:
    newton = np.empty(len(rows))
    guess = 50.0
    for k in range(len(rows)):
        beside = model.offset_at(float(rows.temperature_c[k]), rows.delayed_current_a[k].tolist())
        guess = soc_from_ocv(model, float(rows.voltage_v[k]) - beside, guess).soc_pct
        newton[k] = guess
    return LogFit(
        rows=rows,
        pseudo_ocv_v=model.pseudo_ocv(rows.soc_pct, rows.temperature_c),
        voltage_model_v=model.voltage(rows.soc_pct, rows.temperature_c, rows.delayed_current_a),
        soc_newton_pct=newton,
    )


def evaluate_extended(model: ExtendedModel, logs: Sequence[Prepared]) -> tuple[LogFit, ...]:
    """Return how a model with effects explains each log's rows.

    The rows are what perfect sensors would have shown, where an effect corrects them.
    """
    return tuple(_extended_fit(model, item) for item in logs)


def _extended_fit(model: ExtendedModel, log: Prepared) -> LogFit:
    found = model.predict(log.signals, log.initial_soc_pct, log.at)
    signals = found.signals
    delayed = delayed_currents(
        signals.time_s, signals.current_a, model.model.delay_s, signals.time_s
    )
    rows = replace(
        log.rows,
        voltage_v=signals.voltage_v[log.at],
        temperature_c=signals.temperature_c[log.at],
        soc_pct=found.soc_pct[log.at],
        delayed_current_a=delayed[log.at],
    )
    return LogFit(
        rows=rows,
        pseudo_ocv_v=model.model.pseudo_ocv(rows.soc_pct, rows.temperature_c),
        voltage_model_v=found.voltage_v,
        soc_newton_pct=_newton(model, found, delayed),
    )


def _newton(model: ExtendedModel, found: Prediction, delayed_a: FloatArray) -> FloatArray:
    """Return the inverse on the rows, the effects carried through every sample [%], shape (m,)."""
    online, signals = model.online(), found.signals
    wanted = dict(zip(found.rows.tolist(), range(found.rows.size), strict=True))
    newton = np.empty(found.rows.size)
    guess = 50.0
    samples = zip(
        signals.time_s.tolist(), signals.current_a.tolist(), signals.temperature_c.tolist(),
        signals.voltage_v.tolist(), delayed_a.tolist(), strict=True,
    )  # fmt: skip
    for k, (time_s, current_a, temperature_c, voltage_v, delayed) in enumerate(samples):
        online.advance(time_s, current_a, temperature_c, delayed)
        if k in wanted:
            beside = model.model.offset_at(temperature_c, delayed)
            guess = soc_from_ocv(online, voltage_v - beside, guess).soc_pct
            newton[wanted[k]] = guess
    return newton


def slope_resistance(model: VoltageModel, rows: Sequence[FitRows]) -> tuple[float, float]:
    """Return the slope of (U − pseudo-OCV) on I, and R1 + Σ Rj·ρj, both turned positive [Ω]."""
    drop = np.concatenate(
        [item.voltage_v - model.pseudo_ocv(item.soc_pct, item.temperature_c) for item in rows]
    )
    delayed = np.concatenate([item.delayed_current_a for item in rows])
    centred = delayed - delayed.mean(axis=0)
    variance = float(centred[:, 0] @ centred[:, 0])
    correlation = centred.T @ centred[:, 0] / variance
    slope = float(centred[:, 0] @ (drop - drop.mean())) / variance
    return -slope, -float(np.array(model.resistance_ohm) @ correlation)

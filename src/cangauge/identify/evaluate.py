"""How well a voltage model explains rows of logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cangauge.identify.rows import FitRows
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

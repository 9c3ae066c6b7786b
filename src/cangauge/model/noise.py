"""Errors of the voltage that the coefficients of a model do not explain."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, NonNegativeFloat

from cangauge.model.fields import Fields, Seconds, Volts
from cangauge.model.prior import (
    BLOCK_S,
    CHEMISTRIES,
    FAST_FLOOR,
    SLOW_S,
    SLOW_SHARE,
    ChemistryName,
)
from cangauge.model.voltage_model import resistance_factor


class Noise(Fields):
    """Errors of the voltage that the coefficients do not explain."""

    level_std_v: Volts
    """Lasts a whole log."""
    slow_std_v: Volts
    slow_time_s: Seconds = SLOW_S
    fast_std_v: Volts
    """Of the mean of a block."""
    block_s: Seconds = BLOCK_S
    soc_std_pct: Annotated[float, Field(ge=0, le=50)]
    """δ: SoC against voltage (surface, hysteresis, reference), for a log and in each block."""
    cold_exponent: Annotated[float, Field(ge=0, le=4)]
    """The voltage errors grow with a(T) to this power below 20 °C."""
    residual_std_v: Volts
    """Rms residual of the rows of the fit."""
    left_out_scale: Annotated[float, Field(ge=1, le=1e6)] = 1.0
    """κ²: `level_std_v` and the covariance of the coefficients contain it already."""
    left_out_strain: Annotated[float, Field(gt=0, le=1)] = 1.0
    """What one log teaches a fit of the others, over its mean under the model; 1 without logs."""
    voltage_mae_pct: NonNegativeFloat
    voltage_rmse_v: Volts
    """Errors of left-out logs."""
    judged_on: str

    @classmethod
    def of(
        cls,
        chemistry: ChemistryName,
        mean_v: float,
        residual_v: float,
        judged: Mapping[str, Any],
        *,
        scale: float = 1.0,
        strain: float = 1.0,
    ) -> Self:
        """Return the errors of a chemistry, of mean voltage V0 [V] and rms residual [V].

        `judged` holds `voltage_mae_pct`, `voltage_rmse_v` and `judged_on`; `scale` is κ², and
        `strain` is `left_out_strain`.
        """
        typical = CHEMISTRIES[chemistry]
        return cls(
            level_std_v=typical.level_std * mean_v * scale**0.5,
            slow_std_v=float(np.hypot(typical.slow_std * mean_v, SLOW_SHARE * residual_v)),
            fast_std_v=float(np.hypot(typical.fast_factor * residual_v, FAST_FLOOR * mean_v)),
            soc_std_pct=typical.soc_std_pct,
            cold_exponent=typical.cold_exponent,
            residual_std_v=residual_v,
            left_out_scale=scale,
            left_out_strain=strain,
            **judged,
        )

    def cold(self, temperature_c: float) -> float:
        """Return the growth of the voltage errors in the cold [-], 1 or more."""
        return float(max(1.0, float(resistance_factor(temperature_c))) ** self.cold_exponent)

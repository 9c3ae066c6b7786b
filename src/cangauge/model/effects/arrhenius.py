"""Arrhenius' law: what rises in the cold."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from cangauge.model.effects.effect import FloatArray
from cangauge.model.effects.parameter import WITHIN_C

ZERO_C_IN_K: Final = 273.15
COLDEST_C, HOTTEST_C = WITHIN_C

USUAL_C: Final = 25.0


def inverse_k(temperature_c: FloatArray) -> FloatArray:
    """Return 1/T [1/K], shape (n,)."""
    return np.asarray(1.0 / (np.clip(temperature_c, COLDEST_C, HOTTEST_C) + ZERO_C_IN_K))


def inverse_k_at(temperature_c: float) -> float:
    """Return 1/T [1/K] of one temperature."""
    return 1.0 / (min(max(temperature_c, COLDEST_C), HOTTEST_C) + ZERO_C_IN_K)


def arrhenius(temperature_c: FloatArray, activation_k: float) -> FloatArray:
    """Return exp(B·(1/T − 1/T₂₅)), shape (n,): more than 1 below 25 °C."""
    return np.exp(activation_k * (inverse_k(temperature_c) - 1.0 / (USUAL_C + ZERO_C_IN_K)))


def arrhenius_at(temperature_c: float, activation_k: float) -> float:
    """Return the same of one temperature."""
    inverse = inverse_k_at(temperature_c)
    return math.exp(activation_k * (inverse - 1.0 / (USUAL_C + ZERO_C_IN_K)))

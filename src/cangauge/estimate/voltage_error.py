"""How uncertain one voltage is against the model: more where the model is out of its depth."""

from __future__ import annotations

import math
from collections.abc import Callable

from cangauge.estimate.validity import outside_model_std_v
from cangauge.model.delay_line import DelayLine
from cangauge.model.model_file import ModelFile, effective_error_std_v
from cangauge.model.voltage_model import VoltageModel

USUAL_CURRENT_C_RATE = 1.0 / 3.0
"""What a current that was not seen may have been [1/h]: 20 A at 60 Ah."""

TEMPERATURE_STD_K = 10.0
"""Uncertainty of a temperature that is not measured [K]."""


class VoltageError:
    """The fast error of the voltages that an estimator uses; its biases are states of the filter.

    Parameters
    ----------
    model : VoltageModel
    file : ModelFile
        What the model came from: its noise and rate.
    capacity_ah : float
    """

    def __init__(self, model: VoltageModel, file: ModelFile, capacity_ah: float) -> None:
        self._model = model
        self._fast_std_v = effective_error_std_v(file.noise, 1.0 / file.rate_hz)
        self._usual_a = USUAL_CURRENT_C_RATE * capacity_ah
        # The guesses of one filling delay line are the same guess for all its samples.
        self._alike = max(model.delay_s[-1] * file.rate_hz, 1.0)

    def at(self, temperature_c: float, line: DelayLine) -> Callable[[float], float]:
        """Return what gives the standard deviation of a voltage [V] by the SoC [%], NaN: unknown.

        Parameters
        ----------
        temperature_c : float
            As far as it is known [°C], else NaN.
        line : DelayLine
        """
        squares = self._fast_std_v**2
        if not line.full:
            squares = self._filling_var_v2(squares, line.filled_s)
        if math.isnan(temperature_c):
            squares += (self._model.kt_v_per_k * TEMPERATURE_STD_K) ** 2

        def std_v(soc_pct: float) -> float:
            outside_v = outside_model_std_v(self._model, soc_pct, temperature_c)
            return math.sqrt(squares + outside_v**2)

        return std_v

    def _filling_var_v2(self, settled_var_v2: float, filled_s: float) -> float:
        """Return the error's variance while the delay line fills [V²].

        The currents before the first sample are a guess, and the same guess for all samples until
        the line is full: together they must tell no more than one of them.
        """
        model = self._model
        unknown_ohm = sum(
            abs(resistance)
            for resistance, delay in zip(model.resistance_ohm, model.delay_s, strict=True)
            if delay > filled_s
        )
        return (settled_var_v2 + (unknown_ohm * self._usual_a) ** 2) * self._alike

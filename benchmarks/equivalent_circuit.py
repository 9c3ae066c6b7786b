"""Equivalent circuit of a model: the tables that the peers of the benchmarks run on.

Open-circuit voltage, series resistance and RC pairs over temperature, current and SoC. Capacity and
open-circuit voltage are those of the model. Resistances are fitted to its step response: the
voltage after a current that begins at t = 0 from rest, at constant SoC and temperature. Minimising
the integral of the squared error of the step response minimises the mean squared error of the
voltage for a current whose changes are uncorrelated.

The time constants are found once, at half charge: non-negative least squares over a grid of them,
neighbours merged, and those of RC effects as they are. Then the resistances are fitted at every
point of the tables. A resistance on the current 30 s ago is a step at 30 s, which RC pairs follow
on average only; `step_error_pct` states by how much.

Effects of sensors are no part of a pack and do not enter. Effects that depend on the sign of the
last current (hysteresis) enter as their mean response.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from scipy.optimize import nnls

from cangauge._typing import FloatArray
from cangauge.model.effects.base import Inputs
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model

CURVE_POINTS: Final = 401
"""Points of the open-circuit voltage over 0–100 % SoC: linear interpolation between them is off by
less than 1 mV for a pack of 400 V."""
RESISTANCE_SOC_PCT: Final = (0.0, 2.5, 5.0, 10.0, 20.0, 35.0, 50.0, 65.0, 80.0, 90.0, 95.0, 100.0)
C_RATES: Final = (-4.0, -2.0, -1.0, -0.5, -0.2, -0.05, 0.05, 0.2, 0.5, 1.0, 2.0, 4.0)
"""Currents of the tables relative to the capacity [1/h]."""
USUAL_C_RATE: Final = 1.0 / 3.0
"""Current at which the time constants are found [1/h]."""
TEMPERATURES: Final = 5
"""Temperatures over the identified range."""
NARROWEST_C: Final = 1.0
"""Least width of the tables [K]: simulators interpolate between different temperatures, and a model
may have been identified at a single one."""
FASTEST_S: Final = 0.5
"""Shortest time constant and time of the step response [s]: a few samples of a fast log."""
PER_DECADE: Final = 12
"""Time constants a decade in the search: neighbours differ by a fifth."""
TIMES: Final = 300
"""Times at which the step response is taken, apart from the delays."""
LASTING: Final = 4.0
"""Duration of the step response relative to the longest delay or time constant [-]: an RC pair has
then reached 98 %."""
NEGLIGIBLE: Final = 1e-3
"""RC pairs with less than this fraction of the steady resistance are left out [-]."""


def equivalent_circuit(model: Model) -> dict[str, Any]:
    """Return the tables of the equivalent circuit of a model; positive current discharges.

    Parameters
    ----------
    model : Model

    Returns
    -------
    dict
        `name`, `capacity_ah`, `charge_efficiency` and `soc_range_pct`, over which the model was
        identified; `ocv_v` [V], temperatures × `curve_soc_pct`; `series_ohm` (R0 [Ω]), and
        `pair_ohm` with the same of each RC pair, `temperature_c` × `current_a` × `soc_pct`;
        `pair_tau_s`; and `step_error_pct`, the RMS error of the step response relative to its end,
        at half charge.
    """
    extended = model.extended_model()
    counting = extended.counting(50.0)
    low_c, high_c = model.range.temperature_c
    half_c = max(0.5 * (high_c - low_c), 0.5 * NARROWEST_C)
    temperatures = 0.5 * (low_c + high_c) + half_c * np.linspace(-1.0, 1.0, TEMPERATURES)
    is_plain = not extended.effects
    if is_plain and extended.model.loads.arrhenius is None:
        temperatures = temperatures[[0, -1]]
    curve_soc = np.linspace(0.0, 100.0, CURVE_POINTS)
    response = _StepResponse(extended)
    usual = response.at(50.0, extended.model.loads.t_ref_c, USUAL_C_RATE * extended.capacity_ah)
    tau_s = response.time_constants(usual)
    _, error_ohm = response.resistances(usual, tau_s)
    amperes, socs = np.array(C_RATES) * extended.capacity_ah, np.array(RESISTANCE_SOC_PCT)
    if is_plain:
        amperes, socs = amperes[[0, -1]], socs[[0, -1]]
    places = itertools.product(temperatures, amperes, socs)
    ohm = np.array(
        [response.resistances(response.at(soc, celsius, a), tau_s)[0] for celsius, a, soc in places]
    ).reshape(temperatures.size, amperes.size, socs.size, -1)
    return {
        "name": model.name,
        "capacity_ah": counting.capacity_ah,
        "charge_efficiency": counting.charge_efficiency,
        "soc_range_pct": model.range.soc_pct,
        "temperature_c": temperatures.tolist(),
        "curve_soc_pct": curve_soc.tolist(),
        "ocv_v": [_rest_v(extended, curve_soc, celsius).tolist() for celsius in temperatures],
        "current_a": amperes.tolist(),
        "soc_pct": socs.tolist(),
        "series_ohm": ohm[..., 0].tolist(),
        "pair_tau_s": list(tau_s),
        "pair_ohm": [ohm[..., k].tolist() for k in range(1, ohm.shape[-1])],
        "step_error_pct": 100.0 * error_ohm / usual[-1],
    }


def _rest_v(extended: ExtendedModel, soc_pct: FloatArray, temperature_c: float) -> FloatArray:
    """Return the voltage after a long rest [V], shape (n,)."""
    celsius = np.full_like(soc_pct, temperature_c)
    zero = np.zeros_like(soc_pct)
    inputs = Inputs(np.arange(soc_pct.size, dtype=np.float64), zero, celsius, zero)
    return extended.model.pseudo_ocv(soc_pct, celsius) + _added_v(extended, inputs, soc_pct)


def _added_v(extended: ExtendedModel, inputs: Inputs, soc_pct: FloatArray) -> FloatArray:
    """Return the sum of the effects' voltages [V], shape (n,)."""
    every = slice(None)
    volts = np.zeros_like(soc_pct)
    for effect, values in extended.effects:
        volts += effect.added_v(inputs, every, soc_pct, values, extended)
    return volts


class _StepResponse:
    """Drop per ampere after a current begins, sampled in the middle of intervals."""

    def __init__(self, extended: ExtendedModel) -> None:
        self._extended = extended
        of_effects = {values["tau_s"] for effect, values in extended.effects if effect.is_rc}
        own = {*of_effects, *extended.model.loads.low_pass_s}
        self._own_tau_s = sorted(tau for tau in own if tau >= FASTEST_S)
        delays = [delay for delay in extended.model.loads.delays_s if delay > 0.0]
        self._last_s = LASTING * max([FASTEST_S, *delays, *self._own_tau_s])
        edges = np.union1d([0.0, *delays], np.geomspace(0.1 * FASTEST_S, self._last_s, TIMES))
        self.time_s = 0.5 * (edges[1:] + edges[:-1])
        self._weight = np.sqrt(np.diff(edges) / self._last_s)

    def at(self, soc_pct: float, temperature_c: float, current_a: float) -> FloatArray:
        """Return the drop per ampere [Ω], shape (times,), positive."""
        time_s = np.concatenate(([0.0], self.time_s))
        one = np.ones_like(time_s)
        model = self._extended.model
        flows = [time_s >= delay for delay in model.loads.delays_s]
        smooth = [-np.expm1(-time_s / tau) for tau in model.loads.low_pass_s]
        currents = np.column_stack([*flows, *smooth]).astype(np.float64)
        columns = model.load_columns(temperature_c * one, currents)[:, 1:]
        unit_v = columns @ model.load_coefficients[1:]

        def volts(amperes: float) -> FloatArray:
            inputs = Inputs(time_s, amperes * one, temperature_c * one, amperes * unit_v)
            added_v = _added_v(self._extended, inputs, soc_pct * one)
            return np.asarray(amperes * unit_v + added_v)

        return np.asarray((volts(0.0) - volts(current_a))[1:] / current_a)

    def time_constants(self, response_ohm: FloatArray) -> tuple[float, ...]:
        """Return the time constants of the RC pairs that follow a response [s], increasing."""
        decades = np.log10(self._last_s / LASTING / FASTEST_S)
        grid = np.geomspace(
            FASTEST_S, self._last_s / LASTING, max(round(PER_DECADE * decades), 1) + 1
        )
        tau_s = np.union1d(grid, self._own_tau_s)
        ohm = self.resistances(response_ohm, tau_s)[0][1:]
        kept = ohm > NEGLIGIBLE * response_ohm[-1]
        merged: list[tuple[float, float]] = []  # resistance, time constant
        last = -2
        for place in np.flatnonzero(kept):
            if place == last + 1 and tau_s[place] not in self._own_tau_s:
                before_ohm, before_s = merged.pop()
                total = before_ohm + ohm[place]
                share = ohm[place] / total
                merged.append((total, before_s ** (1.0 - share) * tau_s[place] ** share))
            else:
                merged.append((float(ohm[place]), float(tau_s[place])))
            last = int(place)
        return tuple(float(tau) for _, tau in merged)

    def resistances(
        self, response_ohm: FloatArray, tau_s: Sequence[float] | FloatArray
    ) -> tuple[FloatArray, float]:
        """Return R0 and those of the pairs [Ω], and the RMS error of the response [Ω]."""
        rise = 1.0 - np.exp(-self.time_s[:, None] / np.asarray(tau_s))
        columns = np.column_stack([np.ones_like(self.time_s), rise])
        ohm, error = nnls(columns * self._weight[:, None], response_ohm * self._weight)
        return ohm, float(error)

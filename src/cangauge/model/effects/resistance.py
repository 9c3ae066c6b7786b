"""Changes of the pack's resistance: with temperature, SoC, direction of current, and in a step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.model.effects.base import (
    DELAYED,
    LAG,
    WITHIN_C,
    CoreForm,
    Effect,
    OnlineEffect,
    OnlineInteriorEffect,
    Pack,
    PackState,
    Parameter,
    Values,
    scaled_drop_at,
)
from cangauge.model.voltage_model import VoltageModel

ZERO_C_IN_K: Final = 273.15
COLDEST_C, HOTTEST_C = WITHIN_C

REFERENCE_C: Final = 25.0
"""Temperature at which Arrhenius factors are 1 [°C]."""


def _inverse_k(temperature_c: FloatArray) -> FloatArray:
    """Return 1/T [1/K], shape (n,)."""
    return np.asarray(1.0 / (np.clip(temperature_c, COLDEST_C, HOTTEST_C) + ZERO_C_IN_K))


def _inverse_k_at(temperature_c: float) -> float:
    """Return 1/T [1/K] of one temperature."""
    return 1.0 / (min(max(temperature_c, COLDEST_C), HOTTEST_C) + ZERO_C_IN_K)


def arrhenius(temperature_c: FloatArray, activation_k: float) -> FloatArray:
    """Return exp(B·(1/T − 1/T₂₅)), shape (n,): greater than 1 below 25 °C."""
    return np.exp(activation_k * (_inverse_k(temperature_c) - 1.0 / (REFERENCE_C + ZERO_C_IN_K)))


def arrhenius_at(temperature_c: float, activation_k: float) -> float:
    """Return `arrhenius` of one temperature."""
    inverse = _inverse_k_at(temperature_c)
    return math.exp(activation_k * (inverse - 1.0 / (REFERENCE_C + ZERO_C_IN_K)))


class ResistanceTemperature(Effect):
    """A share of the voltage model's drop that follows Arrhenius' law: it rises in the cold.

    It is zero at `reference_c`, the middle of the identified temperature range when the effect was
    added. The temperature is that of the cell interior, `lag_s` behind the measured one.
    """

    id = "resistance_temperature"
    family = "resistance"
    is_pointwise: ClassVar[bool] = True
    is_structure: ClassVar[bool] = True
    parameters = (
        Parameter("share", "1", 0.0, 3.0),
        Parameter("activation_k", "K", 100.0, 8000.0, neutral=None, grid=(1000.0, 2500.0, 4500.0)),
        DELAYED,
        Parameter(
            "reference_c", "°C", *WITHIN_C, neutral=None, from_pack="temperature_c",
            diagnosis_values=(-15.0, 15.0),
        ),
        LAG,
    )  # fmt: skip
    signature = "the drop over the resistance, growing with (T₀ − T)"
    equation = (
        "ΔU = a·ΣRj·I(t − dj)·(exp(B·(1/T − 1/T₀)) − 1), T₀ = reference_c;"
        " or ΣRj·I in place of ΣRj·I(t − dj); τ·dT/dt = T_measured − T, τ = lag_s"
    )
    source = "Waag, Käbitz, Sauer, Applied Energy 102 (2013) 885"
    separated_by = (
        "the same SoC at two temperatures (a second day): where temperature and SoC move"
        " together it is not separable from resistance_soc"
    )

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        drop_v = state.scaled_drop_v(values["delayed"], pack)
        colder = _inverse_k(state.lagged_temperature_c(values["lag_s"]))
        colder = colder - _inverse_k_at(values["reference_c"])
        return values["share"] * drop_v * np.expm1(values["activation_k"] * colder)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        return _ResistanceTemperatureOnline(values, pack.resistance_ohm)


class _ResistanceTemperatureOnline(OnlineInteriorEffect):
    def __init__(self, values: Values, resistance_ohm: float) -> None:
        super().__init__(values["lag_s"])
        self._share = values["share"]
        self._activation_k = values["activation_k"]
        self._delayed = values["delayed"]
        self._reference_per_k = _inverse_k_at(values["reference_c"])
        self._resistance_ohm = resistance_ohm

    def core_form(self) -> CoreForm:
        values = (
            self._share, self._activation_k, self._delayed, self._reference_per_k,
            self._resistance_ohm,
        )  # fmt: skip
        return CoreForm("resistance_temperature", values, (self.interior.tau_s,))

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        scaled_v = scaled_drop_at(drop_v, current_a, self._delayed, self._resistance_ohm)
        colder = _inverse_k_at(self.interior.step(time_s, temperature_c)) - self._reference_per_k
        self.volts = self._share * scaled_v * math.expm1(self._activation_k * colder)


class ResistanceSoc(Effect):
    """Relative change of the drop that decays exponentially from empty and from full."""

    id = "resistance_soc"
    family = "resistance"
    is_pointwise: ClassVar[bool] = True
    is_structure: ClassVar[bool] = True
    parameters = (
        Parameter("at_empty", "1", -0.4, 3.0),
        Parameter("at_full", "1", -0.4, 1.5),
        Parameter("width_pct", "%", 3.0, 60.0, neutral=None, grid=(5.0, 10.0, 20.0, 40.0)),
        DELAYED,
    )
    signature = "I·f(S): the drop over the resistance, larger near empty"
    equation = "ΔU = ΣRj·I(t − dj)·(a·exp(−S/w) + b·exp(−(100 − S)/w)); or ΣRj·I in its place"
    source = "Waag, Käbitz, Sauer, Applied Energy 102 (2013) 885"
    separated_by = (
        "the same SoC at two temperatures: in one discharge SoC and temperature move together"
        " and it is not separable from resistance_temperature"
    )

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        soc, width = np.clip(state.soc_pct, 0.0, 100.0), values["width_pct"]
        rise = values["at_empty"] * np.exp(-soc / width)
        rise += values["at_full"] * np.exp((soc - 100.0) / width)
        return np.asarray(state.scaled_drop_v(values["delayed"], pack) * rise)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        return _ResistanceSocOnline(values, pack.resistance_ohm)


class _ResistanceSocOnline(OnlineEffect):
    uses_soc = True

    def __init__(self, values: Values, resistance_ohm: float) -> None:
        self._at_empty = values["at_empty"]
        self._at_full = values["at_full"]
        self._width_pct = values["width_pct"]
        self._delayed = values["delayed"]
        self._resistance_ohm = resistance_ohm
        self._drop_v = 0.0

    def core_form(self) -> CoreForm:
        values = (
            self._at_empty, self._at_full, self._width_pct, self._delayed, self._resistance_ohm,
        )  # fmt: skip
        return CoreForm("resistance_soc", values)

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        self._drop_v = scaled_drop_at(drop_v, current_a, self._delayed, self._resistance_ohm)

    def extra_voltage(self, soc_pct: float) -> float:
        soc = min(max(soc_pct, 0.0), 100.0)
        rise = self._at_empty * math.exp(-soc / self._width_pct)
        rise += self._at_full * math.exp((soc - 100.0) / self._width_pct)
        return self._drop_v * rise


class ResistanceAsymmetry(Effect):
    """Additional (or missing) resistance to charging current."""

    id = "resistance_asymmetry"
    family = "resistance"
    is_pointwise: ClassVar[bool] = True
    is_structure: ClassVar[bool] = True
    parameters = (Parameter("charging_ohm", "ohm", -0.6, 1.5, scale="resistance"),)
    signature = "min(I, 0): only while charging, in step with the current"
    equation = "ΔU = −r·min(I, 0)"
    source = "Hu, Li, Peng, J. Power Sources 198 (2012) 359"
    separated_by = (
        "charging and discharging pulses of several sizes: charge_transfer bends with the size"
        " of the current, equally in both directions"
    )

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        return np.asarray(-values["charging_ohm"] * np.minimum(state.current_a, 0.0))

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        return _ResistanceAsymmetryOnline(values["charging_ohm"])


class _ResistanceAsymmetryOnline(OnlineEffect):
    def __init__(self, charging_ohm: float) -> None:
        self._charging_ohm = charging_ohm

    def core_form(self) -> CoreForm:
        return CoreForm("resistance_asymmetry", (self._charging_ohm,))

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        self.volts = -self._charging_ohm * min(current_a, 0.0)


class ResistanceStep(Effect):
    """Additional resistance from a time on: a contact works loose, or is repaired.

    The time counts from the log's first sample, online from the service's first sample. A step
    that has happened persists, so a model for later drives has `start_s` = 0.
    """

    id = "resistance_step"
    family = "resistance"
    parameters = (
        Parameter("step_ohm", "ohm", -0.4, 2.0, scale="resistance"),
        Parameter(
            "start_s", "s", 0.0, 1e7, neutral=None, is_change_point=True,
            grid=(0.0, 300.0, 600.0, 1200.0, 1800.0, 2700.0, 3600.0, 5400.0, 7200.0),
        ),
    )  # fmt: skip
    signature = "I·1(t > t₀): the drop over the resistance changes in a step and stays changed"
    equation = "ΔU = −r·I for t − t_first ≥ t₀, else 0"
    source = "definition"
    separated_by = (
        "the same load before and after at the same SoC and temperature:"
        " resistance_temperature and resistance_soc revert, a step does not"
    )

    def trials(self, parameter: Parameter, pack: Pack, time_s: FloatArray) -> tuple[float, ...]:
        """Return times spread evenly over the log, without its ends [s]."""
        if parameter.name != "start_s":
            return parameter.trials(pack)
        duration = float(time_s[-1] - time_s[0])
        return tuple(duration * part / 20.0 for part in range(1, 20))

    def extra_voltage(
        self, state: PackState, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        after = state.time_s - state.time_s[0] >= values["start_s"]
        return np.where(after, -values["step_ohm"] * state.current_a, 0.0)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        return _ResistanceStepOnline(values["step_ohm"], values["start_s"])


class _ResistanceStepOnline(OnlineEffect):
    def __init__(self, step_ohm: float, start_s: float) -> None:
        self._step_ohm = step_ohm
        self._start_s = start_s
        self._first_s: float | None = None

    def core_form(self) -> CoreForm:
        return CoreForm("resistance_step", (self._step_ohm, self._start_s))

    def advance(self, time_s: float, current_a: float, temperature_c: float, drop_v: float) -> None:
        if self._first_s is None:
            self._first_s = time_s
        after = time_s - self._first_s >= self._start_s
        self.volts = -self._step_ohm * current_a if after else 0.0

    def state(self) -> list[float]:
        return [] if self._first_s is None else [self._first_s]

    def restore(self, state: Sequence[float], latest_s: float) -> None:
        self._first_s = None
        if state:
            (self._first_s,) = state
            if not self._first_s <= latest_s:
                raise ValueError("later than the latest sample")

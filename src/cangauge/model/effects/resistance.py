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
    Load,
    Memories,
    Pack,
    Parameter,
    Values,
)
from cangauge.model.first_order import Lag, Memory
from cangauge.model.voltage_model import VoltageModel

REFERENCE_C: Final = 25.0
"""Temperature at which Arrhenius factors are 1 [°C]."""


def inverse_k(temperature_c: FloatArray | float) -> FloatArray:
    """Return 1/T [1/K]."""
    return np.asarray(1.0 / (np.clip(temperature_c, *WITHIN_C) + 273.15))


def arrhenius(temperature_c: FloatArray, activation_k: float) -> FloatArray:
    """Return exp(B·(1/T − 1/T₂₅)), shape (n,): greater than 1 below 25 °C."""
    return np.asarray(np.exp(activation_k * (inverse_k(temperature_c) - inverse_k(REFERENCE_C))))


class ResistanceTemperature(Effect):
    """A share of the voltage model's drop that follows Arrhenius' law: it rises in the cold.

    It is zero at `reference_c`, the middle of the identified temperature range when the effect was
    added. The temperature is that of the cell interior, `lag_s` behind the measured one.
    """

    id = "resistance_temperature"
    family = "resistance"
    scales_drop: ClassVar[bool] = True
    parameters = (
        Parameter("share", "1", 0.0, 3.0),
        Parameter("activation_k", "K", 100.0, 8000.0, neutral=None, grid=(1000.0, 2500.0, 4500.0)),
        DELAYED,
        Parameter("reference_c", "°C", *WITHIN_C, neutral=None, from_pack="temperature_c"),
        LAG,
    )
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

    def memory(self, values: Values, pack: Pack) -> Memories:
        return (Lag(values["lag_s"]),)

    def drive(
        self, load: Load, values: Values, model: VoltageModel, pack: Pack, memory: Memories
    ) -> FloatArray:
        interior_c = memory[0].step(load.time_s, load.temperature_c)
        colder = inverse_k(interior_c) - inverse_k(values["reference_c"])
        scaled_v = load.scaled_drop_v(values["delayed"], pack)
        return np.asarray(values["share"] * scaled_v * np.expm1(values["activation_k"] * colder))

    def core_form(self, values: Values, model: VoltageModel, pack: Pack) -> CoreForm:
        constants = (
            values["share"],
            values["activation_k"],
            values["delayed"],
            float(inverse_k(values["reference_c"])),
            pack.resistance_ohm,
        )
        return CoreForm("resistance_temperature", constants, (values["lag_s"],))


class ResistanceSoc(Effect):
    """Relative change of the drop that decays exponentially from empty and from full."""

    id = "resistance_soc"
    family = "resistance"
    scales_drop: ClassVar[bool] = True
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

    def drive(
        self, load: Load, values: Values, model: VoltageModel, pack: Pack, memory: Memories
    ) -> FloatArray:
        return load.scaled_drop_v(values["delayed"], pack)

    def over_soc(
        self, soc_pct: FloatArray, values: Values, model: VoltageModel, pack: Pack
    ) -> FloatArray:
        soc, width = np.clip(soc_pct, 0.0, 100.0), values["width_pct"]
        rise = values["at_empty"] * np.exp(-soc / width)
        return np.asarray(rise + values["at_full"] * np.exp((soc - 100.0) / width))

    def core_form(self, values: Values, model: VoltageModel, pack: Pack) -> CoreForm:
        names = ("at_empty", "at_full", "width_pct", "delayed")
        constants = (*(values[name] for name in names), pack.resistance_ohm)
        return CoreForm("resistance_soc", constants)


class ResistanceAsymmetry(Effect):
    """Additional (or missing) resistance to charging current."""

    id = "resistance_asymmetry"
    family = "resistance"
    parameters = (Parameter("charging_ohm", "ohm", -0.6, 1.5, scale="resistance"),)
    signature = "min(I, 0): only while charging, in step with the current"
    equation = "ΔU = −r·min(I, 0)"
    source = "Hu, Li, Peng, J. Power Sources 198 (2012) 359"
    separated_by = (
        "charging and discharging pulses of several sizes: charge_transfer bends with the size"
        " of the current, equally in both directions"
    )

    def drive(
        self, load: Load, values: Values, model: VoltageModel, pack: Pack, memory: Memories
    ) -> FloatArray:
        return np.asarray(-values["charging_ohm"] * np.minimum(load.current_a, 0.0))

    def core_form(self, values: Values, model: VoltageModel, pack: Pack) -> CoreForm:
        return CoreForm("resistance_asymmetry", (values["charging_ohm"],))


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

    def memory(self, values: Values, pack: Pack) -> Memories:
        return (_First(),)

    def drive(
        self, load: Load, values: Values, model: VoltageModel, pack: Pack, memory: Memories
    ) -> FloatArray:
        after = load.time_s - memory[0].of(load.time_s) >= values["start_s"]
        return np.where(after, -values["step_ohm"] * load.current_a, 0.0)

    def core_form(self, values: Values, model: VoltageModel, pack: Pack) -> CoreForm:
        return CoreForm("resistance_step", (values["step_ohm"], values["start_s"]))


class _First(Memory):
    """Time of the first sample."""

    def __init__(self) -> None:
        self._first_s: float | None = None

    def of(self, time_s: FloatArray) -> float:
        """Return the time of the first sample ever [s], given the times of the next ones."""
        if self._first_s is None:
            self._first_s = float(time_s[0])
        return self._first_s

    def state(self) -> list[float]:
        return [] if self._first_s is None else [self._first_s]

    def restore(self, state: Sequence[float]) -> None:
        self._first_s = None
        if state:
            (self._first_s,) = state
            if not math.isfinite(self._first_s):
                raise ValueError("not finite")

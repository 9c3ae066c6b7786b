"""Nine faults: what a user reads of each, and the measurement to do first."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from cangauge._text import number, significant
from cangauge.diagnosis.evidence import EffectEvidence
from cangauge.model.effects.base import Pack


@dataclass(frozen=True)
class Quantity:
    """Value of a parameter with its 95 % interval.

    Parameters
    ----------
    value : float
    unit : str
    ci : (float, float), optional
        None for a shape.
    """

    value: float
    unit: str
    ci: tuple[float, float] | None


@dataclass(frozen=True)
class Began:
    """Start of the first log.

    Parameters
    ----------
    log : str
        What a sentence calls it.
    soc_pct : float
        As stated [%].
    """

    log: str
    soc_pct: float


Sized = Callable[[Mapping[str, Quantity], Pack, Began], str]
"""(parameters, pack, start) → the answer in one sentence, without its end."""


@dataclass(frozen=True)
class FaultWords:
    """What an engineer would repair.

    Parameters
    ----------
    title : str
        As in "likelihood: …".
    measurement : str
        What settles it, as a noun.
    instruction : str
        The same, to do first.
    """

    title: str
    measurement: str
    instruction: str


FAULT: Final[Mapping[str, FaultWords]] = {
    "voltage_reading": FaultWords(
        "voltage reading",
        "a meter on the terminals",
        "Put a meter on the pack's terminals and compare.",
    ),
    "current_reading": FaultWords(
        "current reading",
        "a clamp meter",
        "Compare with a clamp meter, and read the sensor at open contactors.",
    ),
    "start": FaultWords(
        "wrong start",
        "a rest of an hour before the start",
        "Rest the pack for an hour, or charge it fully, before the next log.",
    ),
    "capacity": FaultWords(
        "capacity",
        "a counted discharge",
        "Count a discharge from full to empty, and the charge back.",
    ),
    "clock": FaultWords(
        "clock",
        "the time stamps of a sharp pulse",
        "Compare the time stamps of current and voltage on a sharp pulse.",
    ),
    "temperature": FaultWords(
        "temperature", "a second thermometer", "Compare with a second thermometer on the cells."
    ),
    "resistance": FaultWords(
        "resistance",
        "the same pulse, warm and cold",
        "Repeat one pulse at the same SoC, warm and cold, and check the contacts.",
    ),
    "slow_voltage": FaultWords(
        "slow voltage",
        "rests of an hour after discharge and after charge",
        "Rest for an hour after a discharge and after a charge to the same SoC.",
    ),
    "weak_cell": FaultWords(
        "weak cell",
        "the cell voltages near empty",
        "Read the voltages of the single cells near empty.",
    ),
}
"""Fault → its words."""


def shown_unit(unit: str) -> str:
    """Return the unit of a parameter as a reader sees it."""
    return "" if unit == "1" else unit.replace("ohm", "Ω")


def _between(item: Quantity, factor: float = 1.0, unit: str | None = None) -> str:
    """Return an absolute value with its interval, such as "7.8 V (6.5–9.1 V"; the bracket open."""
    unit = shown_unit(item.unit) if unit is None else unit
    value = factor * item.value
    low, high = sorted(factor * end for end in item.ci or (item.value, item.value))
    if value < 0.0:
        value, low, high = -value, -high, -low
    digits = 2 if value < 100.0 else 3
    ends = f"{significant(max(low, 0.0), digits)}–{significant(high, digits, unit)}"
    return f"{significant(value, digits, unit)} ({ends}"


def _of(parameters: Mapping[str, Quantity], name: str) -> Quantity:
    return parameters[name]


def _sign(item: Quantity, positive: str, negative: str) -> str:
    return positive if item.value > 0.0 else negative


def _voltage_offset(p: Mapping[str, Quantity], pack: Pack, _: Began) -> str:
    item = p["offset_v"]
    part = number(100.0 * abs(item.value) / pack.voltage_v, 1, "%")
    return f"The pack voltage reads {_between(item)}, {part}) {_sign(item, 'too high', 'too low')}"


def _voltage_gain(p: Mapping[str, Quantity], pack: Pack, _: Began) -> str:
    item = p["gain_pct"]
    volts = _between(item, pack.voltage_v / 100.0, "V")
    part = number(abs(item.value), 1, "%")
    return f"The pack voltage reads {volts}, {part}) {_sign(item, 'too high', 'too low')}"


def _current_offset(p: Mapping[str, Quantity], _: Pack, __: Began) -> str:
    item = p["offset_a"]
    return f"The current reads {_between(item)}) {_sign(item, 'too high', 'too low')}"


def _current_gain(p: Mapping[str, Quantity], _: Pack, __: Began) -> str:
    item = p["gain_pct"]
    return f"The current reads {_between(item)}) {_sign(item, 'too high', 'too low')}"


def _start(p: Mapping[str, Quantity], _: Pack, began: Began) -> str:
    item, stated = p["offset_pct"], began.soc_pct
    low, high = (stated + end for end in item.ci or (item.value, item.value))
    true = f"{stated + item.value:.0f} % SoC ({low:.0f}–{high:.0f} %)"
    return f"{began.log} began at {true}, not at {stated:.0f} %"


def _capacity(p: Mapping[str, Quantity], pack: Pack, _: Began) -> str:
    item = p["change_pct"]
    low, high = (pack.capacity_ah * (1.0 + end / 100.0) for end in item.ci or (item.value,) * 2)
    now = pack.capacity_ah * (1.0 + item.value / 100.0)
    ends = f"{significant(low, 3)}–{significant(high, 3, 'Ah')}"
    assumed = significant(pack.capacity_ah, 3, "Ah")
    return f"The capacity is {significant(now, 3, 'Ah')} ({ends}), not {assumed}"


def _efficiency(p: Mapping[str, Quantity], _: Pack, __: Began) -> str:
    item = p["efficiency"]
    lost = Quantity(1.0 - item.value, "1", item.ci and (1.0 - item.ci[1], 1.0 - item.ci[0]))
    return f"{_between(lost, 100.0, '%')}) of the charging current is not stored"


def _skew(p: Mapping[str, Quantity], _: Pack, __: Began) -> str:
    item = p["skew_s"]
    return f"The current is recorded {_between(item)}) {_sign(item, 'late', 'early')}"


def _warmer(p: Mapping[str, Quantity], _: Pack, __: Began) -> str:
    item = p["offset_k"]
    return f"The temperature reads {_between(item)}) {_sign(item, 'too high', 'too low')}"


def _lag(p: Mapping[str, Quantity], _: Pack, __: Began) -> str:
    return f"The thermometer lags by {_between(p['tau_s'])})"


def _core(p: Mapping[str, Quantity], _: Pack, __: Began) -> str:
    if p["late"].value:
        return f"The cells follow the thermometer with {p['tau_s'].value / 60.0:.0f} min of lag"
    return f"The cells are {_between(p['rise_k'])}) warmer than the thermometer at a lasting 1 C"


def _entropic(p: Mapping[str, Quantity], _: Pack, __: Began) -> str:
    names = ("level_v_per_k", "slope_v_per_k", "curve_v_per_k")
    item = max((p[name] for name in names), key=lambda item: abs(item.value))
    per_k = _between(item, 1e3, "mV/K")
    more = _sign(item, "more", "less")
    return f"The voltage changes with temperature by {per_k}) {more} than before"


def _growth(p: Mapping[str, Quantity], pack: Pack, _: Began) -> str:
    item = p["share"]
    part = number(100.0 * abs(item.value), 0, "%")
    grown = _sign(item, "grown", "fallen")
    return f"The resistance has {grown} by {_between(item, pack.resistance_ohm, 'Ω')}, {part})"


def _step(p: Mapping[str, Quantity], _: Pack, __: Began) -> str:
    item = p["step_ohm"]
    minute = p["start_s"].value / 60.0
    grown = _sign(item, "grows", "falls")
    return f"The resistance {grown} by {_between(item)}) in minute {minute:.0f}"


def _cold(p: Mapping[str, Quantity], _: Pack, __: Began) -> str:
    share = _between(p["share"], 100.0, "%")
    return f"The resistance grows more in the cold, {share}) of Arrhenius' law"


def _over_soc(p: Mapping[str, Quantity], _: Pack, __: Began) -> str:
    name = max(("at_empty", "at_full"), key=lambda name: abs(p[name].value))
    end = "empty" if name == "at_empty" else "full"
    item = p[name]
    grown = _sign(item, "larger", "smaller")
    return f"The resistance is {_between(item, 100.0, '%')}) {grown} towards {end}"


def _charging(p: Mapping[str, Quantity], _: Pack, __: Began) -> str:
    item = p["charging_ohm"]
    return f"The resistance to charging is {_between(item)}) {_sign(item, 'larger', 'smaller')}"


def _bend(p: Mapping[str, Quantity], _: Pack, __: Began) -> str:
    scale = _between(p["scale_v"])
    return f"The drop at small currents has grown by charge transfer, scale {scale})"


def _tail(p: Mapping[str, Quantity], _: Pack, __: Began) -> str:
    tail = f"with a tail of {p['tau_s'].value:.0f} s"
    return f"The resistance has grown by {_between(p['ohm'])}) {tail}"


def _slow(p: Mapping[str, Quantity], _: Pack, __: Began) -> str:
    minutes = p["tau_s"].value / 60.0
    size = _between(p["ohm"])
    return f"A voltage of {size}) times the current comes and goes over {minutes:.0f} min"


def _memory(p: Mapping[str, Quantity], _: Pack, __: Began) -> str:
    return f"A voltage of ± {_between(p['half_width_v'])}) stays after discharge and after charge"


def _weak(p: Mapping[str, Quantity], _: Pack, __: Began) -> str:
    behind = f"{p['deficit_pct'].value:.0f} % behind"
    return f"{_between(p['fraction'], 100.0, '%')}) of the cells are about {behind}"


SIZES: Final[Mapping[str, Sized]] = {
    "voltage_offset": _voltage_offset,
    "voltage_gain": _voltage_gain,
    "current_offset": _current_offset,
    "current_gain": _current_gain,
    "initial_soc": _start,
    "capacity": _capacity,
    "coulombic_efficiency": _efficiency,
    "time_skew": _skew,
    "temperature_offset": _warmer,
    "temperature_lag": _lag,
    "core_temperature": _core,
    "entropic_coefficient": _entropic,
    "resistance_growth": _growth,
    "resistance_step": _step,
    "resistance_temperature": _cold,
    "resistance_soc": _over_soc,
    "resistance_asymmetry": _charging,
    "charge_transfer": _bend,
    "fast_polarization": _tail,
    "slow_diffusion": _slow,
    "hysteresis": _memory,
    "weak_cell": _weak,
}
"""Effect → its size in a sentence."""


def sentence(
    evidence: EffectEvidence, parameters: Mapping[str, Quantity], pack: Pack, began: Began
) -> str:
    """Return what a fault does, how much and how sure, without the end of the sentence."""
    effect = evidence.shape.effect
    if effect.id in SIZES:
        return SIZES[effect.id](parameters, pack, began)
    words = FAULT[effect.fault].title
    return f"{words[0].upper()}{words[1:]}: {effect.id.replace('_', ' ')}"

"""Nine faults: what a user reads of each, and the measurement to do first."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from cangauge._text import number, significant
from cangauge.diagnosis.evidence import Evidence, Quantity
from cangauge.model.effects.base import Pack


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


SENTENCE: Final[Mapping[str, str]] = {
    "voltage_offset": "The pack voltage reads {size}, {of_voltage}) too [high|low]",
    "voltage_gain": "The pack voltage reads {at_pack_v}, {of_gain}) too [high|low]",
    "current_offset": "The current reads {size}) too [high|low]",
    "current_gain": "The current reads {size}) too [high|low]",
    "initial_soc": "{log} began at {true_pct:.0f} % SoC {pct}, not at {stated_pct:.0f} %",
    "capacity": "The capacity is {true_ah} {ah}, not {assumed_ah}",
    "coulombic_efficiency": "{lost}) of the charging current is not stored",
    "time_skew": "The current is recorded {size}) [late|early]",
    "temperature_offset": "The temperature reads {size}) too [high|low]",
    "temperature_lag": "The thermometer lags by {size})",
    "core_temperature": "The cells are {size}) warmer than the thermometer at a lasting 1 C",
    "core_temperature_late": "The cells follow the thermometer with {tau_min:.0f} min of lag",
    "entropic_coefficient": "The voltage changes with temperature by {milli}) [more|less] than"
    " before",
    "resistance_growth": "The resistance has [grown|fallen] by {at_pack_ohm}, {of_share})",
    "resistance_step": "The resistance [grows|falls] by {size}) in minute {start_min:.0f}",
    "resistance_temperature": "The resistance grows more in the cold, {percent}) of Arrhenius' law",
    "resistance_soc": "The resistance is {percent}) [larger|smaller] towards {end}",
    "resistance_asymmetry": "The resistance to charging is {size}) [larger|smaller]",
    "charge_transfer": "The drop at small currents has grown by charge transfer, scale {size})",
    "fast_polarization": "The resistance has grown by {size}) with a tail of {tau_s:.0f} s",
    "slow_diffusion": "A voltage of {size}) times the current comes and goes over {tau_min:.0f}"
    " min",
    "hysteresis": "A voltage of ± {size}) stays after discharge and after charge",
    "weak_cell": "{percent}) of the cells are about {deficit_pct:.0f} % behind",
}
"""Effect → its size in a sentence, without the end; of [one|other] the first where it is positive.
A size ends within its bracket, such as "7.8 V (6.5–9.1 V"."""


def shown_unit(unit: str) -> str:
    """Return the unit of a parameter as a reader sees it."""
    return "" if unit == "1" else unit.replace("ohm", "Ω")


def sentence(evidence: Evidence, pack: Pack, log: str, start_pct: float) -> str:
    """Return what a fault does, how much and how sure, without the end of the sentence.

    `log` is what to call the first log, and `start_pct` the SoC at which it is said to begin [%].
    """
    effect, name, parameters = evidence.shape.effect, evidence.shape.name, evidence.parameters
    values = {each: item.value for each, item in parameters.items()}
    key = f"{effect.id}_late" if values.get("late") else effect.id
    if key not in SENTENCE:
        words = FAULT[effect.fault].title
        return f"{words[0].upper()}{words[1:]}: {effect.id.replace('_', ' ')}"
    item = parameters[name]
    value, (low, high) = item.value, item.ci or (item.value, item.value)
    now, least, most = (pack.capacity_ah * (1.0 + each / 100.0) for each in (value, low, high))
    fields = {
        "log": log,
        "size": _shown(item, 1.0, shown_unit(item.unit)),
        "percent": _shown(item, 100.0, "%"),
        "milli": _shown(item, 1e3, f"m{item.unit}"),
        "lost": _shown(Quantity(1.0 - value, (1.0 - high, 1.0 - low), "1"), 100.0, "%"),
        "at_pack_v": _shown(item, pack.voltage_v / 100.0, "V"),
        "at_pack_ohm": _shown(item, pack.resistance_ohm, "Ω"),
        "of_voltage": number(100.0 * abs(value) / pack.voltage_v, 1, "%"),
        "of_gain": number(abs(value), 1, "%"),
        "of_share": number(100.0 * abs(value), 0, "%"),
        "end": name.removeprefix("at_"),
        "stated_pct": start_pct,
        "true_pct": start_pct + value,
        "pct": f"({start_pct + low:.0f}–{start_pct + high:.0f} %)",
        "true_ah": significant(now, 3, "Ah"),
        "ah": f"({significant(least, 3)}–{significant(most, 3, 'Ah')})",
        "assumed_ah": significant(pack.capacity_ah, 3, "Ah"),
    }
    minutes = {f"{each[:-2]}_min": v / 60.0 for each, v in values.items() if each.endswith("_s")}
    text = re.sub(r"\[(.*?)\|(.*?)\]", r"\1" if value > 0.0 else r"\2", SENTENCE[key])
    return text.format_map(values | minutes | fields)


def _shown(item: Quantity, factor: float, unit: str) -> str:
    """Return an absolute value with its interval; the bracket stays open."""
    value = factor * item.value
    low, high = sorted(factor * end for end in item.ci or (item.value, item.value))
    if value < 0.0:
        value, low, high = -value, -high, -low
    digits = 2 if value < 100.0 else 3
    ends = f"{significant(max(low, 0.0), digits)}–{significant(high, digits, unit)}"
    return f"{significant(value, digits, unit)} ({ends}"

"""Texts of the files that `cangauge init` writes: DBC, map and configuration, with comments."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from cangauge.bus.mapping import VehicleMap
from cangauge.bus.vehicle import EXTENDED
from cangauge.extras.discovery.pairs import (
    CURRENT_SCALES,
    SOC_SCALES,
    VOLTAGE_SCALES,
    SignalCandidate,
    is_capacity,
    range_text,
)

UNITS: Final = {"current": "A", "voltage": "V", "temperature": "°C", "soc_reference": "%"}
SIGNALS: Final = {
    "current": "current_a",
    "voltage": "voltage_v",
    "temperature": "temperature_c",
    "soc_reference": "soc_pct",
}
"""Names of the signals in a DBC that is written."""
FALLBACK_C: Final = 20.0
"""Temperature of a map without one [°C]: the reference temperature of the voltage model."""
_NOMINAL_CELL_V: Final = 3.7
"""Nominal voltage of an oxide cell [V]: tells how many cells a scale would mean."""
_LONGEST_PAIR_S: Final = 1.0


@dataclass(frozen=True)
class Assignment:
    """A signal of a DBC with its role: `comments` are the lines above its table in the map."""

    message: str
    signal: str
    sign: int = 1
    comments: tuple[str, ...] = ()


@dataclass(frozen=True)
class Proposal:
    """What a map file is to say.

    Parameters
    ----------
    name, dbc : str
        Name of the car, and of the DBC file beside the map.
    roles : mapping of str to Assignment
    comments : tuple of str
        Lines at the top.
    pair_within_s : float
    temperature_source : str
    periods_s, protection : mapping
        Period [s] and rule of protection by message.
    """

    name: str
    dbc: str
    roles: Mapping[str, Assignment]
    comments: tuple[str, ...] = ()
    pair_within_s: float = 0.020
    temperature_source: str = "unknown"
    periods_s: Mapping[str, float] = field(default_factory=dict)
    protection: Mapping[str, str] = field(default_factory=dict)


# --- What the bits leave open


@dataclass(frozen=True)
class Level:
    """What a usual scale of a field would mean."""

    scale: float
    value: float
    """The pack's voltage in the middle of its range [V], or the largest SoC [%]."""
    text: str


def levels(role: str, candidate: SignalCandidate, nominal_v: float | None) -> list[Level]:
    """Return what the usual scales of a voltage or SoC mean, its own first.

    Bits and the relation to the current are the same by every scale. One level where the scale is
    known: a stated nominal voltage decides that of the voltage.
    """
    found = []
    if role == "voltage" and nominal_v is None:
        middle = (candidate.low + candidate.high) / 2.0 / candidate.scale
        for scale in VOLTAGE_SCALES:
            volts = scale * middle
            text = f"{volts:.3g} V at {scale:g} V a step"
            text += f" (about {round(volts / _NOMINAL_CELL_V)} cells)"
            if scale == candidate.scale or 30.0 < volts < 1000.0:
                found.append(Level(scale, volts, text))
    if role == "soc_reference":
        for scale in SOC_SCALES:
            low, high = (end * scale / candidate.scale for end in (candidate.low, candidate.high))
            capacity_ah = candidate.capacity_ah * candidate.scale / scale
            text = f"{low:.3g} … {high:.3g} % at {scale:g} % a step ({capacity_ah:.0f} Ah)"
            if scale == candidate.scale or (high <= 100.0 and is_capacity(capacity_ah)):
                found.append(Level(scale, high, text))
    return sorted(found, key=lambda level: (level.scale != candidate.scale, level.scale))


# --- Proposals


def message_name(candidate: SignalCandidate) -> str:
    """Return the name of a candidate's message in a DBC that is written."""
    return f"FRAME_{candidate.arbitration_id:X}"


def by_physics(
    chosen: Mapping[str, SignalCandidate],
    names: Mapping[str, Sequence[str]],
    dbc: str,
    nominal_v: float | None,
    comments: Sequence[str],
) -> Proposal:
    """Return the map of fields that were found by physics, as `comments` say.

    `names` are those of all candidates by role; `nominal_v` is the stated voltage of the pack [V].
    """
    roles = {}
    for role, candidate in chosen.items():
        ends = range_text(candidate.low, candidate.high, UNITS[role], candidate.sign)
        lines = [f"{candidate.name}: {ends}, {candidate.steps} steps."]
        if role == "temperature":
            lines.insert(0, "A guess by range and slowness: compare it with the car's display.")
        else:
            lines.append(f"{candidate.facts[0].upper()}{candidate.facts[1:]}.")
        lines += _scale_lines(role, candidate, nominal_v)
        others = [name for name in names[role] if name != candidate.name]
        lines += [f"Else: {', '.join(others)}."] if others else []
        message = message_name(candidate)
        roles[role] = Assignment(message, SIGNALS[role], candidate.sign, tuple(lines))
    current, voltage = chosen["current"], chosen["voltage"]
    apart = current.arbitration_id != voltage.arbitration_id
    slowest_s = max(current.period_s, voltage.period_s)
    pair_s = min(max(0.020, 1.2 * slowest_s), _LONGEST_PAIR_S) if apart else 0.020
    head = (
        *comments,
        "The bits do not determine the factors: compare voltage and current with a",
        "meter or the car's display, and correct factor and offset in the DBC.",
    )
    return Proposal("own car", dbc, roles, head, pair_s)


def _scale_lines(role: str, candidate: SignalCandidate, nominal_v: float | None) -> list[str]:
    """Return how the scale of a field was determined, and which others may be."""
    factor = f"Factor {candidate.scale:g}"
    if role == "current":
        zero = round(-candidate.offset / candidate.scale)
        others = ", ".join(f"{scale:g}" for scale in CURRENT_SCALES if scale != candidate.scale)
        found = "signed" if candidate.place.is_signed else "a round number near the most common"
        return [
            f"{factor} is the usual one that gives a plausible R; the data fit as well with"
            f" {others}. No current at raw {zero}: {found}."
        ]
    if role == "voltage" and nominal_v is not None:
        return [f"{factor} is the usual one nearest to the stated {nominal_v:g} V."]
    others = "; ".join(level.text for level in levels(role, candidate, nominal_v)[1:])
    return [f"{factor} is the likeliest; the data fit as well: {others}."] if others else []


def of_preset(mapping: VehicleMap, dbc: str, comments: tuple[str, ...]) -> Proposal:
    """Return the map of a preset."""
    signals = {role: getattr(mapping, role) for role in SIGNALS}
    messages = mapping.messages
    return Proposal(
        name=mapping.name,
        dbc=dbc,
        roles={
            role: Assignment(str(signal.message), signal.signal, signal.sign)
            for role, signal in signals.items()
            if signal is not None and signal.signal
        },
        comments=comments,
        pair_within_s=mapping.pair_within_s,
        temperature_source=mapping.temperature_source,
        periods_s={name: m.period_s for name, m in messages.items() if m.period_s is not None},
        protection={name: m.protection for name, m in messages.items() if m.protection is not None},
    )


# --- Texts


def dbc_text(chosen: Mapping[str, SignalCandidate]) -> str:
    """Return a DBC with the chosen fields."""
    lines = ['VERSION "1"', "", "NS_ :", "", "BS_:", "", "BU_: Vehicle", ""]
    by_id: dict[int, dict[str, SignalCandidate]] = {}
    for role, candidate in chosen.items():
        key = candidate.arbitration_id | (EXTENDED if candidate.is_extended else 0)
        by_id.setdefault(key, {})[role] = candidate
    values, cycles = [], []
    for key, own in by_id.items():
        first = next(iter(own.values()))
        lines.append(f"BO_ {key} {message_name(first)}: {first.length} Vehicle")
        selector = next((c.selector for c in own.values() if c.selector is not None), None)
        if selector is not None:
            start = 8 * (selector.first // 8) + 7 - selector.first % 8
            lines.append(f' SG_ selector M : {start}|{selector.width}@0+ (1,0) [0|0] "" Vehicle')
        for role, candidate in own.items():
            place, code = candidate.place, candidate.not_available
            mark = "" if candidate.selector is None else f" m{candidate.selector.value}"
            order, sign = int(not place.is_motorola), "-" if place.is_signed else "+"
            lines.append(
                f" SG_ {SIGNALS[role]}{mark} : {candidate.start}|{place.width}@{order}{sign}"
                f" ({candidate.scale:.10g},{candidate.offset + 0.0:.10g}) [0|0]"
                f' "{UNITS[role].replace("°", "deg")}"'
                " Vehicle"
            )
            if code is not None:
                values.append(f'VAL_ {key} {SIGNALS[role]} {code} "not available" ;')
        lines.append("")
        cycles.append(f'BA_ "GenMsgCycleTime" BO_ {key} {max(round(1e3 * first.period_s), 1)};')
    lines += ['BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;', 'BA_DEF_DEF_ "GenMsgCycleTime" 0;']
    return "\n".join([*lines, *cycles, "", *values, ""])


def map_text(proposal: Proposal) -> str:
    """Return a commented map file."""
    lines = [
        *(f"# {line}" for line in proposal.comments),
        "",
        f"name = {_quoted(proposal.name)}",
        f"dbc = {_quoted(proposal.dbc)}",
        f'temperature_source = "{proposal.temperature_source}"'
        "  # where the sensor is: cell, pack, coolant, room, unknown",
        f"pair_within_s = {proposal.pair_within_s:.3g}"
        "  # current and voltage at most this far apart make a sample [s]",
    ]
    for role in SIGNALS:
        found = proposal.roles.get(role)
        if found is not None:
            lines += ["", *(f"# {line}" for line in found.comments), f"[{role}]"]
            lines += [f"message = {_quoted(found.message)}", f"signal = {_quoted(found.signal)}"]
        if found is not None and role == "current":
            way = "positive current discharges" if found.sign > 0 else "negative discharges"
            lines.append(f"sign = {found.sign}  # {way}")
    if "temperature" not in proposal.roles:
        lines += [
            "",
            "# No temperature is known on this bus: a fixed one is assumed. Kt makes an error of"
            " some °C",
            "# worth several % SoC: name a signal here when you find one.",
            "[temperature]",
            f"fixed_c = {FALLBACK_C:g}",
        ]
    for message in dict.fromkeys([*proposal.periods_s, *proposal.protection]):
        lines += ["", f"[messages.{message}]"]
        if message in proposal.protection:
            lines.append(f"protection = {_quoted(proposal.protection[message])}")
        if message in proposal.periods_s:
            lines.append(f"period_s = {proposal.periods_s[message]:.3g}")
    return "\n".join([*lines, ""]).lstrip("\n")


def config_text(
    vehicle: str | None,
    map_name: str,
    interface: str | None,
    channel: str | None,
    bus_options: Mapping[str, object],
) -> str:
    """Return a commented configuration of the service."""
    lines = [
        "# Configuration of `cangauge run --config THIS_FILE`; all keys: docs/configuration.md.",
        "",
        "# The voltage model of the pack: make it of your own drives, such as",
        f"# cangauge fit drive.log --map {map_name} -o model.json",
        'model = "model.json"',
        "",
    ]
    if vehicle is not None:
        lines += [
            f"vehicle = {_quoted(vehicle)}",
            f"# map = {_quoted(map_name)}  # in its place, to change signals or checks",
        ]
    else:
        lines.append(f"map = {_quoted(map_name)}")
    shown = "" if interface else "# "
    lines += [
        "",
        f"{shown}interface = {_quoted(interface or 'socketcan')}",
        f"{shown}channel = {_quoted(channel or 'can0')}",
        "",
        '# record = "drive.log"  # keep the received frames: `cangauge estimate` gives the same',
        '# state = "state.json"  # keep the SoC over restarts',
        "",
    ]
    if bus_options:
        lines.append("[bus_options]")
        lines += [f"{key} = {json.dumps(value)}" for key, value in bus_options.items()]
        lines.append("")
    return "\n".join(lines)


def _quoted(text: str) -> str:
    """Return a basic string of TOML, which JSON's escapes are."""
    return json.dumps(text)

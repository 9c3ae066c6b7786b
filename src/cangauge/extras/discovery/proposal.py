"""Texts of the files that `cangauge init` writes: DBC, map and configuration, with comments."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final

from cangauge.bus.mapping import VehicleMap
from cangauge.bus.vehicle import EXTENDED
from cangauge.extras.discovery.pairs import CURRENT_SCALES, VOLTAGE_SCALES, Candidate

UNITS: Final = {"current": "A", "voltage": "V", "temperature": "degC", "soc_reference": "%"}
SIGNALS: Final = {
    "current": "current_a",
    "voltage": "voltage_v",
    "temperature": "temperature_c",
    "soc_reference": "soc_pct",
}
"""Names of the signals in a DBC that is written."""
FALLBACK_C: Final = 20.0
"""Temperature of a map without one [°C]: the reference temperature of the voltage model."""


@dataclass(frozen=True)
class Assignment:
    """A signal of a DBC with its role, and why.

    Parameters
    ----------
    message, signal : str
    sign : int
    comments : tuple of str
        Lines above its table in the map file.
    not_available : int or None
        Raw code without a value that the DBC does not name.
    """

    message: str
    signal: str
    sign: int = 1
    comments: tuple[str, ...] = ()
    not_available: int | None = None


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
    fixed_c : float
        Temperature where no signal has it [°C].
    periods_s : mapping of str to float
        By message.
    protection : mapping of str to str
        Rule by message.
    """

    name: str
    dbc: str
    roles: Mapping[str, Assignment]
    comments: tuple[str, ...] = ()
    pair_within_s: float = 0.020
    temperature_source: str = "unknown"
    fixed_c: float = FALLBACK_C
    periods_s: Mapping[str, float] = field(default_factory=dict)
    protection: Mapping[str, str] = field(default_factory=dict)


def message_name(candidate: Candidate) -> str:
    """Return the name of a candidate's message in a DBC that is written."""
    return f"FRAME_{candidate.arbitration_id:X}"


def dbc_text(chosen: Mapping[str, Candidate]) -> str:
    """Return a DBC with the chosen fields."""
    lines = ['VERSION "1"', "", "NS_ :", "", "BS_:", "", "BU_: Vehicle", ""]
    keys = dict.fromkeys((each.arbitration_id, each.is_extended) for each in chosen.values())
    values, cycles = [], []
    for number, extended in keys:
        own = {
            role: each
            for role, each in chosen.items()
            if (each.arbitration_id, each.is_extended) == (number, extended)
        }
        first = next(iter(own.values()))
        key = number | (EXTENDED if extended else 0)
        lines.append(f"BO_ {key} {message_name(first)}: {first.length} Vehicle")
        selector = next((each.selector for each in own.values() if each.selector), None)
        if selector is not None:
            start = 8 * (selector.first // 8) + 7 - selector.first % 8
            lines.append(f' SG_ selector M : {start}|{selector.width}@0+ (1,0) [0|0] "" Vehicle')
        for role, each in own.items():
            mark = "" if each.selector is None else f" m{each.selector.value}"
            order, sign = int(not each.place.is_motorola), "-" if each.place.is_signed else "+"
            lines.append(
                f" SG_ {SIGNALS[role]}{mark} : {each.start}|{each.place.width}@{order}{sign}"
                f' ({each.scale:.10g},{each.offset + 0.0:.10g}) [0|0] "{UNITS[role]}" Vehicle'
            )
            if each.not_available is not None:
                values.append(f'VAL_ {key} {SIGNALS[role]} {each.not_available} "not available" ;')
        lines.append("")
        cycles.append(f'BA_ "GenMsgCycleTime" BO_ {key} {max(round(1e3 * first.period_s), 1)};')
    lines += ['BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;', 'BA_DEF_DEF_ "GenMsgCycleTime" 0;']
    return "\n".join([*lines, *cycles, "", *values, ""])


def voltage_levels(candidate: Candidate) -> list[tuple[float, float]]:
    """Return usual scales [V] of a voltage and the pack's voltage by each [V], its own first.

    Bits and the relation to the current are the same by every scale.
    """
    middle = (candidate.low + candidate.high) / 2.0 / candidate.scale
    own = (candidate.scale, candidate.scale * middle)
    others = [(each, each * middle) for each in sorted(VOLTAGE_SCALES) if each != candidate.scale]
    return [own, *((scale, volts) for scale, volts in others if 60.0 < volts < 1000.0)]


def scale_line(role: str, candidate: Candidate, nominal_v: float | None) -> str:
    """Return how the scale of a current or a voltage was determined, and which others may be."""
    usual = VOLTAGE_SCALES if role == "voltage" else CURRENT_SCALES
    others = [each for each in sorted(usual) if each != candidate.scale]
    if role == "current":
        zero = round(-candidate.offset / candidate.scale)
        return (
            f"Factor {candidate.scale:g} is the usual one that gives a plausible R; the data fit as"
            f" well with {', '.join(f'{each:g}' for each in others)}. No current at raw {zero}:"
            f" {'signed' if candidate.place.is_signed else 'a round number near the most common'}."
        )
    shown = [f"{scale:g} ({volts:.0f} V)" for scale, volts in voltage_levels(candidate)[1:]]
    if nominal_v is not None:
        return f"Factor {candidate.scale:g} is the usual one nearest to the stated {nominal_v:g} V."
    return (
        f"Factor {candidate.scale:g} is the usual one with the likeliest level"
        + (f"; the data fit as well with {', '.join(shown)}" if shown else "")
        + ". --nominal-voltage decides."
    )


def map_text(proposal: Proposal) -> str:
    """Return a commented map file."""
    lines = [f"# {line}" for line in proposal.comments]
    lines += [
        "",
        f"name = {_quoted(proposal.name)}",
        f"dbc = {_quoted(proposal.dbc)}",
        f'temperature_source = "{proposal.temperature_source}"'
        "  # where the sensor is: cell, pack, coolant, room, unknown",
        f"pair_within_s = {proposal.pair_within_s:.3g}"
        "  # current and voltage at most this far apart make a sample [s]",
    ]
    for role in ("current", "voltage", "temperature", "soc_reference"):
        each = proposal.roles.get(role)
        if each is None:
            if role == "temperature":
                lines += [
                    "",
                    "# No temperature is known on this bus: a fixed one is assumed. Kt makes an"
                    " error of some °C",
                    "# worth several % SoC: name a signal here when you find one.",
                    "[temperature]",
                    f"fixed_c = {proposal.fixed_c:g}",
                ]
            continue
        lines += ["", *(f"# {line}" for line in each.comments), f"[{role}]"]
        lines += [f"message = {_quoted(each.message)}", f"signal = {_quoted(each.signal)}"]
        if role == "current":
            lines.append(
                f"sign = {each.sign}  # "
                + ("positive current discharges" if each.sign > 0 else "negative discharges")
            )
        if each.not_available is not None:
            lines.append(f"not_available = [{each.not_available}]")
    for message in dict.fromkeys([*proposal.periods_s, *proposal.protection]):
        lines += ["", f"[messages.{message}]"]
        if message in proposal.protection:
            lines.append(f"protection = {_quoted(proposal.protection[message])}")
        if message in proposal.periods_s:
            lines.append(f"period_s = {proposal.periods_s[message]:.3g}")
    return "\n".join([*lines, ""]).lstrip("\n")


def mapped(mapping: VehicleMap, dbc: str, comments: tuple[str, ...]) -> Proposal:
    """Return the proposal that a preset's mapping makes."""
    roles = {}
    for role in ("current", "voltage", "temperature", "soc_reference"):
        signal = getattr(mapping, role)
        if signal is not None and signal.signal:
            roles[role] = Assignment(str(signal.message), signal.signal, signal.sign)
    messages = mapping.messages
    return Proposal(
        name=mapping.name,
        dbc=dbc,
        roles=roles,
        comments=comments,
        pair_within_s=mapping.pair_within_s,
        temperature_source=mapping.temperature_source,
        periods_s={name: m.period_s for name, m in messages.items() if m.period_s is not None},
        protection={name: m.protection for name, m in messages.items() if m.protection is not None},
    )


def config_text(
    *,
    vehicle: str | None,
    map_name: str,
    interface: str | None,
    channel: str | None,
    bus_options: Mapping[str, object] = MappingProxyType({}),
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

"""Texts of the files that `cangauge init` writes: DBC, map and configuration, with comments."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from cangauge.bus.vehicle import EXTENDED
from cangauge.extras.discovery.by_name import NamedSignal
from cangauge.extras.discovery.candidate import SIGNALS, SignalCandidate

FALLBACK_C: Final = 20.0
"""Temperature of a map without one [°C]: the reference temperature of the voltage model."""


def dbc_text(chosen: Iterable[SignalCandidate]) -> str:
    """Return a DBC with the chosen fields."""
    lines = ['VERSION "1"', "", "NS_ :", "", "BS_:", "", "BU_: Vehicle", ""]
    by_id: dict[int, list[SignalCandidate]] = {}
    for each in chosen:
        key = each.stream.arbitration_id | (EXTENDED if each.stream.is_extended else 0)
        by_id.setdefault(key, []).append(each)
    values, cycles = [], []
    for key, own in by_id.items():
        lines.append(f"BO_ {key} {own[0].message}: {own[0].stream.length} Vehicle")
        selector = next((each.stream.selector for each in own if each.stream.selector), None)
        if selector is not None:
            start = 8 * (selector.first // 8) + 7 - selector.first % 8
            lines.append(f' SG_ selector M : {start}|{selector.width}@0+ (1,0) [0|0] "" Vehicle')
        for each in own:
            mark = "" if each.stream.selector is None else f" m{each.stream.selector.value}"
            order, sign = int(not each.place.is_motorola), "-" if each.place.is_signed else "+"
            lines.append(
                f" SG_ {each.signal}{mark} : {each.start}|{each.place.width}@{order}{sign}"
                f" ({each.scale:.10g},{each.offset + 0.0:.10g}) [0|0]"
                f' "{SIGNALS[each.role][1].replace("°", "deg")}" Vehicle'
            )
            if each.not_available is not None:
                values.append(f'VAL_ {key} {each.signal} {each.not_available} "not available" ;')
        lines.append("")
        period_ms = max(round(1e3 * own[0].stream.period_s), 1)
        cycles.append(f'BA_ "GenMsgCycleTime" BO_ {key} {period_ms};')
    lines += ['BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;', 'BA_DEF_DEF_ "GenMsgCycleTime" 0;']
    return "\n".join([*lines, *cycles, "", *values, ""])


def map_text(
    dbc: str,
    head: Sequence[str],
    chosen: Mapping[str, SignalCandidate | NamedSignal],
    comments: Mapping[str, Sequence[str]],
    pair_within_s: float,
) -> str:
    """Return a map file of the chosen signals by role.

    Parameters
    ----------
    dbc : str
        Path of the DBC from the map's folder.
    head : sequence of str
        Comments of the file.
    chosen : mapping of str to SignalCandidate or NamedSignal
    comments : mapping of str to sequence of str
        Comments of each chosen signal.
    pair_within_s : float
        Largest distance between paired current and voltage [s].
    """
    lines = [
        *(f"# {line}" for line in head),
        "",
        f"dbc = {json.dumps(dbc)}",  # a basic string of TOML has JSON's escapes
        'temperature_source = "unknown"  # where the sensor is: cell, pack, coolant, room, unknown',
        f"pair_within_s = {pair_within_s:.3g}"
        "  # current and voltage at most this far apart make a sample [s]",
    ]
    for role, found in chosen.items():
        lines += ["", *(f"# {line}" for line in comments[role]), f"[{role}]"]
        lines += [f"message = {json.dumps(found.message)}", f"signal = {json.dumps(found.signal)}"]
        if role == "current":
            way = "positive current discharges" if found.sign > 0 else "negative discharges"
            lines.append(f"sign = {found.sign}  # {way}")
    if "temperature" not in chosen:
        lines += [
            "",
            "# No temperature is known on this bus: a fixed one is assumed. Kt makes an error of"
            " some °C",
            "# worth several % SoC: name a signal here when you find one.",
            "[temperature]",
            f"fixed_c = {FALLBACK_C:g}",
        ]
    return "\n".join([*lines, ""])


def config_text(vehicle: Sequence[str], interface: str | None, channel: str | None,
                bus_options: Mapping[str, object], reading: str) -> str:  # fmt: skip
    """Return a configuration of the service.

    Parameters
    ----------
    vehicle : sequence of str
        Its lines that name the vehicle.
    interface, channel, bus_options
        The bus; None: a comment instead.
    reading : str
        Options with which a command reads the vehicle's captures.
    """
    shown = "" if interface else "# "
    lines = [
        "# Configuration of `cangauge run --config THIS_FILE`; all keys: docs/configuration.md.",
        "",
        "# The voltage model of the pack: make it of your own drives, such as",
        f"# cangauge fit drive.log {reading} -o model.json",
        'model = "model.json"',
        "",
        *vehicle,
        "",
        f"{shown}interface = {json.dumps(interface or 'socketcan')}",
        f"{shown}channel = {json.dumps(channel or 'can0')}",
        "",
        '# record = "drive.log"  # keep the received frames: `cangauge estimate` gives the same',
        '# state = "state.json"  # keep the SoC over restarts',
        "",
    ]
    if bus_options:
        lines += ["[bus_options]", *(f"{k} = {json.dumps(v)}" for k, v in bus_options.items()), ""]
    return "\n".join(lines)

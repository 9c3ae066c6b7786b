"""Nine faults: what a user reads of each, and the measurement to do first."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from importlib.resources import files
from typing import Any, Final

from cangauge._text import number, significant
from cangauge.diagnosis.evidence import Evidence
from cangauge.model.effects.base import Pack

FAULT: Final[Mapping[str, Mapping[str, Any]]] = tomllib.loads(
    files("cangauge.diagnosis").joinpath("faults.toml").read_text("utf-8")
)
"""Fault → its words; see `faults.toml`."""


def shown_unit(unit: str) -> str:
    """Return the unit of a parameter as a reader sees it."""
    return "" if unit == "1" else unit.replace("ohm", "Ω")


def sentence(evidence: Evidence, pack: Pack, log: str, start_pct: float) -> str:
    """Return what a fault does, how much and how sure, without the end of the sentence.

    `log` is what to call the first log, and `start_pct` the SoC at which it is said to begin [%].
    """
    shape, size, half = evidence.shape, evidence.size, evidence.half_width
    values, words = shape.values(size), FAULT[shape.effect.fault]
    key = f"{shape.effect.id}_late" if values.get("late") else shape.effect.id
    if key not in words["effects"]:
        return f"{words['title'].capitalize()}: {key.replace('_', ' ')}"
    low, high = size - half, size + half
    now, least, most = (pack.capacity_ah * (1.0 + each / 100.0) for each in (size, low, high))

    def shown(factor: float, unit: str) -> str:
        """Return the absolute size with its interval; the bracket stays open."""
        value, wide = factor * abs(size), factor * half
        digits = 2 if value < 100.0 else 3
        least = significant(max(value - wide, 0.0), digits)
        most = significant(value + wide, digits, unit)
        return f"{significant(value, digits, unit)} ({least}–{most}"

    fields = {
        "log": log,
        "size": shown(1.0, shown_unit(shape.unit)),
        "percent": shown(100.0, "%"),
        "milli": shown(1e3, f"m{shape.unit}"),
        "at_pack_v": shown(pack.voltage_v / 100.0, "V"),
        "at_pack_ohm": shown(pack.resistance_ohm, "Ω"),
        "of_voltage": number(100.0 * abs(size) / pack.voltage_v, 1, "%"),
        "of_gain": number(abs(size), 1, "%"),
        "of_share": number(100.0 * abs(size), 0, "%"),
        "end": shape.name.removeprefix("at_"),
        "stated_pct": start_pct,
        "true_pct": start_pct + size,
        "pct": f"({start_pct + low:.0f}–{start_pct + high:.0f} %)",
        "true_ah": significant(now, 3, "Ah"),
        "ah": f"({significant(least, 3)}–{significant(most, 3, 'Ah')})",
        "assumed_ah": significant(pack.capacity_ah, 3, "Ah"),
    }
    minutes = {f"{each[:-2]}_min": v / 60.0 for each, v in values.items() if each.endswith("_s")}
    text = re.sub(r"\[(.*?)\|(.*?)\]", r"\1" if size > 0.0 else r"\2", words["effects"][key])
    return text.format_map(values | minutes | fields)

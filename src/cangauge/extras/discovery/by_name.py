"""Current, voltage, SoC and temperature among the signals of a DBC, by names, units and values."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, ClassVar, Final

import can
import numpy as np
from cantools.database.can import Message, Signal

from cangauge.bus.database import load_dbc, signal_codec
from cangauge.bus.vehicle import EXTENDED
from cangauge.errors import InputError
from cangauge.extras.discovery.candidate import Level, range_text
from cangauge.logs.units import convert

_PACK = re.compile(r"bat|bms|pack|traction|hv|hochvolt|esu|rechargeable", re.IGNORECASE)
_OTHER = re.compile(
    r"lim|max|min|allow|req|target|set_?point|dem(and)?|cell|12v|lv_?|aux|charger|obc|dcdc|motor"
    r"|inv|peak|nom|_nv$|ulo|rated|avail|cap(acity)?|err|fault|delta|dev|isol|pre_?ch|full|remain|energy|power",
    re.IGNORECASE,
)
_ROLES: Final = {
    "current": ("current_a", re.compile(r"cur|amp|strom|(^|_)i(_|$)|ibat", re.IGNORECASE)),
    "voltage": ("voltage_v", re.compile(r"volt|spann|(^|_)u(_|$)|_v$|ubat|vbat", re.IGNORECASE)),
    "soc_reference": ("soc_pct", re.compile(r"soc|state_?of_?charge|ladezustand", re.IGNORECASE)),
    "temperature": ("temperature_c", re.compile(r"temp", re.IGNORECASE)),
}
_RANGES: Final = {
    "current": (-2000.0, 2000.0),
    "voltage": (30.0, 1000.0),
    "temperature": (-30.0, 60.0),
    "soc_reference": (0.0, 100.0),
}
"""Plausible medians of the distinct values [A, V, °C, %]."""
_CLEARLY: Final = 1.0
"""Distance in score of the first signal that makes it clear: one matching word."""
_EXTREME = re.compile(r"max|min|cell", re.IGNORECASE)
"""Words that the pack's temperature may hold in its name: that of its warmest cell."""


@dataclass(frozen=True)
class NamedSignal:
    """A signal of a DBC that may have a role.

    Parameters
    ----------
    message, signal, unit : str
    score : float
        Larger is likelier; in units of one matching word.
    low, high : float
        Range of its values in the whole capture, in the DBC's unit; NaN without frames.
    sign : int
        −1 where positive values charge.
    """

    HEAD: ClassVar = ("signal, by name and unit", "range")

    message: str
    signal: str
    unit: str
    score: float
    low: float
    high: float
    sign: int = 1

    @property
    def name(self) -> str:
        """Message and signal."""
        return f"{self.message}.{self.signal}"

    @property
    def range_text(self) -> str:
        """Range of its values, discharge positive; "" without frames."""
        if math.isnan(self.low):
            return ""
        return range_text(self.low, self.high, self.unit.replace("degC", "°C"), self.sign)

    @property
    def cells(self) -> tuple[str, ...]:
        """Cells of a table under `HEAD`."""
        return f"{self.message}\n{self.signal}", self.range_text

    def levels(self, nominal_v: float | None) -> list[Level]:  # noqa: ARG002 - as of a field
        """Return nothing: a DBC states the scale."""
        return []

    def comments(self, nominal_v: float | None) -> list[str]:  # noqa: ARG002 - as of a field
        """Return the lines that the map states of it."""
        ends = self.range_text
        return [f"By name and unit: {f'{ends} in' if ends else 'not in'} the capture."]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "message": self.message,
            "signal": self.signal,
            "unit": self.unit,
            "score": self.score,
            "range": None if math.isnan(self.low) else [self.low, self.high],
        }


def named_signals(
    dbc: Path, messages: Iterable[can.Message], shown: int = 3
) -> dict[str, tuple[NamedSignal, ...]]:
    """Return the likeliest signals of each role, best first.

    Parameters
    ----------
    dbc : Path
    messages : iterable of can.Message
        A capture of the car; empty: by names and units alone.
    shown : int
        Most signals of a role.

    Raises
    ------
    InputError
        If the DBC cannot be read, or no message of it is in the capture.
    """
    of_dbc = {
        message.frame_id | (EXTENDED if message.is_extended_frame else 0): message
        for message in load_dbc(dbc).messages
    }
    payloads: dict[int, set[bytes]] = {}
    is_capture = False
    for each in messages:
        is_capture = True
        key = each.arbitration_id | (EXTENDED if each.is_extended_id else 0)
        if key in of_dbc and not each.is_error_frame and not each.is_remote_frame:
            payloads.setdefault(key, set()).add(bytes(each.data))
    if is_capture and not payloads:
        cure = "is it of this car and this bus?"
        raise InputError("no message of this DBC is in the capture", source=dbc, cure=cure)
    found: dict[str, list[NamedSignal]] = {role: [] for role in _ROLES}
    for key in payloads if is_capture else of_dbc:
        for signal in of_dbc[key].signals:
            scores = {role: _name_score(role, of_dbc[key], signal) for role in _ROLES}
            roles = [role for role, score in scores.items() if score > 0.0]
            values = _values(dbc, of_dbc[key], signal, payloads.get(key, set())) if roles else set()
            for role in roles:
                lowest, highest = _RANGES[role]
                if values and not lowest <= median(values) <= highest:
                    continue
                low, high = min(values, default=math.nan), max(values, default=math.nan)
                score = scores[role] - (1.0 if is_capture and not values else 0.0)
                score -= 0.5 if role == "current" and low == high else 0.0
                unit = (signal.unit or "").strip()
                made = NamedSignal(of_dbc[key].name, signal.name, unit, score, low, high)
                found[role].append(made)
    return {
        role: tuple(sorted(each, key=lambda one: -one.score)[:shown])
        for role, each in found.items()
    }


def is_clear(found: Sequence[NamedSignal]) -> bool:
    """Whether the first signal is clearly ahead of the others."""
    return len(found) == 1 or (len(found) > 1 and found[0].score - found[1].score >= _CLEARLY)


def _values(dbc: Path, message: Message, signal: Signal, payloads: set[bytes]) -> set[float]:
    """Return the distinct values of a signal; none where it does not fit into its message."""
    try:
        codec = signal_codec(message, signal, source=dbc, field=signal.name)
    except InputError:
        return set()
    cut = {payload[: message.length] for payload in payloads if len(payload) >= message.length}
    values = {codec.decode(payload) for payload in cut if codec.is_in(payload)}
    return {value for value in values if not math.isnan(value)}


def _name_score(role: str, message: Message, signal: Signal) -> float:
    """Return how well names and unit fit a role; 0 where they do not."""
    column, word = _ROLES[role]
    unit = (signal.unit or "").strip()
    named = word.search(signal.name) is not None
    suits = False
    if unit:
        try:
            convert(np.array([0.0]), column, unit, source="", label=signal.name)
            suits = True
        except InputError:
            return 0.0
    if not named and not (suits and role != "soc_reference"):
        return 0.0
    score = 2.0 * named + 1.0 * suits
    score += 1.0 * (_PACK.search(signal.name) is not None)
    score += 0.5 * (_PACK.search(message.name) is not None)
    if role == "temperature":  # by its unit as well; of another part, it is no guess at all
        score += 2.0 * (suits and not named)
        score -= 9.0 * (_OTHER.search(_EXTREME.sub("", signal.name)) is not None)
    else:
        score -= 1.5 * (_OTHER.search(signal.name) is not None)
    score -= 0.5 * (_OTHER.search(message.name) is not None)
    return score

"""Current, voltage, SoC and temperature among the signals of a DBC, by names, units and values."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any, Final

import can
import numpy as np
from cantools.database.can import Message, Signal

from cangauge.bus.database import SignalCodec, load_dbc, signal_codec
from cangauge.bus.vehicle import EXTENDED
from cangauge.errors import InputError
from cangauge.extras.discovery.pairs import range_text
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
    "temperature": ("temperature_c", re.compile(r"temp", re.IGNORECASE)),
    "soc_reference": ("soc_pct", re.compile(r"soc|state_?of_?charge|ladezustand", re.IGNORECASE)),
}
_RANGES: Final = {
    "current": (-2000.0, 2000.0),
    "voltage": (30.0, 1000.0),
    "temperature": (-30.0, 60.0),
    "soc_reference": (0.0, 100.0),
}
"""Plausible medians of the distinct values [A, V, °C, %]."""
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
    low, high : float or None
        Range of its values in the capture, in the DBC's unit; None without frames.
    """

    message: str
    signal: str
    unit: str
    score: float
    low: float | None
    high: float | None

    @property
    def name(self) -> str:
        """Message and signal."""
        return f"{self.message}.{self.signal}"

    def range_text(self, sign: int = 1) -> str:
        """Return the range of its values in the whole capture; "" without frames."""
        if self.low is None or self.high is None:
            return ""
        return range_text(self.low, self.high, self.unit.replace("degC", "°C"), sign)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "message": self.message,
            "signal": self.signal,
            "unit": self.unit,
            "score": self.score,
            "range": None if self.low is None else [self.low, self.high],
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
    wanted: dict[int, list[_Seen]] = {}
    for message in load_dbc(dbc).messages:
        key = message.frame_id | (EXTENDED if message.is_extended_frame else 0)
        seen = [_Seen.of(message, signal, dbc) for signal in message.signals]
        wanted[key] = [each for each in seen if each.scores]
    taken, present = False, set()
    for each in messages:
        taken = True
        key = each.arbitration_id | (EXTENDED if each.is_extended_id else 0)
        if key in wanted and not each.is_error_frame and not each.is_remote_frame:
            present.add(key)
            for signal in wanted[key]:
                signal.add(bytes(each.data))
    if taken and not present:
        cure = "is it of this car and this bus?"
        raise InputError("no message of this DBC is in the capture", source=dbc, cure=cure)
    keys = [key for key in wanted if key in present or not taken]
    found = [seen for key in keys for seen in wanted[key]]
    best = {}
    for role in _ROLES:
        named = filter(None, (seen.as_role(role, taken=taken) for seen in found))
        best[role] = tuple(sorted(named, key=lambda one: -one.score)[:shown])
    return best


@dataclass
class _Seen:
    """A signal that may have a role, with its distinct values in the capture."""

    message: Message
    signal: Signal
    scores: dict[str, float]
    codec: SignalCodec | None
    values: set[float] = field(default_factory=set)

    @classmethod
    def of(cls, message: Message, signal: Signal, dbc: Path) -> _Seen:
        scores = {role: _name_score(role, message, signal) for role in _ROLES}
        codec = None
        with suppress(InputError):  # it does not fit into its message
            codec = signal_codec(message, signal, source=dbc, field=signal.name)
        return cls(message, signal, {k: score for k, score in scores.items() if score > 0.0}, codec)

    def add(self, payload: bytes) -> None:
        payload, codec = payload[: self.message.length], self.codec
        if codec is not None and len(payload) == self.message.length and codec.is_in(payload):
            value = codec.decode(payload)
            if not math.isnan(value):
                self.values.add(value)

    def as_role(self, role: str, *, taken: bool) -> NamedSignal | None:
        if role not in self.scores:
            return None
        score, low, high = self.scores[role], None, None
        if self.values:
            low, high = min(self.values), max(self.values)
            lowest, highest = _RANGES[role]
            if not lowest <= median(self.values) <= highest:
                return None
            score -= 0.5 if role == "current" and low == high else 0.0
        elif taken:
            score -= 1.0
        unit = (self.signal.unit or "").strip()
        return NamedSignal(self.message.name, self.signal.name, unit, score, low, high)


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

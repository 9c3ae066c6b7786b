"""Current, voltage, SoC and temperature among the signals of a DBC, by names, units and values."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import can
import numpy as np
from cantools.database.can import Message, Signal

from cangauge.bus.database import load_dbc, signal_codec
from cangauge.bus.vehicle import EXTENDED
from cangauge.errors import InputError
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
"""Plausible medians [A, V, °C, %]."""
KEPT: Final = 2000
"""Frames of a message that are decoded for its range."""


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

    @property
    def range_text(self) -> str:
        """Range of its values in the capture; "" without frames."""
        return "" if self.low is None else f"{self.low:.5g} … {self.high:.5g} {self.unit}"

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
    database = load_dbc(dbc)
    frames: dict[int, list[bytes]] = {}
    taken = False
    for each in messages:
        taken = True
        if each.is_error_frame or each.is_remote_frame:
            continue
        key = each.arbitration_id | (EXTENDED if each.is_extended_id else 0)
        kept = frames.setdefault(key, [])
        if len(kept) < KEPT:
            kept.append(bytes(each.data))
    present = [each for each in database.messages if not taken or _key(each) in frames]
    if not present:
        raise InputError(
            "no message of this DBC is in the capture",
            source=dbc,
            cure="is it of this car and this bus?",
        )
    return {role: _best(role, present, frames, dbc)[:shown] for role in _ROLES}


def _key(message: Message) -> int:
    return message.frame_id | (EXTENDED if message.is_extended_frame else 0)


def _best(
    role: str, present: list[Message], frames: dict[int, list[bytes]], dbc: Path
) -> tuple[NamedSignal, ...]:
    found = []
    for message in present:
        for signal in message.signals:
            score = _name_score(role, message, signal)
            if score <= 0.0:
                continue
            named: tuple[float, float] | tuple[None, None] = (None, None)
            ends = _range(message, signal, frames.get(_key(message), []), dbc)
            if ends is not None:
                low, middle, high = ends
                bounds = _RANGES[role]
                if not bounds[0] <= middle <= bounds[1]:
                    continue
                if role == "current" and low == high:
                    score -= 0.5
                named = (float(low), float(high))
            else:
                score -= 1.0 if frames else 0.0
            unit = (signal.unit or "").strip()
            found.append(NamedSignal(message.name, signal.name, unit, score, *named))
    return tuple(sorted(found, key=lambda each: -each.score))


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
    score -= 1.5 * (_OTHER.search(signal.name) is not None)
    score -= 0.5 * (_OTHER.search(message.name) is not None)
    return score


def _range(
    message: Message, signal: Signal, frames: list[bytes], dbc: Path
) -> tuple[float, float, float] | None:
    """Return lowest value, median and highest; None without values."""
    try:
        codec = signal_codec(message, signal, source=dbc, field=signal.name)
    except InputError:
        return None
    values = [
        codec.decode(payload[: message.length])
        for payload in frames
        if len(payload) >= message.length and codec.is_in(payload[: message.length])
    ]
    good = np.array([value for value in values if value == value])  # noqa: PLR0124 - not NaN
    if not len(good):
        return None
    return float(good.min()), float(np.median(good)), float(good.max())

"""Current, voltage, SoC and temperature among the signals of a DBC, by names, units and values.

A voltage that follows a current, ΔU = −R·ΔI, is evidence for both, beside their names.
"""

from __future__ import annotations

import math
import re
from array import array
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any, ClassVar, Final

import can
import numpy as np
from cantools.database.can import Message, Signal

from cangauge._typing import FloatArray
from cangauge.bus.database import load_dbc, signal_codec
from cangauge.bus.vehicle import EXTENDED
from cangauge.errors import InputError
from cangauge.extras.discovery.candidate import Level, range_text
from cangauge.extras.discovery.pairs import FEW_MOVES
from cangauge.logs.sign import correlation
from cangauge.logs.units import convert

_PACK = re.compile(
    r"(?<!lv)(?<!lv_)bat|bms|pack|traction|hv(?!ac)|hochvolt|esu|(^|_)(ess|bmc)|rechargeable",
    re.IGNORECASE,
)
_PART = re.compile(
    r"12v|lv_?|aux|charger|obc|dcdc|motor|mcu|inv|cabin|ambient|outside|hvac|cool|inlet|outlet",
    re.IGNORECASE,
)
"""Other parts of a car: their SoC and temperature are not the pack's."""
_OTHER = re.compile(
    r"lim|max|min|allow|req|target|set_?point|dem(and)?|cell|peak|nom|_nv$|ulo|rated|avail"
    r"|cap(acity)?|err|fault|delta|dev|isol|pre_?ch|full|remain|energy|power|" + _PART.pattern,
    re.IGNORECASE,
)
_ROLES: Final = {
    "current": (
        "current_a",
        re.compile(r"cur|amp|strom|(^|_)i(_|$)|ibat|(?-i:(?<=[a-z])I(_|$))", re.IGNORECASE),
    ),
    "voltage": (
        "voltage_v",
        re.compile(r"volt|spann|(^|_)u(_|$)|_v$|ubat|vbat|(?-i:(?<=[a-z])U(_|$))", re.IGNORECASE),
    ),
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
_FOLLOWED: Final = 2.0
"""What the physics is worth at most: two matching words."""
_CODES_APART: Final = 1.0 / 16.0
"""Least distance of a code from the measured numbers, as a share of the signal's range."""
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
    evidence : float
        Share of the voltage's changes that follow the current, by the best partner.
    period_s : float
        Median interval of its message [s]; NaN without frames.
    not_available : tuple of int
        Codes in the capture that mean "no value".
    time_s, value : array
        Its values in the capture.
    """

    HEAD: ClassVar = ("signal, by name and unit", "range")

    message: str
    signal: str
    unit: str
    score: float
    low: float
    high: float
    sign: int = 1
    evidence: float = 0.0
    period_s: float = math.nan
    not_available: tuple[int, ...] = ()
    time_s: FloatArray = field(default_factory=lambda: np.empty(0), repr=False)
    value: FloatArray = field(default_factory=lambda: np.empty(0), repr=False)

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
        lines = [f"By name and unit: {f'{ends} in' if ends else 'not in'} the capture."]
        if self.evidence:
            share = f"{100.0 * self.evidence:.0f} %"
            lines.append(f"Voltage falls when current rises: {share} of the voltage's changes.")
        return lines

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "message": self.message,
            "signal": self.signal,
            "unit": self.unit,
            "score": self.score,
            "evidence": self.evidence,
            "not_available": list(self.not_available),
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
    frames: dict[int, _NamedFrames] = defaultdict(_NamedFrames)
    is_capture = False
    for each in messages:
        is_capture = True
        key = each.arbitration_id | (EXTENDED if each.is_extended_id else 0)
        if key in of_dbc and not each.is_error_frame and not each.is_remote_frame:
            frames[key].add(each)
    if is_capture and not frames:
        cure = "is it of this car and this bus?"
        raise InputError("no message of this DBC is in the capture", source=dbc, cure=cure)
    found: dict[str, list[NamedSignal]] = {role: [] for role in _ROLES}
    for key in list(frames) if is_capture else of_dbc:
        for signal in of_dbc[key].signals:
            scores = {role: _name_score(role, of_dbc[key], signal) for role in _ROLES}
            roles = [role for role, score in scores.items() if score > 0.0]
            if not roles:
                continue
            made = frames[key].signal(dbc, of_dbc[key], signal)
            values = np.unique(made.value)
            for role in roles:
                lowest, highest = _RANGES[role]
                if len(values) and not lowest <= median(values) <= highest:
                    continue
                score = scores[role] - (1.0 if is_capture and not len(values) else 0.0)
                score -= 0.5 if role == "current" and made.low == made.high else 0.0
                found[role].append(replace(made, score=score))
    for each_role in found.values():
        each_role.sort(key=lambda one: -one.score)
    _weigh(found["current"], found["voltage"])
    return {
        role: tuple(sorted(each, key=lambda one: -one.score)[:shown])
        for role, each in found.items()
    }


def clear_roles(found: Mapping[str, Sequence[NamedSignal]]) -> list[str]:
    """Return the roles whose first signal is clearly the pack's own.

    Sensors in one message measure one part; a SoC that stands still shows no battery at work.
    """
    pack = {found[role][0].message for role in ("current", "voltage") if found[role]}
    clear = []
    for role, signals in found.items():
        if not signals:
            continue
        first = signals[0]
        near = [each for each in signals[1:] if first.score - each.score < _CLEARLY]
        if role == "temperature":
            is_packs = first.message in pack or _PACK.search(first.name) is not None
            is_clear = is_packs and all(each.message == first.message for each in near)
        else:
            is_clear = not near and not (role == "soc_reference" and first.low == first.high)
        if is_clear:
            clear.append(role)
    return clear


@dataclass
class _NamedFrames:
    """Frames of one message: their times, and which of its distinct payloads each holds."""

    time_s: array[float] = field(default_factory=lambda: array("d"))
    number: array[int] = field(default_factory=lambda: array("L"))
    payloads: dict[bytes, int] = field(default_factory=dict)

    def add(self, message: can.Message) -> None:
        """Add a frame."""
        self.time_s.append(message.timestamp)
        self.number.append(self.payloads.setdefault(bytes(message.data), len(self.payloads)))

    def signal(self, dbc: Path, message: Message, signal: Signal) -> NamedSignal:
        """Return a signal with its values; none where it does not fit into its message."""
        name, unit = (message.name, signal.name), (signal.unit or "").strip()
        nothing = NamedSignal(*name, unit, 0.0, math.nan, math.nan)
        try:
            codec = signal_codec(message, signal, source=dbc, field=signal.name)
        except InputError:
            return nothing
        cut = [each[: message.length] for each in self.payloads]
        known = [len(each) == message.length and codec.is_in(each) for each in cut]
        decoded = np.array(
            [
                codec.decode(each) if good else math.nan
                for each, good in zip(cut, known, strict=True)
            ]
        )
        codes = []
        if not codec.float_format:
            lowest, highest = codec.raw_range
            raw = np.rint((decoded - codec.offset) / codec.factor)
            for code in (lowest, highest) if codec.is_signed else (highest,):
                far = np.abs(raw - code)
                far = far[far > 0.0]
                if (raw == code).any() and not (far < _CODES_APART * (highest - lowest)).any():
                    codes.append(code)
            decoded[np.isin(raw, codes)] = math.nan
        value, time_s = decoded[np.array(self.number)], np.array(self.time_s)
        good = np.isfinite(value)
        if not good.any():
            return nothing
        value, time_s = value[good], time_s[good]
        return replace(
            nothing, low=float(value.min()), high=float(value.max()), time_s=time_s, value=value,
            period_s=float(np.median(np.diff(time_s))) if len(time_s) > 1 else math.nan,
            not_available=tuple(codes),
        )  # fmt: skip


def _weigh(currents: list[NamedSignal], voltages: list[NamedSignal]) -> None:
    """Add the physics to the scores of the likeliest currents and voltages by name."""
    shares = {
        (a, b): _followed(currents[a], voltages[b])
        for a, b in product(range(min(len(currents), 8)), range(min(len(voltages), 8)))
    }
    for axis, signals in enumerate((currents, voltages)):
        for number, each in enumerate(signals):
            best = max((share for pair, share in shares.items() if pair[axis] == number), default=0)
            score = each.score + _FOLLOWED * round(4.0 * best) / 4.0  # equal of equal packs
            signals[number] = replace(each, score=score, evidence=best)


def _followed(current: NamedSignal, voltage: NamedSignal) -> float:
    """Return the share of a voltage's changes that a current explains, adjusted for chance."""
    if not (current.period_s > 0.0 and voltage.period_s > 0.0):
        return 0.0
    step_s = max(1.0, 2.0 * current.period_s, 2.0 * voltage.period_s)
    slots, means = [], []
    for each in (current, voltage):
        slot, at = np.unique(np.floor(each.time_s / step_s), return_inverse=True)
        slots.append(slot)
        means.append(np.bincount(at, weights=each.value) / np.bincount(at))
    common, *rows = np.intersect1d(slots[0], slots[1], return_indices=True)
    near = np.diff(common) == 1.0
    amps, volts = (np.diff(mean[at])[near] for mean, at in zip(means, rows, strict=True))
    moves = float((amps**2).sum() ** 2 / max(float((amps**4).sum()), 1e-12))
    if moves < FEW_MOVES:
        return 0.0
    share = correlation(amps, volts) ** 2
    return max(1.0 - (1.0 - share) * (moves - 1.0) / (moves - 2.0), 0.0)


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
    if role in {"soc_reference", "temperature"}:
        score -= 9.0 * (_PART.search(f"{message.name} {signal.name}") is not None)
    score -= 0.5 * (_OTHER.search(message.name) is not None)
    return score

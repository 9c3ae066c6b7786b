"""Current, voltage, SoC and temperature among the signals of a DBC, by names, units and values.

Words are whole words of a name. A voltage that follows a current, ΔU = −R·ΔI, is evidence for both;
without it, names must leave nothing open.
"""

from __future__ import annotations

import math
import re
from array import array
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from operator import attrgetter
from statistics import median
from typing import Any, ClassVar, Final

import can
import numpy as np
from cantools.database.can import Database, Message, Signal

from cangauge._typing import FloatArray
from cangauge.bus.database import SignalCodec, signal_codec
from cangauge.bus.vehicle import EXTENDED
from cangauge.errors import InputError
from cangauge.extras.discovery.candidate import MOST_A, ROLES, SHOWN, Candidate, range_text
from cangauge.extras.discovery.fields import LEAST_BITS
from cangauge.extras.discovery.pairs import FEW_MOVES
from cangauge.logs.quantities import unit_of
from cangauge.logs.sign import correlation


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


_ANY_BATTERY: Final = _words("battery batt bat batteries batterie ibat ibatt ubat ubatt vbat vbatt")
_HIGH: Final = _words("hv hvlt highvoltage hochvolt")
"""With one of these it is the pack. Alone they may be any part of a high voltage."""
_BATTERY: Final = _ANY_BATTERY | _words(
    "hvbattery pack pck bms bmu bmc becm"
    " hvb hvbat hvbatt traction trac ess ress esu lb rechargeable"
)
_PARTS: Final = _words(
    "lv lo low aux charger chrg obc dcdc ldc apm motor mtr mcu inv inverter cabin ambient outside"
    " air hvac cool cooling coolant inlet outlet heater heating ptc compressor pump fan valve light"
    " lamp gear relay contactor coil supply ignition module string"
)
"""Other parts of a car, whose current, SoC and temperature are not the pack's."""
_EXTREMES: Final = _words("max min cell cells")
"""Words that the pack's temperature may hold in its name: that of its warmest cell."""
_LIMITS: Final = _EXTREMES | _words(
    "lim limit limits mx mn maximum minimum allow allowed req rq request requested target set"
    " setpoint soll dem demand cmd peak nom nominal nv rated rat avail available cap capacity err"
    " error fault warn warning alarm threshold flag valid status offset gain ref delta dev isol"
    " isolation insulation leak leakage balance balancing pre precharge full remain remaining"
    " energy power est pred draw"
)
"""What is said of another value than the measured one."""
_NEUTRAL: Final = _words(
    "total sum act actl actual ist real meas measured value val inst instant smooth filtered fltrd"
    " avg average mean dc bus link hv main sensor shunt"
)
"""Words that a quantity may have whose message alone is the pack's."""
_PIECES: Final = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
_RUNS: Final = re.compile(r"[a-z]+")
_KNOWN: Final = re.compile(
    "|".join(
        word
        for word in sorted(
            _BATTERY.union(
                _HIGH, _PARTS, _LIMITS, *(_words(each.words) for each in ROLES.values())
            ),
            key=len,
            reverse=True,
        )
        if len(word) > 1
    )
)
_JOINED: Final = re.compile(f"(?:{_KNOWN.pattern})++")
_HIGH_V: Final = 65.536
"""Range of a signal beyond which it is of a high voltage (over 60 V): 16 bits of a millivolt, with
which batteries of 12–48 V are measured."""
_CLEARLY: Final = 1.0
"""Distance in score of the first signal that makes it clear: one matching word."""
_FOLLOWED: Final = 2.0
"""What the physics is worth at most: two matching words."""
_PROVEN: Final = 0.5
"""Share of a voltage's changes by a current from which on the two need no names."""
_WEIGHED: Final = 8
"""Likeliest currents and voltages by name whose pairs are tried."""
_CODES_APART: Final = 1.0 / 16.0
"""Least distance of a code from the measured numbers, as a share of the signal's range."""


def _nothing() -> FloatArray:
    return np.empty(0)


@dataclass(frozen=True, eq=False, kw_only=True)
class NamedSignal(Candidate):
    """A signal of a DBC; its score is in units of one matching word.

    Its evidence is the share of the voltage's changes that follow the current, by the best partner.

    Parameters
    ----------
    bits, holds : int, tuple of float
        Length and range that the DBC gives it; the range in its unit.
    against : tuple of str
        Why it may not have the role.
    is_wrapped : bool
        Whether the DBC reads a signed number as an unsigned one.
    not_available : tuple of int
        Codes in the capture that mean "no value".
    time_s, value : array
        Its values in the capture.
    """

    HEAD: ClassVar = ("signal, by name and unit", "range", "against it")

    bits: int
    holds: tuple[float, float]
    against: tuple[str, ...] = ()
    is_wrapped: bool = False
    not_available: tuple[int, ...] = ()
    time_s: FloatArray = field(default_factory=_nothing, repr=False)
    value: FloatArray = field(default_factory=_nothing, repr=False)

    @property
    def name(self) -> str:
        """Message and signal."""
        return f"{self.message}.{self.signal}"

    @property
    def is_followed(self) -> bool:
        """Whether the physics proves it: the voltage follows the current."""
        return self.evidence > _PROVEN

    @property
    def is_fit(self) -> bool:
        """Whether nothing speaks against it, or the physics for it."""
        return not self.against or self.is_followed

    @property
    def cells(self) -> tuple[str, ...]:
        """Cells of a table under `HEAD`."""
        against = "" if self.is_fit else "; ".join(self.against)
        holds = f"by DBC {range_text(*self.holds, self.unit)}"
        return f"{self.message}\n{self.signal}", self.range_text or holds, against

    def comments(self) -> list[str]:
        """Return the lines that the map states of it."""
        ends = self.range_text
        lines = [f"By name and unit{f'; {ends} in the capture' if ends else ', in no capture'}."]
        if self.evidence:
            share = f"{100.0 * self.evidence:.0f} %"
            lines.append(f"Voltage falls when current rises: {share} of the voltage's changes.")
        return lines

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        names = ("message", "signal", "unit", "score", "evidence")
        return {
            **{name: getattr(self, name) for name in names},
            "against": [*self.against],
            "not_available": [*self.not_available],
            "range": None if math.isnan(self.low) else [self.low, self.high],
        }

    def is_of_one_source(self, other: NamedSignal) -> bool:
        """Whether two signals are of one message, or of one pack by a word of both names."""
        shared = _words_of(self.name) & _words_of(other.name) & _BATTERY
        return self.message == other.message or bool(shared - _ANY_BATTERY)

    def judged(self, role: str, nominal_v: float | None) -> NamedSignal | None:
        """Return it with its score for a role and what speaks against it; None: it has none."""
        wanted, own, of = ROLES[role], _words_of(self.signal), _words_of(self.message)
        unit = unit_of(wanted.column, self.unit) if self.unit else None
        scale, offset = unit or (1.0, 0.0)
        is_soc, is_pair = role == "soc_reference", role in {"current", "voltage"}
        is_named = bool(own & _words(wanted.words)) or (is_soc and {"state", "charge"} <= own)
        names_pack = bool(own & _BATTERY)
        others, parts = own & (_LIMITS | _PARTS), of & _PARTS
        if role == "temperature":
            others -= _EXTREMES
        elif is_pair and not names_pack:
            others |= own - _words(wanted.words) - _NEUTRAL
        lowest, highest = wanted.within
        middle = median(scale * np.unique(self.value) + offset) if len(self.value) else lowest
        if not lowest <= middle <= highest or not (unit or (is_named and not self.unit)):
            return None
        if not is_pair and (parts or (others if role == "temperature" else own & _PARTS)):
            return None
        score = (
            2.0 * (is_named or role == "temperature")
            + 1.0 * (unit is not None)
            + 1.0 * names_pack
            + 0.5 * bool(of & _BATTERY)
            - 1.5 * bool(others)
            - 0.5 * bool(of & (_LIMITS | _PARTS))
        )
        if score <= 0.0 or (is_soc and not is_named):
            return None
        other = others or (frozenset() if names_pack else parts)
        most_a, top_v = scale * max(-self.low, self.high), scale * self.holds[1] + offset
        objections = {
            "no unit": unit is None,
            f"{self.bits} bits": self.bits < LEAST_BITS,
            f"no word for a {role} in its name": is_pair and not is_named,
            "no word for a pack in its name": is_pair and not (own | of) & _BATTERY,
            f"of another value: {', '.join(sorted(other))}": other,
            f"reaches {most_a:.4g} A": role == "current" and unit and most_a > MOST_A,
            f"holds up to {top_v:.4g} V": (
                role == "voltage" and unit and top_v <= (nominal_v or _HIGH_V)
            ),
        }
        against = tuple(text for text, holds in objections.items() if holds)
        return replace(self, role=role, score=score, against=against)


def named_signals(
    database: Database, messages: Iterable[can.Message], nominal_v: float | None = None
) -> dict[str, tuple[NamedSignal, ...]]:
    """Return the likeliest signals of each role, best first.

    Parameters
    ----------
    database : Database
    messages : iterable of can.Message
        A capture of the car; empty: by names and units alone.
    nominal_v : float, optional
        Voltage of the pack, as the user states it [V].

    Raises
    ------
    InputError
        If no message of the DBC is in the capture.
    """
    of_dbc = {
        message.frame_id | (EXTENDED if message.is_extended_frame else 0): message
        for message in database.messages
    }
    frames: defaultdict[int, _NamedFrames] = defaultdict(_NamedFrames)
    is_capture = False
    for each in messages:
        is_capture = True
        key = each.arbitration_id | (EXTENDED if each.is_extended_id else 0)
        if key in of_dbc and not each.is_error_frame and not each.is_remote_frame:
            frames[key].add(each)
    if is_capture and not frames:
        cure = "is it of this car and this bus?"
        raise InputError("no message of this DBC is in the capture", field="--dbc", cure=cure)
    found: dict[str, list[NamedSignal]] = {role: [] for role in ROLES}
    for key in list(frames) if is_capture else of_dbc:
        for made in frames[key].signals(of_dbc[key]):
            for role, signals in found.items():
                if judged := made.judged(role, nominal_v):
                    is_missing = is_capture and not len(made.value)
                    is_still = role == "current" and made.low == made.high
                    score = judged.score - 1.0 * is_missing - 0.5 * is_still
                    signals.append(replace(judged, score=score))
    for signals in found.values():
        signals.sort(key=attrgetter("score"), reverse=True)
    _weigh(found["current"], found["voltage"])
    current, voltage = found["current"], found["voltage"]
    found["current"] = _partnerless(current, voltage, "voltage")
    found["voltage"] = _partnerless(voltage, current, "current")
    for signals in found.values():
        signals.sort(key=attrgetter("is_fit", "score"), reverse=True)
    return {role: tuple(signals[:SHOWN]) for role, signals in found.items()}


def clear_roles(found: Mapping[str, Sequence[NamedSignal]]) -> list[str]:
    """Return the roles whose first signal is clearly the pack's own.

    Sensors in one message measure one part; a SoC that stands still shows no battery at work.
    """
    fit = {role: [each for each in signals if each.is_fit] for role, signals in found.items()}
    pack = {fit[role][0].message for role in ("current", "voltage") if fit[role]}
    clear = []
    for role, signals in fit.items():
        if not signals:
            continue
        first = signals[0]
        near = [each for each in signals[1:] if first.score - each.score < _CLEARLY]
        if role == "temperature":
            is_packs = first.message in pack or bool(_words_of(first.name) & _BATTERY)
            is_clear = is_packs and all(each.message == first.message for each in near)
        else:
            is_clear = not near and not (role == "soc_reference" and first.low == first.high)
        if is_clear:
            clear.append(role)
    return clear


class _NamedFrames:
    """Frames of one message: their times, and which of its distinct payloads each holds."""

    def __init__(self) -> None:
        self.time_s, self.number = array("d"), array("L")
        self.payloads: dict[bytes, int] = {}

    def add(self, message: can.Message) -> None:
        """Add a frame."""
        self.time_s.append(message.timestamp)
        self.number.append(self.payloads.setdefault(bytes(message.data), len(self.payloads)))

    def signals(self, message: Message) -> Iterator[NamedSignal]:
        """Yield the signals that fit into the message, with their values."""
        for signal in message.signals:
            with suppress(InputError):
                codec = signal_codec(message, signal, source="", field=signal.name)
                yield self._signal(message, signal, codec)

    def _signal(self, message: Message, signal: Signal, codec: SignalCodec) -> NamedSignal:
        """Return a signal with its values."""
        low, high = codec.range
        if signal.minimum is not None and signal.maximum is not None:
            low, high = max(low, float(signal.minimum)), min(high, float(signal.maximum))
        bits = codec.field.width
        nothing = NamedSignal(
            message=message.name,
            signal=signal.name,
            unit=codec.unit,
            bits=bits,
            holds=(low, high),
        )
        decoded = self._decoded(codec, message.length)
        is_wrapped = codec.wrapped_bits(decoded) == bits
        if is_wrapped:
            codec = replace(codec, is_signed=True)
            decoded = self._decoded(codec, message.length)
        codes = _codes(codec, decoded)
        decoded[np.isin(codec.raw_numbers(decoded), codes)] = math.nan
        value, time_s = decoded[np.array(self.number)], np.array(self.time_s)
        value, time_s = value[np.isfinite(value)], time_s[np.isfinite(value)]
        if not len(value):
            return nothing
        return replace(
            nothing,
            low=float(value.min()),
            high=float(value.max()),
            is_wrapped=is_wrapped,
            period_s=float(np.median(np.diff(time_s))) if len(time_s) > 1 else math.nan,
            not_available=tuple(codes),
            time_s=time_s,
            value=value,
        )

    def _decoded(self, codec: SignalCodec, length: int) -> FloatArray:
        """Return the value of each payload; NaN where it is too short or holds none."""
        return np.array(
            [
                codec.decode(payload[:length])
                if len(payload) >= length and codec.is_in(payload[:length])
                else math.nan
                for payload in self.payloads
            ]
        )


def _codes(codec: SignalCodec, values: FloatArray) -> list[int]:
    """Return the codes at the ends of a signal's range that lie far from all measured numbers."""
    if codec.float_format:
        return []
    codes, raw = [], codec.raw_numbers(values)
    lowest, highest = codec.raw_range
    for code in (lowest, highest) if codec.is_signed else (highest,):
        far = np.abs(raw - code)
        far = far[far > 0.0]
        if (raw == code).any() and not (far < _CODES_APART * (highest - lowest)).any():
            codes.append(code)
    return codes


def _weigh(currents: list[NamedSignal], voltages: list[NamedSignal]) -> None:
    """Add the physics to the scores of the likeliest currents and voltages by name."""
    shares = np.array([[_followed(i, u) for u in voltages[:_WEIGHED]] for i in currents[:_WEIGHED]])
    for axis, signals in enumerate((currents, voltages)):
        best = shares.max(1 - axis).tolist() if shares.size else []
        for number, share in enumerate(best):
            each = signals[number]
            score = each.score + _FOLLOWED * round(4.0 * share) / 4.0  # equal of equal packs
            signals[number] = replace(each, score=score, evidence=share)


def _partnerless(
    signals: Sequence[NamedSignal], partners: Sequence[NamedSignal], role: str
) -> list[NamedSignal]:
    """Return signals of which those without a partner of their source say so."""
    fit = [each for each in partners if each.is_fit]
    return [
        each
        if any(each.is_of_one_source(other) for other in fit)
        else replace(each, against=(*each.against, f"no {role} of its source"))
        for each in signals
    ]


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


def _words_of(name: str) -> frozenset[str]:
    """Return the words of a name, split at case, digit and underscore.

    A run of letters that consists of known words alone is split into them: "hvbattcurrent".
    """
    words = {piece.lower() for piece in _PIECES.findall(name)}
    for run in _RUNS.findall(name.lower()):
        if _JOINED.fullmatch(run):
            words.update(_KNOWN.findall(run))
    if words & _HIGH and words & _ANY_BATTERY:
        words.add("hvbattery")
    return frozenset(words)

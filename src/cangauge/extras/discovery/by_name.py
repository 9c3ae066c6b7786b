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
from dataclasses import dataclass, replace
from operator import attrgetter
from statistics import median
from typing import Final

import can
import numpy as np
from cantools.database.can import Database, Message, Signal

from cangauge._typing import FloatArray
from cangauge.bus.database import SignalCodec, signal_codec
from cangauge.errors import InputError
from cangauge.extras.discovery.candidate import MOST_A, ROLES, SHOWN, Candidate
from cangauge.extras.discovery.fields import LEAST_BITS
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
_PAIR: Final = ("current", "voltage")
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
_ALL: Final = _BATTERY.union(
    _HIGH, _PARTS, _LIMITS, *(_words(each.words) for each in ROLES.values())
)
_KNOWN: Final = re.compile(
    "|".join(sorted((word for word in _ALL if len(word) > 1), key=len, reverse=True))
)
_JOINED: Final = re.compile(f"(?:{_KNOWN.pattern})++")
_HIGH_V: Final = 65.536
"""Range of a signal beyond which it is of a high voltage (over 60 V): 16 bits of a millivolt, with
which batteries of 12–48 V are measured."""
PROVEN: Final = 0.5
"""Share of a voltage's changes by a current from which on the two need no names."""
_CODES_APART: Final = 1.0 / 16.0
"""Least distance of a code from the measured numbers, as a share of the signal's range."""


@dataclass(frozen=True, eq=False)
class _NamedSignal:
    """A signal of a DBC and its values in a capture.

    `codes` are those that mean "no value", by their distance from all others.
    """

    message: str
    codec: SignalCodec
    holds: tuple[float, float]
    is_wrapped: bool
    codes: tuple[int, ...]
    time_s: FloatArray
    value: FloatArray

    @property
    def period_s(self) -> float:
        """Median interval of its frames [s]."""
        return float(np.median(np.diff(self.time_s))) if len(self.time_s) > 1 else math.nan

    def judged(self, role: str, nominal_v: float | None) -> Candidate | None:
        """Return it with its score for a role and what speaks against it; None: it has none."""
        unit = unit_of(ROLES[role].column, self.codec.unit) if self.codec.unit else None
        score = self._score(role, has_unit=unit is not None)
        if score <= 0.0 or not self._is_plausible(role, unit):
            return None
        low = high = math.nan
        if len(self.value):
            low, high = float(self.value.min()), float(self.value.max())
        # Less where nothing of it is sent, or a current stands still.
        score -= 1.0 * math.isnan(low) + 0.5 * (role == "current" and low == high)
        return Candidate(
            role=role,
            name=f"{self.message}.{self.codec.name}",
            message=self.message,
            signal=self.codec.name,
            unit=self.codec.unit,
            score=score,
            against=tuple(self._objections(role, unit, nominal_v)),
            low=low,
            high=high,
            holds=self.holds,
            period_s=self.period_s,
            is_wrapped=self.is_wrapped,
            not_available=self.codes,
        )

    def _is_named(self, role: str) -> bool:
        own = _words_of(self.codec.name)
        is_state = role == "soc_reference" and {"state", "charge"} <= own
        return is_state or bool(own & _words(ROLES[role].words))

    def _of_others(self, role: str) -> frozenset[str]:
        """Return the words of its name that are said of another value, or of another part."""
        own = _words_of(self.codec.name)
        others = own & (_LIMITS | _PARTS)
        if role == "temperature":
            return others - _EXTREMES
        if role in _PAIR and not own & _BATTERY:
            return others | own - _words(ROLES[role].words) - _NEUTRAL
        return others

    def _score(self, role: str, *, has_unit: bool) -> float:
        """Return the worth of its words and its unit."""
        own, of = _words_of(self.codec.name), _words_of(self.message)
        return (
            2.0 * (self._is_named(role) or role == "temperature")
            + 1.0 * has_unit
            + 1.0 * bool(own & _BATTERY)
            + 0.5 * bool(of & _BATTERY)
            - 1.5 * bool(self._of_others(role))
            - 0.5 * bool(of & (_LIMITS | _PARTS))
        )

    def _is_plausible(self, role: str, unit: tuple[float, float] | None) -> bool:
        """Whether unit, level and name allow a role; SoC and temperature are of no other part."""
        own, of = _words_of(self.codec.name), _words_of(self.message)
        lowest, highest = ROLES[role].within
        scale, offset = unit or (1.0, 0.0)
        middle = median(scale * np.unique(self.value) + offset) if len(self.value) else lowest
        is_named = self._is_named(role)
        if not lowest <= middle <= highest or not (unit or (is_named and not self.codec.unit)):
            return False
        if role == "soc_reference":
            return is_named and not (own | of) & _PARTS
        return role in _PAIR or not (of & _PARTS or self._of_others(role))

    def _objections(
        self, role: str, unit: tuple[float, float] | None, nominal_v: float | None
    ) -> Iterator[str]:
        """Yield what speaks against a role."""
        own, of = _words_of(self.codec.name), _words_of(self.message)
        scale, offset = unit or (1.0, 0.0)
        if unit is None:
            yield "no unit"
        if self.codec.field.width < LEAST_BITS:
            yield f"{self.codec.field.width} bits"
        if role in _PAIR and not self._is_named(role):
            yield f"no word for a {role} in its name"
        if role in _PAIR and not (own | of) & _BATTERY:
            yield "no word for a pack in its name"
        parts = frozenset() if own & _BATTERY else of & _PARTS
        if other := self._of_others(role) or parts:
            yield f"of another value: {', '.join(sorted(other))}"
        most_a = scale * float(np.abs(self.value).max(initial=0.0))
        if role == "current" and unit and most_a > MOST_A:
            yield f"reaches {most_a:.4g} A"
        top_v = scale * self.holds[1] + offset
        if role == "voltage" and unit and top_v <= (nominal_v or _HIGH_V):
            yield f"holds up to {top_v:.4g} V"


class _NamedFrames:
    """Frames of one message: their times, and which of its distinct payloads each holds."""

    def __init__(self) -> None:
        self.time_s, self.number = array("d"), array("L")
        self.payloads: dict[bytes, int] = {}

    def add(self, message: can.Message) -> None:
        """Add a frame."""
        self.time_s.append(message.timestamp)
        self.number.append(self.payloads.setdefault(bytes(message.data), len(self.payloads)))

    def signals(self, message: Message) -> Iterator[_NamedSignal]:
        """Yield the signals that fit into the message, with their values."""
        for signal in message.signals:
            with suppress(InputError):
                codec = signal_codec(message, signal)
                yield self._signal(message, signal, codec)

    def _signal(self, message: Message, signal: Signal, codec: SignalCodec) -> _NamedSignal:
        low, high = codec.range
        if signal.minimum is not None and signal.maximum is not None:
            low, high = max(low, float(signal.minimum)), min(high, float(signal.maximum))
        decoded = self._decoded(codec, message.length)
        is_wrapped = codec.wrapped_bits(decoded) == codec.field.width
        if is_wrapped:
            codec = replace(codec, is_signed=True)
            decoded = self._decoded(codec, message.length)
        codes = _codes(codec, decoded)
        decoded[np.isin(codec.raw_numbers(decoded), codes)] = math.nan
        value = decoded[np.array(self.number)]
        good = np.isfinite(value)
        return _NamedSignal(
            message=message.name,
            codec=codec,
            holds=(low, high),
            is_wrapped=is_wrapped,
            codes=tuple(codes),
            time_s=np.array(self.time_s)[good],
            value=value[good],
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


def named_signals(
    database: Database, messages: Iterable[can.Message], nominal_v: float | None = None
) -> dict[str, list[Candidate]]:
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
    of_dbc = {(each.frame_id, each.is_extended_frame): each for each in database.messages}
    frames: defaultdict[tuple[int, bool], _NamedFrames] = defaultdict(_NamedFrames)
    is_capture = False
    for each in messages:
        is_capture = True
        key = (each.arbitration_id, each.is_extended_id)
        if key in of_dbc and not each.is_error_frame and not each.is_remote_frame:
            frames[key].add(each)
    if is_capture and not frames:
        cure = "is it of this car and this bus?"
        raise InputError("no message of this DBC is in the capture", field="--dbc", cure=cure)
    keys = list(frames) if is_capture else of_dbc
    signals = {
        (signal.message, signal.codec.name): signal
        for key in keys
        for signal in frames[key].signals(of_dbc[key])
    }
    found: dict[str, list[Candidate]] = {}
    for role in ROLES:
        judged = (signal.judged(role, nominal_v) for signal in signals.values())
        found[role] = sorted(filter(None, judged), key=attrgetter("score"), reverse=True)
    current, voltage = _weighed(found["current"], found["voltage"], signals)
    found["current"] = _partnered(current, voltage, "voltage")
    found["voltage"] = _partnered(voltage, current, "current")
    return {
        role: sorted(of, key=attrgetter("is_fit", "score"), reverse=True)[:SHOWN]
        for role, of in found.items()
    }


def _weighed(
    currents: Sequence[Candidate],
    voltages: Sequence[Candidate],
    signals: Mapping[tuple[str, str], _NamedSignal],
) -> list[list[Candidate]]:
    """Add the physics to the scores of the eight likeliest currents and voltages by name.

    It is worth two matching words at most.
    """
    both = (currents, voltages)
    i, u = ([signals[c.message, c.signal] for c in each[:8]] for each in both)
    shares = np.array([[_followed(one, other) for other in u] for one in i])
    weighed = []
    for axis, candidates in enumerate(both):
        best = shares.max(1 - axis).tolist() if shares.size else []
        proven = [
            replace(
                each,
                score=each.score + 2.0 * round(4.0 * share) / 4.0,  # equal of equal packs
                evidence=share,
                against=() if share > PROVEN else each.against,
            )
            for each, share in zip(candidates, best, strict=False)
        ]
        weighed.append([*proven, *candidates[len(best) :]])
    return weighed


def _partnered(
    candidates: Sequence[Candidate], partners: Sequence[Candidate], role: str
) -> list[Candidate]:
    """Return candidates of which those without a partner of their source say so."""
    fit = [each for each in partners if each.is_fit]
    return [
        each
        if each.evidence > PROVEN or any(_are_of_one_source(each, other) for other in fit)
        else replace(each, against=(*each.against, f"no {role} of its source"))
        for each in candidates
    ]


def _are_of_one_source(one: Candidate, other: Candidate) -> bool:
    """Return whether two signals are of one message, or of one pack by a word of both names."""
    shared = _words_of(one.name) & _words_of(other.name) & _BATTERY
    return one.message == other.message or bool(shared - _ANY_BATTERY)


def _followed(current: _NamedSignal, voltage: _NamedSignal) -> float:
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
    if moves < 4.0:  # one coincidence, such as the wake-up, may be all
        return 0.0
    share = correlation(amps, volts) ** 2
    return max(1.0 - (1.0 - share) * (moves - 1.0) / (moves - 2.0), 0.0)


def clear_roles(found: Mapping[str, Sequence[Candidate]]) -> list[str]:
    """Return the roles whose first signal is clearly the pack's own: by one matching word.

    Sensors in one message measure one part; a SoC that stands still shows no battery at work.
    """
    fit = {role: [each for each in of if each.is_fit] for role, of in found.items()}
    pack = {fit[role][0].message for role in ("current", "voltage") if fit[role]}
    clear = []
    for role, candidates in fit.items():
        if not candidates:
            continue
        first, *others = candidates
        near = [each for each in others if first.score - each.score < 1.0]
        if role == "temperature":
            is_packs = first.message in pack or bool(_words_of(first.name) & _BATTERY)
            is_clear = is_packs and all(each.message == first.message for each in near)
        else:
            is_clear = not near and not (role == "soc_reference" and first.low == first.high)
        if is_clear:
            clear.append(role)
    return clear


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

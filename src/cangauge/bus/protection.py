"""Counter and CRC: which frames are new and whole, and how many are missing between them.

A frame with a wrong CRC, or whose counter repeats, is refused. A counter that jumps while the
CRC agrees means that frames were lost: they are counted and the frame is used. Rules: those of
known cars and a user's own here, the profiles of AUTOSAR in `e2e_rule`, a counter without a CRC
in `counter_rule`.

A message with a counter, and no CRC that is known: repeated frames are refused, losses seen.

The profiles of AUTOSAR's end-to-end protection, checked by the library `autosar-e2e`.

A header of CRC and counter (in some profiles also length and data id) stands in the payload; the
CRC covers the data id too, so that a frame sent under a wrong id is refused. Layouts and CRCs:
AUTOSAR FO, "Specification of SW-C End-to-End Communication Protection Library" and "E2E Protocol
Specification".

Which frame can carry which: profiles 1, 2, 5, 6 and 11 fit into 8 bytes; 4 (header of 12 bytes)
and 7 (of 20) need CAN FD.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from types import MappingProxyType
from typing import Any, Final, Literal, Protocol

from e2e import p01, p02, p04, p05, p06, p07, p11

from cangauge.bus.database import Field
from cangauge.errors import InputError

# --- Counter and CRC: which frames are new and whole, and how many are missing between them


class Verdict(enum.IntEnum):
    """What a frame's CRC and counter say."""

    GOOD = 0
    """The frame that was expected."""
    AFTER_LOSS = 1
    """A good frame, but frames before it are missing."""
    CRC_WRONG = 2
    """Refused: damaged."""
    REPEATED = 3
    """Refused: the counter stands still, so this is no new frame."""


# Of every frame; members of an enum are slow to look up.
_GOOD: Final = Verdict.GOOD


class Protection(Protocol):
    """How a message shows that it is new and whole."""

    @property
    def name(self) -> str:
        """What a mapping calls it."""

    @property
    def modulus(self) -> int:
        """How many values the counter has; 0 without a counter."""

    def fits(self, length: int) -> bool:
        """Return whether a payload of so many bytes has room for it."""

    def is_whole(self, data: bytes | bytearray) -> bool:
        """Return whether the CRC agrees, and the counter is one that there is."""

    def counter(self, data: bytes | bytearray) -> int:
        """Return the counter of a payload; 0 without a counter."""

    def protect(self, data: bytes | bytearray, counter: int) -> bytes:
        """Return the payload with counter (taken modulo `modulus`) and CRC set."""


@lru_cache(maxsize=64)
def crc8_table(polynomial: int) -> bytes:
    """Return the 256 entries of the table-driven CRC-8 (not reflected) of a polynomial."""
    table = bytearray(256)
    for value in range(256):
        crc = value
        for _ in range(8):
            crc = ((crc << 1) ^ polynomial if crc & 0x80 else crc << 1) & 0xFF
        table[value] = crc
    return bytes(table)


@dataclass(frozen=True, slots=True)
class ProtectionRule:
    """How a message is protected: a CRC-8 byte over all others, and a counter.

    Parameters
    ----------
    name : str
    polynomial, initial, xor_out : int
        Of the CRC-8, not reflected, 0–255.
    crc_byte : int
        Its place, from the end when negative.
    counter_bits : int
        Width of the counter; 0: there is none.
    counter_byte, counter_shift : int
        Its byte, from the end when negative, and the bit that it starts at.

    Raises
    ------
    InputError
        If a figure is impossible.
    """

    name: str
    polynomial: int
    initial: int = 0
    xor_out: int = 0
    crc_byte: int = -1
    counter_bits: int = 4
    counter_byte: int = -2
    counter_shift: int = 0
    counter_mask: int = field(init=False, repr=False, compare=False)
    """Mask of the counter, shifted down to bit 0."""
    _table: bytes = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("polynomial", "initial", "xor_out"):
            self._require(name, 0, 255)
        self._require("counter_shift", 0, 7)
        self._require("counter_bits", 0, 8 - self.counter_shift)
        if self.counter_bits == 1:
            raise InputError("a counter of one bit tells too little", field=f"{self.name}.counter")
        if self.counter_bits and self.counter_byte == self.crc_byte:
            raise InputError(
                "counter and CRC cannot share a byte",
                field=f"{self.name}.counter_byte",
                value=self.counter_byte,
            )
        object.__setattr__(self, "counter_mask", (1 << self.counter_bits) - 1)
        object.__setattr__(self, "_table", crc8_table(self.polynomial))

    def _require(self, name: str, low: int, high: int) -> None:
        value = getattr(self, name)
        if not low <= value <= high:
            raise InputError(
                f"must be within {low}–{high}", field=f"{self.name}.{name}", value=value
            )

    @property
    def modulus(self) -> int:
        """How many values the counter has; 0 without a counter."""
        return 1 << self.counter_bits if self.counter_bits else 0

    def fits(self, length: int) -> bool:
        """Return whether a payload of so many bytes has both bytes."""
        places = (self.crc_byte, self.counter_byte) if self.counter_bits else (self.crc_byte,)
        found = {place if place >= 0 else length + place for place in places}
        return all(0 <= place < length for place in found) and len(found) == len(places)

    def crc(self, data: bytes | bytearray) -> int:
        """Return the CRC that belongs into the payload `data` (of any content in its CRC byte)."""
        table, crc = self._table, self.initial
        if self.crc_byte == -1:
            covered = data[:-1]
        else:
            covered = data[: self.crc_byte] + data[self.crc_byte :][1:]
        for byte in covered:
            crc = table[crc ^ byte]
        return crc ^ self.xor_out

    def is_whole(self, data: bytes | bytearray) -> bool:
        """Return whether the CRC agrees."""
        return self.crc(data) == data[self.crc_byte]

    def counter(self, data: bytes | bytearray) -> int:
        """Return the counter of a payload; 0 without a counter."""
        return (data[self.counter_byte] >> self.counter_shift) & self.counter_mask

    def protect(self, data: bytes | bytearray, counter: int) -> bytes:
        """Return the payload with counter (taken modulo its width) and CRC set."""
        out = bytearray(data)
        if self.counter_bits:
            mask = self.counter_mask << self.counter_shift
            place = self.counter_byte
            out[place] = (out[place] & ~mask) | ((counter << self.counter_shift) & mask)
        out[self.crc_byte] = self.crc(out)
        return bytes(out)


LEAF_RULE: Final = ProtectionRule("leaf", polynomial=0x85, counter_bits=2)
"""Nissan Leaf EV-CAN: 0x1DB, 0x1DC, 0x55B."""

GENERIC_RULE: Final = ProtectionRule(
    "generic", polynomial=0x1D, initial=0xFF, xor_out=0xFF, counter_bits=4, counter_shift=4
)
"""CRC-8 SAE J1850 in the last byte, counter in the high half of the byte before it: what
cangauge itself sends."""

CRC_ONLY_RULE: Final = ProtectionRule(
    "crc_only", polynomial=0x1D, initial=0xFF, xor_out=0xFF, counter_bits=0
)
"""CRC-8 SAE J1850 in the last byte, no counter: REPLAY_CLOCK, whose time counts."""

RULES: Final = {rule.name: rule for rule in (LEAF_RULE, GENERIC_RULE, CRC_ONLY_RULE)}
"""The rules that a mapping can name."""


SILENCE_S: Final = 2.0
"""After so long without a frame the sender may have begun anew, with any counter [s]."""

WIDE: Final = 256
"""A counter of so many values or more does not go round in no time: one that goes back sooner is
that of a sender that began anew, or of a frame out of its order, and proves no loss."""


class FrameChecker:
    """Checks the frames of one message, one after the other.

    A standing counter is no new frame, unless so much time has passed that the counter can have
    gone round: on a bus that loses frames, one in `modulus` of the survivors looks like that.

    Parameters
    ----------
    rule : Protection
    period_s : float, optional
        Time between frames when none is lost [s]. Without it a standing counter is a repetition
        unless `SILENCE_S` went by without a frame.

    Attributes
    ----------
    lost : int
        Frames missing right before the latest accepted one. The counter proves at least so many;
        whole rounds of it that went by unseen do not show.
    """

    __slots__ = (
        "_counter",
        "_half_round_s",
        "_is_whole",
        "_last",
        "_last_s",
        "_modulus",
        "_period_s",
        "_refused",
        "lost",
    )

    def __init__(self, rule: Protection, period_s: float | None = None) -> None:
        self._is_whole, self._counter = rule.is_whole, rule.counter
        self._modulus = rule.modulus
        self._period_s = math.inf if period_s is None else period_s
        self._half_round_s = (
            SILENCE_S if period_s is None else period_s * min(rule.modulus, WIDE) / 2
        )
        self._last = -1
        self._last_s = 0.0
        self._refused = 0
        self.lost = 0

    def check(self, data: bytes | bytearray, time_s: float) -> Verdict:
        """Judge one payload, cut to the message's length, received at bus time `time_s` [s]."""
        modulus = self._modulus
        if not self._is_whole(data):
            self._refused += 1
            return Verdict.CRC_WRONG
        if not modulus:
            return _GOOD
        last, counter = self._last, self._counter(data)
        elapsed_s, self._last_s = time_s - self._last_s, time_s
        steps = (counter - last) % modulus
        if steps == 1 or last < 0:
            self._last, self._refused = counter, 0
            return _GOOD
        if steps == 0:
            if elapsed_s <= self._half_round_s:
                return Verdict.REPEATED
            steps = min(modulus, WIDE)
        elif modulus >= WIDE and steps > modulus // 2 and elapsed_s < self._period_s * steps / 2:
            steps = 1
        # Frames that came damaged are counted as such, not as lost.
        self.lost = max(steps - 1 - self._refused, 0)
        self._last, self._refused = counter, 0
        return Verdict.AFTER_LOSS if self.lost else Verdict.GOOD


# --- A message with a counter, and no CRC that is known: repeated frames are refused, losses…


@dataclass(frozen=True, slots=True)
class CounterRule:
    """A counter that is a signal of the DBC.

    Parameters
    ----------
    name : str
    field : Field
        Where the counter is.
    length : int
        Bytes of the message.
    modulus : int
        How many values the counter has: it counts 0 … `modulus` − 1.

    Raises
    ------
    InputError
        If the counter's bits cannot hold so many values.
    """

    name: str
    field: Field
    length: int
    modulus: int

    def __post_init__(self) -> None:
        most = 1 << self.field.width
        if not 3 <= self.modulus <= most:
            raise InputError(
                f"a counter of {self.field.width} bits has 3 to {most} values"
                if most >= 3
                else "a counter of one bit tells too little",
                field=f"{self.name}.counter_modulus",
                value=self.modulus,
            )

    def fits(self, length: int) -> bool:
        """Return whether a payload of so many bytes is the message's."""
        return length == self.length

    def is_whole(self, data: bytes | bytearray) -> bool:
        """Return whether the counter is one that there is; more is not known."""
        return self.field.get(data) < self.modulus

    def counter(self, data: bytes | bytearray) -> int:
        """Return the counter of a payload."""
        return self.field.get(data)

    def protect(self, data: bytes | bytearray, counter: int) -> bytes:
        """Return the payload with the counter set."""
        out = bytearray(data)
        self.field.put(out, counter % self.modulus)
        return bytes(out)


# --- The profiles of AUTOSAR's end-to-end protection, checked by the library `autosar-e2e`

DataIdMode = Literal["both", "alternating", "low", "nibble"]

LIST_LENGTH: Final = 16
"""Data ids in the list of profile 2, one for each value of the counter."""


@dataclass(frozen=True, slots=True)
class Profile:
    """Where a profile's counter stands, and what checks it.

    Parameters
    ----------
    header : int
        Bytes of the header.
    counter_at, counter_bytes : int
        First byte of the counter in the header, its number of bytes (big-endian); 0 bytes: the
        low half of that byte.
    modulus : int
        Values of the counter: profiles 1 and 11 leave 15 out.
    id_bits : int
        Width of the data id; 0: a list of 16 bytes.
    modes : mapping of str to int
        How the data id can enter the CRC, where there is a choice.
    check, protect : callable
        Of the library.
    """

    header: int
    counter_at: int
    counter_bytes: int
    modulus: int
    id_bits: int
    modes: MappingProxyType[str, int]
    check: Callable[..., bool]
    protect: Callable[..., None]


_NONE: Final = MappingProxyType[str, int]({})
PROFILES: Final = MappingProxyType(
    {
        "e2e_01": Profile(
            2, 1, 0, 15, 16,
            MappingProxyType({
                "both": p01.E2E_P01_DATAID_BOTH,
                "alternating": p01.E2E_P01_DATAID_ALT,
                "low": p01.E2E_P01_DATAID_LOW,
                "nibble": p01.E2E_P01_DATAID_NIBBLE,
            }),
            p01.e2e_p01_check, p01.e2e_p01_protect,
        ),
        "e2e_02": Profile(2, 1, 0, 16, 0, _NONE, p02.e2e_p02_check, p02.e2e_p02_protect),
        "e2e_04": Profile(12, 2, 2, 1 << 16, 32, _NONE, p04.e2e_p04_check, p04.e2e_p04_protect),
        "e2e_05": Profile(3, 2, 1, 256, 16, _NONE, p05.e2e_p05_check, p05.e2e_p05_protect),
        "e2e_06": Profile(5, 4, 1, 256, 16, _NONE, p06.e2e_p06_check, p06.e2e_p06_protect),
        "e2e_07": Profile(20, 12, 4, 1 << 32, 32, _NONE, p07.e2e_p07_check, p07.e2e_p07_protect),
        "e2e_11": Profile(
            2, 1, 0, 15, 16,
            MappingProxyType({
                "both": p11.E2E_P11_DATAID_BOTH,
                "nibble": p11.E2E_P11_DATAID_NIBBLE,
            }),
            p11.e2e_p11_check, p11.e2e_p11_protect,
        ),
    }
)  # fmt: skip
"""By the name that a mapping takes."""


@dataclass(frozen=True, slots=True)
class E2eRule:
    """Protection of a message by a profile.

    Parameters
    ----------
    name : str
        One of `PROFILES`.
    data_id : int
        Of every profile but 2.
    data_ids : bytes
        The 16 data ids of profile 2, one for each value of the counter.
    data_id_mode : {"both", "alternating", "low", "nibble"}
        How the data id enters the CRC, in profiles 1 and 11 (only "both", "nibble").
    header_byte : int
        Where the header begins; always 0 in profile 2.
    protected_bytes : int
        So many bytes are protected; 0: the whole payload.

    Raises
    ------
    InputError
        If the profile is not known, or cannot have these figures.
    """

    name: str
    data_id: int = 0
    data_ids: bytes = b""
    data_id_mode: DataIdMode = "both"
    header_byte: int = 0
    protected_bytes: int = 0
    _profile: Profile = field(init=False, repr=False, compare=False)
    _arguments: dict[str, Any] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        profile = PROFILES.get(self.name)
        if profile is None:
            raise InputError(
                "unknown profile", field="protection", value=self.name,
                cure=f"known are {', '.join(PROFILES)}",
            )  # fmt: skip
        self._check(profile)
        arguments: dict[str, Any] = {"length": self.protected_bytes}
        if profile.id_bits:
            arguments["offset"] = self.header_byte
        if profile.modes:
            arguments["data_id_mode"] = profile.modes[self.data_id_mode]
        object.__setattr__(self, "_profile", profile)
        object.__setattr__(self, "_arguments", arguments)

    def _check(self, profile: Profile) -> None:
        if profile.id_bits:
            _require(0 <= self.data_id < 1 << profile.id_bits, "data_id", self.data_id,
                     f"{self.name} has a data id of {profile.id_bits} bits")  # fmt: skip
            _require(not self.data_ids, "data_id_list", None, f"{self.name} has one data id")
        else:
            _require(len(self.data_ids) == LIST_LENGTH, "data_id_list", len(self.data_ids),
                     f"{self.name} has a list of {LIST_LENGTH} data ids")  # fmt: skip
            _require(not self.header_byte, "header_byte", self.header_byte,
                     f"the header of {self.name} begins at byte 0")  # fmt: skip
        modes = profile.modes or {"both": 0}
        _require(self.data_id_mode in modes, "data_id_mode", self.data_id_mode,
                 f"{self.name} has {', '.join(modes)}")  # fmt: skip
        _require(self.header_byte >= 0, "header_byte", self.header_byte, "must not be negative")
        least = self.header_byte + profile.header
        _require(self.protected_bytes == 0 or self.protected_bytes >= least, "protected_bytes",
                 self.protected_bytes, f"must hold the header: at least {least}")  # fmt: skip

    @property
    def modulus(self) -> int:
        """How many values the counter has."""
        return self._profile.modulus

    def fits(self, length: int) -> bool:
        """Return whether a payload of so many bytes has room for header and protected bytes."""
        return length >= max(self.header_byte + self._profile.header, self.protected_bytes)

    def is_whole(self, data: bytes | bytearray) -> bool:
        """Return whether header and CRC agree, and the counter is one that there is."""
        if isinstance(data, bytes):
            data = bytearray(data)  # some of the library's checks take nothing else
        return (
            self._profile.check(data, self.data_ids or self.data_id, **self._arguments)
            and self.counter(data) < self._profile.modulus
        )

    def counter(self, data: bytes | bytearray) -> int:
        """Return the counter of a payload."""
        profile = self._profile
        place = self.header_byte + profile.counter_at
        if not profile.counter_bytes:
            return data[place] & 0x0F
        return int.from_bytes(data[place : place + profile.counter_bytes], "big")

    def protect(self, data: bytes | bytearray, counter: int) -> bytes:
        """Return the payload with header, counter (taken modulo its width) and CRC set."""
        profile = self._profile
        out = bytearray(data)
        place = self.header_byte + profile.counter_at
        counter %= profile.modulus
        if profile.counter_bytes:
            end = place + profile.counter_bytes
            out[place:end] = counter.to_bytes(profile.counter_bytes, "big")
        else:
            out[place] = out[place] & 0xF0 | counter
        profile.protect(
            out, self.data_ids or self.data_id, increment_counter=False, **self._arguments
        )
        return bytes(out)


def _require(holds: bool, name: str, value: object, problem: str) -> None:
    if not holds:
        raise InputError(problem, field=name, value=value)

"""Protection of messages by CRC and alive counter: check received frames, protect sent ones.

`ProtectionRule` is a CRC-8 with a counter, as in known cars and in a user's own rules,
`CounterRule` a counter alone, `E2eRule` a profile of AUTOSAR's end-to-end protection, computed by
the library `autosar-e2e`. Layouts and CRCs: AUTOSAR FO, "Specification of SW-C End-to-End
Communication Protection Library" and "E2E Protocol Specification".
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal, NamedTuple

from e2e import p01, p02, p04, p05, p06, p07, p11

from cangauge.bus.database import BitField
from cangauge.errors import InputError


def _require(holds: bool, name: str, value: object, problem: str) -> None:
    if not holds:
        raise InputError(problem, field=name, value=value)


@dataclass(frozen=True, slots=True)
class ProtectionRule:
    """CRC-8 (not reflected) over all other bytes, and a counter of `counter_bits` (0: none).

    `crc_byte` and `counter_byte` are places, negative ones from the end; `counter_shift` is the
    counter's lowest bit. Raises InputError if a value is out of range, or CRC and counter overlap.
    """

    name: str
    polynomial: int
    initial: int = 0
    xor_out: int = 0
    crc_byte: int = -1
    counter_bits: int = 4
    counter_byte: int = -2
    counter_shift: int = 0
    _table: bytes = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        ranges = {"polynomial": 255, "initial": 255, "xor_out": 255, "counter_shift": 7,
                  "counter_bits": 8 - self.counter_shift}  # fmt: skip
        for name, high in ranges.items():
            value = getattr(self, name)
            _require(0 <= value <= high, f"{self.name}.{name}", value, f"must be within 0–{high}")
        _require(self.counter_bits != 1, f"{self.name}.counter", None,
                 "a 1-bit counter is too short")  # fmt: skip
        _require(not self.counter_bits or self.counter_byte != self.crc_byte,
                 f"{self.name}.counter_byte", self.counter_byte,
                 "counter and CRC cannot share a byte")  # fmt: skip
        table = bytearray(256)
        for value in range(256):
            crc = value
            for _ in range(8):
                crc = ((crc << 1) ^ self.polynomial if crc & 0x80 else crc << 1) & 0xFF
            table[value] = crc
        object.__setattr__(self, "_table", bytes(table))

    @property
    def modulus(self) -> int:
        """Number of counter values; 0 without a counter."""
        return 1 << self.counter_bits if self.counter_bits else 0

    def fits(self, length: int) -> bool:
        """Return whether a payload of `length` bytes has both bytes, and they differ."""
        places = (self.crc_byte, self.counter_byte) if self.counter_bits else (self.crc_byte,)
        found = {place if place >= 0 else length + place for place in places}
        return all(0 <= place < length for place in found) and len(found) == len(places)

    def crc(self, data: bytes | bytearray) -> int:
        """Return the CRC of a payload, independent of its CRC byte."""
        table, crc, place = self._table, self.initial, self.crc_byte
        for byte in data[:-1] if place == -1 else data[:place] + data[place:][1:]:
            crc = table[crc ^ byte]
        return crc ^ self.xor_out

    def is_whole(self, data: bytes | bytearray) -> bool:
        """Return whether the CRC agrees."""
        return self.crc(data) == data[self.crc_byte]

    def counter(self, data: bytes | bytearray) -> int:
        """Return the counter of a payload; 0 without a counter."""
        return (data[self.counter_byte] >> self.counter_shift) & ((1 << self.counter_bits) - 1)

    def protect(self, data: bytes | bytearray, counter: int) -> bytes:
        """Return the payload with counter (modulo its width) and CRC set."""
        out = bytearray(data)
        if self.counter_bits:
            mask = ((1 << self.counter_bits) - 1) << self.counter_shift
            place = self.counter_byte
            out[place] = (out[place] & ~mask) | ((counter << self.counter_shift) & mask)
        out[self.crc_byte] = self.crc(out)
        return bytes(out)


LEAF_RULE: Final = ProtectionRule("leaf", polynomial=0x85, counter_bits=2)
"""Nissan Leaf EV-CAN: 0x1DB, 0x1DC, 0x55B."""

GENERIC_RULE: Final = ProtectionRule(
    "generic", polynomial=0x1D, initial=0xFF, xor_out=0xFF, counter_bits=4, counter_shift=4
)
"""CRC-8 SAE J1850 in the last byte, counter in the high half of the byte before: the frames that
`replay` sends as the generic pack."""

CRC_ONLY_RULE: Final = ProtectionRule(
    "crc_only", polynomial=0x1D, initial=0xFF, xor_out=0xFF, counter_bits=0
)
"""CRC-8 SAE J1850 in the last byte, no counter: REPLAY_CLOCK."""

RULES: Final = {rule.name: rule for rule in (LEAF_RULE, GENERIC_RULE, CRC_ONLY_RULE)}
"""Rules that a map file can name."""


@dataclass(frozen=True, slots=True)
class CounterRule:
    """A counter that is a signal of the DBC, with values below `modulus`; no known CRC.

    `length` is the message's. Raises InputError if the bits cannot hold `modulus` values.
    """

    name: str
    field: BitField
    length: int
    modulus: int

    def __post_init__(self) -> None:
        width, most = self.field.width, 1 << self.field.width
        problem = f"a counter of {width} bits has 3 to {most} values"
        _require(3 <= self.modulus <= most, f"{self.name}.counter_modulus", self.modulus,
                 problem if most >= 3 else "a 1-bit counter is too short")  # fmt: skip

    def fits(self, length: int) -> bool:
        """Return whether a payload has the length of the message."""
        return length == self.length

    def is_whole(self, data: bytes | bytearray) -> bool:
        """Return whether the counter value is a possible one."""
        return self.field.get(data) < self.modulus

    def counter(self, data: bytes | bytearray) -> int:
        """Return the counter of a payload."""
        return self.field.get(data)

    def protect(self, data: bytes | bytearray, counter: int) -> bytes:
        """Return the payload with the counter set."""
        out = bytearray(data)
        self.field.put(out, counter % self.modulus)
        return bytes(out)


DataIdMode = Literal["both", "alternating", "low", "nibble"]
LIST_LENGTH: Final = 16
"""Data ids of profile 2, one per counter value."""


class Profile(NamedTuple):
    """Header layout of an E2E profile, and the library's functions for it."""

    header: int  # bytes
    counter_at: int  # first byte of the counter in the header
    counter_bytes: int  # big-endian; 0: the low half of the byte
    modulus: int  # profiles 1 and 11 leave 15 out
    id_bits: int  # width of the data id; 0: a list of 16 bytes
    modes: Mapping[str, int]  # of the data id in the CRC, where there is a choice
    check: Callable[..., bool]
    protect: Callable[..., None]


_MODES_01: Final = {"both": p01.E2E_P01_DATAID_BOTH, "alternating": p01.E2E_P01_DATAID_ALT,
                    "low": p01.E2E_P01_DATAID_LOW, "nibble": p01.E2E_P01_DATAID_NIBBLE}  # fmt: skip
_MODES_11: Final = {"both": p11.E2E_P11_DATAID_BOTH, "nibble": p11.E2E_P11_DATAID_NIBBLE}
PROFILES: Final = {
    "e2e_01": Profile(2, 1, 0, 15, 16, _MODES_01, p01.e2e_p01_check, p01.e2e_p01_protect),
    "e2e_02": Profile(2, 1, 0, 16, 0, {}, p02.e2e_p02_check, p02.e2e_p02_protect),
    "e2e_04": Profile(12, 2, 2, 1 << 16, 32, {}, p04.e2e_p04_check, p04.e2e_p04_protect),
    "e2e_05": Profile(3, 2, 1, 256, 16, {}, p05.e2e_p05_check, p05.e2e_p05_protect),
    "e2e_06": Profile(5, 4, 1, 256, 16, {}, p06.e2e_p06_check, p06.e2e_p06_protect),
    "e2e_07": Profile(20, 12, 4, 1 << 32, 32, {}, p07.e2e_p07_check, p07.e2e_p07_protect),
    "e2e_11": Profile(2, 1, 0, 15, 16, _MODES_11, p11.e2e_p11_check, p11.e2e_p11_protect),
}
"""By name in a map file. Profiles 4 and 7 need CAN FD, the others fit into 8 bytes."""


@dataclass(frozen=True, slots=True)
class E2eRule:
    """AUTOSAR end-to-end protection by a profile, one of `PROFILES`.

    The CRC covers the data id too, so that a frame sent under a wrong id is refused. Profile 2 has
    a list of 16 data ids, one per counter value; the mode of the data id is a choice in profiles 1
    and 11. `header_byte` is the first byte of the header, `protected_bytes` 0 for the whole
    payload. Raises InputError if the profile is unknown, or does not allow these values.
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
            raise InputError("unknown profile", field="protection", value=self.name,
                             cure=f"known are {', '.join(PROFILES)}")  # fmt: skip
        arguments: dict[str, Any] = {"length": self.protected_bytes}
        if profile.id_bits:
            _require(0 <= self.data_id < 1 << profile.id_bits, "data_id", self.data_id,
                     f"{self.name} has a data id of {profile.id_bits} bits")  # fmt: skip
            _require(not self.data_ids, "data_id_list", None, f"{self.name} has one data id")
            arguments["offset"] = self.header_byte
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
        if profile.modes:
            arguments["data_id_mode"] = profile.modes[self.data_id_mode]
        object.__setattr__(self, "_profile", profile)
        object.__setattr__(self, "_arguments", arguments)

    @property
    def modulus(self) -> int:
        """Number of counter values."""
        return self._profile.modulus

    def fits(self, length: int) -> bool:
        """Return whether a payload of `length` bytes has the header and the protected bytes."""
        return length >= max(self.header_byte + self._profile.header, self.protected_bytes)

    def is_whole(self, data: bytes | bytearray) -> bool:
        """Return whether header and CRC agree; the library refuses impossible counters."""
        if isinstance(data, bytes):
            data = bytearray(data)  # some checks of the library accept bytearray only
        return self._profile.check(data, self.data_ids or self.data_id, **self._arguments)

    def counter(self, data: bytes | bytearray) -> int:
        """Return the counter of a payload."""
        profile = self._profile
        place = self.header_byte + profile.counter_at
        if not profile.counter_bytes:
            return data[place] & 0x0F
        return int.from_bytes(data[place : place + profile.counter_bytes], "big")

    def protect(self, data: bytes | bytearray, counter: int) -> bytes:
        """Return the payload with header, counter (modulo its width) and CRC set."""
        profile, out = self._profile, bytearray(data)
        place, counter = self.header_byte + profile.counter_at, counter % profile.modulus
        if size := profile.counter_bytes:
            out[place : place + size] = counter.to_bytes(size, "big")
        else:
            out[place] = out[place] & 0xF0 | counter
        data_id = self.data_ids or self.data_id
        profile.protect(out, data_id, increment_counter=False, **self._arguments)
        return bytes(out)


Protection = ProtectionRule | CounterRule | E2eRule
"""CRC and alive counter of a message: `name`, `modulus` (0 without a counter), `fits`, `is_whole`,
`counter`, `protect`."""


class Verdict(enum.IntEnum):
    """Result of checking the CRC and the counter of a frame."""

    GOOD = 0  # the expected frame
    AFTER_LOSS = 1  # a good frame; frames before it are missing
    CRC_WRONG = 2  # refused: damaged
    REPEATED = 3  # refused: the counter did not change, so this is not a new frame


SILENCE_S: Final = 2.0
"""Silence after which a sender may have restarted, with any counter value [s]."""
WIDE: Final = 256
"""A counter with at least this many values does not wrap within a normal loss. If it steps back
sooner, the sender restarted or frames came out of order: no loss is proven."""
SOON: Final = 0.8
"""A frame this soon after the one before [periods] is not the next one of the same sender: senders
keep their period within some percent."""
SUSPECTED_AT: Final = 8.0
"""Frames out of sequence, repeated or too soon, from which a second sender is suspected: a sender
that restarts makes one or two."""
FORGIVEN: Final = 1.0 / 3.0
"""Such frames forgiven by each frame in sequence: of two senders at least every second frame is out
of sequence, of lost frames in bursts (stamps of a batch are equal) one in four or fewer."""


class FrameChecker:
    """Check the frames of one message in order of time.

    A repeated counter is no new frame, unless enough time has passed for the counter to wrap: on a
    lossy bus one in `modulus` of the surviving frames looks like a repetition. Frames that repeat a
    counter with another content, or come out of sequence too soon, are those of a second sender;
    CAN itself repeats some frames after an error, which are identical. Without a period a repeated
    counter is a repetition unless `SILENCE_S` passed without a frame.

    Attributes
    ----------
    lost : int
        Frames missing right before the latest accepted one, but for whole wraps of the counter.
    learned_period_s : callable
        Returns the frame period [s] where none is stated; NaN while it is not known.
    """

    def __init__(self, rule: Protection, period_s: float | None = None) -> None:
        self._is_whole, self._counter, self._modulus = rule.is_whole, rule.counter, rule.modulus
        self._period_s = period_s
        wrap_s = 2.0 * SILENCE_S if period_s is None else period_s * min(rule.modulus, WIDE)
        self._half_wrap_s = wrap_s / 2
        self._last, self._last_s = -1, 0.0
        self._refused, self._odd = 0, 0.0
        self._content: bytes | bytearray = b""
        self._is_repeated = False
        self.lost = 0
        self.learned_period_s: Callable[[], float] = lambda: math.nan

    @property
    def suspects_second_sender(self) -> bool:
        """Whether the latest frames came from two senders."""
        return self._odd >= SUSPECTED_AT

    def check(self, data: bytes | bytearray, time_s: float) -> Verdict:
        """Check a payload of the message's own length, received at bus time `time_s` [s]."""
        modulus = self._modulus
        if not self._is_whole(data):
            self._refused += 1
            return Verdict.CRC_WRONG
        if not modulus:
            return Verdict.GOOD
        last, counter = self._last, self._counter(data)
        elapsed_s, self._last_s = time_s - self._last_s, time_s
        steps = (counter - last) % modulus
        if steps == 1 or last < 0:
            self._is_repeated = False
            if self._odd:
                self._odd = max(self._odd - FORGIVEN, 0.0)
            return self._accept(counter, data, lost=0)
        period_s = self.learned_period_s() if self._period_s is None else self._period_s
        is_soon = 0.0 <= elapsed_s < SOON * period_s
        is_repeated, was_repeated = steps == 0 and elapsed_s <= self._half_wrap_s, self._is_repeated
        self._is_repeated = is_repeated
        # The second repetition in a row is a stuck counter.
        if (is_soon or (is_repeated and not was_repeated)) and data != self._content:
            self._odd = min(self._odd + 1.0, 2.0 * SUSPECTED_AT)
        if is_repeated:
            return Verdict.REPEATED
        if steps == 0:
            steps = min(modulus, WIDE)
        elif (
            modulus >= WIDE
            and steps > modulus // 2
            and (self._period_s is None or elapsed_s < self._period_s * steps / 2)
        ):
            steps = 1
        # Damaged frames are counted as damaged, not as lost.
        return self._accept(counter, data, lost=max(steps - 1 - self._refused, 0))

    def _accept(self, counter: int, data: bytes | bytearray, lost: int) -> Verdict:
        self._last, self._refused, self._content, self.lost = counter, 0, data, lost
        return Verdict.AFTER_LOSS if lost else Verdict.GOOD

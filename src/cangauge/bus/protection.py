"""Protection of messages by CRC and alive counter: check received frames, protect sent ones.

`ProtectionRule` is a CRC-8 with a counter, as in known cars and in a user's own rules,
`CounterRule` a counter alone, `E2eRule` a profile of AUTOSAR's end-to-end protection, computed by
the library `autosar-e2e`. Layouts and CRCs: AUTOSAR FO, "Specification of SW-C End-to-End
Communication Protection Library" and "E2E Protocol Specification".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Final, Literal, NamedTuple

from e2e import p01, p02, p04, p05, p06, p07, p11
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as checked_dataclass

from cangauge.bus.database import BitField
from cangauge.errors import InputError

Byte = Annotated[int, Field(ge=0, le=255)]
_Place = Annotated[int, Field(ge=-64, le=63)]


@checked_dataclass(config=ConfigDict(extra="forbid"))
class ProtectionRule:
    """CRC-8 (not reflected) over all other bytes, and a counter of `counter_bits` (0: none).

    `crc_byte` and `counter_byte` are places, negative ones from the end; `counter_shift` is the
    counter's lowest bit. `counter_modulus` is the number of counter values, by default all that its
    bits can hold; AUTOSAR's counters of four bits often leave 15 out. `modulus` is 0 without a
    counter.
    """

    polynomial: Byte
    initial: Byte = 0
    xor_out: Byte = 0
    crc_byte: _Place = -1
    counter_bits: Annotated[int, Field(ge=0, le=8)] = 4
    counter_byte: _Place = -2
    counter_shift: Annotated[int, Field(ge=0, le=7)] = 0
    counter_modulus: Annotated[int, Field(ge=3, le=256)] | None = None

    def __post_init__(self) -> None:
        if self.counter_bits == 1 or self.counter_bits + self.counter_shift > 8:
            raise ValueError("counter_bits must be 0, or from 2 to 8 with counter_shift")
        if self.counter_bits and self.counter_byte == self.crc_byte:
            raise ValueError("counter_byte and crc_byte cannot be the same")
        most = 1 << self.counter_bits
        if self.counter_modulus is not None and self.counter_modulus > most:
            raise ValueError(f"counter_modulus is at most {most} with these counter_bits")
        self.modulus = (self.counter_modulus or most) if self.counter_bits else 0
        table: Sequence[int] = range(256)
        for _ in range(8):
            table = [(v << 1 & 0xFF) ^ (self.polynomial if v & 0x80 else 0) for v in table]
        self._table = bytes(table)

    def fits(self, length: int) -> bool:
        """Return whether a payload of `length` bytes has both bytes, and they differ."""
        places = (self.crc_byte, self.counter_byte) if self.counter_bits else (self.crc_byte,)
        bytes_of = {place if place >= 0 else length + place for place in places}
        return all(0 <= byte < length for byte in bytes_of) and len(bytes_of) == len(places)

    def crc(self, data: bytes | bytearray) -> int:
        """Return the CRC of a payload, independent of its CRC byte."""
        table, crc, place = self._table, self.initial, self.crc_byte
        for byte in data[:-1] if place == -1 else data[:place] + data[place:][1:]:
            crc = table[crc ^ byte]
        return crc ^ self.xor_out

    def is_whole(self, data: bytes | bytearray) -> bool:
        """Return whether the CRC agrees, and the counter value is a possible one."""
        is_possible = self.counter_modulus is None or self.counter(data) < self.counter_modulus
        return self.crc(data) == data[self.crc_byte] and is_possible

    def counter(self, data: bytes | bytearray) -> int:
        """Return the counter of a payload; 0 without a counter."""
        return (data[self.counter_byte] >> self.counter_shift) & ((1 << self.counter_bits) - 1)

    def protect(self, data: bytes | bytearray, counter: int) -> bytes:
        """Return the payload with counter (modulo `modulus`) and CRC set."""
        out = bytearray(data)
        if self.counter_bits:
            mask = ((1 << self.counter_bits) - 1) << self.counter_shift
            place, value = self.counter_byte, counter % self.modulus
            out[place] = (out[place] & ~mask) | value << self.counter_shift
        out[self.crc_byte] = self.crc(out)
        return bytes(out)


RULES: Final = {
    # Nissan Leaf EV-CAN: 0x1DB, 0x1DC, 0x55B.
    "leaf": ProtectionRule(polynomial=0x85, counter_bits=2),
    # CRC-8 SAE J1850 in the last byte, counter in the high half of the byte before: the frames that
    # `replay` sends as the generic pack.
    "generic": ProtectionRule(polynomial=0x1D, initial=0xFF, xor_out=0xFF, counter_shift=4),
    # CRC-8 SAE J1850 in the last byte: REPLAY_CLOCK.
    "crc_only": ProtectionRule(polynomial=0x1D, initial=0xFF, xor_out=0xFF, counter_bits=0),
}
"""Rules that a map file can name."""


@dataclass(frozen=True)
class CounterRule:
    """A counter that is a signal of the DBC, with values below `modulus`; no known CRC."""

    field: BitField
    modulus: int

    def __post_init__(self) -> None:
        most = 1 << self.field.width
        if not 3 <= self.modulus <= most:
            problem = f"a counter of {self.field.width} bits has 3 to {most} values"
            problem = problem if most >= 3 else "a 1-bit counter is too short"
            raise InputError(problem, field="counter_modulus", value=self.modulus)

    def fits(self, _length: int) -> bool:
        """Return True: the signal fits into its message."""
        return True

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


class Profile(NamedTuple):
    """Header layout of an E2E profile, and the library's functions for it.

    The counter is the low half of a byte, or as many bytes as `modulus` needs, big-endian.
    """

    header: int  # bytes
    counter_at: int  # first byte of the counter in the header
    modulus: int  # profiles 1 and 11 leave 15 out
    id_bits: int  # width of the data id; 0: a list of 16 bytes
    modes: Mapping[str, int]  # of the data id in the CRC, where there is a choice
    check: Callable[..., bool]
    protect: Callable[..., None]


_MODES_01: Final = {
    "both": p01.E2E_P01_DATAID_BOTH,
    "alternating": p01.E2E_P01_DATAID_ALT,
    "low": p01.E2E_P01_DATAID_LOW,
    "nibble": p01.E2E_P01_DATAID_NIBBLE,
}
_MODES_11: Final = {"both": p11.E2E_P11_DATAID_BOTH, "nibble": p11.E2E_P11_DATAID_NIBBLE}
PROFILES: Final = {
    "e2e_01": Profile(2, 1, 15, 16, _MODES_01, p01.e2e_p01_check, p01.e2e_p01_protect),
    "e2e_02": Profile(2, 1, 16, 0, {}, p02.e2e_p02_check, p02.e2e_p02_protect),
    "e2e_04": Profile(12, 2, 1 << 16, 32, {}, p04.e2e_p04_check, p04.e2e_p04_protect),
    "e2e_05": Profile(3, 2, 256, 16, {}, p05.e2e_p05_check, p05.e2e_p05_protect),
    "e2e_06": Profile(5, 4, 256, 16, {}, p06.e2e_p06_check, p06.e2e_p06_protect),
    "e2e_07": Profile(20, 12, 1 << 32, 32, {}, p07.e2e_p07_check, p07.e2e_p07_protect),
    "e2e_11": Profile(2, 1, 15, 16, _MODES_11, p11.e2e_p11_check, p11.e2e_p11_protect),
}
"""By name in a map file. Profiles 4 and 7 need CAN FD, the others fit into 8 bytes."""


@dataclass
class E2eRule:
    """AUTOSAR end-to-end protection by a profile, one of `PROFILES`.

    The CRC covers the data id too, so that a frame sent under a wrong id is refused. Profile 2 has
    a list of 16 data ids, one per counter value; the mode of the data id is a choice in profiles 1
    and 11. `header_byte` is the first byte of the header, `protected_bytes` 0 for the whole
    payload. Raises InputError if the profile does not allow these values.
    """

    name: str
    data_id: int | None = None
    data_id_list: tuple[int, ...] | None = None
    data_id_mode: DataIdMode = "both"
    header_byte: int = 0
    protected_bytes: int = 0

    def __post_init__(self) -> None:
        name, profile = self.name, PROFILES[self.name]
        bits, modes = profile.id_bits, profile.modes or {"both": 0}
        least, protected = self.header_byte + profile.header, self.protected_bytes
        wanted = "data_id" if bits else "data_id_list"
        if getattr(self, wanted) is None:
            cure = f"the CRC of {name} covers it: ask the sender's manufacturer"
            raise InputError("is missing", field=wanted, cure=cure)
        problems = {
            "data_id_list": bits and self.data_id_list and f"{name} has one data id",
            "data_id": (self.data_id or 0) >> bits and f"{name} has a data id of {bits} bits",
            "data_id_mode": self.data_id_mode not in modes and f"{name} has {', '.join(modes)}",
            "header_byte": self.header_byte and not bits and f"{name} has its header at byte 0",
            "protected_bytes": 0 < protected < least
            and f"must hold the header: at least {least} bytes",
        }
        for where, problem in problems.items():
            if problem:
                raise InputError(str(problem), field=where, value=getattr(self, where))
        self.modulus, self._profile, self._least = profile.modulus, profile, max(least, protected)
        self._data_id = bytes(self.data_id_list) if self.data_id_list else self.data_id
        self._arguments: dict[str, int] = {"length": protected}
        if bits:
            self._arguments["offset"] = self.header_byte
        if profile.modes:
            self._arguments["data_id_mode"] = modes[self.data_id_mode]
        self._mask, first = max(0x0F, profile.modulus - 1), self.header_byte + profile.counter_at
        self._place = slice(first, first + (self._mask.bit_length() + 7) // 8)

    def fits(self, length: int) -> bool:
        """Return whether a payload of `length` bytes has the header and the protected bytes."""
        return length >= self._least

    def is_whole(self, data: bytes | bytearray) -> bool:
        """Return whether header and CRC agree; the library refuses impossible counters."""
        if isinstance(data, bytes):
            data = bytearray(data)  # some checks of the library accept bytearray only
        return self._profile.check(data, self._data_id, **self._arguments)

    def counter(self, data: bytes | bytearray) -> int:
        """Return the counter of a payload."""
        return int.from_bytes(data[self._place], "big") & self._mask

    def protect(self, data: bytes | bytearray, counter: int) -> bytes:
        """Return the payload with header, counter (modulo its width) and CRC set."""
        profile, place, out = self._profile, self._place, bytearray(data)
        word = int.from_bytes(out[place], "big") & ~self._mask | counter % profile.modulus
        out[place] = word.to_bytes(place.stop - place.start, "big")
        profile.protect(out, self._data_id, increment_counter=False, **self._arguments)
        return bytes(out)


Protection = ProtectionRule | CounterRule | E2eRule
"""CRC and alive counter of a message: `modulus` (0 without a counter), `fits`, `is_whole`,
`counter`, `protect`."""


Anomaly = Literal["crc_errors", "counter_repeats", "counter_jumps"]
"""What a frame's CRC and counter show, by the count that it enters: it is damaged; the counter did
not change, so that it is no new frame; or it is good, and frames before it are missing."""

SILENCE_S: Final = 2.0
"""Silence after which a sender may have restarted, with any counter value [s]."""
WIDE: Final = 256
"""A counter with at least this many values does not wrap within a normal loss. If it steps back
sooner, the sender restarted or frames came out of order: no loss is proven."""
TWO_SENDERS: Final = 12.0
"""Frames out of sequence that one sender cannot have sent, from which there are two. Any other
frame out of sequence takes back 12 / `modulus` of them. Where losses are random, one in `modulus`
seems to go on with the sequence left before; they then reach 12 with a probability of 7e-8 with a
counter of two bits, less with a longer one (Wald's bound θ⁻¹², with θ from
θ/m + (1 - 1/m) θ^(-12/m) = 1). Also the frames beyond one sender's rate that are too many."""
CROWDED: Final = 1.5
"""Frames per period that are too many for one sender and its jitter: two send 2 or more."""
RUN: Final = 64
"""Frames in sequence that show the period of their sender: others would lie between them."""


class FrameChecker:
    """Check the frames of one message in order of time.

    A repeated counter is no new frame, unless enough time has passed for the counter to wrap: on a
    lossy bus one in `modulus` of the surviving frames looks like a repetition. CAN itself repeats
    some frames after an error, which are identical. Without a period a repeated counter is a
    repetition unless `SILENCE_S` passed without a frame.

    Attributes
    ----------
    lost : int
        Frames missing right before the latest accepted one. Where its counter proves a loss and the
        period is known, whole wraps of the counter count too, but not in a silence of `SILENCE_S`:
        the sender may have paused.
    learned_period_s : callable
        Returns the frame period [s] where none is stated; NaN while it is not known.
    """

    def __init__(self, rule: Protection, period_s: float | None = None) -> None:
        self._is_whole, self._counter, self._modulus = rule.is_whole, rule.counter, rule.modulus
        self._period_s = period_s
        self.learned_period_s: Callable[[], float] = partial(float, "nan")
        self._half_wrap_s = SILENCE_S
        if period_s is not None:
            self._half_wrap_s = period_s * min(rule.modulus, WIDE) / 2
        self._last, self._last_s = -1, 0.0
        self._refused = 0
        self._other = -1  # counter of the sequence that was left for the present one
        self._of_others = 0.0
        self._step_s = math.inf  # between the latest two frames in sequence
        self._content: bytes | bytearray = b""
        self._is_repeated = False
        # As seen, 0 before: a stated period is wrong too often to accuse anybody by it.
        self._sent_every_s = 0.0
        self._surplus = 0.0
        self._run, self._run_s = 0, 0.0
        self.lost = 0

    @property
    def suspects_second_sender(self) -> bool:
        """Whether the latest frames came from two senders."""
        return self._of_others >= TWO_SENDERS

    def check(self, data: bytes | bytearray, time_s: float) -> Anomaly | None:
        """Check a payload of the message's own length, received at bus time `time_s` [s]."""
        modulus, last = self._modulus, self._last
        if not self._is_whole(data):
            self._refused += 1
            return "crc_errors"
        if not modulus:
            return None
        counter = self._counter(data)
        elapsed_s, self._last_s = time_s - self._last_s, time_s
        steps = (counter - last) % modulus
        self.lost = 0
        self._note_rate(elapsed_s, in_sequence=steps == 1 and last >= 0)
        if steps == 1 or last < 0:
            self._is_repeated = False
            if last >= 0 and elapsed_s > 0.0:  # 0: delivered together
                self._step_s = elapsed_s
        else:
            was_repeated = self._is_repeated
            self._is_repeated = steps == 0 and elapsed_s <= self._half_wrap_s
            # One sender needs its period for each step. A stuck counter repeats itself on and on.
            goes_on = counter == (self._other + 1) % modulus and self._other >= 0
            period_s = self._least_period_s()
            is_early = elapsed_s < ((steps or modulus) - 0.5) * period_s < math.inf
            if not (steps == 0 and data == self._content):
                is_other = goes_on or (self._is_repeated and not was_repeated)
                is_proof = (is_other and is_early) or self._surplus > TWO_SENDERS
                score = 1.0 if is_proof else -TWO_SENDERS / modulus
                self._of_others = max(self._of_others + score, 0.0)
            if self._is_repeated:
                return "counter_repeats"
            self._other = last
            if steps == 0:
                steps = min(modulus, WIDE)
            elif modulus >= WIDE and steps > modulus // 2:
                is_early = self._period_s is None or elapsed_s < self._period_s * steps / 2
                steps = 1 if is_early else steps
            self.lost = self._lost(steps, elapsed_s)
        self._last, self._refused, self._content = counter, 0, data
        return "counter_jumps" if self.lost else None

    def _note_rate(self, elapsed_s: float, *, in_sequence: bool) -> None:
        """Count frames beyond those that one sender sends, less what it owes since a silence."""
        if period_s := self._sent_every_s:
            surplus = self._surplus + 1.0 - CROWDED * elapsed_s / period_s
            self._surplus = max(surplus, -SILENCE_S / period_s)
        if not in_sequence:
            self._run, self._run_s = 0, 0.0
            return
        self._run, self._run_s = self._run + 1, self._run_s + elapsed_s
        if self._run == RUN:
            self._sent_every_s = min(self._run_s / RUN, SILENCE_S)
            self._run, self._run_s = 0, 0.0

    def _least_period_s(self) -> float:
        """Return the shorter of the stated and the learned period [s]; infinite: none is known.

        Where none is stated, that between the latest frames in sequence stands for it: with losses
        too long a period may be learned.
        """
        given_s = self._step_s if self._period_s is None else self._period_s
        return min(given_s, self.learned_period_s())

    def _lost(self, steps: int, elapsed_s: float) -> int:
        """Return the frames lost, from the counter's steps and the time since the frame before."""
        period_s = self.learned_period_s() if self._period_s is None else self._period_s
        if period_s > 0.0 and elapsed_s < SILENCE_S:
            wraps = round((elapsed_s / period_s - steps) / self._modulus)
            steps += max(wraps, 0) * self._modulus
        # Damaged frames are counted as damaged, not as lost.
        return max(steps - 1 - self._refused, 0)

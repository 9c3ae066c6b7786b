"""DBC files: reading, search with helpful errors, and codecs of single signals.

cantools reads the file. A `SignalCodec` decodes one signal without its whole message; its values
equal those of cantools to the last bit.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import re
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, cast

import cantools.database
import numpy as np
from can.typechecking import StringPathLike
from cantools.database.can import Database, Message, Signal
from numpy.typing import NDArray

from cangauge._files import MIB, read_bounded
from cangauge._typing import FloatArray
from cangauge.bus.dbc_text import prepared
from cangauge.errors import InputError, closest, located

MAX_DBC_BYTES: Final = 4 * MIB
"""Parsing takes 1–6 s a megabyte; the largest files in use are smaller."""

Decode = Callable[[bytes | bytearray], float]

_CONVERTED: Final = {".arxml", ".kcd", ".sym"}
"""Suffixes of formats that cantools converts to a DBC."""

# Names in value tables for codes without a value.
_NOT_A_VALUE = re.compile(
    r"^(sna|n/?a|no data|invalid|error|fault|fehler|undefined|unknown|init)$"
    r"|(not|un)[\s_-]?(available|avail|valid|def)|invalid",
    re.IGNORECASE,
)
_FLOATS: Final = {16: "e", 32: "f", 64: "d"}

# cantools warns on stderr of messages defined twice; `find_message` reports the wanted ones.
logging.getLogger("cantools").addHandler(logging.NullHandler())


@dataclass(frozen=True, slots=True)
class BitField:
    """Bits of a payload, as an unsigned number.

    `shift` is the lowest bit and `width` the number of bits, in the payload read as one number of
    the byte order `big_endian` (Motorola) or not (Intel). Payloads have the message's own length.
    """

    shift: int
    width: int
    big_endian: bool

    @property
    def mask(self) -> int:
        """Largest number that the bits hold."""
        return (1 << self.width) - 1

    @property
    def order(self) -> Literal["big", "little"]:
        """Byte order, as `int.from_bytes` names it."""
        return "big" if self.big_endian else "little"

    def get(self, payload: bytes | bytearray) -> int:
        """Return the bits of a payload."""
        return (int.from_bytes(payload, self.order) >> self.shift) & self.mask

    def put(self, payload: bytearray, raw: int) -> None:
        """Set the bits in a payload."""
        word = int.from_bytes(payload, self.order) & ~(self.mask << self.shift)
        word |= (raw & self.mask) << self.shift
        payload[:] = word.to_bytes(len(payload), self.order)

    @classmethod
    def of(cls, signal: Signal, length: int) -> BitField:
        """Return the bits of a signal in a payload of `length` bytes (DBC bit numbering)."""
        if signal.byte_order == "little_endian":
            return cls(signal.start, signal.length, big_endian=False)
        from_top = 8 * (signal.start // 8) + 7 - signal.start % 8
        return cls(8 * length - from_top - signal.length, signal.length, big_endian=True)


Condition = tuple[BitField, frozenset[int]]
"""A multiplexer, and its values with which a signal is present in a frame."""


@dataclass(slots=True)
class SignalCodec:
    """Conversion of one signal: value = gain × (raw × factor + offset) + shift.

    Parameters
    ----------
    name, unit, factor, offset : str, float
        In the DBC.
    field, is_signed, float_format : BitField, bool, str
        Bits; `float_format` is the `struct` format of an IEEE float, "" for integers.
    not_available : frozenset of int
        Raw codes without a value, negative where those of a signed signal are.
    conditions : tuple of Condition
        All must hold for the signal to be present in a frame.

    Attributes
    ----------
    decode : callable
        Takes a payload of the message's own length; returns the value, NaN for "not available".
    """

    name: str
    unit: str
    field: BitField
    is_signed: bool
    float_format: str
    factor: float
    offset: float
    not_available: frozenset[int]
    conditions: tuple[Condition, ...] = ()
    gain: float = 1.0
    shift: float = 0.0
    decode: Decode = dataclasses.field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        self.decode = self._float_decoder() if self.float_format else self._integer_decoder()

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle without `decode`, which is made again."""
        given = (getattr(self, each.name) for each in dataclasses.fields(self) if each.init)
        return type(self), tuple(given)

    # `decode` is made once, with all that it needs at hand: it runs for every value.

    def _float_decoder(self) -> Decode:
        bits, number = self.field, struct.Struct(">" + self.float_format)
        factor, offset, gain, shift = self.factor, self.offset, self.gain, self.shift

        def decode(payload: bytes | bytearray) -> float:
            value: float = number.unpack(bits.get(payload).to_bytes(number.size, "big"))[0]
            return gain * (value * factor + offset) + shift if math.isfinite(value) else math.nan

        return decode

    def _integer_decoder(self) -> Decode:
        order, low_bit, mask = self.field.order, self.field.shift, self.field.mask
        factor, offset, gain, shift = self.factor, self.offset, self.gain, self.shift
        not_available, sign_bit = self.not_available, mask + 1 >> 1 if self.is_signed else 0

        def decode(payload: bytes | bytearray) -> float:
            raw = (int.from_bytes(payload, order) >> low_bit) & mask
            if raw & sign_bit:
                raw -= mask + 1
            return math.nan if raw in not_available else gain * (raw * factor + offset) + shift

        return decode

    def is_in(self, payload: bytes | bytearray) -> bool:
        """Return whether the signal is present, according to its multiplexers, if any."""
        return all(field.get(payload) in values for field, values in self.conditions)

    def encode_into(self, payload: bytearray, value: float) -> None:
        """Set the signal and its multiplexers; NaN becomes the first "not available" code.

        Raises InputError if the value does not fit, or is NaN and there is no such code.
        """
        for field, values in self.conditions:
            field.put(payload, min(values))
        self.field.put(payload, self._raw(value))

    def _raw(self, value: float) -> int:
        number = ((value - self.shift) / self.gain - self.offset) / self.factor
        if math.isnan(value) and not self.float_format:
            if not self.not_available:
                problem = "the DBC has no code for a missing value"
                raise InputError(problem, field=self.name, value=value)
            return min(self.not_available)
        low, high = self.raw_range
        try:
            if self.float_format:
                return int.from_bytes(struct.pack(">" + self.float_format, number), "big")
            raw = round(number)
        except OverflowError:  # too large for the float, or infinite
            raw = high + 1
        if not low <= raw <= high or raw in self.not_available:
            ends = "{:g} to {:g}".format(*self.range)
            problem = f"does not fit into the signal, which holds {ends} {self.unit}".rstrip()
            cure = "use a DBC with a wider signal"
            raise InputError(problem, field=self.name, value=value, cure=cure)
        return raw

    @property
    def raw_range(self) -> tuple[int, int]:
        """Smallest and largest raw number."""
        low = -(1 << (self.field.width - 1)) if self.is_signed else 0
        return low, low + self.field.mask

    @property
    def range(self) -> tuple[float, float]:
        """Smallest and largest value that can be sent."""
        if self.float_format:
            return -math.inf, math.inf
        low, high = self.raw_range
        while low in self.not_available:
            low += 1
        while high in self.not_available:
            high -= 1
        ends = sorted(self.gain * (n * self.factor + self.offset) + self.shift for n in (low, high))
        return ends[0], ends[1]

    def fits(self, values: FloatArray) -> NDArray[np.bool_]:
        """Return which values `encode_into` can send; NaN counts as one."""
        raw, (low, high) = self.raw_numbers(values), self.raw_range
        is_sent = ~((raw < low) | (raw > high) | np.isin(raw, list(self.not_available)))
        return is_sent | bool(self.float_format)

    def raw_numbers(self, values: FloatArray) -> FloatArray:
        """Return the raw numbers of values, NaN for NaN."""
        raw: FloatArray = np.rint(((values - self.shift) / self.gain - self.offset) / self.factor)
        return raw

    def wrapped_bits(self, values: FloatArray) -> int | None:
        """Return the width of the signed number that these values are, if they are read unsigned.

        They lie at both ends of its range, where the number wraps at zero, and none in its middle
        half. It may have a bit less than the signal.
        """
        if self.float_format or self.is_signed or self.offset:
            return None
        raw = self.raw_numbers(values[np.isfinite(values)])
        for bits in (self.field.width, self.field.width - 1):
            top, quarter = 1 << bits, 1 << bits >> 2
            negative = np.unique(raw[raw >= top - quarter])
            is_apart = ((raw < quarter) | (raw >= top - quarter)).all() and (raw < quarter).any()
            if (
                is_apart
                and len(negative) > 3  # signals have up to three codes for "not available"
                and negative[-1] < top <= negative[-1] + top / 32
            ):
                return bits
        return None

    @property
    def half_step(self) -> float:
        """Largest quantization error; 0 for floats."""
        return 0.0 if self.float_format else abs(self.gain * self.factor) / 2.0


def signal_codec(
    message: Message,
    signal: Signal,
    *,
    not_available: tuple[int, ...] = (),
    when: dict[str, int] | None = None,
    signed: bool = False,
) -> SignalCodec:
    """Build the codec of a signal.

    Parameters
    ----------
    message, signal : Message, Signal
    not_available : tuple of int
        Raw codes without a value, besides those that the value table names so. That of a signed
        signal may be written as its bits are: 0x8000 is −32768 of 16 bits.
    when : dict of str to int, optional
        Further conditions: raw values of other signals of the message.
    signed : bool
        Whether it is a signed number, also where the DBC says unsigned.

    Raises
    ------
    InputError
        If the signal does not fit into its message or cannot be a number, or never has a code; its
        field is "signal", or the name of the argument.
    """
    bits, conversion = _bits_of(message, signal), signal.conversion
    is_signed = (signal.is_signed or signed) and not conversion.is_float
    selectors = _selectors(message, signal)
    conditions = [(_bits_of(message, selector), values) for selector, values in selectors]
    for name, value in (when or {}).items():
        other_bits = _bits_of(message, named_signal(message, name, "when"))
        conditions.append((other_bits, frozenset({value & other_bits.mask})))
    return SignalCodec(
        name=signal.name,
        unit=(signal.unit or "").strip(),
        field=bits,
        is_signed=is_signed,
        float_format=_FLOATS[signal.length] if conversion.is_float else "",
        factor=float(conversion.scale),
        offset=float(conversion.offset),
        not_available=_codes(signal, is_signed, not_available),
        conditions=tuple(conditions),
    )


def _bits_of(message: Message, signal: Signal) -> BitField:
    """Return the bits of a signal; raise InputError if it does not fit, or is no number."""
    bits, conversion = BitField.of(signal, message.length), signal.conversion
    if signal.length < 1 or bits.shift < 0 or bits.shift + bits.width > 8 * message.length:
        problem = f"the signal does not fit into the {message.length} bytes of {message.name}"
    elif signal.length not in (_FLOATS if conversion.is_float else range(65)):
        problem = f"a {'float' if conversion.is_float else 'number'} of {signal.length} bits"
        problem += " is not possible"
    elif not (0.0 < abs(conversion.scale) < math.inf and math.isfinite(conversion.offset)):
        problem = "factor and offset must be finite and the factor not 0"
    else:
        return bits
    raise InputError(problem, field="signal", value=signal.name, cure="correct the DBC")


def _codes(signal: Signal, is_signed: bool, stated: tuple[int, ...]) -> frozenset[int]:
    """Return the codes of the value table and the stated ones, which must be possible."""
    width = signal.length
    low, end = -(1 << (width - 1)) if is_signed else 0, 1 << width
    for code in stated:
        problem = cure = ""
        if signal.conversion.is_float:
            problem, cure = "a float has no codes", "remove it: NaN and infinite are no values"
        elif not low <= code < end:
            problem = f"a signal of {width} bits never has this code"
            cure = f"state the raw code, within {low} to {end - 1}"
        if problem:
            raise InputError(problem, field="not_available", value=code, cure=cure)
    codes, names = set(stated), dict[int, object](signal.conversion.choices or {})
    if 2 * len(names) <= end:  # else an enumeration, in which "invalid" is a state
        codes |= {int(raw) for raw, name in names.items() if _NOT_A_VALUE.search(str(name))}
    # The bits of a signed signal may be stated unsigned, as most value tables do.
    return frozenset(
        code - end if is_signed and code >= -low else code for code in codes if low <= code < end
    )


def _selectors(message: Message, signal: Signal) -> Iterator[tuple[Signal, frozenset[int]]]:
    """Yield the multiplexers of a signal with the values that select it, the nearest first."""
    selector: Signal | None = signal
    for _ in message.signals:
        if selector is None or (name := selector.multiplexer_signal) is None:
            break
        values, selector = frozenset(selector.multiplexer_ids or ()), _signal(message, name)
        if selector is not None:
            yield selector, values
    if selector is None or selector.multiplexer_signal is not None:
        problem = "its multiplexer is missing, or its own"
        raise InputError(problem, field="signal", value=signal.name, cure="correct the DBC")


def _signal(message: Message, name: str) -> Signal | None:
    return next((each for each in message.signals if each.name == name), None)


def named_signal(message: Message, name: str, field: str) -> Signal:
    """Return the signal of that name; raise InputError with `field` if there is none."""
    signal = _signal(message, name)
    if signal is None:
        raise InputError(f"message {message.name} has no such signal", field=field, value=name)
    return signal


def load_dbc(path: StringPathLike, remarks: list[str] | None = None) -> Database:
    """Read a DBC file.

    Overlapping signals are accepted: many files have some in messages that are not wanted. What is
    read otherwise than it is written (`dbc_text.prepared`) is added to `remarks`. Raises InputError
    if the file is absent, larger than `MAX_DBC_BYTES`, or not a DBC.
    """
    path = Path(path)
    data = read_bounded(path, MAX_DBC_BYTES, "a DBC")
    if not data.strip():
        raise InputError("the DBC is empty", source=path)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("cp1252", errors="replace")  # the encoding that most tools write
    try:
        if re.search(r"\bBO_\s+\d", text) is None:  # another text takes as long to parse as a DBC
            raise ValueError("it has no message (BO_)")  # noqa: TRY301 - reported as others are
        text, changes = prepared(text, path)
        database = cantools.database.load_string(text, "dbc", strict=False)
    except InputError:
        raise
    except Exception as error:  # a damaged DBC may raise anything in cantools
        words = " ".join((str(error) or type(error).__name__).split())[:160]
        problem = f"not a DBC file that can be read: {words}"
        cure = "open it in a DBC editor, which names the error"
        if path.suffix.lower() in _CONVERTED:
            cure = f"convert it: python -m cantools convert {path} car.dbc"
        raise InputError(problem, source=path, cure=cure) from error
    if remarks is not None:
        remarks += changes
    return cast("Database", database)


def find_message(database: Database, message: str | int) -> Message:
    """Return the message of that name or id ("PackStatus", 475, "0x1DB").

    Raises InputError if there is none (with the closest names) or more than one.
    """
    number: int | None = None
    with suppress(ValueError):
        number = message if isinstance(message, int) else int(message, 0)
    messages = database.messages
    found = [each for each in messages if each.name == message or each.frame_id == number]
    if len(found) == 1:
        return found[0]
    near = closest(str(message), (each.name for each in messages))
    if found:
        problem, cure = f"the DBC defines {len(found)} such messages", "keep one of them"
    else:
        problem, cure = "the DBC has no such message", near and f"did you mean {near}?"
    names = [f"{each.name} (0x{each.frame_id:X})" for each in messages]
    raise InputError(problem, value=message, cure=cure or _listed(names, "messages"))


def find_signal(
    database: Database, message: str | int | None, signal: str
) -> tuple[Message, Signal]:
    """Return a signal and its message; without a message, the only signal of that name.

    Raises InputError if there is none (with the closest names) or more than one; its field is
    "message" or "signal".
    """
    searched = database.messages
    if message is not None:
        with located(None, "message"):
            searched = [find_message(database, message)]
    found = [(each, known) for each in searched if (known := _signal(each, signal)) is not None]
    if len(found) == 1:
        return found[0]
    problem, cure = "the DBC has no such signal", "check the name in the DBC"
    if message is not None:
        problem = f"message {searched[0].name} has no such signal"
        cure = _listed([each.name for each in searched[0].signals], "signals")
    if found:
        names = ", ".join(owner.name for owner, _ in found[:5])
        problem = f"{len(found)} messages have such a signal ({names})"
        cure = "name the message too"
    elif others := [each.name for each in database.messages if _signal(each, signal)]:
        cure = f"it is in {', '.join(others[:3])}"
    elif near := closest(signal, (each.name for owner in searched for each in owner.signals)):
        cure = f"did you mean {near}?"
    raise InputError(problem, field="signal", value=signal, cure=cure)


def _listed(names: list[str], what: str) -> str:
    more = f" and {len(names) - 6} more" if len(names) > 6 else ""
    return f"its {what} are {', '.join(names[:6])}{more}" if names else f"it has no {what}"

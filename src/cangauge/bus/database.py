"""DBC files: bounded reading, search with helpful errors, and codecs of single signals.

cantools reads the DBC. A `SignalCodec` decodes one signal without its whole message; its values
equal those of cantools to the last bit.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Final, Literal
from xml.etree import ElementTree as ET

import cantools.database
import numpy as np
from cantools.database.can import Database, Message, Signal
from numpy.typing import NDArray

from cangauge._io import MAX_DBC_BYTES, read_bounded, time_limit
from cangauge._typing import FloatArray
from cangauge.errors import InputError, closest

Decode = Callable[[bytes | bytearray], float]

# Names in value tables for codes without a value.
_NOT_A_VALUE = re.compile(
    r"^(sna|n/?a|no data|invalid|error|fault|fehler|undefined|unknown|init)$"
    r"|(not|un)[\s_-]?(available|avail|valid|def)|invalid",
    re.IGNORECASE,
)
_FLOATS: Final = {16: "e", 32: "f", 64: "d"}


@dataclass(frozen=True, slots=True)
class Field:
    """Bits of a payload, as an unsigned number.

    Parameters
    ----------
    shift, width : int
        Lowest bit and number of bits, in the payload read as one number.
    big_endian : bool
        Byte order of that number: Motorola or Intel.
    """

    shift: int
    width: int
    big_endian: bool

    def get(self, payload: bytes | bytearray) -> int:
        """Return the bits of a payload of the message's own length."""
        word = int.from_bytes(payload, "big" if self.big_endian else "little")
        return (word >> self.shift) & ((1 << self.width) - 1)

    def put(self, payload: bytearray, raw: int) -> None:
        """Set the bits in a payload of the message's own length."""
        order: Literal["big", "little"] = "big" if self.big_endian else "little"
        mask = ((1 << self.width) - 1) << self.shift
        word = int.from_bytes(payload, order) & ~mask | ((raw << self.shift) & mask)
        payload[:] = word.to_bytes(len(payload), order)

    @classmethod
    def of(cls, signal: Signal, length: int) -> Field:
        """Return the bits of a signal in a payload of `length` bytes (DBC bit numbering)."""
        if signal.byte_order == "little_endian":
            return cls(signal.start, signal.length, big_endian=False)
        from_top = 8 * (signal.start // 8) + 7 - signal.start % 8
        return cls(8 * length - from_top - signal.length, signal.length, big_endian=True)


@dataclass(frozen=True, slots=True)
class Condition:
    """Multiplexer values with which a signal is present in a frame."""

    field: Field
    values: frozenset[int]


@dataclass(frozen=True, slots=True)
class SignalCodec:
    """Conversion of one signal between payload and physical value in the DBC's unit.

    Parameters
    ----------
    name, unit : str
    field : Field
    is_signed : bool
    float_format : str
        `struct` format of an IEEE float, "" for integers.
    factor, offset : float
        value = raw × factor + offset.
    not_available : frozenset of int
        Raw codes without a value.
    conditions : tuple of Condition
        All must hold for the signal to be present in a frame.

    Attributes
    ----------
    decode : callable
        Takes a payload of the message's own length; returns the value, NaN for "not available".
    """

    name: str
    unit: str
    field: Field
    is_signed: bool
    float_format: str
    factor: float
    offset: float
    not_available: frozenset[int]
    conditions: tuple[Condition, ...] = ()
    decode: Decode = dataclasses.field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "decode", self.decoder())

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle without `decode`, which is made again."""
        given = [getattr(self, each.name) for each in dataclasses.fields(self) if each.init]
        return type(self), tuple(given)

    def decoder(self, gain: float = 1.0, shift: float = 0.0) -> Decode:
        """Return a function that decodes a payload to gain × value + shift.

        The kind of the signal is decided here, once, not for each frame.
        """
        order: Literal["big", "little"] = "big" if self.field.big_endian else "little"
        low_bit, mask = self.field.shift, (1 << self.field.width) - 1
        factor, offset = self.factor, self.offset

        if self.float_format:
            floating = struct.Struct(">" + self.float_format)

            def decode_float(payload: bytes | bytearray) -> float:
                raw = (int.from_bytes(payload, order) >> low_bit) & mask
                number: float = floating.unpack(raw.to_bytes(floating.size, "big"))[0]
                if not math.isfinite(number):
                    return math.nan
                return gain * (number * factor + offset) + shift

            return decode_float

        not_available = self.not_available
        sign_bit = (mask + 1) >> 1 if self.is_signed else 0

        def decode_integer(payload: bytes | bytearray) -> float:
            raw = (int.from_bytes(payload, order) >> low_bit) & mask
            if raw & sign_bit:
                raw -= mask + 1
            if raw in not_available:
                return math.nan
            return gain * (raw * factor + offset) + shift

        def decode_plain(payload: bytes | bytearray) -> float:
            raw = (int.from_bytes(payload, order) >> low_bit) & mask
            return gain * (raw * factor + offset) + shift

        return decode_integer if sign_bit or not_available else decode_plain

    def is_in(self, payload: bytes | bytearray) -> bool:
        """Return whether the signal is present, according to its multiplexers, if any."""
        return all(each.field.get(payload) in each.values for each in self.conditions)

    def encode_into(self, payload: bytearray, value: float) -> None:
        """Set the signal and its multiplexers; NaN becomes the first "not available" code.

        Raises
        ------
        InputError
            If the value does not fit, or is NaN and there is no such code.
        """
        for condition in self.conditions:
            condition.field.put(payload, min(condition.values))
        self.field.put(payload, self._raw(value))

    def _raw(self, value: float) -> int:
        number = (value - self.offset) / self.factor
        if self.float_format:
            try:
                return int.from_bytes(struct.pack(">" + self.float_format, number), "big")
            except OverflowError:
                raise self._does_not_fit(value) from None
        if math.isnan(value):
            if not self.not_available:
                raise InputError(
                    "the DBC has no code for a missing value", field=self.name, value=math.nan
                )
            return min(self.not_available)
        if not math.isfinite(number):
            raise self._does_not_fit(value)
        raw = round(number)
        low, high = self.raw_range
        if not low <= raw <= high or raw in self.not_available:
            raise self._does_not_fit(value)
        return raw

    def _does_not_fit(self, value: float) -> InputError:
        low, high = self.range
        return InputError(
            f"does not fit into the signal, which holds {low:g} to {high:g} {self.unit}".rstrip(),
            field=self.name,
            value=value,
            cure="use a DBC with a wider signal",
        )

    def quantize(self, values: FloatArray) -> FloatArray:
        """Return what `decode` gives after `encode_into`, for each value, without range check."""
        if self.float_format:
            kind = {"e": np.float16, "f": np.float32, "d": np.float64}[self.float_format]
            numbers = ((values - self.offset) / self.factor).astype(kind).astype(np.float64)
        else:
            numbers = np.rint((values - self.offset) / self.factor)
        return np.asarray(numbers * self.factor + self.offset)

    def fits(self, values: FloatArray) -> NDArray[np.bool_]:
        """Return which values `encode_into` accepts; NaN counts as accepted."""
        numbers = (values - self.offset) / self.factor
        if self.float_format:
            largest = {"e": 65504.0, "f": 3.4028234e38, "d": math.inf}[self.float_format]
            return np.asarray(~(np.abs(numbers) > largest))
        raw = np.rint(numbers)
        low, high = self.raw_range
        return np.asarray(~((raw < low) | (raw > high) | np.isin(raw, list(self.not_available))))

    @property
    def raw_range(self) -> tuple[int, int]:
        """Smallest and largest raw number."""
        width = self.field.width
        if self.is_signed:
            return -(1 << (width - 1)), (1 << (width - 1)) - 1
        return 0, (1 << width) - 1

    @property
    def range(self) -> tuple[float, float]:
        """Smallest and largest value that can be sent, in the DBC's unit."""
        if self.float_format:
            return -math.inf, math.inf
        low, high = self.raw_range
        while low in self.not_available:
            low += 1
        while high in self.not_available:
            high -= 1
        ends = (low * self.factor + self.offset, high * self.factor + self.offset)
        return min(ends), max(ends)

    @property
    def half_step(self) -> float:
        """Largest quantization error, in the DBC's unit; 0 for floats."""
        return 0.0 if self.float_format else abs(self.factor) / 2.0


def signal_codec(
    message: Message,
    signal: Signal,
    *,
    source: object,
    field: str,
    not_available: tuple[int, ...] = (),
    when: dict[str, int] | None = None,
) -> SignalCodec:
    """Build the codec of a signal.

    Parameters
    ----------
    message, signal : cantools.database.can.Message, cantools.database.can.Signal
    source, field : object, str
        For error messages: the file, and the name of the entry in the map file.
    not_available : tuple of int
        Raw codes without a value, besides those that the value table names "not available",
        "SNA", "invalid", ….
    when : dict of str to int, optional
        Further conditions: raw values of other signals of the message.

    Raises
    ------
    InputError
        If the signal does not fit into its message or cannot be a number.
    """
    bits = _bits(message, signal, source, field)
    conditions: list[Condition] = []
    selector = signal
    while (name := selector.multiplexer_signal) is not None:
        values = frozenset(selector.multiplexer_ids or ())
        found = _signal(message, name)
        if found is None:
            raise InputError(
                f"{selector.name} is multiplexed by a signal that {message.name} does not have",
                source=str(source),
                field=field,
                value=name,
                cure="correct the DBC",
            )
        if len(conditions) > len(message.signals):
            raise InputError("signals are multiplexed in a circle", source=str(source), field=field)
        conditions.append(Condition(_bits(message, found, source, field), values))
        selector = found
    for name, value in (when or {}).items():
        found = _signal(message, name)
        if found is None:
            raise InputError(
                f"message {message.name} has no such signal",
                source=str(source),
                field=f"{field}.when",
                value=name,
            )
        selector_bits = _bits(message, found, source, field)
        raw = value & ((1 << selector_bits.width) - 1)
        conditions.append(Condition(selector_bits, frozenset({raw})))
    conversion = signal.conversion
    return SignalCodec(
        name=signal.name,
        unit=(signal.unit or "").strip(),
        field=bits,
        is_signed=signal.is_signed and not conversion.is_float,
        float_format=_FLOATS[signal.length] if conversion.is_float else "",
        factor=float(conversion.scale),
        offset=float(conversion.offset),
        not_available=_codes_of_no_value(signal) | frozenset(not_available),
        conditions=tuple(conditions),
    )


def _signal(message: Message, name: str) -> Signal | None:
    return next((each for each in message.signals if each.name == name), None)


def _codes_of_no_value(signal: Signal) -> frozenset[int]:
    names: Mapping[int, object] = signal.conversion.choices or {}
    if 2 * len(names) > 1 << min(signal.length, 64):
        return frozenset()  # an enumeration, in which "invalid" is a state
    return frozenset(int(raw) for raw, name in names.items() if _NOT_A_VALUE.search(str(name)))


def _bits(message: Message, signal: Signal, source: object, field: str) -> Field:
    """Return the bits of a signal; raise InputError for an impossible layout or conversion."""
    bits, conversion = Field.of(signal, message.length), signal.conversion
    problem = ""
    if signal.length < 1 or bits.shift < 0 or bits.shift + bits.width > 8 * message.length:
        problem = f"the signal does not fit into the {message.length} bytes of {message.name}"
    elif conversion.is_float and signal.length not in _FLOATS:
        problem = f"a float of {signal.length} bits is not possible"
    elif not conversion.is_float and signal.length > 64:
        problem = f"a number of {signal.length} bits is not possible"
    elif not (0.0 < abs(conversion.scale) < math.inf and math.isfinite(conversion.offset)):
        problem = "factor and offset must be finite and the factor not 0"
    if problem:
        raise InputError(
            problem,
            source=str(source),
            field=f"{field}.signal",
            value=signal.name,
            cure="correct the DBC",
        )
    return bits


MAX_MESSAGES: Final = 20_000
MAX_MESSAGE_BYTES: Final = 1785
"""Longest message of J1939. cantools lays out every bit of a message in memory."""
MAX_MULTIPLEXER_VALUE: Final = (1 << 32) - 1
MAX_MULTIPLEXER_VALUES: Final = 65_536
"""cantools expands each range of multiplexer values into a list."""
MAX_MULTIPLEXER_LEVELS: Final = 32
MAX_MULTIPLEXER_WORK: Final = 20_000_000
"""Largest number of steps in which cantools lays out the multiplexed signals: about 2 s."""
_STEPS_PER_LAYOUT: Final = 200
"""Steps that an empty layout takes, in units of one signal of it."""

_KINDS: Final = {".arxml": "arxml", ".kcd": "kcd", ".sym": "sym"}
"""Formats besides DBC, by suffix."""
_ENTITY = re.compile(r"<!(?:DOCTYPE|ENTITY)", re.IGNORECASE)
"""Entities of XML can unfold to any size."""

_CANTOOLS_ERRORS: Final = (
    ET.ParseError,
    cantools.Error,
    LookupError,
    ValueError,
    TypeError,
    ArithmeticError,
    AttributeError,
    AssertionError,  # a multiplexed signal without a multiplexer
)

# Statements as cantools reads them. Possessive quantifiers keep the time linear for any text.
_STRING_OR_COMMENT = re.compile(r'"(\\"|[^"])*?"|//[^\n]*+\n')
_MESSAGE = re.compile(r"(?<![A-Za-z_])BO_\s++[-+]?\d++\s*+\w++\s*+:\s*+([-+]?\d++)")
_SIGNAL = re.compile(
    r"(?<![A-Za-z_])SG_\s++\w++\s*+(?:\w++\s*+)?:\s*+([-+]?\d++)\s*+\|\s*+([-+]?\d++)\s*+@"
)
_MULTIPLEXER_VALUES = re.compile(r"(?<![A-Za-z_])SG_MUL_VAL_\s[^;]*+")
_MULTIPLEXED = re.compile(
    r"(?<![A-Za-z_])(?:BO_\s++([-+]?\d++)\s*+\w++\s*+:|SG_\s++(\w++)\s*+(?:(\w++)\s*+)?:)"
)
_EXTENDED_MULTIPLEXING = re.compile(
    r"(?<![A-Za-z_])SG_MUL_VAL_\s*+([-+]?\d++)\s*+(\w++)\s++(\w++)([^;]*+)"
)
_NAMED_VALUES = re.compile(r"(?<![A-Za-z_])VAL_\s++([-+]?\d++)\s*+(\w++)([^;]*+)")
_RANGE = re.compile(r"(?<!\d)(\d++)\s*+-\s*+(\d++)")

# cantools warns on stderr of messages defined twice; `find_message` reports the wanted ones.
logging.getLogger("cantools").addHandler(logging.NullHandler())


def load_dbc(path: str | PathLike[str]) -> Database:
    """Read a DBC file, or an ARXML, KCD or SYM file by its suffix.

    Overlapping signals are accepted: many files have some in messages that are not wanted.

    Raises
    ------
    InputError
        If the file is absent, too large, not a DBC, or beyond what a CAN bus can carry.
    """
    path = Path(path)
    with time_limit(path):
        return _load_dbc(path)


def _load_dbc(path: Path) -> Database:
    text = _read_text(path)
    kind = _KINDS.get(path.suffix.lower(), "dbc")
    if kind == "dbc":
        _check_sizes(text, path)
    elif _ENTITY.search(text):
        raise InputError("defines XML entities", source=path, cure="export the file without them")
    try:
        database = cantools.database.load_string(text, kind, strict=False)
    except RecursionError as error:
        raise InputError("signals are multiplexed in a circle", source=path) from error
    except _CANTOOLS_ERRORS as error:
        raise InputError(
            f"not a {kind.upper()} file that can be read: {_first_line(error)}",
            source=path,
            cure=f"open it in a {kind.upper()} editor, which names the error",
        ) from error
    if not isinstance(database, Database) or not database.messages:
        raise InputError(f"the {kind.upper()} defines no messages", source=path)
    if kind != "dbc":
        _check_messages(database, path)
    return database


def find_message(database: Database, message: str | int, *, source: object, field: str) -> Message:
    """Return the message of that name or id ("PackStatus", 475, "0x1DB").

    Raises
    ------
    InputError
        If there is none (with the closest names) or more than one.
    """
    wanted = _as_id(message)
    found = [
        candidate
        for candidate in database.messages
        if candidate.name == message or (wanted is not None and candidate.frame_id == wanted)
    ]
    if len(found) == 1:
        return found[0]
    if found:
        raise InputError(
            f"the DBC defines {len(found)} such messages",
            source=str(source),
            field=field,
            value=message,
            cure="keep one of them",
        )
    near = (
        closest(str(message), (each.name for each in database.messages)) if wanted is None else ""
    )
    shown = ", ".join(f"{each.name} (0x{each.frame_id:X})" for each in database.messages[:6])
    more = len(database.messages) - 6
    raise InputError(
        "the DBC has no such message",
        source=str(source),
        field=field,
        value=message,
        cure=f"did you mean {near}?"
        if near
        else f"its messages are {shown}" + (f" and {more} more" if more > 0 else ""),
    )


def find_signal(
    database: Database, message: str | int | None, signal: str, *, source: object, field: str
) -> tuple[Message, Signal]:
    """Return a signal and its message; without a message, the only signal of that name.

    Raises
    ------
    InputError
        If there is none (with the closest names) or more than one.
    """
    if message is not None:
        owner = find_message(database, message, source=source, field=f"{field}.message")
        found = _signal(owner, signal)
        if found is not None:
            return owner, found
        raise InputError(
            f"message {owner.name} has no such signal",
            source=str(source),
            field=f"{field}.signal",
            value=signal,
            cure=_signal_cure(database, owner, signal),
        )
    owners = [
        (owner, candidate)
        for owner in database.messages
        for candidate in owner.signals
        if candidate.name == signal
    ]
    if len(owners) == 1:
        return owners[0]
    if owners:
        names = ", ".join(owner.name for owner, _ in owners[:5])
        raise InputError(
            f"{len(owners)} messages have such a signal ({names})",
            source=str(source),
            field=f"{field}.signal",
            value=signal,
            cure="name the message too",
        )
    names = closest(signal, (each.name for owner in database.messages for each in owner.signals))
    raise InputError(
        "the DBC has no such signal",
        source=str(source),
        field=f"{field}.signal",
        value=signal,
        cure=f"did you mean {names}?" if names else "check the name in the DBC",
    )


def _read_text(path: Path) -> str:
    data = read_bounded(path, MAX_DBC_BYTES, "a DBC")
    if not data.strip():
        raise InputError("the DBC is empty", source=path)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", errors="replace")  # the encoding that most tools write


def _check_sizes(text: str, path: Path) -> None:
    """Raise InputError for sizes with which cantools would exhaust the memory."""
    # Comments may stand between any two words, and strings may look like statements.
    text = _STRING_OR_COMMENT.sub(lambda match: '""' if match[0][0] == '"' else " ", text)
    messages = 0
    for match in _MESSAGE.finditer(text):
        messages += 1
        _bounded(match[1], MAX_MESSAGE_BYTES, "a message that is too long (bytes)", path)
    if messages > MAX_MESSAGES:
        raise InputError(
            f"the DBC defines more than {MAX_MESSAGES} messages",
            source=path,
            value=messages,
            cure="remove the messages that you do not need",
        )
    for match in _SIGNAL.finditer(text):
        _bounded(match[1], 8 * MAX_MESSAGE_BYTES, "a signal with a start bit out of range", path)
        _bounded(match[2], 8 * MAX_MESSAGE_BYTES, "a signal that is too long (bits)", path)
    values = 0
    for statement in _MULTIPLEXER_VALUES.findall(text):
        for low, high in _RANGE.findall(statement):
            _bounded(high, MAX_MULTIPLEXER_VALUE, "a multiplexer value that is too large", path)
            values += max(int(high) - int(low[-12:]) + 1, 0)
    if values > MAX_MULTIPLEXER_VALUES:
        raise InputError("the DBC lists too many multiplexer values", source=path, value=values)
    _refuse_nesting(text, path)


def _check_messages(database: Database, path: Path) -> None:
    """Raise InputError for sizes that no CAN bus carries."""
    if len(database.messages) > MAX_MESSAGES:
        raise InputError(
            f"defines more than {MAX_MESSAGES} messages", source=path, value=len(database.messages)
        )
    for message in database.messages:
        if not 0 <= message.length <= MAX_MESSAGE_BYTES:
            raise InputError(
                "a message that is too long (bytes)", source=path, field=message.name,
                value=message.length,
            )  # fmt: skip


@dataclass(slots=True)
class _Multiplexer:
    """What the signals of one name in a message multiply."""

    parent: str | None = None
    times: int = 0
    """Values of the parent with which they are present, summed over the signals of this name."""
    children: int = 0
    values: set[int] = dataclasses.field(default_factory=set)
    named: int = 0


def _refuse_nesting(text: str, path: Path) -> None:
    """Refuse multiplexers whose layouts multiply along a chain.

    cantools lays out a message once for each combination of values along a chain of multiplexers,
    and looks at all signals of a multiplexer for each of its values.
    """
    ranges: dict[tuple[int, str], dict[str, set[int]]] = {}
    for message, name, parent, listed in _EXTENDED_MULTIPLEXING.findall(text):
        values: set[int] = set()
        for low, high in _RANGE.findall(listed):
            values.update(range(int(low), int(high) + 1))
        ranges.setdefault((int(message[:20]), name), {})[parent] = values
    named = {
        (int(message[:20]), name): listed.count('""')
        for message, name, listed in _NAMED_VALUES.findall(text)
    }
    work = 0
    message, marked = 0, list[tuple[str, str]]()
    for match in (*_MULTIPLEXED.finditer(text), None):
        if match is not None and match[1] is None:
            if match[3] is not None:
                marked.append((match[2], match[3]))
            continue
        if marked:
            work += _layout_steps(_multiplexers(message, marked, ranges, named), path)
            marked = []
        if match is not None:
            message = int(match[1][:20])
    if work > MAX_MULTIPLEXER_WORK:
        raise InputError(
            "the DBC nests multiplexers so that their values multiply beyond reason",
            source=path,
            cure="remove the multiplexed messages that you do not need",
        )


def _multiplexers(
    message: int,
    marked: list[tuple[str, str]],
    ranges: Mapping[tuple[int, str], Mapping[str, set[int]]],
    named: Mapping[tuple[int, str], int],
) -> dict[str, _Multiplexer]:
    """Return the multiplexers of a message as cantools relates them, by name.

    Parameters
    ----------
    message : int
        Its id.
    marked : list of (str, str)
        Names and marks ("M", "m1", "m1M") of its signals.
    ranges : mapping
        Values by message and signal, then by multiplexer (SG_MUL_VAL_).
    named : mapping
        Number of named values by message and signal (VAL_).
    """
    found = {name: _Multiplexer() for name, mark in marked if mark.endswith("M")}
    only = next(iter(found)) if sum(mark.endswith("M") for _, mark in marked) == 1 else None
    for name, mark in marked:
        listed = ranges.get((message, name), {})
        parent = only if only is not None else next(reversed(list(listed)), None)
        values: set[int] = set()
        if parent is None or (only is not None and name == only):
            parent = None
        else:
            values = set(listed.get(parent, ()))
            if only is not None and mark[1:].isdecimal():
                values.add(int(mark[1:20]))
        if name in found:
            found[name].parent = parent
            found[name].times += len(values) if parent is not None else 1
            found[name].named = named.get((message, name), 0)
        if parent in found:
            found[parent].children += 1
            found[parent].values |= values
    return found


def _layout_steps(multiplexers: Mapping[str, _Multiplexer], path: Path) -> int:
    steps = 0
    for each in multiplexers.values():
        times, above = each.times, each.parent
        for _ in range(MAX_MULTIPLEXER_LEVELS):
            if above is None or above not in multiplexers:
                break
            times *= multiplexers[above].times
            above = multiplexers[above].parent
        else:
            raise InputError(
                "signals are multiplexed in a circle, or in more than"
                f" {MAX_MULTIPLEXER_LEVELS} levels",
                source=path,
                cure="correct the DBC",
            )
        layouts = len(each.values) + each.named
        steps += times * layouts * (_STEPS_PER_LAYOUT + each.children)
    return steps


def _bounded(figure: str, limit: int, what: str, path: Path) -> None:
    if figure.startswith("-") or len(figure) > 13 or int(figure) > limit:
        raise InputError(f"the DBC defines {what}", source=path, value=figure[:20])


def _as_id(message: str | int) -> int | None:
    if isinstance(message, int):
        return message
    try:
        return int(message, 0)
    except ValueError:
        return None


def _signal_cure(database: Database, owner: Message, signal: str) -> str:
    elsewhere = [other.name for other in database.messages if _signal(other, signal)]
    if elsewhere:
        return f"it is in {', '.join(elsewhere[:3])}"
    names = [candidate.name for candidate in owner.signals]
    near = closest(signal, names)
    if near:
        return f"did you mean {near}?"
    shown = ", ".join(names[:8]) + (", …" if len(names) > 8 else "")
    return f"it has {shown}" if shown else "it has no signals"


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0][:160]

"""DBC files: read within bounds of time and memory, and searched with helpful errors."""

from __future__ import annotations

import logging
import re
from os import PathLike
from pathlib import Path
from typing import Final

import cantools.database
from cantools.database.can import Database, Message, Signal

from cangauge.errors import InputError
from cangauge.files import read_bounded
from cangauge.limits import MAX_DBC_BYTES
from cangauge.nearest import closest

MAX_MESSAGES: Final = 20_000
MAX_MESSAGE_BYTES: Final = 1785
"""The longest that J1939 can transport. cantools lays out every bit of a message in memory."""
MAX_MULTIPLEXER_VALUE: Final = (1 << 32) - 1
MAX_MULTIPLEXER_VALUES: Final = 65_536
"""cantools makes a list of every value in a range of multiplexer values."""

_WHAT_CANTOOLS_RAISES: Final = (
    cantools.Error,
    LookupError,
    ValueError,
    TypeError,
    ArithmeticError,
    AttributeError,
    AssertionError,  # it asserts that a multiplexed signal says by what
)

# What cantools reads as these statements, and with possessive quantifiers, so that no text takes
# more than linear time.
_STRING_OR_COMMENT = re.compile(r'"(\\"|[^"])*?"|//[^\n]*+\n')
_MESSAGE = re.compile(r"(?<![A-Za-z_])BO_\s++[-+]?\d++\s*+\w++\s*+:\s*+([-+]?\d++)")
_SIGNAL = re.compile(
    r"(?<![A-Za-z_])SG_\s++\w++\s*+(?:\w++\s*+)?:\s*+([-+]?\d++)\s*+\|\s*+([-+]?\d++)\s*+@"
)
_MULTIPLEXER_VALUES = re.compile(r"(?<![A-Za-z_])SG_MUL_VAL_\s[^;]*+")
_RANGE = re.compile(r"(?<!\d)(\d++)\s*+-\s*+(\d++)")

# cantools warns on stderr, twice for every message that a file defines again; the messages that
# are wanted are checked for that here.
logging.getLogger("cantools").addHandler(logging.NullHandler())


def load_dbc(path: str | PathLike[str]) -> Database:
    """Read a DBC file.

    Overlapping signals are accepted, since many files in use have some in messages that nobody
    asks for.

    Raises
    ------
    InputError
        If the file is absent, too large, not a DBC, or defines what no CAN bus can carry.
    """
    path = Path(path)
    text = _read_text(path)
    _refuse_hostile(text, path)
    try:
        database = cantools.database.load_string(text, "dbc", strict=False)
    except RecursionError as error:
        raise InputError("signals are multiplexed in a circle", source=path) from error
    except _WHAT_CANTOOLS_RAISES as error:
        raise InputError(
            f"not a DBC file that can be read: {_first_line(error)}",
            source=path,
            cure="open it in a DBC editor, which names the error",
        ) from error
    if not isinstance(database, Database) or not database.messages:
        raise InputError("the DBC defines no messages", source=path)
    return database


def find_message(database: Database, message: str | int, *, source: object, field: str) -> Message:
    """Return the message of that name or id ("PackStatus", 475, "0x1DB").

    Raises
    ------
    InputError
        If there is none (with the closest names), or several.
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
    if wanted is None:
        names = closest(str(message), (candidate.name for candidate in database.messages))
        cure = f"did you mean {names}?" if names else _few("messages", database)
    else:
        cure = _few("messages", database)
    raise InputError(
        "the DBC has no such message", source=str(source), field=field, value=message, cure=cure
    )


def find_signal(
    database: Database, message: str | int | None, signal: str, *, source: object, field: str
) -> tuple[Message, Signal]:
    """Return a signal and its message; without a message, the only signal of that name.

    Raises
    ------
    InputError
        If there is none (with the closest names), or several.
    """
    if message is not None:
        owner = find_message(database, message, source=source, field=f"{field}.message")
        for candidate in owner.signals:
            if candidate.name == signal:
                return owner, candidate
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
        return data.decode("cp1252", errors="replace")  # what most tools write


def _refuse_hostile(text: str, path: Path) -> None:
    """Refuse figures that would make cantools fill the memory."""
    # A comment may stand between any two words, and a string may look like anything.
    text = _STRING_OR_COMMENT.sub(lambda match: '""' if match[0][0] == '"' else " ", text)
    messages = 0
    for match in _MESSAGE.finditer(text):
        messages += 1
        _bounded(match[1], MAX_MESSAGE_BYTES, "a message of so many bytes", path)
    if messages > MAX_MESSAGES:
        raise InputError(
            f"the DBC defines more than {MAX_MESSAGES} messages",
            source=path,
            value=messages,
            cure="cut it down to those that you need",
        )
    for match in _SIGNAL.finditer(text):
        _bounded(match[1], 8 * MAX_MESSAGE_BYTES, "a signal that starts at such a bit", path)
        _bounded(match[2], 8 * MAX_MESSAGE_BYTES, "a signal of so many bits", path)
    values = 0
    for statement in _MULTIPLEXER_VALUES.findall(text):
        for low, high in _RANGE.findall(statement):
            _bounded(high, MAX_MULTIPLEXER_VALUE, "so large a multiplexer value", path)
            values += max(int(high) - int(low[-12:]) + 1, 0)
    if values > MAX_MULTIPLEXER_VALUES:
        raise InputError("the DBC lists too many multiplexer values", source=path, value=values)


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
    elsewhere = [
        other.name
        for other in database.messages
        if any(candidate.name == signal for candidate in other.signals)
    ]
    if elsewhere:
        return f"it is in {', '.join(elsewhere[:3])}"
    names = [candidate.name for candidate in owner.signals]
    near = closest(signal, names)
    if near:
        return f"did you mean {near}?"
    shown = ", ".join(names[:8]) + (", …" if len(names) > 8 else "")
    return f"it has {shown}" if shown else "it has no signals at all"


def _few(what: str, database: Database) -> str:
    names = [f"{message.name} (0x{message.frame_id:X})" for message in database.messages]
    shown = ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
    return f"its {what} are {shown}"


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0][:160]

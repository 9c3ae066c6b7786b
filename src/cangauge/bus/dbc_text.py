"""Repair the text of a DBC for cantools, and refuse what would take it minutes.

cantools keeps a table of signals for each path through nested multiplexers. It refuses a file for
one line about a missing signal, and for an extended id without its flag; many files in use have
both.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from can.interfaces.socketcan.constants import CAN_EFF_FLAG, MAX_11_BIT_ID, MSK_ARBID

from cangauge.errors import InputError

MOST_BYTES: Final = 4095
"""Of a message: a reply over ISO-TP."""
_MOST_ENTRIES: Final = 1 << 17
"""Most entries in cantools' tables of multiplexed signals, of which it makes 60,000 a second: two
signals for every value of 16 bits."""
_UNASSIGNED: Final = "VECTOR__INDEPENDENT_SIG_MSG"
"""Message of editors for signals that are in no message; cantools leaves it out."""

# What is not closed goes on to the end: else each beginning would be searched to the end.
_QUOTED: Final = re.compile(r'"(?:[^"\\]|\\.)*+(?:"|\\?\Z)', re.DOTALL)
_LENGTH: Final = re.compile(r"\bBO_\s++\d++\s++\w++\s*+:\s*+\+?(\d++)")
_BITS: Final = re.compile(r"(?<!\d)(\d++)\s*+\|\s*+\+?(\d++)\s*+@")
"""Start bit and length of a signal."""
_ID: Final = re.compile(
    rf"{_QUOTED.pattern}"
    r"|(?P<keyword>\b(?:BO_|SG_|VAL_|SIG_VALTYPE_|SG_MUL_VAL_|SIG_GROUP_|BO_TX_BU_)\s++)"
    r"(?P<id>\d{4,10})\b",
    re.DOTALL,
)
_DEFINED: Final = re.compile(
    r"\bBO_\s++(?P<id>\d++)\s++(?P<message>\w++)\s*+:"
    r"|\bSG_\s++(?P<signal>\w++)\s*+(?P<mark>m\d++M?|M)?\s*+:"
)
_ABOUT: Final = re.compile(r"\b(VAL_|SIG_VALTYPE_)\s++(\d++)\s++(\w++)[^;]*+(;|\Z)")
_SELECTED: Final = re.compile(r"\bSG_MUL_VAL_\s++(\d++)\s++(\w++)\s++(\w++)\s++([^;]*+)")
_RANGE: Final = re.compile(r"(?<!\d)(\d++)\s*+[-+](\d++)")


def prepared(text: str, path: Path) -> tuple[str, list[str]]:
    """Return the text of a DBC as cantools reads it, and a remark on each change.

    Lines about missing signals are left out, and ids of more than 11 bits get the flag of extended
    ones. Raises InputError for a text that would take gigabytes or minutes.
    """
    remarks = []
    bare = _without_content(text)
    _refuse_numbers(bare, path)
    flagged = _ID.sub(_with_flag, text)
    if flagged != text:
        text, bare = flagged, _without_content(flagged)
        remarks.append("ids of more than 11 bits are taken as extended")
    messages = _outline(bare)
    gone = []
    for match in _ABOUT.finditer(bare):
        kind, number, name, end = match.groups()
        if name not in messages.get(number, {}):
            gone += [match] if end else []
        elif kind == "VAL_":
            messages[number][name].named = match[0].count('"') // 2
    _refuse_nesting(messages, bare, path)
    for match in reversed(gone):
        text = text[: match.start()] + text[match.end() :]
    if gone:
        names = list(dict.fromkeys(match[3] for match in gone))
        shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
        what = "a signal that is" if len(gone) == 1 else "signals that are"
        remarks.append(f"read without what it says of {what} gone: {shown}")
    return text, [f"{path}: {remark}" for remark in remarks]


def _without_content(text: str) -> str:
    """Return a text whose quoted parts are blank: places in it are places in the original."""
    return _QUOTED.sub(_blank, text)


def _blank(quoted: re.Match[str]) -> str:
    return '"' + " " * (len(quoted[0]) - 2) + '"'


def _with_flag(match: re.Match[str]) -> str:
    """Return an id of more than 11 bits with the flag of extended ones; another match unchanged."""
    number = int(match["id"] or 0)
    if not MAX_11_BIT_ID < number <= MSK_ARBID:
        return match[0]
    return f"{match['keyword']}{number | CAN_EFF_FLAG}"


def _refuse_numbers(bare: str, path: Path) -> None:
    """Raise InputError for the numbers of a damaged DBC for which cantools would take gigabytes."""
    for pattern, most in ((_LENGTH, MOST_BYTES), (_BITS, 8 * MOST_BYTES)):
        for match in pattern.finditer(bare):
            if max(map(float, match.groups())) > most:
                problem = f"a message of more than {MOST_BYTES} bytes is not possible"
                cure = "open it in a DBC editor, and correct the number"
                raise InputError(problem, source=path, value=match[0], cure=cure)


# --- Multiplexers


@dataclass
class _Signal:
    """A signal in the text.

    `selector` is the multiplexer that selects it, by `values` of its own; "": it is in every frame.
    `named` is the number of its codes that have a name.
    """

    selector: str = ""
    values: float = 1.0
    named: int = 0


_Messages = dict[str, dict[str, _Signal]]
"""Signals by name, of all messages by id as it is written."""


def _outline(bare: str) -> _Messages:
    """Return the signals of all messages."""
    messages: _Messages = {}
    selectors: dict[str, str] = {}
    marked: list[tuple[str, _Signal]] = []
    number = ""
    for match in _DEFINED.finditer(bare):
        if match["id"]:
            number = "" if match["message"] == _UNASSIGNED else match["id"]
            continue
        signal = messages.setdefault(number, {})[match["signal"]] = _Signal()
        if match["mark"] == "M":
            selectors[number] = match["signal"]
        elif match["mark"]:
            marked.append((number, signal))
    messages.pop("", None)
    for number, signal in marked:
        signal.selector = selectors.get(number, "")
    for number, name, selector, ranges in _SELECTED.findall(bare):
        if name in messages.get(number, {}):
            messages[number][name] = _Signal(selector, _count(ranges))
    return messages


def _count(ranges: str) -> float:
    """Return how many values the ranges of a SG_MUL_VAL_ line have."""
    count = 0.0
    for low, high in _RANGE.findall(ranges):
        count += math.inf if len(high) > 20 else max(float(high) - float(low) + 1.0, 0.0)
    return count


def _refuse_nesting(messages: _Messages, bare: str, path: Path) -> None:
    """Raise InputError for multiplexers whose tables cantools would not make in seconds."""
    listed = sum(_count(ranges) for *_, ranges in _SELECTED.findall(bare))
    if max(listed, sum(map(_entries, messages.values()))) > _MOST_ENTRIES:
        problem = f"its multiplexers select more than {_MOST_ENTRIES} signals"
        cure = "remove the messages that are not wanted in a DBC editor"
        raise InputError(problem, source=path, cure=cure)


def _entries(signals: Mapping[str, _Signal]) -> float:
    """Return how many entries the tables of a message's multiplexed signals have."""
    selected = defaultdict[str, list[str]](list)
    for name, signal in signals.items():
        selected[signal.selector].append(name)

    def below(name: str) -> float:
        own = sum(signals[each].values * (1.0 + below(each)) for each in selected.pop(name, ()))
        return own + (signals[name].named if own else 0)

    return sum(below(name) for name in selected.pop("", ()))

"""The columns of a table that a user names: heading, unit and factor by quantity."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from cangauge.errors import InputError
from cangauge.logs.quantities import FIELDS

DOCS: Final = "docs/logs.md"
"""Page that explains the columns of a log."""
SYNTAX: Final = (
    "give NAME=HEADING, NAME=HEADING[UNIT] or NAME=HEADING[UNIT]:FACTOR, separated by commas, for"
    " time, current, voltage, temperature, soc"
)
_SPLIT: Final = re.compile(rf",\s*(?=(?:{'|'.join(FIELDS)})\s*=)", re.IGNORECASE)
_FACTOR: Final = re.compile(
    r"^(?P<text>.*\S)\s*:\s*(?P<factor>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)$"
)
_UNIT: Final = re.compile(r"^(?P<text>.*\S)\s*\[(?P<unit>[^\[\]]*)\]$")


@dataclass(frozen=True, slots=True)
class ColumnMap:
    """The user's columns by quantity: time, current, voltage, temperature, soc.

    `texts` are `HEADING`, `HEADING[UNIT]` or `HEADING[UNIT]:FACTOR`; a heading may be `#3` for the
    third column, or several joined by `+` (a date and its time; the median of temperatures).
    `where` is the option or file that states them, for messages.
    """

    texts: Mapping[str, str] = field(default_factory=dict)
    where: str = "--columns"

    @classmethod
    def of(cls, given: ColumnMap | Mapping[str, str] | str, where: str = "columns") -> ColumnMap:
        """Return the map of a text (`time=t,current=I[mA]:-1`) or of a mapping.

        Raises
        ------
        InputError
            If a name or a value is not understood.

        Examples
        --------
        >>> ColumnMap.of("time=t,current=I, pack[mA]:-1").texts["current"]
        'I, pack[mA]:-1'
        """
        if isinstance(given, ColumnMap):
            return given
        if not isinstance(given, Mapping | str):
            raise InputError("not columns", field=where, value=given, cure=SYNTAX)
        texts: dict[str, str] = {}
        for name, text in _items(given, where):
            quantity = name.strip().lower()
            if quantity not in FIELDS:
                cure = f"known are {', '.join(FIELDS)}"
                raise InputError("not a quantity of a log", field=where, value=quantity, cure=cure)
            if quantity in texts:
                raise InputError("is given twice", field=where, value=quantity)
            if not isinstance(text, str) or not text.strip():
                place = f"{where}.{quantity}"
                cure = 'write it as text: "Wert b[V]:-1"'
                raise InputError("not a column", field=place, value=text, cure=cure)
            texts[quantity] = text.strip()
        return cls(texts, where)

    def error(self, quantity: str, problem: str, cure: str) -> InputError:
        """Return the error for the column of a quantity."""
        field, text = f"{self.where} {quantity}", self.texts[quantity]
        return InputError(problem, field=field, value=text, cure=cure)


def _items(given: Mapping[str, str] | str, where: str) -> Iterable[tuple[str, Any]]:
    """Return names and texts of a mapping, or of `NAME=TEXT,NAME=TEXT`."""
    if not isinstance(given, str):
        return [(str(name), text) for name, text in given.items()]
    items = []
    for part in _SPLIT.split(given):
        name, _, text = part.partition("=")
        if not text.strip():
            raise InputError("not a column", field=where, value=part, cure=SYNTAX)
        items.append((name, text))
    return items


def meant_by(text: str) -> list[tuple[str, str | None, float]]:
    """Return what a text may mean: heading, unit (None: as the heading says) and factor.

    The heading as a whole is first, then less a factor, then less a unit.

    Examples
    --------
    >>> meant_by("I [A]")
    [('I [A]', None, 1.0), ('I', 'A', 1.0)]
    """
    meant: list[tuple[str, str | None, float]] = [(text, None, 1.0)]
    with_factor = _FACTOR.match(text)
    if with_factor:
        meant.append((with_factor["text"], None, float(with_factor["factor"])))
    for heading, _, factor in list(meant):
        with_unit = _UNIT.match(heading)
        if with_unit:
            meant.append((with_unit["text"], with_unit["unit"].strip(), factor))
    return meant

"""The quantities of a log: their columns, words and units, one table for headings and values.

The table is `quantities.toml`.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, cast

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.settings import TEMPERATURE_SOURCES, TemperatureSource

_SCALED: Final = re.compile(r"(?P<scale>0?[.,]\d+|1|10+(?=\s*[mµμu]))\s*(?P<unit>\D+)$")
"""A unit of a bit: 0.1V, 10mV; 500A is the range of a sensor."""


@dataclass(frozen=True, slots=True)
class LogQuantity:
    """A quantity of a log.

    Parameters
    ----------
    field, unit : str
        Column and unit of the canonical log.
    words, words_with_unit : frozenset of str
        Words of a heading that name it, and those that do beside one of its units.
    phrases : tuple of str
        Several words that name it together.
    letters : frozenset of str
        Its letters in formulas.
    units : dict
        Factor and offset to the canonical unit, by spelling.
    """

    field: str
    unit: str
    words: frozenset[str]
    words_with_unit: frozenset[str]
    phrases: tuple[str, ...]
    letters: frozenset[str]
    units: dict[str, tuple[float, float]]

    def scale_of(self, unit: str) -> tuple[float, float] | None:
        """Return factor and offset from a unit to the canonical one; None if it is not known."""
        name = " ".join(unit.lower().removeprefix("unit_").split())
        scaled = _SCALED.match(name)
        if name in self.units or scaled is None or scaled["unit"] not in self.units:
            return self.units.get(name)
        factor, offset = self.units[scaled["unit"]]
        return factor * float(scaled["scale"].replace(",", ".")), offset


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


def _quantity(table: dict[str, Any]) -> LogQuantity:
    return LogQuantity(
        table["field"],
        table["unit"],
        _words(table["words"]),
        _words(table.get("words_with_unit", "")),
        tuple(table.get("phrases", ())),
        _words(table.get("letters", "")),
        {
            spelling: (factor, offset)
            for factor, offset, spellings in table["units"]
            for spelling in spellings.split("|")
        },
    )


_TABLE: Final[dict[str, Any]] = tomllib.loads(
    Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")
)
QUANTITIES: Final[dict[str, LogQuantity]] = {
    name: _quantity(table) for name, table in _TABLE["quantity"].items()
}
"""Quantities by the name that users write."""
WORDS: Final = {name: _words(text) for name, text in _TABLE["words"].items()}
"""What the other words of a heading say."""
LIMITS: Final = _TABLE["limits"]
"""Plausible values, by name with unit."""
EPOCHS: Final = _TABLE["epochs"]
"""Seconds of a tick, and seconds from its origin to 1970, by name."""
CURRENT_FIELDS: Final = _TABLE["fields"]
"""Widths [bit] and steps [A] of a current's field on a bus, the usual ones first."""
FIELDS: Final = {name: quantity.field for name, quantity in QUANTITIES.items()}
"""Canonical column by the name that users write."""
REQUIRED: Final = tuple(field for name, field in FIELDS.items() if name != "soc")
"""Columns of every log."""
_BY_FIELD: Final = {quantity.field: quantity for quantity in QUANTITIES.values()}


def unit_of(field: str, unit: str) -> tuple[float, float] | None:
    """Return (factor, offset) from a unit to the canonical one of a field; None if unknown.

    Examples
    --------
    >>> unit_of("current_a", "mA")
    (0.001, 0.0)
    >>> unit_of("voltage_v", "0.1V")
    (0.1, 0.0)
    """
    return _BY_FIELD[field].scale_of(unit)


def convert(values: FloatArray, field: str, unit: str, *, source: object, label: str) -> FloatArray:
    """Return values of shape (n,) in the canonical unit, from a stated one ("": the canonical).

    Raises
    ------
    InputError
        If the unit is not known for this quantity.
    """
    scale = unit_of(field, unit) if unit.strip() else (1.0, 0.0)
    if scale is None:
        problem = f"the unit is not known for {field}"
        cure = f"convert it to one of: {', '.join(_BY_FIELD[field].units)}"
        raise InputError(problem, source=str(source), field=label, value=unit, cure=cure)
    return values if scale == (1.0, 0.0) else values * scale[0] + scale[1]


def known_temperature_source(word: str, *, source: str | None = None) -> TemperatureSource:
    """Return the word if it names a temperature source, else raise InputError."""
    if word not in TEMPERATURE_SOURCES:
        problem, field = "not a known temperature source", "temperature_source"
        cure = f"use one of: {', '.join(TEMPERATURE_SOURCES)}"
        raise InputError(problem, source=source, field=field, value=word, cure=cure)
    return cast("TemperatureSource", word)

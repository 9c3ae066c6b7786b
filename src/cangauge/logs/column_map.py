"""The columns of a table: those that the user names, and the others by plain headings."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from cangauge.errors import InputError, closest
from cangauge.logs.headings import GUESS, Meaning, meaning_of, names_and_units
from cangauge.logs.units import FIELDS, TemperatureSource, unit_of

DOCS: Final = "docs/logs.md"
"""Page that explains the columns of a log."""
_SYNTAX: Final = (
    "give NAME=HEADING, NAME=HEADING[UNIT] or NAME=HEADING[UNIT]:FACTOR, separated by commas, for"
    " time, current, voltage, temperature, soc"
)
_NEEDED: Final = ("time", "current", "voltage")
_JOINED: Final = ("time", "temperature")
"""Quantities of several columns: a date and its time; probes, whose median is taken."""
_SPLIT: Final = re.compile(rf",\s*(?=(?:{'|'.join(FIELDS)})\s*=)", re.IGNORECASE)
_FACTOR: Final = re.compile(
    r"^(?P<text>.*\S)\s*:\s*(?P<factor>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)$"
)
_DIRECTION: Final = re.compile(r"(?P<dis>dis?|de)?[-_ ]?(?:charg(?:ed|e|ing)|chg)", re.IGNORECASE)
_UNIT: Final = re.compile(r"^(?P<text>.*\S)\s*\[(?P<unit>[^\[\]]*)\]$")


@dataclass(frozen=True, slots=True)
class ColumnSpec:
    """One column as the user gives it.

    Parameters
    ----------
    text : str
        Heading, or headings joined by `+` (a date and its time; the median of temperatures), or
        `#3` for the third column; then `[UNIT]` and `:FACTOR`, both optional.
    unit : str, optional
        Unit of the column, in place of the heading's.
    factor : float
        The column times this is in its unit; its sign inverts.
    """

    text: str
    unit: str | None = None
    factor: float = 1.0

    def readings(self) -> list[ColumnSpec]:
        """Return the readings of the text: the whole, then without factor, without unit."""
        found = [self]
        if match := _FACTOR.match(self.text):
            found.append(ColumnSpec(match["text"], self.unit, self.factor * float(match["factor"])))
        if self.unit is None:
            found += [
                ColumnSpec(match["text"], match["unit"].strip(), item.factor)
                for item in list(found)
                if (match := _UNIT.match(item.text))
            ]
        return found


@dataclass(frozen=True, slots=True)
class ColumnMap:
    """The user's columns by quantity: time, current, voltage, temperature, soc.

    `where` is the option or file that states them, for messages.
    """

    specs: Mapping[str, ColumnSpec] = field(default_factory=dict)
    where: str = "--columns"

    @classmethod
    def of(cls, given: ColumnMap | Mapping[str, Any] | str, where: str = "columns") -> ColumnMap:
        """Return the map of a text (`time=t,current=I[mA]:-1`) or of a mapping.

        Values of a mapping are texts, or mappings with `heading` and optionally `unit`, `sign` and
        `scale`.

        Raises
        ------
        InputError
            If a name or a value is not understood.

        Examples
        --------
        >>> ColumnMap.of("time=t,current=I, pack[mA]:-1").specs["current"].text
        'I, pack[mA]:-1'
        """
        if isinstance(given, ColumnMap):
            return given
        if not isinstance(given, Mapping | str):
            raise InputError("not columns", field=where, value=given, cure=_SYNTAX)
        pairs = given.items() if isinstance(given, Mapping) else _pairs(given, where)
        specs: dict[str, ColumnSpec] = {}
        for name, value in pairs:
            quantity = str(name).lower()
            if quantity in specs:
                raise InputError("is given twice", field=where, value=name)
            specs[quantity] = _spec_of(quantity, value, where)
        return cls(specs, where)


def _pairs(text: str, where: str) -> list[tuple[str, str]]:
    parts = [(part, *part.partition("=")) for part in _SPLIT.split(text)]
    for part, _, equals, value in parts:
        if not equals or not value.strip():
            raise InputError("not a column", field=where, value=part, cure=_SYNTAX)
    return [(name.strip(), value.strip()) for _, name, _, value in parts]


def _spec_of(quantity: str, value: Any, where: str) -> ColumnSpec:
    if quantity not in FIELDS:
        cure = f"known are {', '.join(FIELDS)}"
        raise InputError("not a quantity of a log", field=where, value=quantity, cure=cure)
    if isinstance(value, ColumnSpec):
        return value
    if isinstance(value, str) and value.strip():
        return ColumnSpec(value.strip())
    if isinstance(value, Mapping) and isinstance(value.get("heading"), str):
        unit, sign, scale = value.get("unit"), value.get("sign", 1), value.get("scale", 1.0)
        is_number = isinstance(scale, int | float) and not isinstance(scale, bool) and scale > 0.0
        known = set(value) <= {"heading", "unit", "sign", "scale"}
        if known and is_number and sign in {1, -1} and isinstance(unit, str | None):
            return ColumnSpec(value["heading"], unit, float(sign * scale))
    raise InputError(
        "not a column",
        field=f"{where}.{quantity}",
        value=value,
        cure='give a text such as "Pack Current[mA]:-1", or { heading = …, unit = …, sign = ±1,'
        " scale = … }",
    )


@dataclass(frozen=True, slots=True)
class ChosenColumn:
    """Columns of a table that hold one quantity.

    Several places are a date and its time, temperatures whose median is taken, or the currents of
    discharge and charge, whose difference is taken. The unit is the
    user's, the heading's or that of the row of units. `others` are further columns of time: dates
    beside a clock, or times in case that the first does not increase. `is_stated`: with the
    user's unit or factor.
    """

    places: tuple[int, ...]
    unit: str = ""
    factor: float = 1.0
    source: TemperatureSource = "unknown"
    is_stated: bool = False
    others: tuple[tuple[int, Meaning], ...] = ()


@dataclass(frozen=True, slots=True)
class Choice:
    """Columns of a table by quantity, and the likely columns of each that is not plain."""

    chosen: dict[str, ChosenColumn] = field(default_factory=dict)
    guesses: dict[str, list[int]] = field(default_factory=dict)

    @property
    def is_complete(self) -> bool:
        """Whether time, current and voltage are known (a temperature may be given)."""
        return set(_NEEDED) <= set(self.chosen)


def choose_columns(
    headings: Sequence[str], units_below: Sequence[str] = (), given: ColumnMap | None = None
) -> Choice:
    """Choose the columns of a table: the user's first, then plain headings.

    Raises
    ------
    InputError
        If a column of the user is not in the table, or is named for two quantities.
    """
    below = [*units_below, *[""] * (len(headings) - len(units_below))]
    meanings = [meaning_of(text, unit) for text, unit in zip(headings, below, strict=False)]
    given = given or ColumnMap()
    choice = Choice()
    owner: dict[int, str] = {}
    for quantity, spec in given.specs.items():
        found = _given_column(quantity, spec, headings, meanings, given.where)
        for place in found.places:
            if place in owner:
                raise InputError(
                    f"is the column of {owner[place]} too",
                    field=f"{given.where} {quantity}",
                    value=spec.text,
                    cure="give each quantity a column of its own, as headings or as #1, #2, …",
                )
        owner |= dict.fromkeys(found.places, quantity)
        choice.chosen[quantity] = found
    for quantity in FIELDS:
        plain = [
            (place, meaning)
            for place, meaning in enumerate(meanings)
            if meaning is not None and meaning.quantity == quantity and place not in owner
        ]
        pair = _directions(headings, plain) if quantity == "current" else None
        if pair is not None and "current" not in given.specs:
            choice.chosen["current"] = pair
        elif quantity not in given.specs and plain:
            _choose(quantity, sorted(plain, key=lambda item: item[1].rank), choice)
    return choice


def _directions(
    headings: Sequence[str], plain: Sequence[tuple[int, Meaning]]
) -> ChosenColumn | None:
    """Return the currents of discharge and charge, in this order, if they alone are plain."""
    found: dict[tuple[str, str], dict[bool, int]] = {}
    for place, meaning in plain:
        match = _DIRECTION.search(headings[place])
        rest = _simple(headings[place].replace(match[0], "")) if match else ""
        without = meaning_of(rest) if match else meaning
        if without is not None and without.quantity == "current" and without.rank < GUESS:
            found.setdefault((rest, meaning.unit), {})[bool(match and match["dis"])] = place
    if len(found) != 1:
        return None
    ((_, unit), places), *_ = found.items()
    return ChosenColumn((places[True], places[False]), unit) if len(places) == 2 else None


def _choose(quantity: str, plain: list[tuple[int, Meaning]], choice: Choice) -> None:
    """Choose among the columns of a quantity, the most direct first; or guess one."""
    place, first = plain[0]
    best = [item for item in plain if item[1].rank == first.rank]
    numbered = [meaning.numbered for _, meaning in plain if meaning.rank <= GUESS]
    siblings = quantity in {"current", "voltage"} and first.numbered and sum(numbered) > 1
    if quantity == "temperature" and len(best) > 1:  # of one unit, °C first; T beside T1, T2 is it
        celsius = [item for item in best if unit_of("temperature_c", item[1].unit) == (1.0, 0.0)]
        best = celsius or [item for item in best if item[1].unit == first.unit]
        best = [item for item in best if not item[1].numbered] or best
    are_probes = quantity == "temperature" and all(meaning.numbered for _, meaning in best)
    one_of_many = len(best) > 1 and quantity != "time" and not are_probes
    if first.rank >= GUESS or siblings or one_of_many:
        rank = GUESS if siblings else min(first.rank, GUESS)
        choice.guesses[quantity] = [p for p, meaning in plain if meaning.rank <= rank]
    elif quantity == "time":
        choice.chosen[quantity] = ChosenColumn((place,), first.unit, others=tuple(plain[1:]))
    else:
        unit, source = best[0][1].unit, best[0][1].source
        choice.chosen[quantity] = ChosenColumn(tuple(p for p, _ in best), unit, source=source)


def _given_column(
    quantity: str,
    spec: ColumnSpec,
    headings: Sequence[str],
    meanings: Sequence[Meaning | None],
    where: str,
) -> ChosenColumn:
    for reading in spec.readings():
        places = _places(reading.text, headings, is_joined=quantity in _JOINED)
        if not places:
            continue
        units = {_stated_unit(headings[place], meanings[place], quantity) for place in places}
        unit = reading.unit if reading.unit is not None else units.pop() if len(units) == 1 else ""
        scales = {unit_of("temperature_c", other or "C") for other in units}
        if quantity == "temperature" and reading.unit is None and len(scales) > 1:
            shown = ", ".join(sorted(other or "none" for other in units))
            raise InputError(
                f"the headings have different units: {shown}",
                field=f"{where} {quantity}",
                value=spec.text,
                cure="name columns of one unit",
            )
        first = meanings[places[0]]
        source = first.source if first is not None and quantity == "temperature" else "unknown"
        is_stated = reading.unit is not None or reading.factor != 1.0
        return ChosenColumn(places, unit, reading.factor, source, is_stated)
    near = closest(spec.text, headings)
    raise InputError(
        f"no column has this heading (found: {shown_headings(headings)})",
        field=f"{where} {quantity}",
        value=spec.text,
        cure=f"did you mean {near}?" if near else _SYNTAX,
    )


def _stated_unit(heading: str, meaning: Meaning | None, quantity: str) -> str:
    """Return the unit of this quantity that a heading states, whatever its words; "" if none."""
    if meaning is not None and meaning.quantity == quantity:
        return meaning.unit
    units = (unit for _, unit in names_and_units(heading)[:-1])
    return next((unit for unit in units if unit_of(FIELDS[quantity], unit) is not None), "")


def _places(text: str, headings: Sequence[str], *, is_joined: bool) -> tuple[int, ...]:
    """Return the columns that a text names; none where it names no column, or not all."""
    whole = _place(text, headings)
    if whole is not None or not is_joined:
        return () if whole is None else (whole,)
    places = [_place(part, headings) for part in text.split("+")]
    found = tuple(place for place in places if place is not None)
    return found if len(found) == len(places) else ()


def _place(text: str, headings: Sequence[str]) -> int | None:
    """Return the column that a text names: its heading, that without its unit, or its number."""
    if text in headings:  # `t` beside `T`
        return headings.index(text)
    name, names = _simple(text), [_simple(heading) for heading in headings]
    if name in names:
        return names.index(name)
    number = re.fullmatch(r"#(\d{1,5})", text.strip())
    if number and 1 <= int(number[1]) <= len(headings):
        return int(number[1]) - 1
    bare = [_simple(names_and_units(heading)[0][0]) for heading in headings]
    return bare.index(name) if bare.count(name) == 1 else None


def _simple(text: str) -> str:
    return " ".join(text.split()).casefold()


def unknown_columns(source: str, headings: Sequence[str], choice: Choice) -> InputError:
    """Return the error for a table whose columns are not plain, with the option to paste.

    It has the likely column of each quantity, and `?` where none or several are likely.
    """
    needed = [name for name in _NEEDED if name not in choice.chosen]
    missing = " and ".join(part for part in (", ".join(needed[:-1]), *needed[-1:]) if part)
    guesses = {
        name: [headings[k] if headings.count(headings[k]) == 1 else f"#{k + 1}" for k in places]
        for name, places in choice.guesses.items()
    }
    likely = {quantity: found[0] for quantity, found in guesses.items() if len(found) == 1}
    several = [f"{name} is {' or '.join(found)}" for name, found in guesses.items() if found[1:]]
    for quantity, column in choice.chosen.items():
        likely[quantity] = "+".join(headings[place] for place in column.places)
    names = [name for name in FIELDS if name in likely or name in _NEEDED]
    columns = ",".join(f"{name}={likely.get(name, '?')}" for name in names).replace("'", "'\\''")
    return InputError(
        f"no plain heading of {missing} (found: {shown_headings(headings)})",
        source=source,
        cure="; ".join([f"name the columns, e.g. --columns '{columns}' ({DOCS})", *several]),
    )


def shown_headings(headings: Sequence[str]) -> str:
    """Return the first headings of a table for a message."""
    names = [name for name in headings if name]
    return ", ".join(names[:12]) + (f", … ({len(names)} in all)" if len(names) > 12 else "")

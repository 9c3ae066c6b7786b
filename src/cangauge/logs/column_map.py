"""The columns of a table: those that the user names, and the others by plain headings."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import repeat
from typing import Any, Final

from cangauge.errors import InputError, closest
from cangauge.logs.headings import GUESS, Meaning, meaning_of, names_and_units
from cangauge.logs.units import CANONICAL_UNIT, FIELDS, REQUIRED, unit_of
from cangauge.settings import TemperatureSource

DOCS: Final = "docs/logs.md"
"""Page that explains the columns of a log."""
_SYNTAX: Final = (
    "give NAME=HEADING, NAME=HEADING[UNIT] or NAME=HEADING[UNIT]:FACTOR, separated by commas, for"
    " time, current, voltage, temperature, soc"
)
_NEEDED: Final = ("time", "current", "voltage")
_CANONICAL: Final = (*FIELDS.values(), "temperature_source")
_JOINED: Final = ("time", "temperature")
"""Quantities of several columns: a date and its time; probes, whose median is taken."""
_SPLIT: Final = re.compile(rf",\s*(?=(?:{'|'.join(FIELDS)})\s*=)", re.IGNORECASE)
_FACTOR: Final = re.compile(
    r"^(?P<text>.*\S)\s*:\s*(?P<factor>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)$"
)
_DIRECTION: Final = re.compile(r"(?P<dis>dis?|de)?[-_ ]?(?:charg(?:ed|e|ing)|chg)", re.IGNORECASE)
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
            raise InputError("not columns", field=where, value=given, cure=_SYNTAX)
        texts: dict[str, str] = {}
        items: Iterable[Any] = _SPLIT.split(given) if isinstance(given, str) else given.items()
        for part in items:
            name, text = part.partition("=")[::2] if isinstance(part, str) else part
            quantity = str(name).strip().lower()
            if isinstance(part, str) and not text.strip():
                raise InputError("not a column", field=where, value=part, cure=_SYNTAX)
            if quantity not in FIELDS:
                cure = f"known are {', '.join(FIELDS)}"
                raise InputError("not a quantity of a log", field=where, value=quantity, cure=cure)
            if quantity in texts:
                raise InputError("is given twice", field=where, value=quantity)
            if not isinstance(text, str) or not text.strip():
                cure, place = 'write it as text: "Wert b[V]:-1"', f"{where}.{quantity}"
                raise InputError("not a column", field=place, value=text, cure=cure)
            texts[quantity] = text.strip()
        return cls(texts, where)

    def error(self, quantity: str, problem: str, cure: str) -> InputError:
        """Return the error for the column of a quantity."""
        field, text = f"{self.where} {quantity}", self.texts[quantity]
        return InputError(problem, field=field, value=text, cure=cure)


def _readings(text: str) -> list[tuple[str, str | None, float]]:
    """Return (heading, unit, factor) as a text may be meant: the whole, less a factor, a unit."""
    found: list[tuple[str, str | None, float]] = [(text, None, 1.0)]
    if match := _FACTOR.match(text):
        found.append((match["text"], None, float(match["factor"])))
    units = [(match, factor) for each, _, factor in found if (match := _UNIT.match(each))]
    return found + [(match["text"], match["unit"].strip(), factor) for match, factor in units]


@dataclass(frozen=True, slots=True)
class ChosenColumn:
    """Columns of a table that hold one quantity.

    Several places are a date and its time, temperatures whose median is taken, or the currents of
    discharge and charge, whose difference is taken. The unit is the user's, the heading's or that
    of the row of units. `others` are further columns of time: dates beside a clock, or times in
    case that the first does not increase. `is_stated`: with the user's unit or factor.
    """

    places: tuple[int, ...]
    unit: str = ""
    factor: float = 1.0
    source: TemperatureSource = "unknown"
    is_stated: bool = False
    others: tuple[tuple[int, Meaning], ...] = ()


@dataclass(frozen=True, slots=True)
class Choice:
    """Columns of a table by quantity, and the likely columns of each that is not plain.

    `is_canonical`: by the names of the canonical log, which define the sign of the current.
    """

    chosen: dict[str, ChosenColumn] = field(default_factory=dict)
    guesses: dict[str, list[int]] = field(default_factory=dict)
    is_canonical: bool = False

    @property
    def is_complete(self) -> bool:
        """Whether time, current and voltage are known or named (a temperature may be given)."""
        return set(_NEEDED) <= set(self.chosen)


def choose_columns(
    headings: Sequence[str], units_below: Sequence[str] = (), given: ColumnMap | None = None
) -> Choice:
    """Choose the columns of a table: the user's first, then the canonical or plain headings.

    Raises
    ------
    InputError
        If a column of the user is not in the table, or is named for two quantities.
    """
    if given is None and are_canonical(headings):
        names = [*map(_simple, headings)]
        places = {q: names.index(name) for q, name in FIELDS.items() if name in names}
        columns = {q: ChosenColumn((k,), CANONICAL_UNIT[q]) for q, k in places.items()}
        return Choice(columns, is_canonical=True)
    units = [*units_below, *repeat("", len(headings))]
    meanings = [meaning_of(text, unit) for text, unit in zip(headings, units, strict=False)]
    choice, given = Choice(), given or ColumnMap()
    for quantity in given.texts:
        column = _given_column(quantity, given, headings, meanings)
        for other, chosen in choice.chosen.items():
            if not set(column.places).isdisjoint(chosen.places):
                cure = "give each quantity a column of its own, as headings or as #1, #2, …"
                raise given.error(quantity, f"is the column of {other} too", cure)
        choice.chosen[quantity] = column
    taken = {place for column in choice.chosen.values() for place in column.places}
    for quantity in [name for name in FIELDS if name not in given.texts]:
        plain = [
            (place, meaning)
            for place, meaning in enumerate(meanings)
            if meaning is not None and meaning.quantity == quantity and place not in taken
        ]
        pair = _directions(headings, plain) if quantity == "current" else None
        if pair is not None:
            choice.chosen["current"] = pair
        elif plain:
            _choose(quantity, sorted(plain, key=lambda item: item[1].rank), choice)
    return choice


def are_canonical(headings: Sequence[str]) -> bool:
    """Return whether columns have the names of a canonical log's, possibly an incomplete one.

    A temperature of another name is not a missing one: such a table is a logger's own.
    """
    names = {_simple(heading) for heading in headings}
    others = [(name, meaning_of(name)) for name in names.difference(_CANONICAL)]
    has_other = any("temperature" in n or (m and m.quantity == "temperature") for n, m in others)
    return len(names.intersection(REQUIRED)) >= 2 and ("temperature_c" in names or not has_other)


def refuse_odd_names(headings: Sequence[str], source: str) -> None:
    """Raise InputError if a column of the canonical log is missing, or if two have its name."""
    names = [_simple(heading) for heading in headings]
    for name in _CANONICAL:
        refuse_doubled(name, names, source)
        if name in REQUIRED[:3] and name not in names:
            problem = f"this column is missing (found: {shown_headings(headings)})"
            cure = "a log needs time_s, current_a (positive = discharge), voltage_v,"
            cure += " temperature_c [s, A, V, °C]"
            raise InputError(problem, source=source, field=name, cure=cure)


def refuse_doubled(name: str, names: Sequence[str], source: str | None) -> None:
    """Raise InputError if several columns have a name."""
    if (count := list(names).count(name)) > 1:
        problem, cure = f"{count} columns have this name", "rename or drop all but one"
        raise InputError(problem, source=source, field=name, cure=cure)


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
    quantity: str, given: ColumnMap, headings: Sequence[str], meanings: Sequence[Meaning | None]
) -> ChosenColumn:
    for heading, stated, factor in _readings(given.texts[quantity]):
        places = _places(heading, headings, is_joined=quantity in _JOINED)
        if not places:
            continue
        units = sorted({_stated_unit(headings[k], meanings[k], quantity) for k in places})
        is_mixed = len({unit_of("temperature_c", unit or "C") for unit in units}) > 1
        if quantity == "temperature" and stated is None and is_mixed:
            shown = ", ".join(unit or "none" for unit in units)
            problem = f"the headings have different units: {shown}"
            raise given.error(quantity, problem, "name columns of one unit")
        unit = stated if stated is not None else units[0] if len(units) == 1 else ""
        first = meanings[places[0]] if quantity == "temperature" else None
        source = first.source if first is not None else "unknown"
        return ChosenColumn(places, unit, factor, source, stated is not None or factor != 1.0)
    near = closest(given.texts[quantity], headings)
    problem = f"no column has this heading (found: {shown_headings(headings)})"
    raise given.error(quantity, problem, f"did you mean {near}?" if near else _SYNTAX)


def _stated_unit(heading: str, meaning: Meaning | None, quantity: str) -> str:
    """Return the unit of this quantity that a heading states, whatever its words; "" if none."""
    if meaning is not None and meaning.quantity == quantity:
        return meaning.unit
    units = (unit for _, unit in names_and_units(heading)[:-1])
    return next((unit for unit in units if unit_of(FIELDS[quantity], unit) is not None), "")


def _places(text: str, headings: Sequence[str], *, is_joined: bool) -> tuple[int, ...]:
    """Return the columns that a text names; none where it names no column, or not all."""
    whole = _place(text, headings)
    if whole is not None:
        return (whole,)
    places = [_place(part, headings) for part in text.split("+")] if is_joined else []
    return () if None in places else tuple(place for place in places if place is not None)


def _place(text: str, headings: Sequence[str]) -> int | None:
    """Return the column of a text: its heading, its number, or the heading without the unit."""
    if text in headings:  # `t` beside `T`
        return headings.index(text)
    name, names = _simple(text), [_simple(heading) for heading in headings]
    bare = [_simple(names_and_units(heading)[0][0]) for heading in headings]
    number = re.fullmatch(r"#(\d{1,5})", text.strip())
    if name in names:
        return names.index(name)
    if number and 1 <= int(number[1]) <= len(headings):
        return int(number[1]) - 1
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
    problem = f"no plain heading of {missing} (found: {shown_headings(headings)})"
    cure = "; ".join([f"name the columns, e.g. --columns '{columns}' ({DOCS})", *several])
    return InputError(problem, source=source, cure=cure)


def shown_headings(headings: Sequence[str]) -> str:
    """Return the first headings of a table for a message."""
    names = [name for name in headings if name]
    return ", ".join(names[:12]) + (f", … ({len(names)} in all)" if len(names) > 12 else "")

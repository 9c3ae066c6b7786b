"""The columns of a table: those that the user names, and the rest by plain headings."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

from cangauge.errors import InputError, closest
from cangauge.logs.headings import (
    FIELDS,
    GUESS,
    Meaning,
    bare_name,
    meaning_of,
    stated_unit,
)
from cangauge.logs.units import TemperatureSource, unit_of

SYNTAX: Final = (
    "give NAME=HEADING, NAME=HEADING[UNIT] or NAME=HEADING[UNIT]:FACTOR, separated by commas, for"
    " time, current, voltage, temperature, soc"
)

_SPLIT: Final = re.compile(rf",\s*(?=(?:{'|'.join(FIELDS)})\s*=)", re.IGNORECASE)
_FACTOR: Final = re.compile(r"^(?P<rest>.*\S)\s*:\s*(?P<factor>[-+]?[\d.]+(?:[eE][-+]?\d+)?)$")
_UNIT: Final = re.compile(r"^(?P<rest>.*\S)\s*\[(?P<unit>[^\[\]]*)\]$")
_NUMBER: Final = re.compile(r"^#(?P<number>\d{1,5})$")


@dataclass(frozen=True, slots=True)
class ColumnSpec:
    """One column as the user gives it.

    Parameters
    ----------
    text : str
        Heading, or headings joined by `+` (a date and its time; the mean of temperatures), or `#3`
        for the third column; then `[UNIT]` and `:FACTOR`, both optional.
    unit : str, optional
        Unit of the column, in place of the heading's.
    factor : float
        The column times this is in its unit; its sign inverts.
    """

    text: str
    unit: str | None = None
    factor: float = 1.0

    def variants(self) -> list[ColumnSpec]:
        """Return the readings of the text: the whole, then without factor, without unit."""
        found = [self]
        for pattern in (_FACTOR, _UNIT):
            for item in list(found):
                match = pattern.match(item.text)
                if match is None or (pattern is _UNIT and item.unit is not None):
                    continue
                if pattern is _FACTOR:
                    try:
                        factor = self.factor * float(match["factor"])
                    except ValueError:
                        continue
                    found.append(ColumnSpec(match["rest"], item.unit, factor))
                else:
                    found.append(ColumnSpec(match["rest"], match["unit"].strip(), item.factor))
        return found


@dataclass(frozen=True, slots=True)
class ColumnMap:
    """The user's columns by quantity.

    Parameters
    ----------
    specs : mapping of str to ColumnSpec
        By quantity: time, current, voltage, temperature, soc.
    where : str
        Option or file that states them, for messages.
    """

    specs: Mapping[str, ColumnSpec] = field(default_factory=dict)
    where: str = "--columns"

    @classmethod
    def of(cls, given: ColumnMap | Mapping[str, Any] | str, where: str = "columns") -> ColumnMap:
        """Return the map of a text (`time=t,current=I[mA]:-1`) or of a mapping.

        Parameters
        ----------
        given : ColumnMap, str or mapping
            Values of a mapping are texts, or mappings with `heading` and optionally `unit`, `sign`
            and `scale`.
        where : str
            Option or file, for messages.

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
        pairs: dict[str, Any] = {}
        if isinstance(given, str):
            for part in _SPLIT.split(given):
                name, equals, text = part.partition("=")
                if not equals or not text.strip():
                    raise InputError("not a column", field=where, value=part, cure=SYNTAX)
                if name.strip().lower() in pairs:
                    raise InputError("is given twice", field=where, value=name.strip())
                pairs[name.strip().lower()] = text.strip()
        else:
            pairs = {str(name).lower(): value for name, value in given.items()}
        return cls({name: _spec_of(name, value, where) for name, value in pairs.items()}, where)


def _spec_of(name: str, value: Any, where: str) -> ColumnSpec:
    if name not in FIELDS:
        raise InputError(
            "not a quantity of a log",
            field=where,
            value=name,
            cure=f"known are {', '.join(FIELDS)}",
        )
    if isinstance(value, str) and value.strip():
        return ColumnSpec(value.strip())
    if isinstance(value, Mapping) and isinstance(value.get("heading"), str):
        unknown = set(value) - {"heading", "unit", "sign", "scale"}
        sign, scale = value.get("sign", 1), value.get("scale", 1.0)
        is_number = isinstance(scale, int | float) and not isinstance(scale, bool)
        if not unknown and sign in {1, -1} and is_number and scale > 0.0:
            unit = value.get("unit")
            if unit is None or isinstance(unit, str):
                return ColumnSpec(value["heading"], unit, float(sign * scale))
    raise InputError(
        "not a column",
        field=f"{where}.{name}",
        value=value,
        cure='give a text such as "Pack Current[mA]:-1", or { heading = …, unit = …, sign = ±1,'
        " scale = … }",
    )


@dataclass(frozen=True, slots=True)
class ChosenColumn:
    """Columns of a table that hold one quantity.

    Parameters
    ----------
    places : tuple of int
        Indices; several: a date and its time, or temperatures of which the mean is taken.
    unit : str
        As stated by the user, the heading or the row of units; "" if none states it.
    factor : float
    given : bool
        Whether the user named the column.
    source : str
        Where a temperature is measured, if its heading defines it.
    others : tuple of int
        Further time columns, in case that the first does not increase.
    """

    places: tuple[int, ...]
    unit: str = ""
    factor: float = 1.0
    given: bool = False
    source: TemperatureSource = "unknown"
    others: tuple[int, ...] = ()


_STEMS: Final = {
    "time": ("time", "zeit", "stamp", "date"),
    "current": ("curr", "amp", "strom", "ibat"),
    "voltage": ("volt", "spann", "ubat", "vbat"),
    "temperature": ("temp",),
    "soc": ("soc",),
}
_GUESSED_AT_MOST: Final = 500


@dataclass(frozen=True, slots=True)
class Choice:
    """Columns of a table by quantity, and what hinders the rest.

    Parameters
    ----------
    chosen : dict of str to ChosenColumn
    guesses : dict of str to int
        Index of the likeliest column of each quantity that is not plain.
    """

    chosen: dict[str, ChosenColumn]
    guesses: dict[str, int]

    @property
    def is_complete(self) -> bool:
        """Whether time, current and voltage are known (a temperature may be given)."""
        return {"time", "current", "voltage"} <= set(self.chosen)


def choose_columns(
    headings: Sequence[str], units_below: Sequence[str] = (), given: ColumnMap | None = None
) -> Choice:
    """Choose the columns of a table: the user's first, then plain headings.

    Parameters
    ----------
    headings : sequence of str
    units_below : sequence of str
        Row of units below the header, where there is one.
    given : ColumnMap, optional
        The user's columns.

    Raises
    ------
    InputError
        If a column of the user is not in the table, or is named for two quantities.
    """
    below = [*units_below, *[""] * (len(headings) - len(units_below))]
    meanings = [meaning_of(text, unit) for text, unit in zip(headings, below, strict=False)]
    chosen: dict[str, ChosenColumn] = {}
    for quantity, spec in (given.specs if given else {}).items():
        where = given.where if given else ""
        found = _given_column(quantity, spec, headings, meanings, where)
        for other, before in chosen.items():
            if set(before.places) & set(found.places):
                raise InputError(
                    f"is the column of {other} too",
                    field=f"{where} {quantity}".strip(),
                    value=spec.text,
                    cure="give each quantity a column of its own, as headings or as #1, #2, …",
                )
        chosen[quantity] = found
    taken = {place for item in chosen.values() for place in item.places}
    guesses: dict[str, int] = {}
    for quantity in FIELDS:
        if quantity in chosen:
            continue
        of_it = [
            (meaning.rank, place, meaning)
            for place, meaning in enumerate(meanings)
            if meaning is not None and meaning.quantity == quantity and place not in taken
        ]
        if not of_it:
            continue
        of_it.sort(key=lambda item: item[:2])
        best = [item for item in of_it if item[0] == of_it[0][0]]
        column = _plain_column(quantity, [(place, meaning) for _, place, meaning in best])
        if column is not None and quantity == "time":
            others = tuple(place for rank, place, _ in of_it[1:] if rank < GUESS)
            column = replace(column, others=others)
        if column is None or best[0][0] >= GUESS or _has_siblings(quantity, of_it):
            guesses[quantity] = of_it[0][1]
        else:
            chosen[quantity] = column
    _guess_by_stem(headings, chosen, guesses)
    return Choice(chosen, guesses)


def _has_siblings(quantity: str, of_it: Sequence[tuple[int, int, Meaning]]) -> bool:
    """Whether the first column is one of several numbered ones, such as `Current 1`."""
    numbered = [meaning.numbered for rank, _, meaning in of_it if rank <= GUESS]
    return quantity in {"current", "voltage"} and numbered[0] and sum(numbered) > 1


def _guess_by_stem(
    headings: Sequence[str], chosen: dict[str, ChosenColumn], guesses: dict[str, int]
) -> None:
    """Guess what no word names by parts of words, for the command that is suggested."""
    taken = {place for item in chosen.values() for place in item.places} | set(guesses.values())
    for quantity, stems in _STEMS.items():
        if quantity in chosen or quantity in guesses:
            continue
        for place, heading in enumerate(headings[:_GUESSED_AT_MOST]):
            if place not in taken and any(
                re.search(rf"(?:^|[^a-z]){stem}", heading.lower()) for stem in stems
            ):
                guesses[quantity] = place
                taken.add(place)
                break


def _plain_column(quantity: str, best: list[tuple[int, Meaning]]) -> ChosenColumn | None:
    """Return the column of the best meanings; None if they are several and cannot be combined."""
    place, first = best[0]
    if quantity == "time":
        return ChosenColumn((place,), first.unit)
    if len(best) > 1 and quantity == "temperature":
        celsius = [item for item in best if unit_of("temperature_c", item[1].unit) == (1.0, 0.0)]
        best = celsius or [item for item in best if item[1].unit == first.unit]
        numbered = [item for item in best if item[1].numbered]
        if len(best) > 1 and len(numbered) < len(best):
            best = [item for item in best if not item[1].numbered]  # T beside T1, T2: their mean
    if len(best) > 1 and quantity != "temperature":
        return None
    if len(best) > 1 and not all(meaning.numbered for _, meaning in best):
        return None
    return ChosenColumn(tuple(each for each, _ in best), best[0][1].unit, source=best[0][1].source)


def _given_column(
    quantity: str,
    spec: ColumnSpec,
    headings: Sequence[str],
    meanings: Sequence[Meaning | None],
    where: str,
) -> ChosenColumn:
    for variant in spec.variants():
        places = _places(variant.text, headings)
        if places is None:
            continue
        unit = variant.unit
        if unit is None:
            stated = {
                meaning.unit if (meaning := meanings[place]) and meaning.quantity == quantity
                else stated_unit(headings[place], quantity)
                for place in places
            }  # fmt: skip
            unit = stated.pop() if len(stated) == 1 else ""
        source: TemperatureSource = "unknown"
        if quantity == "temperature" and (meaning := meanings[places[0]]):
            source = meaning.source
        return ChosenColumn(places, unit, variant.factor, given=True, source=source)
    near = closest(spec.text, headings)
    raise InputError(
        f"no column has this heading (found: {shown_headings(headings)})",
        field=f"{where} {quantity}".strip(),
        value=spec.text,
        cure=f"did you mean {near}?" if near else SYNTAX,
    )


def _places(text: str, headings: Sequence[str]) -> tuple[int, ...] | None:
    whole = _one_place(text, headings)
    if whole is not None:
        return (whole,)
    parts = [_one_place(part, headings) for part in text.split("+")]
    found = tuple(place for place in parts if place is not None)
    return found if len(found) == len(parts) > 1 else None


def _one_place(text: str, headings: Sequence[str]) -> int | None:
    if text in headings:  # `t` beside `T`
        return headings.index(text)
    wanted = _simple(text)
    names = [_simple(heading) for heading in headings]
    if wanted in names:
        return names.index(wanted)
    if (match := _NUMBER.match(text.strip())) and 1 <= int(match["number"]) <= len(headings):
        return int(match["number"]) - 1
    bare = [_simple(bare_name(heading)) for heading in headings]
    return bare.index(wanted) if bare.count(wanted) == 1 else None


def _simple(text: str) -> str:
    return " ".join(text.split()).casefold()


def shown_headings(headings: Sequence[str]) -> str:
    """Return the first headings of a table for a message."""
    names = [name for name in headings if name]
    return ", ".join(names[:12]) + (f", … ({len(names)} in all)" if len(names) > 12 else "")


def missing_quantities(choice: Choice) -> str:
    """Return the quantities that every log needs and this table lacks, for a message."""
    names = [name for name in ("time", "current", "voltage") if name not in choice.chosen]
    return " and ".join(part for part in (", ".join(names[:-1]), *names[-1:]) if part)


def suggestion(headings: Sequence[str], choice: Choice) -> str:
    """Return the likeliest `--columns` option to paste; `?` where nothing is likely."""
    parts = []
    for quantity in FIELDS:
        column = choice.chosen.get(quantity)
        if column is not None:
            parts.append(f"{quantity}={'+'.join(headings[place] for place in column.places)}")
        elif quantity in choice.guesses:
            parts.append(f"{quantity}={headings[choice.guesses[quantity]]}")
        elif quantity in {"time", "current", "voltage"}:
            parts.append(f"{quantity}=?")
    return "--columns '" + ",".join(parts).replace("'", "'\\''") + "'"

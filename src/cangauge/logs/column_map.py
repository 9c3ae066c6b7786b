"""The columns of a table: those that the user names, and the others by plain headings."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from cangauge.errors import InputError, closest
from cangauge.logs.headings import GUESS, Meaning, meaning_of, names_and_units
from cangauge.logs.units import FIELDS, REQUIRED, TemperatureSource, unit_of

DOCS: Final = "docs/logs.md"
"""Page that explains the columns of a log."""
SOURCE: Final = "temperature_source"
"""Column or metadata of a canonical log: the location of the temperature sensor."""
_SYNTAX: Final = (
    "give NAME=HEADING, NAME=HEADING[UNIT] or NAME=HEADING[UNIT]:FACTOR, separated by commas, for"
    " time, current, voltage, temperature, soc"
)
_NEEDED: Final = ("time", "current", "voltage")
_SPLIT: Final = re.compile(rf",\s*(?=(?:{'|'.join(FIELDS)})\s*=)", re.IGNORECASE)
_FACTOR: Final = re.compile(r"^(?P<text>.*\S)\s*:\s*(?P<factor>[-+]?[\d.]+(?:[eE][-+]?\d+)?)$")
_UNIT: Final = re.compile(r"^(?P<text>.*\S)\s*\[(?P<unit>[^\[\]]*)\]$")


@dataclass(frozen=True, slots=True)
class ColumnMap:
    """The user's columns.

    Parameters
    ----------
    specs : dict
        By quantity (time, current, voltage, temperature, soc): a heading, or headings joined by
        `+` (a date and its time; the median of temperatures), or `#3` for the third column; then
        `[UNIT]`, in place of the heading's, and `:FACTOR`, both optional.
    where : str
        Option or file that states them, for messages.
    """

    specs: Mapping[str, str] = field(default_factory=dict)
    where: str = "--columns"

    @classmethod
    def of(cls, given: ColumnMap | Mapping[str, Any] | str, where: str = "columns") -> ColumnMap:
        """Return the map of a text (`time=t,current=I[mA]:-1`) or of a mapping of texts.

        Raises
        ------
        InputError
            If a name or a value is not understood.

        Examples
        --------
        >>> ColumnMap.of("time=t,current=I, pack[mA]:-1").specs["current"]
        'I, pack[mA]:-1'
        """
        if isinstance(given, ColumnMap):
            return given
        if isinstance(given, str):
            parts = (part.partition("=") for part in _SPLIT.split(given))
            pairs: Iterable[tuple[Any, Any]] = [(name, text) for name, _, text in parts]
        elif isinstance(given, Mapping):
            pairs = given.items()
        else:
            raise InputError("not columns", field=where, value=given, cure=_SYNTAX)
        specs: dict[str, str] = {}
        for name, text in pairs:
            quantity = str(name).strip().lower()
            if not isinstance(text, str) or not text.strip():
                raise InputError("not a column", field=where, value=text or name, cure=_SYNTAX)
            if quantity not in FIELDS:
                cure = f"known are {', '.join(FIELDS)}"
                raise InputError("not a quantity of a log", field=where, value=quantity, cure=cure)
            if quantity in specs:
                raise InputError("is given twice", field=where, value=name)
            specs[quantity] = text.strip()
        return cls(specs, where)


@dataclass(frozen=True, slots=True)
class ChosenColumn:
    """Columns of a table that hold one quantity.

    Several places are a date and its time, or temperatures whose median is taken. The unit is the
    user's, the heading's or that of the row of units. `others` are further times, in case that the
    first does not increase.
    """

    places: tuple[int, ...]
    unit: str = ""
    factor: float = 1.0
    source: TemperatureSource = "unknown"
    others: tuple[ChosenColumn, ...] = ()


def choose_columns(
    headings: Sequence[str],
    units_below: Sequence[str] = (),
    given: ColumnMap | None = None,
    *,
    source: str,
) -> dict[str, ChosenColumn]:
    """Return the columns of a table by quantity: the user's first, then by plain headings.

    Raises
    ------
    InputError
        If a column of the user is not in the table, or is named for two quantities; if time,
        current or voltage is not known (a temperature may be given).
    """
    chosen, _ = find_columns(headings, units_below, given)
    if not set(_NEEDED) <= set(chosen):
        raise unknown_columns(source, headings, given)
    return chosen


def find_columns(
    headings: Sequence[str], units_below: Sequence[str] = (), given: ColumnMap | None = None
) -> tuple[dict[str, ChosenColumn], dict[str, ChosenColumn]]:
    """Return the columns that are named or plain, and the likeliest one of each other quantity."""
    below = [*units_below, *[""] * len(headings)]
    meanings = [meaning_of(text, unit) for text, unit in zip(headings, below, strict=False)]
    chosen: dict[str, ChosenColumn] = {}
    guesses: dict[str, ChosenColumn] = {}
    owner: dict[int, str] = {}
    given = given or ColumnMap()
    for quantity, text in given.specs.items():
        chosen[quantity] = _named_column(quantity, text, headings, meanings, given.where)
        for place in chosen[quantity].places:
            if owner.setdefault(place, quantity) != quantity:
                raise InputError(
                    f"is the column of {owner[place]} too",
                    field=f"{given.where} {quantity}",
                    value=text,
                    cure="give each quantity a column of its own, as headings or as #1, #2, …",
                )
    for quantity in (name for name in FIELDS if name not in given.specs):
        plain = [
            (place, meaning)
            for place, meaning in enumerate(meanings)
            if meaning is not None and meaning.quantity == quantity and place not in owner
        ]
        if plain:
            column, is_plain = _best_column(quantity, sorted(plain, key=lambda item: item[1].rank))
            (chosen if is_plain else guesses)[quantity] = column
    return chosen, guesses


def _best_column(quantity: str, ranked: list[tuple[int, Meaning]]) -> tuple[ChosenColumn, bool]:
    """Return the most direct column of a quantity, or several, and whether it is plain."""
    place, first = ranked[0]
    best = [(place, item) for place, item in ranked if item.rank == first.rank]
    others: tuple[ChosenColumn, ...] = ()
    if quantity == "time":
        best, later = ranked[:1], ranked[1:]
        others = tuple(ChosenColumn((k,), item.unit) for k, item in later if item.rank < GUESS)
        is_plain = True
    elif quantity == "temperature":  # of one unit, °C first; T beside T1, T2 is it
        celsius = [each for each in best if unit_of("temperature_c", each[1].unit) == (1.0, 0.0)]
        best = celsius or [each for each in best if each[1].unit == first.unit]
        best = [each for each in best if not each[1].numbered] or best
        is_plain = len(best) == 1 or all(item.numbered for _, item in best)
    else:
        siblings = [item for _, item in ranked if item.numbered and item.rank <= GUESS]
        is_plain = len(best) == 1 and not (first.numbered and len(siblings) > 1)
    is_plain = is_plain and first.rank < GUESS
    places = tuple(k for k, _ in best) if is_plain else (place,)
    return ChosenColumn(places, best[0][1].unit, 1.0, best[0][1].source, others), is_plain


def _named_column(
    quantity: str,
    text: str,
    headings: Sequence[str],
    meanings: Sequence[Meaning | None],
    where: str,
) -> ChosenColumn:
    for heading, unit, factor in _readings(text):
        places = _places(heading, headings)
        if places and (len(places) == 1 or quantity in {"time", "temperature"}):
            stated = {_stated_unit(headings[k], meanings[k], quantity) for k in places}
            found = unit or (stated.pop() if len(stated) == 1 else "")
            first = meanings[places[0]]
            source = first.source if first is not None and quantity == "temperature" else "unknown"
            return ChosenColumn(places, found, factor, source)
    near = closest(text, headings)
    raise InputError(
        f"no column has this heading (found: {shown_headings(headings)})",
        field=f"{where} {quantity}",
        value=text,
        cure=f"did you mean {near}?" if near else _SYNTAX,
    )


def _readings(text: str) -> Iterator[tuple[str, str, float]]:
    """Yield heading, unit and factor as a text may be meant: the whole is a heading first."""
    texts = [(text, 1.0)]
    if match := _FACTOR.match(text):
        texts.append((match["text"], float(match["factor"])))
    yield from ((heading, "", factor) for heading, factor in texts)
    for heading, factor in texts:
        if match := _UNIT.match(heading):
            yield match["text"], match["unit"].strip(), factor


def _stated_unit(heading: str, meaning: Meaning | None, quantity: str) -> str:
    """Return the unit of this quantity that a heading states, whatever its words; "" if none."""
    if meaning is not None and meaning.quantity == quantity:
        return meaning.unit
    units = (unit for _, unit in names_and_units(heading)[:-1])
    return next((unit for unit in units if unit_of(FIELDS[quantity], unit) is not None), "")


def _places(text: str, headings: Sequence[str]) -> tuple[int, ...]:
    """Return the columns that a text names; none where it names no column, or not all."""
    for parts in ([text], text.split("+")):
        found = [_place(part, headings) for part in parts]
        if all(place is not None for place in found):
            return tuple(place for place in found if place is not None)
    return ()


def _place(text: str, headings: Sequence[str]) -> int | None:
    if text in headings:  # `t` beside `T`
        return headings.index(text)
    simple = " ".join(text.split()).casefold()
    names = [" ".join(heading.split()).casefold() for heading in headings]
    if simple in names:
        return names.index(simple)
    number = re.fullmatch(r"#(\d{1,5})", simple)
    if number and 1 <= int(number[1]) <= len(headings):
        return int(number[1]) - 1
    bare = [names_and_units(name)[0][0] for name in names]
    return bare.index(simple) if bare.count(simple) == 1 else None


def is_canonical(headings: Sequence[str]) -> bool:
    """Return whether columns have the names of a canonical log's, possibly an incomplete one.

    A temperature of another name is not a missing one: such a table is a logger's own.
    """
    names = {name.strip().lower() for name in headings}
    others = any(
        "temperature" in name
        or ((meaning := meaning_of(name)) and meaning.quantity == "temperature")
        for name in names - {SOURCE}
    )
    return len(names & set(REQUIRED)) >= 2 and ("temperature_c" in names or not others)


# --- For messages


def unknown_columns(source: str, headings: Sequence[str], given: ColumnMap | None) -> InputError:
    """Return the error for a table whose columns are not plain, with the option to paste."""
    chosen, guesses = find_columns(headings, (), given)
    missing = ", ".join(name for name in _NEEDED if name not in chosen)
    missing = " and ".join(missing.rsplit(", ", 1))
    return InputError(
        f"no plain heading of {missing} (found: {shown_headings(headings)})",
        source=source,
        cure=f"name the columns, e.g. {suggestion(headings, guesses | chosen)} ({DOCS})",
    )


def suggestion(headings: Sequence[str], likely: Mapping[str, ChosenColumn]) -> str:
    """Return the likeliest `--columns` option to paste; `?` where nothing is likely."""
    texts = {
        quantity: "+".join(headings[place] for place in column.places)
        for quantity, column in likely.items()
    }
    parts = (f"{name}={texts.get(name, '?')}" for name in FIELDS if name in {*_NEEDED, *texts})
    return "--columns '" + ",".join(parts).replace("'", "'\\''") + "'"


def shown_headings(headings: Sequence[str]) -> str:
    """Return the first headings of a table for a message."""
    names = [name for name in headings if name]
    return ", ".join(names[:12]) + (f", … ({len(names)} in all)" if len(names) > 12 else "")

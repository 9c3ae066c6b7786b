"""Which columns of a table hold which quantity: the user's, else by plain headings."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import islice, product, repeat
from typing import Final

from cangauge.errors import InputError, closest
from cangauge.logs.column_map import DOCS, SYNTAX, ColumnMap, meant_by
from cangauge.logs.headings import Meaning, Rank, meaning_of, parse_heading
from cangauge.logs.log import SOURCE
from cangauge.logs.quantities import FIELDS, QUANTITIES, REQUIRED, unit_of
from cangauge.settings import TemperatureSource

NEEDED: Final = ("time", "current", "voltage")
"""Quantities that every table holds; a temperature may be given as a constant."""
_JOINED: Final = ("time", "temperature")
"""Quantities of several columns: a date and its time; probes, whose median is taken."""

_Found = tuple[int, Meaning]
"""Place and meaning of a column."""


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
    others: tuple[_Found, ...] = ()


@dataclass(frozen=True, slots=True)
class Choice:
    """Columns of a table by quantity, and the likely columns of each that is not plain.

    `is_canonical`: by the names of the canonical log, which define the sign of the current.
    """

    chosen: dict[str, ChosenColumn] = field(default_factory=dict)
    guesses: dict[str, list[_Found]] = field(default_factory=dict)
    is_canonical: bool = False

    @property
    def is_complete(self) -> bool:
        """Whether time, current and voltage are known or named."""
        return set(NEEDED) <= set(self.chosen)


class UnknownColumnsError(InputError):
    """A table whose columns are not plain.

    `likely` are the columns that each quantity may have, as texts of `--columns`: the user's, the
    chosen one, or guesses.
    """

    def __init__(
        self, source: str, headings: Sequence[str], choice: Choice, given: ColumnMap | None
    ) -> None:
        needed = [name for name in NEEDED if name not in choice.chosen]
        missing = " and ".join(filter(None, (", ".join(needed[:-1]), *needed[-1:])))
        problem = f"no plain heading of {missing} (found: {shown_headings(headings)})"
        super().__init__(problem, source=source, cure=f"name the columns with --columns ({DOCS})")
        self.likely: dict[str, list[str]] = {}
        for quantity in FIELDS:
            others: Sequence[_Found] = choice.guesses.get(quantity, ())
            texts = list[str]()
            if quantity in choice.chosen:
                column = choice.chosen[quantity]
                texts = ["+".join(_text_of(headings, place) for place in column.places)]
                others = column.others
            texts += [_text_of(headings, *each) for each in others]
            if given is not None and quantity in given.texts:
                texts = [given.texts[quantity]]
            if texts:
                self.likely[quantity] = texts

    def proposing(self, can_read: Callable[[ColumnMap], bool]) -> InputError:
        """Return the error with the columns to paste, if any columns read the file.

        A quantity has a `?` if several of its columns read the file, or if none is likely.

        Parameters
        ----------
        can_read : callable
            Whether columns read the file.
        """
        proposed = self.likely
        if set(NEEDED) <= set(proposed):
            # Without temperature and SoC, if one of them is not read.
            needed = {name: self.likely[name] for name in NEEDED}
            proposed = _that_read(self.likely, can_read) or _that_read(needed, can_read)
            if not proposed:
                return self
        texts, several = [], []
        for name in FIELDS:
            found = proposed.get(name, [])
            if len(found) == 1 or (found and name == "time"):
                texts.append(f"{name}={found[0]}")
            elif found or name in NEEDED:
                texts.append(f"{name}=?")
            if len(found) > 1 and name != "time":
                several.append(f"{name} is {' or '.join(found)}")
        columns = ",".join(texts).replace("'", "'\\''")
        cure = "; ".join([f"name the columns, e.g. --columns '{columns}' ({DOCS})", *several])
        return InputError(self.problem, source=self.source, cure=cure)


def _text_of(headings: Sequence[str], place: int, meaning: Meaning | None = None) -> str:
    """Return a column as a user would name it: by number where its heading stands twice."""
    text = headings[place] if headings.count(headings[place]) == 1 else f"#{place + 1}"
    unit = "" if meaning is None else meaning.unit
    return text if unit in {"", parse_heading(headings[place]).unit} else f"{text}[{unit}]"


def _that_read(
    likely: dict[str, list[str]], can_read: Callable[[ColumnMap], bool]
) -> dict[str, list[str]]:
    """Return the columns of the combinations that read the file; {} if none does."""
    choices = [likely[name] if name in NEEDED else likely[name][:1] for name in likely]
    trials = (dict(zip(likely, each, strict=True)) for each in product(*choices))
    # At most 24, as each reads the beginning of the file.
    read = [trial for trial in islice(trials, 24) if can_read(ColumnMap(trial))]
    found = {name: [*dict.fromkeys(trial[name] for trial in read)] for name in likely}
    return found if read else {}


def choose_columns(
    headings: Sequence[str], units_below: Sequence[str] = (), given: ColumnMap | None = None
) -> Choice:
    """Choose the columns of a table: the user's first, then the canonical or plain headings.

    Raises
    ------
    InputError
        If a column of the user is not in the table, or is named for two quantities.
    """
    units = [*units_below, *repeat("", len(headings))]
    meanings = [*map(meaning_of, headings, units)]
    canonical = None if given else _canonical(headings, units, meanings)
    if canonical is not None:
        return canonical
    choice, stated = Choice(), given or ColumnMap()
    for quantity in stated.texts:
        column = _given_column(quantity, stated, headings, meanings)
        for other, chosen in choice.chosen.items():
            if not set(column.places).isdisjoint(chosen.places):
                cure = "give each quantity a column of its own, as headings or as #1, #2, …"
                raise stated.error(quantity, f"is the column of {other} too", cure)
        choice.chosen[quantity] = column
    taken = {place for column in choice.chosen.values() for place in column.places}
    found: dict[str, list[_Found]] = {quantity: [] for quantity in FIELDS}
    for place, meaning in enumerate(meanings):
        if meaning is not None and place not in taken and meaning.quantity not in choice.chosen:
            found[meaning.quantity].append((place, meaning))
    for quantity, columns in found.items():
        columns.sort(key=_rank)
        if columns:
            _choose(quantity, columns, headings, choice)
    return choice


def _rank(found: _Found) -> Rank:
    return found[1].rank


def _canonical(
    headings: Sequence[str], units: Sequence[str], meanings: Sequence[Meaning | None]
) -> Choice | None:
    """Return the columns with the names of a canonical log; None if the table is another one.

    A temperature of another name is not a missing one, and a row of units may contradict the
    names: such a table is a logger's own.
    """
    names = [_simple(heading) for heading in headings]
    if not set(names).issuperset(REQUIRED[:3]):
        return None
    chosen = {
        quantity: ChosenColumn((names.index(name),), QUANTITIES[quantity].unit)
        for quantity, name in FIELDS.items()
        if name in names
    }
    if "temperature" not in chosen:
        others = zip(names, meanings, strict=True)
        if any(each and each.quantity == "temperature" and name != SOURCE for name, each in others):
            return None
    stated = ((FIELDS[name], units[each.places[0]].strip("()[]")) for name, each in chosen.items())
    is_canonical = all(unit_of(*each) in {None, (1.0, 0.0)} for each in stated)
    return Choice(chosen, is_canonical=True) if is_canonical else None


def refuse_odd_names(headings: Sequence[str], source: str) -> None:
    """Raise InputError if two columns have a name of the canonical log."""
    names = [_simple(heading) for heading in headings]
    for name in (*FIELDS.values(), SOURCE):
        refuse_doubled(name, names, source)


def refuse_doubled(name: str, names: Sequence[str], source: str | None) -> None:
    """Raise InputError if several columns have a name."""
    count = list(names).count(name)
    if count > 1:
        problem = f"{count} columns have this name"
        raise InputError(problem, source=source, field=name, cure="rename or drop all but one")


# --- By plain headings


def _choose(
    quantity: str, found: Sequence[_Found], headings: Sequence[str], choice: Choice
) -> None:
    """Choose among the columns of a quantity, the most direct first; or guess."""
    _, first = found[0]
    best = [item for item in found if item[1].rank == first.rank]
    is_sure = len(best) == 1
    most = min(first.rank, Rank.GUESS)
    if quantity == "time":
        best, is_sure = best[:1], True
    elif quantity == "temperature":
        best = _probes(best)
        is_sure = len(best) == 1 or all(meaning.numbered for _, meaning in best)
    elif quantity != "soc" and first.numbered:  # one of several that differ by their numbers
        numbered = [meaning.numbered for _, meaning in found if meaning.rank <= Rank.GUESS]
        if sum(numbered) > 1:
            is_sure, most = False, Rank.GUESS
    pair = _directions(headings, found) if quantity == "current" else None
    if pair is not None:
        choice.chosen[quantity] = pair
    elif is_sure and first.rank < Rank.GUESS:
        places = tuple(place for place, _ in best)
        others = tuple(found[1:]) if quantity == "time" else ()
        _, meaning = best[0]
        choice.chosen[quantity] = ChosenColumn(
            places, meaning.unit, source=meaning.source, others=others
        )
    else:
        choice.guesses[quantity] = [item for item in found if item[1].rank <= most]


def _probes(best: list[_Found]) -> list[_Found]:
    """Return the temperatures of one unit, °C first; T beside T1, T2 is it."""
    celsius = [item for item in best if unit_of("temperature_c", item[1].unit) == (1.0, 0.0)]
    best = celsius or [item for item in best if item[1].unit == best[0][1].unit]
    return [item for item in best if not item[1].numbered] or best


def _directions(headings: Sequence[str], found: Sequence[_Found]) -> ChosenColumn | None:
    """Return the currents of discharge and charge, in this order, if they alone are plain."""
    pairs: dict[tuple[str, str], dict[bool, int]] = {}
    for place, meaning in found:
        heading = parse_heading(headings[place])
        rest = _simple(heading.name.replace(heading.way, "")) if heading.way else ""
        without = meaning_of(rest, heading.unit) if heading.way else meaning
        if without is None or without.quantity != "current" or without.rank >= Rank.GUESS:
            continue
        pairs.setdefault((rest, meaning.unit), {})[heading.is_discharge] = place
    if len(pairs) != 1:
        return None
    ((_, unit), places), *_ = pairs.items()
    return ChosenColumn((places[True], places[False]), unit) if len(places) == 2 else None


# --- By the user


def _given_column(
    quantity: str, given: ColumnMap, headings: Sequence[str], meanings: Sequence[Meaning | None]
) -> ChosenColumn:
    for heading, stated, factor in meant_by(given.texts[quantity]):
        places = _places(heading, headings, is_joined=quantity in _JOINED)
        if not places:
            continue
        units = sorted({_stated_unit(headings[k], meanings[k], quantity) for k in places})
        is_mixed = len({unit_of("temperature_c", unit or "C") for unit in units}) > 1
        if quantity == "temperature" and stated is None and is_mixed:
            shown = ", ".join(unit or "none" for unit in units)
            problem = f"the headings have different units: {shown}"
            raise given.error(quantity, problem, "name columns of one unit")
        unit = units[0] if len(units) == 1 else ""
        first = meanings[places[0]] if quantity == "temperature" else None
        return ChosenColumn(
            places,
            unit if stated is None else stated,
            factor,
            source="unknown" if first is None else first.source,
            is_stated=stated is not None or factor != 1.0,
        )
    near = closest(given.texts[quantity], headings)
    problem = f"no column has this heading (found: {shown_headings(headings)})"
    raise given.error(quantity, problem, f"did you mean {near}?" if near else SYNTAX)


def _stated_unit(heading: str, meaning: Meaning | None, quantity: str) -> str:
    """Return the unit of this quantity that a heading states, whatever its words; "" if none."""
    if meaning is not None and meaning.quantity == quantity:
        return meaning.unit
    unit = parse_heading(heading).unit
    return "" if unit_of(FIELDS[quantity], unit) is None else unit


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
    name = _simple(text)
    names = [_simple(heading) for heading in headings]
    if name in names:
        return names.index(name)
    number = re.fullmatch(r"#(\d{1,5})", text.strip())
    if number and 1 <= int(number[1]) <= len(headings):
        return int(number[1]) - 1
    bare = [_simple(parse_heading(heading).name) for heading in headings]
    return bare.index(name) if bare.count(name) == 1 else None


def _simple(text: str) -> str:
    return " ".join(text.split()).casefold()


def shown_headings(headings: Sequence[str]) -> str:
    """Return the first headings of a table for a message."""
    names = [name for name in headings if name]
    more = f", … ({len(names)} in all)" if len(names) > 12 else ""
    return ", ".join(names[:12]) + more

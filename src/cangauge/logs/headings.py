"""Which column of a table is what: meaning of its headings, and the user's own `columns`.

A heading is *plain* if its words name a quantity and nothing contradicts it: `Time [s]`,
`Pack Current (A)`, `Ecell/V`, `Spannung [mV]`, `v.b.soc`. Words that make it another quantity
(`Step Time`, `Max Cell Voltage`, `Motor Current`) exclude it; words that are not known leave it to
the user. Columns of the user come first, the rest is taken from plain headings.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

from cangauge._io import MAX_HEADING
from cangauge.errors import InputError, closest
from cangauge.logs.units import FOREIGN_UNITS, TemperatureSource, unit_of

Quantity = Literal["time", "current", "voltage", "temperature", "soc"]

FIELDS: Final[dict[str, str]] = {
    "time": "time_s",
    "current": "current_a",
    "voltage": "voltage_v",
    "temperature": "temperature_c",
    "soc": "soc_pct",
}
"""Canonical field by the name that users write."""

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
        Where a temperature is measured, as far as its heading tells.
    others : tuple of int
        Further time columns, in case that the first does not increase.
    """

    places: tuple[int, ...]
    unit: str = ""
    factor: float = 1.0
    given: bool = False
    source: TemperatureSource = "unknown"
    others: tuple[int, ...] = ()


# --- Meaning of a heading


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


_PACK: Final = _words(
    "pack packs batt bat battery batterie batteries akku accu hv hvb hvbatt traction "
    "traktion bms ess storage"
)
_NEUTRAL: Final = _words(
    "mid measured meas actual act value val signal avg average mean total tot sum dc "
    "instant inst live real now main ch channel ist mess wert messwert system sys "
    "device ctrl v b var the of in raw data test rec record id sensor usable bus line "
    "overall current present"
)
_CELL: Final = _words("cell cells module mod zelle zellen zell string display displayed dash")
_AMBIENT: Final = _words(
    "ambient chamber room environment env umgebung raum kammer lab oven klimakammer"
)
_EXCLUDED: Final = _words(
    "hr hrs hour hours ah wh kwh capacity cap energy power watt watts index count "
    "counter number rate change delta diff dv di dt dq std stdev error err limit lim "
    "max maximum maximal min minimum minimal peak set setpoint target soll request "
    "requested req nominal rated charger charging motor inverter dcdc phase ac aux "
    "auxiliary starter solar pv panel load grid mains 12 lv gps step cycle loop "
    "schritt zyklus remaining resistance impedance acr control cutoff alarm warning "
    "fault status flag type mode enabled offset gain speed torque rpm cabin outside "
    "outdoor air mos mosfet fet board pcb coolant inlet outlet water oil engine "
    "heater fan pump lowest highest low high upper lower cmd command ref reference"
)
_TIME_EXCLUDED: Final = _words(
    "charge discharge charging remaining rest pause left on off spent estimated eta "
    "full empty minutes to"
)
_ELAPSED: Final = _words(
    "test total elapsed epoch unix run runtime relative rel prog program programm "
    "since start log 总 测试"
)
_WORDS: Final[dict[str, frozenset[str]]] = {
    "time": _words(
        "time zeit timestamp timestamps datetime date datum elapsed tiempo tempo seconds "
        "sec clock uhrzeit stamp changed 时间 总时间 测试时间 日期 绝对时间"
    ),
    "current": _words(
        "current amps amp ampere amperes strom courant corriente corrente stroom curr 电流 "
        "ibat ibatt ipack ihv"
    ),
    "voltage": _words(
        "voltage volt volts spannung tension voltaje tensione spanning 电压 vbat vbatt ubat "
        "ubatt upack vpack uhv ecell ewe potential"
    ),
    "temperature": _words(
        "temperature temp temps temperatur temperatura temperatuur 温度 tbat tbatt tpack tcell"
    ),
    "soc": _words("soc rsoc usoc ladezustand ladestand"),
}
_DATES: Final = frozenset({"date", "datum", "日期"})
_DATE_ONLY: Final = "(date)"
_STEMS: Final = {
    "time": ("time", "zeit", "stamp", "date"),
    "current": ("curr", "amp", "strom", "ibat"),
    "voltage": ("volt", "spann", "ubat", "vbat"),
    "temperature": ("temp",),
    "soc": ("soc", "charge"),
}
_GUESSED_AT_MOST: Final = 500
_SYMBOLS: Final = {"i": "current", "u": "voltage", "v": "voltage", "e": "voltage", "t": "time"}
_TOKEN: Final = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W\d_A-Za-z]+")
_BRACKETS: Final = re.compile(r"^(?P<name>.*?)[\s_]*[\[({](?P<unit>[^\[\](){}]*)[\])}]?\s*$")
_SLASH: Final = re.compile(r"^(?P<name>.+?)\s*/\s*(?P<unit>[^/\s]+)\s*$")
_TAIL: Final = re.compile(r"^(?P<name>.*\S?)(?:,\s*|__|_|\s+)(?P<unit>[^\s_,]+)\s*$")
_CLOCK: Final = re.compile(r"^h+\s*:\s*m", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Meaning:
    """What a heading says.

    Parameters
    ----------
    quantity : str
        time, current, voltage, temperature or soc.
    unit : str
        "" if not stated.
    rank : int
        0: the pack's; higher: less direct; `GUESS` or more: not plain.
    numbered : bool
        One of several sensors (`T1`, `Temp 3`).
    source : str
        Where a temperature is measured.
    """

    quantity: str
    unit: str
    rank: int
    numbered: bool = False
    source: TemperatureSource = "unknown"


GUESS: Final = 10
"""Rank from which a meaning is a guess that only the user can confirm."""


def meaning_of(heading: str, unit_below: str = "") -> Meaning | None:
    """Return the most direct meaning of a heading, or None.

    Parameters
    ----------
    heading : str
    unit_below : str
        Cell of a row of units below the header; "" without one.
    """
    if not heading.strip() or len(heading) > MAX_HEADING:
        return None
    # Measurement tools qualify a signal: `Bus::Message::Signal`, `Signal\\Device:1`.
    heading = re.sub(r"\\[^\[(]*", "", heading.rpartition("::")[2])
    for name, unit in _splits(heading, unit_below):
        found = _meaning(name, unit)
        if found is not None:
            return found
    return None


def _splits(heading: str, unit_below: str) -> list[tuple[str, str]]:
    """Return (name, unit) as the heading may be meant, the most explicit first."""
    found = []
    if unit_below.strip():
        found.append((heading, unit_below.strip().strip("[](){}").strip()))
    for pattern in (_BRACKETS, _SLASH, _TAIL):
        match = pattern.match(heading.strip())
        if match is not None and match["name"].strip():
            found.append((match["name"], match["unit"].strip()))
    return [*found, (heading, "")]


def _bracketed(name: str) -> list[str]:
    """Return the texts in brackets, and a text after a slash, in lower case."""
    found = re.findall(r"[\[(]([^\[\]()]*)[\])]", name)
    tail = name.rpartition("/")[2] if "/" in name else ""
    return [text.strip().lower() for text in (*found, tail) if text.strip()]


def tokens_of(name: str) -> list[str]:
    """Return the words of a heading in lower case, without accents; camel case is split."""
    plain = unicodedata.normalize("NFKD", name.replace("SoC", "Soc").replace("SOC", "Soc"))
    plain = "".join(char for char in plain if not unicodedata.combining(char))
    return [token.lower() for token in _TOKEN.findall(plain)]


def _meaning(name: str, unit: str) -> Meaning | None:
    """Return the meaning of a name with this unit; None if the unit belongs to another quantity."""
    tokens = tokens_of(name)
    quantity, rest = _quantity(tokens, name, unit)
    if quantity is None:
        return None
    if quantity == "time" and _CLOCK.match(unit):
        unit = ""
    if unit and unit_of(FIELDS[quantity], unit) is None:
        return None
    if not unit and any(each in FOREIGN_UNITS for each in _bracketed(name)):
        return None
    return Meaning(quantity, unit, *_rank(quantity, rest))


def _quantity(tokens: list[str], name: str, unit: str) -> tuple[str | None, list[str]]:
    """Return the quantity that the words name, and the other words."""
    text = " ".join(tokens)
    for phrase in ("state of charge", "charge level", "battery level"):
        if phrase in text:
            return "soc", text.replace(phrase, "").split()
    named = {each for each, words in _WORDS.items() if words.intersection(tokens)}
    if "temps" in tokens and unit_of("time_s", unit):  # French
        named = {"time"}
    if len(named) > 1 and "current" in tokens:  # also an adjective
        named.discard("current")
    if len(named) > 1:
        named.discard("time")  # the instant of anything
    if len(named) == 1:
        quantity = named.pop()
        words = _WORDS[quantity] | ({"temps"} if quantity == "time" else set())
        others = [token for token in tokens if token not in words]
        if quantity == "time" and len(others) < len(tokens) and set(tokens) <= _DATES:
            others.append(_DATE_ONLY)
        return quantity, others
    if named:
        return None, tokens
    if tokens and unit and unit_of("time_s", unit) and set(tokens) <= _ELAPSED:
        return "time", tokens
    return _symbol(tokens, name, unit)


def _symbol(tokens: list[str], name: str, unit: str) -> tuple[str | None, list[str]]:
    """Return the quantity of a formula letter that stands alone or with a word for the pack."""
    symbols = [token for token in tokens if token in _SYMBOLS]
    others = [token for token in tokens if token not in _SYMBOLS]
    if len(symbols) != 1 or not all(each in _PACK | _CELL or each.isdigit() for each in others):
        return None, tokens
    quantity = _SYMBOLS[symbols[0]]
    if symbols == ["t"]:
        is_time = bool(unit_of("time_s", unit)) if unit else name.strip() == "t"
        quantity = "time" if is_time else "temperature"
    return quantity, others


def _rank(quantity: str, rest: list[str]) -> tuple[int, bool, TemperatureSource]:
    """Return rank, whether the sensor is numbered, and where a temperature is measured."""
    words = {token for token in rest if not token.isdigit()}
    if quantity == "time":
        return _rank_of_time(words), False, "unknown"
    numbered = len(words) < len(set(rest))
    source: TemperatureSource = "unknown"
    if quantity == "temperature":
        source = "room" if words & _AMBIENT else "pack" if words & _PACK else "unknown"
        source = "cell" if words & _CELL else source
        words -= {"t", "probe", "sensor", "ntc"}
    is_one = not numbered or quantity == "temperature" or bool(words & _PACK) or "1" in rest
    unknown = words - _PACK - _NEUTRAL - _CELL - _AMBIENT
    if words & _EXCLUDED or "12" in rest:
        rank = GUESS + 1
    elif words & _AMBIENT:
        rank = 4 if quantity == "temperature" else GUESS
    elif (unknown and not words & _PACK) or not is_one:
        rank = GUESS
    elif unknown or (numbered and quantity != "temperature"):
        rank = 3
    else:
        rank = 2 if words & _CELL else 0 if words & _PACK else 1
    return rank, numbered, source


def _rank_of_time(words: set[str]) -> int:
    if words & (_EXCLUDED | _TIME_EXCLUDED):
        return GUESS
    if words & _ELAPSED:
        return 0
    return 3 if words - _NEUTRAL - {_DATE_ONLY} else 2 if _DATE_ONLY in words else 1


# --- Choice of columns


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
        If a column of the user is not in the table.
    """
    below = [*units_below, *[""] * (len(headings) - len(units_below))]
    meanings = [meaning_of(text, unit) for text, unit in zip(headings, below, strict=False)]
    chosen: dict[str, ChosenColumn] = {}
    for quantity, spec in (given.specs if given else {}).items():
        where = given.where if given else ""
        chosen[quantity] = _given_column(quantity, spec, headings, meanings, where)
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
        return ChosenColumn((place,), first.unit, others=tuple(each for each, _ in best[1:]))
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


def stated_unit(heading: str, quantity: str) -> str:
    """Return the unit of this quantity that a heading states, whatever its words; "" if none."""
    for _, unit in _splits(heading, "")[:-1]:
        if unit_of(FIELDS[quantity], unit) is not None:
            return unit
    return ""


def _places(text: str, headings: Sequence[str]) -> tuple[int, ...] | None:
    whole = _one_place(text, headings)
    if whole is not None:
        return (whole,)
    parts = [_one_place(part, headings) for part in text.split("+")]
    found = tuple(place for place in parts if place is not None)
    return found if len(found) == len(parts) > 1 else None


def _one_place(text: str, headings: Sequence[str]) -> int | None:
    wanted = _simple(text)
    names = [_simple(heading) for heading in headings]
    if wanted in names:
        return names.index(wanted)
    if (match := _NUMBER.match(text.strip())) and 1 <= int(match["number"]) <= len(headings):
        return int(match["number"]) - 1
    bare = [_simple(_splits(heading, "")[0][0]) for heading in headings]
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

"""Meaning of a table's heading: which quantity, in which unit, how directly.

A heading is *plain* if its words name a quantity and nothing contradicts it: `Time [s]`,
`Pack Current (A)`, `Ecell/V`, `Spannung [mV]`, `v.b.soc`. Words that make it another quantity
(`Step Time`, `Max Cell Voltage`, `Motor Current`) exclude it; words that are not known leave it to
the user. The words are those of `quantities.toml`.
"""

from __future__ import annotations

import re
import unicodedata
from enum import IntEnum
from functools import lru_cache
from typing import Final, NamedTuple

from cangauge.logs.quantities import QUANTITIES, WORDS
from cangauge.logs.stamps import is_time_format
from cangauge.settings import TemperatureSource

LONGEST: Final = 200
"""Longest heading that is read for its meaning [characters]."""
_TOKEN: Final = re.compile(
    r"[RU]?S[oO]C|[A-Z]+(?![a-z])"
    # German and Dutch write one word: `Batteriespannung`, `Zelltemperatur`.
    r"|[A-Z]?[a-z]+?(?=(?:strom|spannung|temperatur|zeit|stroom|spanning)s?\b)"
    r"|[A-Z]?[a-z]+|\d+|[^\W\d_A-Za-z]+"
)
_UNIT_FORMS: Final = (
    re.compile(r"^(?P<name>.*?)[\s_]*[\[({](?P<unit>[^\[\](){}]*)[\])}]?\s*$"),
    re.compile(r"^(?P<name>.+?)\s*/\s*(?P<unit>[^/\s]+)\s*$"),
    re.compile(r"^(?P<name>.*\S?)(?:,\s*|__|_|\s+)(?P<unit>[^\s_,]+)\s*$"),
)
"""`Name [unit]`, `Name/unit`, `Name_unit`."""
_TIMES: Final = re.compile(r"[\s_*(]*x\s?(10+)\b\)?")
"""`Voltage x100`: the cells are a hundred times the voltage."""
_WAY: Final = re.compile(r"(?:dis?|de)?[-_ ]?(?:charg(?:ed|e|ing)|chg)", re.IGNORECASE)
_CELL_VOLTAGE: Final = re.compile(
    r"(?:cell|zelle)[\s_#-]*(?:voltage|volt|v|u)?[\s_#-]*0*(?P<number>\d{1,4})"
    r"[\s_]*(?:voltage|volts?)?[\s_]*[\[(]?(?P<unit>m?v)?[\])]?",
    re.IGNORECASE,
)
_LETTERS: Final = {
    letter: name for name, quantity in QUANTITIES.items() for letter in quantity.letters
}
_PHRASES: Final = [
    (f" {phrase} ", f" {min(quantity.words)} ")
    for quantity in QUANTITIES.values()
    for phrase in quantity.phrases
]
_SOURCES: Final[dict[TemperatureSource, str]] = {"cell": "cell", "room": "ambient", "pack": "pack"}
"""Words for the place where a temperature is measured."""
_UNKNOWN: Final[TemperatureSource] = "unknown"
_NO_UNITS: Final = frozenset({"1", "-", "d"})
"""Units that end a heading as other than a unit: `Sensor 1`."""
_CLOCK: Final = re.compile(r"h+\s*:\s*m", re.IGNORECASE)
"""What a heading of clock times has in place of a unit."""


class Heading(NamedTuple):
    """Parts of a heading: its name, the unit behind it, and the word for the way of a current.

    `way` is the part of the name that says that a current charges or discharges.
    """

    name: str
    unit: str
    way: str

    @property
    def is_discharge(self) -> bool:
        """Whether the word for the way is one of discharge."""
        return self.way[:1].lower() == "d"


class Rank(IntEnum):
    """How directly a heading names its quantity.

    From `GUESS` on it is not plain: only the user can confirm it.
    """

    DIRECT = 0
    BARE = 1
    PLAIN = 2
    DERIVED = 3
    PART = 4
    AMBIENT = 5
    GUESS = 10
    OTHER = 11


class Meaning(NamedTuple):
    """Meaning of a heading: its quantity, the unit that it states ("" if none) and how direct.

    `numbered`: one of several sensors. `source` is where a temperature is measured.
    """

    quantity: str
    unit: str
    rank: Rank
    numbered: bool = False
    source: TemperatureSource = _UNKNOWN


@lru_cache(maxsize=1 << 16)
def meaning_of(heading: str, unit_below: str = "") -> Meaning | None:
    """Return the most direct meaning of a heading with the cell of a row of units, or None."""
    if not heading.strip() or len(heading) > LONGEST or cell_number(heading) is not None:
        return None
    # Measurement tools qualify a signal: `Bus::Message::Signal`, `Signal\\Device:1`.
    heading = re.sub(r"\\[^\[(]*", "", heading.rpartition("::")[2])
    times = _TIMES.search(heading)
    if times is not None:
        found = meaning_of(heading.replace(times[0], " "), unit_below)
        if found is None:
            return None
        unit = found.unit or QUANTITIES[found.quantity].unit
        return found._replace(unit=f"{1.0 / float(times[1]):g}{unit}")
    meanings = (_meaning(name, unit) for name, unit in _readings(heading, unit_below))
    return next((meaning for meaning in meanings if meaning is not None), None)


def cell_number(heading: str) -> tuple[int, float] | None:
    """Return number and scale [V] of a cell's voltage (`cell_3_v`, `Cell 3 [mV]`), or None."""
    match = _CELL_VOLTAGE.fullmatch(heading.strip()) if len(heading) <= LONGEST else None
    if match is None:
        return None
    is_millivolts = (match["unit"] or "").lower() == "mv"
    return int(match["number"]), 1e-3 if is_millivolts else 1.0


def charge_scale(heading: str, unit_below: str = "") -> float | None:
    """Return the factor to Ah of a column that counts charge, or None (`Consumed Ah`, `[mAh]`)."""
    name, unit, _ = parse_heading(heading, unit_below)
    words = [unit.lower().replace(".", ""), *_words_of(name)]
    if "mah" in words:
        return 1e-3
    is_count = not WORDS["charge"].isdisjoint(words) or {"amp", "hours"}.issubset(words)
    return 1.0 if is_count else None


def parse_heading(heading: str, unit_below: str = "") -> Heading:
    """Return the parts of a heading, or of one with the cell of a row of units.

    Examples
    --------
    >>> parse_heading("HVBatt_charge_current__mA")
    Heading(name='HVBatt_charge_current_', unit='mA', way='charge')
    """
    readings = _readings(heading, unit_below)
    name, unit = next((each for each in readings if _is_unit(each[1])), readings[-1])
    match = _WAY.search(name[:LONGEST])
    return Heading(name, unit, match[0] if match else "")


def _readings(heading: str, unit_below: str = "") -> list[tuple[str, str]]:
    """Return (name, unit) as a heading may be meant, the most explicit first, the whole last."""
    heading = heading.strip()
    if heading.lower() in WORDS["degrees"] or heading.lower() == "millis":
        return [("", heading)]
    if len(heading) > LONGEST:
        return [(heading, "")]
    found = []
    for form in _UNIT_FORMS:
        match = form.match(heading)
        if match and match["name"].strip():
            found.append((match["name"], match["unit"].strip()))
    below = unit_below.strip().strip("[](){}").strip()
    if below:  # instead of the heading's own unit, as in `Pack_V`
        names = [name for name, unit in found if _is_unit(unit)]
        found = [(name, below) for name in (*names, heading)] + found
    return [*found, (heading, "")]


def _is_unit(text: str) -> bool:
    if text.lower().replace(".", "") in WORDS["foreign_units"]:
        return True
    return text not in _NO_UNITS and any(each.scale_of(text) for each in QUANTITIES.values())


def _words_of(name: str) -> list[str]:
    """Return the words of a name in lower case, without accents; a phrase as one word."""
    plain = unicodedata.normalize("NFKD", name)
    letters = (char for char in plain if not unicodedata.combining(char))
    text = f" {' '.join(_TOKEN.findall(''.join(letters)))} ".lower()
    for phrase, word in _PHRASES:
        text = text.replace(phrase, word)
    return text.split()


def _meaning(name: str, unit: str) -> Meaning | None:
    """Return the meaning of a name with this unit; None if the unit belongs to another quantity."""
    words = _words_of(name)
    quantity = _quantity(words, name, unit)
    if quantity is None:
        return None
    of = QUANTITIES[quantity]
    names = of.words | (of.words_with_unit if of.scale_of(unit) else frozenset())
    others = {*words} - (_LETTERS.keys() if names.isdisjoint(words) else names)
    ticks = [word for word in words if word in WORDS["ticks"]]
    if quantity == "time":
        if _CLOCK.match(unit) and not is_time_format(unit):
            unit = ""
        if ticks and not unit:  # TimeUS
            unit = ticks[-1]
            others.discard(unit)
    if unit and of.scale_of(unit) is None and not (quantity == "time" and is_time_format(unit)):
        return None
    in_name = re.findall(r"[\[(]([^\[\]()]*)[\])]", name) + name.split("/")[1:]
    if not unit and any(_is_unit(text.strip().lower()) for text in in_name if text.strip()):
        return None  # of another quantity
    if quantity != "time":
        return _measured(quantity, unit, others)
    is_by_tick = bool(ticks) and of.words.isdisjoint(words)  # ms_today
    is_date = bool(words) and WORDS["date"].issuperset(words)
    return Meaning(quantity, unit, Rank.GUESS if is_by_tick else _rank_of_time(others, is_date))


def _quantity(words: list[str], name: str, unit: str) -> str | None:
    """Return the quantity that words name, or a unit or letter where no word does."""
    by_unit = [each for each, quantity in QUANTITIES.items() if unit and quantity.scale_of(unit)]
    for each in by_unit:
        if not QUANTITIES[each].words_with_unit.isdisjoint(words):
            return each
    named = {each for each, quantity in QUANTITIES.items() if not quantity.words.isdisjoint(words)}
    if len(named) > 1 and "current" in words:  # also an adjective
        named.discard("current")
    if len(named) > 1:
        named.discard("time")  # the instant of anything
    if named:
        return named.pop() if len(named) == 1 else None
    return _quantity_of_unit(words, unit, by_unit) or _quantity_of_letter(words, name, unit)


def _quantity_of_unit(words: list[str], unit: str, by_unit: list[str]) -> str | None:
    """Return the quantity of a unit alone, or with words for the pack or of a duration."""
    if unit.lower() in WORDS["degrees"]:
        return "temperature"
    if "time" in by_unit and WORDS["elapsed"].issuperset(words):
        return "time"
    is_of_pack = bool(words) and WORDS["pack"].issuperset(words)
    if is_of_pack and (len(unit) > 1 or unit == "%"):  # `pack_mv`; `Battery A` is one of several
        return next((each for each in by_unit if each != "time"), None)
    return None


def _quantity_of_letter(words: list[str], name: str, unit: str) -> str | None:
    """Return the quantity of a formula's letter, alone or with words for the pack, or of ticks."""
    letters = [word for word in words if word in _LETTERS]
    others = {word for word in words if word not in _LETTERS and not word.isdigit()}
    plain = WORDS["pack"] | WORDS["cell"] | WORDS["display"] | {"avg", "average", "mean"}
    is_last_of_pack = len(words) > 1 and words[-1] in _LETTERS and words[-2] in WORDS["pack"]
    if len(letters) == 1 and (plain >= others or is_last_of_pack):
        if letters != ["t"]:
            return _LETTERS[letters[0]]
        is_time = bool(QUANTITIES["time"].scale_of(unit)) if unit else name.strip() == "t"
        return "time" if is_time else "temperature"
    return "time" if not unit and WORDS["ticks"].intersection(words) else None  # ms_today


def _rank_of_time(words: set[str], is_date: bool) -> Rank:
    if is_date:
        return Rank.DERIVED
    if words & (WORDS["other"] | WORDS["extreme"] | WORDS["other_time"]):
        return Rank.GUESS
    if words & WORDS["elapsed"]:
        return Rank.DIRECT
    return Rank.PART if words - WORDS["neutral"] else Rank.PLAIN


def _measured(quantity: str, unit: str, words: set[str]) -> Meaning:
    """Return the meaning of a measured value with these other words."""
    named = {word for word in words if not word.isdigit()}
    is_numbered = len(named) < len(words)
    is_extreme = bool(named & WORDS["extreme"])
    is_temperature, source = quantity == "temperature", _UNKNOWN
    # A number makes it one of several values; above 1, only a word for the pack makes it sure.
    is_part, is_vague = is_numbered, is_numbered and "1" not in words
    if is_temperature:
        sources = (place for place, group in _SOURCES.items() if named & WORDS[group])
        source = next(sources, _UNKNOWN)
        if named & WORDS["auxiliary"]:
            named.add("battery")
            is_numbered = True
        named -= WORDS["probe"] | WORDS["auxiliary"] | WORDS["extreme"]
        is_numbered = is_numbered or is_extreme
        is_part, is_vague = is_extreme, is_extreme and not named & WORDS["cell"]
    of_cells = WORDS["cell"] | WORDS["display"]
    is_of_pack = bool(named & WORDS["pack"])
    has_unknown = bool(named - WORDS["pack"] - WORDS["neutral"] - WORDS["ambient"] - of_cells)
    if named & WORDS["other"] or "12" in words or (is_extreme and not is_temperature):
        rank = Rank.OTHER
    elif named & WORDS["ambient"]:
        rank = Rank.AMBIENT if is_temperature else Rank.GUESS
    elif not is_of_pack and (has_unknown or is_vague):
        rank = Rank.GUESS
    elif has_unknown or is_part:
        rank = Rank.PART
    elif named & (of_cells | WORDS["derived"]):
        rank = Rank.DERIVED
    elif is_of_pack:
        rank = Rank.DIRECT
    else:
        rank = Rank.PLAIN if named else Rank.BARE
    return Meaning(quantity, unit, rank, is_numbered, source)

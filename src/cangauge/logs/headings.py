"""Meaning of a table's heading: which quantity, in which unit, how directly.

A heading is *plain* if its words name a quantity and nothing contradicts it: `Time [s]`,
`Pack Current (A)`, `Ecell/V`, `Spannung [mV]`, `v.b.soc`. Words that make it another quantity
(`Step Time`, `Max Cell Voltage`, `Motor Current`) exclude it; words that are not known leave it to
the user. The words are those of `headings.toml`.
"""

from __future__ import annotations

import re
import tomllib
import unicodedata
from enum import IntEnum
from functools import lru_cache
from pathlib import Path
from typing import Final, NamedTuple

from cangauge.logs.units import CANONICAL_UNIT, FIELDS, FOREIGN_UNITS, unit_of
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
_CELL_VOLTAGE: Final = re.compile(
    r"(?:cell|zelle)[\s_#-]*(?:voltage|volt|v|u)?[\s_#-]*0*(?P<number>\d{1,4})"
    r"[\s_]*(?:voltage|volts?)?[\s_]*[\[(]?(?P<unit>m?v)?[\])]?",
    re.IGNORECASE,
)
_LETTERS: Final = {"i": "current", "u": "voltage", "v": "voltage", "e": "voltage", "t": "time"}
"""Quantities by their letter in formulas; a `T` is a temperature."""


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
    source: TemperatureSource = "unknown"


def _vocabulary() -> tuple[dict[str, frozenset[str]], dict[str, frozenset[str]]]:
    """Return the words of `headings.toml`: of quantities, and what others say of one."""
    text = Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")
    quantities, qualifiers = (
        {name: frozenset(words.split()) for name, words in table.items()}
        for table in tomllib.loads(text).values()
    )
    return quantities, qualifiers


_QUANTITIES, _SAYS = _vocabulary()


@lru_cache(maxsize=1 << 16)
def meaning_of(heading: str, unit_below: str = "") -> Meaning | None:
    """Return the most direct meaning of a heading with the cell of a row of units, or None."""
    if not heading.strip() or len(heading) > LONGEST or cell_number(heading) is not None:
        return None
    # Measurement tools qualify a signal: `Bus::Message::Signal`, `Signal\\Device:1`.
    heading = re.sub(r"\\[^\[(]*", "", heading.rpartition("::")[2])
    times = _TIMES.search(heading)
    if times is None:
        return _first_meaning(names_and_units(heading, unit_below))
    found = meaning_of(heading.replace(times[0], " "), unit_below)
    if found is None:
        return None
    unit = found.unit or CANONICAL_UNIT[found.quantity]
    return found._replace(unit=f"{1.0 / float(times[1]):g}{unit}")


def cell_number(heading: str) -> tuple[int, float] | None:
    """Return number and scale [V] of a cell's voltage (`cell_3_v`, `Cell 3 [mV]`), or None."""
    match = _CELL_VOLTAGE.fullmatch(heading.strip()) if len(heading) <= LONGEST else None
    if match is None:
        return None
    is_millivolts = (match["unit"] or "").lower() == "mv"
    return int(match["number"]), 1e-3 if is_millivolts else 1.0


def charge_scale(heading: str, unit_below: str = "") -> float | None:
    """Return the factor to Ah of a column that counts charge, or None (`Consumed Ah`, `[mAh]`)."""
    units = [unit.lower() for _, unit in names_and_units(heading, unit_below)]
    words = _words_of(heading) if len(heading) <= LONGEST else []
    if "mah" in units or "mah" in words:
        return 1e-3
    is_count = "ah" in units or not _SAYS["charge"].isdisjoint(words)
    return 1.0 if is_count or ("amp" in words and "hours" in words) else None


def names_and_units(heading: str, unit_below: str = "") -> list[tuple[str, str]]:
    """Return (name, unit) as a heading may be meant, the most explicit first, the whole last."""
    heading = heading.strip()
    if heading.lower() in _SAYS["degrees"] or heading.lower() == "millis":
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
    if text.lower() in FOREIGN_UNITS:
        return True
    return text not in {"1", "-", "d"} and any(unit_of(field, text) for field in FIELDS.values())


def _first_meaning(readings: list[tuple[str, str]]) -> Meaning | None:
    meanings = (_meaning(name, unit) for name, unit in readings)
    return next((meaning for meaning in meanings if meaning is not None), None)


def _meaning(name: str, unit: str) -> Meaning | None:
    """Return the meaning of a name with this unit; None if the unit belongs to another quantity."""
    words = _words_of(name)
    quantity = _quantity(words, name, unit)
    if quantity is None:
        return None
    others = _others(words, quantity, unit)
    if quantity == "time":
        if re.match(r"h+\s*:\s*m", unit, re.IGNORECASE):
            unit = ""
        ticks = [word for word in others if word in _SAYS["ticks"]]
        if ticks and not unit:  # TimeUS
            unit = ticks[-1]
            others = [word for word in others if word != unit]
    if unit and unit_of(FIELDS[quantity], unit) is None:
        return None
    in_brackets = re.findall(r"[\[(]([^\[\]()]*)[\])]", name) + name.split("/")[1:]
    if not unit and any(_is_unit(text.strip().lower()) for text in in_brackets if text.strip()):
        return None  # of another quantity
    if quantity == "time":
        is_by_tick = bool(ticks) and _QUANTITIES["time"].isdisjoint(words)  # ms_today
        return Meaning(quantity, unit, Rank.GUESS if is_by_tick else _rank_of_time(set(others)))
    if quantity == "temperature":
        return _temperature(set(others), unit)
    return _of_pack(quantity, set(others), unit)


def _words_of(name: str) -> list[str]:
    """Return the words of a name in lower case, without accents."""
    plain = unicodedata.normalize("NFKD", name)
    letters = (char for char in plain if not unicodedata.combining(char))
    return [word.lower() for word in _TOKEN.findall("".join(letters))]


def _quantity(words: list[str], name: str, unit: str) -> str | None:
    """Return the quantity that words name, or a unit or letter where no word does."""
    if _soc_phrase(words):
        return "soc"
    if "temps" in words and unit_of("time_s", unit):  # French
        return "time"
    if "vol" in words and unit_of("voltage_v", unit):
        return "voltage"
    named = {quantity for quantity, known in _QUANTITIES.items() if known.intersection(words)}
    if len(named) > 1 and "current" in words:  # also an adjective
        named.discard("current")
    if len(named) > 1:
        named.discard("time")  # the instant of anything
    if named:
        return named.pop() if len(named) == 1 else None
    is_duration = bool(words and unit and unit_of("time_s", unit))
    if words == ["utc"] or (is_duration and _SAYS["elapsed"].issuperset(words)):
        return "time"
    return _quantity_of_letter(words, name, unit)


def _soc_phrase(words: list[str]) -> str:
    text = " ".join(words)
    phrases = ("state of charge", "charge level", "battery level")
    return next((phrase for phrase in phrases if phrase in text), "")


def _quantity_of_letter(words: list[str], name: str, unit: str) -> str | None:
    """Return the quantity of a unit, or of a formula letter alone or with a word for the pack."""
    if unit.lower() in _SAYS["degrees"]:
        return "temperature"
    if not name and unit:
        return "time"
    letters = [word for word in words if word in _LETTERS]
    others = [word for word in words if word not in _LETTERS]
    plain = _SAYS["pack"] | _SAYS["cell"] | _SAYS["display"] | {"avg", "average", "mean"}
    if len(letters) == 1 and all(word in plain or word.isdigit() for word in others):
        if letters != ["t"]:
            return _LETTERS[letters[0]]
        is_time = bool(unit_of("time_s", unit)) if unit else name.strip() == "t"
        return "time" if is_time else "temperature"
    if not unit and _SAYS["ticks"].intersection(words):  # ms_today
        return "time"
    return None


def _others(words: list[str], quantity: str, unit: str) -> list[str]:
    """Return the words beside those that name the quantity."""
    phrase = _soc_phrase(words)
    if phrase:
        return " ".join(words).replace(phrase, "").split()
    names = set(_QUANTITIES[quantity])
    if unit_of(FIELDS[quantity], unit):
        names |= {"temps", "vol"}
    if not names.intersection(words):
        return [word for word in words if word not in _LETTERS]
    is_date = _SAYS["date"].issuperset(words)
    return ["(date)"] if is_date else [word for word in words if word not in names]


def _rank_of_time(words: set[str]) -> Rank:
    if words & (_SAYS["other"] | _SAYS["extreme"] | _SAYS["other_time"]):
        return Rank.GUESS
    if words & _SAYS["elapsed"]:
        return Rank.DIRECT
    if words - _SAYS["neutral"] - {"(date)"}:
        return Rank.PART
    return Rank.DERIVED if "(date)" in words else Rank.PLAIN


def _of_pack(quantity: str, words: set[str], unit: str) -> Meaning:
    """Return the meaning of a current, voltage or SoC with these other words."""
    named = {word for word in words if not word.isdigit()}
    is_numbered = len(named) < len(words)
    is_of_pack = bool(named & _SAYS["pack"])
    known = ("pack", "neutral", "cell", "display")
    has_unknown = bool(named.difference(*(_SAYS[each] for each in known)))
    if named & (_SAYS["other"] | _SAYS["extreme"]) or "12" in words:
        rank = Rank.OTHER
    elif (
        named & _SAYS["ambient"]
        or (has_unknown and not is_of_pack)
        or (is_numbered and not is_of_pack and "1" not in words)
    ):
        rank = Rank.GUESS
    elif has_unknown or is_numbered:
        rank = Rank.PART
    elif named & (_SAYS["cell"] | _SAYS["display"] | _SAYS["derived"]):
        rank = Rank.DERIVED
    elif is_of_pack:
        rank = Rank.DIRECT
    else:
        rank = Rank.PLAIN if named else Rank.BARE
    return Meaning(quantity, unit, rank, is_numbered)


def _source(named: set[str]) -> TemperatureSource:
    """Return where a temperature is measured."""
    if named & _SAYS["cell"]:
        return "cell"
    if named & _SAYS["ambient"]:
        return "room"
    return "pack" if named & _SAYS["pack"] else "unknown"


def _temperature(words: set[str], unit: str) -> Meaning:
    """Return the meaning of a temperature with these other words: of a probe, or of the room."""
    named = {word for word in words if not word.isdigit()}
    is_numbered = len(named) < len(words)
    source = _source(named)
    named -= _SAYS["probe"]
    if named & _SAYS["auxiliary"]:  # a cycler's thermocouple
        named = named - _SAYS["auxiliary"] | {"battery"}
        is_numbered = True
    is_extreme = bool(named & _SAYS["extreme"])
    if is_extreme:  # the hottest and the coldest probe
        named -= _SAYS["extreme"]
        is_numbered = True
    is_of_pack = bool(named & _SAYS["pack"])
    known = ("pack", "neutral", "cell", "display", "ambient")
    has_unknown = bool(named.difference(*(_SAYS[each] for each in known)))
    if named & _SAYS["other"] or "12" in words:
        rank = Rank.OTHER
    elif named & _SAYS["ambient"]:
        rank = Rank.AMBIENT
    elif not is_of_pack and (has_unknown or (is_extreme and not named & _SAYS["cell"])):
        rank = Rank.GUESS
    elif has_unknown or is_extreme:
        rank = Rank.PART
    elif named & (_SAYS["cell"] | _SAYS["display"]):
        rank = Rank.DERIVED
    elif is_of_pack:
        rank = Rank.DIRECT
    else:
        rank = Rank.PLAIN
    return Meaning("temperature", unit, rank, is_numbered, source)

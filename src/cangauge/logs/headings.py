"""Meaning of a table's heading: which quantity, in which unit, how directly.

A heading is *plain* if its words name a quantity and nothing contradicts it: `Time [s]`,
`Pack Current (A)`, `Ecell/V`, `Spannung [mV]`, `v.b.soc`. Words that make it another quantity
(`Step Time`, `Max Cell Voltage`, `Motor Current`) exclude it; words that are not known leave it to
the user.
"""

from __future__ import annotations

import re
import unicodedata
from functools import lru_cache
from typing import Final, NamedTuple

from cangauge.logs.units import CANONICAL_UNIT, FIELDS, FOREIGN_UNITS, unit_of
from cangauge.settings import TemperatureSource


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


_PACK: Final = _words(
    "pack packs batt bat battery batterie batteries akku accu hv hvb hvbatt traction traktion bms"
    " ess storage ece"  # Ewe-Ece: the cell between its electrodes
)
_NEUTRAL: Final = _words(
    "terminal surface skin absolute abs mid measured meas actual act value val signal avg average"
    " mean total tot sum dc instant inst live real now main ch channel ist mess wert messwert"
    " system sys device ctrl v b var the of in raw data test rec record id sensor usable bus line"
    " overall current present averaged volume gesamt klemmen klemm"
)
_CELL: Final = _words("cell cells module mod zelle zellen zell string")
_DERIVED: Final = _words("avg average averaged mean mid raw")
_DISPLAY: Final = _words("display displayed disp dash dashboard anzeige")
_AMBIENT: Final = _words(
    "ambient chamber room environment env umgebung umgebungs raum kammer lab oven klimakammer"
)
_EXCLUDED: Final = _words(
    "hr hrs hour hours ah wh kwh capacity cap energy power watt watts index count counter number"
    " rate change delta diff dv di dt dq std stdev error err limit lim max maximum maximal min"
    " minimum minimal peak set setpoint target soll request requested req nominal rated charger"
    " charging motor inverter dcdc phase ac aux auxiliary starter solar pv panel load grid mains"
    " 12 lv gps step cycle loop schritt zyklus remaining resistance impedance acr control cutoff"
    " alarm warning fault status flag type mode enabled offset gain speed torque rpm cabin outside"
    " outdoor air mos mosfet fet board pcb coolant inlet outlet water oil engine heater fan pump"
    " lowest highest low high upper lower cmd command ref reference"
)
_TIME_EXCLUDED: Final = _words(
    "charge discharge charging remaining rest pause left on off spent estimated eta full empty"
    " minutes to"
)
_ELAPSED: Final = _words(
    "test total elapsed epoch unix run runtime relative rel prog program programm since start log"
    " 总 测试"
)
_WORDS: Final[dict[str, frozenset[str]]] = {
    "time": _words(
        "time realtime zeit timestamp timestamps datetime date datum elapsed tiempo tempo seconds"
        " sec clock uhrzeit stamp tstamp stempel zeitstempel tick ticks uptime"
        " changed 时间 总时间 测试时间 日期 绝对时间"
    ),
    "current": _words(
        "current cur amps amp ampere amperes strom courant corriente corrente stroom curr 电流"
        " ibat ibatt ipack ihv"
    ),
    "voltage": _words(
        "voltage volt volts spannung tension voltaje tensione spanning 电压 vbat vbatt ubat ubatt"
        " upack vpack uhv ecell ewe potential"
    ),
    "temperature": _words(
        "temperature temp temps temperatur temperatura temperatuur 温度 tbat tbatt tpack tcell"
    ),
    "soc": _words("soc rsoc usoc ladezustand ladestand"),
}
_BY_UNIT: Final = {"temps": "time", "vol": "voltage"}
"""Words that are another quantity's too (French; volume): the unit decides."""
_SOC: Final = re.compile(r"(?:\b[RU])?S[oO]C")
_DEGREES: Final = _words("celsius fahrenheit kelvin degc degf")
"""Units that name the quantity where no word does: `celsius`, `battery_celsius`."""
_SYMBOLS: Final = {"i": "current", "u": "voltage", "v": "voltage", "e": "voltage", "t": "time"}
_DATES: Final = frozenset({"date", "datum", "日期"})
_TOKEN: Final = re.compile(
    # German and Dutch write one word: `Batteriespannung`, `Zelltemperatur`.
    r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+?(?=(?:strom|spannung|temperatur|zeit|stroom|spanning)s?\b)"
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

LONGEST: Final = 200
"""Longest heading that is read for its meaning [characters]."""
GUESS: Final = 10
"""Rank from which a meaning is a guess that only the user can confirm."""


class Meaning(NamedTuple):
    """Meaning of a heading: its quantity, the unit that it states ("" if none) and how direct.

    `rank` is 0 for the pack's and higher for less direct ones; from `GUESS` on it is not plain.
    """

    quantity: str
    unit: str
    rank: int
    numbered: bool = False
    source: TemperatureSource = "unknown"


@lru_cache(maxsize=1 << 16)
def meaning_of(heading: str, unit_below: str = "") -> Meaning | None:
    """Return the most direct meaning of a heading with the cell of a row of units, or None."""
    if not heading.strip() or len(heading) > LONGEST or cell_number(heading) is not None:
        return None
    # Measurement tools qualify a signal: `Bus::Message::Signal`, `Signal\\Device:1`.
    heading = re.sub(r"\\[^\[(]*", "", heading.rpartition("::")[2])
    times = _TIMES.search(heading)
    if times:
        found = meaning_of(heading.replace(times[0], " "), unit_below)
        unit = found and (found.unit or CANONICAL_UNIT[found.quantity])
        return found and found._replace(unit=f"{1.0 / float(times[1]):g}{unit}")
    readings = (_meaning(name, unit) for name, unit in names_and_units(heading, unit_below))
    return next((found for found in readings if found is not None), None)


def cell_number(heading: str) -> tuple[int, float] | None:
    """Return number and scale [V] of a cell's voltage (`cell_3_v`, `Cell 3 [mV]`), or None."""
    match = _CELL_VOLTAGE.fullmatch(heading.strip()) if len(heading) <= LONGEST else None
    if match is None:
        return None
    return int(match["number"]), 1e-3 if (match["unit"] or "").lower() == "mv" else 1.0


def names_and_units(heading: str, unit_below: str = "") -> list[tuple[str, str]]:
    """Return (name, unit) as a heading may be meant, the most explicit first, the whole last."""
    heading = heading.strip()
    if heading.lower() in {*_DEGREES, "millis"}:
        return [("", heading)]
    if len(heading) > LONGEST:
        return [(heading, "")]
    matches = [match for form in _UNIT_FORMS if (match := form.match(heading))]
    found = [(match["name"], match["unit"].strip()) for match in matches if match["name"].strip()]
    below = unit_below.strip().strip("[](){}").strip()
    if below:  # instead of the heading's own unit, as in `Pack_V`
        names = [name for name, unit in found if _is_unit(unit)]
        found = [*((name, below) for name in (*names, heading)), *found]
    return [*found, (heading, "")]


def _is_unit(text: str) -> bool:
    if text.lower() in FOREIGN_UNITS:
        return True
    return text not in {"1", "-", "d"} and any(unit_of(field, text) for field in FIELDS.values())


def _meaning(name: str, unit: str) -> Meaning | None:
    """Return the meaning of a name with this unit; None if the unit belongs to another quantity."""
    plain = unicodedata.normalize("NFKD", _SOC.sub(lambda soc: soc[0].capitalize(), name))
    plain = "".join(char for char in plain if not unicodedata.combining(char))
    quantity, others = _quantity([word.lower() for word in _TOKEN.findall(plain)], name, unit)
    if quantity is None:
        return None
    if quantity == "time" and re.match(r"h+\s*:\s*m", unit, re.IGNORECASE):
        unit = ""
    if quantity == "time" and not unit and others and others[-1] in {"us", "ms"}:  # TimeUS
        unit, others = others[-1], others[:-1]
    if unit and unit_of(FIELDS[quantity], unit) is None:
        return None
    in_brackets = re.findall(r"[\[(]([^\[\]()]*)[\])]", name) + name.split("/")[1:]
    if not unit and any(_is_unit(text.strip().lower()) for text in in_brackets if text.strip()):
        return None  # of another quantity
    if quantity == "time":
        return Meaning(quantity, unit, _rank_of_time(set(others)))
    return Meaning(quantity, unit, *_rank(quantity, others))


def _quantity(words: list[str], name: str, unit: str) -> tuple[str | None, list[str]]:
    """Return the quantity that the words name, and the other words."""
    text = " ".join(words)
    for phrase in ("state of charge", "charge level", "battery level"):
        if phrase in text:
            return "soc", text.replace(phrase, "").split()
    named = {quantity for quantity, known in _WORDS.items() if known.intersection(words)}
    for word, quantity in _BY_UNIT.items():
        if word in words and unit_of(FIELDS[quantity], unit):
            named, words = {quantity}, [other for other in words if other != word]
    if len(named) > 1 and "current" in words:  # also an adjective
        named.discard("current")
    if len(named) > 1:
        named.discard("time")  # the instant of anything
    if len(named) == 1:
        quantity = named.pop()
        others = [word for word in words if word not in _WORDS[quantity]]
        return quantity, ["(date)"] if words and set(words) <= _DATES else others
    if named:
        return None, words
    is_elapsed = words and unit and unit_of("time_s", unit) and set(words) <= _ELAPSED
    if is_elapsed or words == ["utc"]:
        return "time", words
    return _symbol(words, name, unit)


def _symbol(words: list[str], name: str, unit: str) -> tuple[str | None, list[str]]:
    """Return the quantity of a unit, or of a formula letter alone or with a word for the pack."""
    if unit.lower() in _DEGREES:
        return "temperature", words
    if not name and unit:
        return "time", words
    symbols = [word for word in words if word in _SYMBOLS]
    others = [word for word in words if word not in _SYMBOLS]
    plain = _PACK | _CELL | _DISPLAY | {"avg", "average", "mean"}
    if len(symbols) != 1 or not all(word in plain or word.isdigit() for word in others):
        return None, words
    if symbols == ["t"]:
        is_time = bool(unit_of("time_s", unit)) if unit else name.strip() == "t"
        return "time" if is_time else "temperature", others
    return _SYMBOLS[symbols[0]], others


def _rank(quantity: str, others: list[str]) -> tuple[int, bool, TemperatureSource]:
    """Return rank, whether the sensor is numbered, and where a temperature is measured."""
    words = {word for word in others if not word.isdigit()}
    numbered = len(words) < len(set(others))
    is_temperature = quantity == "temperature"
    source: TemperatureSource = "unknown"
    if is_temperature:
        source = "room" if words & _AMBIENT else "pack" if words & _PACK else "unknown"
        source = "cell" if words & _CELL else source
        words -= {"t", "probe", "sensor", "ntc", "log"}
        if words & {"aux", "auxiliary"}:  # a cycler's thermocouple
            words, numbered = words - {"aux", "auxiliary"} | {"battery"}, True
    is_one = not numbered or is_temperature or bool(words & _PACK) or "1" in others
    unknown = words - _PACK - _NEUTRAL - _CELL - _DISPLAY - _AMBIENT
    if words & _EXCLUDED or "12" in others:
        return GUESS + 1, numbered, source
    if words & _AMBIENT:
        rank = 4 if is_temperature else GUESS
    elif (unknown and not words & _PACK) or not is_one:
        rank = GUESS
    elif unknown or (numbered and not is_temperature):
        rank = 3
    else:
        less = _CELL | _DISPLAY | (frozenset() if is_temperature else _DERIVED)
        rank = 2 if words & less else 0 if words & _PACK else 1
    return rank, numbered, source


def _rank_of_time(words: set[str]) -> int:
    if words & (_EXCLUDED | _TIME_EXCLUDED):
        return GUESS
    if words & _ELAPSED:
        return 0
    return 3 if words - _NEUTRAL - {"(date)"} else 2 if "(date)" in words else 1

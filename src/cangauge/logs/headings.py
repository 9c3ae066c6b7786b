"""Meaning of a table's heading: which quantity, in which unit, how directly.

A heading is *plain* if its words name a quantity and nothing contradicts it: `Time [s]`,
`Pack Current (A)`, `Ecell/V`, `Spannung [mV]`, `v.b.soc`. Words that make it another quantity
(`Step Time`, `Max Cell Voltage`, `Motor Current`) exclude it; words that are not known leave it to
the user.
"""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass
from typing import Final, Literal

from cangauge._io import MAX_HEADING
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


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


_PACK: Final = _words(
    "pack packs batt bat battery batterie batteries akku accu hv hvb hvbatt traction "
    "traktion bms ess storage"
)
_NEUTRAL: Final = _words(
    "terminal surface skin absolute abs mid measured meas actual act value val signal avg "
    "average mean total tot sum dc instant inst live real now main ch channel ist mess wert "
    "messwert system sys device ctrl v b var the of in raw data test rec record id sensor "
    "usable bus line overall current present averaged volume gesamt klemmen klemm"
)
_CELL: Final = _words("cell cells module mod zelle zellen zell string")
_DISPLAY: Final = _words("display displayed disp dash dashboard anzeige")
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
        "time realtime zeit timestamp timestamps datetime date datum elapsed tiempo tempo seconds "
        "sec clock uhrzeit stamp zeitstempel changed 时间 总时间 测试时间 日期 绝对时间"
    ),
    "current": _words(
        "current cur amps amp ampere amperes strom courant corriente corrente stroom curr 电流 "
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
_ABBREVIATED: Final = {"temps": "time", "vol": "voltage"}
"""Words that are another quantity's too (French; volume): the unit decides."""
_COMPOUND: Final = re.compile(
    r"(\w{3,}?)(strom|spannung|temperatur|zeit|stroom|spanning|temperatuur)"
)
"""A Germanic noun whose last word is the quantity: `Batteriespannung`, `Motorstrom`."""
_TEMPERATURE_UNITS: Final = _words("celsius fahrenheit kelvin degc degf")
"""Units that name the quantity where no word does: `celsius`, `battery_celsius`."""
_AUXILIARY: Final = frozenset({"aux", "auxiliary"})
_PACK_WORD: Final = frozenset({"battery"})
_MEAN: Final = frozenset({"avg", "average", "mean"})
_DATES: Final = frozenset({"date", "datum", "日期"})
_DATE_ONLY: Final = "(date)"
_PLACES: Final = _PACK | _NEUTRAL | _CELL | _DISPLAY | _AMBIENT
_FIRST_PARTS: Final = _PLACES | _EXCLUDED | _TIME_EXCLUDED | _ELAPSED
_SYMBOLS: Final = {"i": "current", "u": "voltage", "v": "voltage", "e": "voltage", "t": "time"}
_TOKEN: Final = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W\d_A-Za-z]+")
_BRACKETS: Final = re.compile(r"^(?P<name>.*?)[\s_]*[\[({](?P<unit>[^\[\](){}]*)[\])}]?\s*$")
_SLASH: Final = re.compile(r"^(?P<name>.+?)\s*/\s*(?P<unit>[^/\s]+)\s*$")
_TAIL: Final = re.compile(r"^(?P<name>.*\S?)(?:,\s*|__|_|\s+)(?P<unit>[^\s_,]+)\s*$")
_CLOCK: Final = re.compile(r"^h+\s*:\s*m", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Meaning:
    """Meaning of a heading.

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
    if heading.strip().lower() in _TEMPERATURE_UNITS:
        return [("", heading.strip())]
    found = []
    for pattern in (_BRACKETS, _SLASH, _TAIL):
        match = pattern.match(heading.strip())
        if match is not None and match["name"].strip():
            found.append((match["name"], match["unit"].strip()))
    below = unit_below.strip().strip("[](){}").strip()
    if below:  # instead of the heading's own unit, as in `Pack_V`
        names = [name for name, unit in found if _is_unit(unit)]
        found = [*((name, below) for name in (*names, heading)), *found]
    return [*found, (heading, "")]


def _is_unit(text: str) -> bool:
    is_index = text in {"1", "-", "d"}
    known = any(unit_of(field_name, text) is not None for field_name in FIELDS.values())
    return text in FOREIGN_UNITS or (known and not is_index)


def _bracketed(name: str) -> list[str]:
    """Return the texts in brackets, and a text after a slash, in lower case."""
    found = re.findall(r"[\[(]([^\[\]()]*)[\])]", name)
    tail = name.rpartition("/")[2] if "/" in name else ""
    return [text.strip().lower() for text in (*found, tail) if text.strip()]


def tokens_of(name: str) -> list[str]:
    """Return the words of a heading in lower case, without accents; camel case is split."""
    plain = unicodedata.normalize("NFKD", name.replace("SoC", "Soc").replace("SOC", "Soc"))
    plain = "".join(char for char in plain if not unicodedata.combining(char))
    words: list[str] = []
    for token in _TOKEN.findall(plain):
        words += _parts_of_compound(token.lower())
    return words


def _parts_of_compound(word: str) -> list[str]:
    """Return the parts of a Germanic compound whose first part is a known word, else the word."""
    match = _COMPOUND.fullmatch(word)
    if match is None:
        return [word]
    first, last = match.groups()
    for part in (first, first.removesuffix("s"), first.removesuffix("n")):
        if part in _FIRST_PARTS:
            return [part, last]
    return [word]


def _meaning(name: str, unit: str) -> Meaning | None:
    """Return the meaning of a name with this unit; None if the unit belongs to another quantity."""
    tokens = tokens_of(name)
    quantity, rest = _quantity(tokens, name, unit)
    if quantity is None:
        return None
    if quantity == "time" and _CLOCK.match(unit):
        unit = ""
    if quantity == "time" and not unit and rest and rest[-1] in {"us", "ms"}:  # TimeUS
        unit, rest = rest[-1], rest[:-1]
    if unit and unit_of(FIELDS[quantity], unit) is None:
        return None
    if not unit and any(_is_unit(each) for each in _bracketed(name)):
        return None  # of another quantity
    return Meaning(quantity, unit, *_rank(quantity, rest))


def _quantity(tokens: list[str], name: str, unit: str) -> tuple[str | None, list[str]]:
    """Return the quantity that the words name, and the other words."""
    text = " ".join(tokens)
    for phrase in ("state of charge", "charge level", "battery level"):
        if phrase in text:
            return "soc", text.replace(phrase, "").split()
    named = {each for each, words in _WORDS.items() if words.intersection(tokens)}
    short = next((word for word in tokens if word in _ABBREVIATED), "")
    if short and unit_of(FIELDS[_ABBREVIATED[short]], unit):
        named = {_ABBREVIATED[short]}
    if len(named) > 1 and "current" in tokens:  # also an adjective
        named.discard("current")
    if len(named) > 1:
        named.discard("time")  # the instant of anything
    if len(named) == 1:
        quantity = named.pop()
        words = _WORDS[quantity] | ({short} if _ABBREVIATED.get(short) == quantity else set())
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
    """Return the quantity of a unit, or of a formula letter alone or with a word for the pack."""
    if unit.lower() in _TEMPERATURE_UNITS:
        return "temperature", tokens
    symbols = [token for token in tokens if token in _SYMBOLS]
    others = [token for token in tokens if token not in _SYMBOLS]
    plain = _PACK | _CELL | _DISPLAY | _MEAN
    if len(symbols) != 1 or not all(each in plain or each.isdigit() for each in others):
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
        words -= {"t", "probe", "sensor", "ntc", "log"}
        if words & _AUXILIARY:  # a cycler's thermocouple
            words, numbered = words - _AUXILIARY | {"thermocouple"} | _PACK_WORD, True
    is_one = not numbered or quantity == "temperature" or bool(words & _PACK) or "1" in rest
    unknown = words - _PLACES
    if words & _EXCLUDED or "12" in rest:
        rank = GUESS + 1
    elif words & _AMBIENT:
        rank = 4 if quantity == "temperature" else GUESS
    elif (unknown and not words & _PACK) or not is_one:
        rank = GUESS
    elif unknown or (numbered and quantity != "temperature"):
        rank = 3
    else:
        rank = 2 if words & (_CELL | _DISPLAY) else 0 if words & _PACK else 1
    return rank, numbered, source


def _rank_of_time(words: set[str]) -> int:
    if words & (_EXCLUDED | _TIME_EXCLUDED):
        return GUESS
    if words & _ELAPSED:
        return 0
    return 3 if words - _NEUTRAL - {_DATE_ONLY} else 2 if _DATE_ONLY in words else 1


def stated_unit(heading: str, quantity: str) -> str:
    """Return the unit of this quantity that a heading states, whatever its words; "" if none."""
    for _, unit in _splits(heading, "")[:-1]:
        if unit_of(FIELDS[quantity], unit) is not None:
            return unit
    return ""


def bare_name(heading: str) -> str:
    """Return a heading without the unit that it states."""
    return _splits(heading, "")[0][0]

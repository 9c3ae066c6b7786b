"""Times of a table as seconds: numbers, clock times, dates with and without a zone.

Dates become seconds since 1970 (UTC). A date without a zone is read as UTC unless a zone is given:
only differences matter.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Final
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cangauge._typing import BoolArray, FloatArray
from cangauge.errors import InputError
from cangauge.logs.quantities import EPOCHS, LIMITS, unit_of
from cangauge.logs.values import first_text, is_number, numbers_of, typical, unit_in_cell

_CLOCK: Final = (
    r"(?P<h>\d{1,5}):(?P<m>\d{1,2}(?:[.,]\d+)?)(?::(?P<s>\d{1,2}(?:[.,:]\d+)?))?"
    r"\s*(?P<half>[AaPp])?(?:\.?[Mm]\.?)?"
)
_DATE: Final = (
    r"(?:[A-Za-z]{3},?\s+)?(?P<a>\d{1,4})[-/.](?P<b>\d{1,2}|[A-Za-z]{3})[-/.](?P<c>\d{1,4})"
)
# Of zones only UTC is known by name: `CEST` is local time, `CEST+0200` is not.
_ZONE: Final = (
    r"(?:(?P<z>Z|z|UTC|GMT)|[A-Z]{3,5})?\s*(?:(?P<sign>[+-])(?P<zh>\d{2}):?(?P<zm>\d{2})?)?"
)
_DATE_TIME: Final = rf"^{_DATE}(?:(?:[T,_]|\s)\s*{_CLOCK})?\s*{_ZONE}$"
_CLOCK_TIME: Final = rf"^(?:(?P<d>\d+)\s*(?:[dD]|[dD]ays?)?,?\s+)?{_CLOCK}$"
_TWO_PARTS: Final = re.compile(r"h+:m+|m+:s+(?:[.,]\w+)?", re.IGNORECASE)
"""Units of clock times of two parts."""
_SPELLINGS: Final = (
    ("[\u00a0\u202f]", " "),  # before AM and PM
    # `Mar 31, 2024` and `31 March 2024` are read as `31-Mar-2024`.
    (
        r"^(?:[A-Za-z]{3,9},?\s+)?([A-Za-z]{3})[a-z]*\.?\s+(\d{1,2})(?:st|nd|rd|th)?,?\s+(\d{4}),?\s*",
        r"\2-\1-\3 ",
    ),
    (r"^(\d{1,2})\.?\s+([A-Za-z]{3})[a-z]*\.?,?\s+(\d{4}),?\s*", r"\1-\2-\3 "),
    # `Wed Mar 13 23:50:00 GMT+01:00 2024`, as C and Java write it.
    (
        r"^[A-Za-z]{3} ([A-Za-z]{3}) +(\d{1,2}) (\d{1,2}:\d{2}:\d{2}) (?:(\S+) )?(\d{4})$",
        r"\2-\1-\5 \3 \4",
    ),
    # `20240313T235000Z`, `240313235000`; days and a clock time: `1.23:50:00`, `073:23:50:00`.
    (r"^(\d{4})(\d{2})(\d{2})T?(\d{2})(\d{2})(\d{2})([Z.,]|$)", r"\1-\2-\3 \4:\5:\6\7"),
    (r"^(\d{2})(\d{2})(\d{2})(\d{2})(\d{2})(\d{2})$", r"20\1-\2-\3 \4:\5:\6"),
    (r"^(\d+)\.(\d{2}:\d{2}:\d{2})", r"\1d \2"),
    (r"^(\d{3}):(\d{2}:\d{2}:\d{2})$", r"\1d \2"),
)
HOUR_S: Final = 3600.0
"""Change of a local clock at daylight saving time [s]."""
_MONTHS: Final = "jan feb mar apr may jun jul aug sep oct nov dec"
_GERMAN: Final = {"mrz": "mar", "mai": "may", "okt": "oct", "dez": "dec"}
_ORDERS: Final = ("ymd", "dmy", "mdy")
_DIGITS: Final = r"^(19|20)?\d{2}(0[1-9]|1[0-2])([0-2]\d|3[01])([01]\d|2[0-3])([0-5]\d){2}$"
"""`20240313235000` and `240313235000`."""


def count_stamps(cells: Sequence[str]) -> int:
    """Return how many cells hold a date or a clock time."""
    alike = _spelled_alike(pa.array(cells, pa.string()))
    return int(np.count_nonzero(_matches(alike, _DATE_TIME) | _matches(alike, _CLOCK_TIME)))


def is_stamp(text: str) -> bool:
    """Return whether a cell holds a date or a clock time."""
    return count_stamps([text]) == 1


def is_clock(text: str) -> bool:
    """Return whether a cell holds a clock time without a date."""
    return bool(_matches(_spelled_alike(pa.array([text])), _CLOCK_TIME)[0])


def is_time_format(unit: str) -> bool:
    """Return whether a unit is an order of dates (`dmy`) or of a clock's two parts (`mm:ss`)."""
    return unit.lower() in _ORDERS or _TWO_PARTS.fullmatch(unit) is not None


def _matches(cells: Any, pattern: str) -> BoolArray:
    return np.asarray(pc.match_substring_regex(cells, pattern), dtype=bool)


def _spelled_alike(cells: Any) -> Any:
    cells = pc.utf8_trim_whitespace(cells)
    for pattern, replacement in _SPELLINGS:
        cells = pc.replace_substring_regex(cells, pattern, replacement)
    return pc.utf8_trim_whitespace(cells)


def seconds_of(
    parts: Sequence[Any], unit: str, factor: float, *, source: str, label: str
) -> tuple[FloatArray, str]:
    """Return a time column, or a date and its time of day, as seconds, and how it was read.

    Parameters
    ----------
    parts : sequence of Arrow columns of n rows
        Numbers, timestamps, durations, dates, or text of any of them; several are texts to join.
    unit : str
        Unit of numbers ("": seconds, or as the size of an epoch shows), order of dates (`dmy`,
        `mdy`) or of a clock's two parts (`h:mm`, `mm:ss`), or the zone of dates that state none
        (`Europe/Berlin`).
    factor : float
        Numbers times this are in the unit.
    source, label : str
        File and heading, for errors.

    Raises
    ------
    InputError
        If a cell is no time.
    """
    is_format = is_time_format(unit) or _zone_of(unit) is not None
    order_or_zone = unit if is_format else ""
    column, kind = parts[0], parts[0].type
    if pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
        return _since_1970(column), str(kind) if is_format or not unit else unit
    if len(parts) > 1:
        joined = pc.binary_join_element_wise(*(part.cast(pa.string()) for part in parts), " ")
        return seconds_of_text(joined, order_or_zone, source, label)
    if pa.types.is_date(kind) or pa.types.is_time(kind):
        column = column.cast(pa.string())
    first = first_text(column)
    if first and not is_number(first) and unit_of("time_s", unit_in_cell(first)) is None:
        return seconds_of_text(column.cast(pa.string()), order_or_zone, source, label)
    values, in_cells = numbers_of(column, source, label)
    digits = _spelled_in_digits(values) if not unit or is_format else None
    if digits is not None:
        return seconds_of_text(digits, order_or_zone, source, label)
    unit = "" if is_format else unit
    values = values if factor == 1.0 else values * factor
    return _seconds_of_numbers(values, unit or in_cells, source, label)


def _since_1970(stamps: Any) -> FloatArray:
    """Return stamps or durations of Arrow in seconds, NaN where missing."""
    tick_s, _ = unit_of("time_s", stamps.type.unit) or (1.0, 0.0)
    counts = np.asarray(stamps.cast(pa.int64()).cast(pa.float64(), safe=False), dtype=np.float64)
    return counts / round(1.0 / tick_s)


def _zone_of(name: str) -> ZoneInfo | None:
    if not name or unit_of("time_s", name) is not None:
        return None
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        return None


def _spelled_in_digits(values: FloatArray) -> Any:
    """Return numbers that spell dates as text, or None."""
    if np.nanmin(values, initial=np.inf) < 1e10:
        return None
    with suppress(pa.ArrowInvalid):  # one is no whole number
        digits = pa.array(values, from_pandas=True).cast(pa.int64()).cast(pa.string())
        return digits if pc.all(pc.match_substring_regex(digits, _DIGITS)).as_py() else None
    return None


def _seconds_of_numbers(
    values: FloatArray, unit: str, source: str, label: str
) -> tuple[FloatArray, str]:
    if unit:
        return values * (unit_of("time_s", unit) or (1.0, 0.0))[0], unit
    is_known = np.isfinite(values)
    finite = values[is_known]
    middle = typical(finite)
    first_s, last_s = LIMITS["can_logs_s"]
    for name, (tick_s, origin_s) in EPOCHS.items():
        if first_s <= middle * tick_s - origin_s <= last_s:
            ticks = values - origin_s / tick_s  # before scaling: 100 ns of 2000 years need 63 bits
            return ticks * tick_s, f"{name}, from its size"
    if middle >= 1e11:  # milliseconds, of 1973
        cure = f"state it: --columns 'time={label}[?]', with s, ms, us, ns, min, h or d for ?"
        problem = "the unit of time is not stated, and no epoch has a year of 1991 to 2099"
        raise InputError(problem, source=source, field=label, value=middle, cure=cure)
    steps = np.abs(np.diff(finite))
    if np.any(steps > 40.0) and np.median(steps) < 40.0:
        # A count of seconds has some of 60 to 99 of each hundred; a clock none, and no gap there.
        hours, minutes, seconds = finite // 10_000.0, finite // 100.0 % 100.0, finite % 100.0
        spells = (hours >= 0.0) & (hours < 24.0) & (minutes < 60.0) & (seconds < 60.0)
        clock_s = over_midnight(hours * 3600.0 + minutes * 60.0 + seconds)
        clock_steps = np.diff(clock_s)
        is_near = (clock_steps > 0.0) & (clock_steps <= 2.0 * np.median(steps))
        if spells.all() and np.any((steps > 40.0) & is_near):
            of_day_s = np.full(values.size, np.nan)
            of_day_s[is_known] = clock_s
            return of_day_s, "hhmmss, from its digits"
    return values, "s, assumed"


def seconds_of_text(cells: Any, unit: str, source: str, label: str) -> tuple[FloatArray, str]:
    """Return stamps of text as `seconds_of`, NaN where empty.

    All cells are clock times (`1:02:03.5`, `2d 01:02:03`), or dates with or without a time of day.
    """
    cells = cells.combine_chunks() if isinstance(cells, pa.ChunkedArray) else cells
    iso = _iso_dates(cells, unit)
    if iso is not None:
        return iso
    spelled = _spelled_alike(cells)
    is_clock_time = is_clock(first_text(spelled))
    parts = pc.extract_regex(spelled, _CLOCK_TIME if is_clock_time else _DATE_TIME)
    read = np.asarray(pc.is_valid(parts), dtype=bool)
    wrong = np.flatnonzero(np.asarray(pc.is_valid(spelled), dtype=bool) & ~read)
    if wrong.size:
        problem, value = f"row {wrong[0] + 1} is not a time", cells[int(wrong[0])].as_py()
        cure = "seconds, hh:mm:ss or dates are read; name another column with --columns time=…"
        raise InputError(problem, source=source, field=label, value=value, cure=cure)
    hours, minutes, seconds = (np.nan_to_num(_numbers(parts, name)) for name in "hms")
    half = _words(parts, "half")
    hours = np.where(half == "", hours, hours % 12 + np.where(half == "p", 12.0, 0.0))
    of_day_s = np.where(read, hours * 3600.0 + minutes * 60.0 + seconds, np.nan)
    if not is_clock_time:
        return _dates(parts, of_day_s, unit)
    if not np.isfinite(_numbers(parts, "s")).any() and _are_minutes(parts, unit, source, label):
        of_day_s /= 60.0
    return over_midnight(np.nan_to_num(_numbers(parts, "d")) * 86400.0 + of_day_s), "clock time"


def _are_minutes(parts: Any, unit: str, source: str, label: str) -> bool:
    """Return whether clock times of two parts are minutes and seconds, not hours and minutes."""
    if pc.any(pc.match_substring_regex(parts.field("m"), "[.,]")).as_py():
        return True
    if _TWO_PARTS.fullmatch(unit):
        return unit[:1].lower() == "m"
    if np.isfinite(_numbers(parts, "d")).any() or np.any(_words(parts, "half") != ""):
        return False  # only a clock counts days, or halves of one
    problem = "it may be hours and minutes, or minutes and seconds"
    hour, minute = (pc.drop_null(parts.field(name))[0].as_py() for name in "hm")
    shown = f"{hour}:{minute}"
    cure = f"state it: --columns 'time={label}[h:mm]', or [mm:ss]"
    raise InputError(problem, source=source, field=label, value=shown, cure=cure)


def _iso_dates(cells: Any, unit: str) -> tuple[FloatArray, str] | None:
    """Return ISO dates as `seconds_of_text`, at a tenth of the cost; None if any is spelled else.

    Examples
    --------
    >>> _iso_dates(pa.array(["2024-03-13T23:59:30.5Z"]), "")
    (array([1.71037437e+09]), 'date with zone')
    """
    for zone in (None, "UTC"):
        with suppress(pa.ArrowInvalid):
            values = _since_1970(pc.cast(cells, pa.timestamp("us", zone)))
            return (values, "date with zone") if zone else _in_zone(values, "date", unit)
    return None


def over_midnight(of_day_s: FloatArray) -> FloatArray:
    """Return times of day [s] with the days that pass at each midnight, NaN where missing."""
    values, read = of_day_s.copy(), np.isfinite(of_day_s)
    values[read] += np.cumsum(np.diff(values[read], prepend=0.0) < -43200.0) * 86400.0
    return values


def changes_of_clock(dates_s: FloatArray, source: str, label: str, cure: str) -> list[str]:
    """Return remarks on dates without a zone that skip an hour, as at daylight saving time.

    Raises
    ------
    InputError
        If they go back by an hour.
    """
    known_s = dates_s[np.isfinite(dates_s)]
    if known_s.size < 2:
        return []
    if np.median(np.diff(known_s)) < 0.0:  # the newest first
        known_s = known_s[::-1]
    step = np.diff(known_s)
    usual_s = float(np.median(step))
    if usual_s > LIMITS["interval_s"]:  # in a slow series an hour may simply have passed
        return []
    remarks = []
    for row in np.flatnonzero(np.abs(np.abs(step - usual_s) - HOUR_S) <= usual_s):
        date = np.datetime64(int(known_s[row]), "s").item()
        problem = f"as at daylight saving time, the clock {{}} an hour after {date}"
        if step[row] < 0.0:
            raise InputError(problem.format("repeats"), source=source, field=label, cure=cure)
        remarks.append(f"{problem.format('skips')}: if no hour is missing there, {cure}")
    return remarks


def _dates(parts: Any, of_day_s: FloatArray, unit: str) -> tuple[FloatArray, str]:
    words, middle, is_word = _words(parts, "b"), _numbers(parts, "b"), False
    for word in set(words) - {""}:
        place = _MONTHS.find(_GERMAN.get(word, word))
        if place >= 0:
            middle[words == word] = 1 + place // 4
            is_word = True
    fields = np.array([_numbers(parts, "a"), middle, _numbers(parts, "c")])
    known = np.isfinite(fields).all(axis=0)
    order, how = _order(fields[:, known], unit.lower(), is_word=is_word)
    values = np.full(known.size, np.nan)
    values[known] = _day_numbers(fields[:, known], order) * 86400.0
    values += of_day_s
    if np.any(_words(parts, "z") + _words(parts, "sign") != ""):
        hours, minutes = (np.nan_to_num(_numbers(parts, name)) for name in ("zh", "zm"))
        sign = np.where(_words(parts, "sign") == "-", -1.0, 1.0)
        return values - sign * (hours * 3600.0 + minutes * 60.0), f"date{how} with zone"
    return _in_zone(values, f"date{how}", unit)


def _in_zone(values: FloatArray, how: str, unit: str) -> tuple[FloatArray, str]:
    """Return dates without a zone as seconds since 1970 (UTC), and how they were read."""
    zone = _zone_of(unit)
    if zone is None:
        return values, f"{how} without zone"
    local = pa.array(values * 1e6, from_pandas=True).cast(pa.int64()).cast(pa.timestamp("us"))
    first_s, again_s = (
        _since_1970(pc.assume_timezone(local, zone.key, ambiguous=which, nonexistent="latest"))
        for which in ("earliest", "latest")
    )
    # Of an hour that the clock shows twice, the rows below its step back are the second one.
    is_again = np.cumsum(np.diff(values, prepend=values[:1]) < 0.0) > 0
    return np.where(is_again, again_s, first_s), f"{how} in {zone.key}"


def _order(fields: FloatArray, unit: str, *, is_word: bool) -> tuple[str, str]:
    """Return the order of year, month and day, and a note where it was assumed."""
    if not fields.size or np.max(fields[0]) > 31:
        return "ymd", ""
    if unit in {"dmy", "mdy"}:
        return unit, f" ({unit} as given)"
    if is_word or np.max(fields[0]) > 12:
        return "dmy", " (day first)"
    if np.max(fields[1]) > 12:
        return "mdy", " (month first)"
    # A log is short: the order of fewer days.
    order = min(("dmy", "mdy"), key=lambda name: float(np.ptp(_day_numbers(fields, name))))
    return order, f" ({'day' if order == 'dmy' else 'month'} first, assumed)"


def _day_numbers(fields: FloatArray, order: str) -> FloatArray:
    """Return days since 1970 of fields of shape (3, n)."""
    year, month, day = (fields[order.index(letter)].astype(np.int64) for letter in "ymd")
    year = np.where(year < 100, year + 2000, year)
    first = ((year - 1970) * 12 + month - 1).astype("datetime64[M]").astype("datetime64[D]")
    return np.asarray(first.astype(np.int64) + day - 1, dtype=np.float64)


def _numbers(parts: Any, name: str) -> FloatArray:
    """Return a group as numbers, NaN where it is empty; `59:123` is 59.123."""
    text = pc.replace_substring_regex(parts.field(name), "[,:]", ".")
    is_number = pc.match_substring_regex(text, r"^\d+(\.\d+)?$")
    numbers = pc.cast(pc.if_else(is_number, text, pa.scalar(None, pa.string())), pa.float64())
    return np.asarray(numbers, dtype=np.float64)


def _words(parts: Any, name: str) -> Any:
    """Return a group in lower case, "" where it is empty."""
    text = pc.fill_null(pc.utf8_lower(parts.field(name)), "")
    return np.asarray(text, dtype=object)

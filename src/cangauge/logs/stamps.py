"""Time columns as text: seconds, clock times, dates with and without a zone → seconds.

Dates become seconds since 1970 (UTC). A date without a zone is read as UTC unless a zone is given:
only differences matter, and they are wrong across a change of the clock alone.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any, Final
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cangauge._typing import BoolArray, FloatArray
from cangauge.logs.units import unit_of

DAY_S: Final = 86400.0
HOUR_S: Final = 3600.0
WITHOUT_ZONE: Final = "without zone"

_DAYS: Final = r"(?:(?P<d>\d+)\s*(?:[dD]|[dD]ays?)?\s+)?"
_CLOCK: Final = (
    r"(?P<h>\d{1,5}):(?P<m>\d{1,2})(?::(?P<s>\d{1,2}(?:[.,:]\d+)?))?"
    r"\s*(?P<ap>[AaPp])?(?:\.?[Mm]\.?)?"
)
_ZONE: Final = r"(?P<z>Z|z|UTC|GMT|[+-]\d{2}:?\d{2}|[+-]\d{2})?"
_DATE: Final = (
    r"(?:[A-Za-z]{3},?\s+)?(?P<a>\d{1,4})[-/.](?P<b>\d{1,2}|[A-Za-z]{3})[-/.](?P<c>\d{1,4})"
)
_MONTH_FIRST: Final = (
    r"^(?:[A-Za-z]{3,9},?\s+)?([A-Za-z]{3})[a-z]*\.?\s+(\d{1,2})(?:st|nd|rd|th)?,?\s+(\d{4}),?\s*"
)
_MONTH_WORD: Final = r"^(\d{1,2})\.?\s+([A-Za-z]{3})[a-z]*\.?,?\s+(\d{4}),?\s*"
_DATE_TIME: Final = rf"^{_DATE}(?:(?:[T,_]|\s)\s*{_CLOCK})?\s*{_ZONE}$"
_CLOCK_TIME: Final = rf"^{_DAYS}{_CLOCK}$"
_MONTHS: Final = (
    "jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"
)  # fmt: skip
_GERMAN: Final = {"mrz": "mar", "mai": "may", "okt": "oct", "dez": "dec"}
_ORDERS: Final = ("ymd", "dmy", "mdy")
_EPOCHS: Final = ((1e17, 1e-9, "ns"), (1e14, 1e-6, "µs"), (1e11, 1e-3, "ms"))
"""Smallest number since 1970 in each unit, its seconds, its name."""


class UnreadableStampError(Exception):
    """A cell that is no time: its row from 0 and its text."""

    def __init__(self, row: int, text: str) -> None:
        self.row, self.text = row, text
        super().__init__(text)


def is_stamp(text: str) -> bool:
    """Return whether a cell holds a date or a clock time."""
    one = _with_short_dates(pa.array([text.strip()], pa.string()))
    return any(
        pc.match_substring_regex(one, pattern)[0].as_py() for pattern in (_DATE_TIME, _CLOCK_TIME)
    )


def is_clock(text: str) -> bool:
    """Return whether a cell holds a clock time without a date."""
    one = pa.array([text.strip()], pa.string())
    return bool(pc.match_substring_regex(one, _CLOCK_TIME)[0].as_py())


def is_time_format(unit: str) -> bool:
    """Return whether a unit is an order of dates (dmy, mdy, ymd) or a time zone."""
    return unit.lower() in _ORDERS or zone_of(unit) is not None


def zone_of(name: str) -> ZoneInfo | None:
    """Return the time zone of this name, or None."""
    if not name or unit_of("time_s", name) is not None:
        return None
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        return None


def seconds_of_numbers(values: FloatArray, unit: str) -> tuple[FloatArray, str]:
    """Return numbers as seconds, and their unit as found: the epoch's size shows an unstated one.

    Parameters
    ----------
    values : array of shape (n,)
    unit : str
        As stated; "" if unknown.
    """
    if unit:
        factor, _ = unit_of("time_s", unit) or (1.0, 0.0)
        return values * factor, unit
    finite = values[np.isfinite(values)]
    typical = float(np.median(finite)) if finite.size else 0.0
    for least, factor, name in _EPOCHS:
        if typical >= least:
            return values * factor, f"{name} since 1970, from its size"
    return values, "s since 1970, from its size" if typical >= 1e9 else "s, assumed"


def seconds_of_text(cells: Any, unit: str = "") -> tuple[FloatArray, str]:
    """Return stamps of text as seconds, NaN where empty, and how they were read.

    Parameters
    ----------
    cells : pyarrow string array of shape (n,)
        Trimmed; null where missing. All clock times (`1:02:03.5`, `2d 01:02:03`), or all dates with
        or without a time of day.
    unit : str
        Order of dates (`dmy`, `mdy`), or the zone of dates without one (`Europe/Berlin`).

    Raises
    ------
    UnreadableStampError
        If a cell is neither.
    """
    if isinstance(cells, pa.ChunkedArray):
        cells = cells.combine_chunks()
    stated, cells = cells, _with_short_dates(cells)
    known = ~np.asarray(pc.is_null(cells).to_numpy(zero_copy_only=False), dtype=bool)
    first = next((cell.as_py() for cell in cells if cell.is_valid), "")
    is_of_day = is_clock(first)
    parts = pc.extract_regex(cells, _CLOCK_TIME if is_of_day else _DATE_TIME)
    bad = known & np.asarray(pc.is_null(parts).to_numpy(zero_copy_only=False), dtype=bool)
    if bad.any():
        row = int(np.argmax(bad))
        raise UnreadableStampError(row, str(stated[row].as_py()))
    of_day_s = _time_of_day_s(parts)
    if is_of_day:
        days = _numbers(parts, "d")
        values = np.where(np.isnan(days), 0.0, days) * DAY_S + of_day_s
        return _unwrapped(values), "clock time" if values.size else ""
    return _dates(parts, of_day_s, unit)


def _with_short_dates(cells: Any) -> Any:
    """Return stamps with dates such as `Mar 31, 2024` or `31 March 2024` as `31-Mar-2024`."""
    cells = pc.replace_substring_regex(cells, "[\u00a0\u202f]", " ")  # before AM and PM
    cells = pc.replace_substring_regex(cells, _MONTH_FIRST, r"\2-\1-\3 ")
    return pc.utf8_trim_whitespace(pc.replace_substring_regex(cells, _MONTH_WORD, r"\1-\2-\3 "))


def hour_jump(time_s: FloatArray) -> tuple[int, bool] | None:
    """Return the first row at which local time jumps an hour, and whether forward; or None.

    Such a row begins within two usual steps of a full hour and follows the row before by one hour
    more, or less, than a usual step.
    """
    known = np.flatnonzero(np.isfinite(time_s))
    stamps = time_s[known]
    step = np.diff(stamps)
    if not np.any(step > 0.0):
        return None
    usual_s = float(np.median(step[step > 0.0]))  # stamps of whole seconds repeat
    near_s = 2.0 * usual_s
    at_hour = stamps[1:] % HOUR_S <= near_s
    jumps = np.flatnonzero(at_hour & (np.abs(np.abs(step - usual_s) - HOUR_S) <= usual_s))
    if not jumps.size or near_s >= HOUR_S:
        return None
    return int(known[jumps[0] + 1]), bool(step[jumps[0]] > 0.0)


def _time_of_day_s(parts: Any) -> FloatArray:
    hours = np.nan_to_num(_numbers(parts, "h"))
    seconds = np.nan_to_num(_numbers(parts, "s"))
    half = _text(parts, "ap")
    hours = np.where(half == "p", hours % 12 + 12, np.where(half == "a", hours % 12, hours))
    total = hours * 3600.0 + np.nan_to_num(_numbers(parts, "m")) * 60.0 + seconds
    missing = np.asarray(pc.is_null(parts).to_numpy(zero_copy_only=False), dtype=bool)
    return np.where(missing, np.nan, total)


def _unwrapped(values: FloatArray) -> FloatArray:
    """Return clock times with a day added at each midnight."""
    known = np.flatnonzero(np.isfinite(values))
    step = np.diff(values[known], prepend=values[known][:1])
    midnights = np.cumsum(step < -0.5 * DAY_S)
    found = values.copy()
    found[known] += midnights * DAY_S
    return found


def _dates(parts: Any, of_day_s: FloatArray, unit: str) -> tuple[FloatArray, str]:
    a, c = _numbers(parts, "a"), _numbers(parts, "c")
    words = _text(parts, "b")
    is_word = bool(words.size and np.char.isalpha(words.astype(str)).any())
    b = _months(words) if is_word else _numbers(parts, "b")
    finite = np.isfinite(a) & np.isfinite(b) & np.isfinite(c)
    order, how = _order(a[finite], b[finite], c[finite], unit, is_word=is_word)
    year, month, day = {"ymd": (a, b, c), "dmy": (c, b, a), "mdy": (c, a, b)}[order]
    year = np.where(year < 100, year + 2000, year)
    days = np.full(a.size, np.nan)
    days[finite] = _day_numbers(year[finite], month[finite], day[finite])
    values = days * DAY_S + of_day_s
    zones = _text(parts, "z")
    if values.size and np.any(zones != ""):
        return values - _offsets_s(zones), f"date{how} with zone"
    zone = zone_of(unit)
    if zone is not None:
        return _in_zone(values, zone), f"date{how} in {zone.key}"
    return values, f"date{how} {WITHOUT_ZONE}"


def _order(
    a: FloatArray, b: FloatArray, c: FloatArray, unit: str, *, is_word: bool
) -> tuple[str, str]:
    """Return the order of year, month and day, and a note where it was assumed."""
    if not a.size or np.max(a) > 31:
        return "ymd", ""
    if unit.lower() in {"dmy", "mdy"}:
        return unit.lower(), f" ({unit.lower()} as given)"
    if is_word or np.max(a) > 12:
        return "dmy", " (day first)"
    if np.max(b) > 12:
        return "mdy", " (month first)"
    spans = {}
    for order, month, day in (("dmy", b, a), ("mdy", a, b)):
        numbers = _day_numbers(np.where(c < 100, c + 2000, c), month, day)
        if np.all(np.diff(numbers) >= 0.0):
            spans[order] = float(np.ptp(numbers))
    order = min(spans, key=lambda each: spans[each], default="dmy")
    return order, f" ({'day' if order == 'dmy' else 'month'} first, assumed)"


def _day_numbers(year: FloatArray, month: FloatArray, day: FloatArray) -> FloatArray:
    months = (year.astype(np.int64) - 1970) * 12 + month.astype(np.int64) - 1
    first = months.astype("datetime64[M]").astype("datetime64[D]").astype(np.int64)
    return np.asarray(first + day - 1, dtype=np.float64)


def _months(words: Any) -> FloatArray:
    numbers = {name: float(k) for k, name in enumerate(_MONTHS, start=1)}
    lower = np.char.lower(words.astype(str))
    return np.array([numbers.get(_GERMAN.get(word, word), np.nan) for word in lower.tolist()])


def _offsets_s(zones: Any) -> FloatArray:
    """Return the offset from UTC that each stamp states [s]."""
    found: dict[str, float] = {}
    for zone in np.unique(zones.astype(str)).tolist():
        digits = zone[1:].replace(":", "")
        if zone[:1] in {"+", "-"} and digits.isdigit():
            seconds = int(digits[:2]) * 3600.0 + int(digits[2:] or 0) * 60.0
            found[zone] = -seconds if zone[0] == "-" else seconds
    return np.array([found.get(zone, 0.0) for zone in zones.astype(str).tolist()])


def _in_zone(local_s: FloatArray, zone: ZoneInfo) -> FloatArray:
    """Return local times as UTC; an hour that occurs twice is read in the order of the rows."""
    found = local_s.copy()
    known = np.flatnonzero(np.isfinite(local_s))
    quarters, which = np.unique(np.floor(local_s[known] / 900.0), return_inverse=True)
    offsets = np.array([[_offset_s(each * 900.0, zone, fold) for fold in (0, 1)]
                        for each in quarters.tolist()]).reshape(-1, 2)  # fmt: skip
    first, second = offsets[which, 0], offsets[which, 1]
    found[known] -= first
    twice: BoolArray = first != second
    back = np.diff(local_s[known], prepend=local_s[known][:1]) < 0.0
    later = twice & (np.maximum.accumulate(np.where(twice & back, np.arange(back.size), -1)) >= 0)
    found[known[later]] += (first - second)[later]
    return found


def _offset_s(local_s: float, zone: ZoneInfo, fold: int) -> float:
    naive = datetime.fromtimestamp(local_s, UTC).replace(tzinfo=zone, fold=fold)
    offset = naive.utcoffset()
    return offset.total_seconds() if offset is not None else 0.0


def _numbers(parts: Any, name: str) -> FloatArray:
    """Return a group as numbers, NaN where it is empty; `59:123` is 59.123."""
    text = pc.replace_substring_regex(parts.field(name), "[,:]", ".")
    valid = pc.match_substring_regex(text, r"^\d+(\.\d+)?$")
    text = pc.if_else(pc.fill_null(valid, fill_value=False), text, pa.scalar(None, pa.string()))
    numbers = pc.cast(text, pa.float64()).to_numpy(zero_copy_only=False)
    return np.asarray(numbers, dtype=np.float64)


def _text(parts: Any, name: str) -> Any:
    """Return a group in lower case, "" where it is empty (zones keep their sign)."""
    text = pc.fill_null(pc.utf8_lower(parts.field(name)), "")
    return np.asarray(text.to_numpy(zero_copy_only=False), dtype=object)

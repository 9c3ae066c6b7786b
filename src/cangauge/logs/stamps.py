"""Times of a table as seconds: numbers, clock times, dates with and without a zone.

Dates become seconds since 1970 (UTC). A date without a zone is read as UTC unless a zone is given:
only differences matter.
"""

from __future__ import annotations

from typing import Any, Final
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.units import unit_of

DAY_S: Final = 86400.0

_CLOCK: Final = (
    r"(?P<h>\d{1,5}):(?P<m>\d{1,2})(?::(?P<s>\d{1,2}(?:[.,:]\d+)?))?"
    r"\s*(?P<half>[AaPp])?(?:\.?[Mm]\.?)?"
)
_ZONE: Final = r"(?P<z>Z|z|UTC|GMT|[+-]\d{2}:?\d{2}|[+-]\d{2})?"
_DATE: Final = (
    r"(?:[A-Za-z]{3},?\s+)?(?P<a>\d{1,4})[-/.](?P<b>\d{1,2}|[A-Za-z]{3})[-/.](?P<c>\d{1,4})"
)
_DATE_TIME: Final = rf"^{_DATE}(?:(?:[T,_]|\s)\s*{_CLOCK})?\s*{_ZONE}$"
_CLOCK_TIME: Final = rf"^(?:(?P<d>\d+)\s*(?:[dD]|[dD]ays?)?\s+)?{_CLOCK}$"
# `Mar 31, 2024` and `31 March 2024` are read as `31-Mar-2024`.
_MONTH_FIRST: Final = (
    r"^(?:[A-Za-z]{3,9},?\s+)?([A-Za-z]{3})[a-z]*\.?\s+(\d{1,2})(?:st|nd|rd|th)?,?\s+(\d{4}),?\s*"
)
_MONTH_WORD: Final = r"^(\d{1,2})\.?\s+([A-Za-z]{3})[a-z]*\.?,?\s+(\d{4}),?\s*"
_MONTHS: Final = (
    "jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"
)  # fmt: skip
_GERMAN: Final = {"mrz": "mar", "mai": "may", "okt": "oct", "dez": "dec"}
_EPOCHS: Final = ((1e17, 1e-9, "ns"), (1e14, 1e-6, "µs"), (1e11, 1e-3, "ms"), (1e9, 1.0, "s"))
"""Smallest number since 1970 in each unit, its seconds, its name."""


def is_stamp(text: str) -> bool:
    """Return whether a cell holds a date or a clock time."""
    cell = _spelled_alike(pa.array([text.strip()], pa.string()))
    patterns = (_DATE_TIME, _CLOCK_TIME)
    return any(pc.match_substring_regex(cell, pattern)[0].as_py() for pattern in patterns)


def is_clock(text: str) -> bool:
    """Return whether a cell holds a clock time without a date."""
    cell = pa.array([text.strip()], pa.string())
    return bool(pc.match_substring_regex(cell, _CLOCK_TIME)[0].as_py())


def is_time_format(unit: str) -> bool:
    """Return whether a unit is an order of dates (dmy, mdy, ymd) or a time zone."""
    return unit.lower() in {"ymd", "dmy", "mdy"} or _zone_of(unit) is not None


def _zone_of(name: str) -> ZoneInfo | None:
    if not name or unit_of("time_s", name) is not None:
        return None
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        return None


def seconds_of_numbers(values: FloatArray, unit: str) -> tuple[FloatArray, str]:
    """Return numbers as seconds, and their unit as stated or as the size of an epoch shows."""
    if unit:
        factor, _ = unit_of("time_s", unit) or (1.0, 0.0)
        return values * factor, unit
    finite = values[np.isfinite(values)]
    typical = float(np.median(finite)) if finite.size else 0.0
    for least, factor, name in _EPOCHS:
        if typical >= least:
            return values * factor, f"{name} since 1970, from its size"
    return values, "s, assumed"


def seconds_of_text(cells: Any, unit: str, source: str, label: str) -> tuple[FloatArray, str]:
    """Return stamps of text as seconds, NaN where empty, and how they were read.

    All cells are clock times (`1:02:03.5`, `2d 01:02:03`), or dates with or without a time of day.
    `unit` is an order of dates (`dmy`, `mdy`), or the zone of dates without one (`Europe/Berlin`).

    Raises
    ------
    InputError
        If a cell is no time.
    """
    if isinstance(cells, pa.ChunkedArray):
        cells = cells.combine_chunks()
    spelled = _spelled_alike(cells)
    first = next((cell.as_py() for cell in spelled if cell.is_valid), "")
    parts = pc.extract_regex(spelled, _CLOCK_TIME if is_clock(first) else _DATE_TIME)
    unread = pc.and_(pc.is_valid(spelled), pc.is_null(parts)).to_numpy(zero_copy_only=False)
    if np.any(unread):
        row = int(np.argmax(unread))
        raise InputError(
            f"row {row + 1} is not a time",
            source=source,
            field=label,
            value=cells[row].as_py(),
            cure="seconds, hh:mm:ss or dates are read; name another column with --columns time=…",
        )
    of_day_s = _time_of_day_s(parts)
    if is_clock(first):
        return _over_midnight(np.nan_to_num(_numbers(parts, "d")) * DAY_S + of_day_s), "clock time"
    return _dates(parts, of_day_s, unit)


def _spelled_alike(cells: Any) -> Any:
    cells = pc.replace_substring_regex(cells, "[\u00a0\u202f]", " ")  # before AM and PM
    cells = pc.replace_substring_regex(cells, _MONTH_FIRST, r"\2-\1-\3 ")
    return pc.utf8_trim_whitespace(pc.replace_substring_regex(cells, _MONTH_WORD, r"\1-\2-\3 "))


def _time_of_day_s(parts: Any) -> FloatArray:
    hours, half = np.nan_to_num(_numbers(parts, "h")), _text(parts, "half")
    hours = np.where(half == "p", hours % 12 + 12, np.where(half == "a", hours % 12, hours))
    minutes, seconds = (np.nan_to_num(_numbers(parts, name)) for name in ("m", "s"))
    missing = np.asarray(pc.is_null(parts).to_numpy(zero_copy_only=False), dtype=bool)
    return np.where(missing, np.nan, hours * 3600.0 + minutes * 60.0 + seconds)


def _over_midnight(values: FloatArray) -> FloatArray:
    """Return clock times with a day added at each midnight."""
    known = np.flatnonzero(np.isfinite(values))
    step = np.diff(values[known], prepend=values[known][:1])
    values[known] += np.cumsum(step < -0.5 * DAY_S) * DAY_S
    return values


def _dates(parts: Any, of_day_s: FloatArray, unit: str) -> tuple[FloatArray, str]:
    words = _text(parts, "b")
    months = {name: float(k) for k, name in enumerate(_MONTHS, start=1)}
    by_word = np.array([months.get(_GERMAN.get(word, word), np.nan) for word in words])
    is_word = bool(np.isfinite(by_word).any())
    a, b, c = (
        _numbers(parts, "a"),
        by_word if is_word else _numbers(parts, "b"),
        _numbers(parts, "c"),
    )
    known = np.isfinite(a) & np.isfinite(b) & np.isfinite(c)
    order, how = _order(a[known], b[known], c[known], unit, is_word=is_word)
    days = np.full(a.size, np.nan)
    days[known] = _day_numbers(a[known], b[known], c[known], order)
    values = days * DAY_S + of_day_s
    zones = _text(parts, "z")
    if np.any(zones != ""):
        return values - _offsets_s(zones), f"date{how} with zone"
    zone = _zone_of(unit)
    if zone is None:
        return values, f"date{how} without zone"
    local = pa.array(values * 1e6, from_pandas=True).cast(pa.int64()).cast(pa.timestamp("us"))
    utc = pc.assume_timezone(local, zone.key, ambiguous="earliest", nonexistent="latest")
    micros = utc.cast(pa.int64()).cast(pa.float64()).to_numpy(zero_copy_only=False)
    return np.asarray(micros) / 1e6, f"date{how} in {zone.key}"


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
    for order in ("dmy", "mdy"):
        days = _day_numbers(a, b, c, order)
        if np.all(np.diff(days) >= 0.0):
            spans[order] = float(np.ptp(days))
    order = min(spans, key=lambda each: spans[each], default="dmy")
    return order, f" ({'day' if order == 'dmy' else 'month'} first, assumed)"


def _day_numbers(a: FloatArray, b: FloatArray, c: FloatArray, order: str) -> FloatArray:
    year, month, day = {"ymd": (a, b, c), "dmy": (c, b, a), "mdy": (c, a, b)}[order]
    year = np.where(year < 100, year + 2000, year)
    months = (year.astype(np.int64) - 1970) * 12 + month.astype(np.int64) - 1
    first = months.astype("datetime64[M]").astype("datetime64[D]").astype(np.int64)
    return np.asarray(first + day - 1, dtype=np.float64)


def _offsets_s(zones: Any) -> FloatArray:
    """Return the offset from UTC that each stamp states [s]."""
    found = dict.fromkeys(set(zones), 0.0)
    for zone in found:
        digits = zone[1:].replace(":", "")
        if zone[:1] in {"+", "-"} and digits.isdigit():
            seconds = int(digits[:2]) * 3600.0 + int(digits[2:] or 0) * 60.0
            found[zone] = -seconds if zone[0] == "-" else seconds
    return np.array([found[zone] for zone in zones])


def _numbers(parts: Any, name: str) -> FloatArray:
    """Return a group as numbers, NaN where it is empty; `59:123` is 59.123."""
    text = pc.replace_substring_regex(parts.field(name), "[,:]", ".")
    valid = pc.fill_null(pc.match_substring_regex(text, r"^\d+(\.\d+)?$"), fill_value=False)
    text = pc.if_else(valid, text, pa.scalar(None, pa.string()))
    numbers = pc.cast(text, pa.float64()).to_numpy(zero_copy_only=False)
    return np.asarray(numbers, dtype=np.float64)


def _text(parts: Any, name: str) -> Any:
    """Return a group in lower case, "" where it is empty."""
    text = pc.fill_null(pc.utf8_lower(parts.field(name)), "")
    return np.asarray(text.to_numpy(zero_copy_only=False), dtype=object)

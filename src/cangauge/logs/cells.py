"""Cells of a table as numbers and as times.

Times are numbers, clock times, or dates with and without a zone. Dates become seconds since 1970
(UTC). A date without a zone is read as UTC: only differences matter.
"""

from __future__ import annotations

import datetime as dt
import re
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.units import convert

MISSING: Final = (
    "nan", "na", "n/a", "#n/a", "null", "none", "-", "--", "1.#qnan", "-1.#ind", "unknown",
    "unavailable", "n.a.",
)  # fmt: skip
"""Cells without a value, in lower case."""
_STAMP: Final = re.compile(
    r"(?P<date>[^:]*?)"
    r"(?:(?:^|[T,_\s])\s*(?P<h>\d{1,5}):(?P<m>\d{1,2})(?::(?P<s>\d{1,2})(?:[.,:](?P<part>\d+))?)?"
    r"\s*(?P<half>[AaPp])?(?:\.?[Mm]\.?)?"
    r"\s*(?P<zone>Z|z|UTC|GMT|(?P<sign>[+-])(?P<zone_h>\d{2})(?::?(?P<zone_m>\d{2}))?)?)?"
)
_DATE: Final = re.compile(
    r"(?:[A-Za-z]{3,9},?\s+)?"
    r"(?:\d{1,4}[-/.](?:\d{1,2}|[A-Za-z]{3})[-/.]\d{1,4}"
    r"|\d{1,2}\.?\s+[A-Za-z]{3,9}\.?,?\s+\d{4}"
    r"|[A-Za-z]{3,9}\.?\s+\d{1,2}(?:st|nd|rd|th)?,?\s+\d{4}),?"
)
"""`2024-03-31`, `31.03.2024`, `31-Mar-2024`, `31 March 2024`, `Sun Mar 31st, 2024`."""
_DAYS: Final = re.compile(r"(\d*)\s*(?:d|days?)?", re.IGNORECASE)
"""Days before a clock time (`2d 01:02:03`), or nothing."""
_MONTHS: Final = {
    "jan": 1, "feb": 2, "mar": 3, "apr": 4, "may": 5, "jun": 6, "jul": 7, "aug": 8, "sep": 9,
    "oct": 10, "nov": 11, "dec": 12, "mrz": 3, "mai": 5, "okt": 10, "dez": 12,
}  # fmt: skip
_1970: Final = dt.date(1970, 1, 1).toordinal()
_EPOCHS: Final = ((1e17, 1e-9, "ns"), (1e14, 1e-6, "µs"), (1e11, 1e-3, "ms"), (1e9, 1.0, "s"))
"""Smallest number since 1970 in each unit, its seconds, its name."""


def is_number(text: str) -> bool:
    """Return whether a text is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _is_text(kind: Any) -> bool:
    """Return whether an Arrow type is text, dictionary-encoded or not."""
    kind = kind.value_type if pa.types.is_dictionary(kind) else kind
    return str(kind) in {"string", "large_string", "string_view"}


def first_text(column: Any) -> str:
    """Return the first value of a column of text; "" of any other."""
    if not _is_text(column.type):
        return ""
    return next((str(cell.as_py()) for cell in column if cell.is_valid), "")


def _present(column: Any) -> Any:
    """Return the trimmed cells of a column of text, null where there is no value."""
    trimmed = pc.utf8_trim_whitespace(column.cast(pa.string()))
    missing = pc.is_in(pc.utf8_lower(trimmed), value_set=pa.array(["", *MISSING]))
    return pc.if_else(missing, pa.scalar(None, pa.string()), trimmed)


# --- Numbers


def numbers_of(column: Any, source: str, label: str) -> tuple[FloatArray, str]:
    """Return a column as numbers, NaN where missing, and the unit in its cells (`53.2 V`).

    Raises
    ------
    InputError
        If a cell holds anything but a number, or the column has another type.
    """
    kind, of = column.type, pa.types
    is_number_type = of.is_integer(kind) or of.is_floating(kind) or of.is_decimal(kind)
    if not (is_number_type or _is_text(kind) or of.is_null(kind)):
        raise InputError(
            "the column does not hold numbers",
            source=source,
            field=label,
            value=str(kind)[:60],
            cure="store it as floating point",
        )
    with suppress(pa.ArrowInvalid):
        return _floats(pc.cast(column, pa.float64(), safe=False)), ""
    cells = _present(column)
    bare, unit = _without_unit(_with_decimal_point(cells))
    try:
        return _floats(pc.cast(bare, pa.float64())), unit
    except pa.ArrowInvalid as error:
        shown = enumerate(cells.to_pylist(), start=1)
        wrong = ((k, text) for k, text in shown if text and not is_number(text.replace(",", ".")))
        row, value = next(wrong, (1, None))
        raise InputError(
            f"row {row} is not a number",
            source=source,
            field=label,
            value=value,
            cure="correct the cell, or leave it empty where the value is unknown",
        ) from error


def _floats(column: Any) -> FloatArray:
    column = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    return np.array(column.to_numpy(zero_copy_only=False), dtype=np.float64)


def _with_decimal_point(cells: Any) -> Any:
    """Return cells with `.` as the decimal mark; the other mark separates thousands."""
    both = pc.and_(pc.match_substring(cells, ","), pc.match_substring(cells, "."))
    if pc.any(both).as_py():
        german = r"^[^,]*,[^,.]*$"  # 1.234,5
        is_comma = pc.any(pc.match_substring_regex(pc.filter(cells, both), german)).as_py()
        cells = pc.replace_substring(cells, "." if is_comma else ",", "")
    return pc.replace_substring(cells, ",", ".")


def _without_unit(cells: Any) -> tuple[Any, str]:
    """Return cells without a unit that all of them carry (`53.2 V`), and the unit."""
    parts = pc.extract_regex(cells, r"^(?P<n>[-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(?P<unit>\D{1,4})$")
    units = pc.unique(pc.struct_field(parts, "unit")).drop_null().to_pylist()
    is_one = len(units) == 1 and parts.null_count == cells.null_count
    return (pc.struct_field(parts, "n"), units[0].strip()) if is_one else (cells, "")


# --- Times


def is_stamp(text: str) -> bool:
    """Return whether a cell holds a date or a clock time."""
    return is_clock(text) or is_date(text)


def is_clock(text: str) -> bool:
    """Return whether a cell holds a clock time without a date."""
    match = _STAMP.fullmatch(text.strip())
    return bool(match and match["h"] and _DAYS.fullmatch(match["date"]))


def is_date(text: str) -> bool:
    """Return whether a cell holds a date, with or without a time of day."""
    match = _STAMP.fullmatch(text.strip())
    return match is not None and _fields(match["date"]) is not None


def seconds_of(
    parts: Sequence[Any], unit: str, factor: float, source: str, label: str
) -> tuple[FloatArray, str]:
    """Return a time column, or a date and its time, as seconds, NaN where empty.

    The second value states how the cells were read: the unit as stated, or as the size of an epoch
    shows. See `_seconds_of_text` for errors.
    """
    if len(parts) > 1:
        cells = pc.binary_join_element_wise(*(part.cast(pa.string()) for part in parts), " ")
        return _seconds_of_text(cells, unit, source, label)
    cells, kind = parts[0], parts[0].type
    if pa.types.is_date(kind):
        cells, kind = cells.cast(pa.timestamp("s")), pa.timestamp("s")
    if pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
        per_second = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[kind.unit]
        counts = _floats(cells.cast(pa.int64()).cast(pa.float64(), safe=False))
        return counts / per_second, str(kind)
    if _is_text(kind):
        filled = _present(cells)
        if not is_number(first_text(filled).replace(",", ".") or "0"):
            return _seconds_of_text(filled, unit, source, label)
    values = numbers_of(cells, source, label)[0] * factor
    if unit:
        return convert(values, "time_s", unit, source=source, label=label)[0], unit
    finite = values[np.isfinite(values)]
    typical = float(np.median(finite)) if finite.size else 0.0
    for least, per_one, name in _EPOCHS:
        if typical >= least:
            return values * per_one, f"{name} since 1970, from its size"
    return values, "s, assumed"


def _seconds_of_text(cells: Any, unit: str, source: str, label: str) -> tuple[FloatArray, str]:
    """Return stamps of text as seconds, NaN where empty, and how they were read.

    All cells are clock times (`1:02:03.5`, `2d 01:02:03`), or dates with or without a time of day.
    `unit` may be an order of dates (`dmy`, `mdy`).

    Raises
    ------
    InputError
        If a cell is no time, or the unit is not known.
    """
    if unit.lower() not in {"dmy", "mdy"}:
        convert(np.empty(0), "time_s", unit, source=source, label=label)
    texts: list[str | None] = cells.to_pylist()
    clock = is_clock(next((text for text in texts if text), ""))
    dates: dict[str, int] = {}
    date, zones = np.zeros(len(texts), dtype=np.intp), False
    of_day_s, offset_s = np.full((2, len(texts)), np.nan)
    for row, text in enumerate(texts):
        match = _STAMP.fullmatch(text.strip()) if text else None
        if match and (match["h"] or not clock):
            date[row] = dates.setdefault(match["date"], len(dates))
            of_day_s[row], offset_s[row] = _of_day_s(match)
            zones = zones or bool(match["zone"])
    days, how = _days_before_clock([*dates]) if clock else _days_since_1970([*dates], unit.lower())
    values = np.array([*days, np.nan])[date] * 86400.0 + of_day_s
    wrong = next((row for row in np.flatnonzero(np.isnan(values)) if texts[row]), None)
    if wrong is not None:
        raise InputError(
            f"row {wrong + 1} is not a time",
            source=source,
            field=label,
            value=texts[wrong],
            cure="seconds, hh:mm:ss or dates are read; name another column with --columns time=…",
        )
    if not clock:
        return values - offset_s, f"{how} with{'' if zones else 'out'} zone"
    known = np.isfinite(values)
    midnights = np.cumsum(np.diff(values[known], prepend=0.0) < -43200.0)
    values[known] += midnights * 86400.0
    return values, how


def _of_day_s(match: re.Match[str]) -> tuple[float, float]:
    """Return the time of day of a stamp and its offset from UTC [s]; `59:123` is 59.123 s."""
    hour, second = float(match["h"] or 0), float(f"{match['s'] or 0}.{match['part'] or 0}")
    if match["half"]:
        hour = hour % 12.0 + (12.0 if match["half"] in "Pp" else 0.0)
    offset_s = float(match["zone_h"] or 0) * 3600.0 + float(match["zone_m"] or 0) * 60.0
    of_day_s = hour * 3600.0 + float(match["m"] or 0) * 60.0 + second
    return of_day_s, -offset_s if match["sign"] == "-" else offset_s


def _days_before_clock(texts: Sequence[str]) -> tuple[list[float], str]:
    matches = map(_DAYS.fullmatch, texts)
    return [float(match[1] or 0) if match else np.nan for match in matches], "clock time"


def _fields(date: str) -> tuple[int, ...] | None:
    """Return the three numbers of a date; year, month and day where the month is a word."""
    words = re.findall(r"\d+|[a-z]{3,}", date.lower()) if _DATE.fullmatch(date.strip()) else []
    numbers = [int(word) for word in words if word.isdigit()]
    months = [_MONTHS[word[:3]] for word in words if word[:3] in _MONTHS]
    if months and len(numbers) == 2:
        day, year = numbers if numbers[0] <= 31 else numbers[::-1]
        return year + 2000 * (year < 100), months[0], day
    return tuple(numbers) if len(numbers) == 3 else None


def _days_since_1970(texts: Sequence[str], given: str) -> tuple[list[float], str]:
    """Return days of dates, NaN where a text is none, and how they were read."""
    fields = [_fields(text) for text in texts]
    if any(each and each[0] > 31 for each in fields):
        return [_day(each, "ymd") for each in fields], "date"
    orders = [given] if given in {"dmy", "mdy"} else ["dmy", "mdy"]
    days = {order: [_day(each, order) for each in fields] for order in orders}
    gaps = {order: np.isnan(each).sum() for order, each in days.items()}
    finite = {order: [day for day in days[order] if np.isfinite(day)] or [0.0] for order in orders}
    # A log is short: the order of fewer days.
    best = min(orders, key=lambda order: (gaps[order], max(finite[order]) - min(finite[order])))
    note = "day first" if best == "dmy" else "month first"
    if given == best:
        note = f"{best} as given"
    elif gaps["dmy"] == gaps["mdy"]:
        note += ", assumed"
    return days[best], f"date ({note})"


def _day(fields: tuple[int, ...] | None, order: str) -> float:
    """Return days since 1970, NaN where there is no such day."""
    if fields is None:
        return np.nan
    year, month, day = (fields[order.index(letter)] for letter in "ymd")
    try:
        return float(dt.date(year + 2000 * (year < 100), month, day).toordinal() - _1970)
    except ValueError:
        return np.nan

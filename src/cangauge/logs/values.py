"""Cells of a table's column: which of them hold no value, and the numbers in the others."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cangauge._typing import FloatArray
from cangauge.errors import InputError

_WORDS: Final = "nan na n/a #n/a null none - -- 1.#qnan -1.#ind unknown unavailable n.a."
MISSING: Final = ("", *_WORDS.split())
"""Cells without a value, in lower case."""
_WITH_UNIT: Final = r"^(?P<number>[-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(?P<unit>\D{1,4})$"
_BARE: Final = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_NUMBER: Final = r"^[-+]?[\d.,]*\d[\d.,]*(?:[eE][-+]?\d+)?\s*\D{0,4}$"
_SPELLINGS: Final = (("[\u2212\u2013]", "-"), ("['\u2019\u00a0\u202f](\\d{3})", r"\1"))
"""A typographic minus; 1'800."""
_THOUSANDS: Final = r"^[-+]?[1-9]\d{{0,2}}(?:[{}]\d{{3}})+\D{{0,5}}$"
_DATE: Final = re.compile(r"\d{1,4}\.\d{1,2}\.\d{1,4}")
"""`13.03.2024` has no decimal mark."""
_MARKS: Final = {",": ".", ".": ","}
"""What separates decimals, and what then may separate thousands."""


def is_number(text: str) -> bool:
    """Return whether a text is a number; its decimal mark may be a comma."""
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True


def is_bare(text: str) -> bool:
    """Return whether a cell is a number as programs write it."""
    return _BARE.fullmatch(text) is not None


def is_spelled(text: str) -> bool:
    """Return whether a cell is a number of another spelling: `1.800,5`, `53.2 V`, `−7`."""
    for pattern, replacement in _SPELLINGS:
        text = re.sub(pattern, replacement, text)
    return re.match(_NUMBER, text) is not None and not is_bare(text)


def is_text(column: Any) -> bool:
    """Return whether an Arrow column holds text, dictionary-encoded or not."""
    kind = column.type.value_type if pa.types.is_dictionary(column.type) else column.type
    return str(kind) in {"string", "large_string", "string_view"}


def present(column: Any) -> Any:
    """Return the trimmed cells of a column of text, null where there is no value."""
    trimmed = pc.utf8_trim_whitespace(column.cast(pa.string()))
    is_missing = pc.is_in(pc.utf8_lower(trimmed), value_set=pa.array(MISSING))
    return pc.if_else(is_missing, pa.scalar(None, pa.string()), trimmed)


def first_text(column: Any) -> str:
    """Return the first value of a column of text; "" of any other."""
    cells = column if is_text(column) else ()
    return next((str(cell.as_py()) for cell in cells if cell.is_valid), "")


def numbers_of(column: Any, source: str, label: str) -> tuple[FloatArray, str]:
    """Return a column as numbers, NaN where missing, and the unit in its cells (`53.2 V`).

    Raises
    ------
    InputError
        If a cell holds anything but a number, or the column has another type.
    """
    of, kind = pa.types, column.type
    is_numeric = of.is_integer(kind) or of.is_floating(kind) or of.is_decimal(kind)
    if not (is_numeric or is_text(column) or of.is_null(kind)):
        problem, cure = "the column does not hold numbers", "store it as floating point"
        raise InputError(problem, source=source, field=label, value=str(kind)[:60], cure=cure)
    unit = ""
    try:
        try:
            numbers = pc.cast(column, pa.float64(), safe=False)
        except pa.ArrowInvalid:
            bare, unit = _without_unit(present(with_decimal_points({0: column})[0]))
            numbers = pc.cast(bare, pa.float64())
    except pa.ArrowInvalid as error:
        texts = enumerate(present(column).to_pylist(), start=1)
        wrong = ((k, text) for k, text in texts if text and not is_number(text))
        row, value = next(wrong, (1, None))
        cure = "correct the cell, or leave it empty where the value is unknown"
        problem = f"row {row} is not a number"
        raise InputError(problem, source=source, field=label, value=value, cure=cure) from error
    return np.array(numbers.to_numpy(), dtype=np.float64), unit


def with_decimal_points(columns: Mapping[int, Any]) -> dict[int, Any]:
    """Return the columns of one table with `-` as minus and `.` as the only mark in numbers.

    A mark separates thousands in a column where each of its uses fits that (`1,800`), if the other
    mark is decimal: it follows in the same cell, or the table's numbers use it and not this one.
    """
    texts: dict[int, Any] = {}
    for place, column in columns.items():
        if is_text(column):
            cells = column.cast(pa.string())
            for pattern, replacement in _SPELLINGS:
                cells = pc.replace_substring_regex(cells, pattern, replacement)
            first = first_text(present(cells))
            if re.match(_NUMBER, first) and not _DATE.fullmatch(first):
                texts[place] = cells
    if not any(_any(cells, ",") for cells in texts.values()):
        return {**columns, **texts}
    one_mark = r"^[^.,]*[{}][^.,]*$"
    used = {mark for mark in _MARKS for cells in texts.values() if _odd(cells, one_mark, mark)}
    for place, cells in texts.items():
        for mark, other in _MARKS.items():
            follows = _any(cells, rf"[{other}][^{other}]*[{mark}][^{mark}{other}]*$")
            if follows or (used == {mark} and not _odd(cells, "[{}]", other)):
                texts[place] = pc.replace_substring(cells, other, "")
                break
        texts[place] = pc.replace_substring(texts[place], ",", ".")
    return {**columns, **texts}


def _any(cells: Any, pattern: str) -> bool:
    return bool(pc.any(pc.match_substring_regex(cells, pattern)).as_py())


def _odd(cells: Any, pattern: str, mark: str) -> bool:
    """Return whether a mark stands as in a pattern where it cannot separate thousands."""
    has_mark = pc.match_substring_regex(cells, pattern.format(mark))
    fits = pc.match_substring_regex(cells, _THOUSANDS.format(mark))
    return bool(pc.any(pc.and_not(has_mark, fits)).as_py())


def unit_in_cell(text: str) -> str:
    """Return the unit of a number in a cell (`5 sec`), "" without any."""
    match = re.match(_WITH_UNIT, text)
    return match["unit"].strip() if match else ""


def _without_unit(cells: Any) -> tuple[Any, str]:
    """Return cells without the unit, and the unit, where all of them carry the same one."""
    parts = pc.extract_regex(cells, _WITH_UNIT)
    if pc.any(pc.and_(pc.is_null(parts), pc.is_valid(cells))).as_py():
        return cells, ""
    parts = parts.combine_chunks() if isinstance(parts, pa.ChunkedArray) else parts
    units = pc.drop_null(pc.unique(parts.field("unit"))).to_pylist()
    return (parts.field("number"), units[0].strip()) if len(units) == 1 else (cells, "")

"""Cells of a table's column: which of them hold no value, and the numbers in the others."""

from __future__ import annotations

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
_POINT_BEFORE_COMMA: Final = r"^[^,]*,[^,.]*$"
"""Of a cell with both marks: 1.234,5."""


def is_number(text: str) -> bool:
    """Return whether a text is a number; its decimal mark may be a comma."""
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True


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

    def error(problem: str, value: object, cure: str) -> InputError:
        return InputError(problem, source=source, field=label, value=value, cure=cure)

    of, kind = pa.types, column.type
    is_numeric = of.is_integer(kind) or of.is_floating(kind) or of.is_decimal(kind)
    if not (is_numeric or is_text(column) or of.is_null(kind)):
        cure = "store it as floating point"
        raise error("the column does not hold numbers", str(kind)[:60], cure)
    unit = ""
    try:
        try:
            numbers = pc.cast(column, pa.float64(), safe=False)
        except pa.ArrowInvalid:
            bare, unit = _without_unit(_with_decimal_point(present(column)))
            numbers = pc.cast(bare, pa.float64())
    except pa.ArrowInvalid as problem:
        texts = enumerate(present(column).to_pylist(), start=1)
        wrong = ((k, text) for k, text in texts if text and not is_number(text))
        row, value = next(wrong, (1, None))
        cure = "correct the cell, or leave it empty where the value is unknown"
        raise error(f"row {row} is not a number", value, cure) from problem
    return np.array(numbers.to_numpy(), dtype=np.float64), unit


def _with_decimal_point(cells: Any) -> Any:
    """Return cells with `.` as the decimal mark; the other mark separates thousands."""
    both = pc.and_(pc.match_substring(cells, ","), pc.match_substring(cells, "."))
    if pc.any(both).as_py():
        with_both = pc.filter(cells, both)
        is_comma = pc.any(pc.match_substring_regex(with_both, _POINT_BEFORE_COMMA)).as_py()
        cells = pc.replace_substring(cells, "." if is_comma else ",", "")
    return pc.replace_substring(cells, ",", ".")


def _without_unit(cells: Any) -> tuple[Any, str]:
    """Return cells without the unit, and the unit, where all of them carry the same one."""
    parts = pc.extract_regex(cells, _WITH_UNIT)
    if pc.any(pc.and_(pc.is_null(parts), pc.is_valid(cells))).as_py():
        return cells, ""
    parts = parts.combine_chunks() if isinstance(parts, pa.ChunkedArray) else parts
    units = pc.drop_null(pc.unique(parts.field("unit"))).to_pylist()
    return (parts.field("number"), units[0].strip()) if len(units) == 1 else (cells, "")

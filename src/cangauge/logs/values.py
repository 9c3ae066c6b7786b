"""Cells of a table: which of them hold no value, and the numbers in the others."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cangauge._typing import FloatArray
from cangauge.errors import InputError

_MISSING: Final = "nan na n/a #n/a null none - -- 1.#qnan -1.#ind unknown unavailable n.a."
"""Cells without a value, in lower case."""
_WITH_UNIT: Final = r"^(?P<number>[-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(?P<unit>\D{1,4})$"
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


def typical(values: FloatArray) -> float:
    """Return the median of at most 20,000 evenly spaced values of shape (n,), 0 of none.

    It tells the unit of a column. That of all values takes as long as reading them.
    """
    sample = values[:: 1 + values.size // 10_000]
    return float(np.median(sample)) if sample.size else 0.0


def is_text(column: Any) -> bool:
    """Return whether an Arrow column holds text, dictionary-encoded or not."""
    kind = column.type.value_type if pa.types.is_dictionary(column.type) else column.type
    return str(kind) in {"string", "large_string", "string_view"}


def first_text(column: Any) -> str:
    """Return the first value of a column of text; "" of any other."""
    known = column.drop_null()[:1].to_pylist() if is_text(column) else []
    return str(known[0]) if known else ""


def read_cells(columns: Mapping[int, Any], headings: Sequence[str]) -> dict[int, Any]:
    """Return columns of one table: text that holds numbers as these, other text trimmed.

    Null stands where there is no value, and where a restarted logger wrote its header again. If all
    numbers are written as programs do, that is all. If not, the columns of numbers are read again
    as they are spelled (`−1'800,5 V`): what a mark means in one column tells it in another.
    """
    texts = {place: each.cast(pa.string()) for place, each in columns.items() if is_text(each)}
    read = {**columns}
    for place, cells in texts.items():
        read[place] = _as_numbers(cells)
        if is_text(read[place]):
            texts[place] = _present(cells, headings[place])
            read[place] = _as_numbers(texts[place])
    if any(is_text(read[place]) and _begins_with_number(cells) for place, cells in texts.items()):
        spelled = {place: cells for place, cells in texts.items() if _begins_with_number(cells)}
        for place, cells in _with_decimal_points(spelled).items():
            read[place] = _as_numbers(cells)
    return read


def numbers_in(beginning: Any) -> dict[str, Any]:
    """Return the types of columns of numbers by the beginning of a table, unless one is spelled.

    They are then parsed without the text, which would take twice the memory of a long log.
    """
    columns = dict(zip(beginning.column_names, beginning.columns, strict=True))
    bare = [name for name, cells in columns.items() if not is_text(_as_numbers(cells))]
    texts = [_present(cells, name) for name, cells in columns.items() if name not in bare]
    texts = [cells for cells in texts if is_text(_as_numbers(cells))]
    return {} if any(map(_begins_with_number, texts)) else dict.fromkeys(bare, pa.float64())


def _as_numbers(cells: Any) -> Any:
    """Return cells of text as numbers, or as they are if one is none."""
    try:
        return pc.cast(cells, pa.float64())
    except pa.ArrowInvalid:
        return cells


def _present(cells: Any, heading: str) -> Any:
    """Return trimmed cells, null where there is no value but perhaps the heading."""
    trimmed = pc.utf8_trim_whitespace(cells)
    missing = pa.array(["", heading.lower(), *_MISSING.split()])
    is_missing = pc.is_in(pc.utf8_lower(trimmed), value_set=missing)
    return pc.if_else(is_missing, pa.scalar(None, pa.string()), trimmed)


def _begins_with_number(cells: Any) -> bool:
    first = first_text(cells)
    for pattern, alike in _SPELLINGS:
        first = re.sub(pattern, alike, first)
    return re.match(_NUMBER, first) is not None and not _DATE.fullmatch(first)


def _with_decimal_points(columns: Mapping[int, Any]) -> dict[int, Any]:
    """Return columns of numbers with `-` as minus and `.` as the only mark.

    A mark separates thousands in a column where each of its uses fits that (`1,800`), if the other
    mark is decimal: it follows in the same cell, or the table's numbers use it and not this one.
    """
    texts = {**columns}
    for pattern, alike in _SPELLINGS:
        for place, cells in texts.items():
            texts[place] = pc.replace_substring_regex(cells, pattern, alike)
    one_mark = r"^[^.,]*[{}][^.,]*$"
    used = {mark for mark in _MARKS for cells in texts.values() if _odd(cells, one_mark, mark)}
    for place, cells in texts.items():
        for mark, other in _MARKS.items():
            follows = _any(cells, rf"[{other}][^{other}]*[{mark}][^{mark}{other}]*$")
            if follows or (used == {mark} and not _odd(cells, "[{}]", other)):
                texts[place] = pc.replace_substring(cells, other, "")
                break
        texts[place] = pc.replace_substring(texts[place], ",", ".")
    return texts


def _any(cells: Any, pattern: str) -> bool:
    return bool(pc.any(pc.match_substring_regex(cells, pattern)).as_py())


def _odd(cells: Any, pattern: str, mark: str) -> bool:
    """Return whether a mark stands as in a pattern where it cannot separate thousands."""
    has_mark = pc.match_substring_regex(cells, pattern.format(mark))
    fits = pc.match_substring_regex(cells, _THOUSANDS.format(mark))
    return bool(pc.any(pc.and_not(has_mark, fits)).as_py())


def numbers_of(column: Any, source: str, label: str) -> tuple[FloatArray, str]:
    """Return a column as numbers, NaN where missing, and the unit in its cells (`53.2 V`).

    Raises
    ------
    InputError
        If a cell holds anything but a number, or the column has another type.
    """
    cells, unit = _without_unit(column) if is_text(column) else (column, "")
    of, kind = pa.types, cells.type
    is_numeric = of.is_integer(kind) or of.is_floating(kind) or of.is_decimal(kind)
    if not (is_numeric or is_text(cells) or of.is_null(kind)):
        problem, cure = "the column does not hold numbers", "store it as floating point"
        raise InputError(problem, source=source, field=label, value=str(kind)[:60], cure=cure)
    try:
        numbers = pc.cast(cells, pa.float64(), safe=False)
    except pa.ArrowInvalid as error:
        texts = enumerate(column.to_pylist(), start=1)
        row, value = next(
            ((k, text) for k, text in texts if text and not is_number(text)), (1, None)
        )
        cure = "correct the cell, or leave it empty where the value is unknown"
        problem = f"row {row} is not a number"
        raise InputError(problem, source=source, field=label, value=value, cure=cure) from error
    return np.array(numbers.to_numpy(), dtype=np.float64), unit  # not the memory of the table


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

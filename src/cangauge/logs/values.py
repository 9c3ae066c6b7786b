"""Cells of a table: which of them hold no value, and the numbers in the others."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
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
_DATE: Final = r"^\d{1,4}\.\d{1,2}\.\d{1,4}$"
"""`13.03.2024` has no decimal mark."""
_MARKS: Final = {",": ".", ".": ","}
"""What separates decimals, and what then may separate thousands."""


class UnclearMarkError(InputError):
    """A mark may separate thousands or decimals, and no number of the table shows which."""


def is_number(text: str) -> bool:
    """Return whether a text is a number; its decimal mark may be a comma."""
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True


def typical(values: FloatArray) -> float:
    """Return the median of at most 20,000 evenly spaced values of shape (n,), 0 of none.

    It shows the unit of a column. The median of all values takes as long as reading them.
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


def read_cells(
    columns: Mapping[int, Any],
    headings: Sequence[str],
    source: str | None,
    decimal_mark: str = "",
    *,
    times: Collection[int] = (),
    optional: Collection[int] = (),
) -> dict[int, Any]:
    """Return columns of one table: numbers in text as numbers, other text trimmed.

    Missing values, and headers repeated by a restarted logger, become null. Numbers may be spelled
    in any way (`−1'800,5 V`). The decimal mark of a column is the one that its own numbers prove,
    else that of the table's other columns, else `decimal_mark`. Decimal points in `times` prove
    nothing for the others: programs write them beside decimal commas.

    Raises
    ------
    UnclearMarkError
        If a mark may separate thousands or decimals (`3,800`). An `optional` column stays text.
    """
    texts = {
        place: _present(cells.cast(pa.string()), headings[place])
        for place, cells in columns.items()
        if is_text(cells)
    }
    spelled = {
        place: _spelled_alike(cells)
        for place, cells in texts.items()
        if not pc.all(pc.match_substring(cells, ":")).as_py()  # a column of clock times
    }
    texts |= spelled
    numbers = {place: _numbers_among(cells) for place, cells in spelled.items()}
    numbers = {place: cells for place, cells in numbers.items() if _any(cells, "[.,]")}
    proven = {place: _decimal_marks(cells) for place, cells in numbers.items()}
    of_table = {
        mark
        for place, marks in proven.items()
        for mark in marks
        if mark == "," or place not in times
    }
    for place, cells in numbers.items():
        marks = proven[place] if len(proven[place]) == 1 else of_table or {*decimal_mark}
        if marks:
            thousands = _MARKS[min(marks)] if len(marks) == 1 else "'"
            bare = pc.replace_substring(pc.replace_substring(cells, thousands, ""), ",", ".")
            texts[place] = pc.coalesce(bare, texts[place])
        elif place not in optional:
            _refuse_unclear(cells, source, headings[place])
    return {**columns, **{place: _as_numbers(cells) for place, cells in texts.items()}}


def numbers_in(beginning: Any, times: Collection[str] = ()) -> dict[str, Any]:
    """Return the types of columns of numbers by the beginning of a table.

    They are then parsed without the text, which would take twice the memory of a long log. A later
    cell of another spelling fails to parse: a decimal comma, or a point if the beginning does not
    prove points to be decimal.
    """
    columns = dict(zip(beginning.column_names, beginning.columns, strict=True))
    bare = [name for name, cells in columns.items() if not is_text(_as_numbers(cells))]
    if has_spelled_numbers([columns[name] for name in columns.keys() - bare]):
        return {}
    if any(_is_no_thousands(columns[name], ".") for name in bare if name not in times):
        return dict.fromkeys(bare, pa.float64())
    has_points = any(_any(columns[name], "[.]") for name in bare)
    return {} if has_points else dict.fromkeys(bare, pa.int64())


def has_spelled_numbers(columns: Sequence[Any]) -> bool:
    """Return whether columns hold numbers with commas (`3,8`)."""
    texts = [cells for cells in columns if is_text(cells)]
    with_commas = [cells for cells in texts if pc.any(pc.match_substring(cells, ",")).as_py()]
    return any(_any(_numbers_among(_spelled_alike(cells)), "[,]") for cells in with_commas)


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


def _spelled_alike(cells: Any) -> Any:
    """Return cells with `-` as minus, and without blanks and apostrophes between thousands."""
    for pattern, alike in _SPELLINGS:
        cells = pc.replace_substring_regex(cells, pattern, alike)
    return cells


def _numbers_among(cells: Any) -> Any:
    """Return the cells that are numbers, in any spelling; the others null."""
    is_number = pc.and_not(
        pc.match_substring_regex(cells, _NUMBER), pc.match_substring_regex(cells, _DATE)
    )
    return pc.if_else(is_number, cells, pa.scalar(None, pa.string()))


def _decimal_marks(numbers: Any) -> set[str]:
    """Return the marks that must be decimal in a column.

    A mark is decimal if its digits cannot be groups of thousands (`3,8`), if it follows the other
    mark (`1.800,500`), or if the other mark stands twice (`1.800.500`).
    """
    return {
        mark
        for mark, other in _MARKS.items()
        if _is_no_thousands(numbers, mark)
        or _any(numbers, rf"[{other}][^{other}]*[{mark}][^{mark}{other}]*$")
        or _any(numbers, rf"[{other}]\d{{3}}[{other}]")
    }


def _refuse_unclear(numbers: Any, source: str | None, label: str) -> None:
    """Raise UnclearMarkError if a mark may separate thousands as well as decimals.

    A point is decimal, as programs write it, unless `1.800` stands beside `950`: programs write
    either all decimals in all cells or no trailing zeros.
    """
    has_points = _any(numbers, "[.].*0$") and _any(numbers, r"^[-+]?[1-9]\d*$")
    marked = pc.match_substring_regex(numbers, "[.,]" if has_points else "[,]")
    unclear = numbers.filter(pc.fill_null(marked, fill_value=False))
    if len(unclear):
        text = unclear[0].as_py()
        plain = re.sub("[.,]", "", text)
        problem = f"it may be {text.replace(',', '.')} or {plain}: three digits follow each mark"
        cure = "export the numbers without marks of thousands, with a decimal point"
        raise UnclearMarkError(problem, source=source, field=label, value=text, cure=cure)


def _any(cells: Any, pattern: str) -> bool:
    return bool(pc.any(pc.match_substring_regex(cells, pattern)).as_py())


def _is_no_thousands(cells: Any, mark: str) -> bool:
    """Return whether the only mark of a cell cannot separate thousands (`3,8`, `0,800`)."""
    has_mark = pc.match_substring_regex(cells, rf"^[^.,]*[{mark}][^.,]*$")
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

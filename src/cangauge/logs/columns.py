"""Columns of numbers from delimited text, with errors that name row and value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv

from cangauge._io import MAX_LOG_BYTES, MAX_LOG_COLUMNS, MAX_LOG_ROWS, MAX_ODD_ROWS
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.file_content import FileContent, split_cells

_MISSING: Final = pa.array(
    [
        "",
        "nan",
        "na",
        "n/a",
        "#n/a",
        "null",
        "none",
        "-",
        "--",
        "1.#qnan",
        "-1.#ind",
        "unknown",
        "unavailable",
        "n.a.",
    ]
)


@dataclass(frozen=True, slots=True)
class Columns:
    """Some columns of a delimited text.

    Parameters
    ----------
    text : dict of str to pyarrow.ChunkedArray
        The cells as text, by the requested name.
    label : dict of str to str
        The column's heading in the file, by the requested name.
    source : str
        The file.
    decimal_comma : bool
        Whether `391,4` means 391.4.
    remarks : tuple of str
        Lines that were omitted.
    units : dict of str to str
        Unit in the cells of a column that was read as numbers (`53.2 V`), by name.
    """

    text: dict[str, Any]
    label: dict[str, str]
    source: str
    decimal_comma: bool
    remarks: tuple[str, ...]
    units: dict[str, str] = field(default_factory=dict)

    def numbers(self, name: str) -> FloatArray:
        """Return a column as float64 of shape (rows,), NaN where the cell is empty.

        Raises
        ------
        InputError
            If a cell holds anything but a number.
        """
        trimmed = self._present(name)
        if self.decimal_comma:
            trimmed = _with_decimal_point(trimmed)
        try:
            return np.asarray(pc.cast(trimmed, pa.float64()).to_numpy(), dtype=np.float64)
        except pa.ArrowInvalid as error:
            bare = without_unit(trimmed)
            if bare is not None:
                numbers, self.units[name] = bare
                return np.asarray(pc.cast(numbers, pa.float64()).to_numpy(), dtype=np.float64)
            row, value = next(
                (
                    (row, value)
                    for row, value in enumerate(trimmed.to_pylist(), start=1)
                    if value is not None and not is_number(value)
                ),
                (1, str(trimmed[0])),
            )
            raise InputError(
                f"row {row} is not a number",
                source=self.source,
                field=self.label[name],
                value=value,
                cure="correct the cell, or leave it empty where the value is unknown",
            ) from error

    def stamps(self, name: str) -> Any:
        """Return a column as numbers, or as a pyarrow string array if its first cell is none."""
        cells = self._present(name)
        first = next((cell.as_py() for cell in cells if cell.is_valid), "")
        return self.numbers(name) if is_number(first.replace(",", ".")) else cells

    def _present(self, name: str) -> Any:
        """Return the trimmed cells of a column, null where there is no value."""
        trimmed = pc.utf8_trim_whitespace(self.text[name])
        missing = pc.is_in(pc.utf8_lower(trimmed), value_set=_MISSING)
        return pc.if_else(missing, pa.scalar(None, pa.string()), trimmed)


def _with_decimal_point(cells: Any) -> Any:
    """Return cells with `.` as the decimal mark; the other mark separates thousands."""
    both = pc.and_(pc.match_substring(cells, ","), pc.match_substring(cells, "."))
    if pc.any(both).as_py():
        last = r"^[^,]*,[^,.]*$"  # 1.234,5
        is_comma = pc.any(pc.match_substring_regex(pc.filter(cells, both), last)).as_py()
        cells = pc.replace_substring(cells, "." if is_comma else ",", "")
    return pc.replace_substring(cells, ",", ".")


def without_unit(cells: Any) -> tuple[Any, str] | None:
    """Return cells without a unit that all of them carry (`53.2 V`), and the unit, or None."""
    parts = pc.extract_regex(
        cells, r"^(?P<number>[-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(?P<unit>\D{1,4})$"
    )
    if pc.any(pc.and_(pc.is_null(parts), pc.is_valid(cells))).as_py():
        return None
    if isinstance(parts, pa.ChunkedArray):
        parts = parts.combine_chunks()
    units = pc.drop_null(pc.unique(parts.field("unit"))).to_pylist()
    return (parts.field("number"), units[0].strip()) if len(units) == 1 else None


_SPELLINGS: Final = [
    spelled
    for text in _MISSING.to_pylist()
    for spelled in dict.fromkeys((text, text.upper(), text.capitalize(), "NaN"))
]


def read_plain_numbers(
    content: FileContent,
    wanted: Mapping[str, int],
    *,
    header: list[str],
    delimiter: str,
    skip_lines: int,
) -> dict[str, FloatArray] | None:
    """Read columns of plain numbers as `Columns.numbers` does, without holding the text.

    Parameters
    ----------
    content, wanted, header, delimiter, skip_lines
        As of `read_columns`.

    Returns
    -------
    dict of str to array of shape (rows,), or None
        None where the text holds anything else, such as decimal commas or a row that is cut off:
        `read_columns` reads that, or raises the error.
    """
    names = [f"c{index}" for index in range(_width(content, header, delimiter, skip_lines))]
    include = {name: names[index] for name, index in wanted.items()}
    convert = pacsv.ConvertOptions(
        include_columns=list(include.values()),
        column_types=dict.fromkeys(include.values(), pa.float64()),
        null_values=_SPELLINGS,
    )
    parts: dict[str, list[FloatArray]] = {name: [] for name in wanted}
    rows, size, piece = 0, 0, b""
    for piece in content.read_pieces():
        size += len(piece)
        if size > MAX_LOG_BYTES or rows > MAX_LOG_ROWS:
            return None
        try:
            table = pacsv.read_csv(
                pa.BufferReader(piece),
                read_options=pacsv.ReadOptions(
                    use_threads=False, column_names=names, skip_rows=0 if rows else skip_lines
                ),
                parse_options=pacsv.ParseOptions(delimiter=delimiter),
                convert_options=convert,
            )
        except (pa.ArrowException, OSError):
            return None
        rows += table.num_rows
        for name, column in include.items():
            parts[name].append(np.array(table.column(column).to_numpy()))
    if not rows or not piece.endswith(b"\n"):
        return None
    return {name: np.concatenate(parts.pop(name)) for name in wanted}


def read_columns(
    content: FileContent,
    wanted: Mapping[str, int],
    *,
    header: list[str],
    delimiter: str,
    skip_lines: int,
) -> Columns:
    """Read some columns of the lines after the first `skip_lines`.

    A line with another number of cells than the first row is an error, except at the end: a cut
    last line and closing remarks of the exporter are omitted, with a remark.

    Parameters
    ----------
    content : FileContent
    wanted : mapping of str to int
        Index of the column, from 0, by the name to give it.
    header : list of str
        Headings, for messages and for the number of cells.
    delimiter : str
        One character.
    skip_lines : int
        Lines before the data: preamble and header.

    Raises
    ------
    InputError
        If there is no row, or a row in the middle has the wrong number of cells.
    """
    width = _width(content, header, delimiter, skip_lines)
    odd: list[Any] = []

    def collect(row: Any) -> str:
        odd.append(row)
        return "skip" if len(odd) < MAX_ODD_ROWS else "error"

    names = [f"c{index}" for index in range(width)]
    include = [names[index] for index in wanted.values()]
    data = content.read()
    try:
        table = pacsv.read_csv(
            pa.BufferReader(data),
            # One thread: otherwise pyarrow does not number odd rows.
            read_options=pacsv.ReadOptions(
                use_threads=False, column_names=names, skip_rows=skip_lines
            ),
            parse_options=pacsv.ParseOptions(delimiter=delimiter, invalid_row_handler=collect),
            convert_options=pacsv.ConvertOptions(
                include_columns=include,
                column_types=dict.fromkeys(include, pa.string()),
                strings_can_be_null=False,
            ),
        )
    except (pa.ArrowException, OSError) as error:
        if len(odd) >= MAX_ODD_ROWS:
            raise _odd_row(odd[0], skip_lines, content) from error
        reason = str(error).splitlines()[0]
        raise InputError(f"the table cannot be read: {reason}", source=content.path) from error
    if table.num_rows > MAX_LOG_ROWS:
        raise InputError(
            f"more than the {MAX_LOG_ROWS} rows that a log may have",
            source=content.path,
            value=table.num_rows,
            cure="split it",
        )
    if not table.num_rows:
        raise _no_rows(content)
    remarks = _remarks_on_odd_rows(odd, table.num_rows, skip_lines, content)
    if not data.endswith((b"\n", b"\r")):
        remarks.append(
            "the last line has no line end: if the file was cut off, its last value may be short"
        )
    text = {name: table.column(f"c{index}") for name, index in wanted.items()}
    return Columns(
        text=text,
        label={
            name: header[index] if index < len(header) else f"column {index + 1}"
            for name, index in wanted.items()
        },
        source=str(content.path),
        decimal_comma=any(
            pc.any(pc.match_substring(column, ",")).as_py() for column in text.values()
        ),
        remarks=tuple(remarks),
    )


def _width(content: FileContent, header: list[str], delimiter: str, skip_lines: int) -> int:
    """Return the number of cells of the first data row: headers can be shorter than rows."""
    first = next((line for line in content.head[skip_lines:] if line.strip()), None)
    if first is None:
        raise _no_rows(content)
    width = len(split_cells(first, delimiter))
    if width > MAX_LOG_COLUMNS:
        raise InputError(
            f"more than the {MAX_LOG_COLUMNS} columns that a log may have",
            source=content.path,
            value=width,
            cure="export only the columns that are needed",
        )
    named = max((i + 1 for i, name in enumerate(header) if name), default=0)
    if width < named:
        raise InputError(
            f"row 1 has {width} cells where the header has {named}",
            source=content.path,
            cure="the file looks cut off or has another delimiter: export it again",
        )
    return width


def _remarks_on_odd_rows(
    odd: list[Any], rows: int, skip_lines: int, content: FileContent
) -> list[str]:
    # pyarrow numbers rows from 1, skipped lines included; only the last ones may be odd.
    last = skip_lines + rows + len(odd)
    remarks = []
    for row in odd:
        closing = row.actual_columns == 1 and not is_number(row.text)
        if row.number > last - len(odd) and closing:
            remarks.append(f"closing line omitted: {row.text.strip()[:60]!r}")
        elif row.number == last and row.actual_columns < row.expected_columns:
            remarks.append("the last line is cut off and was omitted: the file may be incomplete")
        else:
            raise _odd_row(row, skip_lines, content)
    return remarks


def _odd_row(row: Any, skip_lines: int, content: FileContent) -> InputError:
    return InputError(
        f"row {row.number - skip_lines} has {row.actual_columns} cells where the others"
        f" have {row.expected_columns}",
        source=content.path,
        cure="export the file again",
    )


def _no_rows(content: FileContent) -> InputError:
    return InputError(
        "there are no rows below the header", source=content.path, cure="check the export"
    )


def is_number(text: str) -> bool:
    """Return whether a text is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True

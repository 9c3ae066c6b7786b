"""Tables in text: where they begin, and their columns.

A text may have a preamble, a header of two rows, a row of units, `,`, `;`, tab or `|` between the
columns, and a last line that is cut off.
"""

from __future__ import annotations

import csv
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import product, repeat
from typing import Any, Final, NamedTuple

import pyarrow as pa
import pyarrow.csv as pacsv

from cangauge._files import HEAD_BYTES, Head, as_utf8
from cangauge.errors import InputError
from cangauge.logs.column_map import ColumnMap
from cangauge.logs.columns import NEEDED, Choice, choose_columns
from cangauge.logs.headings import meaning_of
from cangauge.logs.quantities import FIELDS, unit_of
from cangauge.logs.stamps import count_stamps
from cangauge.logs.values import (
    has_spelled_numbers,
    is_number,
    numbers_in,
    read_cells,
    unit_in_cell,
)

MAX_ROWS: Final = 20_000_000
"""Rows of a log: 23 days at 10 Hz, 0.8 GB as float64."""
MAX_COLUMNS: Final = 10_000
_DELIMITERS: Final = ("\t", ";", ",", "|")
_ROWS_ABOVE_DATA: Final = 4
"""Rows of units, types and remarks between a header and its data."""


class TextTable(NamedTuple):
    """Where a text holds its table; `remarks` are on lines that were left out."""

    head: Head
    delimiter: str
    headings: Sequence[str]
    units: Sequence[str]
    skip_lines: int
    remarks: list[str]
    word: str = ""

    def columns(
        self,
        places: Sequence[int],
        times: Collection[int] = (),
        optional: Collection[int] = (),
    ) -> dict[int, Any]:
        """Read columns, as `read_cells`.

        A cut last line and closing remarks of the exporter are left out, with a remark.

        Raises
        ------
        InputError
            If there is no row, or a row in the middle has the wrong number of cells.
        """
        width = self._width(places)
        names = [f"c{place}" for place in range(width)]
        texts = {names[place]: pa.string() for place in places}
        data = as_utf8(self.head.read())
        if data.endswith(b"\0"):
            data = data.rstrip(b"\0")
            self.remarks.append("zero bytes at the end omitted, as a power cut leaves them")
        is_whole = data.endswith((b"\n", b"\r"))
        try:
            beginning, _ = self._parsed(
                data[: data.rfind(b"\n", 0, HEAD_BYTES) + 1] or data, names, texts
            )
            numbers = numbers_in(beginning, [names[place] for place in times])
            try:
                table, odd_rows = self._parsed(data, names, texts | numbers)
                is_refuted = bool(numbers) and has_spelled_numbers(table.columns)
            except pa.ArrowInvalid:
                is_refuted = True
            if is_refuted:  # by a cell far below
                table, odd_rows = self._parsed(data, names, texts)
        except pa.ArrowInvalid as error:
            reason = str(error).splitlines()[0]
            raise self._error(f"the table cannot be read: {reason}", "export it again") from error
        del data  # before the numbers take their memory
        self._remark_odd(odd_rows, table.num_rows)
        if table.num_rows > MAX_ROWS:
            raise self._error(f"more than the {MAX_ROWS} rows that a log may have", "split it")
        if not is_whole:
            doubt = "if the file was cut off, its last value may be short"
            self.remarks.append(f"the last line has no line end: {doubt}")
        headings = [*self.headings, *repeat("", width)]
        columns = {place: table.column(names[place]) for place in places}
        source, mark = str(self.head.path), self.head.decimal_mark
        return read_cells(columns, headings, source, mark, times=times, optional=optional)

    def _parsed(
        self, data: bytes, names: list[str], types: Mapping[str, Any]
    ) -> tuple[Any, list[Any]]:
        """Return columns of a text by their types, and the rows of another number of cells."""
        odd_rows = list[Any]()

        def skip(row: Any) -> str:
            odd_rows.append(row)
            return "skip"

        # One thread: otherwise pyarrow does not number odd rows.
        how = pacsv.ReadOptions(use_threads=False, column_names=names, skip_rows=self.skip_lines)
        rows = pacsv.ParseOptions(delimiter=self.delimiter, invalid_row_handler=skip)
        cells = pacsv.ConvertOptions(
            include_columns=[*types],
            column_types=types,
            strings_can_be_null=True,
            check_utf8=False,  # `as_utf8` has
        )
        return pacsv.read_csv(pa.BufferReader(data), how, rows, cells), odd_rows

    def _width(self, places: Sequence[int]) -> int:
        """Return the number of cells of the first row, which may be another than the header's."""
        first = next((line for line in self.head.lines[self.skip_lines :] if line.strip()), "")
        if not first:
            raise self._error("there are no rows below the header", "check the export")
        cells = split_cells(first, self.delimiter)
        is_shifted = any(cells[len(self.headings) :])  # by an index without a heading
        if is_shifted or not max(places) < len(cells) <= MAX_COLUMNS:
            named = max((k + 1 for k, name in enumerate(self.headings) if name), default=0)
            problem = f"row 1 has {len(cells)} cells where the header has {named}"
            cure = "the file lacks a heading, is cut off or has another delimiter: export it"
            raise self._error(f"{problem} (at most {MAX_COLUMNS})", cure)
        return len(cells)

    def _remark_odd(self, odd_rows: list[Any], rows: int) -> None:
        # pyarrow numbers rows from 1, skipped lines included; only the last ones may be odd.
        last = self.skip_lines + rows + len(odd_rows)
        for row in odd_rows:
            is_text = row.actual_columns == 1 and not is_number(row.text)
            if is_text and row.number > last - len(odd_rows):
                self.remarks.append(f"closing line omitted: {row.text.strip()[:60]!r}")
            elif row.number == last and row.actual_columns < row.expected_columns:
                remark = "the last line is cut off and was omitted: the file may be incomplete"
                self.remarks.append(remark)
            else:
                problem = f"row {row.number - self.skip_lines} has {row.actual_columns} cells"
                problem += f" where the others have {row.expected_columns}"
                raise self._error(problem, "export the file again")

    def _error(self, problem: str, cure: str) -> InputError:
        return InputError(problem, source=self.head.path, cure=cure)


def split_cells(line: str, delimiter: str) -> list[str]:
    """Split a line into cells, without enclosing blanks and quotes."""
    reader = csv.reader([line], delimiter=delimiter, skipinitialspace=True)
    return [cell.strip() for cell in next(reader, [])]


def _values_in(cells: Sequence[str]) -> int:
    others = [cell for cell in cells if not is_number(cell)]
    return len(cells) - len(others) + count_stamps(others)


@lru_cache
def _values_in_line(line: str, delimiter: str) -> int:
    return _values_in(split_cells(line, delimiter))


def find_table(head: Head, given: ColumnMap | None = None) -> TextTable | None:
    """Return the table of a text in which time, current and voltage are known, or None."""
    texts = given.texts.values() if given else ()
    if texts and all(text.startswith("#") for text in texts):
        bare = without_header(head)
        if bare is not None:
            return bare
    for rows in (1, 2):
        for table in headed(head, rows):
            try:
                choice = choose_columns(table.headings, (), given)
            except InputError:  # no column has a heading that the user names
                continue
            if choice.is_complete:
                return _above_data(table, rows, choice, given)
    return None


def headed(head: Head, rows: int, *, columns: int = 3) -> Iterator[TextTable]:
    """Yield a table below every line or two, if the words of a header are in two rows.

    `columns` is the least number of them: a log has three.
    """
    for number, delimiter in product(range(len(head.lines) - rows + 1), _DELIMITERS):
        if delimiter not in head.lines[number]:
            continue
        first, *second = (split_cells(row, delimiter) for row in head.lines[number : number + rows])
        if any(len(row) != len(first) or _values_in(row[1:]) for row in second):
            continue
        headings = [" ".join(cells).strip() for cells in zip(first, *second, strict=True)]
        if len(headings) >= columns:
            yield TextTable(head, delimiter, headings, (), number + rows, [])


def _above_data(table: TextTable, rows: int, choice: Choice, given: ColumnMap | None) -> TextTable:
    """Return a table without the rows above its data, with their units.

    Rows below the header without a measured value are above the data. One of them holds units if it
    gives a quantity another unit, or shows that it is none (`t`, °C). So does the row above the
    header if it holds a unit of every quantity: words of a preamble may look like units. Rows of
    other words are left out with a remark.
    """
    names = choice.chosen if choice.is_canonical else NEEDED  # the unit of a SoC may be 1
    measured = [choice.chosen[name].places[-1] for name in names]
    lines, first = table.head.lines, table.skip_lines
    above = [line for line in lines[: first - rows] if line.strip()][-1:]
    below = lines[first : first + _ROWS_ABOVE_DATA]
    remarks = list[str]()
    for number, line in enumerate([*above, *below], start=first - len(above)):
        row = split_cells(line, table.delimiter)
        cells = [row[k] for k in measured if k < len(row) and row[k]]
        is_data = _values_in(cells) > 0 or any(map(unit_in_cell, cells[:1]))
        if is_data and number >= first:
            return table._replace(skip_lines=number, remarks=remarks)
        stated = _units_in(row, choice)
        is_whole = len(row) == len(table.headings) and stated == choice.chosen.keys()
        if is_data or (number < first and not is_whole):
            continue
        if stated <= {"soc"}:  # `-` is a unit of SoC, and a cell without a value
            if any(row):
                remarks.append(f"line below the header omitted: {line.strip()[:60]!r}")
            continue
        again = choose_columns(table.headings, row, given)
        units = {name: column.unit for name, column in again.chosen.items()}
        if any(units.get(name) != column.unit for name, column in choice.chosen.items()):
            table = table._replace(units=row)
    return table


def _units_in(row: Sequence[str], choice: Choice) -> set[str]:
    """Return the quantities of which a row holds a unit."""
    return {
        name
        for name, column in choice.chosen.items()
        if all(
            k < len(row) and unit_of(FIELDS[name], row[k].strip("()[]")) is not None
            for k in column.places
        )
    }


def without_header(head: Head) -> TextTable | None:
    """Return the table of a text that has no header, for columns given by number."""
    for number, delimiter in product(range(len(head.lines)), _DELIMITERS):
        cells = split_cells(head.lines[number], delimiter)
        if len(cells) > 2 and 2 * _values_in(cells) > len(cells):
            above = split_cells(head.lines[number - 1], delimiter) if number else []
            headings = [f"column {k}" for k in range(1, len(cells) + 1)]
            is_header = len(above) == len(cells)
            return None if is_header else TextTable(head, delimiter, headings, (), number, [])
    return None


def likely_header(head: Head, given: ColumnMap | None = None) -> tuple[list[str], Choice]:
    """Return the likeliest header of a text and its incomplete choice, for messages.

    Raises
    ------
    InputError
        If the header has none of a column of the user.
    """
    found: list[list[str]] = []
    for table in headed(head, rows=1, columns=2):
        if len(table.headings) == 2 and _count_known(table.headings) < 2:
            continue
        line, *below = head.lines[table.skip_lines - 1 : table.skip_lines + _ROWS_ABOVE_DATA]
        if _values_in_line(line, table.delimiter) > 1:
            break
        if any(_values_in_line(row, table.delimiter) > 1 for row in below):
            found.append([*table.headings])
    best = max(found, key=_count_known, default=[])
    return best, choose_columns(best, (), given)


def _count_known(headings: Sequence[str]) -> int:
    return sum(map(bool, map(meaning_of, headings)))

"""Tables in text: where they begin, and their columns.

A text may have a preamble, a header of two rows, a row of units, `,`, `;`, tab or `|` between the
columns, and a last line that is cut off.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, Final, NamedTuple

import pyarrow as pa
import pyarrow.csv as pacsv

from cangauge._files import Head, as_utf8
from cangauge.errors import InputError
from cangauge.logs.cells import MISSING, is_number, is_stamp
from cangauge.logs.column_map import (
    ChosenColumn,
    ColumnMap,
    choose_columns,
    is_canonical,
    unknown_columns,
)
from cangauge.logs.headings import meaning_of
from cangauge.logs.units import FIELDS, unit_of

MAX_ROWS: Final = 20_000_000
"""Rows of a log: 23 days at 10 Hz, 0.8 GB as float64."""
MAX_COLUMNS: Final = 10_000
_NULLS: Final = ["", *{s for text in MISSING for s in (text, text.upper(), text.title(), "NaN")}]
_DELIMITERS: Final = ("\t", ";", ",", "|")
_ROWS_ABOVE_DATA: Final = 4
"""Rows of units, types and remarks between a header and its data."""
_FRAME_WORDS: Final = frozenset({"id", "can id", "identifier", "dlc", "len", "data", "d1"})


class TextTable(NamedTuple):
    """Where a text holds its table; `remarks` are on lines that were left out."""

    head: Head
    delimiter: str
    headings: Sequence[str]
    units: Sequence[str]
    skip_lines: int
    remarks: list[str]

    def columns(self, places: Sequence[int]) -> dict[int, Any]:
        """Read columns as text, null where there is no value.

        A cut last line and closing remarks of the exporter are left out, with a remark.

        Raises
        ------
        InputError
            If there is no row, or a row in the middle has the wrong number of cells.
        """
        first = next((line for line in self.head.lines[self.skip_lines :] if line.strip()), "")
        width, wanted = len(split_cells(first, self.delimiter)), [f"f{place}" for place in places]
        if not first:
            raise self._error("there are no rows below the header", "check the export")
        if any(self.headings[width:]):
            problem = f"row 1 has {width} cells where the header has {len(self.headings)}"
            cure = "the file looks cut off or has another delimiter: export it again"
            raise self._error(problem, cure)
        data, odd = as_utf8(self.head.read()), list[Any]()

        def skip(row: Any) -> str:
            odd.append(row)
            return "skip"

        try:
            table = pacsv.read_csv(
                pa.BufferReader(data),
                # One thread: otherwise pyarrow does not number odd rows.
                read_options=pacsv.ReadOptions(
                    use_threads=False,
                    autogenerate_column_names=True,
                    skip_rows=self.skip_lines,
                ),
                parse_options=pacsv.ParseOptions(
                    delimiter=self.delimiter, invalid_row_handler=skip
                ),
                convert_options=pacsv.ConvertOptions(
                    include_columns=wanted,
                    column_types=dict.fromkeys(wanted, pa.string()),
                    null_values=_NULLS,
                    strings_can_be_null=True,
                ),
            )
        except pa.ArrowInvalid as error:
            problem = f"the table cannot be read: {str(error).splitlines()[0]}"
            raise self._error(problem, "export it again") from error
        if table.num_rows > MAX_ROWS:
            raise self._error(f"more than the {MAX_ROWS} rows that a log may have", "split it")
        self._remark_odd(odd, table.num_rows)
        if not data.endswith((b"\n", b"\r")):
            self.remarks.append(
                "the last line has no line end: if the file was cut off, its last value may be"
                " short"
            )
        return {place: table.column(f"f{place}") for place in places}

    def _remark_odd(self, odd: list[Any], rows: int) -> None:
        # pyarrow numbers rows from 1, skipped lines included; only the last ones may be odd.
        last = self.skip_lines + rows + len(odd)
        for row in odd:
            if row.number > last - len(odd) and row.actual_columns == 1 and not is_number(row.text):
                self.remarks.append(f"closing line omitted: {row.text.strip()[:60]!r}")
            elif row.number == last and row.actual_columns < row.expected_columns:
                self.remarks.append(
                    "the last line is cut off and was omitted: the file may be incomplete"
                )
            else:
                raise self._error(
                    f"row {row.number - self.skip_lines} has {row.actual_columns} cells where the"
                    f" others have {row.expected_columns}",
                    "export the file again",
                )

    def _error(self, problem: str, cure: str) -> InputError:
        return InputError(problem, source=self.head.path, cure=cure)


def split_cells(line: str, delimiter: str) -> list[str]:
    """Split a line into cells, without enclosing blanks and quotes."""
    reader = csv.reader([line], delimiter=delimiter, skipinitialspace=True)
    return [cell.strip() for cell in next(reader, [])]


def _is_value(cell: str) -> bool:
    return is_number(cell.replace(",", ".")) or is_stamp(cell)


def find_table(head: Head, given: ColumnMap | None = None) -> TextTable:
    """Return the table of a text that is canonical, or has time, current and voltage.

    Raises
    ------
    InputError
        If there is none, or a column of the user is in no line.
    """
    source, specs = str(head.path), given.specs.values() if given else ()
    by_number = bool(specs) and all(text.startswith("#") for text in specs)
    for rows in (1, 2):  # the words of a header may be in two rows
        for number, delimiter, cells in _headers(head, rows):
            if by_number and 2 * sum(map(_is_value, cells)) > len(cells):  # without a header
                headings = [f"column {k}" for k in range(1, len(cells) + 1)]
                return TextTable(head, delimiter, headings, (), number, [])
            if given is None and is_canonical(cells):
                return TextTable(head, delimiter, cells, (), number + rows, [])
            with suppress(InputError):
                chosen = choose_columns(cells, (), given, source=source)
                return _below(head, number + rows, delimiter, cells, chosen)
    raise unknown_columns(source, likely_header(head), given)


def _headers(head: Head, rows: int = 1) -> Iterator[tuple[int, str, list[str]]]:
    """Yield number, delimiter and cells of what may be a header of one or two rows."""
    for number, line in enumerate(head.lines):
        for delimiter in _DELIMITERS:
            cells = split_cells(line, delimiter) if delimiter in line else []
            for below in head.lines[number + 1 : number + rows]:
                second = split_cells(below, delimiter)
                is_words = len(second) == len(cells) and not any(map(_is_value, second[1:]))
                pairs = zip(cells, second, strict=True) if is_words else ()
                cells = [f"{one} {other}".strip() for one, other in pairs]
            if len(cells) > 2:
                yield number, delimiter, cells


def _below(
    head: Head, first: int, delimiter: str, cells: list[str], chosen: Mapping[str, ChosenColumn]
) -> TextTable:
    """Return the table below a header, with its row of units where there is one."""
    units: list[str] = []
    places = [(FIELDS[name], k) for name, column in chosen.items() for k in column.places]
    for number, line in enumerate(head.lines[first : first + _ROWS_ABOVE_DATA], start=first):
        row = split_cells(line, delimiter) + [""] * len(cells)
        if _is_value(row[chosen["time"].places[-1]]):
            return TextTable(head, delimiter, cells, units, number, [])
        if any(unit_of(field, row[place].strip("[](){} ")) for field, place in places):
            units = row
    return TextTable(head, delimiter, cells, units, first, [])


def likely_header(head: Head) -> list[str]:
    """Return the likeliest header of a text in which no table was found, for messages."""
    best: list[str] = []
    for number, delimiter, cells in _headers(head):
        if sum(map(_is_value, cells)) > 1:
            break
        below = head.lines[number + 1 : number + 1 + _ROWS_ABOVE_DATA]
        has_data = any(sum(map(_is_value, split_cells(row, delimiter))) > 1 for row in below)
        known, most = (sum(map(bool, map(meaning_of, row))) for row in (cells, best))
        if has_data and (not best or known > most):
            best = cells
    return best


def is_of_frames(headings: Iterable[str]) -> bool:
    """Return whether headings are those of CAN frames: an id, a length or bytes."""
    return bool(_FRAME_WORDS & {heading.strip().lower() for heading in headings})

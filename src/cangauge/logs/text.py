"""Tables in text: where they begin, and their columns.

A text may have a preamble, a header of two rows, a row of units, `,`, `;`, tab or `|` between the
columns, and a last line that is cut off.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from typing import Any, Final, NamedTuple

import pyarrow as pa
import pyarrow.csv as pacsv

from cangauge._files import Head, as_utf8
from cangauge.errors import InputError
from cangauge.logs import stamps
from cangauge.logs.column_map import (
    DOCS,
    Choice,
    ColumnMap,
    choose_columns,
    missing_quantities,
    suggestion,
)
from cangauge.logs.draft import shown_headings
from cangauge.logs.headings import meaning_of

MAX_ROWS: Final = 20_000_000
"""Rows of a log: 23 days at 10 Hz, 0.8 GB as float64."""
MAX_COLUMNS: Final = 10_000
_NO_VALUE: Final = "nan na n/a #n/a null none - -- 1.#qnan -1.#ind unknown unavailable n.a."
MISSING: Final = tuple(_NO_VALUE.split())
"""Cells without a value, in lower case."""
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
        """Read columns as numbers where all are plain numbers, else as text.

        A cut last line and closing remarks of the exporter are left out, with a remark.

        Raises
        ------
        InputError
            If there is no row, or a row in the middle has the wrong number of cells.
        """
        data = as_utf8(self.head.read())
        width = self._width()
        try:
            table = self._parse(data, places, width, pa.float64(), [])
        except pa.ArrowInvalid:
            odd: list[Any] = []
            try:
                table = self._parse(data, places, width, pa.string(), odd)
            except pa.ArrowInvalid as error:
                raise InputError(
                    f"the table cannot be read: {str(error).splitlines()[0]}",
                    source=self.head.path,
                ) from error
            self._remark_odd(odd, table.num_rows)
        if table.num_rows > MAX_ROWS:
            raise InputError(
                f"more than the {MAX_ROWS} rows that a log may have", source=self.head.path,
                value=table.num_rows, cure="split it",
            )  # fmt: skip
        if not table.num_rows:
            raise self._no_rows()
        if not data.endswith((b"\n", b"\r")):
            self.remarks.append(
                "the last line has no line end: if the file was cut off, its last value may be"
                " short"
            )
        return {place: table.column(f"c{place}") for place in places}

    def label(self, place: int) -> str:
        """Return the heading of a column for messages."""
        return self.headings[place] if place < len(self.headings) else f"column {place + 1}"

    def _parse(
        self, data: bytes, places: Sequence[int], width: int, kind: Any, odd: list[Any]
    ) -> Any:
        def collect(row: Any) -> str:
            odd.append(row)
            return "error" if kind == pa.float64() else "skip"

        names = [f"c{place}" for place in range(width)]
        wanted = [names[place] for place in places]
        return pacsv.read_csv(
            pa.BufferReader(data),
            # One thread: otherwise pyarrow does not number odd rows.
            read_options=pacsv.ReadOptions(
                use_threads=False, column_names=names, skip_rows=self.skip_lines
            ),
            parse_options=pacsv.ParseOptions(delimiter=self.delimiter, invalid_row_handler=collect),
            convert_options=pacsv.ConvertOptions(
                include_columns=list(dict.fromkeys(wanted)),
                column_types=dict.fromkeys(wanted, kind),
                null_values=_NULLS,
                strings_can_be_null=True,
            ),
        )

    def _width(self) -> int:
        """Return the number of cells of the first row: headers can be shorter than rows."""
        first = next((line for line in self.head.lines[self.skip_lines :] if line.strip()), None)
        if first is None:
            raise self._no_rows()
        width = len(split_cells(first, self.delimiter))
        named = max((k + 1 for k, name in enumerate(self.headings) if name), default=0)
        if width > MAX_COLUMNS or width < named:
            problem = f"row 1 has {width} cells where the header has {named}"
            cure = "the file looks cut off or has another delimiter: export it again"
            if width > MAX_COLUMNS:
                problem = f"more than the {MAX_COLUMNS} columns that a log may have"
                cure = "export only the columns that are needed"
            raise InputError(problem, source=self.head.path, cure=cure)
        return width

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
                raise InputError(
                    f"row {row.number - self.skip_lines} has {row.actual_columns} cells where the"
                    f" others have {row.expected_columns}",
                    source=self.head.path,
                    cure="export the file again",
                )

    def _no_rows(self) -> InputError:
        return InputError(
            "there are no rows below the header", source=self.head.path, cure="check the export"
        )


def split_cells(line: str, delimiter: str) -> list[str]:
    """Split a line into cells, without enclosing blanks and quotes."""
    reader = csv.reader([line], delimiter=delimiter, skipinitialspace=True)
    return [cell.strip() for cell in next(reader, [])]


def delimiter_of(line: str) -> str | None:
    """Return the delimiter of a line (tab before `;` before `,`), or None."""
    return next((mark for mark in _DELIMITERS[:3] if mark in line), None)


def is_number(text: str) -> bool:
    """Return whether a text is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _is_value(cell: str) -> bool:
    return is_number(cell.replace(",", ".")) or stamps.is_stamp(cell)


def find_table(head: Head, given: ColumnMap | None = None) -> TextTable | None:
    """Return the table of a text in which time, current and voltage are known, or None.

    Raises
    ------
    InputError
        If a column of the user is in no line.
    """
    specs = given.specs.values() if given else ()
    if specs and all(spec.text.startswith("#") for spec in specs):
        found = _without_header(head)
        if found is not None:
            return found
    for joined in (False, True):  # the words of a header may be in two rows
        for number, line in enumerate(head.lines):
            for delimiter in _DELIMITERS:
                cells = split_cells(line, delimiter) if delimiter in line else []
                if joined and cells:
                    cells = _joined(cells, head, number, delimiter)
                if len(cells) >= 3 and _is_complete(cells, given):
                    return _below(head, number + joined, delimiter, cells, given)
    if not specs:
        return None
    headings, _ = likely_header(head)
    choice = choose_columns(headings, (), given)  # names a heading that is missing
    raise InputError(
        f"no plain heading of {missing_quantities(choice)} (found: {shown_headings(headings)})",
        source=head.path,
        field=given.where if given else None,
        cure=f"name it too: {suggestion(headings, choice)} ({DOCS})",
    )


def _is_complete(cells: Sequence[str], given: ColumnMap | None) -> bool:
    try:
        return choose_columns(cells, (), given).is_complete
    except InputError:
        return False


def _joined(cells: list[str], head: Head, number: int, delimiter: str) -> list[str]:
    below = [split_cells(line, delimiter) for line in head.lines[number + 1 : number + 2]]
    if not below or len(below[0]) != len(cells) or any(map(_is_value, below[0][1:])):
        return []
    return [f"{one} {other}".strip() for one, other in zip(cells, below[0], strict=True)]


def _below(
    head: Head, number: int, delimiter: str, cells: list[str], given: ColumnMap | None
) -> TextTable:
    """Return the table below a header, with its row of units where there is one."""
    choice = choose_columns(cells, (), given)
    place = choice.chosen["time"].places[-1]
    units: list[str] = []
    first = number + 1
    for k in range(first, min(first + _ROWS_ABOVE_DATA, len(head.lines))):
        row = split_cells(head.lines[k], delimiter)
        if place < len(row) and _is_value(row[place]):
            first = k
            break
        again = choose_columns(cells, row, given).chosen if any(row) else {}
        if len(again) >= len(choice.chosen) and any(
            again[name].unit != column.unit for name, column in choice.chosen.items()
        ):
            units = row
    return TextTable(head, delimiter, cells, units, first, [])


def _without_header(head: Head) -> TextTable | None:
    """Return the table of a text that has no header, for columns given by number."""
    for number, line in enumerate(head.lines):
        for delimiter in _DELIMITERS:
            cells = split_cells(line, delimiter)
            if len(cells) >= 3 and sum(map(_is_value, cells)) > len(cells) / 2:
                above = split_cells(head.lines[number - 1], delimiter) if number else []
                headings = [f"column {k}" for k in range(1, len(cells) + 1)]
                is_header = len(above) == len(cells)
                return None if is_header else TextTable(head, delimiter, headings, (), number, [])
    return None


def likely_header(head: Head) -> tuple[list[str], Choice]:
    """Return the likeliest header of a text and its incomplete choice, for messages."""
    for number, line in enumerate(head.lines):
        for delimiter in _DELIMITERS:
            if not number or sum(map(_is_value, split_cells(line, delimiter))) < 2:
                continue
            above = head.lines[max(number - _ROWS_ABOVE_DATA, 0) : number]
            rows = [split_cells(each, delimiter) for each in reversed(above)]
            words = [
                row for row in rows if len(row) > 2 and sum(map(bool, map(meaning_of, row))) > 1
            ]
            cells = words[0] if words else rows[0]
            if len(cells) > 1 and 2 * sum(map(_is_value, cells)) < len(cells):
                return cells, choose_columns(cells)
    return [], Choice()


def is_of_frames(headings: Iterable[str]) -> bool:
    """Return whether headings are those of CAN frames: an id, a length or bytes."""
    return bool(_FRAME_WORDS & {heading.strip().lower() for heading in headings})

"""Tables in other clothes: a workbook's longest sheet, the history of Home Assistant."""

from __future__ import annotations

from itertools import islice
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cangauge._files import Head
from cangauge.errors import InputError
from cangauge.logs.column_map import ColumnMap, choose_columns, unknown_columns
from cangauge.logs.draft import DraftLog
from cangauge.logs.read import LogTableReader
from cangauge.logs.stamps import seconds_of_text
from cangauge.logs.table import ArrowTable, draft_of_table, held
from cangauge.logs.text import MAX_ROWS, TextTable, split_cells

HOLD_ENTITY_S: Final = 60.0
"""Longest time that a stored value is held [s], as long as charge is counted over a gap: a recorder
stores a value when it changes."""


class Workbook:
    """The longest sheet of an Excel workbook (.xlsx)."""

    takes_columns = True

    def matches(self, head: Head) -> bool:
        """Return whether the file is a workbook: `Head` unpacks every other zip."""
        return head.data.startswith(b"PK\x03\x04")

    def read(self, head: Head, columns: ColumnMap | None = None) -> DraftLog:
        """Read the longest sheet as a text of tabs.

        Raises
        ------
        InputError
            If openpyxl is not installed, or the workbook is damaged or holds no log.
        """
        sheet = _SheetText(head)
        draft = LogTableReader().read(sheet, columns)
        draft.remarks.extend(sheet.remarks)
        return draft


class _SheetText(Head):
    """The text of a workbook's sheet in place of the file's content."""

    def __init__(self, head: Head) -> None:
        self.path, self.name = head.path, head.name
        sheets = _sheets(head)
        longest, rows = max(sheets.items(), key=lambda sheet: len(sheet[1]), default=("", []))
        others = [f"{title!r} ({len(each)} rows)" for title, each in sheets.items()
                  if each and title != longest]  # fmt: skip
        remark = f"sheet {longest!r} is read, the longest; not read: {', '.join(others)}"
        self.remarks = [remark] if others else []
        self._text = "\n".join([*rows, ""]).encode()
        self.data = self._text[: 1 << 16]
        self.lines = tuple(self.data.decode(errors="ignore").splitlines()[:160])

    def read(self) -> bytes:
        return self._text


def _sheets(head: Head) -> dict[str, list[str]]:
    """Return the rows of each sheet by its title."""
    try:
        import openpyxl  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise InputError(
            "reading a workbook needs openpyxl",
            source=head.path,
            cure="install the extra: pip install 'cangauge[excel]', or export the sheet as CSV",
        ) from error
    try:
        with head.open() as file:
            book = openpyxl.load_workbook(file, read_only=True, data_only=True)
            return {sheet.title: _rows(sheet) for sheet in book.worksheets}
    except Exception as error:  # openpyxl raises whatever a damaged part provokes
        raise InputError(
            f"the workbook is damaged ({type(error).__name__})",
            source=head.path,
            cure="save it again, or export the sheet as CSV",
        ) from error


def _rows(sheet: Any) -> list[str]:
    """Return the rows of a sheet that hold anything, as lines with tabs."""
    lines = (
        "\t".join("" if cell is None else " ".join(f"{cell}".split()) for cell in row)
        for row in sheet.iter_rows(values_only=True)
    )
    return [line for line in islice(lines, MAX_ROWS) if line.strip()]


class EntityHistory:
    """A row per entity and change, as Home Assistant exports: the entity is the heading."""

    takes_columns = True
    _NAMES: Final = ("entity_id", "state", "last_changed")

    def matches(self, head: Head) -> bool:
        """Return whether the header is that of a history."""
        return set(self._NAMES) <= {cell.lower() for cell in split_cells(head.first_line, ",")}

    def read(self, head: Head, columns: ColumnMap | None = None) -> DraftLog:
        """Read a history: a row for every time at which the current or the voltage changed."""
        names, first = split_cells(head.first_line, ","), head.lines.index(head.first_line) + 1
        text = TextTable(head, ",", names, (), first, [])
        lower = [cell.lower() for cell in names]
        places = [lower.index(name) for name in self._NAMES]
        cells = text.columns(places)
        entity, state, changed = (cells[place].cast(pa.string()) for place in places)
        source = str(head.path)
        stamps, how = seconds_of_text(changed, "", source, "last_changed")
        order = np.argsort(stamps, kind="stable")
        stamps = stamps[order]
        entity, values = entity.take(order), _as_numbers(state).take(order)
        headings = ["time", *entity.unique().drop_null().to_pylist()]
        choice = choose_columns(headings, (), columns)
        if not choice.is_complete:
            raise unknown_columns(source, headings, choice)
        of_entity = {
            name: np.where(pc.equal(entity, name).to_numpy(), values.to_numpy(), np.nan)
            for name in headings[1:]
        }
        driving = [
            headings[place] for q in ("current", "voltage") for place in choice.chosen[q].places
        ]
        is_change = np.any([np.isfinite(of_entity[name]) for name in driving], axis=0)
        last = np.append(np.flatnonzero(np.diff(stamps) > 0.0), stamps.size - 1)
        at = last[np.isin(stamps[last], stamps[is_change])]
        table: dict[str, Any] = {"time": stamps[at]}
        for name, column in of_entity.items():
            latest, age_s = held(stamps, column, at)
            is_old = (age_s > HOLD_ENTITY_S) & (name in driving)
            table[name] = np.where(is_old, np.nan, latest)
        known = np.all([np.isfinite(table[name]) for name in driving], axis=0)
        frame = pa.table({name: each[known] for name, each in table.items()})
        draft = draft_of_table(
            ArrowTable(headings, frame.select), columns, name=head.name, source=source
        )
        draft.assumed[0] = f'time = "last_changed" [{how}]'
        draft.labels["time_s"] = "last_changed"
        draft.ignored = ()
        return draft


def _as_numbers(cells: Any) -> Any:
    is_number = pc.match_substring_regex(cells, r"^\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*$")
    numbers = pc.if_else(is_number, pc.utf8_trim_whitespace(cells), pa.scalar(None, pa.string()))
    return pc.fill_null(pc.cast(numbers, pa.float64()), float("nan"))


READERS: Final = (Workbook(), EntityHistory())

"""Cell voltages beside a log: the columns `cell_1_v`, `cell_2_v`, …, `Cell 1 [mV]`, … ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.column_map import ColumnMap
from cangauge.logs.headings import cell_number
from cangauge.logs.read import LogTableReader, open_log, open_table
from cangauge.logs.table import draft_of_table, numbers_of


@dataclass(frozen=True, eq=False)
class CellColumns:
    """Voltages of the cells of a log.

    Parameters
    ----------
    first : int
        Number of the first cell.
    voltage_v : array of shape (n, cells)
        Voltage [V] at the log's rows; NaN where missing.
    """

    first: int
    voltage_v: FloatArray

    @property
    def count(self) -> int:
        """Number of cells."""
        return int(self.voltage_v.shape[1])


def read_cells(
    path: str | PathLike[str], time_s: FloatArray, columns: ColumnMap | None = None
) -> CellColumns | None:
    """Read the cell voltages of a log's file; None where it has no such columns.

    Parameters
    ----------
    path : path-like
    time_s : array of shape (n,)
        Times of the log's rows, which the reader may have dropped some of [s].
    columns : ColumnMap, optional
        The user's columns of the log.

    Raises
    ------
    InputError
        If the numbers of the cells have gaps, or a cell holds anything but a number.
    """
    file = open_log(path, columns=columns)
    if not isinstance(file.reader, LogTableReader):
        return None
    source = str(path)
    with open_table(file.head, columns) as table:
        places = _places(table.headings, source)
        if len(places) < 2:  # a single cell is its pack
            return None
        cells = table.columns([place for place, _ in places.values()])
        volts = np.column_stack(
            [
                scale * numbers_of(cells[place], source, table.headings[place])[0]
                for place, scale in places.values()
            ]
        )
        file_s = draft_of_table(table, columns, name=file.head.name, source=source).values["time_s"]
    if file_s.size != volts.shape[0]:
        return None  # rows that hold only what changed
    order = np.argsort(file_s, kind="stable")
    rows = order[np.minimum(np.searchsorted(file_s[order], time_s), file_s.size - 1)]
    return CellColumns(
        min(places), np.where((file_s[rows] == time_s)[:, None], volts[rows], np.nan)
    )


def _places(headings: Sequence[str], source: str) -> dict[int, tuple[int, float]]:
    """Return the column and scale of each cell by its number, in order."""
    found: dict[int, tuple[int, float]] = {}
    for place, heading in enumerate(headings):
        cell = cell_number(heading)
        if cell is not None:
            found.setdefault(cell[0], (place, cell[1]))
    numbers = sorted(found)
    missing = [k for k in range(numbers[0], numbers[-1]) if k not in found] if numbers else []
    if missing:
        problem, field = "the cells must be numbered without gaps", f"cell_{missing[0]}_v"
        raise InputError(problem, source=source, field=field, cure="export all cells")
    return {number: found[number] for number in numbers}

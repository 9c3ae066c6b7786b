"""Cell voltages beside a log: the columns `cell_1_v`, `cell_2_v`, …, `Cell 1 [mV]`, … ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.column_map import ColumnMap
from cangauge.logs.headings import cell_number
from cangauge.logs.read import TableReader, draft_of_table, open_log, open_table
from cangauge.logs.table import numbers_of

_LEAST: Final = 2
"""A single cell is its pack."""


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
    """Read the cell voltages of a log's file.

    Parameters
    ----------
    path : path-like
    time_s : array of shape (n,)
        Times of the log's rows, which the reader may have dropped some of [s].
    columns : ColumnMap, optional
        The user's columns of the log.

    Returns
    -------
    CellColumns or None
        None where the file has no such columns.

    Raises
    ------
    InputError
        If the numbers of the cells have gaps, or a cell holds anything but a number.
    """
    file = open_log(path, columns=columns)
    if not isinstance(file.reader, TableReader):
        return None
    with open_table(file.head, columns) as (table, _):
        places = _places(table.headings, str(path))
        if len(places) < _LEAST:
            return None
        at = [place for place, _ in places.values()]
        volts = table.columns(at)
        source = str(path)
        values = np.column_stack(
            [
                scale * numbers_of(volts[place], source, table.headings[place])[0]
                for place, scale in places.values()
            ]
        )
        file_s = draft_of_table(table, columns, name=file.head.name, source=source).values["time_s"]
    if file_s.size != values.shape[0]:
        return None  # rows that hold only what changed
    return CellColumns(min(places), _at_rows(file_s, values, time_s))


def _places(headings: Sequence[str], source: str) -> dict[int, tuple[int, float]]:
    """Return the column and scale of each cell by its number, in order."""
    found: dict[int, tuple[int, float]] = {}
    for at, heading in enumerate(headings):
        cell = cell_number(heading)
        if cell is not None:
            found.setdefault(cell[0], (at, cell[1]))
    numbers = sorted(found)
    missing = [k for k in range(numbers[0], numbers[-1]) if k not in found] if numbers else []
    if missing:
        problem, field = "the cells must be numbered without gaps", f"cell_{missing[0]}_v"
        raise InputError(problem, source=source, field=field, cure="export all cells")
    return {number: found[number] for number in numbers}


def _at_rows(file_s: FloatArray, volts: FloatArray, time_s: FloatArray) -> FloatArray:
    """Return the rows of the file at the times of the log, NaN where there is none."""
    order = np.argsort(file_s, kind="stable")
    places = np.minimum(np.searchsorted(file_s[order], time_s), file_s.size - 1)
    rows = order[places]
    return np.where((file_s[rows] == time_s)[:, None], volts[rows], np.nan)

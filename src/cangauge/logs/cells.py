"""Cell voltages beside a canonical log: the columns `cell_1_v`, `cell_2_v`, … [V]."""

from __future__ import annotations

import re
from dataclasses import dataclass
from os import PathLike
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.canonical import is_canonical_csv
from cangauge.logs.columns import read_columns
from cangauge.logs.file_content import FileContent, delimiter_of, split_cells

_NAME: Final = re.compile(r"cell_0*(\d{1,4})_v", re.IGNORECASE)
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


def read_cells(path: str | PathLike[str], time_s: FloatArray) -> CellColumns | None:
    """Read the cell voltages of a canonical log's file.

    Parameters
    ----------
    path : path-like
    time_s : array of shape (n,)
        Times of the log's rows, which the reader may have dropped some of [s].

    Returns
    -------
    CellColumns or None
        None where the file has no such columns.

    Raises
    ------
    InputError
        If the numbers of the cells have gaps, or a cell holds anything but a number.
    """
    content = FileContent(path)
    if content.is_parquet:
        table = pq.ParquetFile(pa.BufferReader(content.read()))
        header = table.schema_arrow.names
    elif is_canonical_csv(content):
        delimiter = delimiter_of(content.first_line) or ","
        header = split_cells(content.first_line, delimiter)
    else:
        return None
    places = _places(header, str(path))
    clock = next((at for at, name in enumerate(header) if name.strip().lower() == "time_s"), None)
    if len(places) < _LEAST or clock is None:
        return None
    wanted = {"time_s": clock, **{str(number): at for number, at in places.items()}}
    if content.is_parquet:
        columns = table.read(columns=[header[at] for at in wanted.values()])
        try:
            values = {
                name: np.asarray(columns.column(header[at]).cast(pa.float64()).to_numpy())
                for name, at in wanted.items()
            }
        except pa.ArrowException as error:
            raise InputError(
                f"the columns of the cells do not hold numbers ({error})", source=path
            ) from error
    else:
        found = read_columns(
            content,
            wanted,
            header=header,
            delimiter=delimiter,
            skip_lines=content.head.index(content.first_line) + 1,
        )
        values = {name: found.numbers(name) for name in wanted}
    volts = np.column_stack([values[str(number)] for number in places])
    return CellColumns(min(places), _at_rows(values["time_s"], volts, time_s))


def _places(header: list[str], source: str) -> dict[int, int]:
    """Return the column of each cell by its number, in order."""
    places: dict[int, int] = {}
    for at, name in enumerate(header):
        match = _NAME.fullmatch(name.strip())
        if match is not None and int(match[1]) not in places:
            places[int(match[1])] = at
    numbers = sorted(places)
    if numbers and numbers != list(range(numbers[0], numbers[0] + len(numbers))):
        missing = next(n for n in range(numbers[0], numbers[-1]) if n not in places)
        raise InputError(
            "the cells must be numbered without gaps", source=source, field=f"cell_{missing}_v"
        )
    return {number: places[number] for number in numbers}


def _at_rows(file_s: FloatArray, volts: FloatArray, time_s: FloatArray) -> FloatArray:
    """Return the rows of the file at the times of the log, NaN where there is none."""
    order = np.argsort(file_s, kind="stable")
    places = np.minimum(np.searchsorted(file_s[order], time_s), file_s.size - 1)
    rows = order[places]
    return np.where((file_s[rows] == time_s)[:, None], volts[rows], np.nan)

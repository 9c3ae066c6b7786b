"""Read a log of any known format, recognised by content, not by suffix."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib import import_module
from importlib.metadata import entry_points
from os import PathLike
from typing import Any, Final, Protocol

import numpy as np
import pyarrow as pa

from cangauge._files import Head
from cangauge._typing import FloatArray
from cangauge.errors import InputError, require_temperature
from cangauge.logs.canonical import parquet_table, table_of_schema
from cangauge.logs.column_map import DOCS, ColumnMap
from cangauge.logs.columns import UnknownColumnsError, choose_columns
from cangauge.logs.draft import BESIDES, DraftLog
from cangauge.logs.headings import cell_number
from cangauge.logs.log import Log
from cangauge.logs.quantities import FIELDS
from cangauge.logs.sign import Sign
from cangauge.logs.table import ArrowTable, draft_of_table
from cangauge.logs.text import TextTable, find_table, likely_header, without_header
from cangauge.logs.values import UnclearMarkError
from cangauge.settings import TemperatureSource

KNOWN_LOGS: Final = (
    "canonical Parquet and CSV (time_s, current_a, voltage_v, temperature_c, soc_pct), ANL D3"
    " tests, BMW i3 trips, Arbin, Bitrode and VisuaLCN exports, Battery Data Format, MF4"
    " signals, any table with plain headings"
)
_FORMATS: Final = tuple(
    f"cangauge.extras.formats.{module}" for module in ("exports", "tables", "measurement")
)
"""Modules with further readers, each in its tuple `READERS`; loaded when a log is opened."""
_PARQUET: Final = b"PAR1"
GROUP: Final = "cangauge.readers"
"""Entry points of readers of other packages: a `LogReader`."""


class LogReader(Protocol):
    """Reader of one format of logs."""

    takes_columns: bool
    """Whether the user may name the columns of this format."""

    def matches(self, head: Head) -> bool:
        """Return whether a file begins as this format does."""

    def read(self, head: Head, columns: ColumnMap | None = None, /) -> DraftLog:
        """Read the file; raise InputError where it is damaged or lacks something."""


class LogTableReader:
    """Parquet or text with canonical or plain headings, or the user's columns of it."""

    takes_columns = True

    def matches(self, head: Head) -> bool:
        """Return whether the file is Parquet, or a text with time, current and voltage."""
        return head.data.startswith(_PARQUET) or find_table(head) is not None

    def read(self, head: Head, columns: ColumnMap | None = None) -> DraftLog:
        """Read the table; see `LogReader`."""
        return draft_of_table(
            self.table(head, columns), columns, name=head.name, source=str(head.path)
        )

    def table(self, head: Head, columns: ColumnMap | None) -> TextTable | ArrowTable:
        """Return the table; only its headings are read."""
        is_parquet = head.data.startswith(_PARQUET)
        table = parquet_table(head) if is_parquet else find_table(head, columns)
        if table is None:
            raise UnknownColumnsError(str(head.path), *likely_header(head, columns), columns)
        return table


@cache
def _readers() -> tuple[LogReader, ...]:
    """Return all readers, in the order in which a file is offered to them."""
    others = [entry.load()() for entry in entry_points(group=GROUP)]
    formats = [reader for name in _FORMATS for reader in import_module(name).READERS]
    return (*others, *formats, LogTableReader())


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


@dataclass(frozen=True, slots=True)
class LogFile:
    """A file that may be a log, recognised by its beginning.

    `reader` is None if it is not a log. `columns` and `sign` are the user's; `read_besides` are
    headings that the caller reads itself, so that they are not ignored.
    """

    head: Head
    reader: LogReader | None
    columns: ColumnMap | None = None
    sign: Sign | None = None
    read_besides: tuple[str, ...] = ()

    @property
    def is_any_table(self) -> bool:
        """Whether the file is a text of plain headings, not of a format that defines them."""
        table = find_table(self.head) if isinstance(self.reader, LogTableReader) else None
        return table is not None and not choose_columns(table.headings).is_canonical

    def read(
        self,
        *,
        temperature_c: float | None = None,
        temperature_source: TemperatureSource | None = None,
    ) -> Log:
        """Read the log; arguments and errors as of `cangauge.read_log`.

        If a mark is unclear (`3,800`) and only one reading of it makes a log, it is taken.
        """
        require_temperature(temperature_c)
        self.head.decimal_mark = ""
        try:
            return self._read(temperature_c, temperature_source)
        except UnclearMarkError as error:
            logs = dict[str, Log]()
            for mark in (",", "."):
                self.head.decimal_mark = mark
                with suppress(InputError):
                    logs[mark] = self._read(temperature_c, temperature_source)
            if len(logs) != 1:
                raise
            ((mark, log),) = logs.items()
            self.head.decimal_mark = mark
            taken = "decimals" if mark in str(error.value) else "thousands"
            remark = f"{error.field}: the mark in {error.value} separates {taken}"
            remark += "; the other reading makes no log"
            return replace(log, remarks=(*log.remarks, remark))

    def _read(
        self, temperature_c: float | None, temperature_source: TemperatureSource | None
    ) -> Log:
        reader = self.reader
        if reader is None:
            raise not_recognised(self, "not a known kind of log", f"known are: {KNOWN_LOGS}")
        try:
            draft = reader.read(self.head, self.columns)
            pa.default_memory_pool().release_unused()  # the table's, before the checks take theirs
            draft.ignored = tuple(name for name in draft.ignored if name not in self.read_besides)
            return draft.log(temperature_c, temperature_source, self.sign)
        except UnknownColumnsError as error:
            raise error.proposing(partial(self.can_read, reader)) from error
        except MemoryError as error:
            problem, cure = "larger than the free memory", "split it"
            raise InputError(problem, source=self.head.path, cure=cure) from error

    def can_read(self, reader: LogReader, columns: ColumnMap) -> bool:
        """Return whether a reader makes a log of the file's beginning by these columns."""
        head = self.head
        if head.lines:
            head = head.holding(head.data[: head.data.rfind(b"\n") + 1])
        constant_c = None if "temperature" in columns.texts else 20.0
        try:
            return len(reader.read(head, columns).log(constant_c, None, self.sign)) > 1
        except InputError:
            return False

    def cells(self, time_s: FloatArray) -> CellColumns | None:
        """Return the cell voltages beside the log that was read; None where a table has none.

        Parameters
        ----------
        time_s : array of shape (n,)
            Times of the log's rows, some of which the reader may have dropped [s].
        """
        if not isinstance(self.reader, LogTableReader):
            return None
        table, source = self.reader.table(self.head, self.columns), str(self.head.path)
        cells = _cells(table.headings, source)
        if len(cells) < 2:  # a single cell is its pack
            return None
        scales = dict(cells.values())
        draft = draft_of_table(
            table, self.columns, name=self.head.name, source=source, besides=scales
        )
        volts = np.column_stack([draft.values[f"{BESIDES}{table.headings[k]}"] for k in scales])
        file_s = draft.values["time_s"]
        order = np.argsort(file_s, kind="stable")
        rows = order[np.minimum(np.searchsorted(file_s[order], time_s), file_s.size - 1)]
        is_row = (file_s[rows] == time_s)[:, None]
        return CellColumns(min(cells), np.where(is_row, volts[rows], np.nan))


def not_recognised(file: LogFile, problem: str, cure: str) -> InputError:
    """Return the error for a file of unknown format: its columns if it is a table."""
    head, field, value = file.head, None, None
    foreign = import_module("cangauge.extras.formats.foreign").foreign_format(head)
    headings, choice = likely_header(head)
    bare = without_header(head)
    shown = head.first_line.strip()
    if foreign is not None:
        kind, cure = foreign
        problem = f"{problem}: it is {kind}"
    elif sum(map(bool, headings)) > 1:
        unknown = UnknownColumnsError(str(head.path), headings, choice, None)
        error = unknown.proposing(partial(file.can_read, LogTableReader()))
        problem, cure = f"{problem}: {error.problem}", error.cure or ""
    elif bare is not None:
        problem, count = f"{problem}: a table without a header", len(bare.headings)
        named = ",".join(f"{name}=#{k}" for k, name in enumerate([*FIELDS][:count], start=1))
        cure = f"name its {count} columns by number, such as --columns '{named}' ({DOCS})"
    else:
        cure += f"; other tables: --columns ({DOCS})"
        if shown and shown.isprintable():
            field, value = "first line", shown[:80]
    return InputError(problem, source=head.path, field=field, value=value, cure=cure)


def open_log(
    path: str | PathLike[str],
    *,
    columns: ColumnMap | Mapping[str, str] | str | None = None,
    sign: Sign | None = None,
) -> LogFile:
    """Read the beginning of a file and find its format.

    Arguments as of `cangauge.read_log`.

    Raises
    ------
    InputError
        If the file is absent, empty, damaged or not a regular file.
    """
    head, given = Head(path), None if columns is None else ColumnMap.of(columns)
    for reader in _readers():
        if (given is None or reader.takes_columns) and reader.matches(head):
            return LogFile(head, reader, given, sign)
    # The user's columns make a table of any text.
    return LogFile(head, None if given is None else LogTableReader(), given, sign)


def log_of_dataframe(
    frame: Any,
    *,
    name: str,
    columns: ColumnMap | Mapping[str, str] | str | None,
    temperature_c: float | None,
    temperature_source: TemperatureSource | None,
    sign: Sign | None,
) -> Log:
    """Return the log in a data frame; see `Log.from_dataframe`."""
    require_temperature(temperature_c)
    try:
        table = pa.table(frame)
    except (TypeError, ValueError, pa.ArrowException) as error:
        cure = "give a Log, the path of one, or a table of time, current, voltage, temperature"
        raise InputError("not a log", value=type(frame).__name__, cure=cure) from error
    indices = [column for column in table.schema if column.name.startswith("__index_level_")]
    times = [column.name for column in indices if pa.types.is_timestamp(column.type)]
    if len(times) == 1 and {"time", "time_s"}.isdisjoint(map(str.lower, table.column_names)):
        table = table.rename_columns({times[0]: "time"})  # an unnamed pandas index
    table = table.drop_columns([c.name for c in indices if c.name in table.column_names])
    given = None if columns is None else ColumnMap.of(columns)
    source = table_of_schema(table.schema, table.select, name)
    draft = draft_of_table(source, given, name=name, source="")
    return draft.log(temperature_c, temperature_source, sign)


def _cells(headings: Sequence[str], source: str) -> dict[int, tuple[int, float]]:
    """Return the column and scale of each cell by its number, in order."""
    cells: dict[int, tuple[int, float]] = {}
    for place, heading in enumerate(headings):
        if (cell := cell_number(heading)) is not None:
            number, scale = cell
            cells.setdefault(number, (place, scale))
    first = min(cells, default=0)
    for number in range(first, first + len(cells)):
        if number not in cells:
            problem, field = "the cells must be numbered without gaps", f"cell_{number}_v"
            raise InputError(problem, source=source, field=field, cure="export all cells")
    return dict(sorted(cells.items()))
